"""How much is kept, as arguments of the commands that delete."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from webots_mcp.cli.command import argument

if TYPE_CHECKING:
    from webots_mcp.store.retention.policy import Limit

_BACK: Final = "default"
_KINDS: Final = {
    "state": "recorded states",
    "kept_state": "what is kept at full rate (kept stretches)",
    "rollup": "rollups and change points",
    "log": "log lines",
    "event": "events; its age also holds for commands",
    "image": "pictures with their files",
}
_SIZE: Final = "unshipped"  # a limit of its own, whose size alone can be given


class _Default:
    """What a limit is by default; looked up where a help shows it, because importing it costs."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __str__(self) -> str:
        from webots_mcp.store.retention.notation import limit_text
        from webots_mcp.store.retention.policy import DEFAULT, Limit

        value = getattr(DEFAULT, self._name)
        if not isinstance(value, Limit):
            return f"{value:g}"
        spared = f"; an age spares the newest {value.spared_rows:,}" if value.limits else ""
        return f"{limit_text(value)}{spared}"


def _times(text: str) -> float:
    """How many times; 0 for ever, which a person might take for the opposite, and writes as all."""
    from webots_mcp.store.retention.notation import NO_LIMIT

    if text == NO_LIMIT:
        return 0.0
    try:
        times = float(text)
    except ValueError:
        times = math.nan
    if not 1 <= times < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number, 1 or more, or {NO_LIMIT}")
    return times


LIMITS: Final = (
    *(
        argument(
            "--keep-stretches" if kind == "kept_state" else f"--keep-{kind}s",
            metavar="LIMIT",
            dest=kind,
            default=_Default(kind),
            help=f"how much to keep of {what} (%(default)s)",
        )
        for kind, what in _KINDS.items()
    ),
    argument(
        "--keep-until-shipped",
        metavar="SIZE",
        dest=_SIZE,
        default=_Default(_SIZE),
        help="how much of what is beyond these limits to keep until 'webots-mcp ship' has shipped "
        "it (%(default)s)",
    ),
    argument(
        "--keep-runs",
        type=_times,
        metavar="TIMES",
        dest="outlive",
        default=_Default("outlive"),
        help="keep what is left of a run this many times longer than its states (%(default)s), or "
        "for ever: all",
    ),
)


def limits_of(arguments: argparse.Namespace) -> dict[str, Limit | float | None]:
    """The limits that were given, by the names of `Retention`; None goes back to the default.

    Raises:
        InvalidInputError: A text is not a limit, or a number is negative.
    """
    from webots_mcp.store.retention.notation import parse_limit
    from webots_mcp.store.retention.policy import DEFAULT

    asked = {name: getattr(arguments, name) for name in (*_KINDS, _SIZE, "outlive")}
    given = {name: value for name, value in asked.items() if not isinstance(value, _Default)}
    for kind in given.keys() & {*_KINDS, _SIZE}:
        text = given[kind]
        given[kind] = None if text == _BACK else parse_limit(text, getattr(DEFAULT, kind))
    if given.get(_SIZE) is not None:
        replace(DEFAULT, **{_SIZE: given[_SIZE]})  # refuses what is no size
    return given
