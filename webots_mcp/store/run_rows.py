"""Runs and what is recorded in them: published states, and events that the bridge noticed."""

from __future__ import annotations

import itertools
import json
import sqlite3
from dataclasses import dataclass, fields
from typing import Any, Final, cast

from webots_mcp.errors import InvalidInputError, UnknownRunError
from webots_mcp.naming import nearest_first


def columns_of(row: type[Any]) -> str:
    """What to select so that a row is the arguments of this dataclass."""
    return ", ".join(field.name for field in fields(row))


@dataclass(frozen=True)
class Run:
    """A stretch of rising simulation time in one session. Columns as in `store.models`."""

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
class State:
    """What one `publish` recorded; `data` and `replaced` are JSON text."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    data: str
    replaced: str | None

    def value(self) -> dict[str, Any]:
        """The published dict, with "nan", "inf" and the like where JSON has to say null."""
        value = cast("dict[str, Any]", json.loads(self.data))
        for path, kind in self.replaced_paths().items():
            put_back(value, path.split("."), kind)
        return value

    def replaced_paths(self) -> dict[str, str]:
        """Path of every replaced value, and what it was."""
        return json.loads(self.replaced) if self.replaced else {}


@dataclass(frozen=True)
class Event:
    """Something noticed in a run; `data` is JSON text."""

    id: int
    run_id: int
    sim_time_s: float
    wall_time_s: float
    kind: str
    name: str | None
    data: str | None

    def details(self) -> Any:
        """What was noticed, decoded; None where nothing was added."""
        return json.loads(self.data) if self.data else None


_RUN_COLUMNS: Final = columns_of(Run)
_CURRENT_RUN: Final = f"SELECT {_RUN_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT 1"
_RUN_BY_ID: Final = f"SELECT {_RUN_COLUMNS} FROM run WHERE id = ?"
_RUNS_OF_ROBOT: Final = f"SELECT {_RUN_COLUMNS} FROM run WHERE robot_id = ? ORDER BY id"
_NEWEST_RUN_IDS: Final = (
    "SELECT id FROM run WHERE :robot_id IS NULL OR robot_id = :robot_id ORDER BY id DESC LIMIT 10"
)
_RUN_COUNT: Final = "SELECT count(*) FROM run WHERE robot_id = ?"
_STATE_COLUMNS: Final = columns_of(State)
# Of a crash only a kept stretch has the newest state; it has a negative id.
_NEWEST_STATE: Final = (
    "SELECT * FROM (SELECT * FROM (SELECT {columns} FROM state WHERE run_id = :run "
    "AND sim_time_s <= :until ORDER BY sim_time_s DESC, id DESC LIMIT 1) UNION ALL "
    "SELECT -id, {kept} FROM (SELECT {columns} FROM kept_state WHERE run_id = :run "
    "AND sim_time_s <= :until ORDER BY sim_time_s DESC, id DESC LIMIT 1)) "
    "ORDER BY sim_time_s DESC, wall_time_s DESC LIMIT 1"
).format(columns=_STATE_COLUMNS, kept=_STATE_COLUMNS.partition(", ")[2])
_CHUNKS_END: Final = (
    "SELECT max(end_sim_time_s) FROM row_group WHERE run_id = ? AND is_complete = 1"
)
_RECENT_TIMES: Final = (
    "SELECT sim_time_s, wall_time_s FROM state WHERE run_id = ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
# A blob is greater than any number or text: a time that is not a number is found too, and reported.
_LATER_THAN_ANY: Final = b"\xff"
PACE_ROWS: Final = 6
PACE_WINDOW_S: Final = 5.0
_PACE_WINDOW_ROWS: Final = 500
_SHOWN_KEYS: Final = 20
_SEARCHED_KEYS: Final = 1000  # for those like the one that is not there
_SHOWN_KEY_CHARACTERS: Final = 40
_EVENT_COLUMNS: Final = columns_of(Event)
_NEWEST_EVENTS: Final = (
    f"SELECT {_EVENT_COLUMNS} FROM event WHERE run_id = ? ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)


def current_run(connection: sqlite3.Connection, robot_id: int) -> Run | None:
    """The robot's newest run, going on or not."""
    row = connection.execute(_CURRENT_RUN, (robot_id,)).fetchone()
    return Run(*row) if row else None


def fetch_run(connection: sqlite3.Connection, run_id: int, robot_id: int | None = None) -> Run:
    """The run of that id.

    Args:
        connection: An open database.
        run_id: The run.
        robot_id: Whose run it has to be; None for anybody's.

    Raises:
        UnknownRunError: There is no such run, or it is another robot's.
    """
    row = connection.execute(_RUN_BY_ID, (run_id,)).fetchone()
    if row is None or robot_id not in (None, Run(*row).robot_id):
        raise UnknownRunError(_no_such_run(connection, run_id, robot_id))
    return Run(*row)


