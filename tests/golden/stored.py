"""The stored answers, a file for each recording, and how those of today differ from them."""

from __future__ import annotations

import difflib
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from unittest.mock import patch

from tests.golden.asking import ask_all
from tests.golden.recordings import RECORDINGS, GoldenRecording
from tests.golden.text import Portable
from tests.recordings.drawn import CONTROLLER

_FOLDER: Final = Path(__file__).parent / "answers"
_HEADING: Final = "== "


@contextmanager
def drawn(recording: GoldenRecording) -> Generator[Path]:
    """A folder with such a recording, while the context lasts."""
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        program = patch.object(sys.modules["__main__"], "__file__", str(CONTROLLER), create=True)
        with program, patch.object(sys, "argv", [str(CONTROLLER)]):
            recording.draw(folder)
        yield folder


def answers_of(name: str) -> dict[str, str]:
    """Draw a recording and return today's answer to each question, as portable text."""
    recording = RECORDINGS[name]
    with drawn(recording) as folder:
        portable = Portable(recording, folder)
        return {asked: portable.text(each) for asked, each in ask_all(recording, folder).items()}


def stored(name: str) -> dict[str, str]:
    """What each question answered when it was accepted."""
    file = _FOLDER / f"{name}.txt"
    if not file.exists():
        return {}
    parts = ("\n" + file.read_text("utf-8").rstrip("\n")).split(f"\n{_HEADING}")[1:]
    return dict(part.split("\n", 1) for part in parts)


def store(name: str, answers: dict[str, str]) -> None:
    """Accept these answers."""
    text = "\n".join(f"{_HEADING}{asked}\n{told}" for asked, told in answers.items())
    (_FOLDER / f"{name}.txt").write_text(f"{text}\n", "utf-8")


def difference(name: str, answers: dict[str, str]) -> str:
    """Which answers are not the stored ones, line by line; empty where all are."""
    before = stored(name)
    lines: list[str] = []
    for asked in dict.fromkeys((*before, *answers)):
        old, new = (told.get(asked, "").splitlines() for told in (before, answers))
        heading = f"{name}: {asked}"
        lines += difflib.unified_diff(old, new, heading, heading, lineterm="", n=1)
    return "\n".join(lines)
