"""Sending a controller its own actions, and listing what became of commands.

A command runs at most once; its outcome can be waited for later.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.answers.answer_models import (
    CommandAnswer,
    CommandsAnswer,
)
from webots_mcp.answers.budget import (
    DETAIL_BUDGET_TOKENS,
    condensed,
    fitting,
    seconds,
    short_name,
)
from webots_mcp.answers.shortening import cut_text, is_for_a_person, shorten, tokens_of
from webots_mcp.contract import BUILT_IN_ACTIONS, CommandStatus
from webots_mcp.database.queue import QueuedCommand, list_commands
from webots_mcp.questions.arguments import Cursor, Id, RobotName, TimeoutS
from webots_mcp.questions.declaration import DESTROYS, READS, Caller, question
from webots_mcp.steering.command_answer import shown_result
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.store.recording import RecordingAccess, RobotView

COMMAND_COLUMNS: Final = (
    "id", "action", "params", "outcome", "run_id", "sim_time_s", "asked_ago_wall_s", "took_wall_s",
    "result", "error",
)  # fmt: skip
_WAIT_S: Final = 10.0
NO_BRIDGE: Final = "this robot has no bridge: it takes no commands, and has no parameters"


@dataclass(frozen=True)
class CommandListSizes:
    """How much of actions and commands an answer shows.

    Attributes:
        actions_tokens: Budget of the actions.
        commands_tokens: Budget of the commands.
        error_characters: Characters of an error.
        docstring_characters: Characters of each docstring: the first length with which all actions
            fit.
    """

    actions_tokens: int = 500
    commands_tokens: int = 1_100
    error_characters: int = 200
    docstring_characters: tuple[int, ...] = (2_000, 400, 200, 100, 50, 25)


_SIZES: Final = CommandListSizes()


@question(
    "Send a command",
    DESTROYS,
    command="send",
    positional=("action", "params"),
    options={"params": "NAME=VALUE"},
    example="go_to x=1.5 y=-0.5",
    quotes=True,
    of_controller="params",
    tier="core",
)
async def webots_send_command(
    recording: RecordingAccess,
    action: Annotated[
        str,
        Field(
            min_length=1,
            max_length=200,
            description="Name of the action, from webots_list_commands.",
        ),
    ],
    caller: Caller,
    params: Annotated[
        dict[str, Any] | None, Field(description="Arguments of the action, such as {'x': 1.5}.")
    ] = None,
    robot: RobotName = None,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Have the controller run one of its own actions, at most once, and wait for its answer.

    webots_list_commands lists the actions. For tunable values use webots_set_parameters; to
    pause, step or reset use webots_simulation_control.
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
    tier="all",
)
async def webots_wait_for_command(
    recording: RecordingAccess,
    command_id: Annotated[
        Id, Field(description="Command to wait for, from the answer to its call.")
    ],
    caller: Caller,
    timeout_wall_s: TimeoutS = _WAIT_S,
) -> CommandAnswer:
    """Wait for the outcome of a command that still ran when its call returned.

    Never send such a command again: it would run twice. For all commands use
    webots_list_commands.
    """
    return await Dispatcher(recording, caller.report).wait(command_id, timeout_wall_s)


@question("List the commands", READS, command="commands", quotes=True)
def webots_list_commands(
    recording: RecordingAccess,
    limit: Annotated[int, Field(ge=1, le=200, description="Maximum number of commands.")] = 10,
    status: Annotated[
        CommandStatus | None, Field(description="Only commands of this status.")
    ] = None,
    cursor: Cursor = None,
    robot: RobotName = None,
) -> CommandsAnswer:
    """List the controller's own actions, and the newest commands with their outcome.

    To run an action use webots_send_command; for tunable values use webots_get_parameters.
    """
    with recording.view(robot) as view:
        recording.settle()
        commands = list_commands(
            view.connection, view.robot.id, limit=limit, status=status, before_id=cursor
        )
        return _answer(view, commands, limit)


def _run_of(connection: sqlite3.Connection, command: QueuedCommand) -> int | None:
    """Return the run that went on when a command was claimed, else created."""
    at_s = command.claimed_wall_time_s or command.created_wall_time_s
    found = connection.execute(
        "SELECT id FROM run WHERE robot_id = ? AND started_wall_time_s <= ? "
        "ORDER BY started_wall_time_s DESC, id DESC LIMIT 1",
        (command.robot_id, at_s),
    ).fetchone()
    return found[0] if found else None


def _command_row(connection: sqlite3.Connection, command: QueuedCommand, now_s: float) -> list[Any]:
    """Return a command as a row under `COMMAND_COLUMNS`."""
    took_s = None
    if command.finished_wall_time_s is not None:
        took_s = round(command.finished_wall_time_s - command.created_wall_time_s, 3)
    return [
        command.id,
        command.action,
        shorten(json.loads(command.params), DETAIL_BUDGET_TOKENS).value or None,
        command.status,
        _run_of(connection, command),
        seconds(command.claimed_sim_time_s),
        round(now_s - command.created_wall_time_s, 1),
        took_s,
        shown_result(command, DETAIL_BUDGET_TOKENS),
        cut_text(command.error, _SIZES.error_characters) if command.error else None,
    ]


def _answer(view: RobotView, commands: list[QueuedCommand], limit: int) -> CommandsAnswer:
    rows = [_command_row(view.connection, command, view.now_s) for command in commands]
    rows = fitting(rows, _SIZES.commands_tokens)
    more = len(rows) < len(commands) or len(commands) == limit
    actions = view.session.actions if view.session else {}
    shown = _shown_actions(actions)
    has_bridge = view.session is None or view.session.has_bridge
    nothing = "no such command was sent to this robot yet" if has_bridge else NO_BRIDGE
    hints = [nothing] * (not commands)
    # in pieces as long as one cell of an answer may be
    hints += (
        [
            (
                'docstrings are cut: webots_query_sql("SELECT substr(value, 1, 200), substr(value, '
                "201, 200) "
                f"FROM session, json_each(actions) WHERE session.id = {view.session.id} AND key = "
                "'NAME'\") has more of one"
            )
        ]
        if view.session and shown != actions
        else []
    )
    hints += [f"{len(shown)} of {len(actions)} actions are shown"] * (len(shown) < len(actions))
    return CommandsAnswer(
        **view.header(),
        commands=condensed(COMMAND_COLUMNS, rows),
        cursor=commands[len(rows) - 1].id if more else None,
        actions=shown,
        built_in=[*BUILT_IN_ACTIONS] if has_bridge else None,
        hint="; ".join(hints) or None,
    )


def _shown_actions(actions: Mapping[str, str]) -> dict[str, str]:
    """Return the registered actions with as much of their docstrings as fits next to all the names.

    A controller that registers none sees commands in its loop.
    """
    if is_for_a_person():
        return dict(actions)
    for longest in _SIZES.docstring_characters:
        shown = {name: cut_text(text, longest) for name, text in actions.items()}
        if tokens_of(shown) <= _SIZES.actions_tokens:
            return shown
    named = [(short_name(name) or "", "…" if text else "") for name, text in actions.items()]
    return dict(fitting(named, _SIZES.actions_tokens))