def runs_of(connection: sqlite3.Connection, robot_id: int) -> list[Run]:
    """All runs of the robot, oldest first."""
    return [Run(*row) for row in connection.execute(_RUNS_OF_ROBOT, (robot_id,)).fetchall()]


def count_runs(connection: sqlite3.Connection, robot_id: int) -> int:
    """How many runs of the robot were recorded."""
    return int(connection.execute(_RUN_COUNT, (robot_id,)).fetchone()[0])


def _no_such_run(connection: sqlite3.Connection, run_id: int, robot_id: int | None) -> str:
    ids = [row[0] for row in connection.execute(_NEWEST_RUN_IDS, {"robot_id": robot_id}).fetchall()]
    whose = "" if robot_id is None else " of this robot"
    known = f"the newest runs{whose} are {ids}" if ids else f"no run{whose} was recorded"
    return f"no run {run_id}{whose}: {known}"


def newest_state(connection: sqlite3.Connection, run_id: int) -> State | None:
    """The latest row of a run; None where retention has deleted it."""
    state = _state_up_to(connection, run_id, _LATER_THAN_ANY)
    if state is None or state.id > 0:
        return state
    (ended_s,) = connection.execute(_CHUNKS_END, (run_id,)).fetchone()
    return None if ended_s is not None and ended_s > state.sim_time_s else state


def state_at(connection: sqlite3.Connection, run_id: int, sim_time_s: float) -> State | None:
    """The latest row of a run up to that simulation time."""
    return _state_up_to(connection, run_id, sim_time_s)


def _state_up_to(connection: sqlite3.Connection, run_id: int, until: float | bytes) -> State | None:
    row = connection.execute(_NEWEST_STATE, {"run": run_id, "until": until}).fetchone()
    return State(*row) if row else None


def recent_interval_s(connection: sqlite3.Connection, run_id: int) -> float | None:
    """Median wall time between the latest rows of a run, in seconds; None with fewer than two."""
    times = connection.execute(_RECENT_TIMES, (run_id, PACE_ROWS)).fetchall()
    gaps = sorted(newer[1] - older[1] for newer, older in itertools.pairwise(times))
    return gaps[len(gaps) // 2] if gaps else None


def real_time_factor(connection: sqlite3.Connection, run_id: int) -> float | None:
    """Simulation time per wall time over the last few seconds that were recorded."""
    times = connection.execute(_RECENT_TIMES, (run_id, _PACE_WINDOW_ROWS)).fetchall()
    recent = [time for time in times if times[0][1] - time[1] <= PACE_WINDOW_S]
    if len(recent) < 2 or recent[0][1] <= recent[-1][1]:
        return None
    return (recent[0][0] - recent[-1][0]) / (recent[0][1] - recent[-1][1])


def select(value: Any, path: str) -> Any:
    """The part of a state at a dotted path; `""` is all of it.

    Raises:
        InvalidInputError: Nothing is there; the text names the part that is missing.
    """
    parts = path.split(".") if path else []
    while parts:
        key, taken = _key(value, parts, path)
        value, parts = value[key], parts[taken:]
    return value


def _key(value: Any, parts: list[str], path: str) -> tuple[str | int, int]:
    """The key or index that the path starts with, and how many of its parts that takes.

    A key may itself hold dots, so the longest one that fits is taken.
    """
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        for taken in range(len(parts), 0, -1):
            if (key := ".".join(parts[:taken])) in members:
                return key, taken
        near = nearest_first(parts[0], itertools.islice(members, _SEARCHED_KEYS))[:_SHOWN_KEYS]
        known = [key[:_SHOWN_KEY_CHARACTERS] for key in near]
        raise InvalidInputError(f"path {path!r}: there is no {parts[0]!r}; there are {known}")
    if isinstance(value, list):
        items = cast("list[Any]", value)
        if parts[0].isdecimal() and int(parts[0]) < len(items):
            return int(parts[0]), 1
        raise InvalidInputError(f"path {path!r}: {len(items)} items have no index {parts[0]!r}")
    raise InvalidInputError(f"path {path!r}: {parts[0]!r} is below a single value")


def put_back(value: Any, parts: list[str], replaced: object) -> None:
    """Put what was replaced (or its kind) where null stands for it; a value that was kept stays.

    The last part `*` stands for every null in an array.
    """
    if parts == ["*"] and isinstance(value, list):
        value[:] = [replaced if item is None else item for item in cast("list[Any]", value)]
        return
    try:
        key, taken = _key(value, parts, "")
    except InvalidInputError:  # the path leads to what was replaced as a whole
        return
    if taken < len(parts):
        put_back(value[key], parts[taken:], replaced)
    elif value[key] is None:
        value[key] = replaced


def newest_events(connection: sqlite3.Connection, run_id: int, limit: int) -> list[Event]:
    """The latest events of a run, oldest first; with a limit of -1 all of them."""
    rows = connection.execute(_NEWEST_EVENTS, (run_id, limit)).fetchall()
    return [Event(*row) for row in reversed(rows)]
