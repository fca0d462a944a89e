"""What values tell of signals of which nothing else is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from webots_mcp.signals.meaning import UNKNOWN, meaning_by_behaviour

TIMES = [0.1 * row for row in range(200)]


@pytest.mark.parametrize(
    ("values", "quantity", "why"),
    [
        ([3.5] * 50, None, "its value never changed"),
        ([float(row % 3 == 0) for row in range(50)], "flag", "its values are 0 and 1"),
        (
            [float(row // 4 % 15) for row in range(200)],
            "count",
            "its whole numbers only rise, or begin again",
        ),
        (
            [math.remainder(0.7 * t, math.tau) for t in TIMES],
            "heading",
            "it leaps by a full turn, as an angle does",
        ),
        (
            [(40 * t) % 360 for t in TIMES],
            "heading",
            "it leaps by a full turn, as an angle does",
        ),
        ([0.5 * (row // 30 % 4) for row in range(200)], None, "it has only 4 different values"),
    ],
)
def test_a_behaviour_is_a_weak_source(
    values: Sequence[float], quantity: str | None, why: str
) -> None:
    found = meaning_by_behaviour(values)
    assert (found.quantity, found.source, found.why) == (quantity, "behaviour", why)
    assert not found.is_firm


@pytest.mark.parametrize(
    "values",
    [[math.sin(t) for t in TIMES], [float(row * row % 37) for row in range(200)], [1.0, 2.0]],
)
def test_what_could_be_anything_stays_unknown(values: Sequence[float]) -> None:
    assert meaning_by_behaviour(values) is UNKNOWN
