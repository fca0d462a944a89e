"""Holds rows that the database could not take yet: in a file next to it, else in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Final

from webots_mcp.bridge.simulation import CurrentRun
from webots_mcp.database.waiting_file import (
    ENTRIES_AT_ONCE,
    Kind,
    Values,
    WaitingEntry,
    WaitingFile,
)

MAX_WAITING_ROWS: Final = 10_000
MAX_WAITING_BYTES: Final = 16_000_000


class Row:
    """A write of the session, the run that it belongs to, and its number once it has one."""

    __slots__ = ("kind", "number", "run", "values")

    def __init__(self, kind: Kind, run: CurrentRun | None, values: Values) -> None:
        self.kind: Kind = kind
        self.run = run
        self.values = values
        self.number: int | None = None


class Backlog:
    """The waiting rows, oldest first: the entries of the file, then the rows in memory.

    A row stays in memory only if the file cannot take it (a full disk, a database in memory), or
    until the next call if another thread was writing. Any thread may call `put`; all other methods
    require the connection lock. The order of the statements matters: an interrupt at any place may
    leave a row here that is written already, which its number shows. It never loses one.

    Args:
        file: Where rows survive the process; None for memory alone.
        describe_run: Returns the values of a run's own entry.
        drop: Counts dropped rows, and says why.

    Attributes:
        why: The reason why rows wait.
    """

    def __init__(
        self,
        file: WaitingFile | None,
        describe_run: Callable[[CurrentRun], dict[str, Any]],
        drop: Callable[[int, str], None],
    ) -> None:
        self._file = file
        self._describe_run = describe_run
        self._drop = drop
        self._rows: deque[Row] = deque()
        self._bytes = 0
        self._last_number = 0
        self._in_file = 0
        self._offset = 0
        self._read: list[tuple[int, WaitingEntry]] = []
        self._described: set[str] = set()
        self._names: dict[str, str] = {}
        self.why = "too many wait"

    @property
    def waits(self) -> bool:
        """Whether rows may be waiting."""
        return bool(self._rows or self._in_file)

    @property
    def rows_in_memory(self) -> int:
        """Waiting rows that a killed process would lose."""
        return len(self._rows)

    @property
    def rows(self) -> int:
        """The number of waiting rows."""
        return len(self._rows) + self._in_file

    def put(self, row: Row) -> None:
        """Add the newest row, in memory."""
        self._rows.append(row)
        self._bytes += _weight(row)

    def keep(self, row: Row) -> None:
        """Put a row where it survives the process; in memory only where that fails."""
        self.put(row)
        self.save()
        while len(self._rows) > MAX_WAITING_ROWS or self._bytes > MAX_WAITING_BYTES:
            self._remove_oldest()
            self._drop(1, self.why)

    def save(self) -> None:
        """Move the rows in memory to the file, as far as it takes them."""
        while self._rows and self._file is not None:
            row = self._rows[0]
            self._in_file += 1  # first: an interrupt after `append` must not hide the file's rows
            try:
                self._file.append(self._entries(row, self._described))
            except OSError:
                self._in_file -= 1
                return  # it waits in memory instead
            if row.run is not None:
                self._described.add(row.run.uuid)
            self._remove_oldest()

    def next_entries(self) -> list[WaitingEntry]:
        """Return the oldest entries, which stay until `forget`; an empty list if nothing waits."""
        if self._in_file and self._file is not None:
            self._read = self._read or self._file.read(self._offset)
            if self._read:
                return [self._renamed(entry) for _, entry in self._read]
            self._empty_file()
        entries: list[WaitingEntry] = []
        described: set[str] = set()
        for index in range(min(len(self._rows), ENTRIES_AT_ONCE)):
            row = self._rows[index]
            entries += self._entries(row, described)
            if row.run is not None:
                described.add(row.run.uuid)
        return entries

    def forget(self, number: int) -> None:
        """Remove the entries up to that number, which the database now has."""
        done = [item for item in self._read if item[1].number <= number]
        if done:
            self._offset = done[-1][0]
            self._read = self._read[len(done) :]
            rows = sum(entry.kind != "run" for _, entry in done)
            # Only `next_entries` finds out that the file has ended, and sets 0.
            self._in_file = max(1, self._in_file - rows)
        while self._rows and (self._rows[0].number or number + 1) <= number:
            self._remove_oldest()

    def rename_run(self, before: str, now: str) -> None:
        """Assign the entries in the file to the run that continues theirs in another database."""
        self._names = {old: now if name == before else name for old, name in self._names.items()}
        self._names[before] = now

    def drop_rows_in_memory(self, why: str) -> None:
        """Drop the rows in memory, which nothing will write any more."""
        while self._rows:
            try:
                self._remove_oldest()
            except IndexError:  # another thread was quicker
                return
            self._drop(1, why)

    def close(self) -> str | None:
        """Close the file; one that still has entries is not deleted, and its path is returned."""
        file, self._file = self._file, None
        if file is None:
            return None
        file.close(remove=not self._in_file)
        return str(file.path) if self._in_file else None

    def abandon(self) -> None:
        """Forget the waiting rows in a forked child: they belong to the parent."""
        if self._file is not None:
            self._file.close(remove=False)
            self._file = None
        self._rows.clear()
        self._bytes = self._in_file = 0

    def _remove_oldest(self) -> None:
        self._bytes -= _weight(self._rows.popleft())

    def _renamed(self, entry: WaitingEntry) -> WaitingEntry:
        if isinstance(entry.values, dict) and (
            name := self._names.get(entry.values.get("uuid", ""))
        ):
            return entry._replace(values={**entry.values, "uuid": name})
        return entry._replace(run=self._names.get(entry.run or "", entry.run))

    def _empty_file(self) -> None:
        assert self._file is not None
        self._described.clear()  # first: a run that is described twice does no harm
        self._offset, self._read = 0, []
        self._file.empty()
        self._in_file = 0

    def _entries(self, row: Row, described: set[str]) -> list[WaitingEntry]:
        """Return the row's entry; before it that of its run, unless that is described already."""
        if row.number is None:
            self._last_number += 2  # two numbers: the run's own entry precedes that of the row
            row.number = self._last_number
        entry = WaitingEntry(row.number, row.kind, row.run.uuid if row.run else None, row.values)
        if row.run is None or row.run.uuid in described:
            return [entry]
        run = WaitingEntry(row.number - 1, "run", None, self._describe_run(row.run))
        return [run, entry]


def _weight(row: Row) -> int:
    """Return the approximate memory of a waiting row, in bytes: its texts and a constant."""
    values = row.values if isinstance(row.values, tuple) else row.values.values()
    return 200 + sum(len(value) for value in values if isinstance(value, str))
