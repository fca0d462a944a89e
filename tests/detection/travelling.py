"""How far a robot is said to have travelled, at rest and on the way, beside how far it did."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tests.detection.asking import ToldDistance, told_distances
from tests.detection.driving import NOISES_M, drive_of, driven, phase
from tests.detection.labelled import LabelledRun
from tests.detection.writing import write_all
from tests.memory import memory_connection

INTERVALS_S: Final = (0.08, 0.008, 0.032, 0.16, 0.5)
SECONDS: Final = 120.0
MOST_AT_REST_M: Final = {0.01: 0.1, 0.03: 0.5}  # up to that noise
MOST_ERROR: Final = {0.01: 0.02, 0.03: 0.05}
SLOW_M_S: Final = (0.03, 0.1)
# Noise hides bends as narrow as those of a slow robot: the truth lies so near to what is told, or
# to what it is said to be at most.
MOST_SLOW_ERROR: Final = 0.1


@dataclass(frozen=True)
class Travelled:
    """What came of one noise of the position.

    Attributes:
        rest_m: What each robot at rest is said to have travelled in two minutes.
        ratios: What each driving one is said to have travelled, as a ratio to the truth.
        slow: The same of each slow one, and what it is said to have travelled at most.
        unknown: How many distances the answer does not know.
    """

    noise_m: float
    rest_m: tuple[float, ...]
    ratios: tuple[float, ...]
    unknown: int
    slow: tuple[tuple[float, float], ...] = ()

    @property
    def missed(self) -> list[str]:
        """The goals that are not reached."""
        band = min(noise_m for noise_m in MOST_ERROR if self.noise_m <= noise_m)
        worst = max((abs(ratio - 1) for ratio in self.ratios), default=0.0)
        failed = {
            "rest": max(self.rest_m, default=0.0) > MOST_AT_REST_M[band],
            "distance": worst > MOST_ERROR[band],
            "slow": any(
                told > 1 + MOST_SLOW_ERROR or most < 1 - MOST_SLOW_ERROR for told, most in self.slow
            ),
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
        slow: list[tuple[float, float]] = []
        unknown = 0
        for index in range(cases):
            say(f"distance at {1000 * noise_m:g} mm {index + 1}/{cases}")
            runs = _runs(np.random.default_rng([seed, index]), index, noise_m)
            rest, brisk, slowly = _told(runs)
            unknown += sum(each is None for each in (rest, brisk, slowly))
            rest_m += [rest.distance_m] if rest else []
            ratios += [_ratios(brisk, runs[1])[0]] if brisk else []
            slow += [_ratios(slowly, runs[2])] if slowly else []
        yield Travelled(noise_m, tuple(rest_m), tuple(ratios), unknown, tuple(slow))


def _runs(rng: np.random.Generator, index: int, noise_m: float) -> list[LabelledRun]:
    """At rest, on the way, and slowly so."""
    interval_s = INTERVALS_S[index % len(INTERVALS_S)]
    rest = driven(rng, [phase(SECONDS, 0.0, "idle")], interval_s, noise_m, "commanded")
    speeds = (float(rng.uniform(0.1, 0.4)), float(rng.uniform(*SLOW_M_S)))
    drives = (drive_of(rng, SECONDS, speed, "drive") for speed in speeds)
    return [rest, *(driven(rng, each, interval_s, noise_m, "commanded") for each in drives)]


def _ratios(told: ToldDistance, run: LabelledRun) -> tuple[float, float]:
    """Of what is told, and of what it may be at most, to the truth."""
    truth_m = run.distance_m or 1
    return told.distance_m / truth_m, (told.distance_m + told.longer_m) / truth_m


def _told(runs: Sequence[LabelledRun]) -> list[ToldDistance | None]:
    with memory_connection() as connection:
        return told_distances(connection, write_all(connection, runs))
