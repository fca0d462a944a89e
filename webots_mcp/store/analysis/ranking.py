"""Which parameters did best, and whether by more than repeats of the same ones differ."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

from webots_mcp.store.analysis.spread import chance_beyond

Best = Literal["highest", "lowest"]
MOST_CHANCE: Final = 0.01  # that a set is called better than the next one, and is not


class Outcome(NamedTuple):
    """What became of a trial: a score, or why there is none; one that was pruned has not failed."""

    parameters: dict[str, Any]
    score: float | None
    failure: str | None = None
    pruned: bool = False


class Score(NamedTuple):
    """Of the trials of a set: by the mean they are ranked and compared."""

    mean: float
    low: float
    high: float


class Ranked(NamedTuple):
    """A parameter set and its trials.

    Attributes:
        score: Mean, least and greatest of those that gave one; None if none did.
        scores: Of each of them.
        failures: Why others gave none.
        pruned: How many were ended early because they were not worth going on with.
    """

    parameters: dict[str, Any]
    score: Score | None
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
        better: True where the best beats the next by more than its trials and those of the next
            differ; None where they do not show it.
        chance: How often that alone would set the two as far apart; None where it is not known.
        verdict: The same as a sentence.
    """

    sets: list[Ranked]
    noise: Noise
    better: Literal[True] | None
    chance: float | None
    verdict: str


def rank(outcomes: Sequence[Outcome], best: Best = "highest") -> Ranking:
    """Rank the parameter sets of finished trials."""
    sets = sorted(_grouped(outcomes), key=lambda each: _place(each, best))
    chance = _chance(sets)
    better = True if chance is not None and chance < MOST_CHANCE else None
    return Ranking(sets, _noise(sets), better, chance, _verdict(sets, chance))


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
    score = Score(statistics.fmean(scores), min(scores), max(scores)) if scores else None
    return Ranked(group[0].parameters, score, scores, failures, pruned)


def _place(ranked: Ranked, best: Best) -> tuple[bool, bool, float]:
    if ranked.score is None:
        return True, True, 0.0
    mean = ranked.score.mean
    return False, not ranked.is_whole, -mean if best == "highest" else mean


def _noise(sets: Sequence[Ranked]) -> Noise:
    freedom = sum(len(each.scores) - 1 for each in sets if each.scores)
    squares = sum(
        statistics.pvariance(each.scores) * len(each.scores) for each in sets if each.scores
    )
    return Noise(math.sqrt(squares / freedom) if freedom else 0.0, freedom)


def _chance(sets: Sequence[Ranked]) -> float | None:
    """Of the best and the next; where one is not whole, they are not compared by their scores.

    That they are the best of many makes a false claim no likelier: of more sets that are alike, the
    first two lie nearer to each other.

    How much like trials differ has to be known of each of the two, from its own repeats (B. L.
    Welch, The generalization of "Student's" problem, Biometrika 34, 1947). However close those are
    to each other, they may be so by chance, as where half of all trials fall over and score less.
    """
    if len(sets) < 2 or not sets[1].is_whole:
        return None
    groups = [each.scores for each in sets[:2]]
    if min(map(len, groups)) < 2:
        return None
    first, other = groups
    apart = abs(statistics.fmean(first) - statistics.fmean(other))
    if math.isclose(apart, 0, abs_tol=1e-9 * max(map(abs, (*first, *other)))):
        return 1.0
    parted = _chance_of_parting(len(first) + len(other))
    errors = [statistics.variance(each) / len(each) for each in groups]
    if not any(errors):
        return parted
    parts = sum(e**2 / (len(g) - 1) for e, g in zip(errors, groups, strict=True))
    return max(parted, chance_beyond(apart, sum(errors), sum(errors) ** 2 / parts))


def _chance_of_parting(trials: int) -> float:
    """How often, of two outcomes that are as likely, the one set has all of one and the other not.

    More trials of one set than of the other make it no likelier.
    """
    return 0.5 ** (trials - 1)


def _verdict(sets: Sequence[Ranked], chance: float | None) -> str:
    scores = [score for each in sets for score in each.scores]
    if not scores:
        return "no trial has a score"
    if len(sets) == 1:
        return "one parameter set: there is nothing to compare it with"
    if not sets[1].is_whole:
        which = "every other" if sets[0].is_whole else "every"
        failed = ["had failures"] if any(each.failures for each in sets) else []
        pruned = ["was pruned"] if any(each.pruned for each in sets) else []
        return f"{which} parameter set {' or '.join(failed + pruned)}"
    if min(scores) == max(scores):
        return f"all {len(scores)} scores are {scores[0]:g}: no tried value changed the score"
    if chance is None:
        return "the best and second best were not both repeated: their spread is unknown"
    if chance < MOST_CHANCE:
        return "the best is ahead of the second best by more than the spread of repeats"
    trials = sum(len(each.scores) for each in sets[:2])
    if chance == _chance_of_parting(trials):
        wanted = next(n for n in range(2, 100) if _chance_of_parting(2 * n) < MOST_CHANCE)
        return (
            "the best is clearly ahead of the second best, but with so few repeats that may be "
            f"chance: repeat each {wanted} times"
        )
    return "the best and second best differ by no more than repeats may: repeat more"
