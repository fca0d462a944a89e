"""What is recorded now: the robots, their world, the newest state, and what is not well."""

from __future__ import annotations

import re
import sqlite3
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, cast

from pydantic import Field

from webots_mcp.answers.budget import (
    ANSWER_TOKENS,
    LARGE_ANSWER_TOKENS,
    STATE_BUDGET_TOKENS,
    WHOLE,
    Shortened,
    compact_json,
    cut_for_a_model,
    cut_text,
    detailed,
    fitting,
    is_for_a_person,
    room_tokens,
    round_number,
    shorten,
    some,
    tokens_in,
    tokens_of,
)
from webots_mcp.answers.models import (
    DiagnosisAnswer,
    FullStateAnswer,
    RobotsAnswer,
    SensorsAnswer,
    StateAnswer,
    Table,
    WorldAnswer,
)
from webots_mcp.contract import CUSTOM_DATA
from webots_mcp.database.liveness import dead_sessions
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.questions.declaring import READS, RobotName, RunId, question
from webots_mcp.setup.doctor import Checked, diagnose, subject_of, worst
from webots_mcp.signals.naming import OBSERVED
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.observed_pose import pose_at
from webots_mcp.store.reading.segment import Deadline, Segment, just_after, newest_kept
from webots_mcp.store.recording import (
    GETTING_STARTED,
    RecordingAccess,
    RobotView,
    name_of,
    storage,
    view_of,
)
from webots_mcp.store.retention import described, unheeded
from webots_mcp.store.retention_plan import file_sizes
from webots_mcp.store.robots import (
    RobotRecord,
    SessionRecord,
    WorldSeen,
    companions,
    console_trouble,
    fetch_session,
    list_robots,
    nothing_recorded,
    rows_waiting,
    world_seen,
)
from webots_mcp.store.run_rows import (
    RunRecord,
    StateRecord,
    count_runs,
    newest_events,
    pace_of,
    real_time_factor,
    select,
)

# -- which robots there are, and in which world --

_SHOWN_ROBOTS: Final = 50
_SHOWN_IN_WORLD: Final = 40
_TOLD_IN_WORLD: Final = ("key", "type", "def", "name", "controller", "on_robot")  # as they differ
_PLACE: Final = ("x_m", "y_m", "z_m", "heading_rad", "speed_mps")
_DEVICES_TOKENS: Final = 300
_COMPANIONS_TOKENS: Final = 200
_LONGEST_NAME: Final = 100
_RECORDER_COLUMNS: Final = (
    "row_count", "why", "pace", "rows_waiting", "waiting_in", "rows_dropped", "last_error",
)  # fmt: skip
_LONGEST_ERROR: Final = 300
_READ: Final = "the observer, from customData: it has no bridge and takes no commands"
_ROBOT_COLUMNS: Final = (
    "robot", "kind", "live", "status", "run_id", "sim_time_s", "age_s", "runs", "actions",
)  # fmt: skip
_LONGEST_TEXT: Final = 320
_BUDGET_TOKENS: Final = 1_250  # the checks beyond it are told by name
_PUBLISH: Final = (
    "nothing was recorded in this run yet: of the calls of bridge.publish({...}) in the "
    "controller's loop every 5th is by default (throttle_interval), or each one with force=True"
)
_EARLIER: Final = "SELECT max(id) FROM run WHERE robot_id = ? AND id < ? AND row_count > 0"
_PURGED: Final = "SELECT purged_rows FROM run WHERE id = ?"
_EVENTS: Final = 10
_EVENTS_TOKENS: Final = 250
_PAGE: Final = 500  # members, items or characters where it was not said how many
_SHOWN_NAMES: Final = 6
_MARGIN_TOKENS: Final = 200  # for hints
_SHOWN_REPLACED: Final = 20
_NULL: Final = "the value at this path is null"  # which an answer leaves out
_SHOWN_DEVICES: Final = 30
_ERROR_CHARACTERS: Final = 300
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
_MOST_ITEMS: Final = 64  # of an array, each of which may be a device
_HUMP: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_WORD: Final = re.compile(r"[^\W\d_]+|\d+")


