"""Texts about a recording in the words of the command line: `last_s=-3` is `--last -3` there.

The questions call their arguments as the MCP tools do. The `dest` of an option is that name, so the
options of the command that runs say what a person has typed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextvars import ContextVar
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from webots_mcp.cli.command import Argument

_UNQUOTED: Final = r"(?<![\w'\".-])"  # a quoted name is somebody's data
_NOT_ON: Final = r"(?![\w'\"])"
_running: ContextVar[tuple[Argument, ...]] = ContextVar("running", default=())


def speak_of(arguments: Iterable[Argument]) -> None:
    """Let `as_typed` speak of these arguments: those of the command that runs."""
    _running.set(tuple(arguments))


def as_typed(text: str) -> str:
    """The text with a person's options instead of the names of arguments.

    A name that is a common word (`since`) is meant only where a value follows it, or where it is
    joined to another one ("since and until").
    """
    typed = {each.name: each.typed for each in _running.get()}
    for each in _running.get():
        text = re.sub(rf"{_UNQUOTED}{each.name}=\.\.\.", f"{each.typed} {each.value_name}", text)
        text = re.sub(rf"{_UNQUOTED}{each.name}=", f"{each.typed} ", text)
        if "_" in each.name:
            text = re.sub(rf"{_UNQUOTED}{each.name}{_NOT_ON}", each.typed, text)
    words = "|".join(name for name in typed if "_" not in name)
    if not words:
        return text
    joined = rf"{_UNQUOTED}({words}) (and|or) ({words}){_NOT_ON}"
    return re.sub(joined, lambda found: f"{typed[found[1]]} {found[2]} {typed[found[3]]}", text)
