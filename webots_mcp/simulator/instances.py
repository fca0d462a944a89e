"""The Webots of this machine: where each is installed, which run, and where those listen.

What Webots' sources say about each version, and what happens here if it is otherwise, is listed in
docs/webots.md.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final, TypeVar

from webots_mcp.contract import DATA_DIR_VARIABLE, host_name
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.orders import WebotsAddress

if TYPE_CHECKING:
    import psutil

T = TypeVar("T")
HOME_VARIABLE: Final = "WEBOTS_HOME"

_DEFAULT_HOMES: Final[dict[str, tuple[str, ...]]] = {
    "linux": ("/usr/local/webots", "/snap/webots/current/usr/share/webots"),
    "darwin": ("/Applications/Webots.app", "~/Applications/Webots.app"),
    "win32": ("%PROGRAMFILES%/Webots", "%LOCALAPPDATA%/Programs/Webots"),
}
# Relative to the home folder, the likeliest first; a layout of another version may be the next one.
_PROGRAM_FOLDERS: Final[dict[str, tuple[str, ...]]] = {
    "linux": (".",),
    "darwin": ("Contents/MacOS", "."),
    "win32": ("msys64/mingw64/bin",),
}
_RESOURCES: Final = {"darwin": ("Contents/Resources", "Contents/resources", "resources")}
_LIBRARIES: Final = {"darwin": ("Contents/lib", "lib")}
_VERSION: Final = re.compile(r"R\d{4}[a-z]\w*(?:[ -]\w+)*")
DEFAULT_PORT: Final = 1234
PORTS_TRIED: Final = 11  # Webots takes the next one where a port is taken, ten times
# `webots` is a script that starts `webots-bin`, on Windows `webots` and `webotsw` start it.
_PROGRAMS: Final = ("webots", "webots-bin", "webotsw")
_INTERPRETERS: Final = ("sh", "bash", "dash", "zsh", "python")


@dataclass(frozen=True)
class Installation:
    """A Webots on this machine.

    Attributes:
        home: Its folder, which Webots calls WEBOTS_HOME; None for a program without one.
        found_by: `WEBOTS_HOME`, `PATH`, or `default` for a folder where installers put it.
        program: `webots` itself.
        launcher: `webots-controller`, which starts extern controllers; None where it is missing.
        python_api: The folder of the Python package `controller`; None where it is missing.
        version: `R2023b`, say; None where its version file is missing or says nothing.
    """

    home: Path | None
    found_by: str
    program: Path
    launcher: Path | None
    python_api: Path | None
    version: str | None


def installations(platform: str = sys.platform) -> list[Installation]:
    """All Webots that are found, in the order in which they are used: each of them once."""
    found: dict[Path, Installation] = {}
    for each in _search(platform):
        found.setdefault(each.program.resolve(), each)
    return list(found.values())


def find_webots() -> Installation:
    """The Webots that is used: of WEBOTS_HOME, else of the PATH, else where installers put it.

    Raises:
        CommandRefusedError: There is none.
    """
    if found := installations():
        return found[0]
    looked = ", ".join(str(home) for home in _default_homes(sys.platform))
    raise CommandRefusedError(
        f"there is no program 'webots' in WEBOTS_HOME "
        f"({os.environ.get(HOME_VARIABLE) or 'not set'}), on the PATH or in {looked}: install "
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
    """The installation in a folder; nothing where no program is there."""
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
    """Of a program on the PATH: a link into the home folder, or something that starts Webots."""
    homes = [*program.resolve().parents[:4], *_snap_home(program, platform)]
    for home in homes:
        if _version(home, platform) is not None:
            for found in _at(home, "PATH", platform):
                return found
    launcher = shutil.which("webots-controller")
    return Installation(None, "PATH", program, Path(launcher) if launcher else None, None, None)


def _snap_home(program: Path, platform: str) -> list[Path]:
    """A snap's program is a link to `snap` itself, which does not show where Webots is."""
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
        found = _VERSION.search(text)
        return found.group() if found else text.strip() or None
    return None


