"""Texts of a controller, as the database takes them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from webots_mcp.errors import WebotsMCPError

_MOST_CHARACTERS: Final = 2000  # of what an error says


def cut(text: str, most_characters: int) -> str:
    """The text, or its beginning and how long it was."""
    if len(text) <= most_characters:
        return text
    return f"{text[:most_characters]}... (cut: it had {len(text)} characters)"


def storable(text: str) -> str:
    """No encoding has surrogates, and SQLite's shell would end the text at a NUL."""
    return text.encode("utf-8", "replace").decode().replace("\0", "\\0")


def describe(error: BaseException) -> str:
    """What was wrong; for an exception of the user's own code also its kind and place."""
    text = _text_of(error)
    if isinstance(error, WebotsMCPError):
        return text
    frame = error.__traceback__
    while frame is not None and frame.tb_next is not None:
        frame = frame.tb_next
    if frame is None:
        return f"{type(error).__name__}: {text}"
    place = Path(frame.tb_frame.f_code.co_filename).name
    return f"{type(error).__name__}: {text} ({place}, line {frame.tb_lineno})"


def _text_of(error: BaseException) -> str:
    try:
        return cut(str(error), _MOST_CHARACTERS)
    except Exception as failure:  # noqa: BLE001  (an exception of the user's own kind)
        return f"(without words: its str() raised {type(failure).__name__})"