@question("List the robots", READS, command="status", core=True)
def webots_list_robots(recording: RecordingAccess) -> RobotsAnswer:
    """Every robot ever recorded: whether it is live, whether its time moves, its current run.

    `actions` counts its own commands; webots_list_commands describes them.
    """
    told = is_for_a_person()
    with recording.reader() as connection:
        now_s = time.time()
        robots = list_robots(connection, now_s)
        none = f"{nothing_recorded(connection)}. {GETTING_STARTED}"
        if not robots and not told:
            raise NothingRecordedError(none)
        views = _fitting([view_of(connection, robot, now_s) for robot in _liveliest(robots)])
        live = [view for view in views if view.robot.live]
        return RobotsAnswer(
            **(live[0].header() if len(live) == 1 else storage(connection)),
            robots=_robots(views, told=told) if views else None,
            database=name_of(recording.database) if told else None,
            retention=_retention(recording, connection) if told else None,
            hint=_hint_of_robots(connection, robots, len(views)) if robots else none,
        )


def _hint_of_robots(
    connection: sqlite3.Connection, robots: Sequence[RobotRecord], shown: int
) -> str | None:
    if len(robots) > shown:
        return f"{len(robots)} robots in all, the latest {shown} are shown"
    is_any_live = any(robot.live for robot in robots)
    return None if is_any_live else console_trouble(connection)


@question("Get world information", READS)
def webots_get_world_info(
    recording: RecordingAccess, robot: RobotName = None, run_id: RunId = None
) -> WorldAnswer:
    """The world file, its time step, the run and its pace, the controller's code, other robots.

    With an observer (webots-mcp init --observer) where all robots are. Also where the recording
    lies.
    """
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        session = fetch_session(view.connection, run.session_id)
        others = _companions(view)
        shown = others if is_for_a_person() else fitting(others, _COMPANIONS_TOKENS)
        more = f"{len(others) - len(shown)} more robots beside it: webots_list_robots"
        answer = WorldAnswer(
            **view.header(),
            world=run.world,
            basic_time_step_ms=run.basic_time_step_ms,
            real_time_factor=_pace(view, run),
            supervisor=session.supervisor if session else None,
            run=_run(view, run),
            runs_recorded=count_runs(view.connection, view.robot.id),
            controller=_controller(view, session),
            devices=_devices(view.robot.devices),
            other_robots=Table(columns=["robot", "kind", "pause_state"], rows=shown)
            if shown
            else None,
            database=name_of(recording.database),
            retention=_retention(recording, view.connection),
            data_dir=str(recording.data_dir),
        )
        room = room_tokens(beside=answer.model_dump(exclude_none=True))
        seen = _seen(world_seen(view.connection, run), room)
        hints = [seen.pop("hint", None), more if len(shown) < len(others) else None]
        return answer.model_copy(update=seen | {"hint": "; ".join(filter(None, hints)) or None})


def _robots(views: list[RobotView], *, told: bool) -> Table:
    """A row for each; what could not be recorded only where there is any, or for a person."""
    columns, rows = [*_ROBOT_COLUMNS], [_row(view) for view in views]
    recorders = [_recorder(view) for view in views]
    for name in _RECORDER_COLUMNS:
        values = [recorder[name] for recorder in recorders]
        if any(values) and (told or name not in ("row_count", "why")):
            columns.append(name)
            for row, value in zip(rows, values, strict=True):
                row.append(value)
    return Table(columns=columns, rows=rows)


def _recorder(view: RobotView) -> dict[str, Any]:
    """What a robot's session has recorded of its run, and what it could not."""
    session = view.session
    error = session.last_error if session else None
    return {
        "row_count": view.run.row_count if view.run else 0,
        "why": view.header().get("why"),
        "pace": view.run and pace_of(view.connection, "it", view.run.id),
        "waiting_in": None,
        **rows_waiting(view.connection, session),
        "rows_dropped": session.rows_dropped if session else 0,
        "last_error": error and cut_for_a_model(error, _LONGEST_ERROR),
    }


def _seen(world: WorldSeen | None, budget_tokens: int) -> dict[str, Any]:
    """What an observer has seen of the world, robots first."""
    if world is None:
        return {}
    bodies = [*world.content.get("robots", ()), *world.content.get("solids", ())]
    shown = [body | world.places.get(body["key"], {}) for body in bodies[:_SHOWN_IN_WORLD]]
    used = [
        column
        for column in (*_TOLD_IN_WORLD, *_PLACE)
        if any(body.get(column) is not None for body in shown)
    ]
    rows = fitting([_in_world(body, used) for body in shown], budget_tokens)
    more = f"the first {len(rows)} of {len(bodies)} bodies are shown"
    return {
        "title": world.content.get("title"),
        "observer": world.observer,
        "in_world": Table(columns=used, rows=rows),
        "hint": more if len(rows) < len(bodies) or world.content.get("more") else None,
    }


def _in_world(body: dict[str, Any], columns: list[str]) -> list[Any]:
    values = [body.get(column) for column in columns]
    return [
        round_number(value)
        if isinstance(value, float)
        else cut_text(value, _LONGEST_NAME)
        if isinstance(value, str)
        else value
        for value in values
    ]


