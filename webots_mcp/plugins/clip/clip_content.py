"""What a clip shows: read from the recording, before anything is painted."""

from __future__ import annotations

import math
import sqlite3
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from webots_mcp.analysis.arrays import np
from webots_mcp.errors import InvalidInputError, NothingRecordedError, UnknownSignalError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import motion_in
from webots_mcp.judging.trends import trends
from webots_mcp.plotting.canvas import Room
from webots_mcp.plotting.intervals import Lane
from webots_mcp.plotting.plotted_runs import known_signals, mode_signal
from webots_mcp.plotting.signal_plot import SignalAxes, compose_signals
from webots_mcp.plotting.trajectory import Obstacle, TrajectoryAxes, compose_trajectory
from webots_mcp.plugins.clip.clip_limits import CONTENT_LIMITS, ClipView
from webots_mcp.plugins.clip.moment import Moment, span_of
from webots_mcp.plugins.report.chapter import is_clock
from webots_mcp.plugins.report.obstacles import obstacles_of, robot_outline
from webots_mcp.signals.naming import counted, listed
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.reading.segment import Deadline
from webots_mcp.store.run_rows import StoredImage, camera_frames_between, fetch_run, opened


@dataclass(frozen=True)
class RobotTrack:
    """Where the robot was at which time, on the map.

    Attributes:
        times: Rising, in seconds; the other columns belong to it.
        headings: In radians, counted through full turns; None where nothing tells it.
        outline: Corners seen from above, ahead and to the left of the origin; empty if not known.
    """

    axes: TrajectoryAxes
    obstacles: Sequence[Obstacle]
    times: Any
    x: Any
    y: Any
    headings: Any
    outline: Sequence[tuple[float, float]]

    def pose_at(self, time_s: float) -> tuple[float, float, float | None]:
        """Return x, y and heading at a time, between two rows in proportion."""
        x, y = (_at(time_s, self.times, values) for values in (self.x, self.y))
        return x, y, None if self.headings is None else _at(time_s, self.times, self.headings)


@dataclass(frozen=True)
class ClipContent:
    """What a clip shows.

    Attributes:
        files: The camera frames of `camera` that can be read, with their files, in order of time.
        track: The robot on the map; None if the camera is shown, or no position is known.
        signals: The curves; None without any.
        mode: The signal that says what the robot was doing, if there is one.
    """

    moment: Moment
    robot: str
    start_s: float
    end_s: float
    camera: str
    files: Sequence[tuple[StoredImage, Path]]
    track: RobotTrack | None
    signals: SignalAxes | None
    mode: Lane | None
    notes: Sequence[str]

    @property
    def length_s(self) -> float:
        """Simulated seconds."""
        return self.end_s - self.start_s

    @property
    def view(self) -> str:
        """What is above the curves."""
        return f"frames of {self.camera}" if self.files else "map" if self.track else "curves"

    def picture_at(self, time_s: float) -> tuple[StoredImage, Path]:
        """Return the newest frame up to a time, or the first one."""
        index = bisect_right(self.files, time_s + 1e-9, key=lambda each: each[0].sim_time_s)
        return self.files[max(0, index - 1)]

    def mode_at(self, time_s: float) -> str:
        """Return what the robot was doing at a time; empty if that is not known."""
        for each in self.mode.intervals if self.mode else ():
            if each.start_s <= time_s < each.end_s or time_s == each.end_s == self.end_s:
                return each.value
        return ""


def content_of(
    connection: sqlite3.Connection,
    data_dir: Path,
    moment: Moment,
    before_s: float,
    after_s: float,
    *,
    signals: Sequence[str] = (),
    camera: str = "",
    view: ClipView | None = None,
) -> ClipContent:
    """Read what a clip shows.

    Args:
        connection: Connection to the recording.
        data_dir: Folder of the pictures.
        moment: What it is about.
        before_s: Simulated seconds before the moment.
        after_s: Simulated seconds after it.
        signals: Curves to draw, at most three; empty for those that changed most.
        camera: Name of the camera; empty for the one with most frames in the range.
        view: What is above the curves; None for the camera where it has frames, else the map.

    Raises:
        InvalidInputError: There is no such camera, or no map; the text says what there is.
        NothingRecordedError: Nothing of the range can be shown.
        UnknownSignalError: A name matches no signal.
    """
    run = fetch_run(connection, moment.run_id)
    first_s, last_s = span_of(connection, run)
    start_s = max(first_s, moment.at_s - before_s)
    end_s = min(last_s, moment.at_s + after_s)
    notes = _shortened(moment, before_s, after_s, start_s, end_s)
    whole = _range(connection, run.id, start_s, end_s)
    found = camera_frames_between(connection, run.id, start_s, end_s, CONTENT_LIMITS.frames)
    files: Sequence[tuple[StoredImage, Path]] = ()
    chosen = ""
    if view != "map" and (found or camera or view == "camera"):
        chosen, of_camera = _camera(found, camera, (start_s, end_s))
        notes += of_camera
        files, unusable = _usable([f for f in found if f.device == chosen], data_dir)
        notes += unusable
    track: RobotTrack | None = None
    is_still = len(files) == 1 and not camera and view is None  # a map shows more than one frame
    if not files or is_still:
        track, why_not = _track(connection, whole, deadline_s=CONTENT_LIMITS.deadline_s)
        if view == "map" and track is None:
            raise InvalidInputError(f"No map can be drawn: {why_not}.")
        if track is None:
            notes.append(f"no map: {why_not}")
        elif is_still:
            files = ()
            notes.append(f"camera={chosen!r} shows that frame")
    axes, mode = _curves(connection, whole, signals, moment.signals)
    if not files and track is None and axes is None:
        raise NothingRecordedError(
            f"Nothing of {start_s:.3f} to {end_s:.3f} s of run {run.id} can be shown: it has no "
            f"usable camera frame, no position and no value. {'; '.join(notes)}"
        )
    robot = whole.robot if whole else ""
    return ClipContent(moment, robot, start_s, end_s, chosen if files else "", files, track, axes,
                       mode, tuple(dict.fromkeys(notes)))  # fmt: skip


