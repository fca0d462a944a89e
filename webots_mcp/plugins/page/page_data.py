"""The data that the page shows. No request can write."""

from __future__ import annotations

import base64
import io
import json
import math
import sqlite3
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

from webots_mcp.database.pause_states import PAUSED
from webots_mcp.errors import (
    InvalidInputError,
    NoDatabaseError,
    NothingRecordedError,
    UnknownRobotError,
    UnknownRunError,
    UnknownSignalError,
    WebotsMCPError,
)
from webots_mcp.extras.requirements import quoted
from webots_mcp.plotting import changed_most
from webots_mcp.plotting.interactive_svg import ROOM, signals_figure, way_figure
from webots_mcp.plotting.signal_plot import SignalAxes, compose_signals
from webots_mcp.plotting.trajectory import Obstacle, PlottedPath, TrajectoryAxes, compose_trajectory
from webots_mcp.plugins.clip.clip import make_clip
from webots_mcp.plugins.clip.moment import moment_at, newest_moment
from webots_mcp.plugins.page.run_list import LIMITS as RUN_LIMITS
from webots_mcp.plugins.page.run_list import listed_runs, run_choices
from webots_mcp.plugins.report.controller_variables import shown_variables
from webots_mcp.plugins.report.obstacles import obstacles_of, with_bodies
from webots_mcp.signals.naming import flatten, spelled_out
from webots_mcp.store.chunks import parse
from webots_mcp.store.inspections import inspections_of
from webots_mcp.store.logs import LogFilter, LogLine, LogWindow, newest_lines
from webots_mcp.store.meanings import meanings_of
from webots_mcp.store.reading.catalogue import catalogue, known_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, recorded_bounds
from webots_mcp.store.recording import RecordingAccess, RobotView, view_of
from webots_mcp.store.relative_times import age_in_words
from webots_mcp.store.robot_status import RUNNING
from webots_mcp.store.robots import list_robots, nothing_recorded, without_observers
from webots_mcp.store.run_parameters import described
from webots_mcp.store.run_rows import (
    StoredImage,
    camera_frames,
    current_run,
    fetch_run,
    newest_image,
    newest_state,
    opened,
)
from webots_mcp.store.runs import list_runs

_LEVELS: Final = {"warning": "warning", "error": "error", "critical": "error"}


@dataclass(frozen=True)
class _PageLimits:
    """Limits of the data that the page shows."""

    log_lines: int = 200
    """Lines of the log."""
    line_characters: int = 1000
    """Characters of a log line or an error."""
    signal_names: int = 2000
    """Names of signals to choose from."""
    value_characters: int = 40
    """Characters of a text that is shown next to the name of its signal."""
    robots: int = 10
    """Robots on one map."""
    settled_s: float = 5.0
    """Simulation time after which the signals that change are known."""
    picture_px: int = 640
    """Longest side of the picture."""
    jpeg_quality: int = 80
    """Quality of the picture, 1 to 100."""


_LIMITS: Final = _PageLimits()

Axes = TypeVar("Axes", SignalAxes, TrajectoryAxes)


@dataclass(frozen=True)
class PageRequest:
    """A request of the page: what it wants to show.

    Attributes:
        robot: Name of the robot; None for the only one, or the first that is running.
        run_id: Id of the run; None for the newest run.
        beside_id: Id of a second run to draw over the first; None for no second run.
        names: Names of signals; None for the signals that changed most.
        panels: Signals of each panel; None to group signals of one unit and scale.
        window_s: Length of the shown end of the run in simulated seconds; None for the whole run.
        view: Start and end of the zoomed time range.
        all_robots: Whether the map shows the newest runs of all robots.
        at_s: Simulation time of the cursor; None for the newest picture.
        width_px: Width of the signals.
        side_px: Side length of the map.
        height_px: Height that the signals may fill.
    """

    robot: str | None = None
    run_id: int | None = None
    beside_id: int | None = None
    names: tuple[str, ...] | None = None
    panels: tuple[tuple[str, ...], ...] | None = None
    window_s: float | None = None
    view: tuple[float, float] | None = None
    all_robots: bool = False
    at_s: float | None = None
    width_px: int = 700
    side_px: int = 330
    height_px: int = 500


