"""Read runs and what is recorded in them: published states, events of the bridge, pictures."""

from __future__ import annotations

import contextlib
import itertools
import json
import sqlite3
import stat
from collections.abc import Callable, Generator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from webots_mcp.contract import KEPT_FRAME
from webots_mcp.errors import (
    InvalidInputError,
    MalformedRowError,
    NothingRecordedError,
    UnknownRunError,
)
from webots_mcp.signals.naming import nearest_first

if TYPE_CHECKING:
    from PIL.Image import Image
_RECENT_TIMES: Final = (
    "SELECT sim_time_s, wall_time_s FROM state WHERE run_id = ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
# A blob is greater than any number or text, so a time that is not a number is found and reported.
_LATER_THAN_ANY: Final = b"\xff"
# Mean wall time of a round of the loop, in its own code and in `step`; null if few were seen.
_ENOUGH: Final = "steps >= 20 OR (steps > 0 AND own_wall_s + step_wait_wall_s >= 10)"
OWN_MS: Final = f"CASE WHEN {_ENOUGH} THEN 1e3 * own_wall_s / steps END"
STEP_WAIT_MS: Final = f"CASE WHEN {_ENOUGH} THEN 1e3 * step_wait_wall_s / steps END"
PICTURES: Final = (".png", ".jpg", ".jpeg")
MAX_FILE_BYTES: Final = 64_000_000
_OF_CAMERA: Final = f"kind IN ('camera', '{KEPT_FRAME}')"


@dataclass(frozen=True)
class RowLimits:
    """Limits of what is read and shown of a run.

    Attributes:
        pace_rows: Newest rows whose times give the interval between rows.
        pace_window_s: Wall time before the newest row that the real-time factor covers.
        pace_window_rows: Maximum number of rows in that time.
        pace_share: Share of a round from which its code, or the rest, counts as the bottleneck.
        shown_keys: Keys of a state that an error lists.
        searched_keys: Keys that are searched for names similar to a missing one.
        shown_key_characters: Length at which a listed key is cut.
        max_pixels: Pixels of a picture that is opened: 200 MB in memory.
        shown_path_characters: Length at which a path in an error is cut.
    """

    pace_rows: int = 6
    pace_window_s: float = 5.0
    pace_window_rows: int = 500
    pace_share: float = 0.8
    shown_keys: int = 20
    searched_keys: int = 1000
    shown_key_characters: int = 40
    max_pixels: int = 50_000_000
    shown_path_characters: int = 100


_LIMITS: Final = RowLimits()


def columns_of(row: type[Any]) -> str:
    """Return the columns to select so that a row has the arguments of this dataclass."""
    return ", ".join(field.name for field in fields(row))


@dataclass(frozen=True)
class RunRecord:
    """An interval of rising simulation time in one session. Columns as in `store.models`."""

    id: int
    session_id: int
    robot_id: int
    world: str | None
    basic_time_step_ms: float | None
    start_reason: str
    started_wall_time_s: float
    started_sim_time_s: float
    last_wall_time_s: float
    last_sim_time_s: float
    ended_wall_time_s: float | None
    end_reason: str | None
    row_count: int
    label: str | None


@dataclass(frozen=True)
class StateRecord:
    """What one `publish` recorded; `data` and `replaced` are JSON text."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    data: str
    replaced: str | None

    def value(self) -> dict[str, Any]:
        """Return the published dict, with "nan", "inf" and the like where JSON has null."""
        value = cast("dict[str, Any]", _decoded(self, self.data))
        for path, kind in self.replaced_paths().items():
            put_back(value, path.split("."), kind)
        return value

    def replaced_paths(self) -> dict[str, str]:
        """Return the path of every replaced value, and what it was."""
        return _decoded(self, self.replaced) if self.replaced else {}


@dataclass(frozen=True)
class EventRecord:
    """Something noticed in a run; `data` is JSON text."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    kind: str
    name: str | None
    data: str | None

    def details(self) -> Any:
        """Return the decoded details; None if nothing was added."""
        return _decoded(self, self.data) if self.data else None


def _decoded(row: StateRecord | EventRecord, text: str) -> Any:
    """Return the value of a row's JSON text; a MalformedRowError names a row without valid JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        table = "event" if isinstance(row, EventRecord) else "kept_" * (row.id < 0) + "state"
        where = f"run {row.run_id}: row {abs(row.id)} of table {table}"
        raise MalformedRowError(f"{where} holds a value that cannot be read: {error}") from error


def _text_or_bytes(stored: bytes) -> str | bytes:
    try:
        return stored.decode()
    except UnicodeDecodeError:
        return stored


@contextlib.contextmanager
def reading_texts(
    connection: sqlite3.Connection, read: Callable[[bytes], Any] = _text_or_bytes
) -> Generator[None]:
    """Read texts that are not UTF-8 as bytes: SQLite's error would not name the row."""
    before, connection.text_factory = connection.text_factory, read
    try:
        yield
    finally:
        connection.text_factory = before


_RUN_COLUMNS: Final = columns_of(RunRecord)
_STATE_COLUMNS: Final = columns_of(StateRecord)
# After a crash only a full-rate segment has the newest state; it has a negative id.
_NEWEST_STATE: Final = (
    "SELECT * FROM (SELECT * FROM (SELECT {columns} FROM state WHERE run_id = :run "
    "AND sim_time_s <= :until ORDER BY sim_time_s DESC, id DESC LIMIT 1) UNION ALL "
    "SELECT -id, {kept} FROM (SELECT {columns} FROM kept_state WHERE run_id = :run "
    "AND sim_time_s <= :until ORDER BY sim_time_s DESC, id DESC LIMIT 1)) "
    "ORDER BY sim_time_s DESC, wall_time_s DESC LIMIT 1"
).format(columns=_STATE_COLUMNS, kept=_STATE_COLUMNS.partition(", ")[2])


def current_run(connection: sqlite3.Connection, robot_id: int) -> RunRecord | None:
    """Return the robot's newest run, ended or not."""
    row = connection.execute(
        f"SELECT {_RUN_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT 1", (robot_id,)
    ).fetchone()
    return RunRecord(*row) if row else None


def fetch_run(
    connection: sqlite3.Connection, run_id: int, robot_id: int | None = None
) -> RunRecord:
    """Return the run with an id.

    Args:
        connection: An open database.
        run_id: The run.
        robot_id: The robot of the run; None for any.

    Raises:
        UnknownRunError: The run does not exist, or belongs to another robot.
    """
    row = connection.execute(f"SELECT {_RUN_COLUMNS} FROM run WHERE id = ?", (run_id,)).fetchone()
    if row is None or robot_id not in (None, RunRecord(*row).robot_id):
        raise UnknownRunError(_no_such_run(connection, run_id, robot_id))
    return RunRecord(*row)


def runs_of(connection: sqlite3.Connection, robot_id: int) -> list[RunRecord]:
    """Return all runs of the robot, oldest first."""
    return [
        RunRecord(*row)
        for row in connection.execute(
            f"SELECT {_RUN_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id", (robot_id,)
        ).fetchall()
    ]


def count_runs(connection: sqlite3.Connection, robot_id: int) -> int:
    """Return how many runs of the robot were recorded."""
    return int(
        connection.execute("SELECT count(*) FROM run WHERE robot_id = ?", (robot_id,)).fetchone()[0]
    )


def _no_such_run(connection: sqlite3.Connection, run_id: int, robot_id: int | None) -> str:
    ids = [
        row[0]
        for row in connection.execute(
            "SELECT id FROM run WHERE :robot_id IS NULL OR robot_id = :robot_id ORDER BY id DESC "
            "LIMIT 10",
            {"robot_id": robot_id},
        ).fetchall()
    ]
    known = ", ".join(map(str, ids))
    if robot_id is None:
        return (
            f"No run {run_id} is recorded. Use one of the newest runs: {known}."
            if ids
            else f"No run {run_id} is recorded, because no controller has recorded a run yet."
        )
    query = "SELECT name FROM robot JOIN run ON run.robot_id = robot.id WHERE run.id = ?"
    owner = connection.execute(query, (run_id,)).fetchone()
    if owner is None:
        said = f"No run {run_id} of this robot is recorded."
    else:
        said = f"Run {run_id} belongs to another robot: to read it, give robot={owner[0]!r}."
    return (
        f"{said} Newest runs of this robot: {known}."
        if ids
        else f"{said} This robot has no run yet."
    )


def newest_state(connection: sqlite3.Connection, run_id: int) -> StateRecord | None:
    """Return the latest row of a run; None if retention has deleted it."""
    state = _state_up_to(connection, run_id, _LATER_THAN_ANY)
    if state is None or state.id > 0:
        return state
    (ended_s,) = connection.execute(
        "SELECT max(end_sim_time_s) FROM row_group WHERE run_id = ? AND is_complete = 1", (run_id,)
    ).fetchone()
    return None if ended_s is not None and ended_s > state.sim_time_s else state


def state_at(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> StateRecord | None:
    """Return the latest row of a run up to that simulation time."""
    return _state_up_to(connection, run_id, sim_time_s)


def _state_up_to(
    connection: sqlite3.Connection, run_id: int, until: float | bytes
) -> StateRecord | None:
    with reading_texts(connection):
        row = connection.execute(_NEWEST_STATE, {"run": run_id, "until": until}).fetchone()
    return StateRecord(*row) if row else None


def recent_interval_s(connection: sqlite3.Connection, run_id: int) -> float | None:
    """Return the median wall time between the latest rows of a run in seconds; None if unknown."""
    times = connection.execute(_RECENT_TIMES, (run_id, _LIMITS.pace_rows)).fetchall()
    gaps = sorted(newer[1] - older[1] for newer, older in itertools.pairwise(times))
    return gaps[len(gaps) // 2] if gaps else None


def real_time_factor(connection: sqlite3.Connection, run_id: int) -> float | None:
    """Return simulation time per wall time over the last few recorded seconds."""
    times = connection.execute(_RECENT_TIMES, (run_id, _LIMITS.pace_window_rows)).fetchall()
    recent = [time for time in times if times[0][1] - time[1] <= _LIMITS.pace_window_s]
    if len(recent) < 2 or recent[0][1] <= recent[-1][1]:
        return None
    return (recent[0][0] - recent[-1][0]) / (recent[0][1] - recent[-1][1])


def pace_of(connection: sqlite3.Connection, robot: str, run_id: int) -> str | None:
    """Return a sentence on what sets the pace of a run; None if too few of its steps were seen."""
    own_ms, wait_ms, steps = connection.execute(
        f"SELECT {OWN_MS}, {STEP_WAIT_MS}, steps FROM run WHERE id = ?", (run_id,)
    ).fetchone()
    if own_ms is None:
        return None
    share = own_ms / max(own_ms + wait_ms, 1e-9)
    if share >= _LIMITS.pace_share:
        why = "the controller sets the pace, not the physics"
    elif share > 1 - _LIMITS.pace_share:
        why = "controller and Webots (or another controller) take turns"
    else:
        why = "not the bottleneck: Webots, real time or another controller sets the pace"
    step_ms = own_ms + wait_ms
    return (
        f"{robot}: controller load {100 * share:.2g} % of {step_ms:.4g} ms per step; {why} "
        f"(mean of {steps} steps)"
    )


def select(value: Any, path: str) -> Any:
    """Return the part of a state at a dotted path; `""` is all of it.

    Raises:
        InvalidInputError: The path leads nowhere; the text names the part that is missing.
    """
    parts = path.split(".") if path else []
    while parts:
        key, taken = _key(value, parts, path)
        value, parts = value[key], parts[taken:]
    return value


def _key(value: Any, parts: list[str], path: str) -> tuple[str | int, int]:
    """Return the key or index that the path starts with, and its number of parts.

    A key may itself hold dots, so the longest match is used.
    """
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        for taken in range(len(parts), 0, -1):
            if (key := ".".join(parts[:taken])) in members:
                return key, taken
        near = nearest_first(parts[0], itertools.islice(members, _LIMITS.searched_keys))[
            : _LIMITS.shown_keys
        ]
        known = [key[: _LIMITS.shown_key_characters] for key in near]
        raise InvalidInputError(
            f"path={path!r}: no member {parts[0]!r} in this part of the state. Use one of {known}."
        )
    if isinstance(value, list):
        items = cast("list[Any]", value)
        if parts[0].isdecimal() and int(parts[0]) < len(items):
            return int(parts[0]), 1
        above = path[: len(path) - len(".".join(parts))]
        use = f"Use {above}0 to {above}{len(items) - 1}." if items else "The list is empty."
        raise InvalidInputError(
            f"path={path!r}: {parts[0]!r} is no index of this list of {len(items)}. {use}"
        )
    whole = path[: len(path) - len(".".join(parts))].rstrip(".")
    raise InvalidInputError(
        f"path={path!r}: the value above {parts[0]!r} has no members. Use path={whole!r}."
    )


def put_back(value: Any, parts: list[str], replaced: object) -> None:
    """Put replaced values (or their kind) back where null stands for them, but not over values.

    The last part `*` stands for every null in an array.
    """
    if parts == ["*"] and isinstance(value, list):
        value[:] = [replaced if item is None else item for item in cast("list[Any]", value)]
        return
    try:
        key, taken = _key(value, parts, "")
    except InvalidInputError:  # the path leads to a value that was replaced as a whole
        return
    if taken < len(parts):
        put_back(value[key], parts[taken:], replaced)
    elif value[key] is None:
        value[key] = replaced


def count_dropped(connection: sqlite3.Connection, run: RunRecord, of_session: int) -> int:
    """Return how many rows of a run were dropped.

    For the last run of a session, drops that no event reports yet are included.

    Args:
        connection: An open database.
        run: The run.
        of_session: Dropped rows of all runs of its session, as the session counts them.
    """
    runs = connection.execute(
        "SELECT r.id, coalesce(sum(coalesce(json_extract(e.data, '$.row_count'), "
        "json_extract(e.data, '$.rows'))), 0) FROM run r LEFT JOIN event e ON e.run_id = r.id "
        "AND e.kind = 'dropped' AND json_valid(e.data) WHERE r.session_id = ? GROUP BY r.id",
        (run.session_id,),
    )
    noted = {run_id: int(rows) for run_id, rows in runs}
    unnoted = max(of_session - sum(noted.values()), 0) if run.id == max(noted, default=0) else 0
    return noted.get(run.id, 0) + unnoted


def newest_events(connection: sqlite3.Connection, run_id: int, limit: int) -> list[EventRecord]:
    """Return the latest events of a run, oldest first; a limit of -1 returns all of them."""
    rows = connection.execute(
        f"SELECT {columns_of(EventRecord)} FROM event WHERE run_id = ? "
        "ORDER BY sim_time_s DESC, id DESC LIMIT ?",
        (run_id, limit),
    ).fetchall()
    return [EventRecord(*row) for row in reversed(rows)]


# Camera frames and screenshots: rows here, files in the data folder.


@dataclass(frozen=True)
class StoredImage:
    """A picture that was recorded; `path` is relative to the data folder."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    kind: str
    device: str | None
    path: str
    width: int
    height: int
    size_bytes: int

    def file(self, data_dir: Path) -> Path:
        """Return the file itself; see `inside` for the errors."""
        return inside(data_dir, self.path)


def inside(data_dir: Path, path: str) -> Path:
    """Return the file at a recorded path.

    Raises:
        InvalidInputError: The path leads out of the data folder, or to no regular file.
        NothingRecordedError: The file was deleted.
    """
    try:
        file = (data_dir / path).resolve()
        if not file.is_relative_to(data_dir.resolve()):
            raise InvalidInputError(
                f"The path {path!r} lies outside the data folder and is not opened."
            )
        mode = file.stat().st_mode
    except FileNotFoundError as error:
        raise NothingRecordedError(
            f"The picture {data_dir / path} was recorded, but its file is gone: only the newest "
            "pictures are kept, or the controller records into another data folder. "
            "webots_get_camera() shows the newest picture."
        ) from error
    except (OSError, ValueError, RuntimeError) as error:  # too long, a NUL, a loop of links
        raise InvalidInputError(
            f"{path[: _LIMITS.shown_path_characters]!r} is not a usable path: {error}."
        ) from error
    if not stat.S_ISREG(mode):
        raise InvalidInputError(f"{file} is not a regular file and is not opened")
    return file


@contextlib.contextmanager
def opened(file: Path) -> Generator[Image]:
    """Open a picture without decoding it, and report errors inside the block as errors of its file.

    Pillow is imported with the first picture, because it would slow down the server's start.

    Args:
        file: A regular file.

    Raises:
        InvalidInputError: It is not a complete PNG or JPEG, or is too large.
    """
    from PIL import Image as Pictures

    try:
        _require_at_most(MAX_FILE_BYTES, "bytes", file.stat().st_size)
        picture: Any = Pictures.open(file, formats=("PNG", "JPEG"))
        with picture:
            _require_at_most(_LIMITS.max_pixels, "pixels", picture.width * picture.height)
            yield picture
    except Exception as error:  # Pillow may raise anything for a damaged file
        raise InvalidInputError(f"{file} is not a usable PNG or JPEG: {error}") from error


def _require_at_most(limit: int, of: str, found: int) -> None:
    if found > limit:
        raise ValueError(f"it has {found:,} {of}, {limit:,} is the limit")


def camera_frames(
    connection: sqlite3.Connection,
    run_id: int,
    device: str | None = None,
    *,
    at_s: float | None = None,
    count: int = 1,
) -> list[StoredImage]:
    """Return frames of one camera in a run, in order of time, including full-rate segments.

    Args:
        connection: An open database.
        run_id: The run.
        device: The camera; None for the one with the nearest frame.
        at_s: Simulation time to which the frames are nearest; None for the newest.
        count: Maximum number of frames of one kind.
    """
    order = "sim_time_s DESC" if at_s is None else "abs(sim_time_s - :at_s)"
    values = {"run_id": run_id, "device": device, "kind": None, "at_s": at_s, "count": 1}
    frames_query = (
        f"SELECT {columns_of(StoredImage)} FROM image WHERE run_id = :run_id AND {_OF_CAMERA} "
        "AND (:device IS NULL OR device = :device) AND (:kind IS NULL OR kind = :kind) "
        "ORDER BY {order}, id DESC LIMIT :count"
    )
    query = frames_query.format(order=order)
    found = connection.execute(query, values).fetchall()
    if found and count > 1:
        of = {"device": found[0][5], "kind": found[0][4], "count": count}
        found = connection.execute(query, values | of).fetchall()
    return sorted((StoredImage(*row) for row in found), key=lambda each: each.sim_time_s)


def camera_frames_between(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float, limit: int
) -> list[StoredImage]:
    """Return the frames of all cameras in [start_s, end_s] of a run, in order of time.

    The first `limit` of them; those of full-rate segments too.
    """
    rows = connection.execute(
        f"SELECT {columns_of(StoredImage)} FROM image WHERE run_id = ? AND {_OF_CAMERA} "
        "AND sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s, id LIMIT ?",
        (run_id, start_s, end_s, limit),
    )
    return [StoredImage(*row) for row in rows]


def camera_frame_bounds(connection: sqlite3.Connection, run_id: int) -> tuple[float, float] | None:
    """Return the times of the first and the newest camera frame of a run; None without any."""
    first_s, last_s = connection.execute(
        f"SELECT min(sim_time_s), max(sim_time_s) FROM image WHERE run_id = ? AND {_OF_CAMERA}",
        (run_id,),
    ).fetchone()
    return None if first_s is None else (first_s, last_s)


def newest_image(connection: sqlite3.Connection, run_id: int) -> StoredImage | None:
    """Return the newest picture of a run of any kind."""
    row = connection.execute(
        f"SELECT {columns_of(StoredImage)} FROM image WHERE run_id = ? "
        "ORDER BY sim_time_s DESC, id DESC LIMIT 1",
        (run_id,),
    ).fetchone()
    return StoredImage(*row) if row else None


def count_kept_frames(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> int:
    """Return the number of camera frames of a full-rate segment, from its start to its end."""
    return int(
        connection.execute(
            f"SELECT count(*) FROM image WHERE run_id = ? AND kind = '{KEPT_FRAME}' "
            "AND sim_time_s BETWEEN ? AND ?",
            (run_id, start_s, end_s),
        ).fetchone()[0]
    )


def cameras(connection: sqlite3.Connection, robot_id: int) -> dict[int, str]:
    """Return the cameras that have frames, by run of the robot, the newest run first."""
    return dict(
        connection.execute(
            f"SELECT run_id, group_concat(DISTINCT device) FROM image WHERE {_OF_CAMERA} "
            "AND run_id IN (SELECT id FROM run WHERE robot_id = ?) GROUP BY run_id "
            "ORDER BY run_id DESC",
            (robot_id,),
        ).fetchall()
    )
