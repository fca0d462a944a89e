"""What a tab reads: each look opens the recording anew, on a connection that cannot write."""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.errors import (
    InvalidInputError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownSignalError,
)
from webots_mcp.naming import Value, spelled_out
from webots_mcp.plotting.question import changed_most
from webots_mcp.plotting.signal_axes import SignalAxes
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory, position_of
from webots_mcp.plotting.trajectory_axes import TrajectoryAxes
from webots_mcp.plugins.page.choice import Choice
from webots_mcp.plugins.report.charts.obstacles import Obstacle, obstacles_of
from webots_mcp.plugins.report.charts.signal_panels import ROOM
from webots_mcp.store.logs import LogFilter, LogLine, Window, newest_lines
from webots_mcp.store.parameters import described
from webots_mcp.store.questions.runs import RunInfo, list_runs
from webots_mcp.store.reading.catalogue import catalogue, known_signals
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.recording import Recording, View, view_of
from webots_mcp.store.robots import list_robots, without_observers
from webots_mcp.store.run_rows import Run, StoredImage, current_run, fetch_run, newest_image
from webots_mcp.store.signals import Signal

Axes = TypeVar("Axes", SignalAxes, TrajectoryAxes)

MOST_RUNS: Final = 100  # to choose from
MOST_LINES: Final = 200  # of the log
MOST_ROWS: Final = 2000  # in one look; a tab that fell behind draws anew
MOST_NAMES: Final = 300  # of signals to choose from
_LOOK_S: Final = 2.0  # of reading new rows, at most


class RunKey(NamedTuple):
    """Which run it is, also where another database has taken the place of the one before."""

    run_id: int
    started_wall_time_s: float


class NewRows(NamedTuple):
    """Rows that have come since a moment: their simulation times, and the values of each signal."""

    times: list[float]
    values: dict[str, list[Value]]


@dataclass(frozen=True)
class Look:
    """A robot and its run, now.

    Attributes:
        header: What every answer of the tools begins with.
        run: The run that is shown; None where the robot has none.
        is_newest: Whether it is the robot's newest.
    """

    robot: str
    header: dict[str, Any]
    run: Run | None
    is_newest: bool

    @property
    def key(self) -> RunKey | None:
        """Which run it is."""
        return RunKey(self.run.id, self.run.started_wall_time_s) if self.run else None


@dataclass(frozen=True)
class Surroundings:
    """What changes seldom, or need not be seen at once.

    Attributes:
        names: The signals of the robot.
    """

    robots: tuple[str, ...]
    runs: tuple[RunInfo, ...]
    names: tuple[str, ...]
    lines: tuple[LogLine, ...]
    picture: StoredImage | None
    parameters: tuple[dict[str, Any], ...]


@dataclass(frozen=True)
class Drawing:
    """What the figures are made of; None, and a note, where there is nothing to draw.

    Attributes:
        names: The signals, also where the choice was left open.
        read: How each signal that is drawn is read from a row, that of the mode too.
        position: The names of x and y, where there is a way.
        took_s: Wall seconds that it took to gather.
    """

    names: tuple[str, ...]
    read: tuple[Signal, ...]
    position: tuple[str, str] | None
    signals: SignalAxes | None
    way: TrajectoryAxes | None
    obstacles: tuple[Obstacle, ...]
    notes: tuple[str, ...]
    took_s: float

    @property
    def is_cut(self) -> bool:
        """Whether there was no time to read all of it."""
        ways = self.way.tracks if self.way else ()
        return bool(self.signals and self.signals.unread) or any(
            not track.path.is_whole for track in ways
        )


def look(recording: Recording, choice: Choice) -> Look:
    """The robot and the run that are chosen, and how they are.

    Raises:
        WebotsMCPError: There is no such recording, robot or run.
    """
    with recording.reader() as connection:
        view = _view(connection, choice)
        newest = current_run(connection, view.robot.id)
        return Look(view.robot.name, view.header(), view.run, view.run == newest)


def _view(connection: sqlite3.Connection, choice: Choice) -> View:
    now_s = time.time()
    robots = without_observers(list_robots(connection, now_s))
    if not robots:
        raise NothingRecordedError("no robot has been recorded in this database yet")
    named = [robot for robot in robots if robot.name == choice.robot]
    if choice.robot is not None and not named:
        raise UnknownRobotError(f"robot {choice.robot!r} is not in this database")
    (robot, *_) = named or [robot for robot in robots if robot.live] or robots
    run = fetch_run(connection, choice.run_id, robot.id) if choice.run_id is not None else None
    return view_of(connection, robot, now_s, run)


