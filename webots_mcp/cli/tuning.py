"""Commands that set what a controller lets be set."""

from __future__ import annotations

import argparse
import json
from functools import partial
from typing import TYPE_CHECKING, Any

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    ROBOT,
    argument,
    command,
    reading,
    settings_of,
)
from webots_mcp.cli.ranges import RUN
from webots_mcp.cli.tables import print_table
from webots_mcp.errors import CommandRefusedError, InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.questions.answers import CommandAnswer
    from webots_mcp.steering.tuning import When
    from webots_mcp.store.recording import Recording


@command(
    "parameters", DATA_DIR, DATABASE, ROBOT, RUN, JSON,
    argument("settings", nargs="*", metavar="NAME=VALUE", help="set these, all or none"),
    argument("--from-reset", action="store_true", help="not now, but from the next reset on"),
)  # fmt: skip
def parameters(arguments: argparse.Namespace) -> None:
    """Show the parameters that a controller declares, or set some while it runs.

    webots-mcp parameters kp=3.5 gait=trot
    """
    if not arguments.settings:
        return _show(arguments)
    if arguments.run_id is not None:
        raise InvalidInputError("--run shows an earlier run; parameters are set in the current one")
    answer = _set(arguments)
    if answer.outcome != "done":
        why = answer.error or answer.hint or "no answer in time"
        raise CommandRefusedError(f"the parameters were not set ({answer.outcome}): {why}")
    print(json.dumps(answer.result, indent=2) if arguments.json else _as_text(answer.result))


def _show(arguments: argparse.Namespace) -> None:
    from webots_mcp.store.parameters import COLUMNS, described
    from webots_mcp.store.recording import look

    with reading(arguments) as connection:
        view = look(connection, arguments.robot, arguments.run_id)
        found = described(connection, view.require_run())
    if arguments.json:
        print(json.dumps(found, indent=2))
    else:
        print_table(COLUMNS, [[each[column] for column in COLUMNS] for each in found])


def _set(arguments: argparse.Namespace) -> CommandAnswer:
    import anyio

    from webots_mcp.contract import resolve_database
    from webots_mcp.steering.tuning import set_parameters
    from webots_mcp.store.recording import Recording

    recording = Recording(*resolve_database(arguments.database, arguments.data_dir))
    values = parameters_of(recording, arguments)
    when: When = "reset" if arguments.from_reset else "now"
    ask = partial(set_parameters, when=when, robot=arguments.robot)
    return anyio.run(ask, recording, _silent, values)


def parameters_of(recording: Recording, arguments: argparse.Namespace) -> dict[str, Any]:
    """The typed settings as values of the kinds that the living controller declares."""
    from webots_mcp.steering.tuning import settable

    declared = settable(recording, arguments.robot)
    kinds = {name: each.declaration.kind for name, each in declared.items()}
    return settings_of(arguments.settings, kinds)


async def _silent(waited_s: float, of_s: float | None, text: str) -> None:
    """It takes a round of the loop, which is too short to report on."""


def _as_text(result: dict[str, Any]) -> str:
    lines = [
        f"{name}: {' -> '.join(json.dumps(value) for value in pair.values())}"
        for name, pair in result["values"].items()
    ]
    if "since_sim_time_s" in result:
        lines.append(f"from {result['since_sim_time_s']:.3f} s of run {result['run_id']} on")
    else:
        lines.append("from the next reset on")
    return "\n".join(lines)
