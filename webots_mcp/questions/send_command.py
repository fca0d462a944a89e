"""A controller's own actions, its parameters and its breakpoints, and what became of commands."""

from __future__ import annotations

import json
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Annotated, Any, Final, Literal

from anyio import to_thread
from pydantic import Field

from webots_mcp.answers.budget import (
    DETAIL_BUDGET_TOKENS,
    WHOLE,
    condensed,
    cut_text,
    fitting,
    header_of,
    is_for_a_person,
    seconds,
    short_name,
    shorten,
    table,
    tokens_of,
    without_empty,
)
from webots_mcp.answers.models import (
    BreakpointAnswer,
    BreakpointsAnswer,
    CommandAnswer,
    CommandsAnswer,
    ParametersAnswer,
)
from webots_mcp.contract import BUILT_IN_ACTIONS, BreakpointAction, CommandStatus
from webots_mcp.database import pauses as stored
from webots_mcp.database.queue import Command, list_commands
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.questions.declaring import (
    CHANGES,
    DESTROYS,
    READS,
    SETS,
    Caller,
    Cursor,
    Id,
    RobotName,
    RunId,
    TimeoutS,
    Value,
    merged,
    question,
)
from webots_mcp.signals.conditions import Condition, parse_condition
from webots_mcp.signals.naming import nearest_first
from webots_mcp.signals.parameter import MOST_PARAMETERS, require_known
from webots_mcp.steering.dispatch import Dispatcher, Report, find_target, holds_since, shown_result
from webots_mcp.store.parameters import COLUMNS, Declared, declared_by, described
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.requests import permit

# -- breakpoints: stored for the robot, and read again by its controller --

BREAKPOINT_COLUMNS: Final = (
    "id", "condition", "action", "after_hits", "hit_count", "newest_hit_run_id", "newest_hit_s",
    "set_by", "off_because",
)  # fmt: skip
_NOT_ASKED: Final = (
    "no controller of this robot runs to ask any: those that its code had set ended with it, those "
    "of webots_breakpoint stay and are armed when it starts again"
)
_ARMING_WAIT_S: Final = 5.0
_NO_PARAMS: Final[Mapping[str, Any]] = {}
_LONGEST_CONDITION: Final = 300
COMMAND_COLUMNS: Final = (
    "id", "action", "params", "outcome", "asked_ago_s", "took_s", "result", "error",
)  # fmt: skip
_WAIT_S: Final = 10.0
_ACTIONS_TOKENS: Final = 500
_DOCSTRINGS: Final = (2_000, 400, 200, 100, 50, 25)  # characters of each
_MORE_OF_ONE: Final = (  # in pieces as long as one cell of an answer may be
    'docstrings are cut: webots_query_sql("SELECT substr(value, 1, 200), substr(value, 201, 200) '
    "FROM session, json_each(actions) WHERE session.id = {} AND key = 'NAME'\") has more of one"
)
_COMMANDS_TOKENS: Final = 1_100
_LONGEST_TEXT: Final = 200
SET_WAIT_S: Final = 10.0
_ACTION: Final = "set_parameters"
_MOST_NEAR: Final = 5
_NONE: Final = (
    'this run has none: declare one in the controller with kp = bridge.parameter("kp", 2.0, '
    "low=0.0, high=10.0) and read kp.value in its loop"
)
_TAKES_NONE: Final = "this robot has no bridge: it takes no commands, and has no parameters"


