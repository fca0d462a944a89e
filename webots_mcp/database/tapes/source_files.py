"""The Python files of a controller's project: which are its own, and a copy of them to run."""

from __future__ import annotations

import functools
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from webots_mcp.contract import PROJECT_DATA_FOLDER
from webots_mcp.database.location import find_project
from webots_mcp.errors import InvalidInputError

FOREIGN: Final = frozenset(
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


LIMITS: Final = SourceFileLimits()


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
    return None if FOREIGN.intersection(relative.parts) else relative.as_posix()


def files_near(controller: Path, root: Path) -> Iterator[Path]:
    """Yield the Python files next to a controller; a large folder takes a while."""
    if controller.parent == root:  # of no project: its folder may hold anything
        yield from sorted(controller.parent.glob("*.py"))
        return
    for folder, folders, names in os.walk(controller.parent):
        folders[:] = sorted(set(folders) - FOREIGN)
        yield from (Path(folder, name) for name in sorted(names) if name.endswith(".py"))


def files_imported(modules: Iterable[str]) -> Iterator[Path]:
    """Yield the files of modules that are loaded, by their names."""
    for name in modules:
        file = getattr(sys.modules.get(name), "__file__", None)
        if isinstance(file, str):
            yield Path(file)


def read_sources(files: Iterable[Path], root: Path, known: set[str]) -> dict[str, str]:
    """Return the text of those files that are the project's and not known yet.

    Args:
        files: Any files.
        root: The folder of the project.
        known: Paths from there; those that are read are added.
    """
    texts: dict[str, str] = {}
    size = 0
    for file in files:
        name = relative_source(file, root)
        if name is None or file.suffix != ".py" or name in known:
            continue
        if len(known) >= LIMITS.files:
            break
        try:
            content = file.read_bytes()
        except OSError:
            continue
        size += len(content)
        if size > LIMITS.bytes:
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
        if each.name in FOREIGN or each.suffix == ".py" or target.exists():
            continue
        try:
            target.symlink_to(each)
        except OSError:  # where links are not allowed
            if each.is_file():
                shutil.copyfile(each, target)
