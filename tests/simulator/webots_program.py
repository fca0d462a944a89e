"""A program that takes the place of `webots` on the PATH, and behaves as Webots' sources tell.

It takes Webots' options, prints its words, opens its port (the next one where it is taken), serves
its WebSocket there, and runs the world with its controllers on the stand-in.
"""

from __future__ import annotations

import re
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Final

from tests.simulator.webots_server import WebotsServer
from webots_mcp.standin import Simulation

_ROOT: Final = Path(__file__).parents[2]
_DEFAULT_PORT: Final = 1234
_FLAGS: Final = ("batch", "minimize", "no-rendering", "stdout", "stderr", "stream")
_PRINTED_BY: Final = re.compile(r"\[.+?\] (.*)")  # as the stand-in tells it
_PRINTED: Final = ("pause", "real-time", "fast", "step")  # as it obeys


class World(Simulation):
    """A simulation that obeys the orders of Webots' clients."""

    def obey(self, order: str) -> None:
        word, _, rest = order.partition(":")
        if word == "load":
            path = self.simulator.world.path.with_name(rest)
            self._obey(lambda: self._load(path))
            return
        orders: dict[str, Callable[[], None]] = {
            "pause": self.pause, "real-time": self.resume, "fast": self.fast, "step": self.step,
            "reset": self.reset, "reload": self.reload,
        }  # fmt: skip
        orders[word]()


def put_on_path(folder: Path) -> Path:
    """Write a program `webots` into a folder; returns its file."""
    file = folder / "webots"
    folder.mkdir(parents=True, exist_ok=True)
    file.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(_ROOT)!r})\n"
        "import webots_mcp.standin  # the controllers' library\n"
        "from tests.simulator.webots_program import main\nsys.exit(main(sys.argv[1:]))\n",
        "utf-8",
    )
    file.chmod(0o755)
    return file


def main(arguments: list[str]) -> int:
    parts = [word[2:].partition("=") for word in arguments if word.startswith("--")]
    options: dict[str, str] = {name: value for name, _, value in parts}
    worlds = [word for word in arguments if not word.startswith("--")]
    for name in options:
        if name not in (*_FLAGS, "mode", "port"):
            print(f"webots: invalid option: '--{name}'", file=sys.stderr)
            return 1
    server = _listen(int(options.get("port", _DEFAULT_PORT)), streams="stream" in options)

    def show(line: str) -> None:
        kind = "stderr" if line.startswith(("WARNING", "ERROR")) else "stdout"
        of_controller = _PRINTED_BY.fullmatch(line)
        if of_controller:  # Webots tells neither its clients nor its stdout which one it is
            line = of_controller[1]
        server.log(kind, line + "\n" * bool(of_controller))
        if kind in options:
            print(line, file=getattr(sys, kind), flush=True)

    world = World(worlds[0], mode=options.get("mode", "realtime"), console=show)

    def obey(order: str) -> None:
        world.obey(order)
        if (word := order.partition(":")[0]) in _PRINTED:
            print(word, flush=True)

    server.on_order = obey
    return _run(server, world)


def _listen(port: int, *, streams: bool) -> WebotsServer:
    for number in range(port, port + 11):
        try:
            return WebotsServer(streams=streams, port=number)
        except OSError:  # noqa: PERF203
            print(f"WARNING: Could not initialize TCP server on port {number}.", file=sys.stderr)
    sys.exit(1)


def _run(server: WebotsServer, world: World) -> int:
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    with server:
        world.start(server.port)
        world.wait_for(lambda: stopped.is_set() or not world.is_running, float("inf"))
        status = world.exit_status
        world.close()
    return status or 0
