"""The opening of a chapter: what happened in a sentence, the outcome and a timeline of the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

from webots_mcp.judging.checks import CheckedRun
from webots_mcp.judging.checks.finding import Finding, Outcome
from webots_mcp.judging.detection.events import kind_named
from webots_mcp.judging.detection.kinds import Event
from webots_mcp.plugins.report.grid import Grid, GridRow
from webots_mcp.plugins.report.words import counted, cut, describe_event, length, time_at
from webots_mcp.store.runs import RunInfo

MOMENTS: Final = 3
_LOGGED_SEVERITY: Final = 95  # of a logged error: above that of every kind
_MOST_LANES: Final = 8
_LEAST_PERCENT: Final = 0.4  # width of a mark, so that it can be seen
_LONGEST_EVIDENCE: Final = 200
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


class TimelineLane(NamedTuple):
    """The marks of one kind of events, or of one value of a mode."""

    name: str
    events: int
    marks: Sequence[TimelineMark]


@dataclass(frozen=True)
class Opening:
    """What stands first in a chapter.

    Attributes:
        happened: A sentence on what happened.
        found: Checks that found something, with evidence; None if there is none.
        passed: The checks that passed, in a sentence.
        unjudged: What could not be judged and what to do about it, in sentences.
        lanes: The timeline of the run.
        duration_s: What the timeline covers.
    """

    badge: Badge
    happened: str
    found: Grid | None
    passed: str
    unjudged: Sequence[str]
    lanes: Sequence[TimelineLane]
    start_s: float
    duration_s: float


def opening_of(
    info: RunInfo,
    checked: CheckedRun,
    start_s: float,
    events: Sequence[Event] = (),
    moments: Sequence[Event] = (),
) -> Opening:
    """Return the opening of a run.

    Args:
        info: The run.
        checked: Its checks.
        start_s: Simulation time at which it began.
        events: Events that matter, one by one.
        moments: Those that are shown as moments, which marks of the timeline link to.
    """
    bad = [each for each in checked.worst_first if each.outcome in ("fail", "warn")]
    sign, words = _SIGNS.get(checked.outcome, ("?", "Not judged"))
    mark = {"fail": "error", "warn": "warning", "pass": "good"}.get(checked.outcome, "")
    return Opening(
        Badge(sign, words, mark),
        _happened(info, bad),
        _found(bad),
        _passed(checked),
        _unjudged(checked),
        _lanes(events, moments, info.run_id, start_s, info.duration_s),
        start_s,
        info.duration_s,
    )


def most_important(events: Sequence[Event], most: int = MOMENTS) -> list[Event]:
    """Return the few events that matter most, in the order of time.

    Kinds come in the order of their severity; of one kind the longest first. Each kind has one
    event before any has a second.
    """
    ranked = sorted(events, key=lambda each: (-_importance(each), -each.duration_s, each.start_s))
    seen: dict[str, int] = {}
    rounds: list[tuple[int, int]] = []
    for place, event in enumerate(ranked):
        seen[event.kind] = seen.get(event.kind, 0) + 1
        rounds.append((seen[event.kind], place))
    chosen = [ranked[place] for _, place in sorted(rounds)[:most]]
    return sorted(chosen, key=lambda each: each.start_s)


def _importance(event: Event) -> int:
    """Return how bad an event is: the severity of its kind; errors that were logged come first."""
    if event.kind == "log":
        return _LOGGED_SEVERITY if event.name in ("error", "critical") else 0
    return kind_named(event.kind).severity


def _happened(info: RunInfo, bad: Sequence[Finding]) -> str:
    reason = info.end_reason
    ended = _ENDED.get(reason, f"ended: {reason}") if reason else "is still running"
    first = f"{info.robot} ran for {length(info.duration_s)} and {ended}."
    if not bad:
        return f"{first} No check found anything wrong."
    worst = bad[0]
    word = {"fail": "Failed", "warn": "Warning"}[worst.outcome]
    more = "" if len(bad) == 1 else f" {counted(len(bad) - 1, 'more check')} found something."
    return f"{first} {word}: {cut(worst.evidence, _LONGEST_EVIDENCE)} ({worst.name}).{more}"


def _found(bad: Sequence[Finding]) -> Grid | None:
    rows = [
        GridRow(
            [
                each.name,
                each.outcome,
                each.evidence,
                "" if each.since_s is None else time_at(each.since_s),
                str(each.often or ""),
            ],
            {"fail": "error", "warn": "warning"}[each.outcome],
        )
        for each in bad
    ]
    return Grid(("check", "outcome", "evidence", "since [s]", "times"), rows) if rows else None


def _passed(checked: CheckedRun) -> str:
    passed = [each.name for each in checked.of("pass")]
    if not passed:
        return "No check passed."
    return f"{counted(len(passed), 'check')} passed: {', '.join(passed)}."


def _unjudged(checked: CheckedRun) -> list[str]:
    said = [
        f"{each.name}: not judged, {each.evidence}."
        for each in checked.of("not judged", "not looked at")
    ]
    if absent := [each.name for each in checked.of("not applicable")]:
        said.append(f"Does not apply to what was recorded: {', '.join(absent)}.")
    return said


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
    for event in sorted(events, key=_importance, reverse=True):
        by_kind.setdefault(event.kind, []).append(event)
    anchors = {id(event): f"moment-{run_id}-{number}" for number, event in enumerate(moments)}
    places = {(each.kind, each.name, each.start_s): anchors[id(each)] for each in moments}
    lanes: list[TimelineLane] = []
    for kind, found in list(by_kind.items())[:_MOST_LANES]:
        marks: list[TimelineMark] = []
        for event in found:
            left = min(max((event.start_s - start_s) / duration_s, 0.0), 1.0) * 100
            width = min(max(100 * event.duration_s / duration_s, _LEAST_PERCENT), 100.0 - left)
            title = f"{time_at(event.start_s)} s: {cut(describe_event(event), 120)}"
            anchor = places.get((event.kind, event.name, event.start_s), "")
            marks.append(TimelineMark(left, max(width, _LEAST_PERCENT), title, anchor))
        lanes.append(TimelineLane(kind.replace("_", " "), len(found), marks))
    return lanes
