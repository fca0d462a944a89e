"""Commands that steer a simulation: what an assistant can ask for, a person can."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, cast

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    ROBOT,
    argument,
    command,
    row_id,
    settings_of,
)
from webots_mcp.cli.tables import print_table, text_of
from webots_mcp.cli.terminal import rewrite
from webots_mcp.cli.tuning import parameters_of
from webots_mcp.contract import LOOPING
from webots_mcp.errors import CommandRefusedError

if TYPE_CHECKING:
    from webots_mcp.questions.answers import CommandAnswer, Table
    from webots_mcp.questions.history_answers import RunAnswer
    from webots_mcp.store.recording import Recording

_WHERE: Final = (DATA_DIR, DATABASE, ROBOT, JSON)
_UNDER_WAY: Final = (
    "the controller is still at it and goes on: do not send it again, but go on waiting with\n\n"
    "    {}\n{}"
)
_END_IT: Final = "\nor end it with\n\n    {}\n"
TIMEOUT: Final = argument(
    "--timeout",
    type=float,
    default=600.0,
    dest="timeout_s",
    metavar="S",
    help="wait up to S wall seconds (600)",
)


@command(
    "run",
    *_WHERE,
    TIMEOUT,
    argument("--until", metavar="CONDITION", help="such as 'front_m < 0.1 for 0.5'"),
    argument("--for", dest="for_s", type=float, metavar="S", help="for S simulated seconds"),
    argument("--reset", action="store_true", help="reset the world first"),
    argument("--pace", choices=["fast", "real_time", "as_it_is"], default="fast"),
    argument("--then", choices=["pause", "go_on", "as_before"], default="pause"),
    argument(
        "--set",
        dest="settings",
        action="extend",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="set this parameter first; may be given several times",
    ),
)
def run(arguments: argparse.Namespace) -> None:
    """Let the simulation run until a condition holds or a simulated time is over, then pause it.

    It pauses at that very step, or does what --then says; Ctrl-C ends it the same way.

    webots-mcp run --until 'front_m < 0.1' --for 20 --reset --set kp=2
    """
    import anyio

    from webots_mcp.steering.running import require_possible

    recording, until, for_s = writable(arguments), arguments.until, arguments.for_s
    require_possible(recording, arguments.robot, until, for_s, reset=arguments.reset)
    wanted: dict[str, Any] = {
        "until": until,
        "for_s": for_s,
        "reset": arguments.reset,
        "pace": None if arguments.pace == "as_it_is" else arguments.pace,
        "parameters": parameters_of(recording, arguments) if arguments.settings else None,
        "then": arguments.then,
    }
    params = {name: value for name, value in wanted.items() if value is not None}
    _conclude(anyio.run(_ask, recording, arguments, "run", params), arguments)


@command(
    "send", *_WHERE, TIMEOUT,
    argument("action", metavar="ACTION", help="of the controller's own, or built in"),
    argument(
        "settings", nargs="*", default=[], metavar="NAME=VALUE", help="its parameters"
    ),
)  # fmt: skip
def send(arguments: argparse.Namespace) -> None:
    """Have a controller run an action, and print its answer.

    webots-mcp send set_speed speed=3.5
    """
    import anyio

    params = settings_of(arguments.settings)
    answer = anyio.run(_ask, writable(arguments), arguments, arguments.action, params)
    _conclude(answer, arguments)


@command(
    "keep", *_WHERE, TIMEOUT,
    argument("reason", metavar="REASON", help="why, as it is told with the stretch"),
)  # fmt: skip
def keep(arguments: argparse.Namespace) -> None:
    """Keep the last seconds of a running controller at full rate, and the two that follow.

    Each call of publish in them becomes a row, also those that the throttle drops.
    """
    arguments.action, arguments.settings = "keep", [f"reason={json.dumps(arguments.reason)}"]
    send(arguments)


@command("pause", *_WHERE, TIMEOUT)
def pause(arguments: argparse.Namespace) -> None:
    """Pause the simulation; its controller goes on answering."""
    arguments.action, arguments.settings = "pause", []
    send(arguments)


@command("resume", *_WHERE, TIMEOUT)
def resume(arguments: argparse.Namespace) -> None:
    """Let a paused simulation go on, in real time."""
    arguments.action, arguments.settings = "resume", []
    send(arguments)


@command(
    "step", *_WHERE, TIMEOUT,
    argument("steps", nargs="?", default="1", metavar="N", help="N rounds of its loop (1)"),
)  # fmt: skip
def step(arguments: argparse.Namespace) -> None:
    """Let the controller's own loop come round N times, then pause."""
    arguments.action, arguments.settings = "step", [f"steps={arguments.steps}"]
    send(arguments)


