"""A clock for deadlines that no busy machine uses up."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, Deadline


@pytest.fixture(scope="session", autouse=True)
def deadlines_of_this_process() -> Iterator[None]:
    """A deadline counts the processor time of the tests: no busy machine uses it up."""
    with pytest.MonkeyPatch.context() as patched:
        clock = (QUESTION_DEADLINE_S, time.process_time)
        patched.setattr(Deadline.__init__, "__defaults__", clock)
        yield
