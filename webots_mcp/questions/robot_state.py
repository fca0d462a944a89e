"""Questions about the newest state: the robot at a glance, its sensors, and any part in full.

The newest events and the health of the recorder belong to the full state.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, cast

from pydantic import Field

from webots_mcp.answers.answer_models import (
    AnswerTable,
    FullStateAnswer,
    SensorsAnswer,
    StateAnswer,
)
from webots_mcp.answers.budget import (
    ANSWER_TOKENS,
    LARGE_ANSWER_TOKENS,
    detailed,
    fitting,
    some,
)
from webots_mcp.answers.shortening import (
    STATE_BUDGET_TOKENS,
    WHOLE,
    Shortened,
    compact_json,
    cut_text,
    shorten,
    tokens_in,
    tokens_of,
)
from webots_mcp.contract import CUSTOM_DATA, INSPECTION_EVENT
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.questions.arguments import RobotName, RunId
from webots_mcp.questions.declaration import READS, question
from webots_mcp.questions.list_robots import BY_OBSERVER
from webots_mcp.signals.naming import OBSERVED
from webots_mcp.store.inspections import reference_to
from webots_mcp.store.loop_evidence import rows_waiting
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.observed_pose import pose_at
from webots_mcp.store.reading.segment import Deadline, Segment, just_after, newest_kept
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.run_rows import (
    EventRecord,
    StateRecord,
    count_dropped,
    newest_events,
    pace_of,
    select,
)
from webots_mcp.store.sessions import fetch_session

PagePath = Annotated[
    str,
    Field(
        max_length=1000,
        description="Dotted path of the part to read, as in the state: sensors.lidar.",
    ),
]
Offset = Annotated[int, Field(ge=0, description="Number of members, items or characters to skip.")]
PageSize = Annotated[
    int | None,
    Field(
        ge=1, le=2000, description="Maximum number of members, items or characters. Default 500."
    ),
]
# Webots device classes that are not sensors.
_NO_SENSORS: Final = (
    "Brake", "Connector", "Display", "Emitter", "LED", "LinearMotor", "Motor", "Muscle", "Pen",
    "Propeller", "RotationalMotor", "Skin", "Speaker", "Track", "VacuumGripper",
)  # fmt: skip
_WORDS: Final = (
    "sensor", "lidar", "gps", "imu", "inertial", "compass", "gyro", "accel", "encoder", "touch",
    "bumper", "distance", "range", "radar", "sonar", "light", "altimeter", "camera", "odometry",
    "battery", "force", "contact", "scan",
)  # fmt: skip


@dataclass(frozen=True)
class StateSizes:
    """How much of a state an answer shows.

    Attributes:
        events: Events.
        events_tokens: Budget of the events.
        page: Members, items or characters of a page, unless a limit is given.
        names: Names in a hint.
        margin_tokens: Budget that is reserved for hints.
        replaced: Replaced values.
        devices: Devices that the state does not name.
        error_characters: Characters of an error or a reason.
    """

    events: int = 10
    events_tokens: int = 250
    page: int = 500
    names: int = 6
    margin_tokens: int = 200
    replaced: int = 20
    devices: int = 30
    error_characters: int = 300


_SIZES: Final = StateSizes()


@question("Get the robot's state", READS, quotes=True, tier="core")
def webots_get_robot_state(
    recording: RecordingAccess, robot: RobotName = None, run_id: RunId = None
) -> StateAnswer:
    """Show the newest values that the robot published: rounded, with long arrays summarised.

    For exact values or whole arrays use webots_get_full_state; for the past use
    webots_get_trends; to watch the robot for some seconds use webots_monitor.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            return StateAnswer(**view.header(), hint=_nothing_yet(view))
        short = shorten(_with_observed_pose(view, view.state))
        hint = (
            "webots_get_full_state(path=...) shows a part whole, in pages" if short.rule else None
        )
        return StateAnswer(
            **view.header(),
            **view.position_by(),
            state=short.value,
            shortened=short.rule,
            kept_at_full_rate=_kept(view),
            pace=pace_of(view.connection, view.robot.name, view.require_run().id),
            hint=hint,
        )


