"""How true what is told of events is, by how much noise there is and how often rows come."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from itertools import product, repeat, starmap
from multiprocessing import get_context
from typing import Final

from tests.accuracy.page import percent, share, table
from tests.benchmarks.core import Bench, duration
from tests.judging.checks import judging as checks_judging
from tests.judging.detection.drawing import KINDS as RECORDINGS
from tests.judging.detection.driving import NOISE_LEVELS_M
from tests.judging.detection.judging import Tally, median, nine_in_ten
from tests.judging.detection.labelled import SETTING, Measure, Setting
from tests.judging.detection.measuring import Report, measure
from tests.judging.detection.sensing import READING_NOISES_M
from tests.judging.detection.swinging import NOISE_SHARE_LEVELS
from webots_mcp.judging.checks.check_run import CHECKS
from webots_mcp.judging.detection.event_kinds import KINDS
from webots_mcp.judging.detection.event_options import EventOptions

INTERVALS_S: Final = (0.016, 0.064, 0.16, 0.5)
LEVELS: Final = ("no noise", "little", "much")
# The kind of event and what it is about, by what is judged.
MEASURES: Final[dict[Measure, tuple[str, str]]] = {
    "standstill": ("standstill", "the robot stands"),
    "stuck": ("stuck", "it should move"),
    "missing": ("missing", "a sensor gives no value"),
    "flat": ("flat", "a sensor is frozen"),
    "dropout": ("jump", "a sensor drops out"),
    "leap": ("jump", "the robot jumps"),
    "swing": ("oscillation", "a value oscillates"),
    "gap": ("gap", "no rows"),
}
_OF_ONE_RATE: Final = ("hovering", "roaming", "wide")  # drawn with a rate of their own
_MOST_VALUES: Final = 3_000  # of signals beside
UNSEEN: Final = 10_000  # seed, and number of runs: from 0 on they served to make the rules
_POOR: Final = 0.95
_USUAL_STEP: Final = 0.954  # the median of steps of normal noise, in standard deviations of it


Cell = tuple[Measure, float, int]  # what is judged, the row interval and the level of noise


def events(bench: Bench) -> Iterator[str]:
    """Precision, recall and errors of time of each kind, by noise and rate."""
    cells = _measured(bench)
    clear, noisy = (
        _sum(t for (*_, noise), of in cells.items() for _, t in of if (noise == 2) is much)
        for much in (False, True)
    )
    quiet = _sum(each for found in cells.values() for _, each in found if not each.incidents)
    yield (
        f"{percent(clear.recall)} % of {clear.incidents:,} events in simulated recordings are "
        f"found, and {percent(clear.precision)} % of the reported ones are true. With much noise, "
        f"{percent(noisy.recall)} % of {noisy.incidents:,} are found, and "
        f"{percent(noisy.precision)} % are true."
    )
    yield _EVENTS.format(
        cases=bench.count(4, least=0),
        recordings=len(_recordings()),
        readings=_levels(READING_NOISES_M, 1000, "mm"),
        places=_levels(NOISE_LEVELS_M, 1000, "mm"),
        swings=_levels(NOISE_SHARE_LEVELS, 100, "%"),
        false=f"{60 * quiet.false / quiet.minutes:.2f}" if quiet.minutes else "-",
        hours=f"{quiet.minutes / 60:.0f}",
    )
    for heading, cell in (("found / true", _truth), ("begin, end off", _errors)):
        head = ("kind of event", "a row every", *(f"{each}: {heading}" for each in LEVELS))
        yield table(head, _rows(cells, cell))
    poor = list(_poor(cells)) or ["- none"]
    yield f"Results below {100 * _POOR:.0f} %, with the recordings that cause most of them:"
    yield "\n".join(poor)
    score = EventOptions().jump_min_score
    yield _WHY.format(score=score, jump_m=(1 + score / 0.6745) * _USUAL_STEP * READING_NOISES_M[2])
    measured = {kind for kind, _ in MEASURES.values()}
    measured |= set(CHECKED)
    others = ", ".join(f"`{each.name}`" for each in KINDS if each.name not in measured)
    yield f"Not measured, because they are facts of the recording: {others}."
    yield f"Measured by [their checks](checks.md): {', '.join(f'`{kind}`' for kind in CHECKED)}."


CHECKED: Final = (
    "off_target",
    "fall",
    "slip",
    "degradation",
    "slow_simulation",
)  # kinds that labelled runs of checks show
_EVENTS: Final = """\
Recordings of {recordings} kinds are simulated, {cases} of each kind for each row interval and
noise level: drives, stops, docking, slow drift, robots that are held, failing sensors,
oscillations, healthy robots and others. The noise (standard deviation) is {places} for a position
coordinate, {readings} for a distance sensor, and {swings} of the amplitude for an oscillation.
*Found* is the share of events that are reported (recall). *True* is the share of reports that are
right (precision). Both are in per cent, followed by the number of events. *Off* is the median
error of start and end, with the 90th percentile in parentheses. In {hours} hours of recordings
without an event of a kind, {false} false events of that kind are reported per hour."""

_WHY: Final = """\
The weak cases have two reasons. A dropout must be {score:g} times as large as the signal's usual
steps (a modified z-score). With noise of 50 mm that is {jump_m:.1f} m, so a dropout of a distance
sensor that reads less is not noticed. An answer without any jump names that size. With few rows
and much noise, a short stop looks like a slow drive; the answer then says that it may have missed
some."""


def _recordings() -> list[str]:
    return [name for name in RECORDINGS if name not in _OF_ONE_RATE]


def _measured(bench: Bench) -> dict[Cell, list[tuple[str, Tally]]]:
    """The tallies of each cell, by kind of recording."""
    cases, found = bench.count(4, least=0), dict[Cell, list[tuple[str, Tally]]]()
    settings = list(starmap(Setting, product(INTERVALS_S, range(len(LEVELS)))))
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        reports = pool.map(_report, settings, repeat(cases))
        for (interval_s, noise), report in zip(settings, reports, strict=True):
            bench.say(f"events: a row every {duration(interval_s)}, {LEVELS[noise]}")
            for (recording, judged, _), tally in report.tallies.items():
                found.setdefault((judged, interval_s, noise), []).append((recording, tally))
    return found


def _report(setting: Setting, cases: int) -> Report:
    token = SETTING.set(setting)
    report = measure(_recordings(), cases, UNSEEN, most_values=_MOST_VALUES)
    SETTING.reset(token)
    return report


def _sum(tallies: Iterable[Tally]) -> Tally:
    whole = Tally()
    for tally in tallies:
        for each in fields(Tally):
            setattr(whole, each.name, getattr(whole, each.name) + getattr(tally, each.name))
    return whole


def _rows(
    cells: dict[Cell, list[tuple[str, Tally]]], cell: Callable[[Tally, float], str]
) -> Iterator[list[str]]:
    for judged, (kind, what) in MEASURES.items():
        for interval_s in INTERVALS_S:
            of = [cells.get((judged, interval_s, noise), []) for noise in range(len(LEVELS))]
            figures = (cell(_sum(tally for _, tally in each), interval_s) for each in of)
            yield [f"`{kind}`: {what}", duration(interval_s), *figures]


def _truth(tally: Tally, interval_s: float) -> str:
    if not tally.incidents:
        return "-"
    return f"{percent(tally.recall)} / {percent(tally.precision)} of {tally.incidents}"


def _errors(tally: Tally, interval_s: float) -> str:
    """Of begin and end, in time, of swings in periods: the median, and what nine in ten keep."""
    if not tally.begin_errors:
        return "-"
    figures = [of(errors) or 0.0 for errors in (tally.begin_errors, tally.end_errors)
               for of in (median, nine_in_ten)]  # fmt: skip
    if tally.period_errors:
        return "{:.2f} ({:.2f}), {:.2f} ({:.2f}) periods".format(*figures)
    return "{} ({}), {} ({})".format(
        *(duration(each * interval_s) if each else "0" for each in figures)
    )


def _poor(cells: dict[Cell, list[tuple[str, Tally]]]) -> Iterator[str]:
    for (judged, interval_s, noise), tallies in cells.items():
        whole = _sum(tally for _, tally in tallies)
        where = f"- {MEASURES[judged][1]}, a row every {duration(interval_s)}, {LEVELS[noise]}"
        if (whole.recall if whole.recall is not None else 1.0) < _POOR:
            missed = ((each, tally.incidents - tally.found) for each, tally in tallies)
            found = share(whole.found, whole.incidents)
            yield f"{where}: {found} found; missed in {_worst(missed)}"
        if (whole.precision if whole.precision is not None else 1.0) < _POOR:
            told = whole.found + whole.false
            false = ((each, tally.false) for each, tally in tallies)
            yield f"{where}: {share(whole.found, told)} true; false in {_worst(false)}"


def _worst(counts: Iterable[tuple[str, int]]) -> str:
    most = sorted(counts, key=lambda each: -each[1])
    return ", ".join(f"`{name}` ({count})" for name, count in most[:3] if count)


def _levels(levels: Sequence[float], times: float, unit: str) -> str:
    none, little, much = (f"{times * each:g}" for each in levels)
    return f"{none}, {little} or {much} {unit}"


def checks(bench: Bench) -> Iterator[str]:
    """What the checks say of healthy runs, and of runs with one fault each."""
    judged = checks_judging.judge(bench.count(100), bench.count(5), UNSEEN)
    healthy = judged.pop(checks_judging.HEALTHY)
    fails = sum(n for (_, outcome), n in healthy.said.items() if outcome == "fail")
    warned = sum(n for (_, outcome), n in healthy.said.items() if outcome == "warn")
    noticed, runs = (
        sum(getattr(each, name) for each in judged.values()) for name in ("noticed", "runs")
    )
    yield (
        f"{noticed} of {runs} runs with a fault are noticed by the responsible check; "
        f"{fails} checks fail in {healthy.runs} healthy runs."
    )
    yield _CHECKS.format(warned=warned, runs=healthy.runs, checks=len(CHECKS))
    rows = [
        (kind, each.checked_by, str(each.runs), str(each.said[each.checked_by, "fail"]),
         str(each.said[each.checked_by, "warn"]), str(len(each.wrong)))
        for kind, each in judged.items()
    ]  # fmt: skip
    yield table(("fault", "check", "runs", "fails", "warns", "other checks that fail"), rows)
    found = {each.checked_by for each in judged.values()}
    alarms = [
        (each.name, str(healthy.said[each.name, "fail"]), str(healthy.said[each.name, "warn"]),
         "yes" if each.name in found else "no")
        for each in CHECKS
    ]  # fmt: skip
    yield table(("check", "fails in healthy runs", "warns in them", "has a fault above"), alarms)


_CHECKS: Final = """\
A healthy run drives, turns and stops as commanded. Its sensors work, its odometry drifts, and an
arm lags. Each fault is put into such a run. In {runs} healthy runs, judged by {checks} checks
each, {warned} checks warn. "Other checks that fail" are not always wrong: a robot that is held
also slips. A healthy run fails "moves when commanded" if it turns slowly in place for 3 s at 0.3
to 0.4 rad/s: turning is searched in windows of 2 s, and two consecutive ones must show it."""
