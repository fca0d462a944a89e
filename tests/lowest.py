"""The lowest versions that pyproject.toml admits, as constraints for pip: `python -m tests.lowest`.

What it says of dependencies and extras is true if the tests pass with these: `./run lowest`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def lowest() -> Iterator[str]:
    """A line for each dependency, also of the extras."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    project: dict[str, Any] = toml.loads(PYPROJECT.read_text("utf-8"))["project"]
    extras: dict[str, list[str]] = project["optional-dependencies"]
    wanted_by_project: list[str] = project["dependencies"]
    for wanted in chain(wanted_by_project, *extras.values()):
        found = re.fullmatch(r"([\w-]+)(?:\[[\w,]+\])?>=([\d.]+)(?:,<[\d.]+)?(;.*)?", wanted)
        assert found, wanted
        yield f"{found[1]}=={found[2]}{found[3] or ''}"


if __name__ == "__main__":
    print(*lowest(), sep="\n")
