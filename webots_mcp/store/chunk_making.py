"""Make chunks: the work of the maintainer, never of the control loop.

1,024 rows of a run become a group with one chunk per signal. The rest of an ended run becomes a
group if it has at least 32 rows, and so does everything whose rows retention is about to delete. A
group is prepared outside the write lock, stored in pieces of about half a millisecond, and counts
once its last piece is stored. Ids of state rows are assigned under the write lock, so a watermark
records which rows were examined. Rows that arrive late, at a time that is already in chunks, become
a group of their own.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.database.connection import FrozenConnection
from webots_mcp.database.job_leases import holder_of
from webots_mcp.database.maintenance import Maintainer
from webots_mcp.database.transactions import FAILURES, LONGEST_WRITE_S, AtomicStatements
from webots_mcp.errors import DatabaseError, warn
from webots_mcp.signals.register import MAX_SIGNALS
from webots_mcp.store.chunks import (
    ABSENT,
    EXACT_INTEGERS,
    IS_MARK,
    MAX_TEXT,
    SIM_TIMES,
    STATE_COLUMNS,
    STATE_IDS,
    WALL_TIMES,
    ChunkProgress,
    EncodedChunk,
    StateColumns,
    Statistics,
    chunks_aside,
    decoded_of,
    is_damaged,
    pack,
    reached,
    statistics_of,
    watermark,
)
from webots_mcp.store.recording import RecordingAccess, is_invalid_value
from webots_mcp.store.registered_signals import (
    RegisteredSignal,
    enter_signals,
    may_widen,
    registered,
    seen_in,
)
from webots_mcp.store.robots import list_robots
from webots_mcp.store.run_rows import reading_texts

GROUP_ROWS: Final = 1024
MIN_ROWS_AT_END: Final = 32  # fewer rows at the end of a run are not put into chunks
_NO_LIMIT: Final = 2**62
_COLUMNS: Final = (
    "run_id",
    "signal_id",
    *Statistics._fields,
    "codec",
    "numbers",
    "codes",
    "labels",
)
_LIST: Final = ", ".join(_COLUMNS)
_BEGIN_GROUP: Final = (
    "INSERT INTO row_group (run_id, start_sim_time_s, end_sim_time_s, last_state_id, "
    "max_state_id, row_count, stored_row_count, lost_value_count, stored_row_bytes, chunk_bytes, "
    "is_complete) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 0)"
)
_STORE: Final = AtomicStatements(  # unless another process has removed the group
    "store_chunks",
    ("group_id", "first", "last"),
    f"INSERT INTO chunk (group_id, {_LIST}) SELECT NEW.group_id, {_LIST} FROM new_chunk "
    "WHERE number >= NEW.first AND number <= NEW.last",
    # The extremes of the signals in the register.
    "UPDATE signal SET min = min(coalesce(signal.min, c.min), c.min), "
    "max = max(coalesce(signal.max, c.max), c.max) FROM new_chunk c WHERE c.number >= NEW.first "
    "AND c.number <= NEW.last AND signal.id = c.signal_id AND c.min IS NOT NULL "
    "AND (signal.min IS NULL OR c.min < signal.min OR c.max > signal.max)",
    unless="NOT EXISTS (SELECT 1 FROM row_group WHERE id = NEW.group_id)",
)
_COMPLETE: Final = AtomicStatements(  # unless another process has stored these rows meanwhile
    "complete_group",
    ("group_id", "run_id", "max_state_id", "chunks"),
    "UPDATE row_group SET is_complete = 1 WHERE id = NEW.group_id",
    unless="(SELECT count(*) FROM chunk WHERE group_id = NEW.group_id) <> NEW.chunks OR "
    "(SELECT coalesce(max(max_state_id), 0) FROM row_group WHERE run_id = NEW.run_id "
    "AND is_complete = 1) <> NEW.max_state_id",
)
# Unless rows of the old group were deleted or it was replaced in the meantime.
_REPLACE: Final = AtomicStatements(
    "replace_group",
    ("old_id", "new_id", "chunks"),
    "UPDATE row_group SET is_complete = id = NEW.new_id WHERE id IN (NEW.old_id, NEW.new_id)",
    unless="(SELECT count(*) FROM chunk WHERE group_id = NEW.new_id) <> NEW.chunks OR NOT EXISTS "
    "(SELECT 1 FROM row_group WHERE id = NEW.old_id AND is_complete = 1 "
    "AND stored_row_count = row_count)",
)
_LEFT_BEHIND: Final = "SELECT id FROM row_group WHERE is_complete = 0"
MIN_ROWS_ON_DEMAND: Final = 2000  # a question reads fewer rows without chunks
_PAUSE_S: Final = 0.002  # pause between two short writes, so that robots can write
INDEX_BYTES: Final = 21  # size of an entry (run_id, sim_time_s, id) of a time index, measured


@dataclass(frozen=True)
class ChunkMakingSizes:
    """Sizes and steps of making chunks, in bytes where nothing else is said.

    Attributes:
        ids_per_step: State ids that one step of the search for new rows covers.
        first_piece: Size of the first write, from which the next ones are adapted.
        per_chunk: What writing one chunk costs in addition to its content, as a size.
        state_row: A row of `state` without its text: run, two times and lengths.
        statistics: A row of `chunk` without its compressed values.
        chunk_indexes: The entries of a chunk in both indexes, as measured.
        batch_rows: Rows that are put into chunks between two checks of the deadline.
        page_head: The head of a page of SQLite.
        cell_head: Pointer, length and id of a row in a page.
        overflow_link: The link to the next page of a row that is longer than a page.
    """

    ids_per_step: int = 20_000
    first_piece: int = 100_000
    per_chunk: int = 5_000
    state_row: int = 25
    statistics: int = 115
    chunk_indexes: int = 110
    batch_rows: int = 2000
    page_head: int = 8
    cell_head: int = 7
    overflow_link: int = 4


_SIZES: Final = ChunkMakingSizes()


class Made(NamedTuple):
    """Result of a call of `make_chunks`.

    Attributes:
        rows: Number of state rows that were put into chunks.
        done: Whether nothing remains that could be put into chunks now.
    """

    rows: int
    done: bool


def make_chunks(
    connection: sqlite3.Connection, budget_rows: int = 4096, pause_s: float = 0.0
) -> Made:
    """Put rows that are in no chunk into chunks, at most about `budget_rows` of them.

    The call may be interrupted at any moment: what is stored stays, and the next call continues
    from there. Rows with values that no bridge writes are left out and reported on stderr.

    Args:
        connection: Connection of the only maintainer (role "writer"), in autocommit mode.
        budget_rows: Limit that bounds the time of the call: about 30 us per row of 40 values.
        pause_s: Pause between two writes, so that other processes can write; 0 if none does.

    Raises:
        sqlite3.Error: The database is locked or damaged; what was stored before stays.
    """
    remake_reported_groups(connection, pause_s)
    _delete_left_behind(connection, pause_s)
    rows = 0
    ended = connection.execute(
        "SELECT id, robot_id FROM run WHERE ended_wall_time_s IS NOT NULL AND is_chunked = 0"
    ).fetchall()  # one scan, regardless of the number of rounds
    while rows < budget_rows:
        mark = watermark(connection)
        last = connection.execute(
            "SELECT max(id) FROM (SELECT id FROM state WHERE id > ? ORDER BY id LIMIT ?)",
            (mark, _SIZES.ids_per_step),
        ).fetchone()[0]
        # The bounds 1 and 0 hold no row.
        runs = dict.fromkeys(ended, (1, 0))
        ended = []  # from the next round on only where they have new rows
        if last is not None:
            # One scan serves all runs: late rows lie between the ids that it finds.
            for *run, first_id, last_id in connection.execute(
                "SELECT n.run_id, r.robot_id, n.first_id, n.last_id "
                "FROM (SELECT run_id, min(id) AS first_id, max(id) AS last_id FROM state "
                "WHERE id > ? AND id <= ? GROUP BY run_id) n JOIN run r ON r.id = n.run_id",
                (mark, last),
            ):
                runs[tuple(run)] = (first_id, last_id)
        for (run_id, robot_id), new_ids in runs.items():
            work = _RunChunks(connection, run_id, robot_id, pause_s, new_ids)
            rows += work.make(budget_rows - rows, mark if last is None else last)
            if not work.done:
                return Made(rows, False)
        if last is None:
            return Made(rows, True)
        connection.execute(
            "INSERT INTO watermark (name, state_id) VALUES ('chunk', ?) "
            f"ON CONFLICT (name) DO UPDATE SET state_id = iif({IS_MARK}, "
            "max(state_id, excluded.state_id), excluded.state_id)",
            (last,),
        )
    return Made(rows, False)


def chunk_whole_run(connection: sqlite3.Connection, run_id: int, pause_s: float = 0.0) -> bool:
    """Put every row of a run into chunks, however few remain. Return whether all are in chunks."""
    (robot_id,) = connection.execute(
        "SELECT robot_id FROM run WHERE id = ?", (run_id,)
    ).fetchone() or (None,)
    if robot_id is None:
        return False
    newest_id = connection.execute("SELECT coalesce(max(id), 0) FROM state").fetchone()[0]
    work = _RunChunks(connection, run_id, robot_id, pause_s, (0, newest_id), least_rows=1)
    work.make(_NO_LIMIT, newest_id)
    return work.done


class _RunChunks:
    """Make the remaining chunks of one run.

    Args:
        connection: Connection of the maintainer.
        run_id: The run.
        robot_id: Its robot.
        pause_s: Pause between two writes.
        new_ids: First and last id of its rows beyond the watermark, late rows included.
        least_rows: Minimum number of rows in a group; `GROUP_ROWS` by default.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        run_id: int,
        robot_id: int,
        pause_s: float,
        new_ids: tuple[int, int],
        least_rows: int | None = None,
    ) -> None:
        self._connection = connection
        self._run_id = run_id
        self._robot_id = robot_id
        self._pause_s = pause_s
        self._new_ids = new_ids
        self._least_rows = least_rows or GROUP_ROWS
        self.done = False

    def make(self, budget_rows: int, last_id: int) -> int:
        """Make the chunks of rows up to an id. Return how many rows were put into chunks."""
        rows, least_rows, has_ended = 0, self._least_rows, self._has_ended()
        if has_ended:
            least_rows = min(least_rows, MIN_ROWS_AT_END)
        at = reached(self._connection, self._run_id)
        # Once a later group is stored, the ids of late rows no longer show that they are late.
        while rows < budget_rows and len(late := self._late(at, last_id)):
            if not self._store(late, at):
                return rows
            rows += len(late)
            at = reached(self._connection, self._run_id)
        while rows < budget_rows:
            tail = self._tail(at, last_id) if self._has_tail(at, last_id, least_rows) else None
            if tail is None or not len(tail):
                self.done = True
                if has_ended:
                    # Few rows stay as they are, but their names are registered.
                    left = self._tail(at, last_id)
                    _signals_of(self._connection, self._robot_id, left)
                    self._connection.execute(
                        "UPDATE run SET is_chunked = 1 WHERE id = ?", (self._run_id,)
                    )
                return rows
            if not self._store(tail, at):
                return rows
            rows += len(tail)
            at = reached(self._connection, self._run_id)
        return rows

    def _late(self, at: ChunkProgress, last_id: int) -> StateColumns:
        """Find rows in no chunk that arrived after rows of later times were put into one."""
        first_id, newest_id = self._new_ids
        after_id, last_id = max(at.max_state_id, first_id - 1), min(last_id, newest_id)
        if at.end_s == -math.inf or last_id <= after_id:
            return StateColumns()
        place = (at.end_s, at.last_state_id)
        # Late rows are found by id, because the mark up to which they were read is an id.
        return _read(
            self._connection,
            f"SELECT * FROM (SELECT {STATE_COLUMNS} FROM state WHERE id > ? AND id <= ? "
            "AND +run_id = ? AND (sim_time_s, id) <= (?, ?) ORDER BY id LIMIT ?) "
            "ORDER BY sim_time_s, id",
            (after_id, last_id, self._run_id, *place),
        )

    def _has_tail(self, at: ChunkProgress, last_id: int, least_rows: int) -> bool:
        """Return whether at least N rows follow those that are in chunks."""
        place = (at.end_s, at.last_state_id)
        asked = (self._run_id, *place, last_id, least_rows)
        # The index alone answers this.
        return bool(
            self._connection.execute(
                "SELECT count(*) FROM (SELECT 1 FROM state WHERE run_id = ? "
                "AND (sim_time_s, id) > (?, ?) AND id <= ? LIMIT ?)",
                asked,
            ).fetchone()[0]
            >= least_rows
        )

    def _tail(self, at: ChunkProgress, last_id: int) -> StateColumns:
        """Return the first rows that follow those in chunks."""
        place = (at.end_s, at.last_state_id)
        return _read(
            self._connection,
            f"SELECT {STATE_COLUMNS} FROM state WHERE run_id = ? AND (sim_time_s, id) > (?, ?) "
            "AND id <= ? ORDER BY sim_time_s, id LIMIT ?",
            (self._run_id, *place, last_id),
        )

    def _has_ended(self) -> bool:
        ended = "SELECT ended_wall_time_s IS NOT NULL FROM run WHERE id = ?"
        return bool(self._connection.execute(ended, (self._run_id,)).fetchone()[0])

    def _store(self, columns: StateColumns, at: ChunkProgress) -> bool:
        """Store a group; return False if another process has stored some of its rows meanwhile."""
        owner = (self._run_id, self._robot_id)
        group_id, chunks = store_group(self._connection, owner, columns, self._pause_s)
        expected = (self._run_id, at.max_in_groups, chunks)
        return _COMPLETE.run(self._connection, group_id, *expected)


