"""Provide the pose that an observer saw for a robot that publishes no position of its own.

A robot with a bridge records what it knows of itself, and a plain `Robot` without a GPS does not
know where it is. An observer in the same simulation does. Its poses of that robot become signals of
the robot, `observer.x_m` and so on. So each question about the robot has a position and shows its
source. Nothing is copied in the recording: the poses are read from the observer's run and
interpolated linearly between two of its rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, median, np
from webots_mcp.contract import OBSERVER, WORLD_EVENT
from webots_mcp.signals.naming import OBSERVED, WORLD, find_position
from webots_mcp.signals.register import kind_of, unit_of
from webots_mcp.store.chunks import IS_ABSENT, IS_NUMBER, Decoded, StateColumns, signals_in
from webots_mcp.store.registered_signals import RegisteredSignal, registered, seen_with, with_roles

Derived = Mapping[str, Callable[[Array], Decoded]]
"""Signals that no row of a run holds, by name: their values at some simulation times."""

MARGIN_S: Final = 1.0  # rows of the observer before and after the requested time
_ANGLES: Final = ("heading_rad", "roll_rad", "pitch_rad")
_PARTS: Final = ("x_m", "y_m", "z_m", *_ANGLES)


@dataclass(frozen=True)
class ObservedGaps:
    """How far apart the rows of an observer may be.

    Attributes:
        longest_s: Simulation time between two rows between which poses are interpolated.
        intervals: The same in usual intervals, for an observer that records less often.
    """

    longest_s: float = 1.0
    intervals: float = 3.0


_GAPS: Final = ObservedGaps()


class ObservedRobot(NamedTuple):
    """A robot as an observer calls it.

    Attributes:
        observer: The name of the observer.
        run_id: Its run.
        key: The robot's name in the observer's signals: `world.KEY.x_m`.
    """

    observer: str
    run_id: int
    key: str


def find_observed(
    connection: sqlite3.Connection, run_id: int, columns: StateColumns
) -> ObservedRobot | None:
    """Return how an observer saw the robot of a run that holds no position of its own.

    Args:
        connection: Any.
        run_id: The robot's run.
        columns: Its rows that are in no chunk.

    Returns:
        None if the run has a position, or no observer saw the robot during it.
    """
    if (
        connection.execute(f"SELECT 1 FROM robot WHERE kind = '{OBSERVER}' LIMIT 1").fetchone()
        is None
    ):
        return None
    # The observer's run that lasted longest at the same time, in the same simulation.
    row = connection.execute(
        "SELECT b.name, o.id, own.name FROM run r JOIN robot own ON own.id = r.robot_id "
        "JOIN session me ON me.id = r.session_id JOIN session s ON s.instance = me.instance "
        f"JOIN robot b ON b.id = s.robot_id AND b.kind = '{OBSERVER}' "
        "JOIN run o ON o.session_id = s.id "
        f"WHERE r.id = ? AND own.kind <> '{OBSERVER}' "
        "AND o.started_wall_time_s <= r.last_wall_time_s "
        "AND o.last_wall_time_s >= r.started_wall_time_s "
        "ORDER BY min(o.last_wall_time_s, r.last_wall_time_s) "
        "- max(o.started_wall_time_s, r.started_wall_time_s) DESC, o.id DESC LIMIT 1",
        (run_id,),
    ).fetchone()
    if row is None or _has_position(connection, run_id, columns):
        return None
    observer, observer_run_id, name = row
    asked = {"run": observer_run_id, "name": name}
    # The newest description of the world that contains the robot; a name is omitted if it equals
    # the key.
    key, count = connection.execute(
        "SELECT min(r.value ->> '$.key'), count(*) FROM event e, "
        "json_each(CASE WHEN json_valid(e.data) THEN e.data ELSE '{}' END, '$.robots') r "
        "WHERE e.run_id IN (SELECT id FROM run WHERE session_id = "
        f"(SELECT session_id FROM run WHERE id = :run)) AND e.kind = '{WORLD_EVENT}' "
        "AND e.run_id <= :run "
        "AND coalesce(r.value ->> '$.name', r.value ->> '$.key') = :name "
        "GROUP BY e.id ORDER BY e.id DESC LIMIT 1",
        asked,
    ).fetchone() or (None, 0)
    return ObservedRobot(observer, observer_run_id, str(key)) if count == 1 else None


def _has_position(connection: sqlite3.Connection, run_id: int, columns: StateColumns) -> bool:
    (robot_id,) = connection.execute("SELECT robot_id FROM run WHERE id = ?", (run_id,)).fetchone()
    known = seen_with(registered(connection, robot_id), robot_id, columns)
    stored = signals_in(connection, run_id)
    held = [
        name
        for name, signal in known.items()
        if signal.is_number and signal.kind != "null"
        if signal.id in stored or name in columns.values
    ]
    return find_position(held) is not None


def with_observed_pose(
    connection: sqlite3.Connection,
    robot_id: int,
    known: dict[str, RegisteredSignal],
    runs: Iterable[tuple[int, StateColumns]],
) -> dict[str, RegisteredSignal]:
    """Add the pose by an observer to what is known of a robot, where a run has only that.

    Args:
        connection: An open database.
        robot_id: The robot.
        known: Its own signals.
        runs: Runs of the robot, each with its rows that are in no chunk.
    """
    if not any(find_observed(connection, run_id, columns) for run_id, columns in runs):
        return known
    added = {name: _signal(robot_id, name) for name in map(_name_of, _PARTS) if name not in known}
    return with_roles({**known, **added})


def _signal(robot_id: int, name: str) -> RegisteredSignal:
    kind = kind_of(name, 0.5, ends_pose=False)
    return RegisteredSignal(None, robot_id, name, kind, unit_of(name, kind), "", None)


def _name_of(part: str) -> str:
    return f"{OBSERVED}.{part}"


def poses_of(key: str, usable: Callable[[str], tuple[Array, Array]]) -> Derived:
    """Return the pose of a robot at any time, by the rows in which an observer saw it.

    Args:
        key: The robot's word in the observer's signals.
        usable: Times and values of a signal of the observer, as `Frame.usable` gives them.
    """

    def of(part: str) -> Callable[[Array], Decoded]:
        name = f"{WORLD}.{key}.{part}"
        return lambda times: _decoded(_between(*usable(name), times, turns=part in _ANGLES))

    return {_name_of(part): of(part) for part in _PARTS}


def pose_at(derived: Derived, sim_time_s: float) -> dict[str, float]:
    """Return the pose at a time, by the last part of the names; empty where it is not known."""
    at: Array = np.array([sim_time_s])
    found = {name.rpartition(".")[2]: value(at).numbers.item() for name, value in derived.items()}
    return {part: value for part, value in found.items() if not np.isnan(value)}


def _between(seen_s: Array, values: Array, times: Array, *, turns: bool) -> Array:
    """Interpolate values between observed times; NaN if none was observed near enough.

    Before the first and after the last one, the value holds for the usual interval.
    """
    if not len(seen_s):
        return np.full(len(times), np.nan)
    usual_s = median(np.diff(seen_s)) if len(seen_s) > 1 else 0.0
    longest_s = max(_GAPS.longest_s, _GAPS.intervals * usual_s)
    if turns:
        values = np.unwrap(values)
    found: Array = np.interp(times, seen_s, values)
    after = np.searchsorted(seen_s, times)
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(seen_s) - 1)
    is_far = (seen_s[after] - seen_s[before] > longest_s) & (seen_s[after] != times)
    is_outside = (times < seen_s[0] - usual_s) | (times > seen_s[-1] + usual_s)
    found[is_far | is_outside] = np.nan
    return np.arctan2(np.sin(found), np.cos(found)) if turns else found


def _decoded(values: Array) -> Decoded:
    is_absent = np.isnan(values)
    codes = np.where(is_absent, IS_ABSENT, IS_NUMBER) if is_absent.any() else None
    return Decoded(values, codes, ())
