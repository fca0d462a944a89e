"""Tools that show what a robot published last."""

from __future__ import annotations

from typing import Annotated, Any, Final, cast

from pydantic import Field

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.questions.answers import FullStateAnswer, SensorsAnswer, StateAnswer, Table
from webots_mcp.questions.argument_types import RobotName, RunId
from webots_mcp.questions.budget import some
from webots_mcp.questions.declaring import READS, question
from webots_mcp.questions.shortening import (
    DETAIL_BUDGET,
    FULL_BUDGET,
    WHOLE,
    cut_text,
    shorten,
)
from webots_mcp.steering.sensing import sensor_part, unnamed_devices
from webots_mcp.store.reading.kept import newest_kept
from webots_mcp.store.recording import Recording, View
from webots_mcp.store.run_rows import State, newest_events, select
from webots_mcp.store.sessions import fetch_session
from webots_mcp.store.status import rows_waiting

_PUBLISH: Final = (
    "nothing was recorded in this run yet: of the calls of bridge.publish({...}) in the "
    "controller's loop every 5th is (throttle_interval), or each one with force=True"
)
_EARLIER: Final = "SELECT max(id) FROM run WHERE robot_id = ? AND id < ? AND rows > 0"
_PURGED: Final = "SELECT purged_rows FROM run WHERE id = ?"
_EVENTS: Final = 10
_SHOWN_REPLACED: Final = 20
_SHOWN_DEVICES: Final = 30
_ERROR_CHARACTERS: Final = 300

PagePath = Annotated[
    str,
    Field(max_length=1000, description="Dotted path, as sensors.lidar."),
]
Offset = Annotated[int, Field(ge=0, description="First item or character at the path.")]
PageSize = Annotated[int, Field(ge=1, le=2000, description="So many of them.")]


@question("Get the robot's state", READS, core=True)
def webots_get_robot_state(
    recording: Recording, robot: RobotName = None, run_id: RunId = None
) -> StateAnswer:
    """The robot now, at a glance: its newest published state, rounded, long arrays summed up.

    webots_get_full_state has a part of it whole and exact.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            return StateAnswer(**view.header(), hint=_nothing_yet(view))
        short = shorten(view.state.value())
        hint = "webots_get_full_state(path=...) shows a part whole" if short.rule else None
        return StateAnswer(
            **view.header(),
            state=short.value,
            shortened=short.rule,
            kept_at_full_rate=_kept(view),
            hint=hint,
        )


@question("Get the sensors", READS)
def webots_get_sensors(
    recording: Recording, robot: RobotName = None, run_id: RunId = None
) -> SensorsAnswer:
    """The newest sensor values: members of the state named after a sensor device or like one."""
    with recording.view(robot, run_id) as view:
        if view.state is None:
            return SensorsAnswer(**view.header(), hint=_nothing_yet(view))
        state = view.state.value()
        sensors = sensor_part(state, view.robot.devices)
        short = shorten(sensors)
        unnamed = unnamed_devices(state, view.robot.devices)
        missing = [f"{name} ({kind})" for name, kind in unnamed.items()]
        return SensorsAnswer(
            **view.header(),
            sensors=short.value,
            replaced=_replaced_in(view.state, sensors),
            devices_not_named_in_state=some(missing, _SHOWN_DEVICES) or None,
            shortened=short.rule,
            hint=None if sensors else _no_sensors(state),
        )


@question("Get the full state", READS, core=True)
def webots_get_full_state(
    recording: Recording,
    path: PagePath = "",
    offset: Offset = 0,
    limit: PageSize = 500,
    robot: RobotName = None,
    run_id: RunId = None,
) -> FullStateAnswer:
    """A part of the newest state, whole and exact, in pages: what webots_get_robot_state shortens.

    Without a path also the newest events and the recorder's health.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            hint, recorder = _nothing_yet(view), _recorder(view)
            return FullStateAnswer(**view.header(), hint=hint, recorder=recorder)
        part = select(view.state.value(), path)
        if offset and not isinstance(part, (list, str)):
            raise InvalidInputError("offset is for arrays and texts: give path to one of them")
        answer = _page(part, path, offset, limit)
        answer |= view.header()
        if not path:
            replaced = list(view.state.odd_paths().items())[:_SHOWN_REPLACED]
            answer |= {"replaced": dict(replaced) or None, "events": _events(view)}
            answer |= {"recorder": _recorder(view)}
        return FullStateAnswer(**answer)


