"""What the page shows: each question opens the recording anew, and cannot write."""

from __future__ import annotations

import base64
import io
import json
import logging
import math
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final, TypeVar

from webots_mcp.errors import (
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownRunError,
    UnknownSignalError,
    WebotsMCPError,
)
from webots_mcp.judging.checks import check_run
from webots_mcp.plotting import changed_most
from webots_mcp.plotting.on_a_page import ROOM, signals_figure, way_figure
from webots_mcp.plotting.signals import SignalAxes, compose_signals
from webots_mcp.plotting.trajectory import Obstacle, PlottedPath, TrajectoryAxes, compose_trajectory
from webots_mcp.plugins.report.making import obstacles_of
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.logs import LogFilter, LogLine, LogWindow, newest_lines
from webots_mcp.store.parameters import described
from webots_mcp.store.reading.catalogue import catalogue, known_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, recorded_bounds
from webots_mcp.store.recording import RecordingAccess, RobotView, view_of
from webots_mcp.store.robots import RUNNING, list_robots, nothing_recorded, without_observers
from webots_mcp.store.run_rows import StoredImage, current_run, fetch_run, newest_image, opened
from webots_mcp.store.runs import RunInfo, list_runs

Axes = TypeVar("Axes", SignalAxes, TrajectoryAxes)

MOST_RUNS: Final = 100  # to choose from
MOST_LINES: Final = 200  # of the log
MOST_NAMES: Final = 2000  # of signals to choose from
MOST_ROBOTS: Final = 10  # on one map
_log: Final = logging.getLogger(__name__)
MOST_LIGHTS: Final = 20  # of the newest runs that are over
_LIGHT_S: Final = 1.0  # for the checks of one
_LONGEST_LINE: Final = 1000  # characters of a log line
_SETTLED_S: Final = 5.0  # of simulation time tell which signals change
_SIDE_PX: Final = 640
_JPEG_QUALITY: Final = 80
_LEVELS: Final = {"warning": "warning", "error": "error", "critical": "error"}
_DEFECT: Final = (
    "a defect of webots-mcp, or rows that it did not write; webots-mcp view has written more about "
    "it to its terminal"
)
# Of runs that are over, by database and run: nothing that a check looks at changes any more.
_LIGHTS: Final[dict[tuple[str, int, float], str]] = {}
_OF_OUTCOME: Final = {"fail": "🔴", "warn": "🟡", "pass": "🟢"}
_NO_OUTCOME: Final = "⚪"  # not judged yet, or not to be judged


@dataclass(frozen=True)
class Choice:
    """What a page is asked to show.

    Attributes:
        robot: None for the only one, or the first of those that live.
        run_id: None for the newest run, whichever that is.
        beside_id: A run that is laid over the other; None for none.
        names: Signals; None for those that changed most.
        panels: The signals of each panel; None for those of one unit and scale together.
        window_s: The last so many simulated seconds; None for the whole run.
        view: What part of the time is zoomed to.
        all_robots: Whether the map shows the newest runs of all robots.
        width_px: Of the signals; of the map `side_px`.
        height_px: What the signals may fill.
    """

    robot: str | None = None
    run_id: int | None = None
    beside_id: int | None = None
    names: tuple[str, ...] | None = None
    panels: tuple[tuple[str, ...], ...] | None = None
    window_s: float | None = None
    view: tuple[float, float] | None = None
    all_robots: bool = False
    width_px: int = 700
    side_px: int = 330
    height_px: int = 500