@question("Get the sensors", READS, quotes=True)
def webots_get_sensors(
    recording: RecordingAccess, robot: RobotName = None, run_id: RunId = None
) -> SensorsAnswer:
    """Show the newest readings of the robot's sensors only.

    For everything the robot published use webots_get_robot_state; for readings over time use
    webots_query_history.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            return SensorsAnswer(**view.header(), hint=_nothing_yet(view))
        state = view.state.value()
        sensors = sensor_part(state, view.robot.devices)
        unnamed = unnamed_devices(state, view.robot.devices)
        missing = [f"{name} ({kind})" for name, kind in unnamed.items()]
        replaced, not_named = _replaced_in(view.state, sensors), some(missing, _SIZES.devices)
        left_tokens = ANSWER_TOKENS - _SIZES.margin_tokens - tokens_of([replaced, not_named])
        short = shorten(sensors, min(STATE_BUDGET_TOKENS, left_tokens))
        return SensorsAnswer(
            **view.header(),
            sensors=short.value,
            replaced=replaced,
            devices_not_named_in_state=not_named or None,
            shortened=short.rule,
            hint=None if sensors else _no_sensors(state),
        )


@question("Get the full state", READS, quotes=True)
def webots_get_full_state(
    recording: RecordingAccess,
    path: PagePath = "",
    offset: Offset = 0,
    limit: PageSize = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> FullStateAnswer:
    """Read the newest state exactly and completely, in pages, such as all values of a lidar.

    Without a path it also lists the newest events and the recorder's own errors. For an overview
    use webots_get_robot_state.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            hint, recorder = _nothing_yet(view), _health(view)
            return FullStateAnswer(**view.header(), hint=hint, recorder=recorder)
        part = select(_with_observed_pose(view, view.state), path)
        if offset and not isinstance(part, (dict, list, str)):
            raise InvalidInputError(
                f"offset is possible only with a list, a text or a branch, and {path!r:.80} is a "
                "single value. Leave offset out."
            )
        others: dict[str, Any] = view.header()
        if not (path or offset):
            others |= {"replaced": _some_replaced(view.state.replaced_paths())}
            others |= {"events": _events(view), "recorder": _health(view)}
        most_tokens = ANSWER_TOKENS if limit is None else LARGE_ANSWER_TOKENS
        reported = {
            name: each.model_dump() if name == "events" else each for name, each in others.items()
        }
        left_tokens = most_tokens - _SIZES.margin_tokens - tokens_of(reported)
        return FullStateAnswer(
            **_page(part, path, offset, limit or _SIZES.page, left_tokens), **others
        )


def _with_observed_pose(view: RobotView, state: StateRecord) -> dict[str, Any]:
    """Return the state, with where an observer saw the robot if it has no position of its own."""
    value = state.value()
    if OBSERVED in value:
        return value
    moment = Segment(state.run_id, state.sim_time_s, just_after(state.sim_time_s))
    frame = read_frame(view.connection, moment, Deadline())
    pose = pose_at(frame.derived, state.sim_time_s)
    return {**value, OBSERVED: pose} if pose else value


def _nothing_yet(view: RobotView) -> str:
    """Return a robot that published before a reset will publish again."""
    run_id = view.run.id if view.run else 0
    (purged_rows,) = view.connection.execute(
        "SELECT purged_rows FROM run WHERE id = ?", (run_id,)
    ).fetchone() or (0,)
    if purged_rows:
        return (
            f"the newest states of this run are gone: retention has deleted {purged_rows}; for "
            "their values, as far as chunks hold them, webots_get_trends or webots_query_history"
        )
    earlier = view.connection.execute(
        "SELECT max(id) FROM run WHERE robot_id = ? AND id < ? AND row_count > 0",
        (view.robot.id, run_id),
    ).fetchone()[0]
    if earlier is None:
        return (
            "nothing was recorded in this run yet: of the calls of bridge.publish({...}) in the "
            "controller's loop every 5th is by default (throttle_interval), or each one with "
            "force=True"
        )
    return (
        f"nothing was recorded in this run yet, but in an earlier one (run_id={earlier}): ask "
        "again when the controller has published"
    )


