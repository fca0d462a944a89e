"""A line on stderr, for whoever runs the controller or the server.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import sys


def warn(text: str) -> None:
    """A stderr that is full, closed or (under pythonw) not there costs the line, nothing else."""
    if sys.stderr is None:  # pyright: ignore[reportUnnecessaryComparison]
        return
    try:
        print(f"webots-mcp: {text}", file=sys.stderr, flush=True)  # noqa: T201
    except (OSError, ValueError):
        return
