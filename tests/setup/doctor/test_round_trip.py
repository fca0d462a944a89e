"""A server of our own, started as a client starts it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.older_recording import make_older
from tests.recordings.rows import Recorded
from tests.setup.doctor.conftest import Look

pytestmark = pytest.mark.slow

BREAKS = "raise RuntimeError('the gear is gone')"


def test_a_server_that_starts_and_answers_is_well(look: Look, recorded: Recorded) -> None:
    recorded.robot().state(1.0, {"x": 1})
    found = look("Server")
    assert found.verdict == "ok", found
    assert "tools that only read, one answer" in found.seen


def test_a_server_that_answers_that_it_cannot_read_the_recording_is_not_to_blame(
    look: Look, file: Path
) -> None:
    make_older(file)
    found = look("Server")
    assert found.verdict == "warning"
    assert "move it aside" in found.seen
    assert "Schema" in (found.fix or "")


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
