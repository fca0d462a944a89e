"""A Webots project: its folder, and the controllers in it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.contract import find_project, full_path
from webots_mcp.errors import InvalidInputError

_PYTHON: Final = "Python"
_BRIDGE: Final = b"MCPBridge"
# Of a world file: strings and names; a comment is neither, and hides what is in it.
_WORDS: Final = re.compile(r'"(?:[^"\\]|\\.)*"|#[^\n]*|\w+')


class Controller(NamedTuple):
    """A controller's folder, the file of it that Webots starts, and what that is written in."""

    name: str
    file: Path
    language: str

    @property
    def is_python(self) -> bool:
        """Whether the bridge can be used in it."""
        return self.language == _PYTHON


def project_of(folder: str | None) -> Path:
    """The project that a folder belongs to, or the current folder.

    Raises:
        InvalidInputError: There is no such folder, or it belongs to no project.
        OSError: The path cannot be followed.
    """
    start = full_path(folder or ".")
    if not start.is_dir():
        raise InvalidInputError(f"{start} is no folder: give that of a Webots project")
    if project := find_project(start):
        return project
    below = [each for each in sorted(start.iterdir()) if find_project(each) == each]
    hint = f" (one lies below: {below[0]})" if below else ""
    raise InvalidInputError(
        f"no Webots project at or above {start}: that is a folder with worlds/ and controllers/"
        f"{hint}; give its folder, as 'webots-mcp init PROJECT'"
    )


def controllers_of(project: Path, platform: str = sys.platform) -> list[Controller]:
    """Those that Webots would start, by name."""
    folders = sorted(each for each in (project / "controllers").iterdir() if each.is_dir())
    return [found for folder in folders for found in _started(folder, platform)]


def _started(folder: Path, platform: str) -> Iterator[Controller]:
    """The file of a controller's folder that Webots starts: the first that is there."""
    name = folder.name
    program = f"{name}.exe" if platform == "win32" else name
    kinds = {
        "Dockerfile": "a container" if platform == "linux" else None,
        program: "a program",
        f"build/release/{program}": "a program",
        f"{name}.class": "Java",
        f"{name}.jar": "Java",
        f"{name}.py": _PYTHON,
        f"{name}.m": "MATLAB",
    }
    for file, language in kinds.items():
        if language and (folder / file).is_file():
            yield Controller(name, folder / file, language)
            return


def has_bridge(controller: Path) -> bool:
    """Whether a file of a controller's folder speaks of the bridge."""
    return any(_BRIDGE in file.read_bytes() for file in sorted(controller.glob("*.py")))


def controllers_in(world: Path) -> list[str]:
    """The controllers that a world file names, each once; robots of PROTOs may have others.

    Raises:
        OSError: It cannot be read.
    """
    words = _WORDS.findall(world.read_text("utf-8", "replace"))
    named = (after[1:-1] for word, after in pairwise(words) if word == "controller")
    return list(dict.fromkeys(name for name in named if name))