def _retention(recording: RecordingAccess, connection: sqlite3.Connection) -> dict[str, Any]:
    """What is kept of the recording, how large it is, and which limits of ours do not hold."""
    notes = unheeded(connection, recording.limits)
    return {
        "kept": described(connection),
        **file_sizes(connection),
        **({"not_in_force": notes} if notes else {}),
    }


def _liveliest(robots: list[Any]) -> list[Any]:
    """Those seen last, where there are too many to show; the latest first."""
    latest = sorted(robots, key=lambda robot: (robot.live, robot.last_seen_wall_time_s))
    return latest[::-1][:_SHOWN_ROBOTS]


def _fitting(views: list[RobotView]) -> list[RobotView]:
    """The first that fit, in the order of their first appearance."""
    fitting_rows = fitting([[*_row(view), *_recorder(view).values()] for view in views])
    return sorted(views[: len(fitting_rows)], key=lambda view: view.robot.id)


def _row(view: RobotView) -> list[Any]:
    header, session = view.header(), view.session
    runs = count_runs(view.connection, view.robot.id)
    newest = [header[name] for name in ("status", "run_id", "sim_time_s", "age_s")]
    actions = len(session.actions) if session else 0
    name = cut_text(view.robot.name, _LONGEST_NAME)
    return [name, view.robot.kind, view.robot.live, *newest, runs, actions]


def _pace(view: RobotView, run: RunRecord) -> float | None:
    factor = real_time_factor(view.connection, run.id)
    return None if factor is None else round_number(factor)


def _run(view: RobotView, run: RunRecord) -> dict[str, Any]:
    """What the run is; `rows` is as of its last heartbeat."""
    end_reason = run.end_reason or dict(dead_sessions(view.connection)).get(run.session_id)
    ended = {"ended_by": end_reason} if end_reason is not None else {}
    return {
        "id": run.id,
        "began_by": run.start_reason,
        "began_ago_s": view.age_s(run.started_wall_time_s),
        "sim_duration_s": round(run.last_sim_time_s - run.started_sim_time_s, 3),
        "row_count": run.row_count,
        **ended,
    }


def _controller(view: RobotView, session: SessionRecord | None) -> dict[str, Any] | None:
    if session is None:
        return None
    if view.robot.kind == CUSTOM_DATA:  # its own process and code are not known
        return {"file": session.controller, "recorded_by": _READ}
    return {
        "file": session.controller,
        "sha256": session.controller_sha256,
        "git_commit": session.git_commit,
        "pid": session.pid,
        "host": session.host,
        **session.versions,
    }


def _devices(devices: dict[str, str]) -> dict[str, str] | None:
    return shorten(devices, _DEVICES_TOKENS).value or None


def _companions(view: RobotView) -> list[list[str]]:
    if view.session is None:
        return []
    others = companions(view.connection, view.session, view.now_s)
    robots = {robot.id: robot for robot in list_robots(view.connection, view.now_s)}
    return [
        [robots[other.robot_id].name, robots[other.robot_id].kind, other.pause_state or ""]
        for other in others
    ]


# -- why nothing works --


@question("Diagnose the set-up", READS, core=True)
def webots_diagnose(recording: RecordingAccess) -> DiagnosisAnswer:
    """When nothing comes, or time stands still: each link from Webots and controller to here.

    Data folder, database, who records, what waits, why the simulation stands, which Webots run,
    client files.
    """
    checked = diagnose(subject_of(recording, "how this server was started"))
    return DiagnosisAnswer(
        verdict=worst([each.finding for each in checked]).verdict,
        failed=_failed(checked) or None,
        not_checked=_by_reason(checked) or None,
        passed=", ".join(each.check.name for each in checked if each.is_well),
    )


def _failed(checked: Sequence[Checked]) -> list[dict[str, str]]:
    """What is wrong before what might be."""
    told: list[dict[str, str]] = []
    left = _BUDGET_TOKENS
    for verdict in ("wrong", "warning"):
        for check, finding in checked:
            if finding.verdict == verdict:
                head = {"check": check.name, "verdict": verdict}
                texts = {"seen": finding.seen, "fix": finding.fix or ""}
                cut = {name: cut_text(text, _LONGEST_TEXT) for name, text in texts.items() if text}
                left -= sum(map(tokens_in, cut.values()))
                told.append(head | (cut if left > 0 else {}))
    return told


