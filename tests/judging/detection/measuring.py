"""Writes cases, asks about them, and counts what the answers got right."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.judging.detection.asking import Answer, Claim, ask_run, ask_since
from tests.judging.detection.drawing import MOST_VALUES, draw_case
from tests.judging.detection.judging import Tally, Verdict, judge
from tests.judging.detection.labelled import Case, Incident, LabelledRun, Measure, repeated
from tests.judging.detection.writing import purge, put_in_chunks, write_all
from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S

Key = tuple[str, Measure, str]  # kind of recording, what is judged, under which conditions

NOISY_M: Final = 0.01  # more noise than this has goals of its own
LONG_ROWS: Final = 12_000  # a dozen chunks
LEFT_ROWS: Final = 3_000  # of them, when the others were purged
MOST_ALONE: Final = 4  # incidents of a run that are asked about one by one
AROUND_S: Final = 10.0  # before and after each
_MOST_VALUES: Final = 0  # no further signals in long recordings: their rows cost enough


@dataclass
class Report:
    """What came of all cases.

    Attributes:
        disagreed: By kind of recording and what is judged: how many long runs were told otherwise
            from chunks, or after their rows were purged, than from their rows.
        widened: By kind of recording and what is judged: what was told where only the time about
            it was asked for, and how much of that was told of the whole run too.
        wrong: A line for each thing that was missed or wrongly told.
    """

    tallies: dict[Key, Tally] = field(default_factory=dict[Key, Tally])
    disagreed: dict[tuple[str, Measure], int] = field(
        default_factory=dict[tuple[str, Measure], int]
    )
    widened: dict[tuple[str, Measure], tuple[int, int]] = field(
        default_factory=dict[tuple[str, Measure], tuple[int, int]]
    )
    wrong: list[str] = field(default_factory=list[str])

    def add(self, case: Case, run: LabelledRun, verdict: Verdict, asked: Asked) -> None:
        """Count one run of a case."""
        key = (case.kind, asked.measure, ", ".join(filter(None, (_noise(run), asked.how))))
        tally = self.tallies.setdefault(key, Tally())
        minutes = run.duration_s / 60
        admitted = asked.answer.admits(asked.measure)
        tally.add(verdict, minutes, asked.answer.took_s, admitted=admitted)
        self.wrong += _lines(case, run, verdict, asked)

    def add_agreement(self, key: tuple[str, Measure], *, agree: bool) -> None:
        """Count whether a run was told alike however it is stored."""
        self.disagreed[key] = self.disagreed.get(key, 0) + (not agree)

    def add_widened(self, key: tuple[str, Measure], *, of_whole: bool) -> None:
        """Count what was told when asked about alone."""
        alone, both = self.widened.get(key, (0, 0))
        self.widened[key] = (alone + 1, both + of_whole)


@dataclass(frozen=True)
class Asked:
    """What was asked about a run, and how it was stored: its rows, chunks, or chunks alone."""

    measure: Measure
    answer: Answer
    how: str = ""


def measure(
    kinds: Sequence[str],
    cases: int,
    seed: int,
    say: Callable[[str], None] = lambda text: None,
    *,
    long: bool = False,
    most_values: int = MOST_VALUES,
) -> Report:
    """Ask about so many cases of each kind, or about each as a long run in all ways of storing."""
    report = Report()
    for kind in kinds:
        for index in range(cases):
            say(f"{kind} {index + 1}/{cases}")
            if long:
                _measure_long(draw_case(kind, seed, index, most_values=_MOST_VALUES), report)
            else:
                _measure_whole(draw_case(kind, seed, index, most_values=most_values), report)
    return report


def _measure_whole(case: Case, report: Report) -> None:
    """All runs of a case in one question; every second case is put into chunks before."""
    with memory_connection() as connection:
        run_ids = write_all(connection, case.runs)
        if case.number % 2:
            put_in_chunks(connection)
        answer = ask_since(connection, case.asked, WALL_START_S)
    for run_id, run in zip(run_ids, case.runs, strict=True):
        for asked in (Asked(each, answer) for each in case.asked):
            _judge(case, run, run_id, asked, report)


def _measure_long(case: Case, report: Report) -> None:
    """A long run, asked of its rows, of its chunks, and when most of its rows were purged."""
    run = repeated(case.runs[-1], LONG_ROWS)
    answers: dict[str, Answer] = {}
    with memory_connection() as connection, tempfile.TemporaryDirectory() as folder:
        (run_id,) = write_all(connection, [run])
        answers["rows"] = ask_run(connection, case.asked, run_id)
        put_in_chunks(connection)
        answers["chunks"] = ask_run(connection, case.asked, run_id)
        purge(connection, Path(folder), LEFT_ROWS)
        answers["purged"] = ask_run(connection, case.asked, run_id)
    for each in case.asked:
        for how, answer in answers.items():
            _judge(case, run, run_id, Asked(each, answer, how), report)
        told = [answer.of(each, run_id) for answer in answers.values()]
        report.add_agreement((case.kind, each), agree=told[0] == told[1] == told[2])


def measure_widened(
    kinds: Sequence[str], cases: int, seed: int, say: Callable[[str], None] = lambda text: None
) -> Report:
    """Ask about the time of each incident alone, and about the whole run: more time, not less."""
    report = Report()
    for kind in kinds:
        for index in range(cases):
            say(f"{kind} {index + 1}/{cases}, alone")
            _measure_widened(draw_case(kind, seed, index, most_values=0), report)
    return report


def _measure_widened(case: Case, report: Report) -> None:
    run = case.runs[-1]
    with memory_connection() as connection:
        (run_id,) = write_all(connection, [run])
        whole = ask_run(connection, case.asked, run_id)
        for incident in [each for each in run.incidents if not each.optional][:MOST_ALONE]:
            about = (incident.start_s - AROUND_S, incident.end_s + AROUND_S)
            alone = ask_run(connection, [incident.measure], run_id, *about)
            if _tells(alone, incident, run_id, run):
                of_whole = _tells(whole, incident, run_id, run)
                report.add_widened((case.kind, incident.measure), of_whole=of_whole)
                report.wrong += [] if of_whole else [_lost(case, run, incident)]


def _tells(answer: Answer, incident: Incident, run_id: int, run: LabelledRun) -> bool:
    claims = answer.of(incident.measure, run_id)
    return bool(judge([incident], claims, run.interval_s).found)


def _lost(case: Case, run: LabelledRun, incident: Incident) -> str:
    where = f"{case.kind} {case.number}, {1000 * run.interval_s:g} ms"
    return f"{where}: {_text(incident)} is told of that time and not of the whole run"


def _judge(case: Case, run: LabelledRun, run_id: int, asked: Asked, report: Report) -> None:
    truth = [each for each in run.incidents if each.measure == asked.measure]
    claims = asked.answer.of(asked.measure, run_id)
    report.add(case, run, judge(truth, claims, run.interval_s), asked)


def _noise(run: LabelledRun) -> str:
    if run.distance_m is None:
        return ""
    return f"to {'10' if run.noise_m <= NOISY_M else '30'} mm"


def _lines(case: Case, run: LabelledRun, verdict: Verdict, asked: Asked) -> Iterator[str]:
    noise = f", noise {1000 * run.noise_m:g} mm" if run.noise_m else ""
    where = f"{case.kind} {case.number}, {1000 * run.interval_s:g} ms{noise}"
    where += f", {asked.how}" if asked.how else ""
    for incident in verdict.missed:
        said = ", and said so" if asked.answer.admits(asked.measure) else ""
        yield f"{where}: {_text(incident)} was missed{said}"
    for claim in verdict.unfounded:
        yield f"{where}: {_text(claim)} did not happen"


def _text(what: Incident | Claim) -> str:
    name = f" of {what.name}" if what.name else ""
    period = f", period {what.period_s:.3g} s" if what.period_s else ""
    size = f", amplitude {what.amplitude:.3g}" if what.amplitude else ""
    return f"{what.measure}{name} {what.start_s:.3f} to {what.end_s:.3f} s{period}{size}"