@question("Set a breakpoint", CHANGES)
async def webots_breakpoint(
    recording: RecordingAccess,
    condition: Annotated[
        str,
        Field(
            max_length=500,
            description="On signals: front_m < 0.1 for 0.5; mode == 'turn' and displacement(3) "
            "< 0.05; changed(mode); abs(rate(v)) > 2; missing(gps.x); pose.0 > 1.",
        ),
    ],
    caller: Caller,
    action: Annotated[
        BreakpointAction,
        Field(description="keep records the seconds around at full rate, log only the hit."),
    ] = "pause",
    after_hits: Annotated[
        int, Field(ge=1, le=1_000_000, description="Act from this hit of a run on.")
    ] = 1,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Pause, or take note, when a condition begins to hold; asked at every publish() call.

    Each hit is an event with the values and the simulation time of that very step. It is stored,
    and armed again after a reset or reload.
    """
    parsed = parse_condition(condition)
    if action != "log":  # what the bridge does at a hit is not asked for again
        await to_thread.run_sync(permit, recording, action, _NO_PARAMS)
    name, number, notes = await to_thread.run_sync(
        _store, recording, robot, parsed, action, after_hits, caller.client
    )
    reply, why_not = await _arm(recording, caller, name)
    if action == "pause" and reply.get("cannot_pause"):
        notes.append(f"it will record its hits, but not pause: {reply['cannot_pause']}")
    armed = number in reply.get("armed", ())
    return BreakpointAnswer(
        **await to_thread.run_sync(header_of, recording, name),
        breakpoint_id=number,
        condition=parsed.text,
        action=action,
        armed=armed,
        notes=notes or None,
        hint=None if armed else f"it is stored, but not armed yet: {why_not}",
    )


@question("List the breakpoints", READS)
def webots_list_breakpoints(
    recording: RecordingAccess, robot: RobotName = None
) -> BreakpointsAnswer:
    """The robot's breakpoints, how often each was hit, and when last."""
    with recording.view(robot) as view:
        listed = stored.list_breakpoints(view.connection, view.robot.id)
        rows = [_breakpoint_row(view, each) for each in listed]
        shown = fitting(rows)
        more = f"{len(shown)} of {len(rows)}: webots_query_sql has all in table breakpoint"
        none = "this robot has none: webots_breakpoint sets one"
        hints = [more] * (len(shown) < len(rows))
        hints += [none] * (not rows) + [_NOT_ASKED] * (not view.robot.live)
        return BreakpointsAnswer(
            **view.header(),
            breakpoints=table(BREAKPOINT_COLUMNS, shown),
            hint="; ".join(hints) or None,
        )


@question("Remove a breakpoint", CHANGES)
async def webots_remove_breakpoint(
    recording: RecordingAccess,
    breakpoint_id: Annotated[Id, Field(description="From webots_breakpoint.")],
    caller: Caller,
    robot: RobotName = None,
) -> BreakpointAnswer:
    """Remove a breakpoint. The events of its hits stay; a paused simulation stays paused."""
    name = await to_thread.run_sync(_remove, recording, robot, breakpoint_id)
    reply, why_not = await _arm(recording, caller, name)
    return BreakpointAnswer(
        **await to_thread.run_sync(header_of, recording, name),
        breakpoint_id=breakpoint_id,
        armed=breakpoint_id in reply.get("armed", ()),
        hint=f"removed; {why_not}" if why_not else None,
    )


def _store(
    recording: RecordingAccess, robot: str | None, condition: Condition, *asked: Any
) -> tuple[str, int, list[str]]:
    """Name of the robot, id of the breakpoint, and notes on its signals."""
    with recording.view(robot) as view:
        name, robot_id, notes = view.robot.name, view.robot.id, _notes(view, condition)
    with recording.writer() as connection:
        return name, stored.set_breakpoint(connection, robot_id, condition.text, *asked), notes


def _notes(view: RobotView, condition: Condition) -> list[str]:
    if view.run is None:
        return condition.describe_unknown(())
    subject = Subject(view.robot.id, view.robot.name, view.run.id)
    notes = condition.describe_unknown(catalogue(view.connection, subject))
    try:
        holds_since(view.connection, view.run.id, condition)
    except InvalidInputError as error:
        notes.append(f"it will be turned off by the next state like the last ones: {error}")
    return notes


def _remove(recording: RecordingAccess, robot: str | None, breakpoint_id: int) -> str:
    with recording.view(robot) as view:
        name, robot_id = view.robot.name, view.robot.id
    with recording.writer() as connection:
        stored.remove_breakpoint(connection, robot_id, breakpoint_id)
    return name


async def _arm(
    recording: RecordingAccess, caller: Caller, robot: str
) -> tuple[dict[str, Any], str]:
    """Let the controller read its breakpoints again; its reply, or why there is none."""
    dispatcher = Dispatcher(recording, caller.report)
    try:
        answer = await dispatcher.ask(robot, "arm_breakpoints", _ARMING_WAIT_S)
    except CommandRefusedError as refused:
        return {}, f"{refused}. A controller of this robot reads them when it starts"
    if answer.outcome != "done":
        reason = answer.error or answer.hint or f"the controller's answer was {answer.outcome}"
        return {}, f"{reason}. It will read them at the next reset in any case"
    return answer.result, ""


def _breakpoint_row(view: RobotView, each: stored.StoredBreakpoint) -> list[Any]:
    """A breakpoint as a row under `BREAKPOINT_COLUMNS`."""
    hit = stored.newest_hit(view.connection, each.robot_id, each.id) if each.hit_count else None
    run_id, time_s = hit or (None, None)
    return [
        each.id,
        cut_text(each.condition, _LONGEST_CONDITION),
        each.action,
        each.after_hits,
        each.hit_count,
        run_id,
        time_s if time_s is None else round(time_s, 3),
        each.created_by,
        cut_text(each.error, _LONGEST_CONDITION) if each.error else None,
    ]


@question(
    "Send a command",
    DESTROYS,
    command="send",
    positional=("action", "params"),
    options={"params": "NAME=VALUE"},
    example="go_to x=1.5 y=-0.5",
    core=True,
    quotes=True,
    of_controller="params",
)
async def webots_send_command(
    recording: RecordingAccess,
    action: Annotated[
        str, Field(min_length=1, max_length=200, description="As in webots_list_commands.")
    ],
    caller: Caller,
    params: Annotated[dict[str, Any] | None, Field(description="As its docstring says.")] = None,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Have the controller run one of its own actions, at most once, and wait for its answer.

    webots_list_commands lists them.
    """
    dispatcher = Dispatcher(recording, caller.report)
    return await dispatcher.ask(robot, action, timeout_wall_s, params)


@question(
    "Wait for a command",
    READS,
    command="wait",
    positional=("command_id",),
    options={"command_id": "COMMAND"},
    quotes=True,
)
async def webots_wait_for_command(
    recording: RecordingAccess,
    command_id: Annotated[Id, Field(description="From its answer.")],
    caller: Caller,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Go on waiting for a command that was still under way when its call was answered."""
    return await Dispatcher(recording, caller.report).wait(command_id, timeout_wall_s)


@question("List the commands", READS, command="commands", core=True, quotes=True)
def webots_list_commands(
    recording: RecordingAccess,
    limit: Annotated[int, Field(ge=1, le=200, description="Most shown.")] = 10,
    status: Annotated[CommandStatus | None, Field(description="Only those.")] = None,
    cursor: Cursor = None,
    robot: RobotName = None,
) -> CommandsAnswer:
    """The robot's actions with their docstrings, and its newest commands with their outcome."""
    with recording.view(robot) as view:
        recording.settle()
        commands = list_commands(
            view.connection, view.robot.id, limit=limit, status=status, before_id=cursor
        )
        return _answer(view, commands, limit)


def _command_row(command: Command, now_s: float) -> list[Any]:
    """A command as a row under `COMMAND_COLUMNS`."""
    took_s = None
    if command.finished_wall_time_s is not None:
        took_s = round(command.finished_wall_time_s - command.created_wall_time_s, 3)
    return [
        command.id,
        command.action,
        shorten(json.loads(command.params), DETAIL_BUDGET_TOKENS).value or None,
        command.status,
        round(now_s - command.created_wall_time_s, 1),
        took_s,
        shown_result(command, DETAIL_BUDGET_TOKENS),
        cut_text(command.error, _LONGEST_TEXT) if command.error else None,
    ]


def _answer(view: RobotView, commands: list[Command], limit: int) -> CommandsAnswer:
    rows = [_command_row(command, view.now_s) for command in commands]
    rows = fitting(rows, _COMMANDS_TOKENS)
    more = len(rows) < len(commands) or len(commands) == limit
    actions = view.session.actions if view.session else {}
    shown = _shown_actions(actions)
    has_bridge = view.session is None or view.session.has_bridge
    nothing = "no such command was sent to this robot yet" if has_bridge else _TAKES_NONE
    hints = [nothing] * (not commands)
    hints += [_MORE_OF_ONE.format(view.session.id)] if view.session and shown != actions else []
    hints += [f"{len(shown)} of {len(actions)} actions are shown"] * (len(shown) < len(actions))
    return CommandsAnswer(
        **view.header(),
        commands=condensed(COMMAND_COLUMNS, rows),
        cursor=commands[len(rows) - 1].id if more else None,
        actions=shown,
        built_in=list(BUILT_IN_ACTIONS) if has_bridge else [],
        hint="; ".join(hints) or None,
    )


def _shown_actions(actions: Mapping[str, str]) -> dict[str, str]:
    """The registered actions with as much of their docstrings as fits beside all the names.

    A controller that registers none sees commands in its loop.
    """
    if is_for_a_person():
        return dict(actions)
    for longest in _DOCSTRINGS:
        shown = {name: cut_text(text, longest) for name, text in actions.items()}
        if tokens_of(shown) <= _ACTIONS_TOKENS:
            return shown
    named = [(short_name(name) or "", "…" if text else "") for name, text in actions.items()]
    return dict(fitting(named, _ACTIONS_TOKENS))


# -- parameters --

When = Literal["now", "reset"]


async def set_parameters(
    recording: RecordingAccess,
    report: Report,
    values: Mapping[str, Value],
    *,
    when: When = "now",
    robot: str | None = None,
    timeout_s: float = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters, all or none, and wait for the outcome.

    Raises:
        InvalidInputError: A name is unknown, or a value is out of bounds or of another type.
        CommandRefusedError: No live controller could set them.
        NothingRecordedError: There is no robot.
    """
    declared = await to_thread.run_sync(settable, recording, robot)
    require_known(list(values), list(declared))
    for name, value in values.items():
        declared[name].declaration.checked(value)
    params = {"values": dict(values), "when": when}
    return await Dispatcher(recording, report).ask(robot, _ACTION, timeout_s, params)


def settable(recording: RecordingAccess, robot: str | None) -> dict[str, Declared]:
    """The parameters that a live controller declares.

    Raises:
        InvalidInputError, CommandRefusedError, NothingRecordedError: As `set_parameters`.
    """
    with recording.reader() as connection:
        session = find_target(connection, robot, _ACTION).session
        return declared_by(connection, session.id) if session else {}


def _none(view: RobotView) -> str:
    return _NONE if view.session is None or view.session.has_bridge else _TAKES_NONE


@question("Get the parameters", READS, quotes=True)
def webots_get_parameters(
    recording: RecordingAccess,
    names: Annotated[
        list[str] | None, Field(max_length=50, description="Of parameters; '*' is any text.")
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> ParametersAnswer:
    """What can be tuned while the controller runs: each parameter with value, bounds and setter.

    `since_s` is the simulation time from which on it has the value, `next` what it will have from
    the next reset on. Of an earlier run: its last values.
    """
    with recording.view(robot, run_id) as view:
        rows = _shown_rows(view, names)
        told = fitting(rows)
        hints = [f"{len(told)} of {len(rows)}: names shows others"] * (len(told) < len(rows))
        return ParametersAnswer(
            **view.header(),
            parameters=without_empty(COLUMNS, told),
            total=len(rows),
            hint="; ".join(hints) or (None if rows else _none(view)),
        )


@question("Set parameters", SETS, core=True, of_controller="values")
async def webots_set_parameters(
    recording: RecordingAccess,
    values: Annotated[
        dict[str, Value],
        Field(min_length=1, max_length=MOST_PARAMETERS, description='{"kp": 3.0, "gait": "trot"}'),
    ],
    caller: Caller,
    when: Annotated[When, Field(description="reset: from the next one on.")] = "now",
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = SET_WAIT_S,
) -> CommandAnswer:
    """Set parameters of a running controller, all or none, between two rounds of its loop.

    Answers with old and new values and from which simulation time on. A reset keeps them; a reload
    begins with those in the code.
    """
    return await set_parameters(
        recording, caller.report, values, when=when, robot=robot, timeout_s=timeout_wall_s
    )


def _shown_rows(view: RobotView, names: list[str] | None) -> list[list[Any]]:
    found = described(view.connection, view.run) if view.run else []
    meant = _meant(names, [each["name"] for each in found])
    return [
        [_shown(column, each[column]) for column in COLUMNS]
        for each in found
        if each["name"] in meant
    ]


def _shown(column: str, value: Any) -> Any:
    """Times as everywhere; values and bounds as they are, for they may be sent back."""
    if column == "since_s":
        return seconds(value)
    return shorten(value, DETAIL_BUDGET_TOKENS, WHOLE).value


def _meant(patterns: list[str] | None, known: list[str]) -> set[str]:
    """The known names that match.

    Raises:
        InvalidInputError: A pattern matches none.
    """
    meant = set(known) if patterns is None else set[str]()
    for pattern in patterns or ():
        found = {name for name in known if fnmatchcase(name, pattern)}
        if not found:
            near = ", ".join(nearest_first(pattern, known)[:_MOST_NEAR]) or "none"
            raise InvalidInputError(f"no parameter {pattern!r:.80}; the nearest are: {near}")
        meant |= found
    return meant


COMMANDS: Final = merged(
    webots_list_commands,
    choice="what",
    meaning="outcome: waits for command_id; parameters: what can be tuned, values and bounds; "
    "breakpoints: and their hits.",
    parts={
        "commands": webots_list_commands,
        "outcome": webots_wait_for_command,
        "parameters": webots_get_parameters,
        "breakpoints": webots_list_breakpoints,
    },
    text="""\
The controller's own actions with their docstrings, and what became of the newest commands.""",
)
BREAKPOINT: Final = merged(
    webots_breakpoint,
    choice="change",
    meaning="remove: takes breakpoint_id; the events of its hits stay.",
    parts={"set": webots_breakpoint, "remove": webots_remove_breakpoint},
    text="""\
Pause, or take note, when a condition begins to hold; asked at every publish() call.

Each hit is an event with the values of that step. Armed again after a reset or reload.""",
)
