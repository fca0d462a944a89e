"""Where the level of some values changes, for good or for a while."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final

from webots_mcp.analysis.arrays import Array, np

FEWEST_VALUES: Final = 5  # of a level


def level_changes(values: Array, false_alarms: float) -> list[int]:
    """Return the places at which the level of values changes, in order.

    Searched is the part whose ranks differ most from those of the rest, which may lie in the middle
    (A. B. Olshen and others, Circular binary segmentation for the analysis of array-based DNA copy
    number data, Biostatistics 5, 2004; here of ranks). Then each of the parts is searched again.
    Single values that stand out, and a skewed distribution, divide nothing.

    Args:
        values: In order of time. They may have any distribution, and should be independent.
        false_alarms: How often at most values of one level are divided.
    """
    found: set[int] = set()
    waiting = [(0, len(values))]
    while waiting:
        start, stop = waiting.pop()
        part = _other_part(values[start:stop], false_alarms)
        if part is None:
            continue
        edges = [start, start + part[0], start + part[1], stop]
        found.update(edges)
        waiting += [(a, b) for a, b in pairwise(edges) if b > a]
    return sorted(found - {0, len(values)})


def _other_part(values: Array, false_alarms: float) -> tuple[int, int] | None:
    """Return begin and end of the part of another level; None where none is significant."""
    count = len(values)
    if count < 2 * FEWEST_VALUES:
        return None
    (chance, part), (other_chance, other_part) = _by_rank_sums(values), _separated(values)
    if min(chance, other_chance) >= false_alarms / 2:
        return None
    return other_part if other_chance < chance else part


def _by_rank_sums(values: Array) -> tuple[float, tuple[int, int]]:
    """Return the part whose mean rank differs most, and how often chance makes one like it.

    The sum of the ranks of a part is about normal; its tails are lighter, so that the chance is
    not underestimated.
    """
    count = len(values)
    ranks = _ranks(values)
    sums = np.append(0.0, np.cumsum(ranks - ranks.mean()))
    lengths = np.arange(count + 1) - np.arange(count + 1)[:, None]
    fits = (lengths >= FEWEST_VALUES) & (lengths <= count - FEWEST_VALUES)
    inside = np.minimum(np.maximum(lengths, 1), count - 1)
    variance = float(np.var(ranks)) * inside * (count - inside) / max(1, count - 1)
    scores = np.abs(sums - sums[:, None]) / np.sqrt(np.maximum(variance, 1e-12))
    best = int(np.where(fits, scores, 0.0).argmax())
    part = divmod(best, count + 1)
    chance = math.erfc(float(scores[part]) / math.sqrt(2)) * int(np.count_nonzero(fits))
    return chance, part


def _separated(values: Array) -> tuple[float, tuple[int, int]]:
    """Return a part whose values are all less, or all greater, than the others; and its chance.

    Of n values in any order the k least follow each other in n - k + 1 of n over k orders.
    """
    count = len(values)
    best = math.inf, (0, count)
    for sign in (1, -1):
        order = np.argsort(sign * values, kind="stable")
        first, last = np.minimum.accumulate(order), np.maximum.accumulate(order)
        gaps = np.diff(values[order]) != 0
        together = (last - first)[:-1] == np.arange(count - 1)
        for at in np.flatnonzero(together & gaps).tolist():
            length = at + 1
            if not FEWEST_VALUES <= length <= count - FEWEST_VALUES:
                continue
            orders = math.comb(count, length) / (count - length + 1)
            # It may be of any length, and less or greater.
            chance = 2 * count / orders
            best = min(best, (chance, (int(first[at]), int(last[at]) + 1)))
    return best


def _ranks(values: Array) -> Array:
    """Ranks from 1; equal values share the mean of theirs."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return np.asarray((ends - (counts - 1) / 2)[places], np.float64)
