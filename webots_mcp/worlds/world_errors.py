"""The error of files of Webots."""

from __future__ import annotations


class WorldFileError(Exception):
    """A world or PROTO file that cannot be used; the text names the line."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}: {message}")
        self.line = line