def page_request(asked: Mapping[str, str]) -> PageRequest:
    """Read a request from its query parameters.

    Raises:
        InvalidInputError: A parameter cannot be read.
    """
    try:
        names, panels, view = (
            json.loads(asked.get(name) or "null") for name in ("signals", "panels", "view")
        )
        return PageRequest(
            robot=asked.get("robot") or None,
            run_id=int(asked["run"]) if asked.get("run") else None,
            beside_id=int(asked["beside"]) if asked.get("beside") else None,
            names=tuple(map(str, names)) if names else None,
            panels=tuple(tuple(map(str, each)) for each in panels) if panels else None,
            window_s=float(asked["window"]) if asked.get("window") else None,
            view=(float(view[0]), float(view[1])) if view else None,
            all_robots=bool(asked.get("all")),
            at_s=float(asked["at"]) if asked.get("at") else None,
            width_px=min(max(int(asked.get("width") or 700), 300), 4000),
            side_px=min(max(int(asked.get("side") or 330), 250), 4000),
            height_px=min(max(int(asked.get("height") or 500), 0), 4000),
        )
    except (ValueError, TypeError, IndexError, KeyError) as error:
        raise InvalidInputError(f"the page asked for what cannot be read: {error}") from error


def robot_status(
    recording: RecordingAccess, request: PageRequest, *, steers: bool
) -> dict[str, Any]:
    """Return the status of the chosen robot and run, and the choices that there are.

    Raises:
        WebotsMCPError: The recording, robot or run does not exist.
    """
    with recording.reader() as connection:
        robots = without_observers(list_robots(connection, time.time()))
        view = _view(connection, request)
        run, header = view.run, view.header()
        is_newest = run == current_run(connection, view.robot.id)
        image = newest_image(connection, run.id) if run else None
        asked = LogFilter(run.id if run else None, LogWindow(-math.inf, math.inf),
                          robot_id=view.robot.id)  # fmt: skip
        runs = list_runs(connection, robot=view.robot.name, limit=RUN_LIMITS.runs).runs
        settable = steers and is_newest
        names = list(catalogue(connection, view.subject))[: _LIMITS.signal_names] if run else []
        return _status(header) | {
            "robot": view.robot.name,
            "run": run.id if run else None,
            "started": run.started_wall_time_s if run else None,
            "until": header["sim_time_s"],
            "robots": [robot.name for robot in robots],
            "runs": run_choices(recording, runs),
            "names": names,
            "values": _newest_values(connection, run.id, names) if run else [],
            "lines": [_line(each) for each in newest_lines(connection, asked, _LIMITS.log_lines)],
            "parameters": [_parameter(each) for each in described(connection, run)] if run else [],
            "settable": settable,
            "live": view.robot.live,
            "pace": _pace(header["status"]) if is_newest else "",
            "picture": image.id if image else None,
            "inspected": _inspected(connection, run.id) if run else [],
        }


def _view(connection: sqlite3.Connection, request: PageRequest) -> RobotView:
    now_s = time.time()
    robots = without_observers(list_robots(connection, now_s))
    if not robots:
        raise NothingRecordedError(nothing_recorded(connection))
    named = [robot for robot in robots if robot.name == request.robot]
    if request.robot is not None and not named:
        raise UnknownRobotError(f"robot {request.robot!r} is not in this database")
    (robot, *_) = named or [robot for robot in robots if robot.live] or robots
    run = fetch_run(connection, request.run_id, robot.id) if request.run_id is not None else None
    return view_of(connection, robot, now_s, run)


def _pace(status: str) -> str:
    """Return `running` or `paused`; empty where the status is neither."""
    return next((pace for pace in (RUNNING, PAUSED) if status.startswith(pace)), "")


