"""Shipping a recording to a pool: once, or continuously while a robot records.

The pool stores the progress, numbers that say what it holds, in the same transaction as the rows. A
shipper can therefore be killed at any time and the next one continues; the recording stores
nothing about it. Rows that may change are compared by hashes, and sent again only if these differ.

No read transaction is open while the pool is written to. Otherwise the WAL of the database could
not be truncated, and a slow server would fill up the robot's disk.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NoReturn

from webots_mcp.database.connection import FrozenConnection
from webots_mcp.database.session_cleanup import find_dead_sessions
from webots_mcp.database.tapes.tape import tape_file
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
from webots_mcp.plugins.pool.shipping_source import UNCHECKED, ShippingSource, digest_of_rows
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.chunks import reached
from webots_mcp.store.merging import settled
from webots_mcp.store.recording import RecordingAccess, name_of
from webots_mcp.store.run_rows import MAX_FILE_BYTES, PICTURES, inside

# Names in the progress: the last shipped picture file, and the last state of a full-rate segment.
_PICTURE: Final = "picture"
_TAPE: Final = "tape"  # in the progress: the last session whose tape was shipped
_STRETCH: Final = "kept_stretch/"
_LAST: Final = "SELECT coalesce(max(id), 0) FROM {}"
# The last group before the first incomplete one: groups with lower ids are not checked again.
LAST_GROUP: Final = (
    "SELECT coalesce((SELECT min(id) - 1 FROM row_group WHERE is_complete = 0), "
    "(SELECT max(id) FROM row_group), 0)"
)
# States that were not shipped with a full-rate segment. The parameter is a JSON object of the last
# shipped state by id of the segment.
_UNSENT: Final = (
    "id NOT IN (SELECT s.id FROM json_each(?) sent JOIN kept_stretch k ON k.id = sent.key "
    "JOIN state s ON s.run_id = k.run_id AND s.id > ? AND s.id <= sent.value "
    "AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s)"
)


@dataclass(frozen=True)
class _ShippingLimits:
    """Sizes and times of shipping."""

    thorough_s: float = 30.0
    """Time between two comparisons of all rows that may change, not only the newest."""
    compared_rows: int = 32
    """Rows that share one hash."""
    row_groups: int = 64
    """Row groups in a round."""
    batches: int = 8
    """Batches of a table in a round, before the other tables get their turn."""
    write_bytes: int = 8_000_000
    """Size of rows that are written together."""
    first_wait_s: float = 1.0
    """Delay before the first retry, which doubles each time."""
    longest_wait_s: float = 60.0
    """Maximum delay before a retry."""
    handover_s: tuple[float, ...] = (0.02, 0.1, 0.3, 0.6)
    """Delays while a server may not know yet that the last shipper was killed."""
    pause_s: float = 0.002
    """Pause between two short writes to the recording, for robots that record."""


_LIMITS: Final = _ShippingLimits()


@dataclass(frozen=True)
class ShippingJob:
    """What to ship.

    Attributes:
        recording: The recording.
        open_pool: Opens the pool for shipping. Called for each connection.
        full: Whether to ship all states as well.
        pictures: Whether to ship the files of pictures as well.
    """

    recording: RecordingAccess
    open_pool: Callable[[], Pool]
    full: bool = False
    pictures: bool = False


@dataclass
class ShippingReport:
    """What was shipped so far, and what was not.

    Attributes:
        rows: Number of rows by table. A row that changed counts each time it is sent.
        pictures: Number of picture files.
        lost: Number of rows by table that retention deleted before they were shipped.
        replaced: Number of values by column that the pool cannot hold and stores differently.
        lost_pictures: Number of picture files that are missing or not allowed.
        foreign: UUIDs of runs that another recording shipped before, with its UUID.
        notes: Other notes for a person.
    """

    rows: Counter[str] = field(default_factory=Counter[str])
    pictures: int = 0
    lost: Counter[str] = field(default_factory=Counter[str])
    replaced: Counter[str] = field(default_factory=Counter[str])
    lost_pictures: int = 0
    foreign: dict[str, str] = field(default_factory=dict[str, str])
    notes: list[str] = field(default_factory=list[str])

    def note(self, text: str) -> None:
        """Add a note, unless it exists."""
        if text not in self.notes:
            self.notes.append(text)


def ship(order: ShippingJob, report: ShippingReport) -> None:
    """Ship everything that is recorded, once.

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
    """Ship what is recorded, and what follows, until a KeyboardInterrupt.

    A pool that does not answer is tried again after increasing delays. A recording that does not
    exist yet is waited for.

    Args:
        order: What to ship.
        report: Updated continuously.
        say: Called with a sentence when the pool does not answer, and when it answers again.
        pause_s: Time between two checks of the recording.

    Raises:
        PoolError: The pool cannot be used, and a retry will not help.
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
            # The server may not have noticed yet that our last connection has ended.
            said, wait_s = f"{error}; waiting until it ends", _LIMITS.first_wait_s
        except PoolUnavailableError as error:
            away_s = wait_s = min(max(2 * away_s, _LIMITS.first_wait_s), _LIMITS.longest_wait_s)
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
            next_s = time.monotonic() + _LIMITS.thorough_s
        if connected.round(thorough=is_thorough):
            time.sleep(pause_s)


@contextmanager
def _shipper(order: ShippingJob, report: ShippingReport) -> Generator[Shipper]:
    """Connect to recording and pool as the only shipper of the recording.

    Raises:
        PoolError: The pool cannot be reached or written, or another ships this recording.
        DatabaseError: The recording cannot be read.
    """
    with order.recording.reader() as connection:
        uuid = ShippingSource(connection).uuid()  # First, because it may raise.
    with order.open_pool() as pool, ExitStack() as stack:
        shipment = _entered(stack, pool, uuid)
        yield Shipper(order, report, uuid, pool.address, shipment)


def _entered(stack: ExitStack, pool: Pool, uuid: str) -> Shipment:
    """Start shipping.

    Retry shortly: the server may not know yet that the last shipper was killed.
    """
    for wait_s in _LIMITS.handover_s:
        with suppress(PoolBusyError):
            return stack.enter_context(pool.shipment(uuid))
        time.sleep(wait_s)
    return stack.enter_context(pool.shipment(uuid))


class RecordingReplacedError(PoolError):
    """Another recording has replaced the one that is shipped."""


class Shipper:
    """Ships a recording through one connection to a pool.

    Attributes:
        address: The URL of the pool without secrets.
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
        self._last_ids = dict[str, int]()  # Last rows whose references were read, by table.
        self._batches = list[Batch]()  # Rows that wait to be written together.
        self._numbers = dict[str, int]()  # The progress after that.
        self._size = 0

    def round(self, *, thorough: bool) -> bool:
        """Ship what is new.

        Args:
            thorough: Whether to compare all rows that may have changed, not only the newest.

        Returns:
            Whether the pool holds everything that was recorded at the start of the round.
        """
        with self._order.recording.reader() as connection:
            source = ShippingSource(connection)
            self._require_the_same(source)
            is_frozen = isinstance(connection, FrozenConnection)
            if thorough:
                self._end_killed_runs(connection)
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
                self._ship_tapes(connection)
            if is_complete and thorough:  # Otherwise not all rows were compared.
                whole = whole_runs(ended - source.foreign).items()
                self._put(None, {name: n | self._progress.get(name, 0) for name, n in whole})
            self._send()
        return is_complete

    def note_states_in_no_chunk(self) -> None:
        """Note the number of states that are neither shipped nor in chunks."""
        with self._order.recording.reader() as connection:
            source = ShippingSource(connection)
            self._leave_out_foreign_runs(source)
            behind, shipped = 0, self._progress.get("state", 0)  # With --full.
            for run_id in source.runs().keys() - source.foreign:
                at = reached(connection, run_id)
                place = (run_id, at.end_s, at.last_state_id, shipped)
                behind += source.number(
                    "SELECT count(*) FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
                    "AND id > ?",
                    *place,
                )
        if behind:
            fix = "ship again when their run has ended, or with --full"
            if isinstance(connection, FrozenConnection):
                fix = (
                    "none can be made where the file cannot be written: ship a copy, or with --full"
                )
            self._report.note(f"{behind} states are in no chunk yet, and so not in the pool: {fix}")

    def _end_killed_runs(self, connection: sqlite3.Connection) -> None:
        """End runs in the recording whose process was killed. A pool could not know that."""
        database = self._order.recording.database
        if not isinstance(database, Path) or not find_dead_sessions(connection):
            return
        try:
            settled(database)
        except DatabaseError as error:
            self._report.note(f"runs whose process was killed stay open in the pool: {error}")

    def _make_chunks(self, source: ShippingSource) -> None:
        """Put states into chunks in the recording; of ended runs all of them."""
        database = self._order.recording.database
        if not isinstance(database, Path):
            return
        ended = [each for each in source.ended_runs() if not is_whole(self._progress, each)]
        try:
            with RecordingAccess(database, database.parent).writer() as connection:
                while not make_chunks(connection, pause_s=_LIMITS.pause_s).done:
                    pass
                for run_id in ended:
                    chunk_whole_run(connection, run_id, _LIMITS.pause_s)
        except (DatabaseError, sqlite3.Error) as error:
            self._report.note(f"not all states are in chunks, which alone are shipped: {error}")

    def _appended(self) -> list[ShippedTable]:
        """Return the appended tables to ship, with the largest, states, last."""
        wanted = [each for each in tables() if each.is_appended and each.name not in CHUNKS]
        others = [each for each in wanted if each.name != "state"]
        return [*others, table("state")] if self._order.full else others

    def _require_the_same(self, source: ShippingSource) -> None:
        """Require that the recording is the one shipped before, and no older copy of it.

        Raises:
            PoolError: It is another one.
        """
        if (uuid := source.uuid()) != self._uuid:
            raise RecordingReplacedError(f"the recording {uuid} stands now where {self._uuid} was")
        if self._is_checked:
            return
        for each in (table("run"), table("row_group"), *self._appended()):
            known = self._progress.get(each.name, 0)
            before = self._progress.get(f"{each.name}.check", UNCHECKED)
            now = source.fingerprint(each, known)
            is_other = before != now and UNCHECKED not in (before, now)
            highest_id_ever = source.number(
                f"SELECT max((SELECT coalesce(max(id), 0) FROM {each.name}), "
                f"iif('{each.name}' = 'state', (SELECT reserved_state_id FROM recording), "
                "(SELECT coalesce(max(seq), 0) FROM sqlite_sequence "
                f"WHERE name = '{each.name}')))"
            )
            if highest_id_ever < known or is_other:
                raise PoolError(
                    f"the recording {self._uuid} is not the one that was shipped to {self.address} "
                    f"before: its table {each.name!r} is not the same up to row {known}. It is an "
                    "older copy, or one that was gone on with elsewhere: ship the newest one, or "
                    "import this one into a new recording ('webots-mcp import FILE --data-dir "
                    "NEW') and ship that"
                )
        self._is_checked = True

    def _ship_changing(self, source: ShippingSource, *, thorough: bool) -> set[int]:
        """Ship differences in tables that change; return the runs that had ended by then."""
        while True:
            with _one_moment(source.connection):
                is_all = self._leave_out_foreign_runs(source)
                for each in tables() if is_all else ():
                    if each.is_appended:
                        self._last_ids[each.name] = source.number(_LAST.format(each.name))
                    else:
                        is_all = is_all and self._compare(source, each, thorough=thorough)
                if is_all:
                    self._last_ids["row_group"] = source.number(LAST_GROUP)
                    return source.ended_runs()
            self._fetch_owners(source)
            self._send()

    def _leave_out_foreign_runs(self, source: ShippingSource) -> bool:
        """Return whether the owners of all runs are known; leave out runs of other recordings."""
        runs = {run_id: uuid for run_id, uuid in source.runs().items() if uuid}
        source.leave_out({run_id for run_id, uuid in runs.items() if self._owners.get(uuid)})
        return self._owners.keys() >= set(runs.values())

    def _fetch_owners(self, source: ShippingSource) -> None:
        new = {uuid for uuid in source.runs().values() if uuid} - self._owners.keys()
        found = self._shipment.foreign_runs(new) if new else {}
        self._owners |= {uuid: found.get(uuid) for uuid in new}
        self._report.foreign |= found

    def _compare(self, source: ShippingSource, each: ShippedTable, *, thorough: bool) -> bool:
        """Collect rows whose hash differs from that in the pool; return False if they are too many.

        Rows are compared in groups of ids, those of a table without ids all at once.
        """
        last, count = self._progress.get(each.name, 0), _LIMITS.compared_rows
        parts, where = range(1), "? = ?"
        if each.key == ("id",):
            newest = source.number(_LAST.format(each.name))
            parts = range((0 if thorough else last) // count, newest // count + 1)
            where = "id >= ? AND id < ?"
        for part in parts:
            bounds = (part * count, (part + 1) * count) if each.key == ("id",) else (0, 0)
            rows = source.rows(each, where, *bounds)
            name, value = f"{each.name}:{part}", digest_of_rows(rows)
            if rows and self._progress.get(name) != value:
                if self._size >= _LIMITS.write_bytes:
                    return False
                last = max([last, *(row[0] for row in rows if isinstance(row[0], int))])
                self._add(Batch(each, rows), {name: value, each.name: last})
        return True

    def _ship_groups(self, source: ShippingSource) -> bool:
        """Ship the next row groups with their chunks; return whether these were all."""
        groups, chunks = table("row_group"), table("chunk")
        bounds = (self._progress.get(groups.name, 0), self._last_ids[groups.name])
        found = source.connection.execute(
            "SELECT id FROM row_group WHERE id > ? AND id <= ? ORDER BY id LIMIT ?",
            (*bounds, _LIMITS.row_groups),
        ).fetchall()
        ids = [group_id for (group_id,) in found]
        for group_id in ids:
            self._add(Batch(chunks, source.rows(chunks, "group_id = ?", group_id)), {})
            group = Batch(groups, source.rows(groups, "id = ?", group_id))
            self._put(group, self._reached(source, groups, group_id))
        return len(ids) < _LIMITS.row_groups

    def _ship_appended(self, source: ShippingSource, each: ShippedTable) -> bool:
        """Ship the next rows; return whether these were all."""
        after, up_to = self._progress.get(each.name, 0), self._last_ids[each.name]
        for _ in range(_LIMITS.batches):
            if after >= up_to:
                return True
            count = f"SELECT count(*) FROM {each.name} WHERE id > ? AND id <= ?"
            with _one_moment(source.connection):
                rows, last = self._next(source, each, after, up_to)
                found = source.number(count, after, last)
            if lost := last - after - found:
                self._report.lost[each.name] += lost
            self._put(Batch(each, rows), self._reached(source, each, last))
            after = last
        return after >= up_to

    def _next(
        self, source: ShippingSource, each: ShippedTable, after: int, up_to: int
    ) -> tuple[list[PoolRow], int]:
        """Return the next rows, and the last id that was read."""
        where, values = "id > ? AND id <= ?", (after, up_to)
        if each.name == "state":
            where, values = f"{where} AND {_UNSENT}", (*values, self._sent_stretches(), after)
        rows, is_all = source.piece(each, where, *values)
        return rows, up_to if is_all else int(str(rows[-1][0]))

    def _sent_stretches(self) -> str:
        """Return the last shipped state of each full-rate segment, by id, as JSON."""
        names = [name for name in self._progress if name.startswith(_STRETCH)]
        return json.dumps({name.removeprefix(_STRETCH): self._progress[name] for name in names})

    def _ship_kept(self, source: ShippingSource, *, thorough: bool) -> None:
        """Ship the states of full-rate segments, if not all states are shipped."""
        where = "run_id = ? AND sim_time_s BETWEEN ? AND ? AND id > ? AND id <= ?"
        states, up_to = table("state"), self._last_ids["state"]
        for stretch_id, *bounds, is_over in source.connection.execute(
            "SELECT k.id, k.run_id, k.start_sim_time_s, k.end_sim_time_s, u.ended_wall_time_s IS "
            "NOT NULL FROM kept_stretch k JOIN run u ON u.id = k.run_id ORDER BY k.id"
        ).fetchall():
            name, is_all = f"{_STRETCH}{stretch_id}", False
            if name in self._progress and is_over and not thorough:
                continue
            while not is_all:
                after = max(self._progress.get(name, 0), self._progress.get("state", 0))
                values = (*bounds, after, up_to, self._sent_stretches(), after)
                rows, is_all = source.piece(states, f"{where} AND {_UNSENT}", *values)
                if rows:
                    self._put(Batch(states, rows), {name: int(str(rows[-1][0]))})

    def _reached(self, source: ShippingSource, each: ShippedTable, last: int) -> dict[str, int]:
        """Return the progress up to a row, with a hash by which it is recognized."""
        return {each.name: last, f"{each.name}.check": source.fingerprint(each, last)}

    def _ship_pictures(self, source: ShippingSource) -> None:
        """Ship the files of the pictures whose rows are shipped."""
        images = table("image")
        up_to, path_at = self._progress.get(images.name, 0), images.columns.index("path")
        while (after := self._progress.get(_PICTURE, 0)) < up_to:
            rows, is_all = source.piece(images, "id > ? AND id <= ?", after, up_to)
            size, last = 0, up_to if is_all else int(str(rows[-1][0]))
            for row in rows:
                size += self._ship_picture(str(row[path_at]))
                if size >= _LIMITS.write_bytes:
                    last = int(str(row[0]))
                    break
            self._add(None, {_PICTURE: last})
            self._send()

    def _ship_tapes(self, connection: sqlite3.Connection) -> None:
        """Ship the tapes of the sessions that have ended since the last one, as files."""
        ended = connection.execute(
            "SELECT id, uuid FROM session WHERE id > ? AND id < coalesce((SELECT min(id) "
            "FROM session WHERE ended_wall_time_s IS NULL), id + 1) ORDER BY id",
            (self._progress.get(_TAPE, 0),),
        ).fetchall()
        for session_id, uuid in ended:
            data_dir = self._order.recording.data_dir
            file = tape_file(data_dir, str(uuid))
            if file.is_file() and not file.is_symlink():
                self._shipment.write_picture(
                    file.relative_to(data_dir).as_posix(), file.read_bytes()
                )
            self._add(None, {_TAPE: session_id})
            self._send()

    def _ship_picture(self, path: str) -> int:
        """Ship a picture file; return its number of bytes."""
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
        """Add rows and progress, and send everything that waits once it is large."""
        self._add(batch, numbers)
        if self._size >= _LIMITS.write_bytes:
            self._send()

    def _add(self, batch: Batch | None, numbers: Mapping[str, int]) -> None:
        """Add rows, and the progress that holds once they are written."""
        if batch is not None and batch.rows:
            self._batches.append(fitted(batch, self._report.replaced))
            self._size += sum(map(row_bytes, batch.rows))
        changed = {n: value for n, value in numbers.items() if self._progress.get(n) != value}
        self._numbers |= changed
        self._progress |= changed

    def _send(self) -> None:
        """Write everything that waits, in one transaction of the pool."""
        if not self._batches and not self._numbers:
            return
        self._report.replaced.update(self._shipment.write(self._batches, self._numbers))
        for batch in self._batches:
            self._report.rows[batch.table.name] += len(batch.rows)
        self._batches, self._numbers, self._size = [], {}, 0


@contextmanager
def _one_moment(connection: sqlite3.Connection) -> Generator[None]:
    """Read from one state of the database within the block."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        connection.execute("COMMIT")