@dataclass(frozen=True)
class Instance:
    """A Webots that runs.

    Attributes:
        pid: Its process.
        port: Where it listens; where the system does not show it, the port in its command line.
        is_listening: Whether it was seen to listen there.
        mode: Of `--mode`; None where its preferences decide.
        streams: Whether it was started with `--stream`, so that it obeys orders from outside.
        world: The world file that it was started with.
        started_wall_time_s: When it started; 0 where the system does not show it.
    """

    pid: int
    port: int
    is_listening: bool
    mode: str | None
    streams: bool
    world: Path | None
    started_wall_time_s: float = field(default=0.0, compare=False)

    @property
    def name(self) -> str:
        """As the sessions of its controllers name it."""
        return f"{host_name()}:{self.port}"

    @property
    def data_dir(self) -> Path | None:
        """Where its controllers record if its environment says so; None where it does not."""
        environment = shown_of(self.pid, lambda process: process.environ(), dict[str, str]())
        named = environment.get(DATA_DIR_VARIABLE)
        return Path(named) if named else None

    @property
    def runs(self) -> bool:
        """Whether it still does."""
        import psutil

        try:
            process = psutil.Process(self.pid)
            is_it = process.create_time() == self.started_wall_time_s
            return is_it and process.status() != psutil.STATUS_ZOMBIE
        except psutil.AccessDenied:
            return True
        except psutil.Error:
            return False

    @property
    def address(self) -> WebotsAddress:
        """Where to speak to it."""
        return WebotsAddress("127.0.0.1", self.port)


def instances() -> list[Instance]:
    """The Webots of this machine, as far as its processes may be looked at."""
    import psutil

    found: dict[int, list[str]] = {}
    starters: set[int] = set()
    for process in psutil.process_iter(["cmdline", "ppid"]):
        arguments = _arguments(process.info["cmdline"] or ())
        if arguments is not None:
            found[process.pid] = arguments
            starters.add(process.info["ppid"])
    return [_inspect_process(pid, found[pid]) for pid in sorted(found.keys() - starters)]


def instance_at(port: int) -> Instance | None:
    """The Webots that listens at a port of this machine."""
    return next((each for each in instances() if each.port == port), None)


def _arguments(command_line: Sequence[str]) -> list[str] | None:
    """What a Webots was started with; None for any other program."""
    for at, word in enumerate(command_line[:2]):
        name = PurePath(word.replace("\\", "/")).name.lower().removesuffix(".exe")
        if name in _PROGRAMS:
            return list(command_line[at + 1 :])
        if not name.startswith(_INTERPRETERS):
            return None
    return None


def _inspect_process(pid: int, arguments: list[str]) -> Instance:
    words = [word[2:].partition("=") for word in arguments if word.startswith("--")]
    options = {name: value for name, _, value in words}
    asked = options.get("port", "")
    port = int(asked) if asked.isascii() and asked.isdecimal() else DEFAULT_PORT
    sockets = shown_of(pid, lambda process: process.net_connections(kind="tcp"), [])
    ports = sorted(each.laddr.port for each in sockets if each.status == "LISTEN")
    listening = [each for each in ports if port <= each < port + PORTS_TRIED]
    world = next((word for word in arguments if word.endswith(".wbt")), None)
    return Instance(
        pid,
        listening[0] if listening else port,
        bool(listening),
        options.get("mode"),
        "stream" in options,
        Path(shown_of(pid, lambda process: process.cwd(), ""), world) if world else None,
        shown_of(pid, lambda process: process.create_time(), 0.0),
    )


def shown_of(pid: int, ask: Callable[[psutil.Process], T], otherwise: T) -> T:
    """What the system shows of a process; it hides much of another user's."""
    import psutil

    try:
        return ask(psutil.Process(pid))
    except (psutil.Error, OSError):
        return otherwise
