"""How often comparisons and rankings of like runs name a difference, and of unlike ones find it."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import product, repeat
from multiprocessing import get_context
from typing import Any, Final

import numpy as np

from tests.accuracy.page import share, table
from tests.benchmarks.core import Bench
from tests.judging.detection.asking import UNHURRIED_S
from tests.judging.detection.labelled import Array, LabelledRun
from tests.judging.detection.writing import Writer
from tests.memory import memory_connection
from webots_mcp.analysis.rank_and_count_tests import verdicts_on_shares
from webots_mcp.analysis.summary import MOST_CHANCE, Outcome, rank
from webots_mcp.judging.comparison import Comparison, compare_runs

_RUNS: Final = (3, 5, 10)  # of each group
_EFFECTS_SD: Final = (0.5, 1.0, 2.0, 4.0)
_REPEATS: Final = (2, 4, 6, 10)
_SCATTER: Final = 0.05  # standard deviation between like runs, as a share of the mean
_OUTLIERS: Final = 0.1  # share of the runs that lie ten times as far out
KINDS: Final = {
    "normal": "that scatter by 5 %",
    "skewed": "of skewed figures",
    "discrete": "of three values",
    "outliers": "with outliers",
    "lanes": "in two lanes, by chance",
}
_SCATTERS: Final = [*KINDS]
EQUAL: Final = ((3, 3), (5, 5), (10, 10), (4, 10))
_NOISIER: Final = (1.5, 2.0, 3.0)
_OF_FRONT: Final = ("front_m deviation", "front_m")
_MANY: Final = (5, 10, 20, 50)
_RATES: Final = ((0.05, 0.05), (0.2, 0.2), (0.0, 0.4), (0.1, 0.5), (0.0, 0.8))
_ROWS: Final = 50
_INTERVAL_S: Final = 0.2
_STEADY: Final = {"front_m": 1.2, "left_m": 0.8, "right_m": 0.9, "battery_v": 12.0}


def _scattered(dice: np.random.Generator, scatter: str) -> float:
    """How far a run lies from the others, with a standard deviation of about 1."""
    if scatter == "skewed":
        return float(dice.exponential()) - 1
    if scatter == "discrete":
        return float(dice.choice([-1.0, 0.0, 2.0]))
    if scatter == "outliers":
        return float(dice.normal()) * (10.0 if dice.random() < _OUTLIERS else 1.0)
    return float(dice.normal())


def _run(
    dice: np.random.Generator, faster_sd: float, scatter: str, noisier: float = 1.0
) -> LabelledRun:
    """10 s of a drive; its speed and the mean of each sensor are drawn anew for each run.

    Args:
        dice: Draws them.
        faster_sd: How much faster it drives, in standard deviations between repeated runs.
        scatter: How runs scatter. "lanes": it keeps to one of two lanes, by chance, which is seen
            in all that it measures.
        noisier: How many times as noisy the front sensor is.
    """
    times: Array = _INTERVAL_S * np.arange(_ROWS, dtype=np.float64)
    lane = 0.3 * float(dice.integers(2)) if scatter == "lanes" else 0.0
    speed = 0.2 * (1 + _SCATTER * (_scattered(dice, scatter) + faster_sd)) * (1 + lane)
    course = speed * times + dice.normal(0, 0.002, _ROWS)
    columns: dict[str, Any] = {
        "pose": [[x, lane, 0.0] for x in course.tolist()],
        "speed": (speed + dice.normal(0, 0.01, _ROWS)).tolist(),
        "wheels": [{"left": each, "right": each} for each in [round(speed / 0.05, 4)] * _ROWS],
        "mode": ["cruise"] * _ROWS,
    }
    for name, mean in _STEADY.items():
        mean *= (1 + _SCATTER * _scattered(dice, scatter)) * (1 + lane)
        noise = 0.02 * (noisier if name == "front_m" else 1.0)
        columns[name] = (mean * (1 + dice.normal(0, noise, _ROWS))).tolist()
    return LabelledRun(times, columns, _INTERVAL_S)


def _compared(
    seed: int, sizes: tuple[int, int], effect_sd: float, scatter: str, noisier: float
) -> Comparison:
    """Runs before and after an edit of the controller, compared."""
    key = [seed, *sizes, round(10 * effect_sd), _SCATTERS.index(scatter), round(100 * noisier)]
    dice = np.random.default_rng(key)
    with memory_connection() as connection:
        writer = Writer(connection)
        for code, runs, faster_sd, factor in zip(
            "ab", sizes, (0.0, effect_sd), (1.0, noisier), strict=True
        ):
            writer.begin_session(code)
            for _ in range(runs):
                writer.write(_run(dice, faster_sd, scatter, factor))
        return compare_runs(connection, limit=100, deadline_s=UNHURRIED_S)


def _said(
    seed: int, sizes: tuple[int, int], effect_sd: float, scatter: str = "normal", noisier: float = 1
) -> dict[str, bool | None]:
    """Of each figure and signal of a comparison, whether the runs after the edit differ."""
    found = _compared(seed, sizes, effect_sd, scatter, noisier)
    figures = (*found.measures, *found.differences)
    spreads = {f"{e.name} deviation": e.deviation_different[1] for e in found.differences}
    return {each.name: each.different[1] for each in figures} | spreads


def comparisons(bench: Bench) -> Iterator[str]:
    """Equal groups, and groups of which one drives faster, is noisier or has rare events."""
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        yield from _comparisons(bench, pool)


def _comparisons(bench: Bench, pool: ProcessPoolExecutor) -> Iterator[str]:
    def _answers(
        pairs: int,
        sizes: tuple[int, int],
        effect_sd: float,
        scatter: str = "normal",
        noisier: float = 1.0,
    ) -> list[dict[str, bool | None]]:
        given = (repeat(each) for each in (sizes, effect_sd, scatter, noisier))
        return list(pool.map(_said, range(pairs), *given))

    pairs, equal, wrong, of = bench.count(100), list[list[str]](), 0, 0
    for (scatter, kind), sizes in bench.sample(product(KINDS.items(), EQUAL)):
        bench.say(f"comparisons of equal groups of {sizes}, {kind}")
        said = _answers(pairs, sizes, 0.0, scatter)
        each = Counter(value for answer in said for value in answer.values())
        claims = sum(True in answer.values() for answer in said)
        wrong, of = wrong + claims, of + pairs
        figures = (share(each[value], each.total()) for value in (True, False))
        equal.append([f"{sizes[0]} + {sizes[1]} {kind}", share(claims, pairs), *figures])
    rows, found_of = list[list[str]](), dict[tuple[float, int], str]()
    for effect_sd in _EFFECTS_SD:
        row = [f"{effect_sd:g}"]
        for runs in _RUNS:
            bench.say(f"comparisons with an effect of {effect_sd:g}, {runs} runs")
            said = _answers(pairs, (runs, runs), effect_sd)
            found = [answer["distance_m"] for answer in said]
            row += [share(found.count(True), pairs), share(found.count(False), pairs)]
            found_of[effect_sd, runs] = f"{100 * found.count(True) / pairs:.0f} %"
        rows.append(row)
    noises = list[list[str]]()
    for noisier in bench.sample(_NOISIER):
        row = [f"{noisier:g}"]
        for runs in _RUNS[1:]:
            bench.say(f"comparisons with {noisier:g} times the noise, {runs} runs")
            said = _answers(pairs, (runs, runs), 0.0, noisier=noisier)
            row += [share(sum(bool(a[name]) for a in said), pairs) for name in _OF_FRONT]
        noises.append(row)
    yield (
        f"A difference is claimed in {wrong} of {of} comparisons of equal groups; a "
        f"difference of 2 standard deviations is found in {found_of[2.0, 10]} of comparisons of 10 "
        f"runs with 10, in {found_of[2.0, 5]} of 5 with 5."
    )
    yield _COMPARED.format(pairs=pairs, figures=len(_said(0, (2, 2), 0.0)))
    yield table(("equal groups", "answers that claim a difference", "figures called different",
                 "figures called equal"), equal)  # fmt: skip
    heads = [f"{runs} + {runs}: {what}" for runs in _RUNS for what in ("found", "called equal")]
    yield table(("effect on `distance_m`", *heads), rows)
    yield _POWER.format(chance=1000 * MOST_CHANCE)
    yield _OF_NOISE
    heads = [f"{runs} + {runs}: {what}" for runs in _RUNS[1:] for what in ("spread", "level")]
    yield table(("noise of `front_m`, times", *heads), noises)
    yield _OF_RARE
    heads = [f"{runs} + {runs}" for runs in _MANY]
    yield table(("runs with the event, before and after", *heads), _rare(bench.count(2000)))


def _rare(draws: int) -> list[list[str]]:
    """How often a rare event is called a difference, which each run has by chance."""
    dice, rows = np.random.default_rng(1), list[list[str]]()
    for before, after in _RATES:
        row = [f"{100 * before:.0f} %, {100 * after:.0f} %"]
        for runs in _MANY:
            groups = ((dice.random((2, runs)) < [[before], [after]]) for _ in range(draws))
            verdicts = (
                verdicts_on_shares(each.astype(float).tolist(), 1, 1, 1.0) for each in groups
            )
            row.append(share(sum(each[1].different is True for each in verdicts), draws))
        rows.append(row)
    return rows


_COMPARED: Final = """\
`webots_compare_runs` compares the runs before and after an edit of a controller, with {pairs}
pairs of groups in each line. From run to run, speed and the means of the sensors scatter. An
answer judges {figures} figures: levels and spreads of signals. If runs keep to one of two lanes,
the figures of a run depend on each other; the intervals below assume independence and are too
narrow there. In the second table, the edit makes the robot faster by N standard
deviations of repeated runs."""
_POWER: Final = """\
Comparisons are designed to claim a false difference in at most {chance:g} of 1,000 answers. The
second table shows the price: 3 runs of each prove nothing, and effects below two standard
deviations are mostly left open ("null"), not denied. `min_effect_sd` sets what counts as equal."""
_OF_NOISE: Final = """\
Level and spread have separate verdicts. In this table, an edit makes a front sensor noisier with
the same mean. It shows how often the sensor is reported to differ in its spread, and in its
level:"""
_OF_RARE: Final = """\
An event that most runs do not have is counted by run (Fisher's exact test). This table shows how
often a change is reported after an edit if this event is the only figure:"""


def trials(bench: Bench) -> Iterator[str]:
    """Trial sets in which all parameters do alike, and sets in which one is better."""
    rankings = bench.count(2000)
    cases = [(0.0, "all equal", sets) for sets in (2, 5)]
    cases += [(0.0, "all equal, half of the trials fall over", 2)]
    cases += [(sd, f"one ahead by {sd:g} deviations", 5) for sd in _EFFECTS_SD]
    rows, false = list[list[str]](), 0
    for better_sd, kind, sets in cases:
        row = [f"{sets} sets, {kind}"]
        for repeats in _REPEATS:
            dice = random.Random(repeats)
            found = [_confirmed(dice, kind, sets, better_sd, repeats) for _ in range(rankings)]
            right = sum(each == 0 for each in found) if better_sd else 0
            wrong = sum(each is not None for each in found) - right
            false += wrong * (not better_sd and repeats > _REPEATS[0])
            row += [share(right, rankings) if better_sd else "-", share(wrong, rankings)]
        rows.append(row)
    alike = rankings * sum(not each for each, *_ in cases) * len(_REPEATS[1:])
    yield (
        f"In {false:,} of {alike:,} rankings of equally good sets of parameters, each repeated "
        f"{_REPEATS[1]} times or more, one is wrongly confirmed as best."
    )
    yield _RANKED.format(rankings=f"{rankings:,}")
    heads = [f"{n} repeats: {what}" for n in _REPEATS for what in ("right", "wrong")]
    yield table(("trials", *heads), rows)


_RANKED: Final = """\
The scores of these trials are drawn from a normal distribution with a standard deviation of 1.
The table shows how often `is_best_confirmed` is true for the better set, and how often for
another one, in {rankings} rankings each. It should be wrong at most once in a hundred. At least
4 repeats are needed to confirm anything, as the answer says."""


def _confirmed(
    dice: random.Random, kind: str, sets: int, better_sd: float, repeats: int
) -> int | None:
    """Which set is confirmed to be the best; the first is, if any."""
    outcomes = list[Outcome]()
    for at in range(sets):
        for _ in range(repeats):
            fallen = "fall over" in kind and dice.random() < 0.5
            score = dice.gauss(better_sd * (at == 0), 1) - 100.0 * fallen
            outcomes.append(Outcome({"kp": at}, score))
    ranking = rank(outcomes)
    return int(ranking.sets[0].parameters["kp"]) if ranking.better else None
