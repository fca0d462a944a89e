"""The conversations in examples/ are such as take place: they are had again, and compared."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from webots_mcp.judging.detection.event_kinds import kind_names

EXAMPLES = Path(__file__).parents[2] / "examples"
CONVERSATIONS = sorted(path.parent.name for path in EXAMPLES.glob("*/conversation.toml"))
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


def test_there_are_conversations_to_have() -> None:
    assert {"conversation", "e_puck", "tag"} <= set(CONVERSATIONS)


@pytest.mark.parametrize(
    "page", sorted(EXAMPLES.glob("*/README.md")), ids=lambda page: page.parent.name
)
def test_a_page_shows_kinds_and_counts_by_the_names_that_they_have(page: Path) -> None:
    shown = page.read_text("utf-8")
    assert set(re.findall(r'"(\w+) per min"', shown)) <= set(kind_names())
    assert re.search(r'"rows": \d', shown) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVERSATIONS)
def test_the_page_shows_what_is_said_and_answered_today(name: str) -> None:
    line = [sys.executable, str(EXAMPLES / "ask.py"), str(EXAMPLES / name)]
    had = subprocess.run(line, capture_output=True, text=True, timeout=600, check=False)
    assert had.returncode == 0, had.stderr
    shown = (EXAMPLES / name / "README.md").read_text("utf-8")

    assert len(turns_of(shown)) == shown.count("**Assistant:**") > 4
    assert turns_of(had.stdout) == turns_of(shown)
    assert [text for text in shown.splitlines() if text.startswith("**You:**")] == [
        text for text in had.stdout.splitlines() if text.startswith("**You:**")
    ]
