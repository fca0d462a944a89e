"""The first sentence of each answer: what it says, in at most 40 words.

A summary is made of the members of its answer, so that it cannot say anything else. Texts that
controllers have written (log lines, results) are not repeated in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import singledispatch
from typing import Any, Final, cast

from webots_mcp.answers.models import (
    Answer,
    AnswerTable,
    BreakpointAnswer,
    BreakpointsAnswer,
    CheckAnswer,
    CommandAnswer,
    CommandsAnswer,
    ComparisonAnswer,
    DiagnosisAnswer,
    EventsAnswer,
    FullStateAnswer,
    HistoryAnswer,
    KindVerdicts,
    LogsAnswer,
    MonitorAnswer,
    ParametersAnswer,
    RobotsAnswer,
    RunAnswer,
    RunsAnswer,
    SensorsAnswer,
    SignalMeaningsAnswer,
    SignalsAnswer,
    SqlAnswer,
    StateAnswer,
    TimelineAnswer,
    TrendsAnswer,
    TrialsAnswer,
    WorldAnswer,
)

MOST_WORDS: Final = 40
_MOST_NAMED: Final = 4
_SERIOUS: Final = ("critical", "error", "warning")
# Kinds that are no fault by themselves: a summary of faults names them last.
_ORDINARY: Final = ("run", "change", "command", "log", "bridge_event", "kept_stretch", "image")
_WORST_KINDS: Final = (
    "violation", "condition", "fall", "stuck", "off_target", "oscillation", "missing", "jump",
    "degradation", "flat", "standstill", "gap",
)  # fmt: skip
_OUTCOMES: Final = {"fail": "failed", "warn": "warned", "not judged": "could not be judged"}
_ENDINGS: Final = {"finished": "finished", "crashed": "crashed"}  # others: "ended by reset"


def summary_of(answer: Answer) -> str | None:
    """Return the first sentence of an answer; None where it says nothing but its header."""
    if answer.status == "never seen":
        return "Nothing is recorded here yet."
    text = _summary(answer)
    return None if text is None else _cut(text)


def _cut(text: str) -> str:
    words = text.split()
    return text if len(words) <= MOST_WORDS else f"{' '.join(words[:MOST_WORDS])} ..."


@singledispatch
def _summary(answer: Answer) -> str | None:
    return None


@_summary.register
def _(answer: StateAnswer) -> str:
    state: dict[str, Any] = {}
    if isinstance(answer.state, dict):
        state = cast("dict[str, Any]", answer.state)
    mode = state.get("mode")
    doing = f", mode {mode!r}" if isinstance(mode, str) and len(mode) <= 40 else ""
    return f"{_subject(answer)} {_when(answer)}{doing}."


@_summary.register
def _(answer: SensorsAnswer) -> str:
    if not answer.sensors:
        return f"{_subject(answer)} publishes no sensor value."
    return f"Newest sensor values of {_subject(answer)}, which {_when(answer)}."


@_summary.register
def _(answer: FullStateAnswer) -> str:
    part = f"'{answer.path}'" if answer.path else "the newest state"
    more = f"; continue with offset={answer.next_offset}" if answer.next_offset else ""
    size = f" ({answer.total} members, items or characters)" if answer.total else ""
    return f"Exact values of {part}{size}{more}; {_subject(answer)} {_when(answer)}."


@_summary.register
def _(answer: WorldAnswer) -> str:
    world = answer.world.replace("\\", "/").rsplit("/", 1)[-1] if answer.world else "unknown world"
    speed = answer.real_time_factor
    pace = f", {speed:.3g} times real time" if speed is not None else ""
    runs = f", {answer.runs_recorded} recorded" if answer.runs_recorded else ""
    return f"{world}: {_subject(answer)} {_when(answer)}{pace}; run {answer.run_id}{runs}."


@_summary.register
def _(answer: RobotsAnswer) -> str:
    robots = list(_rows(answer.robots))
    named = [f"{each.get('robot')} ({each.get('status')})" for each in robots]
    return f"{_count(len(robots), 'robot')} recorded: {_listed(named)}."


@_summary.register
def _(answer: DiagnosisAnswer) -> str:
    failed = [each.get("check", "") for each in answer.failed or ()]
    skipped = "; some checks could not be made" if answer.not_checked else ""
    if not failed:
        return f"The set-up is well: no check failed{skipped}."
    return f"{_count(len(failed), 'check')} of the set-up failed: {_listed(failed)}{skipped}."


@_summary.register
def _(answer: LogsAnswer) -> str:
    lines = list(_rows(answer.lines))
    if not lines:
        return "No log line matches."
    levels = Counter(str(each.get("level")) for each in lines)
    serious = [f"{levels[name]} {name}" for name in _SERIOUS if levels[name]]
    total = max(answer.matching or 0, len(lines))
    shown = (
        f"{len(lines)} of {total} log lines" if total > len(lines) else _count(total, "log line")
    )
    return f"{shown}; {_listed(serious) or 'no warning or error'}."


@_summary.register
def _(answer: RunAnswer) -> str:
    if answer.stopped is None:
        return _command(answer)
    at = f" at {answer.state_at_s:.12g} s" if answer.state_at_s is not None else ""
    return f"The run stopped{at}: {answer.stopped}."


@_summary.register
def _(answer: CommandAnswer) -> str:
    return _command(answer)


def _command(answer: CommandAnswer) -> str:
    outcome = "still under way" if answer.outcome == "claimed" else answer.outcome or "unknown"
    by = f", by {answer.route}" if answer.route else ""
    number = f" (command {answer.command_id})" if answer.command_id is not None else ""
    return f"{answer.action or 'The command'}{number}: {outcome}{by}."


@_summary.register
def _(answer: ParametersAnswer) -> str:
    if not answer.total:
        return f"{_subject(answer)} declares no parameters."
    return f"{_count(answer.total, 'parameter')} of {_subject(answer)}."


@_summary.register
def _(answer: CommandsAnswer) -> str:
    actions = list(answer.actions or ())
    commands = list(_rows(answer.commands))
    own = _count(len(actions), "action") if actions else "no action"
    newest = "no command was sent"
    if commands:
        newest = f"newest command: {commands[0].get('action')}, {commands[0].get('outcome')}"
    return f"{_subject(answer)} has {own} of its own; {newest}."


@_summary.register
def _(answer: BreakpointAnswer) -> str:
    number = f"Breakpoint {answer.breakpoint_id}"
    if answer.condition is None:
        return f"{number} is removed."
    armed = {True: "armed", False: "not armed", None: "stored, not yet confirmed"}[answer.armed]
    return f"{number} is {armed}: {answer.action} when {answer.condition}."


@_summary.register
def _(answer: BreakpointsAnswer) -> str:
    return f"{_count(len(list(_rows(answer.breakpoints))), 'breakpoint')} of {_subject(answer)}."


@_summary.register
def _(answer: SignalsAnswer) -> str:
    unknown = [str(e.get("signal")) for e in _rows(answer.signals) if e.get("source") == "unknown"]
    said = f"; unknown meaning: {_listed(unknown)}" if unknown else ""
    return f"{_count(answer.total or 0, 'signal')}{said}."


@_summary.register
def _(answer: SignalMeaningsAnswer) -> str:
    if answer.changed:
        return f"Changed the meaning of {_listed(answer.changed)}."
    unknown = answer.unknown or []
    said = f"; unknown, so never judged: {_listed(unknown)}" if unknown else "; all are known"
    return f"{_count(answer.total or 0, 'signal')}{said}."


@_summary.register
def _(answer: HistoryAnswer) -> str:
    if answer.raw is not None:
        more = "; continue with cursor" if answer.cursor else ""
        return f"{_count(len(answer.raw.sim_time_s), 'row')} as recorded{more}."
    runs = answer.runs or []
    if not runs:
        return "No row is in this range."
    first = runs[0]
    names = [*(first.numbers or ()), *(first.states or ())]
    step = f" per {first.step_s:.3g} s" if first.step_s else ""
    return f"{_listed(names)}{step}, {_span(first.start_s, first.end_s)} of run {first.run_id}."


@_summary.register
def _(answer: TrendsAnswer) -> str:
    runs = answer.runs or []
    if not runs:
        return "No row is in this range."
    first = runs[0]
    changed = [f"{row.get('signal')} {row.get('says')}" for row in _rows(first.numbers)]
    lead = _listed(changed, 2) or "no number changed"
    return f"{_span(first.start_s, first.end_s)} of run {first.run_id}: {lead}."


@_summary.register
def _(answer: EventsAnswer) -> str:
    return _events(answer.verdicts, answer.events)


@_summary.register
def _(answer: TimelineAnswer) -> str:
    shown = list(_rows(answer.events))
    more = "; continue with cursor" if answer.cursor else ""
    entries = _count(len(shown), "recorded entry", "recorded entries")
    return f"{entries} in order of time, not searched for faults (webots_find_events){more}."


@_summary.register
def _(answer: MonitorAnswer) -> str:
    window = f"{answer.window_s or 0:.3g} s of wall-clock time"
    if not answer.row_count:
        return f"No row was recorded in {window}."
    moved_m = (answer.movement or {}).get("distance_m")
    path = f" it moved {moved_m:.3g} m" if isinstance(moved_m, float | int) else ""
    return f"In {window}{path}. {_events(answer.verdicts, answer.events)}"


def _events(verdicts: KindVerdicts | None, events: AnswerTable | None) -> str:
    """Return what was found, since when, what was not found, and what could not be searched."""
    if verdicts is None:
        return "Nothing was searched."
    found = dict(verdicts.found or {})
    first_s = _first_begins(events)
    faults = sorted((kind for kind in found if kind not in _ORDINARY), key=_severity)
    said = [_occurrences(kind, found[kind], first_s.get(kind)) for kind in faults]
    noted = [f"{found[kind]} {kind}" for kind in found if kind in _ORDINARY]
    searched = _kinds_in([*(verdicts.nearest or ()), verdicts.not_found or ""])
    absent = sorted([kind for kind in searched if kind not in _ORDINARY] or searched, key=_severity)
    unsearched = _kinds_in(verdicts.not_searched or ())
    partly = [kind for kind in unsearched if kind in found or kind in searched]
    unknown = [kind for kind in unsearched if kind not in partly]
    parts = [
        f"Found {_listed(said)}" if said else "",
        f"Noted {_listed(noted)}" if noted and not said else "",
        f"not found: {_listed(absent)}" if absent else "",
        f"cannot tell: {_listed(unknown)}" if unknown else "",
        f"searched only in part: {_listed(partly)}" if partly else "",
    ]
    text = "; ".join(part for part in parts if part) or "nothing in this range"
    return f"{text[0].upper()}{text[1:]}."


def _kinds_in(texts: Iterable[str]) -> list[str]:
    return [kind for text in texts for kind in text.split(", ") if kind]


def _severity(kind: str) -> int:
    return _WORST_KINDS.index(kind) if kind in _WORST_KINDS else len(_WORST_KINDS)


def _first_begins(events: AnswerTable | None) -> dict[str, float]:
    """Return when the first event of each kind that is shown began, in simulated seconds."""
    first_s: dict[str, float] = {}
    for row in _rows(events):
        kind, start_s = row.get("kind"), row.get("start_s")
        if isinstance(kind, str) and isinstance(start_s, float | int):
            first_s[kind] = min(first_s.get(kind, start_s), start_s)
    return first_s


def _occurrences(kind: str, count: int, first_s: float | None) -> str:
    times = "once" if count == 1 else f"{count} times"
    if first_s is None:
        return f"{kind} {times}"
    at = f"at {first_s:.12g} s" if count == 1 else f"from {first_s:.12g} s on"
    return f"{kind} {times} {at}"


@_summary.register
def _(answer: CheckAnswer) -> str:
    names: dict[str, list[str]] = {}
    for row in _rows(answer.checks):
        names.setdefault(str(row.get("outcome")), []).append(str(row.get("check")))
    parts = [
        f"{len(names[outcome])} {words} ({_listed(names[outcome], 2)})"
        for outcome, words in _OUTCOMES.items()
        if outcome in names
    ]
    parts.append(f"{len(answer.passed or ())} passed")
    others = len(names.get("not applicable", ()))
    parts.append(f"{others} not applicable" if others else "")
    return f"Of the checks {', '.join(part for part in parts if part)}."


@_summary.register
def _(answer: TrialsAnswer) -> str:
    if answer.trial_set is None:
        return "No trials were started."
    over = f"{answer.over or 0} of {answer.trials or 0} trials are over"
    ranked = list(_rows(answer.ranked))
    best = ""
    if ranked and ranked[0].get("score") is not None:
        sure = "confirmed" if answer.is_best_confirmed else "not confirmed"
        best = f"; best score {ranked[0]['score']} ({sure})"
    return f"Trial set {answer.trial_set}: {over}, {answer.state}{best}."


@_summary.register
def _(answer: SqlAnswer) -> str:
    cut = "; some are missing" if answer.truncated else ""
    return f"{_count(len(list(_rows(answer.result))), 'row')}{cut}."


@_summary.register
def _(answer: RunsAnswer) -> str:
    if answer.run is not None:
        return f"Run {answer.run.get('run_id', answer.run_id)} is annotated and will be kept."
    runs = list(_rows(answer.runs))
    if not runs:
        return "No run matches."
    newest = runs[0]
    lasted_s, ended = newest.get("duration_s"), newest.get("ended_by")
    lasts = f"lasted {lasted_s:.12g} s" if isinstance(lasted_s, float | int) else "began"
    end = _ENDINGS.get(ended, f"ended by {ended}") if ended else "goes on"
    total = _count(answer.total or len(runs), "run")
    return f"{total}; the first shown, run {newest.get('run_id')}, {lasts} and {end}."


@_summary.register
def _(answer: ComparisonAnswer) -> str | None:
    if answer.verdict is not None:
        return None
    if len(list(_rows(answer.groups))) < 2:
        return "Figures of one group of runs; there is nothing to compare it with."
    rows = [*_rows(answer.measures), *_rows(answer.differences)]
    different = [_name(row) for row in rows if _is(row, True)]
    same = sum(_is(row, False) for row in rows)
    undecided = len(rows) - len(different) - same
    apart = [] if different else _largest_differences(rows)
    parts = [f"Different: {_listed(different)}" if different else "No figure is known to differ"]
    if apart:
        parts = [f"Largest differences, not certain: {', '.join(apart)}", _too_few(answer, rows)]
    parts.append(f"{same} equal within what matters" if same else "")
    parts.append(f"{undecided} cannot be decided" if undecided and not apart else "")
    return f"{'; '.join(part for part in parts if part)}."


def _largest_differences(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return undecided figures of two groups whose runs do not overlap, largest change first.

    Of changes that are equally large, those of signals that are constant in each run come first.
    """
    found: list[tuple[float, bool, str]] = []
    for row in rows:
        values: list[float | None] = row.get("median") or row.get("mean") or []
        if row.get("different") is not None or len(values) != 2:
            continue
        first, second = values
        if first is None or second is None or first == second:
            continue
        ranges: list[list[float] | None] = row.get("range") or row.get("mean_range") or []
        known = [each for each in ranges if each is not None] or [[first] * 2, [second] * 2]
        if len(known) < 2 or max(each[0] for each in known) <= min(each[1] for each in known):
            continue
        change = abs(second - first) / max(abs(first), abs(second))
        varies = row.get("deviation") != [0.0, 0.0]
        found.append((-round(change, 2), varies, f"{_name(row)} {first:.4g} -> {second:.4g}"))
    return [text for *_, text in sorted(found, key=lambda each: each[:2])[:_MOST_NAMED]]