def _nothing_yet(view: View) -> str:
    """A robot that published before a reset will publish again."""
    run_id = view.run.id if view.run else 0
    (purged_rows,) = view.connection.execute(_PURGED, (run_id,)).fetchone() or (0,)
    if purged_rows:
        return (
            f"all states of this run are gone: retention has deleted {purged_rows}; their 10 s "
            "summaries are left, ask webots_get_trends"
        )
    earlier = view.connection.execute(_EARLIER, (view.robot.id, run_id)).fetchone()[0]
    if earlier is None:
        return _PUBLISH
    return (
        f"nothing was recorded in this run yet, but in an earlier one (run_id={earlier}): ask "
        "again when the controller has published"
    )


def _page(part: Any, path: str, offset: int, limit: int) -> dict[str, Any]:
    """A value that fits; of an array or a text the items from `offset` on."""
    if not isinstance(part, (list, str)):
        short = shorten(part, FULL_BUDGET, WHOLE)
        return {"path": path or None, "state": short.value, "shortened": short.rule}
    whole = cast("list[Any] | str", part)
    page = whole[offset : offset + limit]
    rule = None
    if isinstance(page, list):
        items, rule = _fitting_items(page)
        page = items
    end = offset + len(page)
    following = end if end < len(whole) else None
    return {
        "path": path,
        "state": page,
        "total": len(whole),
        "next_offset": following,
        "shortened": rule,
    }


def _fitting_items(items: list[Any]) -> tuple[list[Any], str | None]:
    """As many items as fit the budget; only an item that is itself too long is shortened."""
    fitting: list[Any] = []
    room, rule = FULL_BUDGET, None
    for item in items:
        short = shorten(item, FULL_BUDGET // 4, WHOLE)
        room -= len(str(short.value)) + 1
        if room < 0 and fitting:
            break
        fitting.append(short.value)
        rule = rule or short.rule
    return fitting, rule


def _events(view: View) -> Table:
    events = newest_events(view.connection, view.require_run().id, _EVENTS)
    rows = [
        [round(event.sim_time_s, 3), event.kind, event.name, _details(event.details())]
        for event in events
    ]
    return Table(columns=["sim_time_s", "kind", "name", "data"], rows=rows)


def _details(details: Any) -> Any:
    return shorten(details, DETAIL_BUDGET).value


def _recorder(view: View) -> dict[str, Any] | None:
    """The health of the session that recorded the run."""
    session = view.session
    if view.run is not None and (session is None or session.id != view.run.session_id):
        session = fetch_session(view.connection, view.run.session_id)
    if session is None:
        return None
    error = cut_text(session.last_error, _ERROR_CHARACTERS) if session.last_error else None
    return {
        "rows_recorded": view.run.rows if view.run else 0,
        **({"kept_at_full_rate": kept} if (kept := _kept(view)) else {}),
        **rows_waiting(view.connection, session),
        "rows_dropped": session.rows_dropped,
        "last_error": error,
        "heartbeat_age_s": round(session.silent_s(view.now_s), 2),
        "polls_commands": session.last_poll_wall_time_s is not None,
        "controller": session.controller,
        "controller_sha256": session.controller_sha256,
        "git_commit": session.git_commit,
        "versions": session.versions,
    }


def _kept(view: View) -> str | None:
    """Which seconds of the run were kept last at full rate, and why."""
    newest = newest_kept(view.connection, view.run.id) if view.run else None
    if newest is None or view.run is None:
        return None
    span = f"{newest.start_s:.3f}-{newest.end_s:.3f} s"
    if newest.end_s > view.run.last_sim_time_s:
        span = f"{newest.start_s:.3f} s on, until {newest.end_s:.3f} s"
    return f"{span}: {cut_text(newest.reason, _ERROR_CHARACTERS)}"


def _replaced_in(state: State, part: dict[str, Any]) -> dict[str, str] | None:
    """The replaced values among those members of the state."""
    replaced = {
        path: kind
        for path, kind in state.odd_paths().items()
        if any(path == key or path.startswith(f"{key}.") for key in part)
    }
    return dict(list(replaced.items())[:_SHOWN_REPLACED]) or None


def _no_sensors(state: dict[str, Any]) -> str:
    if not state:
        raise NothingRecordedError("the newest state is empty")
    return (
        "no member of the state is named after a sensor device or like a sensor; "
        "webots_get_robot_state shows the whole state"
    )
