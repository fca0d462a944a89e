"""What a run achieved: goal, path, speed, modes and events, compared over groups of runs."""

from __future__ import annotations

import re
import sqlite3
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.analysis.path_length import PathLength, tracks_of, travelled
from webots_mcp.analysis.rank_and_count_tests import is_rare, may_shares_differ, verdicts_on_shares
from webots_mcp.analysis.summary import (
    MIN_REPEATED,
    Spread,
    Verdict,
    chance_of,
    chance_of_counts,
    may_differ,
    spread_of,
    verdicts_on,
)
from webots_mcp.judging.detection.condition import VIOLATION, expectations_of
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Found, search_events
from webots_mcp.judging.detection.search import Motion, doubt_of_length, doubt_of_unit, in_metres
from webots_mcp.judging.run_sampling import SampledRun
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.signals.naming import FARTHEST_M, NAME_POSITION, listed
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.frame_summary import MOST_VALUES, change_points, spelled
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.reading.unread import Unread
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.runs import RunInfo

MOST_SEARCHED: Final = 10  # newest runs of each group in which events are searched
_SHARE: Final = "share of "
_DUST: Final = 1e-9  # of a figure
_AS_LONG: Final = 1.01  # times another duration: the ends of identical runs differ by a few rows
_CLOCK_MARGIN: Final = (
    0.25  # wall times of two sessions differ by less on a machine with other load
)
_RATE: Final = " per min"
NO_MODE: Final = (
    "no mode is known: publish one as a text, such as mode, or name the signal of one: mode=NAME"
)
NO_WAY: Final = "fewer than two rows have a position"
OUT_OF_TIME: Final = "time limit reached before all rows were read: compare fewer runs at once"
_NOT_EXPECTED: Final = "nothing was expected of it when it ran"
_SPEED: Final = "mean_speed_m_s"
GOAL_REACHED: Final = "goal reached"
_GOAL_TIME: Final = "time_to_goal_s"
_DURATION: Final = "duration_s"
_OWN_MS: Final = "own_ms_per_step"
WHOLE_RUNS: Final = "whole runs"
_OF_WHOLE_RUNS: Final = (GOAL_REACHED, _GOAL_TIME, _DURATION, _OWN_MS)


@dataclass(frozen=True)
class Way:
    """Where a robot was in a segment of one run.

    Attributes:
        times: Of the rows that have a position, in s.
        x_m: In metres, as `y_m`.
        cut_at_s: As of a frame: where the deadline cut it.
        unread: As of a frame: all that was not read.
    """

    times: Array
    x_m: Array
    y_m: Array
    cut_at_s: float | None
    unread: tuple[Unread, ...]

    @property
    def length(self) -> PathLength:
        """How long it is, without what the noise of the position adds from row to row."""
        return travelled(tracks_of(self.times, self.x_m, self.y_m))


