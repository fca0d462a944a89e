"""Whether groups of runs differ by more than like runs do."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple, TypeAlias

MOST_CHANCE: Final = 0.002  # that any of the figures compared at once differs among like runs
MIN_EFFECT_SD: Final = 1.0  # a difference that matters, in standard deviations between like runs
MOST_REPEATED: Final = 10  # runs of each group: who asks for more of them has no answer
_OUTSIDE: Final = 0.1  # how often an interval does not hold the difference
_LEAST_RUNS: Final = 4  # of each group, that tell how much they differ, and no two clusters
_DUST: Final = 1e-9  # of the largest figure: what differs by less differs by rounding


class Spread(NamedTuple):
    """A figure of each run of a group, in the group: its median, and the least and the greatest."""

    median: float
    low: float
    high: float


def spread_of(figures: Sequence[float | None]) -> Spread | None:
    """None where the figure of any run is not known."""
    known = [figure for figure in figures if figure is not None]
    if not known or len(known) < len(figures):
        return None
    return Spread(statistics.median(known), min(known), max(known))


class Verdict(NamedTuple):
    """Whether a group differs from the first by more than like runs do.

    Attributes:
        different: None where that cannot be decided yet; False where a difference that matters is
            excluded.
        runs_wanted: So many runs of each would tell, if they went on like these; None where they
            need not, or where even 10 would not.
        interval: The difference from the mean of the first group lies in it nine times of ten;
            None where like runs were not seen to differ.
    """

    different: bool | None
    runs_wanted: int | None = None
    interval: tuple[float, float] | None = None


Chance: TypeAlias = Callable[[Sequence[float], Sequence[float]], "float | None"]


class _Apart(NamedTuple):
    """How far the means of two groups are apart, and how well that is known.

    Attributes:
        by: The other mean less the first.
        deviation: The standard deviation between like runs, pooled over both groups; 0 where they
            agree but for rounding.
        error: The standard error of `by`, from `deviation` or, in groups of unequal size, from that
            of each by itself if that is more: so a few runs of a code that scatters are not judged
            by the many of one that does not (B. L. Welch, The generalization of "Student's"
            problem, Biometrika 34, 1947). A single run is taken to scatter as the other group does.
        freedom: The degrees of freedom of `error`.
        split: How often runs that fall into two clusters by chance alone, whatever their figures,
            would be parted as these groups are: two of all ways to choose the runs of one group
            (R. A. Fisher, The Design of Experiments, 1935, section 21).
    """

    by: float
    deviation: float
    error: float
    freedom: float
    split: float


def _apart(first: Sequence[float], other: Sequence[float]) -> _Apart | None:
    """None for one run each: then it is unknown how much equal runs differ."""
    groups, free = (first, other), len(first) + len(other) - 2
    if free < 1 or not first or not other:
        return None
    means = [math.fsum(group) / len(group) for group in groups]
    pairs = zip(means, groups, strict=True)
    squares = [math.fsum((each - mean) ** 2 for each in group) for mean, group in pairs]
    dust = _DUST * max(map(abs, (*first, *other)))
    by, deviation = means[1] - means[0], math.sqrt(sum(squares) / free)
    by, deviation = (0.0 if abs(each) <= dust else each for each in (by, deviation))
    split = 2 / math.comb(free + 2, len(first))
    error = deviation * math.sqrt(1 / len(first) + 1 / len(other))
    if not deviation or len(first) == len(other) or min(map(len, groups)) < 2:
        return _Apart(by, deviation, error, free, split)
    errors = [of / (len(group) - 1) / len(group) for of, group in zip(squares, groups, strict=True)]
    parts = sum(of**2 / (len(group) - 1) for of, group in zip(errors, groups, strict=True))
    error = max(error, math.sqrt(sum(errors)))
    return _Apart(by, deviation, error, sum(errors) ** 2 / parts, split)


def chance_of(first: Sequence[float], other: Sequence[float]) -> float | None:
    """How often two groups of like runs would lie as far apart as these: Student's t test.

    Two-sided. 0 where like runs agree to the last digit and the groups do not. None for one run
    each: then it is unknown how much equal runs differ.
    """
    apart = _apart(first, other)
    if apart is None:
        return None
    return chance_beyond(abs(apart.by), apart.error**2, apart.freedom) if apart.by else 1.0


def chance_beyond(apart: float, variance: float, freedom: float) -> float:
    """How often chance alone makes a difference this large, of a known variance: Student's t.

    Args:
        apart: The difference, 0 or more.
        variance: That of such differences, as far as so many degrees of freedom tell it.
        freedom: 1 or more.
    """
    return _student_tail(apart / math.sqrt(variance), freedom) if variance > 0 else float(not apart)


def chance_of_counts(first: Sequence[float], other: Sequence[float]) -> float | None:
    """The same of counted events in stretches of one length.

    Neither chance alone makes such counts (the conditional test of two Poisson means, J.
    Przyborowski, H. Wilenski, Biometrika 31, 1940: of all events each falls on a group as often as
    the group has runs), nor the spread of like runs, which may be larger than that of chance.
    """
    chance = chance_of(first, other)
    if chance is None:
        return None
    share = len(first) / (len(first) + len(other))
    return max(chance, _chance_of_split(round(sum(first)), round(sum(other)), share))


def may_differ(groups: Sequence[Sequence[float]]) -> bool:
    """Whether any split of so many events on two groups would show that counts differ.

    A test whose least chance is above the limit adds nothing to the chance of a false claim (R. E.
    Tarone, A modified Bonferroni method for discrete data, Biometrics 46, 1990).
    """
    first = groups[0]
    for other in groups[1:]:
        events = round(sum(first) + sum(other))
        share = min(len(first), len(other)) / (len(first) + len(other))
        if _chance_of_split(events, 0, share) < MOST_CHANCE:
            return True
    return False


def _chance_of_split(first: int, other: int, share: float) -> float:
    """How often so many events fall as unevenly on two groups: twice the lesser binomial tail."""
    events = first + other
    fewer, part = (first, share) if first <= events * share else (other, 1 - share)
    ways = math.lgamma(events + 1) - math.lgamma(first + 1) - math.lgamma(other + 1)
    chance = math.exp(ways + first * math.log(share) + other * math.log(1 - share))
    tail = 0.0
    for count in range(fewer, -1, -1):  # each of fewer events is less likely than the one before
        tail += chance
        chance *= count / (events - count + 1) * (1 - part) / part
    return min(1.0, 2 * tail)


def verdicts_on(
    groups: Sequence[Sequence[float | None]],
    tests: int,
    chance: Chance = chance_of,
    tests_of_more: int = 0,
    min_effect_sd: float = MIN_EFFECT_SD,
) -> list[Verdict]:
    """Of each group whether it differs from the first by more than like runs do.

    True where like runs would lie as far apart too seldom, both as normal figures (`chance`) and as
    figures that fall into two clusters (`_Apart.split`); the latter takes at least 4 runs of each,
    and 7 where the runs of each group agree to the last digit. False where a difference that
    matters is excluded: two one-sided tests at 5 %, which is the same as an interval of 90 % within
    the margin (D. J. Schuirmann, A comparison of the two one-sided tests procedure, J.
    Pharmacokinetics and Biopharmaceutics 15, 1987). Of a figure whose unit is unknown, the one
    scale there is is how much like runs differ: the margin is `min_effect_sd` of their standard
    deviations, as far as these runs tell it. Where like runs agree to the last digit and the groups
    do as well, False takes as many runs as True would. The first is False; None where that cannot
    be decided, or a figure of any run is missing.

    Args:
        groups: A figure of each run of each group.
        tests: How many such questions are asked at once: the more, the surer True has to be.
        chance: How often like runs lie as far apart.
        tests_of_more: How many are asked once there are more runs, if not as many.
        min_effect_sd: The least difference that matters.
    """
    known = [[each for each in group if each is not None] for group in groups]
    if any(len(a) < len(b) for a, b in zip(known, groups, strict=True)):
        return [Verdict(None)] * len(groups)
    limits = [MOST_CHANCE / max(each, 1) for each in (tests, tests_of_more or tests)]
    others = (_verdict(known[0], other, limits, chance, min_effect_sd) for other in known[1:])
    return [Verdict(False), *others]


def _verdict(
    first: Sequence[float],
    other: Sequence[float],
    limits: Sequence[float],
    chance: Chance,
    min_effect_sd: float,
) -> Verdict:
    apart = _apart(first, other)
    if apart is None:
        return Verdict(None)
    within = apart.error * _student_quantile(apart.freedom)
    interval = (apart.by - within, apart.by + within) if apart.deviation else None
    different = _differs(first, other, limits[0], chance, min_effect_sd)
    if different is not None:
        return Verdict(different, None, interval)
    fewest = min(len(first), len(other)) + 1
    for runs in range(fewest, MOST_REPEATED + 1):
        more = _so_many(first, runs), _so_many(other, runs)
        if _differs(*more, limits[1], chance, min_effect_sd) is not None:
            return Verdict(None, runs, interval)
    return Verdict(None, None, interval)


def _differs(
    first: Sequence[float],
    other: Sequence[float],
    limit: float,
    chance: Chance,
    min_effect_sd: float,
) -> bool | None:
    apart, found = _apart(first, other), chance(first, other)
    if apart is None or found is None:
        return None
    is_repeated = min(len(first), len(other)) >= _LEAST_RUNS
    is_repeated &= bool(apart.deviation) or apart.split < MOST_CHANCE
    if found < limit and is_repeated:
        return True
    if not apart.deviation:
        return False if is_repeated and not apart.by else None
    farthest = abs(apart.by) + apart.error * _student_quantile(apart.freedom)
    return False if farthest < min_effect_sd * apart.deviation else None


def _so_many(figures: Sequence[float], runs: int) -> list[float]:
    """Figures of at least so many runs, of which the further ones are as the first were."""
    return [figures[index % len(figures)] for index in range(max(runs, len(figures)))]


def _student_tail(t: float, freedom: float) -> float:
    """The chance of a greater |t|, for 1 degree of freedom or more.

    M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions (1964), 26.7.3 and 26.7.4;
    between two whole numbers of degrees, for which those are, its logarithm is almost straight.
    """
    part = freedom % 1 if freedom > 1 else 0.0  # rounding leaves a little less
    if part:
        few, more = (_student_tail(t, freedom - part + each) for each in (0, 1))
        return few ** (1 - part) * more**part
    freedom = max(1, int(freedom))
    angle = math.atan(t / math.sqrt(freedom))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    odd = freedom % 2
    term = math.cos(angle) if odd else 1.0
    total = term if freedom > 1 else 0.0
    for power in range(2 + odd, freedom, 2):
        term *= square * (power - 1) / power
        total += term
    inside = 2 / math.pi * (angle + sine * total) if odd else sine * total
    return max(0.0, 1 - inside)


@lru_cache(1000)
def _student_quantile(freedom: float) -> float:
    """The |t| that chance exceeds in one case of ten."""
    low, high = 0.0, 10.0  # of one degree of freedom it is 6.3
    while high - low > 1e-9:
        middle = (low + high) / 2
        low, high = (middle, high) if _student_tail(middle, freedom) > _OUTSIDE else (low, middle)
    return high


# -- which parameters did best, and whether by more than repeats of the same ones differ -----------


Best = Literal["highest", "lowest"]
MOST_CHANCE_OF_BEST: Final = 0.01  # that a set is called better than the next one, and is not


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
    better = True if chance is not None and chance < MOST_CHANCE_OF_BEST else None
    return Ranking(sets, _noise(sets), better, chance, _in_words(sets, chance))


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


def _in_words(sets: Sequence[Ranked], chance: float | None) -> str:
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
    if chance < MOST_CHANCE_OF_BEST:
        return "the best is ahead of the second best by more than the spread of repeats"
    trials = sum(len(each.scores) for each in sets[:2])
    if chance == _chance_of_parting(trials):
        wanted = next(n for n in range(2, 100) if _chance_of_parting(2 * n) < MOST_CHANCE_OF_BEST)
        return (
            "the best is clearly ahead of the second best, but with so few repeats that may be "
            f"chance: repeat each {wanted} times"
        )
    return "the best and second best differ by no more than repeats may: repeat more"