def store_group(
    connection: sqlite3.Connection, owner: tuple[int, int], columns: StateColumns, pause_s: float
) -> tuple[int | None, int]:
    """Store a group, which readers ignore until it is marked as complete.

    Args:
        connection: Connection of the maintainer.
        owner: The run and its robot.
        columns: The rows of the group.
        pause_s: Pause between two writes.

    Returns:
        The id of the group and its number of chunks.
    """
    run_id, robot_id = owner
    signals = _signals_of(connection, robot_id, columns)
    ids = {name: each.id for name, each in signals.items() if each.id is not None}
    chunks = list(_chunks_of(run_id, columns, ids))
    _prepare(connection, chunks)
    rows = len(columns)
    group = (run_id, columns.times[0], columns.times[-1], columns.ids[-1], max(columns.ids))
    lost = count_lost(columns, signals)
    values = (*group, rows, rows, lost, *_sizes_of(connection, columns, chunks))
    group_id = connection.execute(_BEGIN_GROUP, values).lastrowid

    def store(first: int, last: int) -> bool:
        return _STORE.run(connection, group_id, first, last)

    _in_short_steps(list(map(_packed_bytes, chunks)), store, pause_s)
    return group_id, len(chunks)


def _sizes_of(
    connection: sqlite3.Connection, columns: StateColumns, chunks: Sequence[tuple[Any, ...]]
) -> tuple[float, int]:
    """Return the mean size of a state row and the size of all chunks, on the disk with indexes."""
    page_bytes = connection.execute("PRAGMA page_size").fetchone()[0]
    texts = (len(text.encode()) + _SIZES.state_row for text in columns.texts)
    packed = (_packed_bytes(chunk) + _SIZES.statistics for chunk in chunks)
    row_bytes = disk_bytes(texts, page_bytes) / len(columns) + INDEX_BYTES
    return row_bytes, round(disk_bytes(packed, page_bytes) + _SIZES.chunk_indexes * len(chunks))


