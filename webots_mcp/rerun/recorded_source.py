"""Finds the source that a controller had in a run without a tape: on the disk, else in git.

A recording has the hash of the controller's file and the commit that was checked out. Modules that
it imports are found next to it. On the disk they count where they were not changed since the run
began, else as they are in the commit. Whether they had changes then that were not committed is not
recorded, and the answer says so.
"""

from __future__ import annotations

import ast
import hashlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from webots_mcp.contract import host_name
from webots_mcp.database.location import find_project
from webots_mcp.database.tapes.source_files import (
    FOREIGN,
    LIMITS,
    files_near,
    read_sources,
    root_of,
)

_COMMIT: Final = re.compile(r"[0-9a-f]{7,64}")
_GIT_S: Final = 10.0  # that git may take for a file

Read = Callable[[Path], "bytes | None"]


@dataclass
class RecordedSource:
    """The code of a run, or why it is not known.

    Attributes:
        root: The folder of the project.
        controller: The controller's path from there.
        texts: The text of it and of the modules that it imports, by path.
        basis: Where they were found, in a few words.
        why_not: What is missing, in a few words; None where they are known.
    """

    root: Path = Path()
    controller: str = ""
    texts: dict[str, str] = field(default_factory=dict[str, str])
    basis: str = ""
    why_not: str | None = None


def find_source(
    controller: str | None,
    sha256: str | None,
    commit: str | None,
    began_s: float,
    data_dir: Path,
    host: str,
) -> RecordedSource:
    """Find the code of a run.

    Args:
        controller: The path of its controller's file.
        sha256: The hash of that file, in hexadecimal digits.
        commit: The commit that was checked out.
        began_s: The wall time at which the process began.
        data_dir: The folder of the recording.
        host: The machine on which it ran.
    """
    if controller is None or sha256 is None:
        return _unknown("the controller's source, because the process had no main file")
    file = Path(controller)
    if file.suffix != ".py":
        return _unknown(f"a controller in Python: it ran {file.name}")
    project = find_project(data_dir)
    is_own = project is not None and file.is_relative_to(project)
    if not is_own and host != host_name():  # a recording of elsewhere must not choose what runs
        return _unknown(f"the controller's source, which is {file} on the computer {host}")
    root = root_of(file)
    why = f"the controller's source of that time: {file} was changed since or is gone"
    on_disk = _read_file(file)
    if on_disk is not None and _sha256(on_disk) == sha256:
        texts = _with_imports(file, root, _read_file)
        changed = [
            name for name in texts if root / name != file and _is_newer(root / name, began_s)
        ]
        if not changed:
            texts |= _found_by_name(file, root, began_s, texts)
            return _found(root, file, texts, "the controller's file, which has the recorded hash")
        why = f"the source of that time of {', '.join(changed[:8])}, changed since the run began"
    if commit is None or not _COMMIT.fullmatch(commit):
        return _unknown(f"{why}, and no git commit was recorded")

    of_commit: list[str] = []

    def read_of_then(each: Path) -> bytes | None:
        if each != file and each.is_file() and not _is_newer(each, began_s):
            return _read_file(each)
        found = _committed(commit, each, root)
        if found is not None and each != file:
            of_commit.append(each.relative_to(root).as_posix())
        return found

    committed = _committed(commit, file, root)
    if committed is None or _sha256(committed) != sha256:
        return _unknown(f"{why}, and the commit {commit[:10]} does not have it")
    texts = _with_imports(file, root, read_of_then)
    texts |= _found_by_name(file, root, began_s, texts)
    basis = f"the controller as in the commit {commit[:10]}"
    if of_commit:
        named = ", ".join(sorted(set(of_commit))[:8])
        basis = f"{basis}, with {named} as committed: wrong if they had uncommitted changes then"
    return _found(root, file, texts, basis)


def _unknown(why_not: str) -> RecordedSource:
    return RecordedSource(why_not=why_not)


def _found(root: Path, file: Path, texts: dict[str, str], basis: str) -> RecordedSource:
    return RecordedSource(root, file.relative_to(root).as_posix(), texts, basis)


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read_file(file: Path) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None


def _is_newer(file: Path, wall_time_s: float) -> bool:
    """Return whether a file was changed or put in its place after a time.

    A file that was moved or copied there keeps the time of its last change. On POSIX its status
    has another time then; on Windows that is the time at which it was made.
    """
    try:
        status = file.stat()
        return max(status.st_mtime, status.st_ctime) > wall_time_s
    except OSError:
        return True


def _committed(commit: str, file: Path, root: Path) -> bytes | None:
    """Return a file as it is in a commit, without the filters and hooks of the repository."""
    command = ["git", "-C", str(root), "cat-file", "blob", f"{commit}:./{file.relative_to(root)}"]
    try:
        found = subprocess.run(command, capture_output=True, timeout=_GIT_S, check=False)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout if found.returncode == 0 else None


def _with_imports(controller: Path, root: Path, read: Read) -> dict[str, str]:
    """Return the texts of a controller and of the modules next to it that it imports, by path."""
    texts: dict[str, str] = {}
    elsewhere = _modules_elsewhere(controller, root)
    waiting = [controller]
    while waiting and len(texts) < LIMITS.files:
        file = waiting.pop()
        name = file.relative_to(root).as_posix()
        if name in texts or (content := read(file)) is None:
            continue
        texts[name] = content.decode("utf-8", "surrogateescape")
        for module in _imported(texts[name]):
            parts = module.split(".")
            waiting += elsewhere.pop(parts[0], [])
            for folder in {controller.parent, file.parent}:
                waiting += [folder.joinpath(*parts[:i]) / "__init__.py" for i in range(1, 9)]
                waiting += [folder.joinpath(*parts).with_suffix(".py")]
                waiting += [folder.joinpath(*parts[:-1]).with_suffix(".py")] if parts[1:] else []
    return texts


def _modules_elsewhere(controller: Path, root: Path) -> dict[str, list[Path]]:
    """Return the project's files by the module or package that they may be with another path.

    A controller may add a folder of its project to `sys.path`. What is found next to it, or in
    Python, has precedence.
    """
    modules: dict[str, list[Path]] = {}
    if controller.parent == root:  # of no project: its folder may hold anything
        return modules
    for folder, folders, names in os.walk(root):
        here = Path(folder)
        folders[:] = sorted(set(folders) - FOREIGN)
        if here == controller.parent:
            folders[:] = []
            continue
        package = here
        while (package.parent / "__init__.py").is_file() and package.parent != root:
            package = package.parent
        is_packaged = (package / "__init__.py").is_file()
        for name in sorted(names):
            if name.endswith(".py"):
                of = package.name if is_packaged else name[:-3]
                modules.setdefault(of, []).append(here / name)
    near = {each.stem for each in controller.parent.glob("*")} | sys.stdlib_module_names
    return {name: files for name, files in modules.items() if name not in near}


def _found_by_name(
    controller: Path, root: Path, began_s: float, known: dict[str, str]
) -> dict[str, str]:
    """Return the other files next to a controller, which it may import by a name that it makes."""
    old = (each for each in files_near(controller, root) if not _is_newer(each, began_s))
    files = islice(old, max(LIMITS.files - len(known), 0))
    return read_sources(files, root, {*known})


def _imported(text: str) -> set[str]:
    """Return the modules that a text imports, with the names taken from them."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError):
        return set()
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            names |= {base} if base else set()
            names |= {f"{base}.{each.name}".strip(".") for each in node.names if each.name != "*"}
    return names
