"""Comparisons across an edit: of one that changed nothing, and of one that made it 10 % faster."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tests.detection.asking import claimed_differences, compared_edits, undecided
from tests.detection.driving import drive_of, driven, phase
from tests.detection.labelled import LabelledRun
from tests.detection.sensing import sensors
from tests.detection.writing import Writer, put_in_chunks
from tests.memory import memory_connection
from webots_mcp.store.questions.compare import Comparison

SAME_PAIRS: Final = 20
FASTER_PAIRS: Final = 10
RUNS: Final = 4  # on either side of the edit
FASTER: Final = 1.1
SPEED_M_S: Final = 0.2
INTERVAL_S: Final = 0.1
LIKE_RUNS: Final = 0.01  # the speeds of like runs differ by this standard deviation, as a share
_SPEED: Final = re.compile(r"speed|distance|travelled|m_s|m_min", re.IGNORECASE)


@dataclass(frozen=True)
class Pairs:
    """What came of the pairs.

    Attributes:
        claimed: Names of what is claimed to be different between like runs, pair by pair.
        found: Of the pairs with a robot that became faster, those in which that was claimed.
        undecided: And those of which the answer says that more runs would show it.
    """

    claimed: tuple[tuple[str, ...], ...]
    faster: int
    found: int
    undecided: int

    @property
    def missed(self) -> list[str]:
        """The goals that are not reached."""
        return ["A/A"] * any(self.claimed) + ["+10 %"] * (self.found < self.faster)


def measure_pairs(
    seed: int,
    same: int = SAME_PAIRS,
    faster: int = FASTER_PAIRS,
    say: Callable[[str], None] = lambda text: None,
) -> Pairs:
    """Compare so many pairs of each sort."""
    claimed: list[tuple[str, ...]] = []
    for index in range(same):
        say(f"A/A {index + 1}/{same}")
        comparison = _compared(seed, index, 1.0)
        claimed.append(tuple(name for name, _ in claimed_differences(comparison)))
    found = unsure = 0
    for index in range(faster):
        say(f"+10 % {index + 1}/{faster}")
        comparison = _compared(seed, same + index, FASTER)
        rises = [name for name, more in claimed_differences(comparison) if more > 0]
        is_found = any(map(_SPEED.search, rises))
        found += is_found
        unsure += not is_found and any(map(_SPEED.search, undecided(comparison)))
    return Pairs(tuple(claimed), faster, found, unsure)


def _compared(seed: int, index: int, faster: float) -> Comparison:
    rng = np.random.default_rng([seed, index, 1])
    with memory_connection() as connection:
        writer = Writer(connection)
        for code, factor in (("a", 1.0), ("b", faster)):
            writer.begin_session(code)
            for _ in range(RUNS):
                writer.write(_run(rng, SPEED_M_S * factor))
        put_in_chunks(connection)
        return compared_edits(connection)


def _run(rng: np.random.Generator, speed_m_s: float) -> LabelledRun:
    """A drive on a way of its own with two stops, beside sensors that work."""
    speed_m_s *= 1 + float(rng.normal(0, LIKE_RUNS))
    phases = drive_of(rng, 25.0, speed_m_s, "explore")
    for _ in range(2):
        phases.append(phase(5.0, 0.0, "scan"))
        phases += drive_of(rng, 25.0, speed_m_s, "explore")
    drive = driven(rng, phases, INTERVAL_S, 0.005, "measured", "pose")
    measured = np.array(drive.columns["speed"]) + rng.normal(0, 0.005, len(drive.times))
    beside = sensors(rng, INTERVAL_S, 2 * drive.duration_s).columns
    others = {name: beside[name][: len(drive.times)] for name in ("front", "gyro", "battery_v")}
    return replace(drive, columns={**drive.columns, **others, "speed": measured.tolist()})
