"""Writes cases, asks about them, and counts what the answers got right."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

from tests.detection.asking import Answer, Claim, ask_run, ask_since
from tests.detection.drawing import draw_case
from tests.detection.judging import Tally, Verdict, judge
from tests.detection.labelled import Case, Incident, LabelledRun, Measure, repeated
from tests.detection.writing import purge, put_in_chunks, write_all
from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S

Summaries = Literal["long", "purged"]
Key = tuple[str, Measure, str]  # kind of recording, what is judged, under which conditions

NOISY_M: Final = 0.01  # more noise than this has goals of its own
LONG_ROWS: Final = 36_000  # longer than what any question reads row by row
PART_ROWS: Final = 12_000  # of it, which then repeats; purging takes the first
MOST_ALONE: Final = 4  # incidents of a run that are asked about one by one
AROUND_S: Final = 10.0  # before and after each
_MOST_VALUES: Final = 0  # no further signals in long recordings: their rows cost enough


@dataclass
class Report:
    """What came of all cases.

    Attributes:
        agreements: By kind of recording and what is judged: what rows and summaries both tell,
            and what only the rows or only the summaries do.
        widened: By kind of recording and what is judged: what was told where only the time about
            it was asked for, and how much of that was told of the whole run too.
        wrong: A line for each thing that was missed or wrongly told.
    """

    tallies: dict[Key, Tally] = field(default_factory=dict[Key, Tally])
    agreements: dict[tuple[str, Measure], tuple[int, int, int]] = field(
        default_factory=dict[tuple[str, Measure], tuple[int, int, int]]
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

    def add_agreement(self, key: tuple[str, Measure], told: Verdict) -> None:
        """Count what summaries tell, judged by what rows tell."""
        both, missing, more = self.agreements.get(key, (0, 0, 0))
        new = (both + len(told.found), missing + len(told.missed), more + told.false)
        self.agreements[key] = new

    def add_widened(self, key: tuple[str, Measure], *, of_whole: bool) -> None:
        """Count what was told when asked about alone."""
        alone, both = self.widened.get(key, (0, 0))
        self.widened[key] = (alone + 1, both + of_whole)


@dataclass(frozen=True)
class Asked:
    """What was asked about a run, and how: of rows, of summaries, or as it came."""

    measure: Measure
    answer: Answer
    how: str = ""


def measure(
    kinds: Sequence[str],
    cases: int,
    seed: int,
    summaries: Summaries | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Report:
    """Ask about so many cases of each kind."""
    report = Report()
    for kind in kinds:
        for index in range(cases):
            say(f"{kind} {index + 1}/{cases}")
            if summaries is None:
                _measure_whole(draw_case(kind, seed, index), report)
            else:
                case = draw_case(kind, seed, index, most_values=_MOST_VALUES)
                _measure_long(case, summaries, report)
    return report


def _measure_whole(case: Case, report: Report) -> None:
    """All runs of a case in one question; of every second case the summaries are made before."""
    with memory_connection() as connection:
        run_ids = write_all(connection, case.runs)
        if case.number % 2:
            put_in_chunks(connection)
        answer = ask_since(connection, case.asked, WALL_START_S)
    for run_id, run in zip(run_ids, case.runs, strict=True):
        for asked in (Asked(each, answer) for each in case.asked):
            _judge(case, run, run_id, asked, report)


def _measure_long(case: Case, summaries: Summaries, report: Report) -> None:
    """A long run, asked of all of its rows and of its summaries.

    What happens often is told as one event that counts it, so that both are asked of the same time.
    """
    short = repeated(case.runs[-1], min(PART_ROWS, 4 * len(case.runs[-1].times)))
    long = repeated(short, LONG_ROWS)
    with memory_connection() as connection, tempfile.TemporaryDirectory() as folder:
        (run_id,) = write_all(connection, [long])
        put_in_chunks(connection)
        with _read_row_by_row():
            of_rows = ask_run(connection, case.asked, run_id)
        if summaries == "purged":
            purge(connection, Path(folder), len(long.times) - len(short.times))
        of_summaries = ask_run(connection, case.asked, run_id)
    for each in case.asked:
        _judge(case, long, run_id, Asked(each, of_rows, "rows"), report)
        _judge(case, long, run_id, Asked(each, of_summaries, summaries), report)
        told = [_as_incident(claim) for claim in of_rows.of(each, run_id)]
        # One event that counts many stands for itself, on both sides.
        alike = [replace(claim, count=1) for claim in of_summaries.of(each, run_id)]
        agreed = judge(told, alike, long.interval_s)
        report.add_agreement((case.kind, each), agreed)


def _as_incident(claim: Claim) -> Incident:
    return Incident(claim.measure, claim.start_s, claim.end_s, claim.name)


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
