"""A fall names the side on which the robot lies."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise, wrapped
from tests.cases.situations import Columns, Situation, recorded


@pytest.mark.parametrize("mounted_rad", [0.0, math.pi])  # upside down: about its x axis
@pytest.mark.parametrize(
    ("roll", "pitch", "direction"),
    [
        (1.4, 0.0, "right"),
        (-1.4, 0.0, "left"),
        (0.0, 1.4, "forward"),
        (0.0, -1.4, "back"),
        (-1.0, -0.8, "back left"),
    ],
)
def test_the_side_follows_from_roll_and_pitch(
    roll: float, pitch: float, direction: str, mounted_rad: float
) -> None:
    def draw(t: Array, random: Random) -> Columns:
        tips = np.clip(t - 20, 0, 1)
        return {
            "imu.roll": wrapped(mounted_rad + roll * tips + noise(random, t, 0.01)),
            "imu.pitch": pitch * tips + noise(random, t, 0.01),
            "x": 0.2 * np.minimum(t, 20),
            "y": 0 * t,
        }

    with recorded(Situation("falls", draw, (), 40, 0.04)) as asked:
        (fall,) = asked.events("fall").events
        (check,) = (each for each in asked.checked.findings if each.name == "stays upright")
    assert fall.details["direction"] == direction
    assert f"({direction})" in check.evidence


def test_with_roll_alone_a_fall_is_to_the_left_or_right() -> None:
    def draw(t: Array, random: Random) -> Columns:
        return {"roll_deg": -85 * np.clip(t - 20, 0, 1) + noise(random, t, 0.5)}

    with recorded(Situation("falls by roll", draw, (), 40, 0.04)) as asked:
        (fall,) = asked.events("fall").events
    assert fall.details["direction"] == "left"