def choice_of(asked: Mapping[str, str]) -> Choice:
    """What a request asks for, in its parameters.

    Raises:
        InvalidInputError: A parameter is none.
    """
    try:
        names, panels, view = (
            json.loads(asked.get(name) or "null") for name in ("signals", "panels", "view")
        )
        return Choice(
            robot=asked.get("robot") or None,
            run_id=int(asked["run"]) if asked.get("run") else None,
            beside_id=int(asked["beside"]) if asked.get("beside") else None,
            names=tuple(map(str, names)) if names else None,
            panels=tuple(tuple(map(str, each)) for each in panels) if panels else None,
            window_s=float(asked["window"]) if asked.get("window") else None,
            view=(float(view[0]), float(view[1])) if view else None,
            all_robots=bool(asked.get("all")),
            width_px=min(max(int(asked.get("width") or 700), 300), 4000),
            side_px=min(max(int(asked.get("side") or 330), 250), 4000),
            height_px=min(max(int(asked.get("height") or 500), 0), 4000),
        )
    except (ValueError, TypeError, IndexError, KeyError) as error:
        raise InvalidInputError(f"the page asked for what cannot be read: {error}") from error


# How the robot is ---------------------------------------------------------------------------------


def look(recording: RecordingAccess, choice: Choice, *, steers: bool) -> dict[str, Any]:
    """The status of the robot and the run that are chosen, and what else there is to choose.

    Raises:
        WebotsMCPError: There is no such recording, robot or run.
    """
    with recording.reader() as connection:
        robots = without_observers(list_robots(connection, time.time()))
        view = _view(connection, choice)
        run, header = view.run, view.header()
        is_newest = run == current_run(connection, view.robot.id)
        image = newest_image(connection, run.id) if run else None
        asked = LogFilter(run.id if run else None, LogWindow(-math.inf, math.inf),
                          robot_id=view.robot.id)  # fmt: skip
        runs = list_runs(connection, robot=view.robot.name, limit=MOST_RUNS).runs
        settable = steers and is_newest
        return _status(header) | {
            "robot": view.robot.name,
            "run": run.id if run else None,
            "started": run.started_wall_time_s if run else None,
            "until": header["sim_time_s"],
            "robots": [robot.name for robot in robots],
            "runs": _with_lights(recording, runs),
            "names": list(catalogue(connection, view.subject))[:MOST_NAMES] if run else [],
            "lines": [_line(each) for each in newest_lines(connection, asked, MOST_LINES)],
            "parameters": [_parameter(each) for each in described(connection, run)] if run else [],
            "settable": settable,
            "picture": image.id if image else None,
        }


def _view(connection: sqlite3.Connection, choice: Choice) -> RobotView:
    now_s = time.time()
    robots = without_observers(list_robots(connection, now_s))
    if not robots:
        raise NothingRecordedError(nothing_recorded(connection))
    named = [robot for robot in robots if robot.name == choice.robot]
    if choice.robot is not None and not named:
        raise UnknownRobotError(f"robot {choice.robot!r} is not in this database")
    (robot, *_) = named or [robot for robot in robots if robot.live] or robots
    run = fetch_run(connection, choice.run_id, robot.id) if choice.run_id is not None else None
    return view_of(connection, robot, now_s, run)


def _status(header: Mapping[str, Any]) -> dict[str, Any]:
    """Whether the robot's time is moving, and how old what is shown is."""
    text = "no data yet"
    if header["sim_time_s"] is not None:
        text = f"simulation time {header['sim_time_s']:.2f} s, {header['age_s']:.1f} s old"
    run = f"run {header['run_id']}, " if header["run_id"] is not None else ""
    kind = "running" if header["status"] == RUNNING else "standing"
    return {"pill": header["status"], "kind": kind, "text": run + text, "why": header["why"] or ""}


def problem(error: Exception) -> dict[str, Any]:
    """Why nothing can be read now; `unknown` are the choices that are no more to be made."""
    waits = isinstance(error, (NoDatabaseError, NothingRecordedError))
    why = str(error)
    if not isinstance(error, WebotsMCPError):
        why = f"{_DEFECT} ({type(error).__name__}: {why[:_LONGEST_LINE]})"
    unknown: list[str] = []
    if waits or isinstance(error, (UnknownRobotError, UnknownRunError)):
        unknown = ["run", "beside", "view", "at"]
    if isinstance(error, UnknownRobotError):  # another database has taken the place
        unknown += ["robot", "signals", "panels"]
    return {
        "pill": "nothing recorded yet" if waits else "cannot be read",
        "kind": "standing" if waits else "problem",
        "text": spelled_out(why), "why": "", "unknown": unknown,
    }  # fmt: skip


