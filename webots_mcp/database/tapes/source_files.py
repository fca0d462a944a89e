"""The Python files of a controller's project: which are its own, and a copy of them to run."""

from __future__ import annotations

import functools
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from webots_mcp.contract import PROJECT_DATA_FOLDER
from webots_mcp.database.location import find_project
from webots_mcp.errors import InvalidInputError

_FOREIGN: Final = frozenset(
    {"site-packages", "dist-packages", ".venv", "venv", "__pycache__", PROJECT_DATA_FOLDER}
)


@dataclass(frozen=True)
class SourceFileLimits:
    """Limits of the source files that a tape holds.

    Attributes:
        bytes: Total size.
        files: Number of files.
    """

    bytes: int = 4_000_000
    files: int = 500


_LIMITS: Final = SourceFileLimits()


def root_of(controller: Path) -> Path:
    """Return the folder of the project that a controller belongs to, else the controller's own."""
    return find_project(controller.parent) or controller.parent


def relative_source(file: str | os.PathLike[str], root: Path) -> str | None:
    """Return the path of a source file from its project's folder; None if it is not of it."""
    return _relative(os.fspath(file), str(root))


@functools.lru_cache(maxsize=4096)
def _relative(file: str, root: str) -> str | None:
    try:
        relative = Path(file).relative_to(root)
    except ValueError:
        return None
    return None if _FOREIGN.intersection(relative.parts) else relative.as_posix()


def own_sources(controller: Path, root: Path) -> Iterator[tuple[str, Path]]:
    """Yield the Python files next to a controller and those of the project that are imported."""
    loaded = [getattr(each, "__file__", None) for each in tuple(sys.modules.values())]
    near = sorted(controller.parent.rglob("*.py"))
    if controller.parent == root:  # of no project: its folder may hold anything
        near = sorted(controller.parent.glob("*.py"))
    imported = sorted(Path(each) for each in loaded if isinstance(each, str))
    for file in dict.fromkeys([controller, *near, *imported]):
        name = relative_source(file, root)
        if name is not None and file.suffix == ".py" and file.is_file():
            yield name, file


def read_sources(controller: Path, root: Path, known: set[str]) -> dict[str, str]:
    """Return the text of the project's files that are not known yet, and add them to `known`."""
    texts: dict[str, str] = {}
    size = 0
    for name, file in own_sources(controller, root):
        if name in known or len(known) >= _LIMITS.files:
            continue
        try:
            content = file.read_bytes()
        except OSError:
            continue
        size += len(content)
        if size > _LIMITS.bytes:
            break
        known.add(name)
        texts[name] = content.decode("utf-8", "surrogateescape")
    return texts


def unpack_sources(sources: Mapping[str, str], folder: Path, original: Path) -> None:
    """Write recorded source files into a folder, with links to the project's other files.

    What a controller reads next to its code (a motion, a table, a network) is not on the tape.

    Args:
        sources: Texts by path, as `Tape.sources` returns them.
        folder: An empty folder.
        original: The folder of the project that they were recorded in, which may be gone.

    Raises:
        InvalidInputError: A path leads out of the folder.
    """
    for name, text in sources.items():
        file = folder / name
        if not file.resolve().is_relative_to(folder.resolve()):
            raise InvalidInputError(f"The tape holds the source {name!r}, outside of its project.")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(text.encode("utf-8", "surrogateescape"))
    for made in {(folder / name).parent for name in sources}:
        counterpart = original / made.relative_to(folder)
        if counterpart.is_dir():
            _link_others(counterpart, made)


def _link_others(original: Path, made: Path) -> None:
    for each in original.iterdir():
        target = made / each.name
        if each.name in _FOREIGN or each.suffix == ".py" or target.exists():
            continue
        try:
            target.symlink_to(each)
        except OSError:  # where links are not allowed
            if each.is_file():
                shutil.copyfile(each, target)
