"""Preparing texts of a controller for the database."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from webots_mcp.errors import WebotsMCPError

_MOST_CHARACTERS: Final = 2000  # of what an error says


def cut(text: str, most_characters: int) -> str:
    """The text, or its beginning with the original length."""
    if len(text) <= most_characters:
        return text
    return f"{text[:most_characters]}... (cut: it had {len(text)} characters)"


def storable(text: str) -> str:
    """A text without surrogates, which UTF-8 lacks, and NULs, at which SQLite's shell ends it."""
    return text.encode("utf-8", "replace").decode().replace("\0", "\\0")


def describe(error: BaseException) -> str:
    """The text of an error; for one of the user's code also its type, file and line."""
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
        return f"(no text: its str() raised {type(failure).__name__})"