def _by_reason(checked: Sequence[Checked]) -> dict[str, str]:
    names: dict[str, list[str]] = {}
    for check, finding in checked:
        if finding.verdict == "not checked":
            names.setdefault(cut_text(finding.seen, _LONGEST_TEXT), []).append(check.name)
    return {reason: ", ".join(those) for reason, those in names.items()}


PagePath = Annotated[
    str,
    Field(max_length=1000, description="Dotted path, as sensors.lidar."),
]
Offset = Annotated[int, Field(ge=0, description="First member, item or character at the path.")]
PageSize = Annotated[int | None, Field(ge=1, le=2000, description="So many, up to 10,000 tokens.")]


@question("Get the robot's state", READS, core=True, quotes=True)
def webots_get_robot_state(
    recording: RecordingAccess, robot: RobotName = None, run_id: RunId = None
) -> StateAnswer:
    """The robot now, at a glance: its newest published state, rounded, long arrays summed up.

    webots_get_full_state has a part of it whole and exact.
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
    """The newest sensor values: members of the state named after a sensor device or like one."""
    with recording.view(robot, run_id) as view:
        if view.state is None:
            return SensorsAnswer(**view.header(), hint=_nothing_yet(view))
        state = view.state.value()
        sensors = sensor_part(state, view.robot.devices)
        unnamed = unnamed_devices(state, view.robot.devices)
        missing = [f"{name} ({kind})" for name, kind in unnamed.items()]
        replaced, not_named = _replaced_in(view.state, sensors), some(missing, _SHOWN_DEVICES)
        left_tokens = ANSWER_TOKENS - _MARGIN_TOKENS - tokens_of([replaced, not_named])
        short = shorten(sensors, min(STATE_BUDGET_TOKENS, left_tokens))
        return SensorsAnswer(
            **view.header(),
            sensors=short.value,
            replaced=replaced,
            devices_not_named_in_state=not_named or None,
            shortened=short.rule,
            hint=None if sensors else _no_sensors(state),
        )


@question("Get the full state", READS, core=True, quotes=True)
def webots_get_full_state(
    recording: RecordingAccess,
    path: PagePath = "",
    offset: Offset = 0,
    limit: PageSize = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> FullStateAnswer:
    """A part of the newest state, whole and exact, in pages: what webots_get_robot_state shortens.

    Without a path also the newest events and the recorder's health.
    """
    with recording.view(robot, run_id) as view:
        if view.state is None:
            hint, recorder = _nothing_yet(view), _health(view)
            return FullStateAnswer(**view.header(), hint=hint, recorder=recorder)
        part = select(_with_observed_pose(view, view.state), path)
        if offset and not isinstance(part, (dict, list, str)):
            raise InvalidInputError(f"offset: {path!r:.80} is a single value, not in pages")
        beside: dict[str, Any] = view.header()
        if not (path or offset):
            beside |= {"replaced": _some_replaced(view.state.replaced_paths())}
            beside |= {"events": _events(view), "recorder": _health(view)}
        most_tokens = ANSWER_TOKENS if limit is None else LARGE_ANSWER_TOKENS
        told = {
            name: each.model_dump() if name == "events" else each for name, each in beside.items()
        }
        left_tokens = most_tokens - _MARGIN_TOKENS - tokens_of(told)
        return FullStateAnswer(**_page(part, path, offset, limit or _PAGE, left_tokens), **beside)


def _with_observed_pose(view: RobotView, state: StateRecord) -> dict[str, Any]:
    """The state, with where an observer saw the robot if it has no position of its own."""
    value = state.value()
    if OBSERVED in value:
        return value
    moment = Segment(state.run_id, state.sim_time_s, just_after(state.sim_time_s))
    frame = read_frame(view.connection, moment, Deadline())
    pose = pose_at(frame.derived, state.sim_time_s)
    return {**value, OBSERVED: pose} if pose else value


def _nothing_yet(view: RobotView) -> str:
    """A robot that published before a reset will publish again."""
    run_id = view.run.id if view.run else 0
    (purged_rows,) = view.connection.execute(_PURGED, (run_id,)).fetchone() or (0,)
    if purged_rows:
        return (
            f"the newest states of this run are gone: retention has deleted {purged_rows}; for "
            "their values, as far as chunks hold them, webots_get_trends or webots_query_history"
        )
    earlier = view.connection.execute(_EARLIER, (view.robot.id, run_id)).fetchone()[0]
    if earlier is None:
        return _PUBLISH
    return (
        f"nothing was recorded in this run yet, but in an earlier one (run_id={earlier}): ask "
        "again when the controller has published"
    )


def _page(part: Any, path: str, offset: int, limit: int, budget_tokens: int) -> dict[str, Any]:
    """What fits of a value; of an object, an array or a text from `offset` on."""
    if not isinstance(part, (dict, list, str)):
        return {"path": path, "state": part, "hint": _NULL if part is None else None}
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
            hints.append(f"path=... shows these in pages: {some([*cut], _SHOWN_NAMES)}")
        page = page if named else [*page.values()]
    end = offset + len(page)
    if end < len(whole) and isinstance(whole, dict):
        left_out = [*whole][end:]
        hints.append(
            f"not shown: {some(left_out, _SHOWN_NAMES)}; ask with offset={end}, with path=... for "
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
    """The first members that fit, at least one.

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
    """The size to which the largest must come down for all of them to fit."""
    for smaller, size in enumerate(sorted(sizes)):
        share = budget // (len(sizes) - smaller)
        if size > share:
            return share
        budget -= size
    return max(sizes, default=0)