def way_in(frame: Frame, position: tuple[RegisteredSignal, RegisteredSignal]) -> Way:
    """The path of a robot in a frame, as far as it is read before the deadline."""
    x, y = (in_metres(each, frame.numbers(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    return Way(frame.times[there], x[there], y[there], frame.cut_at_s, frame.unread)


def _way_in_even_rows(rows: SampledRun, position: tuple[RegisteredSignal, RegisteredSignal]) -> Way:
    x, y = (in_metres(each, rows.numbers(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    frame = rows.frame
    return Way(rows.moments[there], x[there], y[there], frame.cut_at_s, frame.unread)


class RunGoal(NamedTuple):
    """The goal of a run: the condition in `until` of its last run command.

    Attributes:
        took_s: Simulated seconds until it was reached; None where it was not.
    """

    condition: str
    took_s: float | None


def goals_of(
    connection: sqlite3.Connection, robot_id: int, run_ids: Sequence[int]
) -> dict[int, RunGoal]:
    """Return the goals of those runs of a robot that had one."""
    wanted = set(run_ids)
    # the last run command with a goal that finished in each run
    return {
        run_id: RunGoal(str(condition), took_s if ended == "condition held" else None)
        for run_id, condition, ended, took_s in connection.execute(
            "SELECT json_extract(result, '$.run_id'), json_extract(params, '$.until'), "
            "json_extract(result, '$.ended'), json_extract(result, '$.advanced_s') FROM command "
            "WHERE robot_id = ? AND action = 'run' AND json_valid(result) "
            "AND json_extract(params, '$.until') IS NOT NULL ORDER BY id",
            (robot_id,),
        )
        if run_id in wanted
    }


@dataclass(frozen=True)
class RunPart:
    """A run, its own robot's signals, and the part of it that is compared.

    Attributes:
        segment: The compared part.
        rows: Its rows at even moments.
        goal: None of a run without one.
        searched: Whether events are searched in it.
    """

    robot_id: int
    run: RunInfo
    whole: Segment
    segment: Segment
    known: dict[str, RegisteredSignal]
    motion: Motion
    rows: SampledRun
    goal: RunGoal | None
    searched: bool = True


@dataclass(frozen=True)
class Measure:
    """What each run achieved as a whole, by group.

    Attributes:
        name: `goal reached` (1 or 0), time_to_goal_s, distance_m, mean_speed_m_s, `share of MODE`
            (of the time), `KIND per min` (events), duration_s, own_ms_per_step (wall time in the
            controller's own code).
        spread: Over the runs of the group; None where it is not known of all of them.
        different: Whether the group differs from the first by more than repeated runs do; None
            where that cannot be decided; False where a difference that matters is excluded.
        runs_wanted: This many runs of each group would tell, if they went on like these; None where
            nothing shows that they would.
        interval: The difference lies in it nine times of ten: of the means, or of what `compared`
            says.
        holds_for: Over which time the figures hold.
        compared: What the verdict is about: "means", or "share of runs" for rare events, which are
            counted by run (Fisher's exact test).
        runs: Of a figure that is counted by run, the runs that have it, by group.
        reasons: Why `different` is None, by group.
    """

    name: str
    spread: list[Spread | None]
    different: list[bool | None]
    runs_wanted: list[int | None]
    interval: list[tuple[float, float] | None]
    holds_for: str = ""
    compared: str = "means"
    runs: list[list[int]] | None = None
    reasons: list[str | None] = field(default_factory=list[str | None])


@dataclass(frozen=True)
class Outcomes:
    """What the runs achieved.

    Attributes:
        unknown: Figures that are not known, or not wholly: of which runs, why, and what would
            make them known.
    """

    measures: tuple[Measure, ...]
    unknown: dict[str, str]


class RunOutcome(NamedTuple):
    """What one run achieved in the compared part.

    Attributes:
        has_mode: Its mode is known: one in which it never was took no time.
        events: How many of each kind.
        unknown: What is not known of it, or not wholly, with why.
        unsearched: Kinds that were not searched at all, or not in rows that could not be read.
        complete: All rows were searched.
        searched: Whether events were searched in it.
    """

    run_id: int
    duration_s: float
    figures: dict[str, float | None]
    has_mode: bool
    events: Counter[str]
    unknown: dict[str, tuple[str, ...]]
    unsearched: frozenset[str]
    complete: bool
    searched: bool

    def figure(self, name: str) -> float | None:
        """The path, or the share of the time that a mode took."""
        none = 0.0 if name.startswith(_SHARE) and self.has_mode else None
        return self.figures.get(name, none)

    def events_of(self, kind: str) -> int | None:
        """How many events of a kind, where that is known."""
        return self.events[kind] if self.complete and kind not in self.unsearched else None


def outcomes_of(
    groups: Sequence[Sequence[RunOutcome]], compared_s: float, min_effect_sd: float
) -> Outcomes:
    """Compare what the runs of each group achieved; the goal comes first."""
    runs = [run for group in groups for run in group]
    named = dict.fromkeys(name for run in runs for name in run.figures)
    first = [name for name in (GOAL_REACHED, _GOAL_TIME) if name in named]
    names = [*first, *(name for name in named if name not in first)]
    if _DURATION in names and not _varies_in_length([run.figures[_DURATION] for run in runs]):
        names.remove(_DURATION)
    searched = [[run for run in group if run.searched] for group in groups]
    kinds = list(dict.fromkeys(kind for run in runs for kind in run.events))
    tests, of_more = _facts(groups, searched, names, kinds)
    holds_for = f"first {compared_s:.4g} s of each run"
    measures = [
        _measure(name, groups, (tests, of_more), min_effect_sd, holds_for) for name in names
    ]
    measures += [
        _counted(kind, searched, (tests, of_more), min_effect_sd, holds_for) for kind in kinds
    ]
    unknown = _not_known(runs)
    left_out = [run.run_id for run in runs if not run.searched]
    if left_out:
        unknown[f"events{_RATE}"] = (
            f"searched in the newest {MOST_SEARCHED} runs of each group, not in the other "
            f"{len(left_out)}: compare fewer runs"
        )
    return Outcomes(tuple(measures), unknown)


def _varies_in_length(durations_s: Sequence[float | None]) -> bool:
    known = [each for each in durations_s if each is not None]
    return bool(known) and max(known) > _AS_LONG * min(known)


def _facts(
    groups: Sequence[Sequence[RunOutcome]],
    searched: Sequence[Sequence[RunOutcome]],
    names: Sequence[str],
    kinds: Sequence[str],
) -> tuple[int, int]:
    """How many figures can differ by chance, each on its own, and how many if runs are repeated.

    Not those that are the same in all runs, nor counts of too few events (`may_differ`); the
    distance and the mean speed over the same time are one fact, and the last share of the time
    follows from the others.
    """
    runs = [run for group in groups for run in group]
    vary = [name for name in names if _varies([run.figure(name) for run in runs])]
    shares = sum(name.startswith(_SHARE) for name in vary)
    one_fact = (_SPEED in vary) + (shares > 0)
    of_events = [run for group in searched for run in group]
    kinds = [kind for kind in kinds if len({run.events_of(kind) for run in of_events}) > 1]
    counts = [[[run.events_of(kind) or 0 for run in group] for group in searched] for kind in kinds]
    may = (may_shares_differ(each) if is_rare(each) else may_differ(each) for each in counts)
    figures = len(vary) - one_fact
    return max(1, figures + sum(may)), max(1, figures + len(kinds))


def _varies(figures: Sequence[float | None]) -> bool:
    """Whether the figures of some runs differ, by more than adding makes of one."""
    known = [figure for figure in figures if figure is not None]
    spread = max(known, default=0.0) - min(known, default=0.0)
    return len(known) < len(figures) or spread > _DUST * max(map(abs, known), default=0.0)


def _measure(
    name: str,
    groups: Sequence[Sequence[RunOutcome]],
    tests: tuple[int, int],
    min_effect_sd: float,
    holds_for: str,
) -> Measure:
    figures = [[run.figure(name) for run in group] for group in groups]
    by_run = name == GOAL_REACHED
    if by_run:
        verdicts = verdicts_on_shares(figures, *tests, min_effect_sd)
    else:
        verdicts = verdicts_on(figures, tests[0], chance_of, tests[1], min_effect_sd)
    run_ids = [[run.run_id for run in group] for group in groups]
    reasons = reasons_of(verdicts, figures, run_ids)
    if name == _OWN_MS:
        verdicts, reasons = _beyond_load(verdicts, reasons, figures)
    if name == _GOAL_TIME:
        missing = [run.run_id for group in groups for run in group if run.figure(name) is None]
        why = f"run {listed(list(map(str, missing)))} did not reach a goal, so it has no such time"
        reasons = [each and why if missing else each for each in reasons]
    return _made(
        name,
        figures,
        verdicts,
        holds_for=WHOLE_RUNS if name in _OF_WHOLE_RUNS else holds_for,
        compared="share of runs" if by_run else "means",
        runs=_having(run_ids, figures) if by_run else None,
        reasons=reasons,
    )


def _beyond_load(
    verdicts: list[Verdict], reasons: list[str | None], figures: Sequence[Sequence[float | None]]
) -> tuple[list[Verdict], list[str | None]]:
    """Without differences in wall time that another load of the machine can make.

    Repeated runs of one session share the load of their hour: how much they differ does not tell
    how much two sessions do.
    """
    spreads = [spread_of(each) for each in figures]
    verdicts, reasons = list(verdicts), list(reasons)
    for at, (verdict, spread) in enumerate(zip(verdicts, spreads, strict=True)):
        first = spreads[0]
        if verdict.different and first is not None and spread is not None:
            apart = abs(spread.median - first.median)
            if apart <= _CLOCK_MARGIN * max(spread.median, first.median):
                verdicts[at] = verdict._replace(different=None)
                reasons[at] = (
                    f"less than {_CLOCK_MARGIN:.0%} of wall time, which another load of the "
                    "machine makes too"
                )
    return verdicts, reasons


def _having(
    run_ids: Sequence[Sequence[int]], figures: Sequence[Sequence[float | None]]
) -> list[list[int]]:
    groups = zip(run_ids, figures, strict=True)
    return [[run_id for run_id, each in zip(ids, of, strict=True) if each] for ids, of in groups]


def _made(
    name: str,
    figures: Sequence[Sequence[float | None]],
    verdicts: Sequence[Verdict],
    **others: Any,
) -> Measure:
    different, wanted, interval = map(list, zip(*verdicts, strict=True))
    return Measure(
        name, [spread_of(each) for each in figures], different, wanted, interval, **others
    )


def _counted(
    kind: str,
    groups: Sequence[Sequence[RunOutcome]],
    tests: tuple[int, int],
    min_effect_sd: float,
    holds_for: str,
) -> Measure:
    """Events per minute; their counts are compared, of rare ones the runs that have any."""
    counts = [[run.events_of(kind) for run in group] for group in groups]
    run_ids = [[run.run_id for run in group] for group in groups]
    rate = 60 / groups[0][0].duration_s
    per_min = [[None if each is None else each * rate for each in group] for group in counts]
    if by_run := is_rare(counts) and any(len(group) > 1 for group in groups):
        verdicts = verdicts_on_shares(counts, *tests, min_effect_sd)
    else:
        found = verdicts_on(counts, tests[0], chance_of_counts, tests[1], min_effect_sd)
        verdicts = [_per_min(each, rate) for each in found]
    return _made(
        f"{kind}{_RATE}",
        per_min,
        verdicts,
        holds_for=holds_for,
        compared="share of runs" if by_run else "means",
        runs=_having(run_ids, counts) if by_run else None,
        reasons=reasons_of(verdicts, counts, run_ids),
    )


def _per_min(verdict: Verdict, rate: float) -> Verdict:
    if verdict.interval is None:
        return verdict
    return verdict._replace(interval=(verdict.interval[0] * rate, verdict.interval[1] * rate))


def reasons_of(
    verdicts: Sequence[Verdict],
    figures: Sequence[Sequence[float | None]],
    run_ids: Sequence[Sequence[int]],
) -> list[str | None]:
    """Return why a verdict is None, by group; None where there is one."""
    unknown = [
        str(run_id)
        for ids, of in zip(run_ids, figures, strict=True)
        for run_id, figure in zip(ids, of, strict=True)
        if figure is None
    ]
    return [
        None if verdict.different is not None else _reason(verdict, figures[0], group, unknown)
        for verdict, group in zip(verdicts, figures, strict=True)
    ]


def _reason(
    verdict: Verdict,
    first: Sequence[float | None],
    other: Sequence[float | None],
    unknown: Sequence[str],
) -> str:
    if unknown:
        return f"not known of run {listed(unknown)}"
    counts = (len(first), len(other))
    if verdict.runs_wanted is not None:
        return f"{counts[0]} and {counts[1]} runs: {verdict.runs_wanted} of each would tell"
    if max(counts) == 1:
        return "one run each: how much repeated runs differ is not known"
    if min(counts) < MIN_REPEATED:
        return f"{counts[0]} and {counts[1]} runs: it takes {MIN_REPEATED} of each or more"
    return "the runs of each group scatter too much to show a difference, or that there is none"


def _not_known(runs: Sequence[RunOutcome]) -> dict[str, str]:
    """Why figures are not known: those that share a reason under one key, reasons in one text."""
    alike: dict[tuple[str, str], dict[int, str]] = {}
    for run in runs:
        for name, reasons in run.unknown.items():
            for why in reasons:
                key = (
                    name,
                    re.sub(r"^run \d+ lasted only [^;,]*|(?<=a period is over )\S+", "", why),
                )
                alike.setdefault(key, {})[run.run_id] = why
    sharing: dict[str, list[str]] = {}
    for (name, _), reasons in alike.items():
        sharing.setdefault(_reason_of_runs(reasons, len(runs)), []).append(name)
    by_reason: dict[str, list[str]] = {}
    for why, names in sharing.items():
        by_reason.setdefault(", ".join(names), []).append(why)
    return {names: "; ".join(reasons) for names, reasons in by_reason.items()}


def _reason_of_runs(reasons: dict[int, str], of: int) -> str:
    """One sentence for runs that share a reason; where their figures differ, those of the first."""
    first, *others = reasons.items()
    if any(why != first[1] for _, why in others):
        return f"{first[1]}; likewise run {', '.join(str(run_id) for run_id, _ in others)}"
    if len(reasons) == of or first[1].startswith(f"run {first[0]} "):
        return first[1]
    return f"run {', '.join(map(str, reasons))}: {first[1]}"


def _path_figures(
    part: RunPart, duration_s: float, deadline: Deadline
) -> tuple[dict[str, float | None], str | None]:
    """Return how far and how fast a robot went, and why these figures are not certain, if so."""
    position = part.motion.position
    if position is None:
        return {}, NAME_POSITION
    read = _way_in_even_rows(part.rows, position)
    is_known = len(read.times) > 1 and not (deadline.passed or read.unread)
    way = read.length if is_known else None
    speed = None if way is None else way.length_m / duration_s
    doubt = OUT_OF_TIME if deadline.passed else "; ".join(map(str, read.unread))
    doubt = doubt or (NO_WAY if way is None else doubt_of_unit(position, speed or 0.0))
    return {"distance_m": way and way.length_m, _SPEED: speed}, doubt or (
        way and doubt_of_length(way)
    )


def outcome_of(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> RunOutcome:
    """Return what a run achieved in the compared part: path, modes and events."""
    run_id, duration_s = part.segment.run_id, part.segment.end_s - part.segment.start_s
    figures: dict[str, float | None] = {}
    if part.goal is not None:
        figures[GOAL_REACHED] = float(part.goal.took_s is not None)
        figures[_GOAL_TIME] = part.goal.took_s
    figures[_DURATION] = part.whole.end_s - part.whole.start_s
    if part.run.own_ms is not None:
        figures[_OWN_MS] = part.run.own_ms
    unknown: dict[str, tuple[str, ...]] = {}
    of_path, doubt = _path_figures(part, duration_s, deadline)
    figures |= of_path
    if doubt:
        unknown["distance_m, mean_speed_m_s"] = (doubt,)
    shares, unread = _mode_shares(connection, part, deadline)
    if deadline.passed or unread:
        shares = {}
    figures |= {f"{_SHARE}{mode}": share for mode, share in shares.items()}
    if not shares:
        unknown["share of each mode"] = (OUT_OF_TIME if deadline.passed else unread or NO_MODE,)
    counts, unsearched = Counter[str](), frozenset[str]()
    if part.searched:
        counts, unsearched, of_events = _event_counts(connection, part, options, deadline)
        unknown |= of_events
    return RunOutcome(
        run_id,
        duration_s,
        figures,
        bool(shares),
        counts,
        unknown,
        unsearched,
        not deadline.passed,
        part.searched,
    )


def _event_counts(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> tuple[Counter[str], frozenset[str], dict[str, tuple[str, ...]]]:
    """How many events of each kind, the kinds that were not searched, and why."""
    found = _events(connection, part, options, deadline)
    verdicts, counts = found.verdicts, Counter(event.kind for event in found.events)
    kinds = sorted(asked_kinds(options), key=lambda kind: not kind.stored)
    in_order = {kind.name: counts[kind.name] for kind in kinds if counts[kind.name]}
    unsearched = {e for e in verdicts.reasons if verdicts.why_unsearched(e) or verdicts.unread(e)}
    unknown: dict[str, tuple[str, ...]] = {}
    if deadline.passed:
        unknown[f"events{_RATE}"] = (OUT_OF_TIME,)
    else:
        unknown |= {f"{kind}{_RATE}": reasons for kind, reasons in verdicts.reasons.items()}
    if not expectations_of(connection, part.segment.run_id):
        unsearched.add(VIOLATION)  # a run of which nothing was expected has not met it
    return Counter(in_order), frozenset(unsearched), unknown


def _mode_shares(
    connection: sqlite3.Connection, part: RunPart, deadline: Deadline
) -> tuple[dict[str, float], str]:
    """The share of the even moments in each mode, and what was not read."""
    if part.motion.mode is None:
        return {}, ""
    frame = part.rows.frame
    changes = change_points(
        connection, part.segment, [part.motion.mode], deadline, frame=frame, since=False
    )
    points = changes.points[part.motion.mode.name]
    starts_s: Array = np.array([point.sim_time_s for point in points], np.float64)
    moments = part.rows.moments
    at = np.searchsorted(starts_s, moments + SAME_TIME_S, "right") - 1
    found = Counter[str]()
    for place, count in zip(*np.unique(at[at >= 0], return_counts=True), strict=True):
        found[spelled(points[int(place)].value)] += int(count)
    shares = {mode: count / len(moments) for mode, count in found.most_common(MOST_VALUES)}
    return shares, "; ".join(map(str, changes.unread))


def _events(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> Found:
    kinds = tuple(kind.name for kind in asked_kinds(options) if kind.counted)
    whole = TimeRange(part.robot_id, "", (part.segment,), "simulation")
    wanted = replace(options, kinds=kinds)
    return search_events(
        connection, whole, wanted, around=(), group=False, deadline_s=deadline.left_s
    )
