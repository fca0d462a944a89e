"""How much is kept, as options of the commands that delete."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final

from webots_mcp.cli.values import Parameter
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.retention import (
    DEFAULT,
    NO_LIMIT,
    Asked,
    Limit,
    limit_text,
    option_of,
    parse_limit,
)

_BACK: Final = "default"
_RUNS: Final = "outlive"
_SIZE: Final = "unshipped"  # whose size alone can be given


def _option(name: str, text: str) -> Parameter:
    """The option of a limit, with what holds where nobody has set one."""
    value = getattr(DEFAULT, name)
    default = f"{value:g}" if name == _RUNS else limit_text(value)
    if isinstance(value, Limit) and value.limits and name != _SIZE:
        default += f"; an age spares the newest {value.spared_rows:,}"
    shown = {_RUNS: "TIMES", _SIZE: "SIZE"}.get(name, "LIMIT")
    return Parameter(_name_of(name), metavar=shown, help=text.format(default))


def _name_of(name: str) -> str:
    return option_of("run" if name == _RUNS else name)


@Parameter(name="*")
@dataclass(frozen=True)
class Limits:
    """How much is kept of what, as it was typed; by the names of `Retention`."""

    state: Annotated[str | None, _option("state", "Keep so much of recorded states ({}).")] = None
    kept_state: Annotated[
        str | None,
        _option(
            "kept_state", "Keep so much of what is kept at full rate, the kept stretches ({})."
        ),
    ] = None
    chunk: Annotated[
        str | None,
        _option("chunk", "Keep so much of the values in chunks, which outlive states ({})."),
    ] = None
    log: Annotated[str | None, _option("log", "Keep so much of log lines ({}).")] = None
    event: Annotated[
        str | None,
        _option("event", "Keep so much of events; its age also holds for commands ({})."),
    ] = None
    image: Annotated[
        str | None, _option("image", "Keep so much of pictures with their files ({}).")
    ] = None
    unshipped: Annotated[
        str | None,
        _option(
            "unshipped",
            "Of what is beyond these limits, keep this size until 'webots-mcp ship' has shipped it "
            "({}).",
        ),
    ] = None
    outlive: Annotated[
        str | None,
        _option(
            _RUNS,
            "Keep what is left of a run this many times longer than its chunks ({}), or for ever: "
            "all.",
        ),
    ] = None

    def asked(self) -> Asked:
        """The limits that were given; None goes back to the default.

        Raises:
            InvalidInputError: A text is not a limit, or a number is below 1.
        """
        given = {name: text for name, text in vars(self).items() if text is not None}
        return {name: _value(name, text) for name, text in given.items()}


def _value(name: str, text: str) -> Limit | float | None:
    if text == _BACK:
        return None
    try:
        if name == _RUNS:
            return _times_of(text)
        limit = parse_limit(text, getattr(DEFAULT, name))
        replace(DEFAULT, **{name: limit})  # refuses one that has to be a size
    except InvalidInputError as error:
        raise InvalidInputError(f"{_name_of(name)}: {error}") from error
    return limit


def _times_of(text: str) -> float:
    """How many times; 0 for ever, which a person might take for the opposite, and writes as all."""
    if text == NO_LIMIT:
        return 0.0
    try:
        times = float(text)
    except ValueError:
        times = math.nan
    if not 1 <= times < math.inf:
        raise InvalidInputError(f"{text!r} must be a number, 1 or more, or {NO_LIMIT}")
    return times