def run_title(run: RunInfo) -> str:
    """A run in a list: its number, label, begin and length."""
    label = f" “{spelled_out(run.label)}”" if run.label else ""
    began = datetime.fromtimestamp(run.started_wall_time_s).strftime("%d %b %H:%M:%S")
    return f"run {run.run_id}{label} · {began} · {run.duration_s:.1f} s"


_judges: Final = ThreadPoolExecutor(1, "webots-mcp lights")  # no look waits for a check


def _with_lights(recording: RecordingAccess, runs: Sequence[RunInfo]) -> list[dict[str, Any]]:
    """The runs to choose from; behind those that are over a light, which a check gives them."""
    choices: list[dict[str, Any]] = []
    lights = 0
    for run in runs:
        title = run_title(run)
        if run.end_reason and lights < MOST_LIGHTS:
            lights += 1
            key = (str(recording.database), run.run_id, run.started_wall_time_s)
            if key not in _LIGHTS:
                _LIGHTS[key] = _NO_OUTCOME
                _judges.submit(_judge, recording, key)
            title += f" {_LIGHTS[key]}"
        choices.append({"id": run.run_id, "title": title})
    return choices


def _judge(recording: RecordingAccess, key: tuple[str, int, float]) -> None:
    """Check a run; one that cannot be read now is judged at another look."""
    try:
        with recording.reader() as connection:
            outcome = check_run(connection, key[1], deadline_s=_LIGHT_S).outcome
        _LIGHTS[key] = _OF_OUTCOME.get(outcome, _NO_OUTCOME)
    except (WebotsMCPError, sqlite3.Error):
        del _LIGHTS[key]
    except Exception:  # noqa: BLE001  (no look of the page waits for it, to say so)
        _log.exception("run %d cannot be judged", key[1])


def _line(line: LogLine) -> dict[str, str]:
    at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
    message = spelled_out(line.message[:_LONGEST_LINE])
    kind = _LEVELS.get(line.level, "plain")
    return {"at": at, "level": spelled_out(line.level), "kind": kind, "message": message}


def _parameter(parameter: Mapping[str, Any]) -> dict[str, Any]:
    """Its name, value and choices, and a title with its unit and bounds."""
    low, high = parameter["low"], parameter["high"]
    unit = f" [{parameter['unit']}]" if parameter["unit"] else ""
    bounds = "" if low is None and high is None else f" ({_bound(low)} to {_bound(high)})"
    kept = {name: parameter[name] for name in ("name", "value", "choices")}
    return kept | {"title": spelled_out(f"{parameter['name']}{unit}{bounds}")}


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"


def picture(recording: RecordingAccess, choice: Choice) -> dict[str, Any]:
    """The newest picture of a run as part of the page itself, and what it is."""
    with recording.reader() as connection:
        run = _view(connection, choice).run
        image: StoredImage | None = newest_image(connection, run.id) if run else None
    if image is None:
        return {"uri": None, "caption": "no picture recorded yet"}
    caption = spelled_out(f"{image.device or image.kind} at {image.sim_time_s:.3f} s")
    try:
        data = base64.b64encode(_as_jpeg(image.file(recording.data_dir))).decode("ascii")
    except WebotsMCPError as error:
        return {"uri": None, "caption": f"{caption}: {spelled_out(str(error))}"}
    return {"uri": f"data:image/jpeg;base64,{data}", "caption": caption}


def _as_jpeg(file: Path) -> bytes:
    buffer = io.BytesIO()
    with opened(file) as stored:
        scaled: Any = stored.convert("RGB")
        scaled.thumbnail((_SIDE_PX, _SIDE_PX))
        scaled.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return buffer.getvalue()


# Figures ------------------------------------------------------------------------------------------


