"""The states that are published in the benchmarks."""

from __future__ import annotations

import random
from typing import Any, Final

STATES: Final = 64

State = dict[str, Any]


def make_states(count: int = STATES) -> list[State]:
    """States of 39 leaves, about 740 bytes of compact JSON; all numbers differ between them."""
    numbers = random.Random(7)
    return [_state(numbers) for _ in range(count)]


def make_wide_states(count: int = STATES) -> list[State]:
    """States of 88 leaves, about 1.5 kB: what all devices of a well equipped robot say."""
    numbers = random.Random(8)
    return [_wide_state(numbers) for _ in range(count)]


def _wide_state(numbers: random.Random) -> State:
    arms = {
        f"arm_{side}": {
            "angles_rad": [round(numbers.uniform(-3.1, 3.1), 8) for _ in range(6)],
            "torques_nm": [round(numbers.uniform(-9.9, 9.9), 8) for _ in range(6)],
            "touches": [numbers.random() < 0.01 for _ in range(4)],
            "grasping": numbers.random() < 0.01,
        }
        for side in ("left", "right")
    }
    sonar = [round(numbers.uniform(0.1, 5), 8) for _ in range(15)]
    return {**_state(numbers), **arms, "sonar_m": sonar}


def _state(numbers: random.Random) -> State:
    def some(count: int, digits: int) -> list[float]:
        return [round(numbers.uniform(-9.99, 9.99), digits) for _ in range(count)]

    return {
        "mode": "following_wall",
        "goal_reached": False,
        "pose": dict(zip(("x_m", "y_m", "yaw_rad"), some(3, 8), strict=True)),
        "velocity": dict(zip(("linear_m_s", "angular_rad_s"), some(2, 8), strict=True)),
        "imu": dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), some(3, 8), strict=True)),
        "accelerometer": some(3, 8),
        "gyro": some(3, 8),
        "wheels": {"left_rad": some(1, 8)[0], "right_rad": some(1, 8)[0]},
        "motors": {"left_rad_s": some(1, 6)[0], "right_rad_s": some(1, 6)[0]},
        "distance": {f"ds{i}": value for i, value in enumerate(some(8, 6))},
        "lidar": {"min_m": some(1, 6)[0], "sectors_m": some(8, 6)},
        "battery_j": round(numbers.uniform(1e4, 9e4), 3),
        "step": numbers.randrange(10_000, 99_999),
    }