def _too_few(answer: ComparisonAnswer, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many runs there are of each group, and how many would decide."""
    counts = [str(len(row.get("runs") or ())) for row in _rows(answer.groups)]
    wanted: list[int] = []
    for row in rows:
        value: list[int | None] | int | None = row.get("runs_wanted")
        wanted += [each for each in (value if isinstance(value, list) else [value]) if each]
    least = f"{max(wanted)} of each would do" if wanted else "repeat the runs"
    return f"too few runs ({' and '.join(counts)}): {least}"


def _is(row: Mapping[str, Any], outcome: bool) -> bool:
    """Whether a figure, or its spread, is different in any group, or in none."""
    flat: list[Any] = []
    for value in (row.get("different"), row.get("deviation_different")):
        flat += value if isinstance(value, list) else [value]
    known = [each for each in flat if each is not None]
    return any(known) if outcome else bool(known) and not any(known)


def _name(row: Mapping[str, Any]) -> str:
    return str(row.get("name") or row.get("signal"))


def _subject(answer: Answer) -> str:
    return answer.robot or "The robot"


def _when(answer: Answer) -> str:
    """Return whether the robot runs, at which simulated time, and how old that is."""
    at = f" at {answer.sim_time_s:.12g} s" if answer.sim_time_s is not None else ""
    age = answer.age_s
    old = f" (data {age:.3g} s old)" if age is not None and answer.status == "running" else ""
    if answer.why and answer.why.startswith("this is an earlier run"):
        return f"was last recorded in this run{at}"
    return f"is {answer.status or 'known'}{at}{old}"


def _span(start_s: float | None, end_s: float | None) -> str:
    ends = ["?" if each is None else f"{each:.12g}" for each in (start_s, end_s)]
    return f"{ends[0]} to {ends[1]} s"


def _rows(table: AnswerTable | None) -> Iterable[dict[str, Any]]:
    """Yield the rows of a table as objects."""
    if table is None:
        return
    for row in table.rows:
        yield {**(table.in_every_row or {}), **dict(zip(table.columns, row, strict=False))}


def _count(number: int, word: str, plural: str | None = None) -> str:
    return f"{number} {word if number == 1 else plural or f'{word}s'}"


def _listed(names: Sequence[str], most: int = _MOST_NAMED) -> str:
    left = len(names) - most
    return ", ".join(names[:most]) + (f" and {left} more" if left > 0 else "")
