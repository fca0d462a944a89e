"""The chapter of a report about one run: what ran, what happened and what was recorded."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from webots_mcp.contract import INSPECTION_EVENT, MODE_EVENT, WORLD_EVENT
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.checks.check_run import CheckedRun, check_run
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_kinds import KINDS, stored_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Found, search_events
from webots_mcp.judging.trends import RunTrends, StateTrend, Trend, trends
from webots_mcp.judging.verdicts import AS_STUCK, Verdicts
from webots_mcp.plotting.intervals import at_resolution, lane_of
from webots_mcp.plotting.plotted_runs import plotted_runs
from webots_mcp.plugins.report.chapter_opening import (
    CRASH,
    MOMENTS,
    ModeInterval,
    Opening,
    event_name,
    most_important,
    opening_of,
)
from webots_mcp.plugins.report.controller_variables import ShownVariables, shown_variables
from webots_mcp.plugins.report.tables import Grid, GridRow
from webots_mcp.plugins.report.words import (
    capitalised,
    clock,
    counted,
    cut,
    describe_event,
    format_named_values,
    format_signal_values,
    format_value,
    length,
    number,
    pace_text,
    share,
    time_at,
)
from webots_mcp.signals.naming import find_mode
from webots_mcp.store.inspections import Inspection, inspections_of
from webots_mcp.store.logs import (
    COUNT_LIMIT,
    LogFilter,
    LogLine,
    LogWindow,
    count_lines,
    newest_lines,
)
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.run_parameters import described
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import RunInfo, run_info
from webots_mcp.store.sessions import SessionRecord, fetch_session

_CLOCK_UNITS: Final = frozenset({"s", "ms", "us", "µs", "ns", "min"})
_CLOCK_NAMES: Final = frozenset({"t", "time", "timestamp", "clock", "elapsed", "step", "steps"})
_MARKS: Final = {"warning": "warning", "error": "error", "critical": "error"}
# Fractions of the bytes of texts. What a table leaves unused goes to the next ones.
_SHARES: Final = {
    "checks": 0.05, "parameters": 0.05, "moments": 0.1, "events": 0.15, "trends": 0.15,
    "commands": 0.1, "timeline": 0.2, "log": 0.2,
}  # fmt: skip


@dataclass(frozen=True)
class _ChapterLimits:
    """Limits of the texts of a run."""

    events: int = 200
    timeline_entries: int = 500
    log_lines: int = 2_000
    around_s: float = 5.0
    """Time that is shown before and after such an event."""
    event_s: float = 30.0
    """Time that is shown of the event itself."""
    context_lines: int = 12
    """Entries of the timeline around an event."""
    mode_values: int = 20
    """Values of a mode."""
    timeline_steps: int = 400
    """Steps of time in which the timeline shows a mode."""
    moment_signals: int = 4
    """Signals that are drawn with a moment."""
    clock_fit: float = 0.999
    """Share of its variance that a straight line explains, from which on a time is a clock."""


_LIMITS: Final = _ChapterLimits()

_ORDINARY: Final = ("pause", "resume", WORLD_EVENT, MODE_EVENT, INSPECTION_EVENT)
"""Events of the bridge that need no context."""


class ModeShare(NamedTuple):
    """How long a mode had a value: the value, its time and its percentage."""

    value: str
    time: str
    percent: float


@dataclass(frozen=True)
class EventContext:
    """An event with the seconds around it.

    Attributes:
        signals: Signals that show it, the most telling first.
        values: Values of a few signals at its start.
        lines: Entries of the timeline around it.
        variables: What the controller's own variables held then; None where none were recorded.
    """

    event: Event
    title: str
    says: str
    values: str
    lines: Grid
    signals: Sequence[str] = ()
    variables: ShownVariables | None = None

    @property
    def start_s(self) -> float:
        """Return the start of the shown time."""
        return self.event.start_s - _LIMITS.around_s

    @property
    def end_s(self) -> float:
        """Return the end of the shown time. Of a long event only the start is shown."""
        return min(self.event.end_s, self.event.start_s + _LIMITS.event_s) + _LIMITS.around_s


@dataclass(frozen=True)
class Chapter:
    """One run. A table that would be empty is None.

    Attributes:
        opening: What happened, the outcome and the timeline.
        checked: What became of each check.
        range: The whole run; None if it has no state row.
        numbers: Number of numeric signals with values.
        changed_most: Names of signals that changed, the largest change first.
        found: Events in values and stored events, one by one.
        images: Events of pictures.
        findings: Sentences on what was found, and what was not.
        unsearched: Notes on what was not searched, or not everywhere, and why.
    """

    info: RunInfo
    range: TimeRange | None
    title: str
    summary: str
    opening: Opening
    checked: CheckedRun
    facts: Mapping[str, str]
    findings: Sequence[str] = ()
    unsearched: Sequence[str] = ()
    mode: str = ""
    held: Sequence[ModeShare] = ()
    moments: Sequence[EventContext] = ()
    checks: Grid | None = None
    parameters: Grid | None = None
    events: Grid | None = None
    trends: Grid | None = None
    commands: Grid | None = None
    timeline: Grid | None = None
    log: Grid | None = None
    numbers: int = 0
    changed_most: Sequence[str] = ()
    found: Found | None = None
    images: Sequence[Event] = ()
    notes: Sequence[str] = ()

    @property
    def grids(self) -> dict[str, Grid]:
        """Return the tables that may lack rows, by what their rows are called."""
        named = {
            "checks": self.checks, "parameters": self.parameters, "events": self.events,
            "trends": self.trends,
            "commands": self.commands, "entries of the timeline": self.timeline,
            "log lines": self.log,
        }  # fmt: skip
        return {name: grid for name, grid in named.items() if grid is not None}


class _TextBudget:
    """The bytes for the texts of a run, which its tables share in order."""

    def __init__(self, budget_bytes: float) -> None:
        self._budget_bytes, self._spare_bytes = budget_bytes, 0.0

    def fit(self, name: str, grid: Grid, *, newest: bool = False) -> Grid | None:
        """Return a table with as many rows as fit; None if it is empty."""
        budget_bytes = _SHARES[name] * self._budget_bytes + self._spare_bytes
        fitted = grid.within(budget_bytes, newest=newest)
        self._spare_bytes = budget_bytes - sum(row.size_bytes for row in fitted.rows)
        return fitted if fitted.rows or fitted.left_out else None


def chapter_of(
    connection: sqlite3.Connection, run_id: int, budget_bytes: float, deadline_s: float
) -> Chapter:
    """Make the chapter of a run.

    Args:
        connection: Connection to the recording.
        run_id: Id of the run.
        budget_bytes: Approximate size of its texts.
        deadline_s: Time limit of the search for events in values. Trends and stored events have a
            third of it each. The chapter says what was not searched in time.

    Raises:
        UnknownRunError: The run does not exist.
    """
    run, info = fetch_run(connection, run_id), run_info(connection, run_id)
    session = fetch_session(connection, run.session_id)
    budget = _TextBudget(budget_bytes)
    facts = _facts(info, session, run.basic_time_step_ms)
    title = f"Run {run_id} of {info.robot}" + (f": {info.label}" if info.label else "")
    newer = _failed_start_after(connection, session)
    try:
        whole = find_range(connection, Scope(run_id=run_id))
    except NothingRecordedError as error:  # The run has no state row.
        checked = check_run(connection, run_id, deadline_s=deadline_s / 2)
        return Chapter(
            info, None, title,
            summary=f"{_first_words(info)} {error}.",
            opening=opening_of(info, checked, run.started_sim_time_s),
            checked=checked,
            facts=facts,
            checks=budget.fit("checks", _checks(checked)),
            parameters=budget.fit("parameters", _parameters(connection, run_id)),
            log=budget.fit("log", _log(connection, run_id), newest=True),
            notes=newer,
        )  # fmt: skip
    each_alone = _found(connection, whole, deadline_s)
    checked = check_run(connection, run_id, found=each_alone, deadline_s=deadline_s / 2)
    checks = budget.fit("checks", _checks(checked))
    parameters = budget.fit("parameters", _parameters(connection, run_id))
    found = each_alone.in_groups(known_signals(connection, whole))
    stored = _stored(connection, whole, deadline_s / 3)
    matter = [*_crash(info, run.last_sim_time_s), *_that_matter(each_alone)]
    outstanding = _outstanding(connection, each_alone, matter, checked)
    inspections = inspections_of(connection, run_id)
    moments = [_moment(each, stored, each_alone.verdicts, inspections) for each in outstanding]
    course = trends(connection, whole, limit=500, deadline_s=deadline_s / 3)
    (run_trends,) = course.runs
    mode = _mode(run_trends)
    modes = _mode_intervals(connection, whole, mode.name, deadline_s / 6) if mode else []
    opening = opening_of(info, checked, run.started_sim_time_s, matter, outstanding, modes)
    travelled, why_not = _travelled(connection, run_id)
    return Chapter(
        info, whole, title,
        summary=_first_words(info),
        opening=opening,
        checked=checked,
        facts=facts,
        findings=[*travelled, *_findings(found.verdicts)],
        unsearched=[f"{kinds}: {why}" for kinds, why in found.verdicts.gaps.items()],
        mode=mode.name if mode else "",
        held=_mode_shares(mode) if mode else (),
        moments=moments,
        checks=checks,
        parameters=parameters,
        events=budget.fit("events", _events(connection, found)),
        trends=budget.fit("trends", _trends(run_trends)),
        commands=budget.fit("commands", _commands(connection, stored), newest=True),
        timeline=budget.fit("timeline", _timeline(connection, stored), newest=True),
        log=budget.fit("log", _log(connection, run_id), newest=True),
        numbers=run_trends.total,
        changed_most=_changed(run_trends),
        found=each_alone,
        images=[each for each in stored.events if each.kind == "image"],
        notes=tuple(
            dict.fromkeys((*newer, *found.notes, *course.notes, *_unread(run_trends), *why_not))
        ),
    )  # fmt: skip


def _changed(run_trends: RunTrends) -> list[str]:
    """Return the signals that changed, the most first, without clocks."""
    return [
        each.name for each in run_trends.numbers if each.shape != "constant" and not is_clock(each)
    ]


def _unread(course: RunTrends) -> list[str]:
    """Return a note if modes and trends are not those of all rows."""
    if course.cut_at_s is None:
        return []
    since = time_at(course.cut_at_s)
    return [f"modes and trends are those of what was read in time: not all was from {since} s on"]


def _first_words(info: RunInfo) -> str:
    world = f" in {_file(info.world)}" if info.world else ""
    ended = f"It ended: {info.end_reason}." if info.end_reason else "It goes on."
    pace = info.real_time_factor
    how_fast = f", {pace_text(pace)}" if pace is not None else ""
    return (
        f"{info.robot} ran for {length(info.duration_s)} of simulation time{world}, from "
        f"{clock(info.started_wall_time_s)} on{how_fast}. {ended}"
    )


def _facts(info: RunInfo, session: SessionRecord | None, step_ms: float | None) -> dict[str, str]:
    """Return facts in the rows of run and session, without unknown ones."""
    facts: dict[str, object] = {
        "robot": info.robot,
        "run": f"{info.run_id} (session {info.session_id})",
        "label": info.label,
        "note": info.note,
        "controller": info.controller,
        "SHA-256 of its file": info.controller_sha256,
        "git commit": info.git_commit,
        "world": info.world,
        "basic time step": f"{step_ms:g} ms" if step_ms else None,
        "began": f"{clock(info.started_wall_time_s)}, by {info.start_reason}",
        "ended": info.end_reason or "it goes on",
        "simulation time": length(info.duration_s),
        "wall time": length(info.wall_duration_s)
        + (f", of which {length(info.held_s)} paused by a command" if info.held_s else ""),
        "rows": f"{info.row_count:,}"
        + (f" ({info.purged_rows:,} of them purged since)" if info.purged_rows else ""),
        "needs attention": format_named_values(info.notable) or None,
    }
    if session is not None:
        facts |= {
            "host": session.host,
            "supervisor": "yes" if session.supervisor else "no",
            "versions": format_signal_values(session.versions) or None,
            "end of the controller": session.end_reason,
            "newest error of the recorder": session.last_error,
            "rows dropped": session.rows_dropped or None,
        }
    return {name: cut(str(fact), 4_000) for name, fact in facts.items() if fact is not None}


def _failed_start_after(
    connection: sqlite3.Connection, session: SessionRecord | None
) -> tuple[str, ...]:
    """Return a note if a controller was started later and recorded nothing."""
    if session is None:
        return ()
    found = connection.execute(
        "SELECT started_wall_time_s, coalesce(end_reason, last_error) FROM session s "
        "WHERE robot_id = ? AND id > ? "
        "AND NOT EXISTS (SELECT 1 FROM run r WHERE r.session_id = s.id) ORDER BY id DESC LIMIT 1",
        (session.robot_id, session.id),
    ).fetchone()
    if found is None:
        return ()
    why = f" ({cut(str(found[1]), 200)})" if found[1] else ""
    return (f"A newer start of this controller, at {clock(found[0])}, recorded no run{why}.",)


def _checks(checked: CheckedRun) -> Grid:
    """Return each check, the worst first."""
    rows: list[GridRow] = []
    for each in checked.worst_first:
        since = "" if each.since_s is None else time_at(each.since_s)
        cells = [each.name, each.outcome, each.evidence, since, str(each.often or "")]
        rows.append(GridRow(cells, {"fail": "error", "warn": "warning"}.get(each.outcome, "")))
    return Grid(("check", "outcome", "evidence", "since [s]", "times"), rows)


def _parameters(connection: sqlite3.Connection, run_id: int) -> Grid:
    columns = ("name", "value", "unit", "default", "set_by", "since_s", "doc")
    rows = [
        GridRow([_text(each[column]) for column in columns])
        for each in described(connection, fetch_run(connection, run_id))
    ]
    return Grid(("parameter", "value", "unit", "default", "set by", "since [s]", "what"), rows)


def _found(connection: sqlite3.Connection, whole: TimeRange, deadline_s: float) -> Found:
    """Search the kinds of events that are searched by default, except routine ones."""
    usual = EventOptions()
    kinds = tuple(
        kind.name for kind in KINDS if kind.usual(usual) and kind.counted and not kind.routine
    )
    options = EventOptions(kinds=kinds)
    return search_events(connection, whole, options, group=False, deadline_s=deadline_s)


def _stored(connection: sqlite3.Connection, whole: TimeRange, deadline_s: float) -> Found:
    """Return the events that were stored when they happened, one by one."""
    options = EventOptions(kinds=stored_kinds(), log_level="info")
    return search_events(connection, whole, options, around=(), group=False, deadline_s=deadline_s)


def _findings(verdicts: Verdicts) -> list[str]:
    """Return sentences on the kinds of events that were found, and that were not."""
    found = [f"{kind} ({count})" for kind, count in verdicts.found.items()]
    said = [f"Found: {', '.join(found)}."] if found else []
    said += [f"Searched and not found: {', '.join(verdicts.far)}."] if verdicts.far else []
    said += [
        f"Not found: {kind}. Nearest: {what}."
        for kind, what in verdicts.nearest.items()
        if what != AS_STUCK
    ]
    return said


def _events(connection: sqlite3.Connection, found: Found) -> Grid:
    """Return events. Commands that were done have their own table."""
    matter = [each for each in found.events if each.kind != "command" or _mark(each)]
    answer = found.only(matter).page(connection, _LIMITS.events)
    rows = [
        GridRow(
            [time_at(each.start_s), _lasted(each), each.kind, describe_event(each), _around(each)],
            _mark(each),
        )
        for each in answer.events
    ]
    left_out = sum(each.count for each in answer.left_out.values())
    columns = ("from [s]", "for [s]", "kind", "what", "values when it began")
    return Grid(columns, rows, left_out=left_out)


def _that_matter(found: Found) -> list[Event]:
    """Return the events that are no routine: those in values, warnings, and what failed."""
    matter = [each for each in found.events if each.kind not in ("kept_stretch", "command", "log")]
    matter = [each for each in matter if each.details.get("what") not in _ORDINARY]
    return [*matter, *(each for each in found.events if _mark(each))]


def _crash(info: RunInfo, ended_s: float) -> list[Event]:
    """Return the crash that ended a run as an event."""
    if info.end_reason != "crashed":
        return []
    wall_s = info.started_wall_time_s + info.wall_duration_s
    details = {"says": "the controller crashed or was killed"}
    return [Event(CRASH, info.run_id, ended_s, ended_s, wall_s, details=details)]


def is_clock(trend: Trend) -> bool:
    """Return whether a signal is a time or counts steps, so that its curve shows nothing."""
    last_word = trend.name.rpartition(".")[2].rpartition("_")[2]
    is_time = trend.unit in _CLOCK_UNITS or last_word in _CLOCK_NAMES
    is_even = trend.r2 is not None and trend.r2 >= _LIMITS.clock_fit
    return is_time and is_even and trend.monotonic == "rising"


def _outstanding(
    connection: sqlite3.Connection, found: Found, matter: Sequence[Event], checked: CheckedRun
) -> list[Event]:
    """Return the few events that are shown with picture, curves and context."""
    chosen = most_important(matter, checked)
    crashes = [each for each in chosen if each.kind == CRASH]
    others = [each for each in chosen if each.kind != CRASH]
    shown = [*found.only(others).page(connection, MOMENTS).events, *crashes]
    return sorted(shown, key=lambda each: each.start_s)


def _moment(
    event: Event, stored: Found, verdicts: Verdicts, inspections: Sequence[Inspection]
) -> EventContext:
    lasted = f", for {length(event.duration_s)}" if event.duration_s else ""
    kind = capitalised(event_name(event).replace("_", " "))
    title = f"{kind} at {time_at(event.start_s)} s{lasted}"
    columns = ("at [s]", "kind", "what")
    moment = EventContext(
        event, title, _says(event), _around(event), Grid(columns, ()),
        _telling_signals(event, verdicts),
    )  # fmt: skip
    around = [
        each for each in stored.events
        if moment.start_s <= each.start_s <= moment.end_s and each.kind != "image"
    ]  # fmt: skip
    nearest = sorted(around, key=lambda each: abs(each.start_s - event.start_s))[
        : _LIMITS.context_lines
    ]
    shown = [each for each in around if any(each is near for near in nearest)]
    rows = [
        GridRow([time_at(each.start_s), each.kind, describe_event(each)], _mark(each))
        for each in shown
    ]
    near = [each for each in inspections if moment.start_s <= each.sim_time_s <= moment.end_s]
    inspection = min(near, key=lambda each: abs(each.sim_time_s - event.start_s), default=None)
    return replace(
        moment,
        lines=Grid(columns, rows, left_out=len(around) - len(shown)),
        variables=inspection and shown_variables(inspection),
    )


def _says(event: Event) -> str:
    """Return what happened; only a name of a signal keeps its first letter."""
    said = describe_event(event)
    return said if event.name else capitalised(said)


def _telling_signals(event: Event, verdicts: Verdicts) -> list[str]:
    """Return the signals of an event: its own, else those that its kind is judged by.

    Of these one of each branch comes first: the position and the wheels, not three coordinates. For
    kinds without signals they are those of motion.
    """
    if event.name is not None and event.kind not in ("log", "command", "bridge_event"):
        return [event.name]
    judged = [
        verdicts.coverage[kind] for kind in (event.kind, "stuck") if kind in verdicts.coverage
    ]
    found = next((each for each in judged if each.signals), None)
    names = list(found.signals) if found is not None else list[str]()
    places: dict[str, int] = {}
    order: list[tuple[int, int]] = []
    for place, name in enumerate(names):
        branch = name.rpartition(".")[0] or name
        places[branch] = places.get(branch, 0) + 1
        order.append((places[branch], place))
    return [names[place] for _, place in sorted(order)[: _LIMITS.moment_signals]]


def _timeline(connection: sqlite3.Connection, stored: Found) -> Grid:
    """Return stored events in order. Of a long run, ordinary log lines are in the log only."""
    notes: list[str] = []
    if len(stored.events) > _LIMITS.timeline_entries:
        stored = stored.only([e for e in stored.events if e.kind != "log" or _mark(e)])
        notes = ["Of the log only warnings and errors stand here."]
    answer = stored.page(connection, _LIMITS.timeline_entries)
    rows = [
        GridRow(
            [time_at(each.start_s), _lasted(each), each.kind, describe_event(each)], _mark(each)
        )
        for each in answer.events
    ]
    left_out = sum(each.count for each in answer.left_out.values())
    return Grid(("at [s]", "for [s]", "kind", "what"), rows, notes, left_out=left_out)


def _commands(connection: sqlite3.Connection, stored: Found) -> Grid:
    commands = stored.only([each for each in stored.events if each.kind == "command"])
    answer = commands.page(connection, _LIMITS.events)
    rows = [
        GridRow([
            time_at(each.start_s), str(each.details.get("id", "")), each.name or "",
            format_signal_values(each.details.get("params") or {}), each.details["status"],
            number(each.details.get("took_wall_s")),
            cut(str(each.details.get("error") or each.details.get("rule")
                    or format_value(each.details.get("result", "")))),
        ], _mark(each))
        for each in answer.events
    ]  # fmt: skip
    columns = ("at [s]", "id", "action", "parameters", "outcome", "took [s]", "answer")
    return Grid(columns, rows, left_out=sum(each.count for each in answer.left_out.values()))


def _log(connection: sqlite3.Connection, run_id: int) -> Grid:
    robot_id = fetch_run(connection, run_id).robot_id
    asked = LogFilter(run_id, LogWindow(-math.inf, math.inf), robot_id=robot_id)
    lines = newest_lines(connection, asked, _LIMITS.log_lines)
    count = count_lines(connection, asked)
    return Grid(
        ("at [s]", "level", "from", "line"),
        [_line(line) for line in lines],
        left_out=count - len(lines),
        or_more=count >= COUNT_LIMIT,
    )


def _line(line: LogLine) -> GridRow:
    cells = [time_at(line.sim_time_s), line.level, line.source, cut(line.message, 2_000)]
    return GridRow(cells, _MARKS.get(line.level, ""))


def _trends(run: RunTrends) -> Grid:
    """Return trends of numbers, the largest change first, then of texts and flags."""
    rows = [
        GridRow([trend.name, trend.unit or "", trend.says, *_figures(trend)])
        for trend in run.numbers
    ]
    rows += [GridRow([state.name, "", _course(state), "", "", "", ""]) for state in run.states]
    notes = [f"Without a value: {', '.join(run.without_value[:50])}."] if run.without_value else []
    columns = ("signal", "unit", "what it did", "mean", "deviation", "minimum", "maximum")
    return Grid(columns, rows, notes, left_out=run.total - len(run.numbers))


def _figures(trend: Trend) -> list[str]:
    """Return mean, deviation, minimum and maximum."""
    low, high = trend.summary.min, trend.summary.max
    span = 0.0 if low is None or high is None else high - low
    return [number(each, span) for each in (trend.mean, trend.deviation, low, high)]


def _course(state: StateTrend) -> str:
    if state.changes == 0:
        return f"always {format_value(state.last)}"
    since = "" if state.since_s is None else f" since {time_at(state.since_s)} s"
    times = ", ".join(
        f"{cut(value, 40)} {length(held_s)}"
        for value, held_s in list(state.time_by_value_s.items())[: _LIMITS.mode_values]
    )
    changed = counted(state.changes, "change")
    return f"{changed}, {format_value(state.last)}{since}; {times}"


def _mode(run: RunTrends) -> StateTrend | None:
    name = find_mode([state.name for state in run.states if state.kind == "text"])
    return next((state for state in run.states if state.name == name), None)


def _mode_intervals(
    connection: sqlite3.Connection, whole: TimeRange, name: str, deadline_s: float
) -> list[ModeInterval]:
    """Return when a mode had which value, as far as that was read in time."""
    (part,) = plotted_runs(connection, [whole], [name], _LIMITS.timeline_steps, deadline_s)
    lanes = [lane_of(columns, part.run, part.end_s) for columns in part.run.changes]
    step_s = (part.end_s - part.run.start_s) / _LIMITS.timeline_steps
    intervals = [each for lane in lanes for each in at_resolution(lane.intervals, step_s)]
    return [ModeInterval(each.value, each.start_s, each.end_s) for each in intervals]


def _mode_shares(mode: StateTrend) -> list[ModeShare]:
    whole_s = sum(mode.time_by_value_s.values())
    return [
        ModeShare(
            cut(value, 60),
            f"{length(held_s)}, {share(held_s, whole_s)}",
            100 * held_s / whole_s if whole_s else 0.0,
        )
        for value, held_s in list(mode.time_by_value_s.items())[: _LIMITS.mode_values]
    ]


def _travelled(connection: sqlite3.Connection, run_id: int) -> tuple[list[str], list[str]]:
    """Return how far the robot went, in words, or why that is unknown."""
    nothing_else = EventOptions(kinds=("bridge_event",))
    found = compare_runs(connection, [run_id], options=nothing_else)
    known = {each.name: each.spread[0] for each in found.measures}
    distance, speed = known.get("distance_m"), known.get("mean_speed_m_s")
    why_not = [
        f"not known: {figures}: {why}"
        for figures, why in found.unknown.items()
        if "distance_m" in figures
    ]
    if distance is None or speed is None:
        return [], why_not
    went = f"It went {number(distance.median)} m, {number(speed.median)} m/s on average."
    return [went], why_not


def _around(event: Event) -> str:
    """Return values at the start of an event; an empty text if those rows were removed."""
    known = any(value is not None for value in event.around.values())
    return format_signal_values(event.around) if known else ""


def _mark(event: Event) -> str:
    if event.kind == "log":
        return _MARKS.get(event.name or "", "")
    failed = event.kind == "command" and event.details.get("status") in ("failed", "lost")
    return "error" if failed else ""


def _lasted(event: Event) -> str:
    return number(event.duration_s) if event.count == 1 and event.duration_s else ""


def _text(value: object) -> str:
    return "" if value is None else format_value(value)


def _file(path: str) -> str:
    return path.replace("\\", "/").rpartition("/")[2]
