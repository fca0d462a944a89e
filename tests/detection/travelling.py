"""How far a robot is said to have travelled, at rest and on the way, beside how far it did."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from tests.detection.asking import distances_m
from tests.detection.driving import NOISES_M, drive_of, driven, phase
from tests.detection.labelled import LabelledRun
from tests.detection.writing import write_all
from tests.memory import memory_connection

INTERVALS_S: Final = (0.08, 0.008, 0.032, 0.16, 0.5)
SECONDS: Final = 120.0
MOST_AT_REST_M: Final = {0.01: 0.1, 0.03: 0.5}  # up to that noise
MOST_ERROR: Final = {0.01: 0.02, 0.03: 0.05}


@dataclass(frozen=True)
class Travelled:
    """What came of one noise of the position.

    Attributes:
        rest_m: What each robot at rest is said to have travelled in two minutes.
        ratios: What each driving one is said to have travelled, as a ratio to the truth.
        unknown: How many distances the answer does not know.
    """

    noise_m: float
    rest_m: tuple[float, ...]
    ratios: tuple[float, ...]
    unknown: int

    @property
    def missed(self) -> list[str]:
        """The goals that are not reached."""
        band = min(noise_m for noise_m in MOST_ERROR if self.noise_m <= noise_m)
        worst = max((abs(ratio - 1) for ratio in self.ratios), default=0.0)
        failed = {
            "rest": max(self.rest_m, default=0.0) > MOST_AT_REST_M[band],
            "distance": worst > MOST_ERROR[band],
            "unknown": self.unknown > 0,
        }
        return [name for name, is_missed in failed.items() if is_missed]


def measure_travelled(
    cases: int, seed: int, say: Callable[[str], None] = lambda text: None
) -> Iterable[Travelled]:
    """Ask for the distances of so many robots at rest and on the way, at each noise."""
    for noise_m in NOISES_M:
        rest_m: list[float] = []
        ratios: list[float] = []
        unknown = 0
        for index in range(cases):
            say(f"distance at {1000 * noise_m:g} mm {index + 1}/{cases}")
            rest, drive = _runs(np.random.default_rng([seed, index]), index, noise_m)
            told = _told(rest, drive)
            unknown += told.count(None)
            rest_m += [told[0]] if told[0] is not None else []
            ratios += [told[1] / (drive.distance_m or 1)] if told[1] is not None else []
        yield Travelled(noise_m, tuple(rest_m), tuple(ratios), unknown)


def _runs(rng: np.random.Generator, index: int, noise_m: float) -> tuple[LabelledRun, LabelledRun]:
    interval_s = INTERVALS_S[index % len(INTERVALS_S)]
    rest = driven(rng, [phase(SECONDS, 0.0, "idle")], interval_s, noise_m, "commanded")
    speed = float(rng.uniform(0.1, 0.4))
    drive = driven(rng, drive_of(rng, SECONDS, speed, "drive"), interval_s, noise_m, "commanded")
    return rest, drive


def _told(*runs: LabelledRun) -> list[float | None]:
    with memory_connection() as connection:
        return distances_m(connection, write_all(connection, runs))
