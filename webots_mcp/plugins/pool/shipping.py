"""Shipping a recording to a pool: once, or on and on while a robot records.

What the pool holds is told by numbers that it stores in the same transaction as the rows. So a
shipper may be killed anywhere, and the next one goes on; nothing at the edge has to be remembered.
What changes is compared by digests, and sent again only where they differ.

No read transaction lasts while a pool is written to: the log of the database could not be cut back
meanwhile, and the robot's disk would fill up because a server is slow.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Final, NoReturn

from webots_mcp.database.connection import FrozenConnection
from webots_mcp.database.liveness import dead_sessions
from webots_mcp.errors import (
    DatabaseError,
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
    PoolBusyError,
    PoolError,
    PoolUnavailableError,
)
from webots_mcp.plugins.pool.pool_interface import (
    BATCH_BYTES,
    BATCH_ROWS,
    CHUNKS,
    Batch,
    Pool,
    PoolRow,
    Shipment,
    ShippedTable,
    fitted,
    is_whole,
    row_bytes,
    table,
    tables,
    whole_runs,
)
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.chunks import reached
from webots_mcp.store.merging import settled
from webots_mcp.store.recording import Recording, name_of
from webots_mcp.store.run_rows import MAX_FILE_BYTES, PICTURES, inside

THOROUGH_S: Final = 30.0  # between two looks at all of what may change, and not only the newest
CHUNK_ROWS: Final = 32
GROUPS_AT_ONCE: Final = 64
MOST_BATCHES: Final = 8  # of a table in a round, before the others get their turn
WRITE_BYTES: Final = 8_000_000
_FIRST_WAIT_S: Final = 1.0
_LONGEST_WAIT_S: Final = 60.0
_HANDOVER_S: Final = (0.02, 0.1, 0.3, 0.6)
_PAUSE_S: Final = 0.002  # between two short writes, for robots to write theirs
_UNCHECKED: Final = -1
# Of the progress: the last picture whose file was shipped, and the last state of a kept stretch.
_PICTURE: Final = "picture"
_STRETCH: Final = "kept_stretch/"
_SEQUENCE: Final = (
    "SELECT max((SELECT coalesce(max(id), 0) FROM {}), "
    "(SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = '{}'))"
)
_LAST: Final = "SELECT coalesce(max(id), 0) FROM {}"
# Up to the first that somebody is still making: its id is not looked at again later.
LAST_GROUP: Final = (
    "SELECT coalesce((SELECT min(id) - 1 FROM row_group WHERE is_complete = 0), "
    "(SELECT max(id) FROM row_group), 0)"
)
_NEXT_GROUPS: Final = "SELECT id FROM row_group WHERE id > ? AND id <= ? ORDER BY id LIMIT ?"
_IN_NO_CHUNK: Final = (
    "SELECT count(*) FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) AND id > ?"
)
_STRETCHES: Final = (
    "SELECT k.id, k.run_id, k.start_sim_time_s, k.end_sim_time_s, u.ended_wall_time_s IS NOT NULL "
    "FROM kept_stretch k JOIN run u ON u.id = k.run_id ORDER BY k.id"
)
# Of states: those that were shipped with a kept stretch, of which the numbers are given by its id.
_UNSENT: Final = (
    "id NOT IN (SELECT s.id FROM json_each(?) sent JOIN kept_stretch k ON k.id = sent.key "
    "JOIN state s ON s.run_id = k.run_id AND s.id > ? AND s.id <= sent.value "
    "AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s)"
)


@dataclass(frozen=True)
class ShippingJob:
    """What is to be shipped.

    Attributes:
        recording: From where.
        open_pool: Opens the pool to ship to it, each time that it is connected to.
        full: States as well.
        pictures: The files of pictures as well.
    """

    recording: Recording
    open_pool: Callable[[], Pool]
    full: bool = False
    pictures: bool = False


@dataclass
class ShippingReport:
    """What was shipped so far, and what was not.

    Attributes:
        rows: By table; a row that changed counts each time that it was sent.
        pictures: Files.
        lost: By table, rows that retention had deleted before they could be shipped.
        replaced: By column, values that the pool cannot hold, for which it has what comes nearest.
        lost_pictures: Files that were not there any more, or are no pictures of ours.
        foreign: By their UUIDs, runs that another recording had shipped before, with its UUID.
        notes: What else a person should know.
    """

    rows: Counter[str] = field(default_factory=Counter[str])
    pictures: int = 0
    lost: Counter[str] = field(default_factory=Counter[str])
    replaced: Counter[str] = field(default_factory=Counter[str])
    lost_pictures: int = 0
    foreign: dict[str, str] = field(default_factory=dict[str, str])
    notes: list[str] = field(default_factory=list[str])

    def note(self, text: str) -> None:
        """Remember it, once."""
        if text not in self.notes:
            self.notes.append(text)


def ship(order: ShippingJob, report: ShippingReport) -> None:
    """Ship all that is there, and end.

    Raises:
        PoolError: The pool cannot be reached or written, or another ships this recording.
        DatabaseError: The recording cannot be read.
    """
    with _shipper(order, report) as connected:
        while not connected.round(thorough=True):
            pass
        connected.note_states_in_no_chunk()


def follow(
    order: ShippingJob, report: ShippingReport, say: Callable[[str], None], pause_s: float
) -> NoReturn:
    """Ship what is there and what comes, until a KeyboardInterrupt.

    A pool that is away is tried again, each time after a longer wait; a recording that is not there
    yet is waited for.

    Args:
        order: What.
        report: Grows while it goes on.
        say: Told in a sentence when the pool is away, and when it is back.
        pause_s: Between two looks at the recording.

    Raises:
        PoolError: The pool will not be better by itself.
        DatabaseError: The recording cannot be read.
    """
    away_s, was_there, last_said = 0.0, False, ""
    while True:
        said, wait_s = "", 0.0
        try:
            with _shipper(order, report) as connected:
                if away_s:
                    say(f"the pool {connected.address} is there again")
                away_s, was_there, last_said = 0.0, True, ""
                _go_on(connected, pause_s)
        except RecordingReplacedError as error:
            say(f"{error}: that one is shipped from here on")
        except NoDatabaseError:
            there = f"nothing is recorded at {name_of(order.recording.database)} now"
            said, wait_s = f"{there}: it is shipped as soon as it is there", pause_s
        except PoolBusyError as error:
            if not was_there:
                raise
            # It may be our last connection, of which a server learns late.
            said, wait_s = f"{error}; waiting until it ends", _FIRST_WAIT_S
        except PoolUnavailableError as error:
            away_s = wait_s = min(max(2 * away_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)
            say(f"{error}; trying again in {away_s:g} s, nothing is lost meanwhile")
        if said and not last_said:
            say(said)
        last_said = said or last_said
        time.sleep(wait_s)


def _go_on(connected: Shipper, pause_s: float) -> NoReturn:
    next_s = 0.0
    while True:
        is_thorough = time.monotonic() >= next_s
        if is_thorough:
            next_s = time.monotonic() + THOROUGH_S
        if connected.round(thorough=is_thorough):
            time.sleep(pause_s)


@contextmanager
def _shipper(order: ShippingJob, report: ShippingReport) -> Generator[Shipper]:
    """Be connected to recording and pool, as the one who ships the recording.

    Raises:
        PoolError: The pool cannot be reached or written, or another ships this recording.
        DatabaseError: The recording cannot be read.
    """
    with order.recording.reader() as connection:
        uuid = ShippingSource(connection).uuid()  # first: nothing is asked of the pool in vain
    with order.open_pool() as pool, ExitStack() as stack:
        shipment = _entered(stack, pool, uuid)
        yield Shipper(order, report, uuid, pool.address, shipment)


def _entered(stack: ExitStack, pool: Pool, uuid: str) -> Shipment:
    """Wait a moment for a server that has not noticed yet that the shipper before was killed."""
    for wait_s in _HANDOVER_S:
        with suppress(PoolBusyError):
            return stack.enter_context(pool.shipment(uuid))
        time.sleep(wait_s)
    return stack.enter_context(pool.shipment(uuid))


class RecordingReplacedError(PoolError):
    """Another recording stands where the one was that is shipped."""


# -- reading ----------------------------------------------------------------------------------


class ShippingSource:
    """A recording as it is read to be shipped, and which of its runs are another's to ship.

    Args:
        connection: A reader.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        connection.text_factory = _text
        self.foreign = set[int]()
        self._foreign_sessions = set[int]()

    def uuid(self) -> str:
        """The recording's.

        Raises:
            DatabaseError: It has none, or several.
        """
        rows = self.connection.execute("SELECT uuid FROM recording LIMIT 2").fetchall()
        if len(rows) != 1 or not isinstance(rows[0][0], str) or not rows[0][0]:
            raise DatabaseError(
                f"the recording has {len(rows) or 'no'} UUIDs, by which a pool tells recordings "
                "apart: import it into a new one ('webots-mcp import FILE --data-dir NEW') and "
                "ship that"
            )
        return rows[0][0]

    def number(self, query: str, *values: object) -> int:
        """What a query counts."""
        return int(self.connection.execute(query, values).fetchone()[0])

    def runs(self) -> dict[int, str | None]:
        """The UUIDs of the runs; those that an old version has recorded have none."""
        return dict(self.connection.execute("SELECT id, uuid FROM run").fetchall())

    def ended_runs(self) -> set[int]:
        """The runs that are over."""
        query = "SELECT id FROM run WHERE ended_wall_time_s IS NOT NULL"
        return {run_id for (run_id,) in self.connection.execute(query)}

    def leave_out(self, runs: set[int]) -> None:
        """These runs are another's to ship, and sessions that have no others are as well."""
        self.foreign = runs
        query = "SELECT id, session_id FROM run"
        sessions = dict(self.connection.execute(query).fetchall() if runs else ())
        ours = {session for run_id, session in sessions.items() if run_id not in runs}
        self._foreign_sessions = set(sessions.values()) - ours

    def fingerprint(self, table: ShippedTable, row_id: int) -> int:
        """A number of that row's values; `_UNCHECKED` where retention has deleted it."""
        query = f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE id = ?"
        rows = self.connection.execute(query, (row_id,)).fetchall()
        return _digest(rows) if rows else _UNCHECKED

    def rows(self, table: ShippedTable, where: str, *values: object) -> list[PoolRow]:
        """The rows of a small part of a table that are ours to ship."""
        return self.connection.execute(self._query(table, where), values).fetchall()

    def piece(self, table: ShippedTable, where: str, *values: object) -> tuple[list[PoolRow], bool]:
        """Of such rows as many as a bounded size has, and whether they are all."""
        rows: list[PoolRow] = []
        size = 0
        with closing(self.connection.execute(self._query(table, where), values)) as cursor:
            for row in cursor:
                rows.append(row)
                size += row_bytes(row)
                if size >= BATCH_BYTES or len(rows) >= BATCH_ROWS:
                    return rows, False
        return rows, True

    def _query(self, table: ShippedTable, where: str) -> str:
        """Without what belongs to runs and sessions of another; what outlasts them names none."""
        columns, conditions = [*table.columns], [where]
        others = {table.run_column: self.foreign, table.session_column: self._foreign_sessions}
        for column, foreign in others.items():
            if column is not None and foreign:
                listed = f"({', '.join(map(str, foreign))})"
                if table.outlasts_runs:
                    at = columns.index(column)
                    columns[at] = f"CASE WHEN {column} NOT IN {listed} THEN {column} END"
                else:
                    conditions.append(f"coalesce({column}, 0) NOT IN {listed}")
        order = f" ORDER BY {', '.join(table.key)}"
        return (
            f"SELECT {', '.join(columns)} FROM {table.name} WHERE {' AND '.join(conditions)}{order}"
        )


