"""How much is kept, as arguments of the commands that delete."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import argument

if TYPE_CHECKING:
    from webots_mcp.store.retention import Retention

_KINDS: Final = {
    "state": "recorded states",
    "rollup": "rollups and change points",
    "log": "log lines",
    "event": "events; its age also holds for commands",
    "image": "pictures with their files",
}


class _Default:
    """What a limit is by default; looked up where a help shows it, because importing it costs."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __str__(self) -> str:
        from webots_mcp.store.retention import DEFAULT, Limit
        from webots_mcp.store.retention.notation import limit_text

        value = getattr(DEFAULT, self._name)
        return limit_text(value) if isinstance(value, Limit) else f"{value:g}"


LIMITS: Final = (
    *(
        argument(
            f"--{kind}",
            metavar="LIMIT",
            default=_Default(kind),
            help=f"how much to keep of {what} (%(default)s)",
        )
        for kind, what in _KINDS.items()
    ),
    argument(
        "--outlive",
        type=float,
        metavar="TIMES",
        default=_Default("outlive"),
        help="keep what is left of a run so many times longer than its states (%(default)s; "
        "0: for ever)",
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

    names = (*_KINDS, "outlive")
    asked = {name: getattr(arguments, name) for name in names}
    given = {name: value for name, value in asked.items() if not isinstance(value, _Default)}
    for kind in given.keys() & _KINDS.keys():
        given[kind] = parse_limit(given[kind], getattr(DEFAULT, kind))
    return replace(DEFAULT, **given)
