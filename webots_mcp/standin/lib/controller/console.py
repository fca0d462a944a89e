"""The lines that the real library writes to the C stderr, past Python's `sys.stderr`."""

from __future__ import annotations

import os


def say(line: str) -> None:
    """Write one line to the process's standard error."""
    os.write(2, f"{line}\n".encode())
