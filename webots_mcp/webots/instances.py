"""The Webots that run on this machine: how each was started, and where it listens."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final

from webots_mcp.contract import DATA_DIR_VARIABLE, host_name
from webots_mcp.webots.stream import WebotsAddress

if TYPE_CHECKING:
    import psutil

DEFAULT_PORT: Final = 1234
PORTS_TRIED: Final = 11  # Webots takes the next one where a port is taken, ten times

# `webots` is a script that starts `webots-bin`, on Windows `webots` and `webotsw` start it.
_PROGRAMS: Final = ("webots", "webots-bin", "webotsw")
_INTERPRETERS: Final = ("sh", "bash", "dash", "zsh", "python")


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
        import psutil

        try:
            named = psutil.Process(self.pid).environ().get(DATA_DIR_VARIABLE)
        except (psutil.Error, OSError):
            return None
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

    found: dict[int, tuple[psutil.Process, list[str]]] = {}
    starters: set[int] = set()
    for process in psutil.process_iter(["cmdline", "ppid"]):
        arguments = _arguments(process.info["cmdline"] or ())
        if arguments is not None:
            found[process.pid] = process, arguments
            starters.add(process.info["ppid"])
    programs = [found[pid] for pid in sorted(found.keys() - starters)]
    return [_look(process, arguments) for process, arguments in programs]


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


def _look(process: psutil.Process, arguments: list[str]) -> Instance:
    options = dict(_options(arguments))
    asked = options.get("port", "")
    port = int(asked) if asked.isascii() and asked.isdecimal() else DEFAULT_PORT
    listening = sorted(set(_ports(process)) & set(range(port, port + PORTS_TRIED)))
    return Instance(
        process.pid,
        listening[0] if listening else port,
        bool(listening),
        options.get("mode"),
        "stream" in options,
        _world(process, arguments),
        _started_s(process),
    )


def _options(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    for word in arguments:
        if word.startswith("--"):
            name, _, value = word[2:].partition("=")
            yield name, value


def _ports(process: psutil.Process) -> Iterator[int]:
    """The ports where it listens; none where the system hides another user's process."""
    import psutil

    try:
        for connection in process.net_connections(kind="tcp"):
            if connection.status == psutil.CONN_LISTEN:
                yield connection.laddr.port
    except psutil.Error:
        return


def _started_s(process: psutil.Process) -> float:
    import psutil

    try:
        return process.create_time()
    except psutil.Error:
        return 0.0


def _world(process: psutil.Process, arguments: Sequence[str]) -> Path | None:
    """Its world; a relative path is resolved by its working folder, where that is shown."""
    import psutil

    named = next((word for word in arguments if word.endswith(".wbt")), None)
    if named is None:
        return None
    try:
        return Path(process.cwd(), named)
    except psutil.Error:
        return Path(named)