def _events(view: RobotView) -> Table:
    """The newest events that fit, the oldest of them first."""
    events = newest_events(view.connection, view.require_run().id, _EVENTS)
    rows = [
        [round(event.sim_time_s, 3), event.kind, event.name, detailed(event.details())]
        for event in reversed(events)
    ]
    shown = fitting(rows, _EVENTS_TOKENS)[::-1]
    return Table(columns=["sim_time_s", "kind", "name", "data"], rows=shown)


def _health(view: RobotView) -> dict[str, Any] | None:
    """The health of the session that recorded the run."""
    session = view.session
    if view.run is not None and (session is None or session.id != view.run.session_id):
        session = fetch_session(view.connection, view.run.session_id)
    if session is None:
        return None
    error = cut_text(session.last_error, _ERROR_CHARACTERS) if session.last_error else None
    return {
        "rows_recorded": view.run.row_count if view.run else 0,
        **({"kept_at_full_rate": kept} if (kept := _kept(view)) else {}),
        **rows_waiting(view.connection, session),
        "rows_dropped": session.rows_dropped,
        "last_error": error,
        "heartbeat_age_s": round(session.silent_s(view.now_s), 2),
        "polls_commands": session.last_poll_wall_time_s is not None,
        **({"recorded_by": _READ} if view.robot.kind == CUSTOM_DATA else {}),
        "controller": session.controller,
        "controller_sha256": session.controller_sha256,
        "git_commit": session.git_commit,
        "versions": session.versions,
    }


def _kept(view: RobotView) -> str | None:
    """Which seconds of the run were kept last at full rate, and why."""
    newest = newest_kept(view.connection, view.run.id) if view.run else None
    if newest is None or view.run is None:
        return None
    span = f"{newest.start_s:.3f}-{newest.end_s:.3f} s"
    if newest.end_s > view.run.last_sim_time_s:
        span = f"{newest.start_s:.3f} s on, until {newest.end_s:.3f} s"
    return f"{span}: {cut_text(newest.reason, _ERROR_CHARACTERS)}"


def _replaced_in(state: StateRecord, part: dict[str, Any]) -> dict[str, str] | None:
    """The replaced values among those members of the state."""
    replaced = {
        path: kind
        for path, kind in state.replaced_paths().items()
        if any(path == key or path.startswith(f"{key}.") for key in part)
    }
    return _some_replaced(replaced)


def _some_replaced(replaced: Mapping[str, str]) -> dict[str, str] | None:
    """The first of them, and how many more there are; None without any."""
    shown = dict(list(replaced.items())[:_SHOWN_REPLACED])
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


# -- sensor values in a published state --


def sensor_part(state: dict[str, Any], devices: dict[str, str]) -> dict[str, Any]:
    """The members of a state that have the name of a sensor of the robot, or a sensor's word."""
    sensors = _sensor_devices(devices)
    return {key: state[key] for key in state if key in sensors or _has_sensor_word(key)}


def _sensor_devices(devices: dict[str, str]) -> dict[str, str]:
    """The devices that are sensors: name to class."""
    return {name: kind for name, kind in devices.items() if kind not in _NO_SENSORS}


def unnamed_devices(state: dict[str, Any], devices: dict[str, str]) -> dict[str, str]:
    """The sensor devices whose name is in no name of the published values.

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
    """The path of each member at any depth, and of the first items of arrays."""
    yield path
    if isinstance(value, dict):
        for key, member in cast("dict[str, Any]", value).items():
            yield from _paths(member, f"{path}.{key}")
    elif isinstance(value, list):
        for index, item in enumerate(cast("list[Any]", value)[:_MOST_ITEMS]):
            yield from _paths(item, f"{path}.{index}")


def _words(name: str) -> set[str]:
    return set(_WORD.findall(_HUMP.sub(" ", name).lower()))