def look_around(recording: Recording, shown: Look) -> Surroundings:
    """What else there is of a robot and a run."""
    with recording.reader() as connection:
        robots = without_observers(list_robots(connection, time.time()))
        view = _view(connection, Choice(shown.robot, shown.run.id if shown.run else None))
        run = view.run
        names = list(catalogue(connection, view.subject)) if run else []
        whole = Window(-math.inf, math.inf)
        asked = LogFilter(run.id if run else None, whole, robot_id=view.robot.id)
        return Surroundings(
            robots=tuple(robot.name for robot in robots),
            runs=list_runs(connection, robot=shown.robot, limit=MOST_RUNS).runs,
            names=tuple(names[:MOST_NAMES]),
            lines=tuple(newest_lines(connection, asked, MOST_LINES)),
            picture=newest_image(connection, run.id) if run else None,
            parameters=tuple(described(connection, run)) if run else (),
        )


def gather(recording: Recording, shown: Look, choice: Choice) -> Drawing:
    """Read what is to be drawn of the run."""
    started_s = time.monotonic()
    with recording.reader() as connection:
        try:
            ranges = _ranges(connection, shown, choice)
        except NothingRecordedError as error:
            return Drawing((), (), None, None, None, (), (str(error),), 0.0)
        known = known_signals(connection, ranges[0])
        names = tuple(name for name in choice.names or () if name in known)
        names = names or tuple(changed_most(connection, ranges[0]))
        signals, notes = _composed(lambda: compose_signals(connection, ranges, names, room=ROOM))
        way, of_way = _composed(lambda: compose_trajectory(connection, ranges))
        position = position_of(connection, known, ranges[-1]) if way else None
        return Drawing(
            names=names,
            read=_read(known, signals, way, position),
            position=(position[0].name, position[1].name) if position else None,
            signals=signals,
            way=way,
            obstacles=obstacles_of(connection, ranges) if way else (),
            notes=tuple(dict.fromkeys((*notes, *of_way))),
            took_s=time.monotonic() - started_s,
        )


def _composed(compose: Callable[[], tuple[Axes, tuple[str, ...]]]) -> tuple[Axes | None, list[str]]:
    """What was composed, and its notes; where there is nothing to draw, why."""
    try:
        axes, notes = compose()
        return axes, list(notes)
    except (InvalidInputError, NothingRecordedError, UnknownSignalError) as error:
        return None, [str(error)]


def _read(
    known: dict[str, Signal],
    signals: SignalAxes | None,
    way: TrajectoryAxes | None,
    position: tuple[Signal, Signal] | None,
) -> tuple[Signal, ...]:
    names = [signal.name for signal in position or ()]
    if signals:
        names += [name for panel in signals.panels for name in panel.names]
        names += [lane.name for lane in signals.lanes]
        names += [signals.bands.name] if signals.bands else []
    names += [way.mode] if way and way.mode else []
    return tuple(known[name] for name in dict.fromkeys(names) if name in known)


def _ranges(connection: sqlite3.Connection, shown: Look, choice: Choice) -> list[TimeRange]:
    assert shown.run is not None, "looked at first"
    scope = Scope(robot=shown.robot, run_id=shown.run.id, last_s=choice.window_s)
    ranges = [find_range(connection, scope)]
    if choice.beside_id not in (None, shown.run.id):
        whole = replace(scope, run_id=choice.beside_id, last_s=None)
        ranges = [
            find_range(connection, replace(scope, last_s=None)),
            find_range(connection, whole),
        ]
    return ranges


def rows_after(
    recording: Recording, run_id: int, signals: Sequence[Signal], after_s: float
) -> NewRows:
    """The rows of a run that have come since a simulation time."""
    segment = Segment(run_id, math.nextafter(after_s, math.inf), math.inf)
    with recording.reader() as connection:
        frame = read_frame(connection, segment, Deadline(_LOOK_S)).rows(0, MOST_ROWS)
        values = {signal.name: frame.values(signal.name) for signal in signals}
        return NewRows(frame.times.tolist(), values)


def run_title(run: RunInfo) -> str:
    """A run in a list: its number, label, begin and length."""
    label = f" “{spelled_out(run.label)}”" if run.label else ""
    began = datetime.fromtimestamp(run.started_wall_time_s).strftime("%d %b %H:%M:%S")
    return f"run {run.run_id}{label} · {began} · {run.duration_s:.1f} s"
