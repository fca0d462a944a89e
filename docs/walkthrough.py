"""The steps of docs/tutorial.md, read from the page and run in a folder.

The test of the tutorial and the pictures of the pages both use it, so that they show one robot.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, NamedTuple

PAGE: Final = Path(__file__).parent / "tutorial.md"
_BLOCK: Final = re.compile(
    r"(?ms)(?:`(?P<file>[\w/.]+)`:\n\n)?^```(?P<language>\w+)\n(?P<text>.*?)^```$"
)
# For starved machines. A launch that ends without the text fails at once.
_START_S: Final = 600.0


class Step(NamedTuple):
    """A block of the page: a file to write, commands to type, an output or an edit."""

    language: str
    text: str
    file: str | None


def steps(page: str) -> Iterator[Step]:
    """Yield the blocks of a page in their order."""
    for found in _BLOCK.finditer(page):
        yield Step(found["language"], found["text"], found["file"])


def write_project(folder: Path) -> Path:
    """Write the world and the controller of the tutorial; return the file of the world."""
    files = [step for step in steps(PAGE.read_text("utf-8")) if step.file]
    for step in files:
        file = folder / str(step.file)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(step.text, "utf-8")
    return next(folder.glob("worlds/*.wbt"))


def edited(code: str, diff: str) -> str:
    """Return code with the lines of a diff exchanged.

    Raises:
        ValueError: If the code does not contain the lines that the diff removes.
    """
    old = "".join(line[1:] + "\n" for line in diff.splitlines() if line.startswith("-"))
    new = "".join(line[1:] + "\n" for line in diff.splitlines() if line.startswith("+"))
    if code.count(old) != 1:
        raise ValueError(f"the code does not contain once: {old}")
    return code.replace(old, new)


class Terminal:
    """A shell in a folder, with the programs of this environment first on the PATH."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self.environment = {**os.environ, "PATH": path, "COLUMNS": "100", "NO_COLOR": "1"}

    def run(self, line: str) -> tuple[int, str]:
        """Run one line; return its exit code, and what it printed."""
        if line.startswith("cd "):
            self.folder /= line.removeprefix("cd ")
            return 0, ""
        done = subprocess.run(
            shlex.split(line), cwd=self.folder, env=self.environment, text=True, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=3600,
        )  # fmt: skip
        return done.returncode, done.stdout

    @contextmanager
    def running(self, line: str, until: str) -> Generator[str]:
        """Run one line until the end of the context; yield what it prints up to a text.

        Raises:
            TimeoutError: If the text is not printed in time.
        """
        log = self.folder / "terminal.txt"
        with log.open("w") as out, subprocess.Popen(
            shlex.split(line), cwd=self.folder, env=self.environment, stdout=out,
            stderr=subprocess.STDOUT,
        ) as process:  # fmt: skip
            try:
                end_s = time.monotonic() + _START_S
                while until not in (said := log.read_text("utf-8")):
                    if time.monotonic() > end_s or process.poll() is not None:
                        raise TimeoutError(f"{line} did not print {until!r}, but {said}")
                    time.sleep(0.1)
                yield said
            finally:
                process.terminate()


def follow(page: str, terminal: Terminal) -> Iterator[tuple[Step, str]]:
    """Take each step of a page; yield it with what the commands before it printed.

    Raises:
        RuntimeError: If a command fails. A check that finds something does not.
    """
    blocks, printed = list(steps(page)), ""
    with ExitStack() as running:
        for step, after in zip(blocks, [*blocks[1:], None], strict=True):
            if step.file is not None:
                (terminal.folder / step.file).write_text(step.text, "utf-8")
            elif step.language == "sh":
                printed = ""
                for line in step.text.splitlines():
                    if " launch " in line and after is not None:
                        until = after.text.strip()
                        printed += running.enter_context(terminal.running(line, until))
                        continue
                    code, said = terminal.run(line)
                    if code > (" check" in line):
                        raise RuntimeError(f"{line} failed: {said}")
                    printed += said
            elif step.language == "diff":
                (file,) = terminal.folder.glob("controllers/*/*.py")
                file.write_text(edited(file.read_text("utf-8"), step.text), "utf-8")
            yield step, printed
