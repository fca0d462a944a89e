"""Programs of the benchmarks in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

_ROOT: Final = Path(__file__).parents[2]
PROGRAMS: Final = ("-m", "tests.benchmarks.programs")


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
    return [sys.executable, *PROGRAMS, name, *map(str, arguments)]


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
