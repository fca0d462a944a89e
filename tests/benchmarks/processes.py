"""Programs of the benchmarks in processes of their own, and the servers that are compared."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

import anyio
from mcp import Client, StdioServerParameters

_ROOT: Final = Path(__file__).parents[2]
_PROGRAMS: Final = ("-m", "tests.benchmarks.programs")
_LOOK_INTERVAL_S: Final = 1.0
_LOOK: Final = {"robot": "rover 0", "lookback_wall_s": 60}


class Program:
    """A program of `tests.benchmarks.programs` that runs; use it in a `with` statement.

    It answers each line that it is sent with one line of JSON.
    """

    def __init__(self, name: str, *arguments: object) -> None:
        self.process = subprocess.Popen(
            program_line(name, *arguments),
            env=environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Program:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is not None:
            self.process.kill()
        self.process.communicate()

    def send(self, line: str) -> None:
        """Send it a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def receive(self) -> Any:
        """Wait for what it says.

        Raises:
            RuntimeError: It ended instead; its stderr shows why.
        """
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.process.args} ended with {self.process.wait()}")
        return json.loads(line)


def driving(
    robots: list[Program],
    order: str,
    around: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> Callable[[], list[Any]]:
    """A block in which all robots obey an order at once, within a `with` block of its own."""

    def run_block() -> list[Any]:
        with around():
            for robot in robots:
                robot.send(order)
            return [robot.receive() for robot in robots]

    return run_block


def program_line(name: str, *arguments: object) -> list[str]:
    """The command line of a program."""
    return [sys.executable, *_PROGRAMS, name, *map(str, arguments)]


def environment() -> dict[str, str]:
    """The environment of a program that imports this checkout from any folder.

    Compiled modules are kept, as in any installation: else each start would compile them again.
    """
    path = [str(_ROOT), os.environ.get("PYTHONPATH", "")]
    changed = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in path if part)}
    changed.pop("PYTHONDONTWRITEBYTECODE", None)
    return changed


def output_of(line: list[str]) -> str:
    """What a program prints until it ends."""
    done = subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True, env=environment())
    return done.stdout


def our_server(database: Path) -> StdioServerParameters:
    """`webots-mcp serve`."""
    return _started_by("-m", "webots_mcp", "serve", "--database", str(database))


def one_tool_server() -> StdioServerParameters:
    """The smallest server of the same library."""
    return _started_by(*_PROGRAMS, "one_tool_server")


def _started_by(*arguments: str) -> StdioServerParameters:
    return StdioServerParameters(command=sys.executable, args=[*arguments], env=environment())


@contextmanager
def running_server(database: Path) -> Generator[None]:
    """`webots-mcp serve` with a client that asks each second what `rover 0` did in a minute."""
    over, ready = threading.Event(), threading.Event()

    async def be_client() -> None:
        try:
            async with Client(our_server(database)) as client:
                await client.list_tools()
                ready.set()
                while not await anyio.to_thread.run_sync(over.wait, _LOOK_INTERVAL_S):
                    await client.call_tool("webots_monitor", _LOOK)
        finally:
            ready.set()

    thread = threading.Thread(target=lambda: anyio.run(be_client))
    thread.start()
    ready.wait()
    try:
        yield
    finally:
        over.set()
        thread.join()