def _prepare(connection: sqlite3.Connection, chunks: Sequence[tuple[Any, ...]]) -> None:
    """Fill the temporary table, in a transaction that locks nothing else."""
    connection.execute(
        f"CREATE TEMP TABLE IF NOT EXISTS new_chunk (number INTEGER PRIMARY KEY, {_LIST})"
    )
    connection.execute("BEGIN")
    try:
        connection.execute("DELETE FROM temp.new_chunk")
        connection.executemany(
            f"INSERT INTO temp.new_chunk VALUES ({', '.join('?' * (len(_COLUMNS) + 1))})",
            ((number, *chunk) for number, chunk in enumerate(chunks)),
        )
    finally:
        connection.execute("COMMIT")


# A damaged group whose rows all still exist is remade as a whole. Readers cannot write, so they
# report the group, and the maintainer of their process remakes it.


_reported: set[tuple[str, int]] = set()  # database file and group


def report_damaged_group(connection: sqlite3.Connection, group_id: int) -> None:
    """Report a damaged group, so that the next `make_chunks` of this process remakes it."""
    _reported.add((_file_of(connection), group_id))


def remake_reported_groups(connection: sqlite3.Connection, pause_s: float) -> None:
    """Remake the groups of this database that readers of this process reported as damaged."""
    file = _file_of(connection)
    for report in [each for each in _reported if each[0] == file]:
        _reported.discard(report)
        remake_if_damaged(connection, report[1], pause_s)


