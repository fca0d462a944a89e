"""The first sentence of each answer: what it says, in at most 40 words.

A summary is made of the members of its answer, so that it cannot say anything else. Texts that
controllers have written (log lines, results) are not repeated in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, singledispatch
from typing import Any, Final, cast

from webots_mcp.answers.answer_models import (
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
    InspectionAnswer,
    KindVerdicts,
    LintAnswer,
    LogsAnswer,
    MonitorAnswer,
    ParametersAnswer,
    RerunAnswer,
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
from webots_mcp.judging.verdicts import AS_STUCK
from webots_mcp.store.relative_times import age_in_words

MOST_WORDS: Final = 40
_MOST_NAMED: Final = 4
_NOTED_FIRST: Final = ("change", "command", "log", "bridge_event", "kept_stretch", "image", "run")
_OUTCOMES: Final = {"fail": "failed", "warn": "warned", "not judged": "could not be judged"}
_ENDINGS: Final = {  # others: "ended by reset"
    "finished": "finished", "crashed": "crashed", "going on": "goes on",
}  # fmt: skip
_HELD: Final = {"pass": "held", "fail": "did not hold", "warn": "did not always hold"}
TRIAL_FIGURES: Final = ("score", "range", "scored", "pruned", "failed", "why", "runs")
_NOUNS: Final = {  # one and several
    "change": ("change", "changes"), "command": ("command", "commands"),
    "log": ("log line", "log lines"), "bridge_event": ("bridge event", "bridge events"),
    "kept_stretch": ("full-rate segment", "full-rate segments"), "image": ("image", "images"),
    "run": ("beginning or end of a run", "beginnings and ends of runs"),
}  # fmt: skip


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
    mode = cast("dict[str, Any]", answer.state or {}).get("mode")
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
    runs = f", {answer.run_count} recorded" if answer.run_count else ""
    return f"{world}: {_subject(answer)} {_when(answer)}; run {answer.run_id}{runs}."


@_summary.register
def _(answer: LintAnswer) -> str:
    counts = {
        name.removesuffix("s"): count for name, count in (answer.counts or {}).items() if count
    }
    name = (answer.world or "world").replace("\\", "/").rsplit("/", 1)[-1]
    open_rules = len(answer.not_searched or ())
    rest = f"; {_count(open_rules, 'rule')} could not judge everything" if open_rules else ""
    if not counts:
        return f"{name}: no fault found{rest}."
    return f"{name}: {_listed([_count(n, each) for each, n in counts.items()])}{rest}."


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
    serious = [
        f"{levels[name]} {name}" for name in ("critical", "error", "warning") if levels[name]
    ]
    total = max(answer.total or 0, len(lines))
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
    newest = "no command was sent"
    if commands:
        first = commands[0]
        where = f" (run {first['run_id']}" if first.get("run_id") is not None else ""
        if where and first.get("sim_time_s") is not None:
            where += f", {first['sim_time_s']:.12g} s"
        where += ")" if where else ""
        newest = f"newest command: {first.get('action')}{where}, {first.get('outcome')}"
    if not actions and (answer.status or "").startswith("stopped"):
        return f"What {_subject(answer)} can do is unknown while no controller runs; {newest}."
    own = _count(len(actions), "action") if actions else "no action"
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
def _(answer: InspectionAnswer) -> str:
    if answer.path is not None:
        at = f" at {answer.line}" if answer.line else ""
        if isinstance(answer.value, dict | list):
            return f"{answer.path} was read{at}: value has its contents."
        return f"{answer.path} is {answer.value}{at}."
    if not answer.frames:
        return f"No variables of the controller of {_subject(answer)} are recorded here."
    inner = answer.frames[0]
    when = "Now" if answer.event_id is None else f"At {answer.at_s or 0:.12g} s ({answer.cause})"
    rows = len(list(_rows(answer.inspections)))
    more = f"; {rows} inspections listed" if rows else ""
    return f"{when}: {inner.get('at')}, {inner.get('function')}(){more}."


@_summary.register
def _(answer: SignalsAnswer) -> str:
    unknown = [str(e.get("signal")) for e in _rows(answer.signals) if e.get("source") == "unknown"]
    said = f"; unknown meaning: {_listed(unknown)}" if unknown else ""
    return f"{_count(answer.total or 0, 'signal')}{said}."


@_summary.register
def _(answer: SignalMeaningsAnswer) -> str:
    if answer.changed:
        doubts = f" But {answer.notes[0]}." if answer.notes else ""
        return f"Changed the meaning of {_listed(answer.changed)}.{doubts}"
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
    states = [_changes_of(row) for row in _rows(first.states)]
    numbers = [f"{row.get('signal')} {_clause(row.get('says'))}" for row in _rows(first.numbers)]
    named = [*states[:1], *numbers][:2]
    left = len(states) + len(numbers) - len(named)
    lead = "; ".join([*named, *[f"{left} more changed"] * bool(left)]) or "nothing changed"
    return f"{_span(first.start_s, first.end_s)} of run {first.run_id}: {lead}."


def _changes_of(state: Mapping[str, Any]) -> str:
    count, since_s = state.get("changes"), state.get("since_s")
    times = "once" if count == 1 else f"{count} times"
    since = f" since {since_s:.12g} s" if isinstance(since_s, float | int) else ""
    return f"{state.get('signal')} changed {times}, {state.get('last')!r}{since}"


def _clause(says: Any) -> str:
    """Return the first clause of what a signal did: the others stand in the table."""
    return str(says).split("; ")[0]


@_summary.register
def _(answer: EventsAnswer) -> str:
    return _events(answer.verdicts, answer.events, answer.run_id, answer.start_s)


@_summary.register
def _(answer: TimelineAnswer) -> str:
    shown = list(_rows(answer.events))
    more = "; continue with cursor" if answer.cursor else ""
    entries = _count(len(shown), "recorded entry", "recorded entries")
    return f"{entries} in order of time, not searched for faults (webots_find_events){more}."


@_summary.register
def _(answer: MonitorAnswer) -> str:
    window = f"{answer.window_wall_s or 0:.3g} s of wall-clock time"
    if (answer.status or "").startswith("stopped"):
        window = f"the last {window} recorded"
    if not answer.row_count:
        return f"No row was recorded in {window}."
    ranges = [f"run {run.run_id}, {_span(run.start_s, run.end_s)}" for run in answer.trends or ()]
    when = f" ({'; '.join(ranges)})" if ranges else ""
    moved_m = (answer.movement or {}).get("distance_m")
    path = f" it moved {moved_m:.3g} m" if isinstance(moved_m, float | int) else ""
    return (
        f"In {window}{when}{path}. {_events(answer.verdicts, answer.events, answer.run_id, most=2)}"
    )


def _events(
    verdicts: KindVerdicts | None,
    events: AnswerTable | None,
    run_id: int | None = None,
    from_s: float | None = None,
    most: int = _MOST_NAMED,
) -> str:
    """Return what was found, since when, what was not found, and what could not be searched."""
    if verdicts is None:
        return "Nothing was searched."
    kinds = verdict_of_kinds(verdicts)
    found = dict(verdicts.found or {})
    first_s = _first_begins(events)
    faults = _worst_first(filter(_is_fault, found))
    partly = set(_kinds_in(verdicts.not_searched or ()))
    before, said = list[str](), list[str]()
    for kind in faults:
        start_s, count = first_s.get(kind), found[kind]
        in_part = " (searched in part)" if kind in partly else ""
        if from_s is not None and start_s is not None and start_s < from_s and count == 1:
            before.append(f"{kind} since {start_s:.12g} s{in_part}")
        else:
            said.append(f"{_occurrences(kind, count, start_s)}{in_part}")
    noted = _noted(found, list(_rows(events)), run_id, with_ordinary=not faults)
    shown = {
        verdict: _worst_first(kind for kind in kinds if kinds[kind] == verdict)
        for verdict in ("not found", "none in the searched part", "cannot tell")
    }
    absent = [*filter(_is_fault, shown["not found"])] or shown["not found"]
    nearest = (verdicts.nearest or {}).get("condition")
    if nearest and "condition" in absent:
        absent.remove("condition")
    parts = [
        nearest or "",
        f"already going on at {from_s:.12g} s: {_listed(before, most)}"
        if before and from_s
        else "",
        f"found {_listed(said, most)}" if said else "",
        f"noted {_listed(noted, 2)}" if noted else "",
        f"not found: {_listed(absent, most)}" if absent else "",
        *(
            f"{verdict}: {_listed(shown[verdict], most)}"
            for verdict in ("none in the searched part", "cannot tell")
            if shown[verdict]
        ),
    ]
    text = "; ".join(part for part in parts if part) or "nothing in this range"
    return f"{text[0].upper()}{text[1:]}."


def verdict_of_kinds(verdicts: KindVerdicts) -> dict[str, str]:
    """Return the one verdict of each kind that was asked for."""
    made = dict.fromkeys(_kinds_in(verdicts.not_searched or ()), "cannot tell")
    in_part = [kind for kind in made if kind in verdicts.none_in_part]
    absent = _kinds_in([*(verdicts.nearest or ()), verdicts.not_found or ""])
    in_part += [kind for kind in absent if kind in made]
    made |= dict.fromkeys(absent, "not found") | dict.fromkeys(in_part, "none in the searched part")
    as_stuck = [kind for kind, why in (verdicts.nearest or {}).items() if why == AS_STUCK]
    made |= dict.fromkeys(as_stuck, AS_STUCK)
    return made | dict.fromkeys(verdicts.found or (), "found")


def _noted(
    found: Mapping[str, int],
    rows: Sequence[Mapping[str, Any]],
    run_id: int | None,
    *,
    with_ordinary: bool,
) -> list[str]:
    """Return what was noted: errors and failed commands first, and the rest if it fits."""
    logs = [row for row in rows if row.get("kind") == "log"]
    errors = sum(
        {"critical": 1, "error": 1}.get(str(row.get("name")), 0) * _times(row) for row in logs
    )
    failed = sum(
        _times(row) for row in rows
        if row.get("kind") == "command" and _detail(row, "status") in ("failed", "refused", "lost")
    )  # fmt: skip
    said = [_count(errors, "log error")] * bool(errors)
    said += [_count(failed, "failed command")] * bool(failed)
    if not with_ordinary:
        return said
    counts = {kind: found[kind] for kind in found if not _is_fault(kind)}
    if "log" in counts:
        counts["log"] -= errors
    if "command" in counts:
        counts["command"] -= failed
    for kind in sorted(counts, key=_NOTED_FIRST.index):
        if kind == "run":
            ends = [row for row in rows if row.get("kind") == "run"]
            if len(ends) == counts["run"]:
                runs = {row.get("run_id", run_id) for row in ends}
                said.append(f"{_count(len(runs), 'run')} that began or ended")
                continue
        if counts[kind] > 0:
            said.append(_count(counts[kind], *_NOUNS[kind]))
    return said


def _times(row: Mapping[str, Any]) -> int:
    return row.get("count") or 1


def _detail(row: Mapping[str, Any], name: str) -> Any:
    details = row.get("details")
    return cast("dict[str, Any]", details).get(name) if isinstance(details, dict) else None


def _kinds_in(texts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(kind for text in texts for kind in text.split(", ") if kind))


@cache
def _severities() -> dict[str, int]:
    from webots_mcp.judging.detection.event_kinds import KINDS

    return {kind.name: kind.severity for kind in KINDS}


def _is_fault(kind: str) -> bool:
    return _severities().get(kind, 0) > 0


def _worst_first(kinds: Iterable[str]) -> list[str]:
    return sorted(kinds, key=lambda kind: -_severities().get(kind, 0))


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
    counts = {outcome: len(each) for outcome, each in names.items()}
    counts = answer.counts or counts | {"pass": len(answer.passed or ())}
    parts = [
        f"{counts[outcome]} {words}" + _in_brackets(names.get(outcome, []), counts[outcome])
        for outcome, words in _OUTCOMES.items()
        if counts.get(outcome)
    ]
    parts.append(f"{counts.get('pass', 0)} passed")
    others = counts.get("not applicable", 0)
    parts.append(f"{others} not applicable" if others else "")
    said = f"Of the checks {', '.join(part for part in parts if part)}."
    expected = [
        f"{name} {_HELD.get(made.partition(':')[0], 'was not judged')}"
        for name, made in (answer.expected or {}).items()
    ]
    return f"{_listed(expected, 2)}. {said}" if expected else said


def _in_brackets(names: Sequence[str], count: int) -> str:
    """Name two of N items, some of which may not be shown."""
    if not names:
        return ""
    left = count - len(names[:2])
    return f" ({', '.join(names[:2])}{f' and {left} more' if left else ''})"


@_summary.register
def _(answer: TrialsAnswer) -> str:
    if answer.trial_set is None:
        return "No trials were started."
    over = f"{answer.over or 0} of {answer.trials or 0} trials are over"
    ranked = list(_rows(answer.ranked))
    best = ""
    if ranked and ranked[0].get("score") is not None:
        sure = "confirmed" if answer.is_best_confirmed else "not confirmed"
        best = f"; best: {_parameters(ranked[0])}, score {ranked[0]['score']} ({sure})"
    failed = [_parameters(row) for row in ranked if row.get("failed")]
    bad = f"; {answer.failed} failed ({_listed(failed, 2)})" if answer.failed else ""
    return f"Trial set {answer.trial_set}: {over}, {answer.state}{best}{bad}."


def _parameters(trial: Mapping[str, Any]) -> str:
    named = [f"{name} {value}" for name, value in trial.items() if name not in TRIAL_FIGURES]
    return _listed(named) or "no parameters"


@_summary.register
def _(answer: SqlAnswer) -> str:
    cut = "; some are missing" if answer.truncated else ""
    return f"{_count(len(list(_rows(answer.result))), 'row')}{cut}."


@_summary.register
def _(answer: RunsAnswer) -> str:
    if answer.run is not None:
        replaced = f" The {answer.hint}." if answer.hint else ""
        number = answer.run.get("run_id", answer.run_id)
        return f"Run {number} is annotated and will be kept.{replaced}"
    runs = list(_rows(answer.runs))
    if not runs:
        return "No run matches."
    newest = runs[0]
    total = _count(answer.total or len(runs), "run")
    bad = [_ended_badly(run) for run in runs[1:]]
    others = _listed([each for each in bad if each], 3)
    which = "newest" if answer.total in (None, len(runs)) else "first shown"
    of_newest = _ended_badly(newest) or f"run {newest.get('run_id')} {_end_of(newest)}"
    lasted_s = newest.get("duration_s")
    lasts = f" after {lasted_s:.12g} s" if isinstance(lasted_s, float | int) else ""
    return f"{total}; {which}: {of_newest}{lasts}{f'; {others}' if others else ''}."


def _end_of(run: Mapping[str, Any]) -> str:
    ended = run.get("ended_by")
    return _ENDINGS.get(ended, f"ended by {ended}") if ended else "goes on"


def _ended_badly(run: Mapping[str, Any]) -> str:
    """Return what needs attention in a run; empty if nothing does."""
    notable = run.get("notable")
    counted: dict[str, int] = {}
    if isinstance(notable, dict):
        counted = cast("dict[str, int]", notable)
    bad = [
        f"{count} {name}"
        for name, count in counted.items()
        if name in ("log critical", "log error", "command failed", "dropped")
    ]
    crashed = run.get("ended_by") == "crashed"
    if not crashed and not bad:
        return ""
    said = f"run {run.get('run_id')} {_end_of(run)}"
    return f"{said} ({', '.join(bad)})" if bad else said


@_summary.register
def _(answer: RerunAnswer) -> str | None:
    return answer.verdict


@_summary.register
def _(answer: ComparisonAnswer) -> str | None:
    if answer.verdict is not None:
        return _first_difference(answer)
    if answer.score is not None:
        return _development(answer)
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


def _development(answer: ComparisonAnswer) -> str:
    """Return how the score of many runs developed, and which run was best."""
    scored, curve = answer.scored or {}, list(_rows(answer.curve))
    runs, known = scored.get("runs", 0), scored.get("score", 0)
    of_runs = _count(runs, "run") if known == runs else f"{known} of {_count(runs, 'run')}"
    best = next(iter(_rows(answer.best_runs)), None)
    if not known:
        reason = next(iter(answer.unscored or ()), "no reason is known")
        return f"None of {_count(runs, 'run')} has a score: {reason}."
    parts = [f"Score of {of_runs}: {answer.trend}"]
    parts.append(
        f"best {'scored ' * (known < runs)}run {best['run_id']} ({best['score']})" if best else ""
    )
    counts = [row.get("scored") or 0 for row in curve]
    reached = [
        row["goal_percent"]
        for row, count in zip(curve, counts, strict=True)
        if row.get("goal_percent") is not None and 2 * count >= max(counts)
    ]
    if len(reached) > 1:
        parts.append(
            f"goal reached in {reached[0]:.12g} % of the first, {reached[-1]:.12g} % of the "
            "last runs"
        )
    return f"{'; '.join(part for part in parts if part)}."


def _first_difference(answer: ComparisonAnswer) -> str:
    """Return where two runs diverge, and what was different before they began."""
    compared, parted = answer.compared or {}, list(_rows(answer.diverging))
    begun = [name for name in answer.different_before or () if name != "began_by"]
    before = f"The runs were started differently ({_listed(begun)}). " if begun else ""
    if not compared.get("row_count") or not compared.get("signal_count"):
        return f"{before}Cannot tell: no row of one run could be compared with one of the other."
    if not parted:
        rows = _count(compared["row_count"], "compared row")
        signals = _count(compared["signal_count"], "signal")
        return f"{before}Identical in {rows} of {signals}, up to {compared['end_s']:.12g} s."
    first_s = parted[0].get("start_s")
    first = [_name(row) for row in parted if row.get("start_s") == first_s]
    is_at_once = first_s is None or first_s == compared.get("start_s")
    when = "from the first compared row on"
    if not is_at_once:
        when = f"from {first_s:.12g} s on, and are identical before"
    return f"{before}The runs differ in {_listed(first)} {when}."


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
    """Return whether a figure, or its spread, is different in any group, or in none."""
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
    old = (
        f" (data {age_in_words(age)} old)" if age is not None and answer.status == "running" else ""
    )
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
