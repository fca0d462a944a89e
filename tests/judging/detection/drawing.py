"""Cases by kind and seed: the same seed draws the same case."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from tests.judging.detection import driving, sensing, swinging
from tests.judging.detection.labelled import Case, LabelledRun, Measure, cut_at

MOST_VALUES: Final = 400_000  # rows times signals that are added to a run
WIDE: Final = 300
_RESET_SHARE: Final = 0.25
_MOTION: Final[tuple[Measure, ...]] = ("standstill", "stuck")
_SENSORS: Final[tuple[Measure, ...]] = ("missing", "flat", "dropout", "swing")


def with_others(rng: np.random.Generator, run: LabelledRun, count: int) -> LabelledRun:
    """The run with so many counters beside: they rise with each row, and never stand still."""
    starts = rng.integers(0, 1000, count).tolist()
    rows = [
        {f"c{at}": start + row for at, start in enumerate(starts)} for row in range(len(run.times))
    ]
    return replace(run, columns={**run.columns, "counters": rows}) if count else run


@dataclass(frozen=True)
class Kind:
    """A kind of recording.

    Attributes:
        asked: What is looked for in it; what is found and did not happen is false.
        others: How many signals that say nothing stand beside; None draws 0 to 300.
        anew: Its runs are drawn one by one, each with names of its own, as after an edit.
    """

    draw: Callable[[np.random.Generator], LabelledRun]
    asked: tuple[Measure, ...]
    others: int | None = None
    anew: bool = False


KINDS: Final[dict[str, Kind]] = {
    **{name: Kind(draw, _MOTION) for name, draw in driving.DRAWN.items()},
    **{name: Kind(draw, _SENSORS) for name, draw in sensing.DRAWN.items()},
    "gaps": Kind(sensing.draw_gaps, ("gap", *_SENSORS)),
    "leaps": Kind(sensing.draw_leaps, ("leap",)),
    "healthy": Kind(
        sensing.draw_healthy, ("standstill", "stuck", "missing", "flat", "dropout", "leap", "gap")
    ),
    **{name: Kind(draw, ("swing",)) for name, draw in swinging.DRAWN.items()},
    "swing_gap": Kind(swinging.draw_with_gap, ("swing", "dropout", "gap")),
    "renamed": Kind(driving.draw_held, _MOTION, anew=True),
    "wide": Kind(sensing.draw_short_silence, ("missing",), others=WIDE),
}


def draw_case(kind: str, seed: int, index: int, *, most_values: int = MOST_VALUES) -> Case:
    """The case of that number: a run, in a quarter of the cases again after it was reset."""
    rng = np.random.default_rng([seed, index, zlib.crc32(kind.encode())])
    chosen = KINDS[kind]
    run = _among_others(rng, chosen, most_values)
    runs = (run,)
    if chosen.anew:
        runs = (chosen.draw(rng), run)
    elif rng.random() < _RESET_SHARE:
        runs = (cut_at(run, float(rng.uniform(0.2, 0.9)) * run.duration_s), run)
    return Case(kind, index, runs, chosen.asked)


def _among_others(rng: np.random.Generator, chosen: Kind, most_values: int) -> LabelledRun:
    """A run with signals beside that say nothing, as many as its rows allow."""
    run = chosen.draw(rng)
    drawn = int(rng.choice([0, 0, 0, 5, 20, 100, WIDE]))
    wanted = drawn if chosen.others is None else chosen.others
    return with_others(rng, run, min(wanted, most_values // len(run.times)))
