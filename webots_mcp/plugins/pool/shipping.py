"""Shipping a recording to a pool, as long as both are there; `following` goes on and on.

What the pool holds is told by numbers that it stores in the same transaction as the rows. So a
shipper may be killed anywhere, and the next one goes on; nothing at the edge has to be remembered.
What changes is compared by digests, and sent again only where they differ.
"""

from __future__ import annotations

import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

from webots_mcp.connection import FrozenConnection
from webots_mcp.contract import Database
from webots_mcp.errors import (
    DatabaseError,
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
    PoolBusyError,
    PoolError,
    PoolUnavailableError,
)
from webots_mcp.liveness import dead_sessions
from webots_mcp.plugins.pool.pool_interface import (
    BATCH_BYTES,
    BATCH_ROWS,
    CHUNKS,
    Batch,
    Row,
    Shipment,
    SQLValue,
    Table,
    Target,
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


# A recording as it is shipped: read in short transactions, a bounded piece at a time.
#
# No read transaction lasts while a pool is written to: the log of the database could not be cut
# back meanwhile, and the robot's disk would fill up because a server is slow.


CHUNK_ROWS: Final = 32
GROUPS_AT_ONCE: Final = 64
_UUID: Final = "SELECT uuid FROM recording LIMIT 2"
_RUNS: Final = "SELECT id, uuid FROM run"
_SESSIONS: Final = "SELECT id, session_id FROM run"
_ENDED: Final = "SELECT id FROM run WHERE ended_wall_time_s IS NOT NULL"
_SEQUENCE: Final = "SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = ?"
_LAST: Final = "SELECT coalesce(max(id), 0) FROM {table}"
# Up to the first that somebody is still making: its id is not looked at again later.
_COMPLETE: Final = (
    "SELECT coalesce((SELECT min(id) - 1 FROM row_group WHERE is_complete = 0), "
    "(SELECT max(id) FROM row_group), 0)"
)
_IN_NO_CHUNK: Final = (
    "SELECT count(*) FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) AND id > ?"
)
_STRETCHES: Final = (
    "SELECT k.id, k.run_id, k.start_sim_time_s, k.end_sim_time_s, u.ended_wall_time_s IS NOT NULL "
    "FROM kept_stretch k JOIN run u ON u.id = k.run_id ORDER BY k.id"
)
_IN_STRETCH: Final = (
    "SELECT {columns} FROM state WHERE run_id = ? AND sim_time_s BETWEEN ? AND ? "
    "AND id > ? AND id <= ? ORDER BY id"
)
_PICTURES: Final = (
    "SELECT id, run_id, path FROM image WHERE id > ? AND id <= ? ORDER BY id LIMIT 100"
)


class Stretch(NamedTuple):
    """Seconds that are kept at full rate; `is_over` where their run has ended."""

    id: int
    run_id: int
    start_sim_time_s: float
    end_sim_time_s: float
    is_over: bool

    def holds(self, run_id: SQLValue, sim_time_s: SQLValue) -> bool:
        """Whether a state is one of them."""
        is_time = isinstance(sim_time_s, int | float)
        return (
            is_time
            and run_id == self.run_id
            and (self.start_sim_time_s <= sim_time_s <= self.end_sim_time_s)
        )


class Source:
    """A connection to a recording, and which of its runs are another's to ship.

    Args:
        connection: A reader.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        connection.text_factory = _text
        self.foreign = set[int]()
        self._foreign_sessions = set[int]()

    def uuid(self) -> str:
        """The recording's.

        Raises:
            DatabaseError: It has none, or several.
        """
        rows = self._connection.execute(_UUID).fetchall()
        if len(rows) != 1 or not isinstance(rows[0][0], str) or not rows[0][0]:
            raise DatabaseError(
                f"the recording has {len(rows) or 'no'} UUIDs, by which a pool tells recordings "
                "apart: import it into a new one ('webots-mcp import FILE --data-dir NEW') and "
                "ship that"
            )
        return rows[0][0]

    def runs(self) -> dict[int, str | None]:
        """The UUIDs of the runs; those that an old version has recorded have none."""
        return dict(self._connection.execute(_RUNS).fetchall())

    def leave_out(self, runs: set[int]) -> None:
        """These runs are another's to ship, and sessions that have no others are as well."""
        self.foreign = runs
        sessions = dict(self._connection.execute(_SESSIONS).fetchall() if runs else ())
        ours = {session for run_id, session in sessions.items() if run_id not in runs}
        self._foreign_sessions = set(sessions.values()) - ours

    def ended_runs(self) -> set[int]:
        """The runs that are over."""
        return {run_id for (run_id,) in self._connection.execute(_ENDED)}

    def sequence(self, table: Table) -> int:
        """The largest id that a row of the table ever had."""
        last = self._first(_LAST.format(table=table.name))
        return max(last, self._first(_SEQUENCE, table.name))

    def in_one_moment(self, read: Callable[[], bool]) -> bool:
        """Read several things from one state of the database."""
        self._connection.execute("BEGIN")
        try:
            return read()
        finally:
            self._connection.execute("COMMIT")

    def last_id(self, table: Table) -> int:
        """The largest id in the table now; 0 where it is empty."""
        return self._first(_LAST.format(table=table.name))

    def row(self, table: Table, row_id: int) -> Row | None:
        """One row of an appended table; None where retention has deleted it."""
        query = f"SELECT {', '.join(table.columns)} FROM {table.name} WHERE id = ?"
        return self._connection.execute(query, (row_id,)).fetchone()

    def appended(self, table: Table, after: int, upto: int) -> tuple[Batch, int, int]:
        """The next rows of an appended table.

        Returns:
            Those that are ours to ship; the last id that was looked at; how many rows were there.
        """
        query = (
            f"SELECT {', '.join(table.columns)} FROM {table.name} "
            "WHERE id > ? AND id <= ? ORDER BY id"
        )
        rows, is_all = self._some(query, (after, upto))
        last = upto if is_all else int(str(rows[-1][0]))
        return Batch(table, self.ours(table, rows)), last, len(rows)

    def chunk(self, table: Table, number: int) -> list[Row]:
        """The rows of a changing table whose ids lie in that chunk; all where it has no ids."""
        columns = ", ".join(table.columns)
        if table.key != ("id",):
            rows = self._connection.execute(f"SELECT {columns} FROM {table.name}").fetchall()
        else:
            query = f"SELECT {columns} FROM {table.name} WHERE id >= ? AND id < ? ORDER BY id"
            bounds = (number * CHUNK_ROWS, (number + 1) * CHUNK_ROWS)
            rows = self._connection.execute(query, bounds).fetchall()
        return self.ours(table, rows)

    def chunks(self, table: Table, since: int) -> range:
        """The numbers of the chunks from the one that holds that id on."""
        if table.key != ("id",):
            return range(1)
        return range(since // CHUNK_ROWS, self.last_id(table) // CHUNK_ROWS + 1)

    def last_group(self) -> int:
        """The id of the last row group up to which all are complete."""
        return self._first(_COMPLETE)

    def groups(self, after: int, upto: int) -> Iterator[tuple[int, list[Batch]]]:
        """The next row groups by their ids, each with its chunks; nothing of another's runs."""
        groups, chunks = table("row_group"), table("chunk")
        query = f"SELECT {', '.join(groups.columns)} FROM row_group WHERE id > ? AND id <= ?"
        of_group = f"SELECT {', '.join(chunks.columns)} FROM chunk WHERE group_id = ? ORDER BY id"
        found = self._connection.execute(
            f"{query} ORDER BY id LIMIT ?", (after, upto, GROUPS_AT_ONCE)
        )
        for group in found.fetchall():
            rows = self._connection.execute(of_group, group[:1]).fetchall()
            both = (groups, self.ours(groups, [group])), (chunks, self.ours(chunks, rows))
            yield int(group[0]), [Batch(*each) for each in both]

    def in_no_chunk(self, shipped: int) -> int:
        """How many states after that one are in no row group, of the runs that are ours to ship."""
        found = 0
        for run_id in self.runs().keys() - self.foreign:
            at = reached(self._connection, run_id)
            found += self._first(_IN_NO_CHUNK, run_id, at.end_s, at.last_state_id, shipped)
        return found

    def stretches(self) -> list[Stretch]:
        """Kept stretches of the runs that are ours to ship."""
        found = map(Stretch._make, self._connection.execute(_STRETCHES).fetchall())
        return [stretch for stretch in found if stretch.run_id not in self.foreign]

    def kept(self, stretch: Stretch, after: int, upto: int) -> tuple[Batch, bool]:
        """The next states of a kept stretch, and whether they are all."""
        states = table("state")
        query = _IN_STRETCH.format(columns=", ".join(states.columns))
        bounds = (stretch.start_sim_time_s, stretch.end_sim_time_s)
        rows, is_all = self._some(query, (stretch.run_id, *bounds, after, upto))
        return Batch(states, rows), is_all

    def pictures(self, after: int, upto: int) -> list[tuple[int, int, str]]:
        """The next pictures: their ids, runs and paths."""
        return self._connection.execute(_PICTURES, (after, upto)).fetchall()

    def ours(self, table: Table, rows: Sequence[Row]) -> list[Row]:
        """Without what belongs to runs and sessions of another recording, or refers to them."""
        rows = _without(table, rows, table.run_column, self.foreign)
        return _without(table, rows, table.session_column, self._foreign_sessions)

    def _some(self, query: str, values: tuple[Any, ...]) -> tuple[list[Row], bool]:
        """Rows up to a bounded size, and whether they are all; the transaction is over then."""
        rows: list[Row] = []
        size = 0
        cursor = self._connection.execute(query, values)
        try:
            for row in cursor:
                rows.append(row)
                size += row_bytes(row)
                if size >= BATCH_BYTES or len(rows) >= BATCH_ROWS:
                    return rows, False
            return rows, True
        finally:
            cursor.close()

    def _first(self, query: str, *values: object) -> int:
        return int(self._connection.execute(query, values).fetchone()[0])


def _without(table: Table, rows: Sequence[Row], column: str | None, foreign: set[int]) -> list[Row]:
    """Rows whose column names none of these; what outlasts them names nothing then."""
    if column is None or not foreign:
        return list(rows)
    at = table.columns.index(column)
    if table.outlasts_runs:
        return [(*row[:at], None, *row[at + 1 :]) if row[at] in foreign else row for row in rows]
    return [row for row in rows if row[at] not in foreign]


def digest(rows: Sequence[Sequence[SQLValue]]) -> int:
    """A number that other rows have with a chance of one in 2**63."""
    text = repr([tuple(row) for row in rows]).encode("utf-8", "surrogatepass")
    return int.from_bytes(blake2b(text, digest_size=8).digest(), "big") >> 1


def _text(value: bytes) -> str:
    """Bytes that are no UTF-8, which another program has written, are read as what comes near."""
    return value.decode("utf-8", "replace")


# Rows on their way to a pool: gathered, and written with the progress that they make.


WRITE_BYTES: Final = 8_000_000

Put = Callable[["Batch | None", Mapping[str, int]], None]


class Outbox:
    """What waits to be written together, with the progress that it makes."""

    def __init__(self, shipment: Shipment, report: Report, progress: dict[str, int]) -> None:
        self._shipment = shipment
        self._report = report
        self._batches: list[Batch] = []
        self._told = dict[str, int]()
        self._size = 0
        self.progress = progress

    @property
    def is_full(self) -> bool:
        """Whether to send before anything is added."""
        return self._size >= WRITE_BYTES

    def add(self, batch: Batch | None, told: Mapping[str, int]) -> None:
        """Rows, and the numbers that hold once they are written."""
        if batch is not None and batch.rows:
            self._batches.append(batch)
            self._size += sum(map(row_bytes, batch.rows))
        self._told |= told
        self.progress |= told

    def send(self) -> None:
        """Write it all, in one transaction of the pool's."""
        if not self._batches and not self._told:
            return
        self._report.replaced.update(self._shipment.write(self._batches, self._told))
        for batch in self._batches:
            self._report.rows[batch.table.name] += len(batch.rows)
        self._batches, self._told, self._size = [], {}, 0


# What a shipper tells of its work.


@dataclass
class Report:
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


# Shipping on and on while a robot records, also where the pool or the recording goes away.


THOROUGH_S: Final = 30.0  # between two looks at all of what may change, and not only the newest
_FIRST_WAIT_S: Final = 1.0
_LONGEST_WAIT_S: Final = 60.0

Say = Callable[[str], None]


def follow(order: Order, report: Report, say: Say, pause_s: float) -> None:
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
    patience = _Patience(say, pause_s)
    while True:
        time.sleep(_go_on_until_it_fails(order, report, say, pause_s, patience))


def _go_on_until_it_fails(
    order: Order, report: Report, say: Say, pause_s: float, patience: _Patience
) -> float:
    """Ship as long as recording and pool are there; returns how long to wait then."""
    try:
        with shipper(order, report) as connected:
            patience.connected(connected.address)
            _go_on(connected, pause_s)
    except ReplacedError as error:
        say(f"{error}: that one is shipped from here on")
        return 0.0
    except NoDatabaseError:
        return patience.wait_for(order.recording.database)
    except (PoolBusyError, PoolUnavailableError) as error:
        return patience.wait_after(error)


class _Patience:
    """How long to wait before the next attempt, and what is said of it."""

    def __init__(self, say: Say, pause_s: float) -> None:
        self._say = say
        self._pause_s = pause_s
        self._away_s = 0.0
        self._was_there = False
        self._has_told = False

    def connected(self, address: str) -> None:
        """The recording and the pool are there."""
        if self._away_s:
            self._say(f"the pool {address} is there again")
        self._away_s, self._was_there, self._has_told = 0.0, True, False

    def wait_for(self, database: Database) -> float:
        """In seconds, where no recording is."""
        there = f"nothing is recorded at {name_of(database)} now"
        self._tell_once(f"{there}: it is shipped as soon as it is there")
        return self._pause_s

    def wait_after(self, error: PoolError) -> float:
        """In seconds; what would not be better after it is raised again."""
        if isinstance(error, PoolBusyError):
            if not self._was_there:
                raise error
            self._tell_once(f"{error}; waiting until it ends")
            return _FIRST_WAIT_S  # it may be our last connection, of which a server learns late
        self._away_s = min(max(2 * self._away_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)
        self._say(f"{error}; trying again in {self._away_s:g} s, nothing is lost meanwhile")
        return self._away_s

    def _tell_once(self, text: str) -> None:
        if not self._has_told:
            self._say(text)
        self._has_told = True


def _go_on(connected: Shipper, pause_s: float) -> NoReturn:
    next_s = 0.0
    while True:
        is_thorough = time.monotonic() >= next_s
        if is_thorough:
            next_s = time.monotonic() + THOROUGH_S
        if connected.round(thorough=is_thorough):
            time.sleep(pause_s)