def _page(part: Any, path: str, offset: int, limit: int, budget_tokens: int) -> dict[str, Any]:
    """Return what fits of a value; of an object, an array or a text from `offset` on."""
    if not isinstance(part, (dict, list, str)):
        return {  # an answer leaves out a null, so the hint names it
            "path": path,
            "state": part,
            "hint": "the value at this path is null" if part is None else None,
        }
    whole = cast("dict[str, Any] | list[Any] | str", part)
    hints, rule = list[str](), None
    if isinstance(whole, str):
        page = whole[offset : offset + limit]
    else:
        named = isinstance(whole, dict)
        members = [*whole.items()] if isinstance(whole, dict) else [*enumerate(whole)]
        shown = _fitting_members(members[offset : offset + limit], budget_tokens, named=named)
        page = {name: short.value for name, short in shown.items()}
        cut = {str(name): short.rule for name, short in shown.items() if short.rule}
        if cut:
            rule = next(iter(cut.values()))
            hints.append(f"path=... shows these in pages: {some([*cut], _SIZES.names)}")
        page = page if named else [*page.values()]
    end = offset + len(page)
    if end < len(whole) and isinstance(whole, dict):
        left_out = [*whole][end:]
        hints.append(
            f"not shown: {some(left_out, _SIZES.names)}; ask with offset={end}, with path=... for "
            f"one, or with limit for up to {LARGE_ANSWER_TOKENS:,} tokens"
        )
    return {
        "path": path or None,
        "state": page,
        "total": None if isinstance(whole, dict) and len(page) == len(whole) else len(whole),
        "next_offset": end if end < len(whole) else None,
        "shortened": rule,
        "hint": "; ".join(hints) or None,
    }


