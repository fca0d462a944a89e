"""The opening of a chapter: what happened in a sentence, the outcome and a timeline of the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

from webots_mcp.judging.checks.check import Finding, Outcome
from webots_mcp.judging.checks.check_run import CHECKS, UNDERSTOOD, CheckedRun
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_kinds import KINDS
from webots_mcp.plugins.report.words import (
    capitalised,
    counted,
    cut,
    describe_event,
    length,
    time_at,
)
from webots_mcp.store.runs import RunInfo

MOMENTS: Final = 3
CRASH: Final = "crash"  # the end of a run whose controller crashed, as an event
# How bad events are that are no kinds of their own, on the scale of `EventKind.severity`.
_SEVERITIES: Final[Mapping[str, int]] = MappingProxyType(
    {CRASH: 100, "error": 95, "breakpoint": 75, "warning": 25}
)
# What checks without kinds of events are about, or what counts of their kinds.
_ENDS_WELL: Final = "ends well"
_KINDS_OF_CHECKS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {_ENDS_WELL: (CRASH,), "logs no errors": ("error",), "keeps expectations": ("violation",)}
)
_ALWAYS_FIRST: Final = (CRASH, "fall")
_OF_FAILED_CHECK, _OF_WARNING, _OTHER = range(3)  # severities, the worst first
_MOST_LANES: Final = 8
_MOST_MODES: Final = 4  # values of a mode that have a lane
_LEAST_PERCENT: Final = 0.4  # width of a mark, so that it can be seen
_LONGEST_EVIDENCE: Final = 200
_LONGEST_REASON: Final = 240
_JUDGED_BADLY: Final[Mapping[Outcome, int]] = MappingProxyType(
    {"fail": _OF_FAILED_CHECK, "warn": _OF_WARNING}
)
# A word and a sign for each outcome: neither needs colours.
_SIGNS: Final[Mapping[Outcome, tuple[str, str]]] = MappingProxyType(
    {
        "fail": ("✕", "Failed"),
        "warn": ("!", "Passed with warnings"),
        "pass": ("✓", "Passed"),
    }
)


_ENDED: Final[Mapping[str, str]] = MappingProxyType(
    {
        "finished": "its controller finished",
        "reset": "was ended by a reset",
        "reload": "was ended by a reload",
        "crashed": "its controller crashed",
    }
)


class FoundFault(NamedTuple):
    """A check that found something: sign, outcome, name, evidence, and the class of its colour."""

    sign: str
    outcome: str
    name: str
    evidence: str
    mark: str


class Badge(NamedTuple):
    """The outcome of a run: a sign, words and the class of its colour."""

    sign: str
    words: str
    mark: str


class TimelineMark(NamedTuple):
    """A mark of the timeline: start and width in percent of the run, and what it is."""

    start_percent: float
    width_percent: float
    title: str
    anchor: str


class ModeInterval(NamedTuple):
    """An interval in which a mode had one value."""

    value: str
    start_s: float
    end_s: float


class TimelineLane(NamedTuple):
    """The marks of one kind of events, or of one value of a mode."""

    name: str
    marks: Sequence[TimelineMark]
    is_mode: bool = False


@dataclass(frozen=True)
class Opening:
    """What stands first in a chapter.

    Attributes:
        happened: A sentence on what happened.
        found: Checks that found something, the most important first.
        passed: The checks that passed, in a sentence.
        unjudged: What could not be judged and what to do about it, in one paragraph.
        lanes: The timeline of the run.
        duration_s: What the timeline covers.
    """

    badge: Badge
    happened: str
    found: Sequence[FoundFault]
    passed: str
    unjudged: str
    lanes: Sequence[TimelineLane]
    start_s: float
    duration_s: float


def opening_of(
    info: RunInfo,
    checked: CheckedRun,
    start_s: float,
    events: Sequence[Event] = (),
    moments: Sequence[Event] = (),
    modes: Sequence[ModeInterval] = (),
) -> Opening:
    """Return the opening of a run.

    Args:
        info: The run.
        checked: Its checks.
        start_s: Simulation time at which it began.
        events: Events that matter, one by one.
        moments: Those that are shown as moments, which marks of the timeline link to.
        modes: What its mode was, and when.
    """
    bad = sorted(checked.of("fail", "warn"), key=_check_importance)
    sign, words = _SIGNS.get(checked.outcome, ("?", "Not judged"))
    mark = {"fail": "error", "warn": "warning", "pass": "good"}.get(checked.outcome, "")
    return Opening(
        Badge(sign, words, mark),
        _happened(info, bad),
        _found(bad),
        _passed(checked),
        _unjudged(checked),
        [
            *_lanes_of_modes(modes, start_s, info.duration_s),
            *_lanes(events, moments, info.run_id, start_s, info.duration_s),
        ],
        start_s,
        info.duration_s,
    )


def most_important(
    events: Sequence[Event], checked: CheckedRun | None = None, most: int = MOMENTS
) -> list[Event]:
    """Return the few events that matter most, in the order of time.

    A crash and falls come first, then events of checks that failed, then of checks that warned,
    then others. Equal ones come by the severity of their kinds, of one kind first the one that a
    check names, then the longest. Each kind has one event before any has a second.
    """
    bad = checked.of("fail", "warn") if checked is not None else []
    ranked = sorted(
        events,
        key=lambda each: (
            _severity(each, bad),
            -_importance(event_name(each)),
            each.start_s not in [finding.since_s for finding in bad],
            -each.duration_s,
            each.start_s,
        ),
    )
    seen: dict[str, int] = {}
    rounds: list[tuple[int, int]] = []
    for place, event in enumerate(ranked):
        name = event_name(event)
        seen[name] = seen.get(name, 0) + 1
        rounds.append((seen[name], place))
    chosen = [ranked[place] for _, place in sorted(rounds)[:most]]
    return sorted(chosen, key=lambda each: each.start_s)


def event_name(event: Event) -> str:
    """Return the kind of an event; of a log line its level, of a bridge event what it is."""
    if event.kind == "log":
        return "error" if event.name == "critical" else event.name or event.kind
    what = event.details.get("what") if event.kind == "bridge_event" else None
    return str(what) if what in _SEVERITIES else event.kind


def _severity(event: Event, bad: Sequence[Finding]) -> int:
    """Return how bad an event is by what the checks made of it."""
    if event.kind in _ALWAYS_FIRST:
        return -1
    if event_name(event) in ("error", "violation"):
        return _OF_FAILED_CHECK
    kinds = {check.name: check.kinds for check in CHECKS}
    outcomes = [
        _JUDGED_BADLY[each.outcome]
        for each in bad
        if event.kind in kinds.get(each.name, ()) and event.name in (each.signals or (event.name,))
    ]
    return min(outcomes, default=_OTHER)


def _importance(name: str) -> int:
    """Return how bad what has this name is: the higher the worse."""
    own = {kind.name: kind.severity for kind in KINDS}
    return _SEVERITIES.get(name, own.get(name, 0))


def _check_importance(finding: Finding) -> tuple[int, int]:
    """Return the place of a check that found something: by outcome, then by its kinds of events."""
    kinds = next((check.kinds for check in CHECKS if check.name == finding.name), ())
    kinds = _KINDS_OF_CHECKS.get(finding.name, kinds)
    return _JUDGED_BADLY[finding.outcome], -max(map(_importance, kinds), default=0)


def _happened(info: RunInfo, bad: Sequence[Finding]) -> str:
    reason = info.end_reason
    ended = _ENDED.get(reason, f"ended: {reason}") if reason else "is still running"
    first = f"{info.robot} ran for {length(info.duration_s)} and {ended}."
    if not bad:
        return f"{first} No check found anything wrong."
    # How it ended was just said.
    lead = next((each for each in bad if each.name != _ENDS_WELL), bad[0])
    more = [each.name for each in bad if each is not lead]
    also = f" {counted(len(more), 'more check')} found something: {', '.join(more)}."
    return f"{first} {_sentence(lead)}{also if more else ''}"


def _sentence(finding: Finding) -> str:
    """Return the evidence of a check as a sentence, with when it began."""
    evidence = cut(finding.evidence, _LONGEST_EVIDENCE).rstrip(".")
    first_word = evidence.partition(" ")[0].rstrip(":,")
    if first_word.isalpha() and first_word not in finding.signals:  # else it is a signal's name
        evidence = capitalised(evidence)
    since_s = finding.since_s
    if since_s is None or f"at {since_s:.4g} s" in evidence:
        return f"{evidence}."
    return f"{evidence}. First at {time_at(since_s)} s."


def _found(bad: Sequence[Finding]) -> list[FoundFault]:
    return [
        FoundFault(
            _SIGNS[each.outcome][0],
            "failed" if each.outcome == "fail" else "warning",
            each.name,
            _sentence(each),
            "error" if each.outcome == "fail" else "warning",
        )
        for each in bad
    ]


def _passed(checked: CheckedRun) -> str:
    passed = [each.name for each in checked.of("pass")]
    if not passed:
        return "No check passed."
    return f"{counted(len(passed), 'check')} passed: {', '.join(passed)}."


def _unjudged(checked: CheckedRun) -> str:
    """Return what could not be judged, why, and the call that declares what signals mean."""
    unjudged = checked.of("not judged", "not looked at", "not applicable")
    if not unjudged:
        return ""
    absent = [each.name for each in unjudged if each.outcome == "not applicable"]
    named = [
        f"{each.name} ({cut(each.evidence, _LONGEST_REASON)})"
        for each in unjudged
        if each.name not in absent
    ]
    named += [f"{', '.join(absent)} (nothing to judge was recorded)"] if absent else []
    said = f"{counted(len(unjudged), 'check')} could not be judged: {'; '.join(named)}."
    unknown = [each.more for each in unjudged if each.name == UNDERSTOOD and each.more]
    return f"{said} To declare what a signal means: {unknown[0]}." if unknown else said


def _lanes(
    events: Sequence[Event],
    moments: Sequence[Event],
    run_id: int,
    start_s: float,
    duration_s: float,
) -> list[TimelineLane]:
    """Return the kinds of events that matter most, with where in the run they were."""
    if duration_s <= 0:
        return []
    by_kind: dict[str, list[Event]] = {}
    for event in sorted(events, key=lambda each: -_importance(event_name(each))):
        by_kind.setdefault(event_name(event), []).append(event)
    anchors = {id(event): f"moment-{run_id}-{number}" for number, event in enumerate(moments)}
    places = {(each.kind, each.name, each.start_s): anchors[id(each)] for each in moments}
    lanes: list[TimelineLane] = []
    for kind, found in list(by_kind.items())[:_MOST_LANES]:
        marks: list[TimelineMark] = []
        for event in found:
            left, width = _percent(event.start_s, event.end_s, start_s, duration_s)
            title = f"{time_at(event.start_s)} s: {cut(describe_event(event), 120)}"
            anchor = places.get((event.kind, event.name, event.start_s), "")
            marks.append(TimelineMark(left, width, title, anchor))
        lanes.append(TimelineLane(f"{kind.replace('_', ' ')} ({len(found)})", marks))
    return lanes


def _lanes_of_modes(
    modes: Sequence[ModeInterval], start_s: float, duration_s: float
) -> list[TimelineLane]:
    """Return the values that a mode had for longest, with when it had them."""
    if duration_s <= 0:
        return []
    by_value: dict[str, list[ModeInterval]] = {}
    for interval in modes:
        by_value.setdefault(interval.value, []).append(interval)
    longest = sorted(by_value.items(), key=lambda each: -sum(i.end_s - i.start_s for i in each[1]))
    return [
        TimelineLane(
            cut(value, 40),
            [
                TimelineMark(
                    *_percent(each.start_s, each.end_s, start_s, duration_s),
                    f"{time_at(each.start_s)} to {time_at(each.end_s)} s: {cut(value, 40)}",
                    "",
                )
                for each in held
            ],
            is_mode=True,
        )
        for value, held in longest[:_MOST_MODES]
    ]


def _percent(
    begins_s: float, ends_s: float, start_s: float, duration_s: float
) -> tuple[float, float]:
    """Return start and width of an interval in percent of the run, wide enough to be seen."""
    left = min(max((begins_s - start_s) / duration_s, 0.0), 1.0) * 100
    left = min(left, 100 - _LEAST_PERCENT)
    width = 100 * (ends_s - begins_s) / duration_s
    return left, min(max(width, _LEAST_PERCENT), 100 - left)