def _file_of(connection: sqlite3.Connection) -> str:
    query = "SELECT file FROM pragma_database_list WHERE name = 'main'"
    return connection.execute(query).fetchone()[0] or ""


def remake_if_damaged(connection: sqlite3.Connection, group_id: int, pause_s: float = 0.0) -> int:
    """Remake a group if one of its chunks is damaged and all of its rows still exist.

    Returns:
        The id of the new group, or of the old one if it was not replaced.
    """
    group = connection.execute(
        "SELECT g.run_id, r.robot_id, g.row_count, g.last_state_id, coalesce((SELECT min(min) "
        "FROM chunk WHERE group_id = g.id "
        f"AND signal_id = {STATE_IDS}), 0), g.max_state_id, g.start_sim_time_s, g.end_sim_time_s "
        "FROM row_group g JOIN run r ON r.id = g.run_id WHERE g.id = ? AND g.is_complete = 1 "
        "AND g.stored_row_count = g.row_count",
        (group_id,),
    ).fetchone()
    if group is None:
        return group_id
    run_id, robot_id, count, last_state_id, *bounds = group
    chunks = connection.execute(
        "SELECT signal_id, codec, numbers, codes, labels FROM chunk WHERE group_id = ?", (group_id,)
    ).fetchall()
    is_sound = {SIM_TIMES, WALL_TIMES, STATE_IDS} <= {signal_id for signal_id, *_ in chunks}
    if is_sound and not any(is_damaged(EncodedChunk(*each), count) for _, *each in chunks):
        return group_id
    columns = _read(
        connection,
        f"SELECT {STATE_COLUMNS} FROM state WHERE +run_id = ? AND id BETWEEN ? AND ? "
        "AND sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s, id LIMIT ?",
        (run_id, *bounds),
    )
    if len(columns) != count or columns.ids[-1] != last_state_id:
        return group_id
    new_id, made = store_group(connection, (run_id, robot_id), columns, pause_s)
    is_replaced = _REPLACE.run(connection, group_id, new_id, made)
    return new_id if is_replaced and new_id is not None else group_id


