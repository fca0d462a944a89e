"""Programs of the benchmarks in processes of their own, spoken to line by line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[2]
"""The checkout: programs import `tests.benchmarks` from there."""
PROGRAMS: Final = Path(__file__).parent / "programs"
_PACKAGE: Final = "tests.benchmarks.programs"


class Program:
    """A module of `tests.benchmarks.programs` that runs; use it in a `with` statement.

    It answers each line that it is sent with one line of JSON.
    """

    def __init__(self, name: str, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"{_PACKAGE}.{name}", *map(str, arguments)],
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
        """Tell it something."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def hear(self) -> Any:
        """Wait for what it says.

        Raises:
            RuntimeError: It ended instead; its stderr has told why.
        """
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.process.args} ended with {self.process.wait()}")
        return json.loads(line)

    def ask(self, line: str) -> Any:
        """Tell it something and wait for the answer."""
        self.send(line)
        return self.hear()


def say(value: object) -> None:
    """Answer, from inside a program."""
    print(json.dumps(value), flush=True)


def environment() -> dict[str, str]:
    """The environment of a program that imports this checkout from any folder.

    Compiled modules are kept, as in any installation: else each start would compile them again.
    """
    path = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    changed = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in path if part)}
    changed.pop("PYTHONDONTWRITEBYTECODE", None)
    return changed


def run_python(code: str) -> str:
    """What a fresh interpreter prints for that code."""
    return _run("-c", code)


def run_module(name: str, *arguments: object) -> str:
    """What a module of `tests.benchmarks.programs` prints."""
    return _run("-m", f"{_PACKAGE}.{name}", *map(str, arguments))


def _run(*arguments: str) -> str:
    line = [sys.executable, *arguments]
    done = subprocess.run(line, stdout=subprocess.PIPE, text=True, check=True, env=environment())
    return done.stdout
