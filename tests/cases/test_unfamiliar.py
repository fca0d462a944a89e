"""Robots of unfamiliar kinds raise no alarm while healthy, and their faults are noticed."""

from __future__ import annotations

import pytest

from tests.cases import more_unfamiliar  # which enters its robots into `ROBOTS`
from tests.cases.unfamiliar import (
    GOOD,
    HELPFUL,
    INTERVALS_S,
    NOT_JUDGED,
    RIGHT,
    ROBOTS,
    ask_faulty,
    ask_healthy,
)

_REGISTERED = more_unfamiliar
_NOT_JUDGED = {"tracked excavator": "speeds of tracks are not known to be those of wheels"}


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", INTERVALS_S[1:])  # the module asks at all of them
@pytest.mark.parametrize("name", ROBOTS)
def test_a_healthy_robot_raises_no_alarm(name: str, interval_s: float) -> None:
    answer, said = ask_healthy(name, interval_s)
    assert answer == GOOD, said


@pytest.mark.parametrize("name", ROBOTS)
def test_a_fault_is_noticed_and_never_denied(name: str) -> None:
    answer, said = ask_faulty(name)
    wanted = (NOT_JUDGED,) if name in _NOT_JUDGED else (RIGHT, HELPFUL)
    assert answer in wanted, said
