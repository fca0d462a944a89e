"""A grip that is lost under an unchanged command is found; letting go as commanded is not one."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise
from tests.cases.situations import Columns, Situation, recorded


def _gripper(t: Array, random: Random, *, lost: bool) -> Columns:
    closed = (t % 12) >= 4
    holds = closed & ~(lost & (t >= 32) & (t < 36))
    return {
        "gripper.command": 1.0 * closed,
        "gripper.force_n": holds * 12.0 + noise(random, t, 0.2),
        "gripper.opening_m": np.where(holds, 0.04, np.where(closed, 0.0, 0.08)),
    }


@pytest.mark.parametrize("interval_s", [0.01, 0.05, 0.2])
def test_a_lost_grip_is_a_warning(interval_s: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _gripper(t, random, lost=True)

    with recorded(Situation("loses it", draw, (), 60, interval_s)) as asked:
        (found,) = asked.events("off_target").events
        (check,) = (e for e in asked.checked.findings if e.name == "follows its targets")
    assert (found.name, found.start_s) == ("gripper.force_n", pytest.approx(32, abs=0.3))
    assert check.outcome == "warn"
    assert "the grip was lost" in check.evidence


@pytest.mark.parametrize("interval_s", [0.01, 0.05, 0.2])
def test_a_gripper_that_opens_as_commanded_is_fine(interval_s: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        return _gripper(t, random, lost=False)

    with recorded(Situation("holds it", draw, (), 60, interval_s)) as asked:
        assert asked.events("off_target").events == ()
        assert not asked.checked.of("warn", "fail")
