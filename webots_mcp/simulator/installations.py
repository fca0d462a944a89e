"""Find the installations of Webots on this machine: folder, programs and version.

'webots-mcp help webots' lists what each version's source code says, and what happens otherwise.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from webots_mcp.errors import CommandRefusedError

HOME_VARIABLE: Final = "WEBOTS_HOME"
_DEFAULT_HOMES: Final[dict[str, tuple[str, ...]]] = {
    "linux": ("/usr/local/webots", "/snap/webots/current/usr/share/webots"),
    "darwin": ("/Applications/Webots.app", "~/Applications/Webots.app"),
    "win32": ("%PROGRAMFILES%/Webots", "%LOCALAPPDATA%/Programs/Webots"),
}
# Relative to the home folder, the most likely first; the layout of another version comes next.
_PROGRAM_FOLDERS: Final[dict[str, tuple[str, ...]]] = {
    "linux": (".",),
    "darwin": ("Contents/MacOS", "."),
    "win32": ("msys64/mingw64/bin",),
}
_RESOURCES: Final = {"darwin": ("Contents/Resources", "Contents/resources", "resources")}
_LIBRARIES: Final = {"darwin": ("Contents/lib", "lib")}


@dataclass(frozen=True)
class Installation:
    """A Webots on this machine.

    Attributes:
        home: Its folder, which Webots calls WEBOTS_HOME; None for a program without one.
        found_by: `WEBOTS_HOME`, `PATH`, or `default` for a folder where installers put it.
        program: `webots` itself.
        launcher: `webots-controller`, which starts extern controllers; None where it is missing.
        python_api: The folder of the Python package `controller`; None where it is missing.
        version: For example `R2023b`; None if its version file is missing or empty.
    """

    home: Path | None
    found_by: str
    program: Path
    launcher: Path | None
    python_api: Path | None
    version: str | None


def installations(platform: str = sys.platform) -> list[Installation]:
    """Return all installations in the order of preference, each once."""
    found: dict[Path, Installation] = {}
    for each in _search(platform):
        found.setdefault(each.program.resolve(), each)
    return list(found.values())


def find_webots() -> Installation:
    """Find the Webots to use: WEBOTS_HOME, else the PATH, else where installers put it.

    Raises:
        CommandRefusedError: There is none.
    """
    if found := installations():
        return found[0]
    searched = ", ".join(str(home) for home in _default_homes(sys.platform))
    raise CommandRefusedError(
        f"there is no program 'webots' in WEBOTS_HOME "
        f"({os.environ.get(HOME_VARIABLE) or 'not set'}), on the PATH or in {searched}: install "
        "Webots, or set WEBOTS_HOME to its folder"
    )


def _search(platform: str) -> Iterator[Installation]:
    if home := os.environ.get(HOME_VARIABLE):
        yield from _at(Path(home), HOME_VARIABLE, platform)
    if program := shutil.which("webots"):
        yield _of_program(Path(program), platform)
    for home in _default_homes(platform):
        yield from _at(home, "default", platform)


def _default_homes(platform: str) -> list[Path]:
    homes = (os.path.expandvars(text) for text in _DEFAULT_HOMES.get(platform, ()))
    return [Path(home).expanduser() for home in homes]


def _at(home: Path, found_by: str, platform: str) -> Iterator[Installation]:
    """Return the installation in a folder; nothing if the folder has no program."""
    program = _program(home, "webots", platform)
    if program is not None:
        libraries = _LIBRARIES.get(platform, ("lib",))
        python_apis = [home / library / "controller/python" for library in libraries]
        yield Installation(
            home,
            found_by,
            program,
            _program(home, "webots-controller", platform),
            next((folder for folder in python_apis if folder.is_dir()), None),
            _version(home, platform),
        )


def _of_program(program: Path, platform: str) -> Installation:
    """Return the installation of a program on the PATH, which may be a link or a starter script."""
    homes = [*program.resolve().parents[:4], *_snap_home(program, platform)]
    for home in homes:
        if _version(home, platform) is not None:
            for found in _at(home, "PATH", platform):
                return found
    launcher = shutil.which("webots-controller")
    return Installation(None, "PATH", program, Path(launcher) if launcher else None, None, None)


def _snap_home(program: Path, platform: str) -> list[Path]:
    """Return the home folders of a snap, whose program links to `snap` itself, not to Webots."""
    is_snap = program.resolve().name == "snap" or "snap" in program.parts
    return [home for home in _default_homes(platform) if is_snap and "snap" in home.parts]


def _program(home: Path, name: str, platform: str) -> Path | None:
    file = f"{name}.exe" if platform == "win32" else name
    places = (home / folder / file for folder in _PROGRAM_FOLDERS.get(platform, (".",)))
    return next((place for place in places if place.is_file()), None)


def _version(home: Path, platform: str) -> str | None:
    for folder in _RESOURCES.get(platform, ("resources",)):
        try:
            text = (home / folder / "version.txt").read_text("utf-8", "replace")
        except OSError:
            continue
        found = re.search(r"R\d{4}[a-z]\w*(?:[ -]\w+)*", text)
        return found.group() if found else text.strip() or None
    return None
