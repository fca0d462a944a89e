"""Ways of a robot whose truth is known, as arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from webots_mcp.analysis.path_length import SmoothedTrack, track_of

Array = NDArray[np.float64]


def way(
    phases: Sequence[tuple[float, float, float]], interval_s: float
) -> tuple[Array, Array, Array, float]:
    """Times, x, y and the metres travelled of phases: seconds, speed in m/s, turn in rad/s."""
    ends = np.cumsum([seconds for seconds, _, _ in phases])
    times = np.arange(0.0, ends[-1], interval_s)
    at = np.minimum(np.searchsorted(ends, times, side="right"), len(phases) - 1)
    speed, turn = (np.array([phase[index] for phase in phases])[at] for index in (1, 2))
    heading = np.cumsum(turn) * interval_s
    x, y = np.cumsum(speed * np.cos(heading)), np.cumsum(speed * np.sin(heading))
    return times, x * interval_s, y * interval_s, float(np.abs(speed).sum() * interval_s)


def noisy_track(
    phases: Sequence[tuple[float, float, float]], interval_s: float, noise_m: float, seed: int = 1
) -> tuple[SmoothedTrack, float]:
    """The track of a robot that goes through the phases, and how far it truly went."""
    times, x, y, length_m = way(phases, interval_s)
    noise = np.random.default_rng(seed).normal(0, noise_m, (2, len(times)))
    return track_of(times, x + noise[0], y + noise[1]), length_m
