"""The measuring core: contenders take turns in blocks; medians, p99.9, ratios block by block."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from statistics import fmean, median
from typing import TypeVar

T = TypeVar("T")
Statistic = Callable[[list[float]], float]


def alternate(
    contenders: Mapping[str, Callable[[], T]], blocks: int, *, warm_up: bool = True
) -> dict[str, list[T]]:
    """Run the contenders in turn: A B A B ...

    Args:
        contenders: Name to what runs one block and returns what it measured.
        blocks: How many blocks of each are kept.
        warm_up: Run one more block of each in front and forget it.
    """
    if warm_up:
        for run_block in contenders.values():
            run_block()
    rounds = [{name: run_block() for name, run_block in contenders.items()} for _ in range(blocks)]
    return {name: [taken[name] for taken in rounds] for name in contenders}


def time_calls(call: Callable[[int], object], calls: int) -> list[float]:
    """Durations in seconds of so many calls in a row; the garbage collector runs in between."""
    gc.collect()
    clock, durations = time.perf_counter, [0.0] * calls
    for i in range(calls):
        started = clock()
        call(i)
        durations[i] = clock() - started
    return durations


@dataclass(frozen=True)
class Samples:
    """What one contender needed, block by block (seconds, or any other unit)."""

    blocks: list[list[float]]

    @classmethod
    def of(cls, singles: Iterable[float]) -> Samples:
        """Blocks of one value each."""
        return cls([[value] for value in singles])

    @property
    def all(self) -> list[float]:
        """The values of all blocks."""
        return [value for block in self.blocks for value in block]

    def typical(self, statistic: Statistic) -> float:
        """The median over the blocks of a statistic of each."""
        return median(statistic(block) for block in self.blocks)

    @property
    def p50(self) -> float:
        """The median."""
        return self.typical(median)

    @property
    def mean(self) -> float:
        """The mean of a typical block."""
        return self.typical(fmean)

    @property
    def p99(self) -> float:
        """One value in a hundred is above it."""
        return percentile(self.all, 0.99)

    @property
    def p999(self) -> float:
        """One value in a thousand is above it."""
        return percentile(self.all, 0.999)

    @property
    def worst(self) -> float:
        """The largest value."""
        return max(self.all)


def ratio(ours: Samples, theirs: Samples, statistic: Statistic = median) -> float:
    """The median of the ratios of neighbouring blocks: what drifts meanwhile falls out."""
    pairs = zip(ours.blocks, theirs.blocks, strict=True)
    return median(statistic(our) / statistic(their) for our, their in pairs)


def percentile(values: list[float], fraction: float) -> float:
    """The value below which that fraction of the values lies."""
    return sorted(values)[min(len(values) - 1, int(len(values) * fraction))]
