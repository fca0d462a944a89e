"""Breakpoints from a shell: set, listed, removed."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from webots_mcp.cli.command import (
    DATA_DIR,
    DATABASE,
    JSON,
    ROBOT,
    argument,
    command,
    count,
    reading,
    row_id,
)
from webots_mcp.cli.steering import show_progress, writable
from webots_mcp.cli.tables import print_table
from webots_mcp.contract import BREAKPOINT_ACTIONS
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.questions.answers import BreakpointAnswer


@command(
    "breakpoint", DATA_DIR, DATABASE, ROBOT, JSON,
    argument("condition", nargs="?", metavar="CONDITION", help="such as 'front_m < 0.1 for 0.5'"),
    argument("--action", choices=BREAKPOINT_ACTIONS, default="pause", help="at a hit (pause)"),
    count("--after-hits", "act from the Nth hit of a run on", default=1, dest="after_hits"),
    argument("--remove", type=row_id, dest="breakpoint_id", metavar="ID", help="remove this one"),
)  # fmt: skip
def breakpoint_(arguments: argparse.Namespace) -> None:
    """Pause, or take note, when a condition begins to hold; without one, list the breakpoints.

    webots-mcp breakpoint 'front_m < 0.1' --action log

    It is asked of every published state, stored, and armed again after a reset or reload.
    """
    if arguments.condition is not None and arguments.breakpoint_id is not None:
        raise InvalidInputError("give a condition to set, or --remove ID, not both")
    if arguments.condition is None and arguments.breakpoint_id is None:
        return _list(arguments)
    answer = _remove(arguments) if arguments.condition is None else _set(arguments)
    if arguments.json:
        return print(json.dumps(answer.model_dump(mode="json", exclude_none=True), indent=2))
    print(f"breakpoint {answer.breakpoint_id}: {_said(answer)}")
    for note in filter(None, [*(answer.notes or ()), answer.hint]):
        print(f"note: {note}")


def _list(arguments: argparse.Namespace) -> None:
    from webots_mcp.steering.arming import COLUMNS, breakpoint_rows
    from webots_mcp.store.recording import look

    with reading(arguments) as connection:
        rows = breakpoint_rows(look(connection, arguments.robot))
    if arguments.json:
        print(json.dumps([dict(zip(COLUMNS, row, strict=True)) for row in rows], indent=2))
    elif rows:
        print_table(COLUMNS, rows)
    else:
        print("no breakpoints")


def _set(arguments: argparse.Namespace) -> BreakpointAnswer:
    from functools import partial

    import anyio

    from webots_mcp.steering.arming import set_breakpoint

    ask = partial(
        set_breakpoint,
        action=arguments.action,
        after_hits=arguments.after_hits,
        robot=arguments.robot,
        set_by="cli",
    )
    return anyio.run(ask, writable(arguments), show_progress, arguments.condition)


def _remove(arguments: argparse.Namespace) -> BreakpointAnswer:
    from functools import partial

    import anyio

    from webots_mcp.steering.arming import remove_breakpoint

    ask = partial(remove_breakpoint, robot=arguments.robot)
    return anyio.run(ask, writable(arguments), show_progress, arguments.breakpoint_id)


def _said(answer: BreakpointAnswer) -> str:
    if answer.condition is None:
        return "removed"
    return f"{answer.condition} ({answer.action}), {'armed' if answer.armed else 'not armed yet'}"