def _fitting_members(
    members: Sequence[tuple[str | int, Any]], budget_tokens: int, *, named: bool
) -> dict[str | int, Shortened]:
    """Return the first members that fit, at least one.

    Where all fit once arrays among the longest are summarised, all are shown; else each that is
    not very long is shown whole, and others must be asked for.
    """

    def tokens(name: str | int, short: Shortened) -> int:
        return tokens_in(f",{compact_json(name)}:" * named + compact_json(short.value))

    shorts = {name: shorten(value, budget_tokens, WHOLE) for name, value in members}
    sizes = {name: tokens(name, short) for name, short in shorts.items()}
    longest = _longest_that_fits(sizes.values(), budget_tokens)
    summarised = {
        name: shorten(value, max(longest, budget_tokens // 2), WHOLE[1:])
        for name, value in members
        if sizes[name] > longest
    }
    after = {name: tokens(name, short) for name, short in summarised.items()}
    if sum((sizes | after).values()) > budget_tokens:
        summarised = {
            name: each for name, each in summarised.items() if sizes[name] > budget_tokens // 4
        }
    shown: dict[str | int, Shortened] = {}
    for name, short in (shorts | summarised).items():
        budget_tokens -= tokens(name, short)
        if budget_tokens < 0 and shown:
            break
        shown[name] = short
    return shown


def _longest_that_fits(sizes: Collection[int], budget: int) -> int:
    """Return the size to which the largest must come down for all of them to fit."""
    for smaller, size in enumerate(sorted(sizes)):
        share = budget // (len(sizes) - smaller)
        if size > share:
            return share
        budget -= size
    return max(sizes, default=0)


def _events(view: RobotView) -> AnswerTable:
    """Return the newest events that fit, the oldest of them first."""
    events = newest_events(view.connection, view.require_run().id, _SIZES.events)
    rows = [
        [round(event.sim_time_s, 3), event.kind, event.name, detailed(_details_of(event))]
        for event in reversed(events)
    ]
    shown = fitting(rows, _SIZES.events_tokens)[::-1]
    return AnswerTable(columns=["start_s", "kind", "name", "details"], rows=shown)


def _details_of(event: EventRecord) -> Any:
    """Return the details; of an inspection how to ask for its variables."""
    details = event.details()
    return reference_to(event.id, details) if event.kind == INSPECTION_EVENT else details


def _health(view: RobotView) -> dict[str, Any] | None:
    """Return the health of the session that recorded the run."""
    session = view.session
    if view.run is not None and (session is None or session.id != view.run.session_id):
        session = fetch_session(view.connection, view.run.session_id)
    if session is None:
        return None
    error = cut_text(session.last_error, _SIZES.error_characters) if session.last_error else None
    return {
        "row_count": view.run.row_count if view.run else 0,
        **({"kept_at_full_rate": kept} if (kept := _kept(view)) else {}),
        **rows_waiting(view.connection, session),
        "rows_dropped": _dropped(view, session.rows_dropped),
        "last_error": error,
        "heartbeat_age_wall_s": round(session.silent_s(view.now_s), 2),
        "polls_commands": session.last_poll_wall_time_s is not None,
        **({"recorded_by": BY_OBSERVER} if view.robot.kind == CUSTOM_DATA else {}),
        "controller": session.controller,
        "controller_sha256": session.controller_sha256,
        "git_commit": session.git_commit,
        "versions": session.versions,
    }


def _dropped(view: RobotView, of_session: int) -> int:
    """Return how many rows of the run were dropped; without a run, of the session."""
    run = view.run
    return of_session if run is None else count_dropped(view.connection, run, of_session)


def _kept(view: RobotView) -> str | None:
    """Return the last full-rate segment of the run, and its reason."""
    newest = newest_kept(view.connection, view.run.id) if view.run else None
    if newest is None or view.run is None:
        return None
    span = f"{newest.start_s:.3f} to {newest.end_s:.3f} s"
    if (last_s := view.run.last_sim_time_s) < newest.end_s:
        span = f"since {newest.start_s:.3f} s, planned to {newest.end_s:.3f} s"
        if view.run.end_reason is not None:
            span = f"{newest.start_s:.3f} to {last_s:.3f} s, where the run ended"
    return f"full-rate segment {span}: {cut_text(newest.reason, _SIZES.error_characters)}"


def _replaced_in(state: StateRecord, part: dict[str, Any]) -> dict[str, str] | None:
    """Return the replaced values among those members of the state."""
    replaced = {
        path: kind
        for path, kind in state.replaced_paths().items()
        if any(path == key or path.startswith(f"{key}.") for key in part)
    }
    return _some_replaced(replaced)


def _some_replaced(replaced: Mapping[str, str]) -> dict[str, str] | None:
    """Return the first of them, and how many more there are; None without any."""
    shown = dict(list(replaced.items())[: _SIZES.replaced])
    if more := len(replaced) - len(shown):
        shown["…"] = f"{more} more: webots_query_sql has all in column replaced of table state"
    return shown or None


def _no_sensors(state: dict[str, Any]) -> str:
    if not state:
        raise NothingRecordedError("the newest state is empty")
    return (
        "no member of the state is named after a sensor device or like a sensor; "
        "webots_get_robot_state shows the whole state"
    )


def sensor_part(state: dict[str, Any], devices: dict[str, str]) -> dict[str, Any]:
    """Return the members of a state that are named after a sensor, or contain a sensor's word."""
    sensors = _sensor_devices(devices)
    return {key: state[key] for key in state if key in sensors or _has_sensor_word(key)}


def _sensor_devices(devices: dict[str, str]) -> dict[str, str]:
    """Return the devices that are sensors: name to class."""
    return {name: kind for name, kind in devices.items() if kind not in _NO_SENSORS}


def unnamed_devices(state: dict[str, Any], devices: dict[str, str]) -> dict[str, str]:
    """Return the sensor devices whose name is in no name of the published values.

    The words of a name may be anywhere in a path: `front left`, `left_front` and `ds0` match
    `front: {left: 1}` and `ds: [1]`.
    """
    published = [_words(path) for path in _paths(state)]
    return {
        name: kind
        for name, kind in _sensor_devices(devices).items()
        if not any(_words(name) <= words for words in published)
    }


def _has_sensor_word(key: str) -> bool:
    return any(word in key.lower() for word in _WORDS)


def _paths(value: Any, path: str = "") -> Iterator[str]:
    """Yield the path of each member at any depth, and of the first items of arrays."""
    yield path
    if isinstance(value, dict):
        for key, member in cast("dict[str, Any]", value).items():
            yield from _paths(member, f"{path}.{key}")
    elif isinstance(value, list):
        # Each item of an array may be a device.
        for index, item in enumerate(cast("list[Any]", value)[:64]):
            yield from _paths(item, f"{path}.{index}")


def _words(name: str) -> set[str]:
    return set(re.findall(r"[^\W\d_]+|\d+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).lower()))
