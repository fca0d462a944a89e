"""How often comparisons and rankings of like runs name a difference, and of unlike ones find it."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from typing import Any, Final

import numpy as np

from tests.accuracy.page import share, table
from tests.benchmarks.core import Bench
from tests.judging.detection.asking import UNHURRIED_S
from tests.judging.detection.labelled import Array, LabelledRun
from tests.judging.detection.writing import Writer
from tests.memory import memory_connection
from webots_mcp.analysis.summary import MOST_CHANCE, Outcome, rank
from webots_mcp.judging.comparison import Comparison, compare_runs

_RUNS: Final = (3, 5, 10)
_EFFECTS_SD: Final = (0.5, 1.0, 2.0, 4.0)
_REPEATS: Final = (2, 4, 6, 10)
_SCATTER: Final = 0.05  # standard deviation between like runs, as a share of the mean
_ROWS: Final = 50
_INTERVAL_S: Final = 0.2
_STEADY: Final = {"front_m": 1.2, "left_m": 0.8, "right_m": 0.9, "battery_v": 12.0}


def _run(dice: np.random.Generator, faster_sd: float, *, lanes: bool) -> LabelledRun:
    """10 s of a drive; its speed and the mean of each sensor are drawn anew for each run.

    Args:
        dice: Draws them.
        faster_sd: How much faster it drives, in standard deviations between like runs.
        lanes: It keeps to one of two lanes, by chance, which is seen in all that it measures.
    """
    times: Array = _INTERVAL_S * np.arange(_ROWS, dtype=np.float64)
    lane = 0.3 * float(dice.integers(2)) if lanes else 0.0
    speed = 0.2 * (1 + _SCATTER * (float(dice.normal()) + faster_sd)) * (1 + lane)
    course = speed * times + dice.normal(0, 0.002, _ROWS)
    columns: dict[str, Any] = {
        "pose": [[x, lane, 0.0] for x in course.tolist()],
        "speed": (speed + dice.normal(0, 0.01, _ROWS)).tolist(),
        "wheels": [{"left": each, "right": each} for each in [round(speed / 0.05, 4)] * _ROWS],
        "mode": ["cruise"] * _ROWS,
    }
    for name, mean in _STEADY.items():
        mean *= (1 + _SCATTER * float(dice.normal())) * (1 + lane)
        columns[name] = (mean * (1 + dice.normal(0, 0.02, _ROWS))).tolist()
    return LabelledRun(times, columns, _INTERVAL_S)


def _compared(seed: int, runs: int, effect_sd: float, lanes: bool) -> Comparison:
    """So many runs before and after an edit of the controller, compared."""
    dice = np.random.default_rng([seed, runs, round(10 * effect_sd), lanes])
    with memory_connection() as connection:
        writer = Writer(connection)
        for code, faster_sd in (("a", 0.0), ("b", effect_sd)):
            writer.begin_session(code)
            for _ in range(runs):
                writer.write(_run(dice, faster_sd, lanes=lanes))
        return compare_runs(connection, limit=100, deadline_s=UNHURRIED_S)


def _said(seed: int, runs: int, effect_sd: float, lanes: bool = False) -> dict[str, bool | None]:
    """Of each figure and signal of a comparison, whether the runs after the edit differ."""
    found = _compared(seed, runs, effect_sd, lanes)
    figures = (*found.measures, *found.differences)
    return {each.name: each.different[1] for each in figures}


def _answers(
    pairs: int, runs: int, effect_sd: float, *, lanes: bool = False
) -> list[dict[str, bool | None]]:
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        return list(pool.map(_said, range(pairs), repeat(runs), repeat(effect_sd), repeat(lanes)))


def comparisons(bench: Bench) -> Iterator[str]:
    """Equal groups, and groups of which one drives faster."""
    pairs, equal, wrong, of = bench.count(100), list[list[str]](), 0, 0
    for lanes, kind in ((False, "that scatter by 5 %"), (True, "in two lanes, by chance")):
        for runs in _RUNS:
            bench.say(f"comparisons of equal groups of {runs}, {kind}")
            said = _answers(pairs, runs, 0.0, lanes=lanes)
            each = Counter(value for answer in said for value in answer.values())
            told = sum(True in answer.values() for answer in said)
            wrong, of = wrong + told, of + pairs
            figures = (share(each[value], each.total()) for value in (True, False))
            equal.append([f"{runs} + {runs} {kind}", share(told, pairs), *figures])
    rows, found_of = list[list[str]](), dict[tuple[float, int], str]()
    for effect_sd in _EFFECTS_SD:
        row = [f"{effect_sd:g}"]
        for runs in _RUNS:
            bench.say(f"comparisons with an effect of {effect_sd:g}, {runs} runs")
            said = _answers(pairs, runs, effect_sd)
            found = [answer["distance_m"] for answer in said]
            row += [share(found.count(True), pairs), share(found.count(False), pairs)]
            found_of[effect_sd, runs] = f"{100 * found.count(True) / pairs:.0f} %"
        rows.append(row)
    yield (
        f"A difference is claimed in {wrong} of {of} comparisons of equal groups; one of 2 "
        f"standard deviations is found in {found_of[2.0, 10]} of comparisons of 10 runs with 10, "
        f"in {found_of[2.0, 5]} of 5 with 5."
    )
    yield _COMPARED.format(pairs=pairs, figures=len(_said(0, 2, 0.0)))
    yield table(("equal groups", "answers that claim a difference", "figures called different",
                 "figures called equal"), equal)  # fmt: skip
    heads = [f"{runs} + {runs}: {what}" for runs in _RUNS for what in ("found", "called equal")]
    yield table(("effect on `distance_m`", *heads), rows)
    yield _POWER.format(chance=1000 * MOST_CHANCE)


_COMPARED: Final = """\
`webots_compare_runs` of the runs before and after an edit of a controller: {pairs} pairs of
groups in each line. A run is a drive whose speed and whose sensors' means scatter from run to
run; an answer judges {figures} figures and signals. Where runs keep to one of two lanes, all
figures of a run hang together; the intervals of figures take them to be independent, and are
too narrow there. In the second table the edit makes the robot faster, by so many standard
deviations between like runs."""
_POWER: Final = """\
A comparison is made to claim little that is not there ({chance:g} in 1,000 answers). The price
is in the second table: 3 runs of each prove nothing at all, and effects below two standard
deviations are mostly left open ("null"), not denied. `min_effect_sd` sets what counts as equal."""


def trials(bench: Bench) -> Iterator[str]:
    """Trial sets in which all parameters do alike, and sets in which one is better."""
    rankings = bench.count(2000)
    cases = [(0.0, "all alike", sets) for sets in (2, 5)]
    cases += [(0.0, "all alike, half of the trials fall over", 2)]
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
        f"Of sets that are alike, repeated {_REPEATS[1]} times or more, a best is confirmed in "
        f"{false:,} of {alike:,} rankings."
    )
    yield _RANKED.format(rankings=f"{rankings:,}")
    heads = [f"{n} repeats: {what}" for n in _REPEATS for what in ("right", "wrong")]
    yield table(("trials", *heads), rows)


_RANKED: Final = """\
`is_best_confirmed` of trials whose scores are drawn, normal with a standard deviation of 1: how
often it is true of the set that is better, and how often of one that is not, in {rankings}
rankings each. It is meant to be wrong at most once in a hundred. Two or three repeats confirm
nothing: 4 is what shows that scores differ, as the answer says itself."""


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
