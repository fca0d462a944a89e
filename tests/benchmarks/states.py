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
