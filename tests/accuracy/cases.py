"""How situations that people met are answered, at which rates and noises, and what is missed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from tests.accuracy.page import table
from tests.benchmarks.core import Bench
from tests.cases import healthy_robots, more_unfamiliar, problems
from tests.cases.columns import TURN, Array, Random
from tests.cases.public import FIRST_POINTS, PUBLIC, RIGHT, labels, score
from tests.cases.rates import FAULTS, INTERVALS_S, NOISES, answer
from tests.cases.situations import HEALTHY, PROBLEMS, Columns, Situation, failures, quiet, recorded
from tests.cases.unfamiliar import FIRST_ANSWERS, ROBOTS, ask_faulty, ask_healthy
from tests.cases.unfamiliar import INTERVALS_S as INTERVALS_OF_ROBOTS_S

_MODULES = (healthy_robots, problems, more_unfamiliar)  # which fill the registries
_OTHER_INTERVALS_S: Final = (0.016, 0.064, 0.16)
_INTRODUCTION: Final = """\
`tests/cases` rebuilds situations from public reports as recordings, with the answer that an
expert would give. {healthy} are kinds of healthy robots, about which any alarm is false.
{problems} are problems, which must be found or reported as not searched."""
_LABELLED: Final = """\
The rules were made with those situations in view. Therefore {count} further public situations of
other kinds were labelled, and the labels committed, before the first question. The right answer
earns 2 points, a helpful one 1, none 0. A false one earns -1: an alarm about a healthy robot, or
a pass of the responsible check. The first answers earned {first} of {most} points. Then some
rules were improved for whole classes of misses. The labels are in
`tests/cases/public_labels.toml`."""
_UNFAMILIAR: Final = """\
{robots} kinds of robots that are in no other list, from a gantry to an underwater glider, were
simulated. Each was recorded healthy, with a row every {rates}, and once with a fault. The right
answers were committed before the first question. An alarm about a healthy robot is false. A
fault is answered *right* if the responsible check warns or fails, names it and gives its start.
The answer is *helpful* if one of the three is missing, *not judged* if it says that it cannot
decide, and *denied* if that check passes. The column *first* counts what was answered before a
rule was changed; ten healthy recordings were asked only later."""
_ALSO_DRAWN: Final = """\
The healthy kinds were also simulated with a row every {rates} and other noise. Of {runs} runs,
{alarmed} raise an alarm{names}."""
_OSCILLATIONS: Final = 30
_GROWTH: Final = """\
Of {count} oscillations whose amplitude grows or decays 4 to 20 times in a minute, {found} are
found, and {told} are reported with their amplitudes at start and end. Of {count} with a constant
amplitude, {false} are reported to grow."""
_RATES: Final = """\
The verdict about a situation must not depend on the rate or the noise of its recording. In this
table, noise is its standard deviation over the signal's range. *Found* means an event whose
start and end are right within 1 s or 3 rows. *Not searched* means an answer that says why it
cannot tell, *denied* a wrong "not found" or pass, and *inexact* an event at another time."""


def cases(bench: Bench) -> Iterator[str]:
    """Tables of healthy robots, problems, public situations, rates and noises."""
    healthy, faulty = bench.sample(HEALTHY.values()), bench.sample(PROBLEMS.values())
    alarms = {each.name: wrong for each in healthy if (wrong := failures(each))}
    missed = {each.name: wrong for each in faulty if (wrong := failures(each))}
    scores = {name: score(name) for name in bench.sample(PUBLIC)}
    points, most = sum(each.points for each in scores.values()), RIGHT * len(scores)
    yield (
        f"{len(healthy) - len(alarms)} of {len(healthy)} healthy robots get no alarm, "
        f"{len(faulty) - len(missed)} of {len(faulty)} problems are answered; {len(scores)} "
        f"situations that were labelled first earn {points} of {most} points."
    )
    yield _INTRODUCTION.format(healthy=len(healthy), problems=len(faulty))
    wrong = [f"- {name}: {', '.join(why)}" for name, why in (alarms | missed).items()]
    yield "Answered wrongly:" if wrong else "None is answered wrongly."
    if wrong:
        yield "\n".join(wrong)
    first = sum(FIRST_POINTS.values())
    yield _LABELLED.format(count=len(scores), first=first, most=most)
    rows = [
        (_linked(name), str(FIRST_POINTS[name]), str(each.points)) for name, each in scores.items()
    ]
    yield table(("situation", "first", "now"), rows)
    bench.say("cases: unfamiliar robots")
    yield _unfamiliar(bench.sample(ROBOTS))
    bench.say("cases: other rates")
    yield _other_rates(bench)
    yield _growth(bench.count(_OSCILLATIONS))
    bench.say("cases: rates and noises")
    yield _RATES
    yield table(("fault", "a row every", *(f"{100 * each:g} %" for each in NOISES)), _rates(bench))


def _unfamiliar(robots: Sequence[str]) -> str:
    """Ask about robots of kinds that no rule was made with, healthy ones and ones with a fault."""
    answers = Counter(
        ask_healthy(name, interval_s)[0] for name in robots for interval_s in INTERVALS_OF_ROBOTS_S
    )
    answers += Counter(ask_faulty(name)[0] for name in robots)
    rows = [(kind, str(first), str(answers[kind])) for kind, first in FIRST_ANSWERS.items()]
    rates = ", ".join(f"{1000 * each:g}" for each in INTERVALS_OF_ROBOTS_S)
    said = _UNFAMILIAR.format(robots=len(robots), rates=f"{rates} ms")
    return f"{said}\n\n{table(('answer', 'first', 'now'), rows)}"


def _growth(oscillations: int) -> str:
    """Draw oscillations that grow, decay or keep their amplitude, and count the reports of it."""
    random = np.random.default_rng(10_000)
    told, found = {True: 0, False: 0}, {True: 0, False: 0}
    for number in range(2 * oscillations):
        changes = number % 2 == 0
        period_s, factor = float(random.uniform(1.5, 4)), float(random.uniform(4, 20))
        over_s = 60 / math.log(factor) * float(random.choice((-1, 1)))

        def draw(t: Array, noise: Random) -> Columns:
            size = np.exp((t - 30) / over_s) if changes else np.ones(len(t))  # noqa: B023
            swing = size * np.sin(TURN * t / period_s)  # noqa: B023
            return {"roll": 0.1 * (swing + noise.normal(0, 0.02, len(t)))}

        interval_s = float(random.choice(_OTHER_INTERVALS_S))
        drawn = Situation(f"oscillation {number}", draw, (), 60.0, interval_s)
        with recorded(drawn) as asked:
            events = asked.events("oscillation", signals=("roll",)).events
        found[changes] += bool(events)
        told[changes] += any("amplitude_at_end" in each.details for each in events)
    return _GROWTH.format(count=oscillations, told=told[True], false=told[False], found=found[True])


def _linked(name: str) -> str:
    label = labels()[name]
    kind = "healthy: " if label.get("healthy") else ""
    return f"{kind}{label['situation'].removesuffix('.')} ([report]({label['source']}))"


def _other_rates(bench: Bench) -> str:
    """Draw each healthy kind at other rates, and say which raise an alarm."""
    kinds = [each for each in HEALTHY.values() if quiet in each.expect]
    kinds += [PUBLIC[name] for name, label in labels().items() if label.get("healthy")]
    drawn = [
        _at(each, interval_s) for each in bench.sample(kinds) for interval_s in _OTHER_INTERVALS_S
    ]
    alarmed: dict[str, int] = {}
    for each in drawn:
        with recorded(each) as asked:
            if quiet(asked):
                name = each.name.rpartition(" at ")[0]
                alarmed[name] = alarmed.get(name, 0) + 1
    names = ", ".join(f"{name.replace('_', ' ')} ({count})" for name, count in alarmed.items())
    rates = ", ".join(f"{1000 * each:g}" for each in _OTHER_INTERVALS_S)
    return _ALSO_DRAWN.format(
        rates=f"{rates} ms",
        runs=len(drawn),
        alarmed=sum(alarmed.values()) or "none",
        names=f": {names}" if names else "",
    )


def _at(each: Situation, interval_s: float) -> Situation:
    """The same with another rate, and another draw of its noise."""
    return replace(each, name=f"{each.name} at {interval_s:g} s", interval_s=interval_s)


def _rates(bench: Bench) -> Iterator[tuple[str, ...]]:
    for name, interval_s in bench.sample(product(FAULTS, INTERVALS_S)):
        answers = (answer(name, interval_s, noise) for noise in NOISES)
        yield (f"`{name}`", f"{1000 * interval_s:g} ms", *answers)
