"""Shipping a recording to a pool, as long as both are there; `following` goes on and on.

What the pool holds is told by numbers that it stores in the same transaction as the rows. So a
shipper may be killed anywhere, and the next one goes on; nothing at the edge has to be remembered.
What changes is compared by digests, and sent again only where they differ.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from webots_mcp.connection import FrozenConnection
from webots_mcp.errors import (
    DatabaseError,
    InvalidInputError,
    NothingRecordedError,
    PoolBusyError,
    PoolError,
)
from webots_mcp.liveness import dead_sessions
from webots_mcp.plugins.pool.outbox import WRITE_BYTES, Outbox
from webots_mcp.plugins.pool.reading import GROUPS_AT_ONCE, Source, digest
from webots_mcp.plugins.pool.report import Report
from webots_mcp.plugins.pool.row_batch import Batch
from webots_mcp.plugins.pool.shipped_tables import CHUNKS, SQLValue, Table, table, tables
from webots_mcp.plugins.pool.target import Shipment, Target, is_whole, whole_runs
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.merging import settled
from webots_mcp.store.recording import Recording
from webots_mcp.store.retention_plan import Shipped, read_shipped, write_shipped
from webots_mcp.store.run_rows import MAX_FILE_BYTES, PICTURES, inside

MOST_BATCHES: Final = 8  # of a table in a round, before the others get their turn
_HANDOVER_S: Final = (0.02, 0.1, 0.3, 0.6)
_UNCHECKED: Final = -1
_PAUSE_S: Final = 0.002  # between two short writes, for robots to write theirs
# Of the progress: the last picture whose file was shipped, and the last state of a kept stretch.
_PICTURE: Final = "picture"
_STRETCH: Final = "kept_stretch/{}"


@dataclass(frozen=True)
class Order:
    """What is to be shipped.

    Attributes:
        recording: From where.
        open_target: Opens the pool, each time that it is connected to.
        full: States as well.
        pictures: The files of pictures as well.
    """

    recording: Recording
    open_target: Callable[[], Target]
    full: bool = False
    pictures: bool = False


def ship(order: Order, report: Report) -> None:
    """Ship all that is there, and end.

    Raises:
        PoolError: The pool cannot be reached or written, or another ships this recording.
        DatabaseError: The recording cannot be read.
    """
    with shipper(order, report) as connected:
        while not connected.round(thorough=True):
            pass
        connected.note_states_in_no_chunk()


@contextmanager
def shipper(order: Order, report: Report) -> Generator[Shipper]:
    """Be connected to recording and pool, as the one who ships the recording.

    Raises:
        PoolError: The pool cannot be reached or written, or another ships this recording.
        DatabaseError: The recording cannot be read.
    """
    with order.recording.reader() as connection:
        uuid = Source(connection).uuid()  # first: nothing is asked of the pool in vain
    with order.open_target() as target, ExitStack() as stack:
        target.prepare()
        shipment = _enter(stack, target, uuid)
        yield Shipper(order, report, uuid, target, shipment)


def _enter(stack: ExitStack, target: Target, uuid: str) -> Shipment:
    """Wait a moment for a server that has not noticed yet that the shipper before was killed."""
    for wait_s in _HANDOVER_S:
        with suppress(PoolBusyError):
            return stack.enter_context(target.shipment(uuid))
        time.sleep(wait_s)
    return stack.enter_context(target.shipment(uuid))


class ReplacedError(PoolError):
    """Another recording stands where the one was that is shipped."""


class Shipper:
    """One connection to a pool, as long as it lasts.

    Attributes:
        address: The pool's URL without secrets.
    """

    def __init__(
        self, order: Order, report: Report, uuid: str, target: Target, shipment: Shipment
    ) -> None:
        self._order = order
        self._report = report
        self._uuid = uuid
        self._shipment = shipment
        self._outbox = Outbox(shipment, report, shipment.progress())
        self._progress = self._outbox.progress
        self._owners = dict[str, str | None]()
        self._is_checked = False
        self._last_ids = dict[str, int]()
        self._ended = set[int]()
        self.address = target.address

    def round(self, *, thorough: bool) -> bool:
        """Ship what is new.

        Args:
            thorough: Look at all rows that may have changed, and not only at the newest.

        Returns:
            Whether the pool holds all that was there when the round began.
        """
        started_s = time.time()
        with self._order.recording.reader() as connection:
            source = Source(connection)
            self._require_the_same(source)
            is_frozen = isinstance(connection, FrozenConnection)
            if thorough:
                self._end_what_was_killed(connection)
            if thorough and not is_frozen:
                self._make_chunks(source)
            self._ship_changing(source, thorough=thorough)
            is_complete = self._ship_groups(source) and self._ship_all_appended(source)
            if is_complete and not self._order.full:
                self._ship_kept(source, thorough=thorough)
            if self._order.pictures:
                self._ship_pictures(source)
            is_whole = is_complete and thorough  # else some of what may change was not looked at
            if is_whole:
                self._tell_whole(source)
            self._outbox.send()
        if not is_frozen:
            self._leave_word(started_s, is_complete=is_whole)
        return is_complete

    def note_states_in_no_chunk(self) -> None:
        """Say how many states are neither shipped nor in chunks."""
        with self._order.recording.reader() as connection:
            source = Source(connection)
            self._knows_owners(source)
            behind = source.in_no_chunk(self._progress.get("state", 0))  # at full rate
        if behind:
            mend = "ship again when their run has ended, or with --full"
            if isinstance(connection, FrozenConnection):
                mend = (
                    "none can be made where the file cannot be written: ship a copy, or with --full"
                )
            self._report.note(
                f"{behind} states are in no chunk yet, and so not in the pool: {mend}"
            )

    def _end_what_was_killed(self, connection: sqlite3.Connection) -> None:
        """End runs whose process is gone, at the edge: nobody at the pool could judge that."""
        database = self._order.recording.database
        if not isinstance(database, Path) or not dead_sessions(connection):
            return
        try:
            settled(database)
        except DatabaseError as error:
            self._report.note(f"runs whose process was killed stay open in the pool: {error}")

    def _make_chunks(self, source: Source) -> None:
        """Put states into chunks, at the edge; all of those of runs that are over."""
        database = self._order.recording.database
        if not isinstance(database, Path):
            return
        ended = [each for each in source.ended_runs() if not is_whole(self._progress, each)]
        try:
            with Recording(database, database.parent).writer() as connection:
                while not make_chunks(connection, pause_s=_PAUSE_S).done:
                    pass
                for run_id in ended:
                    chunk_whole_run(connection, run_id, _PAUSE_S)
        except (DatabaseError, sqlite3.Error) as error:
            self._report.note(f"not all states are in chunks, which alone are shipped: {error}")

    def _appended(self) -> list[Table]:
        """States last: others should not wait for the largest table."""
        wanted = [each for each in tables() if each.is_appended and each.name not in CHUNKS]
        others = [each for each in wanted if each.name != "state"]
        return [*others, table("state")] if self._order.full else others

    def _require_the_same(self, source: Source) -> None:
        """That the recording is the one of before, and not an older copy of it.

        Raises:
            PoolError: It is not.
        """
        if (uuid := source.uuid()) != self._uuid:
            raise ReplacedError(f"the recording {uuid} stands now where {self._uuid} was")
        if self._is_checked:
            return
        for each in (table("run"), table("row_group"), *self._appended()):
            known = self._progress.get(each.name, 0)
            if source.sequence(each) < known or self._is_other(source, each, known):
                raise PoolError(
                    f"the recording {self._uuid} is not the one that was shipped to {self.address} "
                    f"before: its table {each.name!r} is not the same up to row {known}. It is an "
                    "older copy, or one that was gone on with elsewhere: ship the newest one, or "
                    "import this one into a new recording ('webots-mcp import FILE --data-dir "
                    "NEW') and ship that"
                )
        self._is_checked = True

    def _is_other(self, source: Source, each: Table, known: int) -> bool:
        check = self._progress.get(f"{each.name}.check", _UNCHECKED)
        row = source.row(each, known) if check != _UNCHECKED else None
        return row is not None and digest([row]) != check

    def _ship_changing(self, source: Source, *, thorough: bool) -> None:
        """Ship what differs in tables that change.

        What the rows of the others refer to is at the pool then, up to where they were read: to
        `_last_ids`.
        """

        def read() -> bool:
            if not self._knows_owners(source):
                return False
            for each in tables():
                if each.is_appended:
                    self._last_ids[each.name] = source.last_id(each)
                elif not self._compare(source, each, thorough=thorough):
                    return False
            self._last_ids["row_group"] = source.last_group()
            self._ended = source.ended_runs()
            return True

        while not source.in_one_moment(read):
            self._ask_for_owners(source)
            self._outbox.send()

    def _knows_owners(self, source: Source) -> bool:
        """Whether the pool was asked whose the runs are; those of others are left out then."""
        runs = {run_id: uuid for run_id, uuid in source.runs().items() if uuid}
        if not self._owners.keys() >= set(runs.values()):
            return False
        source.leave_out({run_id for run_id, uuid in runs.items() if self._owners[uuid]})
        return True

    def _ask_for_owners(self, source: Source) -> None:
        new = {uuid for uuid in source.runs().values() if uuid} - self._owners.keys()
        found = self._shipment.foreign_runs(new) if new else {}
        self._owners |= {uuid: found.get(uuid) for uuid in new}
        self._report.foreign |= found

    def _compare(self, source: Source, each: Table, *, thorough: bool) -> bool:
        """Take the chunks whose digests differ from the pool's; False where they are too many."""
        last = self._progress.get(each.name, 0)
        for number in source.chunks(each, 0 if thorough else last):
            rows = source.chunk(each, number)
            name, value = f"{each.name}:{number}", digest(rows)
            if rows and self._progress.get(name) != value:
                if self._outbox.is_full:
                    return False
                ids = [row[0] for row in rows if isinstance(row[0], int)]
                self._outbox.add(Batch(each, rows), {name: value, each.name: max([last, *ids])})
                last = self._progress[each.name]
        return True

    def _ship_groups(self, source: Source) -> bool:
        """Ship the next row groups, each with its chunks at once; whether these were all."""
        after, upto, count = self._progress.get("row_group", 0), self._last_ids["row_group"], 0
        for group_id, (group, chunks) in source.groups(after, upto):
            self._outbox.add(chunks, {})
            self._put(group, _told_of(group, group_id))
            count += 1
        return count < GROUPS_AT_ONCE

    def _ship_all_appended(self, source: Source) -> bool:
        """Ship the next rows of the appended tables; returns whether these were all."""
        are_all = [self._ship_appended(source, each) for each in self._appended()]
        return all(are_all)

    def _ship_appended(self, source: Source, each: Table) -> bool:
        """Ship the next rows; returns whether these were all."""
        after, upto = self._progress.get(each.name, 0), self._last_ids[each.name]
        for _ in range(MOST_BATCHES):
            if after >= upto:
                return True
            batch, last, found = source.appended(each, after, upto)
            told = _told_of(batch, last)
            lost = last - after - found
            if lost:
                self._report.lost[each.name] += lost
            self._put(self._unsent(source, batch), told)
            after = last
        return after >= upto

    def _ship_kept(self, source: Source, *, thorough: bool) -> None:
        """Ship the states of kept stretches, where not all states are shipped."""
        for stretch in source.stretches():
            name = _STRETCH.format(stretch.id)
            after, is_all = self._progress.get(name, 0), False
            if name in self._progress and stretch.is_over and not thorough:
                continue
            while not is_all:
                batch, is_all = source.kept(stretch, after, self._last_ids["state"])
                if batch.rows:
                    after = int(str(batch.rows[-1][0]))
                    self._put(self._unsent(source, batch), {name: after})

    def _unsent(self, source: Source, batch: Batch) -> Batch:
        """Without the states that were shipped before, with all others or with a kept stretch."""
        if batch.table.name != "state":
            return batch
        last = self._progress.get("state", 0)
        known = [(each, self._progress.get(_STRETCH.format(each.id), 0)) for each in
                 source.stretches()]  # fmt: skip

        def is_sent(row_id: int, run_id: SQLValue, sim_time_s: SQLValue) -> bool:
            return row_id <= last or any(
                row_id <= upto and each.holds(run_id, sim_time_s) for each, upto in known
            )

        rows = [row for row in batch.rows if not is_sent(int(str(row[0])), row[1], row[2])]
        return Batch(batch.table, rows)

    def _ship_pictures(self, source: Source) -> None:
        """Ship the files of the pictures whose rows are shipped."""
        upto = self._progress.get("image", 0)
        while some := source.pictures(self._progress.get(_PICTURE, 0), upto):
            size = 0
            for image_id, run_id, path in some:
                if run_id not in source.foreign:
                    size += self._ship_picture(path)
                self._outbox.add(None, {_PICTURE: image_id})
                if size >= WRITE_BYTES:
                    break
            self._outbox.send()

    def _ship_picture(self, path: str) -> int:
        """Returns how many bytes it has."""
        try:
            file = inside(self._order.recording.data_dir, path)
            if file.suffix.lower() not in PICTURES or file.stat().st_size > MAX_FILE_BYTES:
                raise InvalidInputError(f"{path!r} is no picture")
            content = file.read_bytes()
        except (InvalidInputError, NothingRecordedError, OSError):
            self._report.lost_pictures += 1
            return 0
        self._shipment.write_picture(path, content)
        self._report.pictures += 1
        return len(content)

    def _tell_whole(self, source: Source) -> None:
        """Say that all of the runs is there that were over when the round began."""
        told = whole_runs(self._ended - source.foreign).items()
        told = {name: mask | self._progress.get(name, 0) for name, mask in told}
        self._outbox.add(None, dict(told.items() - self._progress.items()))

    def _put(self, batch: Batch | None, told: Mapping[str, int]) -> None:
        """Send it with others, when they have come to a size."""
        self._outbox.add(batch, told)
        if self._outbox.is_full:
            self._outbox.send()

    def _leave_word(self, started_s: float, *, is_complete: bool) -> None:
        """Tell retention, by a file beside the database."""
        database = self._order.recording.database
        assert isinstance(database, Path)
        before = read_shipped(database, self._uuid).get(self.address)
        complete_s = before.complete_wall_time_s if before else 0.0
        shipped_tables = (table("row_group"), *self._appended())
        last_ids = {each.name: self._progress.get(each.name, 0) for each in shipped_tables}
        shipped = Shipped(
            self._uuid, last_ids, started_s if is_complete else complete_s, time.time()
        )
        try:
            write_shipped(database, self.address, shipped)
        except OSError as error:
            self._report.note(f"retention cannot learn here what is shipped: {error}")


def _told_of(batch: Batch, last: int) -> dict[str, int]:
    """The progress that these rows make, with a digest of the last one."""
    name = batch.table.name
    newest = batch.rows[-1] if batch.rows and batch.rows[-1][0] == last else None
    return {name: last, f"{name}.check": digest([newest]) if newest else _UNCHECKED}
