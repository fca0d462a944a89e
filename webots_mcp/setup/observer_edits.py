"""Adding the observer to a world and a project, and removing it again.

A world stays as it is, byte for byte, except for the node at its end.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from webots_mcp.contract import OBSERVER_NAME
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.setup.file_change import FileChange, read

COPY_SUFFIX: Final = "_observed"
CONTROLLER: Final = b'''"""The observer of webots-mcp: it records where all robots are."""

from webots_mcp.simulator.observer import main

main()
'''
# Without synchronization the world does not wait for it, and a pause by hand does not stop it:
# see 'webots-mcp help webots'.
_ROBOT: Final = """Robot {{
  name "{name}"
  controller "{controller}"
  supervisor TRUE
  synchronization FALSE
}}
"""
_HEADER: Final = b"#VRML_SIM "
_TOKEN: Final = re.compile(rb'"(?:\\.|[^"\\])*"|#[^\r\n]*|[{}\[\]]|[^\s,"#{}\[\]]+', re.DOTALL)


def with_observer(world: bytes, *, extern: bool = False) -> bytes:
    """Return the world with an observer at its end; unchanged where it has one.

    Args:
        world: What its file holds.
        extern: Its controller is started by a person, as by `webots-mcp observe`.

    Raises:
        InvalidInputError: It is no world of Webots.
    """
    if _find(world) is not None:
        return world
    robot = _ROBOT.format(name=OBSERVER_NAME, controller="<extern>" if extern else OBSERVER_NAME)
    ending = b"\r\n" if b"\r\n" in world else b"\n"
    gap = b"" if world.endswith((b"\n", b"\r")) else ending
    return world + gap + robot.encode().replace(b"\n", ending)


def without_observer(world: bytes) -> bytes:
    """Return the world without its observer, wherever it stands and whatever Webots has made of it.

    Raises:
        InvalidInputError: It is no world of Webots, or has no observer.
    """
    found = _find(world)
    if found is None:
        raise InvalidInputError(f"there is no robot {OBSERVER_NAME!r} at the top of this world")
    start, end = found
    rest = world[end:]
    line_end = re.match(rb"[ \t]*(\r\n|\n|\r)?", rest)
    return world[:start] + rest[line_end.end() if line_end else 0 :]


def has_observer(world: bytes) -> bool:
    """Return whether an observer stands at the top of a world."""
    return world.startswith(_HEADER) and _find(world) is not None


def copy_of(world: Path) -> Path:
    """Return where the copy belongs: next to the world, so that it finds its files."""
    return world.with_name(f"{world.stem}{COPY_SUFFIX}{world.suffix}")


def world_change(world: Path, *, in_place: bool, extern: bool) -> FileChange:
    """Return what is to be written so that a world has an observer.

    Raises:
        InvalidInputError: It is no world, or has an observer already and is to be copied.
        OSError: It cannot be read.
    """
    before = read(world)
    if before is None or world.suffix != ".wbt":
        raise InvalidInputError(f"there is no world {world}: give a .wbt file")
    if in_place:
        return FileChange(world, before, with_observer(before, extern=extern))
    if has_observer(before):
        raise InvalidInputError(f"{world} has an observer already: open it, or give another world")
    copy = copy_of(world)
    return FileChange(copy, read(copy), with_observer(before, extern=extern))


def undo(world: Path) -> FileChange | None:
    """Return the change that removes the observer; None if the file is a copy to delete.

    Raises:
        InvalidInputError: It has no observer.
        CommandRefusedError: It is a copy in which something else was changed too.
        OSError: It cannot be read.
    """
    held = read(world)
    if held is None:
        raise InvalidInputError(f"there is no file {world}")
    without = without_observer(held)
    if not world.stem.endswith(COPY_SUFFIX):
        return FileChange(world, held, without)
    source = world.with_name(f"{world.stem.removesuffix(COPY_SUFFIX)}{world.suffix}")
    if read(source) not in (without, without.rstrip(b"\r\n")):
        raise CommandRefusedError(
            f"{world} differs from {source.name} in more than the observer: delete it by hand if "
            "nothing in it is needed"
        )
    return None


def controller_change(project: Path) -> FileChange:
    """Return what is to be written so that the project has the observer's controller.

    Raises:
        OSError: It cannot be read.
    """
    file = _controller_of(project)
    return FileChange(file, read(file), CONTROLLER)


def python_change(controller: Path, python: str) -> FileChange:
    """Return the change by which Webots starts the observer with that Python.

    Raises:
        OSError: It cannot be read.
    """
    file = controller.with_name("runtime.ini")
    return FileChange(file, read(file), _runtime(python))


def unused_controller(project: Path, python: str) -> list[Path]:
    """Return the observer's files that no world needs, if they are as we wrote them.

    Raises:
        OSError: They cannot be read.
    """
    worlds = (project / "worlds").rglob("*.wbt")
    if any(f'"{OBSERVER_NAME}"'.encode() in world.read_bytes() for world in worlds):
        return []
    file = _controller_of(project)
    ours = {file: CONTROLLER, file.with_name("runtime.ini"): _runtime(python)}
    return [each for each, content in ours.items() if read(each) == content]


def _runtime(python: str) -> bytes:
    return f"[python]\nCOMMAND = {python}\n".encode()


def _controller_of(project: Path) -> Path:
    return project / "controllers" / OBSERVER_NAME / f"{OBSERVER_NAME}.py"


def _find(world: bytes) -> tuple[int, int] | None:
    """Return where the observer's node begins and ends."""
    if not world.startswith(_HEADER):
        raise InvalidInputError("it is no world of Webots, which begins with '#VRML_SIM R2025a'")
    for start, end, name in _robots(world):
        if name == OBSERVER_NAME.encode():
            return start, end
    return None


def _robots(world: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield the Robot nodes at the top of a world: where each begins and ends, and its name."""
    depth, start, name = 0, 0, b""
    before: list[re.Match[bytes]] = []  # the words at this place of the top
    last = b""
    for token in _TOKEN.finditer(world):
        word = token[0]
        if word.startswith(b"#"):
            continue
        if word in (b"}", b"]"):
            depth -= 1
            if depth == 0 and before and before[-1][0] == b"Robot":
                yield start, token.end(), name
            if depth == 0:
                before, name = [], b""
        elif depth == 0 and word not in (b"{", b"["):
            before = [*before, token][-3:]
            start = before[0].start() if before[0][0] == b"DEF" else token.start()
        if depth == 1 and last == b"name" and word.startswith(b'"'):
            name = word[1:-1]
        depth += word in (b"{", b"[")
        last = word