def _text(stored: bytes) -> str:
    """Bytes that are no UTF-8, which another program has written, are read as what comes near."""
    return stored.decode("utf-8", "replace")


def _digest(rows: Sequence[PoolRow]) -> int:
    """A number that other rows have with a chance of one in 2**63."""
    text = repr([tuple(row) for row in rows]).encode("utf-8", "surrogatepass")
    return int.from_bytes(blake2b(text, digest_size=8).digest(), "big") >> 1


# -- sending ----------------------------------------------------------------------------------


class Shipper:
    """One connection to a pool, as long as it lasts.

    Attributes:
        address: The pool's URL without secrets.
    """

    def __init__(
        self,
        order: ShippingJob,
        report: ShippingReport,
        uuid: str,
        address: str,
        shipment: Shipment,
    ) -> None:
        self.address = address
        self._order, self._report, self._uuid, self._shipment = order, report, uuid, shipment
        self._progress = shipment.progress()
        self._owners = dict[str, str | None]()
        self._is_checked = False
        self._last_ids = dict[str, int]()  # up to where what the rows refer to was read
        self._batches = list[Batch]()  # what waits to be written together,
        self._numbers = dict[str, int]()  # and the progress that it makes
        self._size = 0

    def round(self, *, thorough: bool) -> bool:
        """Ship what is new.

        Args:
            thorough: Look at all rows that may have changed, and not only at the newest.

        Returns:
            Whether the pool holds all that was there when the round began.
        """
        with self._order.recording.reader() as connection:
            source = ShippingSource(connection)
            self._require_the_same(source)
            is_frozen = isinstance(connection, FrozenConnection)
            if thorough:
                self._end_what_was_killed(connection)
            if thorough and not is_frozen:
                self._make_chunks(source)
            ended = self._ship_changing(source, thorough=thorough)
            is_complete = self._ship_groups(source)
            for each in self._appended() if is_complete else ():
                is_complete &= self._ship_appended(source, each)
            if is_complete and not self._order.full:
                self._ship_kept(source, thorough=thorough)
            if self._order.pictures:
                self._ship_pictures(source)
            if is_complete and thorough:  # else some of what may change was not looked at
                whole = whole_runs(ended - source.foreign).items()
                self._put(None, {name: n | self._progress.get(name, 0) for name, n in whole})
            self._send()
        return is_complete

    def note_states_in_no_chunk(self) -> None:
        """Say how many states are neither shipped nor in chunks."""
        with self._order.recording.reader() as connection:
            source = ShippingSource(connection)
            self._knows_owners(source)
            behind, shipped = 0, self._progress.get("state", 0)  # at full rate
            for run_id in source.runs().keys() - source.foreign:
                at = reached(connection, run_id)
                place = (run_id, at.end_s, at.last_state_id, shipped)
                behind += source.number(_IN_NO_CHUNK, *place)
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

    def _make_chunks(self, source: ShippingSource) -> None:
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

    def _appended(self) -> list[ShippedTable]:
        """States last: others should not wait for the largest table."""
        wanted = [each for each in tables() if each.is_appended and each.name not in CHUNKS]
        others = [each for each in wanted if each.name != "state"]
        return [*others, table("state")] if self._order.full else others

    def _require_the_same(self, source: ShippingSource) -> None:
        """That the recording is the one of before, and not an older copy of it.

        Raises:
            PoolError: It is not.
        """
        if (uuid := source.uuid()) != self._uuid:
            raise RecordingReplacedError(f"the recording {uuid} stands now where {self._uuid} was")
        if self._is_checked:
            return
        for each in (table("run"), table("row_group"), *self._appended()):
            known = self._progress.get(each.name, 0)
            before = self._progress.get(f"{each.name}.check", _UNCHECKED)
            now = source.fingerprint(each, known)
            is_other = before != now and _UNCHECKED not in (before, now)
            if source.number(_SEQUENCE.format(each.name, each.name)) < known or is_other:
                raise PoolError(
                    f"the recording {self._uuid} is not the one that was shipped to {self.address} "
                    f"before: its table {each.name!r} is not the same up to row {known}. It is an "
                    "older copy, or one that was gone on with elsewhere: ship the newest one, or "
                    "import this one into a new recording ('webots-mcp import FILE --data-dir "
                    "NEW') and ship that"
                )
        self._is_checked = True

    def _ship_changing(self, source: ShippingSource, *, thorough: bool) -> set[int]:
        """Ship what differs in tables that change; the runs that were over then."""
        while True:
            with _one_moment(source.connection):
                is_all = self._knows_owners(source)
                for each in tables() if is_all else ():
                    if each.is_appended:
                        self._last_ids[each.name] = source.number(_LAST.format(each.name))
                    else:
                        is_all = is_all and self._compare(source, each, thorough=thorough)
                if is_all:
                    self._last_ids["row_group"] = source.number(LAST_GROUP)
                    return source.ended_runs()
            self._ask_for_owners(source)
            self._send()

    def _knows_owners(self, source: ShippingSource) -> bool:
        """Whether the pool was asked whose the runs are; those of others are left out then."""
        runs = {run_id: uuid for run_id, uuid in source.runs().items() if uuid}
        source.leave_out({run_id for run_id, uuid in runs.items() if self._owners.get(uuid)})
        return self._owners.keys() >= set(runs.values())

    def _ask_for_owners(self, source: ShippingSource) -> None:
        new = {uuid for uuid in source.runs().values() if uuid} - self._owners.keys()
        found = self._shipment.foreign_runs(new) if new else {}
        self._owners |= {uuid: found.get(uuid) for uuid in new}
        self._report.foreign |= found

    def _compare(self, source: ShippingSource, each: ShippedTable, *, thorough: bool) -> bool:
        """Take the rows whose digest differs from the pool's; False where they are too many.

        Rows are compared so many at a time, by their ids; all of a table that has none.
        """
        last = self._progress.get(each.name, 0)
        parts, where = range(1), "? = ?"
        if each.key == ("id",):
            newest = source.number(_LAST.format(each.name))
            parts = range((0 if thorough else last) // CHUNK_ROWS, newest // CHUNK_ROWS + 1)
            where = "id >= ? AND id < ?"
        for part in parts:
            bounds = (part * CHUNK_ROWS, (part + 1) * CHUNK_ROWS) if each.key == ("id",) else (0, 0)
            rows = source.rows(each, where, *bounds)
            name, value = f"{each.name}:{part}", _digest(rows)
            if rows and self._progress.get(name) != value:
                if self._size >= WRITE_BYTES:
                    return False
                last = max([last, *(row[0] for row in rows if isinstance(row[0], int))])
                self._add(Batch(each, rows), {name: value, each.name: last})
        return True

    def _ship_groups(self, source: ShippingSource) -> bool:
        """Ship the next row groups, each with its chunks at once; whether these were all."""
        groups, chunks = table("row_group"), table("chunk")
        bounds = (self._progress.get(groups.name, 0), self._last_ids[groups.name])
        found = source.connection.execute(_NEXT_GROUPS, (*bounds, GROUPS_AT_ONCE)).fetchall()
        ids = [group_id for (group_id,) in found]
        for group_id in ids:
            self._add(Batch(chunks, source.rows(chunks, "group_id = ?", group_id)), {})
            group = Batch(groups, source.rows(groups, "id = ?", group_id))
            self._put(group, self._reached(source, groups, group_id))
        return len(ids) < GROUPS_AT_ONCE

    def _ship_appended(self, source: ShippingSource, each: ShippedTable) -> bool:
        """Ship the next rows; returns whether these were all."""
        after, upto = self._progress.get(each.name, 0), self._last_ids[each.name]
        for _ in range(MOST_BATCHES):
            if after >= upto:
                return True
            count = f"SELECT count(*) FROM {each.name} WHERE id > ? AND id <= ?"
            with _one_moment(source.connection):
                rows, last = self._next(source, each, after, upto)
                found = source.number(count, after, last)
            if lost := last - after - found:
                self._report.lost[each.name] += lost
            self._put(Batch(each, rows), self._reached(source, each, last))
            after = last
        return after >= upto

    def _next(
        self, source: ShippingSource, each: ShippedTable, after: int, upto: int
    ) -> tuple[list[PoolRow], int]:
        """The next rows, and the last id that was looked at."""
        where, values = "id > ? AND id <= ?", (after, upto)
        if each.name == "state":
            where, values = f"{where} AND {_UNSENT}", (*values, self._sent_stretches(), after)
        rows, is_all = source.piece(each, where, *values)
        return rows, upto if is_all else int(str(rows[-1][0]))

    def _sent_stretches(self) -> str:
        """By the ids of kept stretches, up to which state they were shipped, as JSON."""
        names = [name for name in self._progress if name.startswith(_STRETCH)]
        return json.dumps({name.removeprefix(_STRETCH): self._progress[name] for name in names})

    def _ship_kept(self, source: ShippingSource, *, thorough: bool) -> None:
        """Ship the states of kept stretches, where not all states are shipped."""
        where = "run_id = ? AND sim_time_s BETWEEN ? AND ? AND id > ? AND id <= ?"
        states, upto = table("state"), self._last_ids["state"]
        for stretch_id, *bounds, is_over in source.connection.execute(_STRETCHES).fetchall():
            name, is_all = f"{_STRETCH}{stretch_id}", False
            if name in self._progress and is_over and not thorough:
                continue
            while not is_all:
                after = max(self._progress.get(name, 0), self._progress.get("state", 0))
                values = (*bounds, after, upto, self._sent_stretches(), after)
                rows, is_all = source.piece(states, f"{where} AND {_UNSENT}", *values)
                if rows:
                    self._put(Batch(states, rows), {name: int(str(rows[-1][0]))})

    def _reached(self, source: ShippingSource, each: ShippedTable, last: int) -> dict[str, int]:
        """The progress up to a row, with a number by which it is known again."""
        return {each.name: last, f"{each.name}.check": source.fingerprint(each, last)}

    def _ship_pictures(self, source: ShippingSource) -> None:
        """Ship the files of the pictures whose rows are shipped."""
        images = table("image")
        upto, path_at = self._progress.get(images.name, 0), images.columns.index("path")
        while (after := self._progress.get(_PICTURE, 0)) < upto:
            rows, is_all = source.piece(images, "id > ? AND id <= ?", after, upto)
            size, last = 0, upto if is_all else int(str(rows[-1][0]))
            for row in rows:
                size += self._ship_picture(str(row[path_at]))
                if size >= WRITE_BYTES:
                    last = int(str(row[0]))
                    break
            self._add(None, {_PICTURE: last})
            self._send()

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

    def _put(self, batch: Batch | None, numbers: Mapping[str, int]) -> None:
        """Send it with others, when they have come to a size."""
        self._add(batch, numbers)
        if self._size >= WRITE_BYTES:
            self._send()

    def _add(self, batch: Batch | None, numbers: Mapping[str, int]) -> None:
        """Rows, and the numbers that hold once they are written."""
        if batch is not None and batch.rows:
            self._batches.append(fitted(batch, self._report.replaced))
            self._size += sum(map(row_bytes, batch.rows))
        changed = {n: value for n, value in numbers.items() if self._progress.get(n) != value}
        self._numbers |= changed
        self._progress |= changed

    def _send(self) -> None:
        """Write it all, in one transaction of the pool's."""
        if not self._batches and not self._numbers:
            return
        self._report.replaced.update(self._shipment.write(self._batches, self._numbers))
        for batch in self._batches:
            self._report.rows[batch.table.name] += len(batch.rows)
        self._batches, self._numbers, self._size = [], {}, 0


@contextmanager
def _one_moment(connection: sqlite3.Connection) -> Generator[None]:
    """Inside the block, all is read from one state of the database."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        connection.execute("COMMIT")