def _newest_values(
    connection: sqlite3.Connection, run_id: int, names: Sequence[str]
) -> list[float | str | None]:
    """Return the values of the newest row in the order of the names; None where it has none."""
    state = newest_state(connection, run_id)
    values = flatten(parse(state.data)) if state else {}
    return [_shown_value(values.get(name)) for name in names]


def _shown_value(value: float | str | None) -> float | str | None:
    if isinstance(value, str):
        return spelled_out(value[: _LIMITS.value_characters])
    return value if value is None or math.isfinite(value) else None


def describe_signals(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return the unit and the meaning in words of each signal of a robot."""
    with recording.reader() as connection:
        known = catalogue(connection, _view(connection, request).subject)
    meanings = meanings_of(known)
    return {
        name: {
            "unit": spelled_out(known[name].unit or meanings[name].unit or ""),
            "meaning": spelled_out(meanings[name].words or ""),
        }
        for name in list(known)[: _LIMITS.signal_names]
    }


def _status(header: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether the robot's time is advancing, and the age of the shown data."""
    text = "no data yet"
    if header["sim_time_s"] is not None:
        text = f"simulation time {header['sim_time_s']:.2f} s, {age_in_words(header['age_s'])} old"
    run = f"run {header['run_id']}, " if header["run_id"] is not None else ""
    kind = "running" if header["status"] == RUNNING else "standing"
    return {"pill": header["status"], "kind": kind, "text": run + text, "why": header["why"] or ""}


def problem(error: Exception, recording: RecordingAccess) -> dict[str, Any]:
    """Return why nothing can be read; `unknown` names the choices that became invalid.

    Where nothing is recorded yet, `steps` are texts with lines to copy that begin a recording.
    """
    waits = isinstance(error, (NoDatabaseError, NothingRecordedError))
    why = str(error)
    if not isinstance(error, WebotsMCPError):
        defect = (
            "a defect of webots-mcp, or rows that it did not write; webots-mcp view has written "
            "more about it to its terminal"
        )
        why = f"{defect} ({type(error).__name__}: {why[: _LIMITS.line_characters]})"
    unknown: list[str] = []
    if waits or isinstance(error, (UnknownRobotError, UnknownRunError)):
        unknown = ["run", "beside", "view", "at"]
    if isinstance(error, UnknownRobotError):  # Another database has replaced it.
        unknown += ["robot", "signals", "panels"]
    return {
        "pill": "nothing recorded yet" if waits else "cannot be read",
        "kind": "standing" if waits else "problem",
        "text": spelled_out(why), "why": "", "unknown": unknown,
        "steps": _first_steps(recording) if waits else [],
    }  # fmt: skip


def _first_steps(recording: RecordingAccess) -> list[dict[str, str]]:
    command = ["webots-mcp", "demo", "--keep", "--data-dir", str(recording.data_dir)]
    return [
        {
            "text": "Add two lines to the robot's controller, below the line that creates its "
            "robot. Then start the simulation.",
            "code": "from webots_mcp import MCPBridge\nbridge = MCPBridge.attach(robot)",
        },
        {
            "text": "Or watch a demo robot first. It needs no Webots, and drives until Ctrl-C.",
            "code": spelled_out(quoted(command)),
        },
    ]


def _line(line: LogLine) -> dict[str, Any]:
    at = "" if line.sim_time_s is None else f"{line.sim_time_s:.3f} s"
    message = spelled_out(line.message[: _LIMITS.line_characters])
    kind = _LEVELS.get(line.level, "plain")
    return {
        "time": line.sim_time_s,
        "at": at,
        "level": spelled_out(line.level),
        "kind": kind,
        "message": message,
    }


def _parameter(parameter: Mapping[str, Any]) -> dict[str, Any]:
    """Return name, value and choices of a parameter, and a title with its unit and bounds."""
    low, high = parameter["low"], parameter["high"]
    unit = f" [{parameter['unit']}]" if parameter["unit"] else ""
    bounds = "" if low is None and high is None else f" ({_bound(low)} to {_bound(high)})"
    kept = {name: parameter[name] for name in ("name", "value", "choices")}
    return kept | {"title": spelled_out(f"{parameter['name']}{unit}{bounds}")}


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"


def picture(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return a picture of a run as a data URI, and its caption.

    It is the newest picture, or the picture that is nearest to the cursor.
    """
    with recording.reader() as connection:
        run = _view(connection, request).run
        image: StoredImage | None = None
        if run and request.at_s is not None:
            image = next(iter(camera_frames(connection, run.id, at_s=request.at_s)), None)
        if run and image is None:
            image = newest_image(connection, run.id)
    if image is None:
        return {"uri": None, "caption": "no picture recorded yet"}
    caption = spelled_out(f"{image.device or image.kind} at {image.sim_time_s:.3f} s")
    try:
        data = base64.b64encode(_as_jpeg(image.file(recording.data_dir))).decode("ascii")
    except WebotsMCPError as error:
        return {"uri": None, "caption": f"{caption}: {spelled_out(str(error))}"}
    return {"uri": f"data:image/jpeg;base64,{data}", "caption": caption}


def film(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return a clip of the seconds around the cursor as a data URI, and its caption.

    Without a cursor it is of the newest incident of the run.
    """
    with recording.reader() as connection:
        run = _view(connection, request).require_run()
        try:
            moment = (
                newest_moment(connection, run)
                if request.at_s is None
                else moment_at(connection, run, request.at_s)
            )
            clip = make_clip(connection, recording.data_dir, moment)
        except (InvalidInputError, NothingRecordedError) as error:
            return {"uri": None, "caption": spelled_out(str(error))}
    content = clip.content
    what = f", {content.moment.what}" if content.moment.what else ""
    caption = f"{content.view}, {content.start_s:.3f} to {content.end_s:.3f} s{what}"
    data = base64.b64encode(clip.data).decode("ascii")
    return {"uri": f"data:image/webp;base64,{data}", "caption": spelled_out(caption)}


def all_runs(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return the newest runs of a robot, each with a small curve of the first named signal."""
    with recording.reader() as connection:
        robot = _view(connection, request).robot
        return listed_runs(recording, connection, robot, request.names or ())


def _inspected(connection: sqlite3.Connection, run_id: int) -> list[float]:
    """Return the times at which the controller's variables were recorded, newest first."""
    return [each.sim_time_s for each in inspections_of(connection, run_id)]


def controller_variables(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return the controller's own variables as they were recorded nearest to the cursor."""
    with recording.reader() as connection:
        run = _view(connection, request).run
        found = inspections_of(connection, run.id) if run else []
    if not found:
        return {"title": "", "frames": []}
    at_s = found[0].sim_time_s if request.at_s is None else request.at_s
    shown = shown_variables(min(found, key=lambda each: abs(each.sim_time_s - at_s)))
    frames = [
        {
            "place": spelled_out(each.place),
            "source": [*map(spelled_out, each.source)],
            "variables": [[*map(spelled_out, variable)] for variable in each.variables],
        }
        for each in shown.frames
    ]
    return {"title": spelled_out(shown.title), "frames": frames}


def _as_jpeg(file: Path) -> bytes:
    buffer = io.BytesIO()
    with opened(file) as stored:
        scaled: Any = stored.convert("RGB")
        scaled.thumbnail((_LIMITS.picture_px, _LIMITS.picture_px))
        scaled.save(buffer, "JPEG", quality=_LIMITS.jpeg_quality)
    return buffer.getvalue()


def draw(recording: RecordingAccess, request: PageRequest) -> dict[str, Any]:
    """Return the figures of a run as markup, None where there is nothing to draw, and notes."""
    with recording.reader() as connection:
        view = _view(connection, request)
        run = view.require_run()
        try:
            ranges = _ranges(connection, view.robot.name, run.id, request)
        except NothingRecordedError as error:
            return _nothing(str(error))
        known = known_signals(connection, ranges[0])
        chosen = request.names or tuple(name for each in request.panels or () for name in each)
        names = [name for name in chosen if name in known]
        names = names or changed_most(connection, ranges[0])
        signals, notes = _composed(
            lambda: compose_signals(connection, ranges, names, room=ROOM, grouped=request.panels)
        )
        if request.all_robots:
            way, of_way = _composed(lambda: _all_paths(connection))
        else:
            way, of_way = _composed(lambda: compose_trajectory(connection, ranges))
            if way:
                way = replace(way, tracks=with_bodies(connection, way.tracks, ranges))
        standing: Sequence[Obstacle] = obstacles_of(connection, ranges) if way else ()
        drawn = _nothing(*dict.fromkeys((*notes, *of_way)))
        if signals:
            wide, high = request.width_px, request.height_px
            drawn["signals"] = signals_figure(signals, width_px=wide, height_px=high).markup
        if way:
            side = request.side_px
            drawn["way"] = way_figure(way, (), standing, width_px=side, height_px=side).markup
        length_s = signals.x_range[1] - signals.x_range[0] if signals else 0.0
        bounds = None if request.beside_id else recorded_bounds(connection, run.id)
        return drawn | {
            "names": names,
            "settled": length_s > _LIMITS.settled_s,
            "is_cut": bool(signals and signals.unread)
            or any(not track.path.is_whole for track in (way.tracks if way else ())),
            "bounds": bounds,
        }


def _nothing(*notes: str) -> dict[str, Any]:
    shown = [spelled_out(note) for note in notes]
    return {"signals": None, "way": None, "notes": shown, "names": [], "settled": False,
            "is_cut": False, "bounds": None}  # fmt: skip


def _composed(compose: Callable[[], tuple[Axes, tuple[str, ...]]]) -> tuple[Axes | None, list[str]]:
    """Return a figure and its notes; if there is nothing to draw, None and the reason."""
    try:
        axes, notes = compose()
        return axes, list(notes)
    except (InvalidInputError, NothingRecordedError, UnknownSignalError) as error:
        return None, [str(error)]


def _ranges(
    connection: sqlite3.Connection, robot: str, run_id: int, request: PageRequest
) -> list[TimeRange]:
    scope = Scope(robot=robot, run_id=run_id)
    if request.beside_id not in (None, run_id):
        beside = replace(scope, run_id=request.beside_id)
        return [find_range(connection, scope), find_range(connection, beside)]
    if request.view is not None:
        scope = replace(scope, start_s=max(0.0, request.view[0]), end_s=max(0.0, request.view[1]))
    else:
        scope = replace(scope, last_s=request.window_s)
    return [find_range(connection, scope)]


def _all_paths(connection: sqlite3.Connection) -> tuple[TrajectoryAxes, tuple[str, ...]]:
    """Return the paths of the newest runs of all robots on one map."""
    tracks: list[PlottedPath] = []
    found: TrajectoryAxes | None = None
    notes: list[str] = []
    robots = without_observers(list_robots(connection, time.time()))
    for robot in robots[: _LIMITS.robots]:
        try:
            whole = find_range(connection, Scope(robot=robot.name))
            found, of_robot = compose_trajectory(connection, [whole], events=False)
        except (InvalidInputError, NothingRecordedError, UnknownSignalError) as error:
            notes.append(f"{robot.name}: {error}")
            continue
        notes += [f"{robot.name}: {note}" for note in of_robot]
        of_robot_tracks = with_bodies(connection, found.tracks, [whole])
        tracks += [replace(each, name=robot.name, modes=None) for each in of_robot_tracks]
    if len(robots) > _LIMITS.robots:
        notes.append(f"the map shows {_LIMITS.robots} of {len(robots)} robots")
    if found is None:
        raise NothingRecordedError("; ".join(notes))
    return replace(found, title="all robots", tracks=tracks, mode=None), tuple(notes)
