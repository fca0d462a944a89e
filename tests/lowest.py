"""The lowest versions that pyproject.toml admits, as constraints for pip: `python -m tests.lowest`.

What it says of dependencies and extras is true if the tests pass with these: `./run lowest`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def lowest() -> Iterator[str]:
    """A line for each dependency, also of the extras."""
    project = tomllib.loads(PYPROJECT.read_text("utf-8"))["project"]
    for wanted in (*project["dependencies"], *sum(project["optional-dependencies"].values(), [])):
        found = re.fullmatch(r"([\w-]+)(?:\[[\w,]+\])?>=([\d.]+)(?:,<[\d.]+)?(;.*)?", wanted)
        assert found, wanted
        yield f"{found[1]}=={found[2]}{found[3] or ''}"


if __name__ == "__main__":
    print(*lowest(), sep="\n")