def _shortened(
    moment: Moment, before_s: float, after_s: float, start_s: float, end_s: float
) -> list[str]:
    cut = [
        f"the recording begins at {start_s:.3f} s" if start_s > moment.at_s - before_s else "",
        f"the recording ends at {end_s:.3f} s" if end_s < moment.at_s + after_s else "",
    ]
    return [each for each in cut if each]


def _range(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> TimeRange | None:
    """Return the range of states; None if there are none, only pictures."""
    try:
        return find_range(connection, Scope(run_id=run_id, start_s=start_s, end_s=end_s + 0.001))
    except NothingRecordedError:
        return None


# -- the camera ------------------------------------------------------------------------------------


def _camera(
    found: Sequence[StoredImage], wanted: str, span: tuple[float, float]
) -> tuple[str, list[str]]:
    """Return the camera to show, and a note that names the others."""
    frames = Counter(str(each.device) for each in found)
    if wanted and wanted not in frames:
        named = listed(sorted(frames))
        there = f"Cameras with frames there: {named}." if frames else "No camera has any there."
        raise InvalidInputError(
            f"Camera {wanted!r} has no frame from {span[0]:.3f} to {span[1]:.3f} s. {there} Name "
            "one of these, give another time, or ask for the map."
        )
    if not frames:
        raise InvalidInputError(
            f"No camera frame was recorded from {span[0]:.3f} to {span[1]:.3f} s. "
            "bridge.keep_camera(camera) in the controller keeps frames of the seconds around a "
            "hit. Ask for the map to see where the robot was."
        )
    chosen = wanted or min(frames, key=lambda name: (-frames[name], name))
    others = sorted(set(frames) - {chosen})
    notes = [] if wanted or not others else [f"other cameras there: {listed(others)}"]
    if frames[chosen] == 1:
        (only,) = (each for each in found if each.device == chosen)
        notes.append(f"camera {chosen} has only one frame there, of {only.sim_time_s:.3f} s")
    return chosen, notes


def frames_of_a_camera(
    connection: sqlite3.Connection, data_dir: Path, run_id: int, span: tuple[float, float]
) -> tuple[str, Sequence[tuple[StoredImage, Path]]]:
    """Return the camera with most frames from a time to another, and those that can be read."""
    found = camera_frames_between(connection, run_id, *span, CONTENT_LIMITS.frames)
    if not found:
        return "", ()
    chosen, _ = _camera(found, "", span)
    usable, _ = _usable([each for each in found if each.device == chosen], data_dir)
    return chosen, usable


def _usable(
    frames: Sequence[StoredImage], data_dir: Path
) -> tuple[list[tuple[StoredImage, Path]], list[str]]:
    """Return the frames whose files can be read, one for each time, and a note on the others."""
    usable: dict[float, tuple[StoredImage, Path]] = {}
    why: list[str] = []
    for each in frames:
        before = usable.get(each.sim_time_s)
        try:
            file = each.file(data_dir)
            with opened(file) as picture:
                picture.load()
                is_larger = before is None or picture.width > before[0].width
        except (InvalidInputError, NothingRecordedError) as error:
            why.append(str(error))
            continue
        if is_larger:
            usable[each.sim_time_s] = (each, file)
    notes = []
    if why:
        notes = [f"{len(why)} of {counted(len(frames), 'frame')} could not be read: {why[0]}"]
    return list(usable.values()), notes


# -- the map ---------------------------------------------------------------------------------------


def _track(
    connection: sqlite3.Connection, whole: TimeRange | None, *, deadline_s: float
) -> tuple[RobotTrack | None, str]:
    """Return the robot's track on the map, or why there is none."""
    if whole is None:
        return None, "no state was recorded there"
    try:
        axes, _ = compose_trajectory(connection, [whole], events=False, deadline_s=deadline_s)
    except InvalidInputError:
        return None, (
            "no position was found among its signals (webots_describe_signals declares one, with "
            "quantity='x' and quantity='y')"
        )
    except (NothingRecordedError, UnknownSignalError) as error:
        return None, str(error)
    places = axes.tracks[0].path.places
    times, x, y = (np.array([place[i] for place in places], np.float64) for i in range(3))
    headings = _headings(connection, whole, times, x, y, deadline_s)
    obstacles = obstacles_of(connection, [whole])
    outline = robot_outline(connection, whole)
    reach_m = max((math.hypot(*corner) for corner in outline), default=0.0)
    title = f"{whole.robot}, run {whole.segments[0].run_id}"
    axes = replace(axes, title=title, room_m=reach_m)
    return RobotTrack(axes, obstacles, times, x, y, headings, outline), ""


def _headings(
    connection: sqlite3.Connection, whole: TimeRange, times: Any, x: Any, y: Any, deadline_s: float
) -> Any:
    """Return the heading at each place: as recorded where that fits the motion, else of the motion.

    A recorded heading may be a compass bearing, or have another zero. A robot that moves backwards
    has the right heading too, so the axis of motion decides, not its direction.
    """
    moved = _directions(x, y)
    known = known_signals(connection, [whole])
    frame = read_frame(connection, whole.segments[-1], Deadline(deadline_s))
    heading = motion_in(frame, known, EventOptions()).heading
    if heading is None or not heading.turn:
        return moved
    values = frame.numbers(heading.name) * (math.tau / heading.turn)
    present = np.flatnonzero(np.isfinite(values))
    if len(present) == 0:
        return moved
    recorded: Any = cast("Any", np).interp(times, frame.times[present], np.unwrap(values[present]))
    steps = np.hypot(np.diff(x), np.diff(y))
    moving = np.flatnonzero(steps > CONTENT_LIMITS.moving_share * steps.max(initial=0.0))
    if moved is not None and len(moving):
        towards = np.arctan2(np.diff(y), np.diff(x))[moving]
        apart = np.abs(np.sin(recorded[moving] - towards))
        if float(np.median(apart)) > math.sin(CONTENT_LIMITS.wrong_heading_rad):
            return moved
    return recorded


def _at(time_s: float, times: Any, values: Any) -> float:
    return float(cast("Any", np).interp(time_s, times, values))


def _directions(x: Any, y: Any) -> Any:
    """Return the direction of motion at each place, held while it stands; None if it never moves.

    Steps that are short compared with the longest are noise of the position.
    """
    if len(x) < 2:
        return None
    dx, dy = np.diff(x), np.diff(y)
    steps = np.hypot(dx, dy)
    moving = steps > CONTENT_LIMITS.moving_share * steps.max()
    if not moving.any():
        return None
    at = np.flatnonzero(moving)
    angles = np.unwrap(np.arctan2(dy[at], dx[at]))
    last = np.maximum(np.searchsorted(at, np.arange(len(x)), "right") - 1, 0)
    return angles[last]


# -- the curves ------------------------------------------------------------------------------------


def _curves(
    connection: sqlite3.Connection,
    whole: TimeRange | None,
    names: Sequence[str],
    of_event: Sequence[str],
) -> tuple[SignalAxes | None, Lane | None]:
    """Return the curves and the mode of a range, None of what it does not have.

    Raises:
        UnknownSignalError: A name matches no signal.
        InvalidInputError: More than three signals are named.
    """
    if whole is None:
        return None, None
    known = known_signals(connection, [whole])
    mode = mode_signal(known, None)
    told = [name for name in of_event if name in known and known[name].is_number]
    usual = () if names else (*told, *_changed_most(connection, whole))
    chosen = list(names) or list(dict.fromkeys(usual))[: CONTENT_LIMITS.signals]
    if len(chosen) > CONTENT_LIMITS.signals:
        raise InvalidInputError(
            f"{len(chosen)} signals are named, and a clip has at most {CONTENT_LIMITS.signals} "
            "curves. Name fewer; webots_plot draws more."
        )
    room = Room(points=CONTENT_LIMITS.points, panels=CONTENT_LIMITS.signals, lanes=1, rows=1)
    try:
        axes, _ = compose_signals(
            connection, [whole], [*chosen, *([] if chosen or mode is None else [mode])],
            events=False, room=room, grouped=[[name] for name in chosen],
            deadline_s=CONTENT_LIMITS.deadline_s,
        )  # fmt: skip
    except NothingRecordedError:
        return None, None
    lanes = [*([axes.bands] if axes.bands else []), *axes.lanes]
    held = next((lane for lane in lanes if lane.name == mode), None)
    shown = replace(axes, x_label="simulation time [s]")
    return shown if axes.panels or axes.lanes else None, held


def _changed_most(connection: sqlite3.Connection, whole: TimeRange) -> list[str]:
    """Return the numbers that changed most in a range, without clocks."""
    found = trends(connection, whole, limit=4 * CONTENT_LIMITS.signals, shown=0).runs
    changed = [
        trend.name
        for run in found
        for trend in run.numbers
        if trend.shape != "constant" and not is_clock(trend)
    ]
    return changed[: CONTENT_LIMITS.signals]