def _read(connection: sqlite3.Connection, query: str, values: tuple[object, ...]) -> StateColumns:
    """Read rows as columns, without rows that hold values no bridge writes."""
    columns = StateColumns()
    with reading_texts(connection):
        rows = connection.execute(query, (*values, GROUP_ROWS)).fetchall()
    try:
        columns.add(rows)
    except Exception as error:
        valid = [row for row in rows if _is_valid(row)]
        if not is_invalid_value(error) or len(valid) == len(rows):
            raise
        columns = StateColumns()
        columns.add(valid)
        first = next(row[0] for row in rows if row not in valid)
        warn(
            f"{len(rows) - len(valid)} states from state {first} on are left out of the chunks: "
            f"another program wrote what no bridge writes ({error})"
        )
    return columns


def _is_valid(row: tuple[Any, ...]) -> bool:
    try:
        StateColumns().add([row])
    except Exception as error:
        if not is_invalid_value(error):
            raise
        return False
    return True


def _signals_of(
    connection: sqlite3.Connection, robot_id: int, columns: StateColumns
) -> dict[str, RegisteredSignal]:
    """Return the robot's signals by name, and register those that are new in these rows."""
    known = registered(connection, robot_id)
    budget = max(0, MAX_SIGNALS - len(known))
    fresh = [name for name, each in columns.values.items() if may_widen(known.get(name), each)]
    # A state may have many more names than the register accepts.
    entered = [name for name in fresh if name in known]
    entered += islice((name for name in fresh if name not in known), budget)
    if entered:
        known = enter_signals(connection, robot_id, seen_in(columns, entered))
    return known


