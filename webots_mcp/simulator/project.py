"""Read a Webots project: its folder, worlds and controllers, and which of them record."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.contract import (
    CONTROLLER_FOLDER,
    OBSERVER_NAME,
    PROJECT_IS,
    WORLD_ENDING,
    WORLD_FOLDER,
)
from webots_mcp.database.files import full_path
from webots_mcp.database.location import find_project
from webots_mcp.errors import InvalidInputError
from webots_mcp.extras.requirements import quoted

_PYTHON: Final = "Python"
# Tokens of a world file: strings and names; a comment is neither, and hides its content.
_WORDS: Final = re.compile(r'"(?:[^"\\]|\\.)*"|#[^\n]*|\w+')
# By language: the extensions of controllers that are built before Webots starts them.
_SOURCES: Final = {"C": (".c",), "C++": (".cpp", ".cc", ".cxx"), "Java": (".java",)}
_CALLS: Final = {
    "C": 'wb_robot_set_custom_data("{...}")',
    "C++": 'robot->setCustomData("{...}")',
    "Java": 'robot.setCustomData("{...}")',
    "MATLAB": "wb_robot_set_custom_data('{...}')",
}
_ONE_LINE: Final = (
    "write its values as JSON with {} in each step: an observer ('webots-mcp init --observer "
    "WORLD') records them; see 'webots-mcp help any-language'"
)
NO_SUPERVISOR: Final = (
    "is a plain Robot: pause, step, reset, screenshots and the scene need a Supervisor"
)
NO_POSITION_OF_ITS_OWN: Final = (
    "Unless it publishes its position (pose, gps), stuck, distances and paths are not known"
)


class ProjectController(NamedTuple):
    """A controller of a project.

    Attributes:
        name: Its name, which is that of its folder.
        file: The file that Webots starts, or a source file of that program.
        language: Its language, or what else it is, such as `a program` or `a container`.
        is_built: Whether Webots can start it now.
    """

    name: str
    file: Path
    language: str
    is_built: bool = True

    @property
    def advice(self) -> str:
        """Return how to record a controller in which the bridge cannot be used."""
        header = (
            "include webots_mcp.h ('webots-mcp header' writes it), or "
            if self.language in ("C", "C++")
            else ""
        )
        call = _CALLS.get(self.language, _CALLS["C"])
        return f"{header}{_ONE_LINE.format(call)}"

    @property
    def is_python(self) -> bool:
        """Whether the bridge can be used in it."""
        return self.language == _PYTHON


def project_of(folder: str | None) -> Path:
    """Return the project that a folder belongs to, or the current folder.

    Raises:
        InvalidInputError: There is no such folder, or it belongs to no project.
        OSError: The path cannot be followed.
    """
    start = full_path(folder or ".")
    if not start.is_dir():
        raise InvalidInputError(f"{start} is not a folder. Give the folder of a Webots project.")
    if project := find_project(start):
        return project
    below = [each for each in sorted(start.iterdir()) if find_project(each) == each]
    hint = f" (one lies below: {below[0]})" if below else ""
    raise InvalidInputError(
        f"No Webots project at or above {start}: that is {PROJECT_IS}"
        f"{hint}. Give its folder, as in 'webots-mcp init PROJECT'"
    )


def controllers_of(project: Path, platform: str = sys.platform) -> list[ProjectController]:
    """Return the controllers that Webots would start, by name."""
    folder = project / CONTROLLER_FOLDER
    folders = sorted(each for each in folder.glob("*") if each.is_dir())
    return [found for folder in folders for found in _started(folder, platform)]


def _started(folder: Path, platform: str) -> Iterator[ProjectController]:
    """Return the file of a controller's folder that Webots starts: the first that exists."""
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
    found = next((each for each, kind in kinds.items() if kind and (folder / each).is_file()), None)
    source = _source(folder)
    if found is None and source is not None:
        yield source
    elif found is not None and source is not None and kinds[found] == "a program":
        yield source._replace(is_built=True)
    elif found is not None:
        yield ProjectController(name, folder / found, kinds[found] or "")
    elif (folder / "package.xml").is_file():
        yield ProjectController(name, folder / "package.xml", "ROS")


def _source(folder: Path) -> ProjectController | None:
    """Return the source of a controller: the file of its name, else the first source."""
    files = [*sorted(folder.glob("*.*")), *sorted(folder.glob("src/*.*"))]
    files.sort(key=lambda file: file.stem != folder.name)
    for file in files:
        for language, endings in _SOURCES.items():
            if file.suffix in endings:
                return ProjectController(folder.name, file, language, is_built=False)
    return None


def has_bridge(controller: Path) -> bool:
    """Return whether a Python file in a controller's folder names the bridge."""
    return any(b"MCPBridge" in file.read_bytes() for file in sorted(controller.glob("*.py")))


def writes_states(controller: ProjectController) -> bool:
    """Return whether a controller in another language records: by our header, or customData."""
    folder = controller.file.parent
    files = [
        each
        for each in folder.rglob("*.*")
        if each.suffix in (".c", ".cpp", ".cc", ".cxx", ".java", ".m", ".h", ".hpp", ".hh")
    ]
    return any(
        re.search(rb"webots_mcp\.h|setCustomData|wb_robot_set_custom_data", each.read_bytes())
        for each in files
    )


def has_observer(project: Path) -> bool:
    """Return whether the project has an observer's controller."""
    return (project / CONTROLLER_FOLDER / OBSERVER_NAME).is_dir()


def offer_observer(project: Path | None, world: Path | None = None) -> str:
    """Return the line that adds an observer to a world, or to the only one of a project."""
    worlds = sorted((project / WORLD_FOLDER).glob(f"*{WORLD_ENDING}")) if project else []
    chosen_world = world or (worlds[0] if len(worlds) == 1 else None)
    name = "WORLD"
    if chosen_world is not None:
        inside = project is not None and chosen_world.is_relative_to(project)
        name = str(chosen_world.relative_to(project) if inside and project else chosen_world)
    return f"{quoted(['webots-mcp', 'init', '--observer', name])} adds a robot that has all of it"


def controllers_in(world: Path) -> list[str]:
    """Return the controllers that a world file names, each once; robots of PROTOs may have others.

    Raises:
        OSError: It cannot be read.
    """
    words = _WORDS.findall(world.read_text("utf-8", "replace"))
    named = (after[1:-1] for word, after in pairwise(words) if word == "controller")
    return list(dict.fromkeys(name for name in named if name))


def names_a_supervisor(world: Path) -> bool:
    """Return whether a world file gives a robot the rights of a Supervisor.

    Raises:
        OSError: It cannot be read.
    """
    words = _WORDS.findall(world.read_text("utf-8", "replace"))
    return ("supervisor", "TRUE") in pairwise(words)
