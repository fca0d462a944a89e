"""Paths such as `self.pid.integral` in the variables that were recorded at an event."""

from __future__ import annotations

import re
from typing import Any, Final, NamedTuple, cast

from webots_mcp.database.secret_names import LEFT_OUT, SecretNames
from webots_mcp.database.variable_paths import AttributePath, parse_path
from webots_mcp.errors import InvalidInputError

_MOST_NAMED: Final = 8
_SAME: Final = re.compile(r"\(the same as (.+)\)")
_ABOVE: Final = "above"  # at the same path, in a frame that is further in
_MOST_REFERENCES: Final = 8  # that are followed, one from the other
_LONGEST_TEXT: Final = 120
_CUT: Final = "..."


class RecordedValue(NamedTuple):
    """A value as it was recorded, and the line of the function that has the variable."""

    path: str
    value: Any
    line: str


def find_recorded(text: str, frames: list[dict[str, Any]]) -> RecordedValue:
    """Return the recorded value at a path.

    Args:
        text: The path. Its first name is searched in the innermost function first.
        frames: The recorded functions, the innermost first.

    Raises:
        InvalidInputError: It is no path, or the value was not recorded; the text says what was.
    """
    path = parse_path(text, SecretNames())
    value, line = _resolve(path, frames, _MOST_REFERENCES)
    return RecordedValue(path.text, value, line)


def _resolve(path: AttributePath, frames: list[dict[str, Any]], left: int) -> tuple[Any, str]:
    value, line = _root(path, frames)
    shown = path.root
    for number, (is_name, step) in enumerate(path.steps):
        if (other := _referred(value)) is not None and left > 0:
            rest = path.steps[number:]
            return _resolve(other._replace(steps=(*other.steps, *rest)), frames, left - 1)
        value = _member(value, is_name, step, shown)
        shown += f".{step}" if is_name else f"[{step!r}]"
    if (other := _referred(value)) is not None and left > 0:
        return _resolve(other, frames, left - 1)
    return value, line


def _root(path: AttributePath, frames: list[dict[str, Any]]) -> tuple[Any, str]:
    for frame in frames:
        variables: dict[str, Any] = frame["variables"]
        value = variables.get(path.root)
        if path.root in variables and value != f"(the same as {_ABOVE})":
            return value, frame["at"]
    known = [name for frame in frames for name in frame["variables"] if name != _CUT]
    raise InvalidInputError(
        f"no variable {path.root!r} was recorded at this event; recorded: {_listed(known)}"
    )


def _referred(value: Any) -> AttributePath | None:
    """Return the path that a value refers to, where the same object was recorded before."""
    found = _SAME.fullmatch(value) if isinstance(value, str) else None
    if found is None or found[1] == _ABOVE:
        return None
    try:
        return parse_path(found[1], SecretNames())
    except InvalidInputError:  # a text of the controller that looks so, or a key that is no text
        return None


def _member(value: Any, is_name: bool, step: str | int, shown: str) -> Any:
    if isinstance(value, list) and not is_name and isinstance(step, int):
        items = cast("list[Any]", value)
        count = len(items) - bool(items and _is_cut(items[-1]))
        if 0 <= step < count:
            return items[step]
        raise InvalidInputError(
            f"of {shown} the first {count} items were recorded, and [{step}] is none of them"
        )
    if isinstance(value, dict):
        members = cast("dict[str, Any]", value)
        if str(step) in members:
            return members[str(step)]
        inner = members.get("<items>")
        if not is_name and inner is not None:
            return _member(inner, is_name, step, shown)
        known = [name for name in members if name != _CUT and not name.startswith("<")]
        raise InvalidInputError(
            f"{str(step)!r} of {shown} was not recorded; recorded of it: {_listed(known)}"
        )
    if value == LEFT_OUT:
        raise InvalidInputError(f"{shown} looks secret, so its value was not recorded")
    known_text = str(cast("object", value))[:_LONGEST_TEXT]
    raise InvalidInputError(
        f"of {shown} only this was recorded: {known_text}. An inspection goes a few levels deep. "
        "To record more, watch the path or ask while the controller runs"
    )


def _is_cut(item: Any) -> bool:
    return isinstance(item, str) and item.startswith(f"{_CUT} ")


def _listed(names: list[str]) -> str:
    distinct = list(dict.fromkeys(names))
    more = ", ..." if len(distinct) > _MOST_NAMED else ""
    return f"{', '.join(distinct[:_MOST_NAMED])}{more}" if distinct else "nothing"
