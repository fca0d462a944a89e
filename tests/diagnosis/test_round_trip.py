"""A server of our own, started as a client starts it."""

from __future__ import annotations

import sys

import pytest

from tests.diagnosis.conftest import Look
from tests.recordings.rows import Recorded

BREAKS = "raise RuntimeError('the gear is gone')"


def test_a_server_that_starts_and_answers_is_well(look: Look, recorded: Recorded) -> None:
    recorded.robot().state(1.0, {"x": 1})
    found = look("Server")
    assert found.verdict == "ok", found
    assert "tools, one answer" in found.seen


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ((sys.executable, "-c", BREAKS), "it wrote: RuntimeError: the gear is gone"),
        (("/nowhere/python", "-m", "webots_mcp"), "/nowhere/python"),
    ],
)
def test_a_server_that_cannot_start_is_wrong_and_its_last_words_are_told(
    look: Look, line: tuple[str, ...], why: str
) -> None:
    found = look("Server", *line)
    assert found.verdict == "wrong"
    assert why in found.seen
    assert found.fix