def count_lost(columns: StateColumns, signals: dict[str, RegisteredSignal]) -> int:
    """Count the values that chunks do not hold exactly as recorded (see 'webots-mcp help
    database').
    """
    lost = 0
    for name, values in columns.values.items():
        signal = signals.get(name)
        types = set(map(type, values))
        # beyond the number of registered signals, or a long array
        if signal is None or signal.reduction == "count":
            lost += sum(value is not ABSENT for value in values)
        if str in types:
            lost += sum(isinstance(value, str) and len(value) > MAX_TEXT for value in values)
        if int in types:
            lost += sum(type(value) is int and abs(value) > EXACT_INTEGERS for value in values)
    return lost


def _chunks_of(
    run_id: int, columns: StateColumns, ids: dict[str, int]
) -> Iterator[tuple[Any, ...]]:
    """Yield rows of the table `chunk`: for the times, and for each registered signal."""
    places: tuple[tuple[int, Sequence[Any]], ...] = (
        (SIM_TIMES, columns.times),
        (WALL_TIMES, columns.wall_times),
        (STATE_IDS, columns.ids),
    )
    values = [(ids[name], values) for name, values in columns.values.items() if name in ids]
    for signal_id, of_rows in (*places, *values):
        held = decoded_of(of_rows)
        yield (run_id, signal_id, *statistics_of(held), *pack(held))


def _packed_bytes(chunk: tuple[Any, ...]) -> int:
    return sum(len(each) for each in chunk[-3:] if each is not None)


def _in_short_steps(
    sizes: Sequence[int], store: Callable[[int, int], object], pause_s: float
) -> None:
    """Store items in steps of about half a millisecond each."""
    most, done = _SIZES.first_piece, 0
    while done < len(sizes):
        last, size = done, sizes[done] + _SIZES.per_chunk
        while last + 1 < len(sizes) and size + sizes[last + 1] + _SIZES.per_chunk <= most:
            last += 1
            size += sizes[last] + _SIZES.per_chunk
        started_s = time.perf_counter()
        store(done, last)
        took_s = time.perf_counter() - started_s
        done = last + 1
        most = round(size * min(2.0, LONGEST_WRITE_S / 2 / took_s))
        time.sleep(pause_s)


def _delete_left_behind(connection: sqlite3.Connection, pause_s: float) -> None:
    """Delete groups that an ended process left without all of their chunks."""
    for (group_id,) in connection.execute(_LEFT_BEHIND).fetchall():
        # The maker of a group may have completed it in the meantime.
        while connection.execute(
            "DELETE FROM chunk WHERE id IN (SELECT id FROM chunk WHERE group_id = (SELECT id "
            "FROM row_group WHERE id = ? AND is_complete = 0) LIMIT 20)",
            (group_id,),
        ).rowcount:
            time.sleep(pause_s)
        connection.execute("DELETE FROM row_group WHERE id = ? AND is_complete = 0", (group_id,))


# Making chunks on demand, if no server makes them in the background. Rows in no chunk are read one
# by one until a deadline, and an answer omits the rest. A server puts new rows into chunks; for a
# recording without a server, the process that asks does it.


