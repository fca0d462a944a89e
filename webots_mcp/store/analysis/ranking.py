"""Which parameters did best, and whether by more than repeats of the same ones differ."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

from webots_mcp.store.analysis.spread import Spread, chance_beyond, spread_of

Best = Literal["highest", "lowest"]
MOST_CHANCE: Final = 0.01  # that a set is called better than the next one, and is not


class Outcome(NamedTuple):
    """What became of a trial: a score, or why there is none; one that was pruned has not failed."""

    parameters: dict[str, Any]
    score: float | None
    failure: str | None = None
    pruned: bool = False


class Ranked(NamedTuple):
    """A parameter set and its trials.

    Attributes:
        score: Median, least and greatest of those that gave one; None if none did.
        scores: Of each of them.
        failures: Why others gave none.
        pruned: How many were ended early because they were not worth going on with.
    """

    parameters: dict[str, Any]
    score: Spread | None
    scores: list[float]
    failures: list[str]
    pruned: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether every trial gave a score."""
        return not self.failures and not self.pruned


class Noise(NamedTuple):
    """How much the scores of repeats differ.

    Attributes:
        deviation: The standard deviation, pooled over all sets.
        freedom: The degrees of freedom that it rests on; 0 where nothing was repeated.
    """

    deviation: float
    freedom: int


class Ranking(NamedTuple):
    """Parameter sets, the best first; those of which every trial gave a score come first.

    Attributes:
        better: Whether the best beats the next by more than the noise; None if nobody can tell.
        chance: How often noise alone would set the two as far apart.
        verdict: The same as a sentence.
    """

    sets: list[Ranked]
    noise: Noise
    better: bool | None
    chance: float | None
    verdict: str


def rank(outcomes: Sequence[Outcome], best: Best = "highest") -> Ranking:
    """Rank the parameter sets of finished trials."""
    sets = sorted(_grouped(outcomes), key=lambda each: _place(each, best))
    noise = _noise(sets)
    chance = _chance(sets, noise)
    limit = MOST_CHANCE / max(1, len(sets) - 1)
    better = None if chance is None else chance < limit
    return Ranking(sets, noise, better, chance, _verdict(sets, noise, better))


def _grouped(outcomes: Sequence[Outcome]) -> list[Ranked]:
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(repr(sorted(outcome.parameters.items())), []).append(outcome)
    return [_ranked(group) for group in groups.values()]


def _ranked(group: Sequence[Outcome]) -> Ranked:
    scores = [each.score for each in group if each.score is not None]
    failures = [
        each.failure or "no score" for each in group if each.score is None and not each.pruned
    ]
    pruned = sum(each.pruned for each in group)
    return Ranked(group[0].parameters, spread_of(scores), scores, failures, pruned)


def _place(ranked: Ranked, best: Best) -> tuple[bool, bool, float]:
    if ranked.score is None:
        return True, True, 0.0
    median = ranked.score.median
    return False, not ranked.is_whole, -median if best == "highest" else median


def _noise(sets: Sequence[Ranked]) -> Noise:
    freedom = sum(len(each.scores) - 1 for each in sets if each.scores)
    squares = sum(
        statistics.pvariance(each.scores) * len(each.scores) for each in sets if each.scores
    )
    return Noise(math.sqrt(squares / freedom) if freedom else 0.0, freedom)


def _chance(sets: Sequence[Ranked], noise: Noise) -> float | None:
    """Of the best and the next; where one is not whole, they are not compared by their scores."""
    if len(sets) < 2 or not sets[1].is_whole or not noise.freedom:
        return None
    first, other = sets[0].scores, sets[1].scores
    apart = abs(statistics.fmean(first) - statistics.fmean(other))
    if math.isclose(apart, 0, abs_tol=1e-9 * max(map(abs, (*first, *other)))):
        return 1.0
    variance = noise.deviation**2 * (1 / len(first) + 1 / len(other))
    return chance_beyond(apart, variance, noise.freedom)


def _verdict(sets: Sequence[Ranked], noise: Noise, better: bool | None) -> str:
    if not sets or sets[0].score is None:
        return "no trial gave a score"
    if len(sets) == 1:
        return "one parameter set: there is nothing to compare it with"
    if not sets[1].is_whole:
        which = "every other" if sets[0].is_whole else "every"
        failed = ["had failures"] if any(each.failures for each in sets) else []
        pruned = ["was pruned"] if any(each.pruned for each in sets) else []
        return f"{which} parameter set {' or '.join(failed + pruned)}"
    if not noise.freedom:
        return "nothing was repeated with success: how much like trials differ is not known"
    if better:
        return "the best beats the next by more than repeats differ"
    return "the best and the next are not farther apart than repeats may be: repeat more"
