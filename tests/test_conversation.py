"""The conversation in examples/ is one that takes place: it is had again, and compared."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parent.parent / "examples" / "conversation"
TURN = re.compile(r"```\n(.*?)\n```\n\n```\n(.*?)\n```\n\n\*\*Assistant:\*\* (.*?)\n\n", re.S)


class Turn(NamedTuple):
    call: str
    answer: list[str]  # which parts it has
    says: str


def turns_of(page: str) -> list[Turn]:
    return [
        Turn(without_numbers(call), re.findall(r'^  "(\w+)":', answer, re.M), without_numbers(says))
        for call, answer, says in TURN.findall(page + "\n")
    ]


def without_numbers(text: str) -> str:
    """Simulators on two machines are not at the same step when they are asked."""
    return re.sub(r"\d+(\.\d+)?", "#", text)


def test_the_page_shows_what_is_said_and_answered_today() -> None:
    line = [sys.executable, str(FOLDER / "conversation.py")]
    had = subprocess.run(line, capture_output=True, text=True, timeout=180, check=False)
    assert had.returncode == 0, had.stderr
    shown = (FOLDER / "README.md").read_text("utf-8")

    assert len(turns_of(shown)) == 10
    assert turns_of(had.stdout) == turns_of(shown)
    assert [text for text in shown.splitlines() if text.startswith("**You:**")] == [
        text for text in had.stdout.splitlines() if text.startswith("**You:**")
    ]