@command(
    "wait", DATA_DIR, DATABASE, JSON, TIMEOUT,
    argument("command_id", type=row_id, metavar="COMMAND",
             help="its number, as 'run' and 'send' say"),
)  # fmt: skip
def wait(arguments: argparse.Namespace) -> None:
    """Go on waiting for a command that was still under way when --timeout was over.

    Ctrl-C ends the waiting, not the command.
    """
    import anyio

    _conclude(anyio.run(_wait, writable(arguments), arguments), arguments)


async def _ask(
    recording: Recording, arguments: argparse.Namespace, action: str, params: dict[str, Any]
) -> CommandAnswer:
    from webots_mcp.steering.dispatch import Dispatcher

    with _line_of_progress():
        dispatcher = Dispatcher(recording, show_progress)
        return await dispatcher.ask(arguments.robot, action, arguments.timeout_s, params)


async def _wait(recording: Recording, arguments: argparse.Namespace) -> CommandAnswer:
    from webots_mcp.steering.dispatch import Dispatcher

    with _line_of_progress():
        dispatcher = Dispatcher(recording, show_progress)
        return await dispatcher.wait(arguments.command_id, arguments.timeout_s)


@contextmanager
def _line_of_progress() -> Generator[None]:
    try:
        yield
    finally:
        rewrite(sys.stderr)


async def show_progress(progress: float, total: float | None, text: str) -> None:
    """On a terminal one line that changes; in a pipe nothing, as for all commands."""
    rewrite(sys.stderr, text)


def writable(arguments: argparse.Namespace) -> Recording:
    """The recording that the commands for a controller go through."""
    from webots_mcp.contract import resolve_database
    from webots_mcp.store.recording import Recording

    return Recording(*resolve_database(arguments.database, arguments.data_dir), asker="cli")


def _conclude(answer: CommandAnswer | RunAnswer, arguments: argparse.Namespace) -> None:
    require_done(answer, arguments)
    if answer.action == "run" and not arguments.json:
        _print_run(cast("RunAnswer", answer))
    else:
        _print(answer, arguments)


def require_done(answer: CommandAnswer, arguments: argparse.Namespace) -> None:
    """Refuse to go on with a command that was not done.

    Raises:
        CommandRefusedError: With what became of it, and what to do next.
    """
    if answer.outcome == "done":
        return
    under_way = answer.outcome == "claimed"
    hint = _under_way(answer, arguments) if under_way else answer.hint
    why = "; ".join(filter(None, (answer.error, hint))) or "no answer in time"
    raise CommandRefusedError(f"{answer.action} is not done ({answer.outcome}): {why}")


def _under_way(answer: CommandAnswer, arguments: argparse.Namespace) -> str:
    """The command lines that go on waiting, and that end what lets the loop come round."""
    where = [("--data-dir", arguments.data_dir), ("--database", arguments.database)]
    given = [text for option, value in where if value for text in (option, value)]
    wait = shlex.join(["webots-mcp", "wait", str(answer.command_id), *given])
    robot = ["--robot", answer.robot] if answer.robot else []
    end = shlex.join(["webots-mcp", "pause", *robot, *given])
    return _UNDER_WAY.format(wait, _END_IT.format(end) if answer.action in LOOPING else "")


def _print(answer: CommandAnswer, arguments: argparse.Namespace) -> None:
    if arguments.json:
        print(json.dumps(answer.model_dump(mode="json", exclude_none=True), indent=2))
    else:
        print(text_of(answer.result) or "done")


def _print_run(answer: RunAnswer) -> None:
    ran = answer.ran or {}
    why = f" ({answer.why_stopped})" if answer.why_stopped else ""
    factor = f", {ran['factor']} times real time" if ran.get("factor") else ""
    print(
        f"{answer.stopped}{why} at {ran.get('to_s')} s of run {ran.get('run_id')}: "
        f"{ran.get('advanced_s')} s simulated{factor}; mode {answer.mode}"
    )
    print(f"state: {json.dumps(answer.state, ensure_ascii=False)}")
    trends = answer.trends.numbers if answer.trends else None
    for name, table in (("last rows", answer.rows), ("events", answer.events), ("trends", trends)):
        _print_table(name, table)


def _print_table(name: str, table: Table | None) -> None:
    if table is not None:
        print(f"\n{name}:")
        print_table(table.columns, table.rows)