def make_missing_chunks(
    recording: RecordingAccess,
    progress: Callable[[int, int], object] | None = None,
    *,
    limit_s: float = math.inf,
    called_off: Callable[[], bool] = lambda: False,
    write: bool = True,
) -> str:
    """Put all states that are in no chunk yet into chunks, unless a server does.

    The call may be interrupted at any moment, also by an exception: finished chunks stay, and the
    next call continues from there.

    Args:
        recording: The recording, with the current schema.
        progress: Called now and then with the number of finished rows and the total.
        limit_s: Wall seconds after which it stops.
        called_off: Called between two batches; returns whether to stop.
        write: If false, or if the file cannot be written, the chunks are made in a temporary file
            of this process.

    Returns:
        The number of states that remain in no chunk, and why; "" if none remain, or so few that a
        question reads them all.

    Raises:
        DatabaseError: The recording does not exist or cannot be read.
    """
    with recording.reader() as connection:
        total = left = _rows_left(connection)
        holder = holder_of(connection, "maintainer") or ""
        is_frozen = isinstance(connection, FrozenConnection)
    if total < MIN_ROWS_ON_DEMAND:
        return ""
    if holder.startswith("server ") and not is_frozen:
        return _say(total, "the server that maintains the recording makes them")
    until_s, why = time.monotonic() + limit_s, ""
    try:
        with _opened(recording, write=write, frozen=is_frozen) as connection:
            live = not is_frozen and any(
                robot.live for robot in list_robots(connection, time.time())
            )
            while not why:
                done = make_chunks(connection, _SIZES.batch_rows, _PAUSE_S if live else 0.0).done
                left = 0 if done else min(left, _rows_left(connection))
                if progress is not None:
                    progress(total - left, total)
                if done:
                    return ""
                if called_off() or time.monotonic() > until_s:
                    why = "ask again to continue"
    except (DatabaseError, *FAILURES) as error:
        why = str(error)
    return _say(left, why) if left >= MIN_ROWS_ON_DEMAND else ""


def _rows_left(connection: sqlite3.Connection) -> int:
    """Estimate how many rows are in no chunk."""
    # Ids have gaps only where rows were deleted.
    return int(
        connection.execute(
            "SELECT max(0, (SELECT coalesce(max(id), 0) "
            "FROM state) - :mark - (SELECT coalesce(sum(row_count), 0) FROM row_group "
            "WHERE is_complete = 1 AND max_state_id > :mark))",
            {"mark": watermark(connection)},
        ).fetchone()[0]
    )


@contextmanager
def _opened(
    recording: RecordingAccess, *, write: bool, frozen: bool
) -> Generator[sqlite3.Connection]:
    """Open a connection for making chunks, with a maintainer that keeps the log short."""
    database = recording.database
    if isinstance(database, Path) and (frozen or not write):
        with chunks_aside(database, frozen=frozen) as connection:
            yield connection
        return
    with recording.writer() as connection, ExitStack() as at_the_end:
        if isinstance(database, Path):
            maintainer = Maintainer(database, "question")  # idle if a bridge is the maintainer
            maintainer.start()
            at_the_end.callback(maintainer.stop)
        yield connection


def _say(rows: int, why: str) -> str:
    return f"the newest {rows} rows are in no chunk yet: {why}"


# How rows are stored on the pages of a file: the disk space of a table exceeds its text. Rows fill
# the pages of a table in the order of their ids. A row that does not fit the rest of a page starts
# the next page, and what is too long for a page has pages of its own (SQLite, Database File Format,
# section 1.6: B-tree Pages).


def disk_bytes(payloads: Iterable[int], page_bytes: int) -> float:
    """Return the disk space of rows that follow each other in a table, without its indexes.

    Args:
        payloads: Size of the record of each row, in bytes.
        page_bytes: Page size of the database.
    """
    space = page_bytes - _SIZES.page_head
    full_pages = own_bytes = filled = used = rows = 0
    for payload in payloads:
        local, own = _cell(payload, page_bytes)
        own_bytes += own
        if used + local > space:
            full_pages, filled, used, rows = full_pages + 1, filled + used, 0, 0
        used, rows = used + local, rows + 1
    if not rows:
        return 0.0
    # Other rows follow on the last page, which will be as full as the others.
    per_byte = page_bytes / (space - used / rows / 2)
    if full_pages:
        per_byte = full_pages * page_bytes / filled
    return full_pages * page_bytes + used * per_byte + own_bytes


def _cell(payload: int, page_bytes: int) -> tuple[int, int]:
    """Return the size of a row on its table page and the size of the pages it occupies alone."""
    most, least = page_bytes - 35, (page_bytes - 12) * 32 // 255 - 23
    if payload <= most:
        return payload + _SIZES.cell_head, 0
    overflow_space = page_bytes - _SIZES.overflow_link
    local = least + (payload - least) % overflow_space
    local = local if local <= most else least
    pages = -(-(payload - local) // overflow_space)
    return local + _SIZES.cell_head + _SIZES.overflow_link, pages * page_bytes