def draw(recording: RecordingAccess, choice: Choice) -> dict[str, Any]:
    """The figures of a run as markup, None where there is nothing to draw, and notes."""
    with recording.reader() as connection:
        view = _view(connection, choice)
        run = view.require_run()
        try:
            ranges = _ranges(connection, view.robot.name, run.id, choice)
        except NothingRecordedError as error:
            return _nothing(str(error))
        known = known_signals(connection, ranges[0])
        chosen = choice.names or tuple(name for each in choice.panels or () for name in each)
        names = [name for name in chosen if name in known]
        names = names or changed_most(connection, ranges[0])
        signals, notes = _composed(
            lambda: compose_signals(connection, ranges, names, room=ROOM, grouped=choice.panels)
        )
        if choice.all_robots:
            way, of_way = _composed(lambda: _all_ways(connection))
        else:
            way, of_way = _composed(lambda: compose_trajectory(connection, ranges))
        standing: Sequence[Obstacle] = obstacles_of(connection, ranges) if way else ()
        drawn = _nothing(*dict.fromkeys((*notes, *of_way)))
        if signals:
            wide, high = choice.width_px, choice.height_px
            drawn["signals"] = signals_figure(signals, width_px=wide, height_px=high).markup
        if way:
            side = choice.side_px
            drawn["way"] = way_figure(way, (), standing, width_px=side, height_px=side).markup
        length_s = signals.x_range[1] - signals.x_range[0] if signals else 0.0
        bounds = None if choice.beside_id else recorded_bounds(connection, run.id)
        return drawn | {
            "names": names,
            "settled": length_s > _SETTLED_S,
            "is_cut": bool(signals and signals.unread)
            or any(not track.path.is_whole for track in (way.tracks if way else ())),
            "bounds": bounds,
        }


def _nothing(*notes: str) -> dict[str, Any]:
    shown = [spelled_out(note) for note in notes]
    return {"signals": None, "way": None, "notes": shown, "names": [], "settled": False,
            "is_cut": False, "bounds": None}  # fmt: skip


def _composed(compose: Callable[[], tuple[Axes, tuple[str, ...]]]) -> tuple[Axes | None, list[str]]:
    """What was composed, and its notes; where there is nothing to draw, why."""
    try:
        axes, notes = compose()
        return axes, list(notes)
    except (InvalidInputError, NothingRecordedError, UnknownSignalError) as error:
        return None, [str(error)]


def _ranges(
    connection: sqlite3.Connection, robot: str, run_id: int, choice: Choice
) -> list[TimeRange]:
    scope = Scope(robot=robot, run_id=run_id)
    if choice.beside_id not in (None, run_id):
        beside = replace(scope, run_id=choice.beside_id)
        return [find_range(connection, scope), find_range(connection, beside)]
    if choice.view is not None:
        scope = replace(scope, start_s=max(0.0, choice.view[0]), end_s=max(0.0, choice.view[1]))
    else:
        scope = replace(scope, last_s=choice.window_s)
    return [find_range(connection, scope)]


def _all_ways(connection: sqlite3.Connection) -> tuple[TrajectoryAxes, tuple[str, ...]]:
    """The ways of the newest runs of all robots on one map."""
    tracks: list[PlottedPath] = []
    found: TrajectoryAxes | None = None
    notes: list[str] = []
    robots = without_observers(list_robots(connection, time.time()))
    for robot in robots[:MOST_ROBOTS]:
        try:
            whole = find_range(connection, Scope(robot=robot.name))
            found, of_robot = compose_trajectory(connection, [whole], events=False)
        except (InvalidInputError, NothingRecordedError, UnknownSignalError) as error:
            notes.append(f"{robot.name}: {error}")
            continue
        notes += [f"{robot.name}: {note}" for note in of_robot]
        tracks += [replace(each, name=robot.name, modes=None) for each in found.tracks]
    if len(robots) > MOST_ROBOTS:
        notes.append(f"the map shows {MOST_ROBOTS} of {len(robots)} robots")
    if found is None:
        raise NothingRecordedError("; ".join(notes))
    return replace(found, title="all robots", tracks=tracks, mode=None), tuple(notes)
