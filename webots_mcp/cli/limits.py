"""How much is kept, as arguments of the commands that delete."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import argument

if TYPE_CHECKING:
    from webots_mcp.store.retention import Retention

_KINDS: Final = {
    "state": "recorded states (1GB)",
    "rollup": "rollups and change points (none)",
    "log": "log lines (100MB)",
    "event": "events; its age also holds for commands (100MB)",
    "image": "pictures with their files (1GB)",
}
LIMITS: Final = (
    *(
        argument(f"--{kind}", metavar="LIMIT", help=f"how much to keep of {what}")
        for kind, what in _KINDS.items()
    ),
    argument(
        "--outlive",
        type=float,
        metavar="TIMES",
        help="keep what is left of a run so many times longer than its states (10; 0: for ever)",
    ),
)


def retention_of(arguments: argparse.Namespace) -> Retention:
    """The limits that were given, and the defaults of those that were not.

    Raises:
        InvalidInputError: A text is no limit, or a number is negative.
    """
    from dataclasses import replace

    from webots_mcp.store.retention import DEFAULT
    from webots_mcp.store.retention.notation import parse_limit

    given = {kind: text for kind in _KINDS if (text := getattr(arguments, kind)) is not None}
    limits = {kind: parse_limit(text, getattr(DEFAULT, kind)) for kind, text in given.items()}
    outlive = DEFAULT.outlive if arguments.outlive is None else arguments.outlive
    return replace(DEFAULT, **limits, outlive=outlive)
