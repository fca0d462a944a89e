"""The command line in this process, on a recording."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import Driver
from tests.server.story import write_story
from webots_mcp.cli import main


class Cli:
    """What commands print; `where` are the options that name their recording."""

    def __init__(self, capsys: pytest.CaptureFixture[str], where: Sequence[str]) -> None:
        self._capsys = capsys
        self.where = list(where)

    def on(self, *where: str | Path) -> Cli:
        """The same on another recording."""
        return Cli(self._capsys, list(map(str, where)))

    def ended(self, typed: str | Sequence[str]) -> tuple[int, str, str]:
        """The exit code, and what stands on stdout and on stderr."""
        words = shlex.split(typed) if isinstance(typed, str) else list(typed)
        code = main([*words, *self.where])
        said = self._capsys.readouterr()
        return code, said.out, said.err

    def __call__(self, typed: str | Sequence[str]) -> str:
        """What a command prints that succeeds."""
        code, out, err = self.ended(typed)
        assert code == 0, err
        return out

    def json(self, typed: str | Sequence[str]) -> Any:
        words = shlex.split(typed) if isinstance(typed, str) else list(typed)
        return json.loads(self([*words, "--json"]))

    def refused(self, typed: str | Sequence[str]) -> str:
        """The line on stderr of one that is refused."""
        code, out, err = self.ended(typed)
        assert (code, out) == (2, ""), err
        return err


@pytest.fixture(scope="session")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording whose story is known; do not change it."""
    return write_story(tmp_path_factory.mktemp("story") / "webots.db")


@pytest.fixture
def cli(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Cli:
    """On the database of this test."""
    return Cli(capsys, ["--database", str(tmp_path / "webots.db")])


@pytest.fixture
def driver(tmp_path: Path) -> Iterator[Driver]:
    """A controller that records into that database."""
    driving = Driver(tmp_path / "webots.db")
    driving.start()
    yield driving
    driving.stop()


def line_with(text: str, *words: str) -> str:
    lines = [line for line in text.splitlines() if all(word in line for word in words)]
    assert len(lines) == 1, (words, text)
    return lines[0]
