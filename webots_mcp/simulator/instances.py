"""Find the running instances of Webots on this machine, and their ports.

They are found by their command lines, as far as the system shows these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Final, TypeVar

from webots_mcp.contract import DATA_DIR_VARIABLE, host_name
from webots_mcp.simulator.orders import WebotsAddress

if TYPE_CHECKING:
    import psutil

T = TypeVar("T")
DEFAULT_PORT: Final = 1234
PORTS_TRIED: Final = 11  # Webots tries up to ten following ports if one is taken


@dataclass(frozen=True)
class Instance:
    """A running Webots.

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
        """The name by which the sessions of its controllers refer to it."""
        return f"{host_name()}:{self.port}"

    @property
    def data_dir(self) -> Path | None:
        """The data folder of its controllers, if its environment names one; else None."""
        environment = shown_of(self.pid, lambda process: process.environ(), dict[str, str]())
        named = environment.get(DATA_DIR_VARIABLE)
        return Path(named) if named else None

    @property
    def runs(self) -> bool:
        """Whether it is still running."""
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
        """The address at which it receives orders."""
        return WebotsAddress("127.0.0.1", self.port)


def instances() -> list[Instance]:
    """Return the Webots of this machine, as far as its processes may be checked."""
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
    """Return the Webots that listens at a port of this machine."""
    return next((each for each in instances() if each.port == port), None)


def _arguments(command_line: Sequence[str]) -> list[str] | None:
    """Return what a Webots was started with; None for any other program."""
    for at, word in enumerate(command_line[:2]):
        name = PurePath(word.replace("\\", "/")).name.lower().removesuffix(".exe")
        # `webots` is a script that starts `webots-bin`, on Windows `webots` and `webotsw` start it.
        if name in ("webots", "webots-bin", "webotsw"):
            return list(command_line[at + 1 :])
        if not name.startswith(("sh", "bash", "dash", "zsh", "python")):
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
    """Return what the system shows of a process; it hides much of another user's."""
    import psutil

    try:
        return ask(psutil.Process(pid))
    except (psutil.Error, OSError):
        return otherwise
