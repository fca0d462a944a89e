"""How a signal differs between groups of runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.spread import Spread, spread_of, verdicts_on
from webots_mcp.store.analysis.summary import Summary
from webots_mcp.store.signals.registry import Signal

_DUST: Final = 1e-9  # of a signal's largest value: what varies by less does not vary


@dataclass(frozen=True)
class Difference:
    """A signal in each group, over the compared stretch; lists are in the order of the groups.

    Attributes:
        mean: Over the runs of the group; of an angle the circular mean.
        deviation: The standard deviation within a run, over the runs of the group.
        deviation_ratio: Of its median to that of the first group; None where that is 0.
        effect: How far each mean is from that of the first group, in pooled standard deviations:
            Cohen's d, (m - m1) / sqrt((s1**2 + s**2) / 2) (J. Cohen, Statistical Power Analysis
            for the Behavioral Sciences, 2nd ed. 1988, section 2.2 with the note on unequal
            deviations); 0.2 is called small, 0.5 medium, 0.8 large. None where it is not defined:
            without values, or both constant and not equal. Rows follow each other too closely to
            be independent, so it describes, and proves nothing.
        different: Whether the means or the deviations differ by more than those of like runs do;
            None where that cannot be decided (`analysis.spread`).
        interval: The difference of the means of the groups lies in it nine times of ten.
    """

    name: str
    kind: str
    unit: str | None
    mean: list[Spread | None]
    deviation: list[Spread | None]
    min: list[float | None]
    max: list[float | None]
    count: list[int | None]
    deviation_ratio: list[float | None]
    effect: list[float | None]
    different: list[bool | None]
    interval: list[tuple[float, float] | None]


def difference_of(
    signal: Signal,
    groups: Sequence[Sequence[dict[str, Summary] | None]],
    tests: int,
    min_effect_sd: float,
) -> Difference:
    """A signal in each run of each group.

    Args:
        signal: Which.
        groups: Of each run its summaries; None of one of which not all was read.
        tests: So many are made at once.
        min_effect_sd: See `analysis.spread`.
    """
    whole = [[run for run in group if run is not None] for group in groups]
    is_whole = [len(a) == len(b) for a, b in zip(whole, groups, strict=True)]
    runs = [[run.get(signal.name, Summary()) for run in group] for group in whole]
    runs = [[each for each in group if each.sum is not None] for group in runs]
    read = [group if all_read else [] for group, all_read in zip(runs, is_whole, strict=True)]
    known = all(each.sines is not None for group in runs for each in group)
    turn = signal.turn if known else None
    means, deviations = (
        [each if all_read else [None] for each, all_read in zip(figures, is_whole, strict=True)]
        for figures in (_means(turn, runs), _deviations(turn, runs))
    )
    mean, deviation = [spread_of(each) for each in means], [spread_of(each) for each in deviations]
    of_means = verdicts_on(means, tests, min_effect_sd=min_effect_sd)
    of_deviations = verdicts_on(deviations, tests, min_effect_sd=min_effect_sd)
    verdicts = zip(of_means, of_deviations, strict=True)
    return Difference(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        mean=mean,
        deviation=deviation,
        min=[
            min((each.min for each in group if each.min is not None), default=None)
            for group in read
        ],
        max=[
            max((each.max for each in group if each.max is not None), default=None)
            for group in read
        ],
        count=[
            sum(each.present for each in group) if all_read else None
            for group, all_read in zip(runs, is_whole, strict=True)
        ],
        deviation_ratio=[_ratio(each, deviation[0]) for each in deviation],
        effect=[_effect(turn, mean, deviation, index) for index in range(len(groups))],
        different=[_either(a.different, b.different) for a, b in verdicts],
        interval=[each.interval for each in of_means],
    )


def _means(turn: float | None, groups: Sequence[Sequence[Summary]]) -> list[list[float | None]]:
    """Of an angle all within half a turn of the first: their own mean must not be cut in two."""
    found = [[each.centre(turn) for each in group] for group in groups]
    if turn is None:
        return found
    start = next((each for group in found for each in group if each is not None), 0.0)
    return [
        [None if each is None else start + math.remainder(each - start, turn) for each in group]
        for group in found
    ]


def _deviations(
    turn: float | None, groups: Sequence[Sequence[Summary]]
) -> list[list[float | None]]:
    return [[_without_dust(each.deviation_in(turn), each) for each in group] for group in groups]


def _without_dust(deviation: float | None, summary: Summary) -> float | None:
    """What adding floats leaves is the 0 that it means."""
    if deviation is None or summary.min is None or summary.max is None:
        return deviation
    return deviation if deviation > _DUST * max(abs(summary.min), abs(summary.max)) else 0.0


def _either(one: bool | None, other: bool | None) -> bool | None:
    return True if one or other else None if None in (one, other) else False


def _ratio(deviation: Spread | None, first: Spread | None) -> float | None:
    if deviation is None or first is None or first.median == 0:
        return None
    return deviation.median / first.median


def _effect(
    turn: float | None,
    means: Sequence[Spread | None],
    deviations: Sequence[Spread | None],
    index: int,
) -> float | None:
    """Cohen's d of a group against the first; see `Difference`."""
    mean, deviation, mean1, deviation1 = means[index], deviations[index], means[0], deviations[0]
    if mean is None or mean1 is None or deviation is None or deviation1 is None:
        return None
    apart = mean.median - mean1.median
    apart = apart if turn is None else math.remainder(apart, turn)
    pooled = math.sqrt((deviation.median**2 + deviation1.median**2) / 2)
    if pooled <= 1e-12 * max(abs(mean.median), abs(mean1.median)):
        return 0.0 if math.isclose(mean.median, mean1.median, rel_tol=1e-9) else None
    return apart / pooled


def size_of(difference: Difference) -> tuple[bool, float]:
    """What differs most: first what differs for certain, then by the effect or the deviation.

    Constants that are not equal come before all others; a deviation counts by how often it has
    doubled or halved.
    """
    effects = (math.inf if each is None else abs(each) for each in difference.effect[1:])
    ratios = (each for each in difference.deviation_ratio[1:] if each is not None)
    doublings = (math.inf if each == 0 else abs(math.log2(each)) for each in ratios)
    return any(difference.different), max((0.0, *effects, *doublings))


def only_in(differences: Sequence[Difference], groups: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Signals that not every group has, with the groups that have them."""
    return {
        each.name: tuple(group for group, count in zip(groups, each.count, strict=True) if count)
        for each in differences
        if any(each.count) and 0 in each.count
    }
