"""`compare_runs`: what runs achieved, whether one group is better than another, and in what.

Figures are compared over the time that all runs have, at even moments of simulation time.
"""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final, NamedTuple

from webots_mcp.analysis.summary import (
    MIN_EFFECT_SD,
    Spread,
    Summary,
    Verdict,
    spread_of,
    verdicts_on,
    with_extremes,
)
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import motion_in
from webots_mcp.judging.run_measures import (
    MOST_SEARCHED,
    OUT_OF_TIME,
    Measure,
    RunGoal,
    RunOutcome,
    RunPart,
    goals_of,
    outcome_of,
    outcomes_of,
    reasons_of,
)
from webots_mcp.judging.run_sampling import SampledRun, shared_interval_s
from webots_mcp.signals.conditions.functions import SAME_TIME_S
from webots_mcp.signals.naming import listed
from webots_mcp.signals.parameter import Value
from webots_mcp.store.reading import frame_summary
from webots_mcp.store.reading.catalogue import known_signals, resolve_signals
from webots_mcp.store.reading.frame import Frame, read_frame, read_kept
from webots_mcp.store.reading.ranges import TimeRange, whole_run
from webots_mcp.store.reading.segment import Deadline, Segment, in_one_snapshot
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.run_parameters import differing, parameters_of
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import RunInfo, run_infos
from webots_mcp.store.trial_sets import scored_runs

# -- how a signal differs between groups of runs ---------------------------------------------------


_NONE: Final = Summary()
_DUST: Final = 1e-9  # of a signal's largest value: what varies by less does not vary
COMPARE_DEADLINE_S: Final = 5.0
MOST_COMPARED: Final = 300  # runs that are given
MOST_OF_EDIT: Final = 10  # newest runs before and after an edit, and of each set of parameters
MOST_SETS: Final = 5  # of a trial set
_MOST_NAMED: Final = 10  # runs in the name of a group
_AS_LONG: Final = 1.01  # times the compared time: the ends of identical runs differ by a few rows


@dataclass(frozen=True)
class Difference:
    """A signal in each group, over the compared time; lists are in the order of the groups.

    Attributes:
        mean: Over the runs of the group, of values at even moments; of an angle the circular mean.
        deviation: The standard deviation within a run, over the runs of the group.
        deviation_ratio: Of its median to that of the first group; None where that is 0.
        effect: How far each mean is from that of the first group, in pooled standard deviations:
            Cohen's d, (m - m1) / sqrt((s1**2 + s**2) / 2) (J. Cohen, Statistical Power Analysis
            for the Behavioral Sciences, 2nd ed. 1988, section 2.2 with the note on unequal
            deviations); 0.2 is called small, 0.5 medium, 0.8 large. None where it is not defined:
            without values, or both constant and not equal. Rows follow each other too closely to
            be independent, so it describes, and proves nothing.
        different: Whether the means differ by more than those of repeated runs do; None where that
            cannot be decided (`analysis.summary`).
        interval: The difference of the means of the groups lies in it nine times of ten.
        deviation_different: Whether the deviations within runs differ by more than those of
            repeated runs do; None where that cannot be decided.
        deviation_interval: The difference of the deviations lies in it nine times of ten.
        reasons: Why `different` or `deviation_different` is None.
        asked: It was asked for by its name.
    """

    name: str
    kind: str
    unit: str | None
    mean: list[Spread | None]
    deviation: list[Spread | None]
    min: list[float | None]
    max: list[float | None]
    count: list[int | None]
    deviation_ratio: list[float | None]
    effect: list[float | None]
    different: list[bool | None]
    interval: list[tuple[float, float] | None]
    deviation_different: list[bool | None]
    deviation_interval: list[tuple[float, float] | None]
    reasons: list[str | None]
    asked: bool = False

    @property
    def is_certain(self) -> bool:
        """Whether its level or its spread differs for certain in any group."""
        return any(self.different) or any(self.deviation_different)


def difference_of(
    signal: RegisteredSignal,
    groups: Sequence[Sequence[dict[str, Summary] | None]],
    run_ids: Sequence[Sequence[int]],
    tests: int,
    min_effect_sd: float,
) -> Difference:
    """A signal in each run of each group.

    Args:
        signal: Which.
        groups: Of each run its summaries; None of one of which not all was read.
        run_ids: Of the runs.
        tests: How many are made at once.
        min_effect_sd: See `analysis.summary`.
    """
    runs: list[list[Summary] | None] = []  # that have a value; None of a group that is not known
    for group in groups:
        found = [run.get(signal.name, Summary()) for run in group if run is not None]
        is_known = len(found) == len(group)
        runs.append([each for each in found if each.sum is not None] if is_known else None)
    has_angles = all(each.sines is not None for group in runs for each in group or ())
    turn = signal.turn if has_angles else None
    means = _means(turn, runs)
    deviations = [
        [None] if group is None else [_deviation(turn, each) for each in group] for group in runs
    ]
    mean, deviation = [spread_of(each) for each in means], [spread_of(each) for each in deviations]
    of_means = verdicts_on(means, tests, min_effect_sd=min_effect_sd)
    of_deviations = verdicts_on(deviations, tests, min_effect_sd=min_effect_sd)
    missing = _without_value(signal, groups, run_ids)
    reasons = [
        missing or _reason(level, spread)
        for level, spread in zip(
            reasons_of(of_means, means, _runs_of(means, run_ids)),
            reasons_of(of_deviations, deviations, _runs_of(deviations, run_ids)),
            strict=True,
        )
    ]
    if missing:
        of_means = of_deviations = [Verdict(None)] * len(groups)
    lows = ([each.min for each in group or () if each.min is not None] for group in runs)
    highs = ([each.max for each in group or () if each.max is not None] for group in runs)
    return Difference(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        mean=mean,
        deviation=deviation,
        min=[min(each, default=None) for each in lows],
        max=[max(each, default=None) for each in highs],
        count=[None if group is None else sum(each.present for each in group) for group in runs],
        deviation_ratio=[_ratio(each, deviation[0]) for each in deviation],
        effect=[_effect(turn, mean, deviation, index) for index in range(len(groups))],
        different=[each.different for each in of_means],
        interval=[each.interval for each in of_means],
        deviation_different=[each.different for each in of_deviations],
        deviation_interval=[each.interval for each in of_deviations],
        reasons=reasons,
    )


def _reason(level: str | None, spread: str | None) -> str | None:
    return level or (spread and f"deviation: {spread}")


def _runs_of(
    figures: Sequence[Sequence[float | None]], run_ids: Sequence[Sequence[int]]
) -> list[Sequence[int]]:
    """The ids of the runs of these figures; of a group that is not known that of its first run."""
    return [ids[: len(of)] for ids, of in zip(run_ids, figures, strict=True)]


def _without_value(
    signal: RegisteredSignal,
    groups: Sequence[Sequence[dict[str, Summary] | None]],
    run_ids: Sequence[Sequence[int]],
) -> str:
    """Why a signal cannot be compared: runs that hold no value of it, or that were not read."""
    named = [
        (run_id, run)
        for ids, group in zip(run_ids, groups, strict=True)
        for run_id, run in zip(ids, group, strict=True)
    ]
    unread = [str(run_id) for run_id, run in named if run is None]
    if unread:
        return f"not all rows of run {listed(unread)} were read"
    groups_without = [
        group
        for group in groups
        if all(run and run.get(signal.name, _NONE).sum is None for run in group)
    ]
    if not groups_without:
        return ""
    without = [str(i) for i, run in named if run and run.get(signal.name, _NONE).sum is None]
    return f"run {listed(without)} has no number of it"


def _means(
    turn: float | None, groups: Sequence[Sequence[Summary] | None]
) -> list[list[float | None]]:
    """Of an angle all within half a turn of the first: their own mean must not be cut in two."""
    found: list[list[float | None]] = [
        [None] if group is None else [each.centre(turn) for each in group] for group in groups
    ]
    if turn is None:
        return found
    start = next((each for group in found for each in group if each is not None), 0.0)
    return [
        [None if each is None else start + math.remainder(each - start, turn) for each in group]
        for group in found
    ]


def _deviation(turn: float | None, summary: Summary) -> float | None:
    """What adding floats leaves is the 0 that it means."""
    deviation = summary.deviation_in(turn)
    if deviation is None or summary.min is None or summary.max is None:
        return deviation
    return deviation if deviation > _DUST * max(abs(summary.min), abs(summary.max)) else 0.0


def _ratio(deviation: Spread | None, first: Spread | None) -> float | None:
    if deviation is None or first is None or first.median == 0:
        return None
    return deviation.median / first.median


def _effect(
    turn: float | None,
    means: Sequence[Spread | None],
    deviations: Sequence[Spread | None],
    index: int,
) -> float | None:
    """Cohen's d of a group against the first; see `Difference`."""
    mean, deviation, mean1, deviation1 = means[index], deviations[index], means[0], deviations[0]
    if mean is None or mean1 is None or deviation is None or deviation1 is None:
        return None
    apart = mean.median - mean1.median
    apart = apart if turn is None else math.remainder(apart, turn)
    pooled = math.sqrt((deviation.median**2 + deviation1.median**2) / 2)
    if pooled <= 1e-12 * max(abs(mean.median), abs(mean1.median)):
        return 0.0 if math.isclose(mean.median, mean1.median, rel_tol=1e-9) else None
    return apart / pooled


def size_of(difference: Difference) -> tuple[bool, float]:
    """What differs most: first what differs for certain, then by the effect or the deviation.

    Constants that are not equal come before all others; a deviation counts by how often it has
    doubled or halved.
    """
    effects = (math.inf if each is None else abs(each) for each in difference.effect[1:])
    ratios = (each for each in difference.deviation_ratio[1:] if each is not None)
    doublings = (math.inf if each == 0 else abs(math.log2(each)) for each in ratios)
    return difference.is_certain, max((0.0, *effects, *doublings))


def only_in(differences: Sequence[Difference], groups: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Signals that not every group has, with the groups that have them."""
    return {
        each.name: tuple(group for group, count in zip(groups, each.count, strict=True) if count)
        for each in differences
        if any(each.count) and 0 in each.count
    }


@dataclass(frozen=True)
class Group:
    """Runs that are looked at as one: a single run, or all that repeat it.

    Attributes:
        total_duration_s: Simulated seconds of all its runs together, as long as they are.
        parameters: Those in which the compared runs differ, with the values that its runs had.
    """

    name: str
    runs: tuple[RunInfo, ...]
    total_duration_s: float
    parameters: dict[str, tuple[Value | str, ...]]


@dataclass(frozen=True)
class Comparison:
    """The answer of `compare_runs`.

    Attributes:
        compared_s: All figures are about the first so many simulated seconds of each run, as many
            as the shortest has.
        measures: What the runs came to as a whole.
        unknown: Figures that are not known, or not wholly: of which runs, why, and what would
            make them known.
        differences: What differs most comes first; at most `limit` of `total`.
        only_in: Signals that not every group has, with the groups that have them.
        notes: What is not complete.
    """

    groups: tuple[Group, ...]
    compared_s: float
    measures: tuple[Measure, ...]
    unknown: dict[str, str]
    differences: tuple[Difference, ...]
    total: int
    only_in: dict[str, tuple[str, ...]]
    notes: tuple[str, ...]


@in_one_snapshot
def compare_runs(
    connection: sqlite3.Connection,
    run_ids: Sequence[int] | None = None,
    *,
    groups: Mapping[str, Sequence[int]] | None = None,
    set_id: int | None = None,
    robot: str | None = None,
    names: Sequence[str] = ("*",),
    limit: int = 30,
    options: EventOptions | None = None,
    min_effect_sd: float = MIN_EFFECT_SD,
    deadline_s: float = COMPARE_DEADLINE_S,
) -> Comparison:
    """Compare runs, aligned at their start; those of the first group are the reference.

    Of given runs where some have the same robot, code and parameters and others have not, those
    that have are one group; for a single run it has that run's figures. Of a trial set its best
    five sets of parameters count, the best first, of each the runs that have a score, at most 10.
    Else it is the runs before and after the last edit of the robot's controller, which is seen by
    the SHA-256 of its file: "after" are the newest runs that share one, "before" those just before
    them that share another, at most the newest 10 of each.

    Args:
        connection: Any.
        run_ids: 1 to 10 different runs.
        groups: Runs by the names of their groups, instead of `run_ids`.
        set_id: A trial set, where no runs are given.
        robot: Whose controller was edited, where neither is given.
        names: Signals, with `*`.
        limit: The most differences to return.
        options: What counts as an event, and what the position and the mode are.
        min_effect_sd: The least difference that matters, in standard deviations between like runs.
        deadline_s: After it, figures for which not all rows were read are None.

    Raises:
        InvalidInputError: No run, more than 10, or one twice; no such set; nothing could matter.
        UnknownRunError, UnknownRobotError, AmbiguousRobotError, UnknownSignalError: As they say.
        NothingRecordedError: A run has no state row, all runs had the same code, or the set has no
            run with a score.
    """
    if not 0 < min_effect_sd < math.inf:
        raise InvalidInputError(f"min_effect_sd={min_effect_sd} must be a number above 0.")
    notes: list[str] = []
    if groups is None:
        groups, notes = _asked_groups(connection, run_ids, set_id, robot)
    options = options or EventOptions()
    deadline = Deadline(deadline_s)
    compared = _groups(connection, groups)
    runs = _Runs(connection, compared, options, deadline)
    compared_s = min(runs.durations_s.values())
    known = runs.known
    asked = resolve_signals(known, names)
    is_named = tuple(names) != ("*",)
    signals = [each for each in asked if each.is_number or (is_named and each.kind == "bool")]
    figures = _figures(connection, runs, signals)
    compared_ids = [[run.run_id for run in group.runs] for group in compared]
    tests = 2 * len(signals)
    differences = [
        replace(
            difference_of(each, figures.summaries, compared_ids, tests, min_effect_sd),
            asked=is_named,
        )
        for each in signals
        if len(runs.durations_s) > 1
    ]
    shared = [each for each in differences if each.asked or 0 not in each.count]
    if is_named and len(runs.durations_s) > 1:
        shared += [_of_text(each, len(groups)) for each in asked if each not in signals]
    shared.sort(key=size_of, reverse=True)
    found_outcomes = outcomes_of(figures.outcomes, compared_s, min_effect_sd)
    return Comparison(
        groups=compared,
        compared_s=compared_s,
        measures=found_outcomes.measures,
        unknown=found_outcomes.unknown
        | (
            {"means of signals": "; ".join(figures.unread)}
            if figures.unread and differences
            else {}
        ),
        differences=tuple(shared[:limit]),
        total=len(shared),
        only_in=only_in(differences, list(groups)),
        notes=(
            *notes,
            *_notes(compared),
            *_goal_notes(runs.goals, runs.durations_s),
            *_cut_notes(runs.durations_s, compared_s),
        ),
    )


def _asked_groups(
    connection: sqlite3.Connection,
    run_ids: Sequence[int] | None,
    set_id: int | None,
    robot: str | None,
) -> tuple[dict[str, list[int]], list[str]]:
    """Return the runs to compare by the names of their groups, and a note on what is left out."""
    if run_ids is not None:
        return _repeats(connection, run_ids), []
    if set_id is None:
        return _around_last_edit(connection, robot), []
    found = scored_runs(connection, set_id)
    groups = {name: found[name][:MOST_OF_EDIT] for name in list(found)[:MOST_SETS]}
    if len(found) == len(groups):
        return groups, []
    return groups, [f"the best {len(groups)} of {len(found)} sets of parameters"]


class _Figures(NamedTuple):
    """What was read of the runs, by group and run.

    Attributes:
        summaries: Of each signal; None of a run of which not all was read.
        unread: Reasons why figures are missing.
    """

    summaries: list[list[dict[str, Summary] | None]]
    outcomes: list[list[RunOutcome]]
    unread: dict[str, None]

    def missing_means(self) -> dict[str, str]:
        """Return why means of signals are missing, as an entry of what is unknown."""
        return {"means of signals": "; ".join(self.unread)} if self.unread else {}


def _figures(
    connection: sqlite3.Connection, runs: _Runs, signals: Sequence[RegisteredSignal]
) -> _Figures:
    """Read each run, for as long as the shortest one lasted; a single run has no summaries."""
    figures = _Figures([], [], {})
    for group in runs.parts(min(runs.durations_s.values())):
        figures.summaries.append([])
        figures.outcomes.append([])
        for part in group:
            if len(runs.durations_s) > 1:
                summary = _summarise(connection, part, signals, runs.deadline, figures.unread)
                figures.summaries[-1].append(summary)
            outcome = outcome_of(connection, part, runs.options, runs.deadline)
            figures.outcomes[-1].append(outcome)
            part.rows.frame.forget()
    return figures


def _of_text(signal: RegisteredSignal, groups: int) -> Difference:
    """A text that was asked for: it has no mean, and the answer says what compares it."""
    return Difference(
        name=signal.name,
        kind=signal.kind,
        unit=None,
        mean=[None] * groups,
        deviation=[None] * groups,
        min=[None] * groups,
        max=[None] * groups,
        count=[None] * groups,
        deviation_ratio=[None] * groups,
        effect=[None] * groups,
        different=[None] * groups,
        interval=[None] * groups,
        deviation_different=[None] * groups,
        deviation_interval=[None] * groups,
        reasons=[f"its values are texts: mode='{signal.name}' compares the time in each"] * groups,
        asked=True,
    )


class _Runs:
    """The runs of a comparison, read one after the other.

    Attributes:
        durations_s: Of each run, from its first row to its last.
        goals: Of the runs that had one.
        known: All signals of the robots.

    Raises:
        NothingRecordedError: A run has no state row.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        groups: Sequence[Group],
        options: EventOptions,
        deadline: Deadline,
    ) -> None:
        self._connection = connection
        self._groups = groups
        self.options = options
        self.deadline = deadline
        run_ids = [run.run_id for group in groups for run in group.runs]
        self._segments = {run_id: _whole_run(connection, run_id) for run_id in run_ids}
        self._robots = {run_id: fetch_run(connection, run_id).robot_id for run_id in run_ids}
        self.durations_s = {
            run_id: segment.end_s - segment.start_s for run_id, segment in self._segments.items()
        }
        self.goals: dict[int, RunGoal] = {}
        self._known: dict[int, dict[str, RegisteredSignal]] = {}
        for robot_id in dict.fromkeys(self._robots.values()):
            own = [run_id for run_id in run_ids if self._robots[run_id] == robot_id]
            self.goals |= goals_of(connection, robot_id, own)
            segments = tuple(self._segments[run_id] for run_id in own)
            time_range = TimeRange(robot_id, "", segments, "simulation")
            self._known[robot_id] = known_signals(connection, time_range)
        self._frames = [[self._frame(run.run_id) for run in group.runs] for group in groups]
        self._interval_s = shared_interval_s(self._frames)

    @property
    def known(self) -> dict[str, RegisteredSignal]:
        robots = reversed(list(self._known.values()))
        return {name: signal for known in robots for name, signal in known.items()}

    def _frame(self, run_id: int) -> Frame:
        """All rows of a run, without those that only a full-rate segment has if it has others."""
        segment, deadline = self._segments[run_id], self.deadline
        frame = read_frame(self._connection, segment, deadline, full_rate=False)
        if segment.full_rate and len(frame) < 2:
            return read_frame(self._connection, segment, deadline)
        return frame

    def parts(self, compared_s: float) -> Iterator[Iterator[RunPart]]:
        """The compared part of each run of each group."""
        for group, frames in zip(self._groups, self._frames, strict=True):
            newest = sorted((run.run_id for run in group.runs), reverse=True)[:MOST_SEARCHED]
            yield (
                self._part(run, frame, compared_s, searched=run.run_id in newest)
                for run, frame in zip(group.runs, frames, strict=True)
            )

    def _part(self, run: RunInfo, frame: Frame, compared_s: float, *, searched: bool) -> RunPart:
        whole = self._segments[run.run_id]
        end_s = whole.start_s + compared_s
        segment = whole if end_s >= whole.end_s else whole.until(end_s)
        robot_id = self._robots[run.run_id]
        known = self._known[robot_id]
        return RunPart(
            robot_id,
            run,
            whole,
            segment,
            known,
            motion_in(frame, known, self.options),
            SampledRun(frame, self._interval_s, segment.end_s),
            self.goals.get(run.run_id),
            searched,
        )


def _whole_run(connection: sqlite3.Connection, run_id: int) -> Segment:
    segment = whole_run(connection, run_id)
    if segment is None:
        raise NothingRecordedError(
            f"Run {run_id} has no state row, so there is nothing to compare. Choose "
            "another run from webots_list_runs."
        )
    return segment


def _goal_notes(goals: dict[int, RunGoal], durations_s: dict[int, float]) -> list[str]:
    """That a run which never reached its goal is not better for having been shorter."""
    missed = [run_id for run_id in durations_s if run_id in goals and goals[run_id].took_s is None]
    if not missed:
        return []
    named = listed([f"{run_id} (after {durations_s[run_id]:.4g} s)" for run_id in missed])
    return [
        f"goal not reached by run {named}: {goals[missed[0]].condition}. Its other figures hold "
        "for the time it ran; less time or distance is no advantage"
    ]


def _repeats(connection: sqlite3.Connection, run_ids: Sequence[int]) -> dict[str, list[int]]:
    """Runs by robot, code and parameters, if that makes groups; by themselves where it does not."""
    if not 1 <= len(run_ids) <= MOST_COMPARED or len(set(run_ids)) < len(run_ids):
        found = len(run_ids) if len(run_ids) > MOST_COMPARED else list(run_ids)
        raise InvalidInputError(
            f"run_ids must be 1 to {MOST_COMPARED} different runs, not {found}. "
            "webots_list_runs shows the runs."
        )
    had = parameters_of(connection, run_ids)
    groups: dict[object, list[int]] = {}
    for run_id, run in zip(run_ids, run_infos(connection, run_ids), strict=True):
        values = sorted((name, repr(each.values)) for name, each in had.get(run_id, {}).items())
        code = run.controller_sha256 or run_id  # of unknown code nothing is a repeat
        groups.setdefault((run.robot, code, *values), []).append(run_id)
    alike = groups.values() if len(groups) > 1 else [[run_id] for run_id in run_ids]
    return {_name_of(each): each for each in alike}


def _name_of(run_ids: Sequence[int]) -> str:
    if len(run_ids) > _MOST_NAMED:
        return f"{len(run_ids)} runs from {run_ids[0]} to {run_ids[-1]}"
    return f"run{'s' * (len(run_ids) > 1)} {', '.join(map(str, run_ids))}"


def _around_last_edit(connection: sqlite3.Connection, robot: str | None) -> dict[str, list[int]]:
    robot_id = resolve_robot(connection, robot, time.time()).id
    runs = connection.execute(
        "SELECT r.id, s.controller_sha256 FROM run r JOIN session s ON s.id = r.session_id "
        "WHERE r.robot_id = ? "
        "AND (r.row_count > 0 OR EXISTS (SELECT 1 FROM state WHERE run_id = r.id)) "
        "ORDER BY r.id DESC",
        (robot_id,),
    ).fetchall()
    blocks = [[run_id for run_id, _ in each] for _, each in groupby(runs, lambda run: run[1])][:2]
    if len(blocks) < 2:
        raise NothingRecordedError(
            "Every recorded run had the same controller file, so there is no edit to compare. "
            "Give two or more run_ids; webots_list_runs shows them."
        )
    after, before = (each[:MOST_OF_EDIT][::-1] for each in blocks)
    return {"before": before, "after": after}


def _notes(groups: Sequence[Group]) -> list[str]:
    runs = [run for group in groups for run in group.runs]
    notes: list[str] = []
    if 1 < len(runs) == len(groups):
        notes.append("one run each: a difference may be normal variation between runs; repeat them")
    robots = list(dict.fromkeys(run.robot for run in runs))
    if len(robots) > 1:
        notes.append(f"these are runs of different robots: {', '.join(robots)}")
    return notes


def _cut_notes(durations_s: dict[int, float], compared_s: float) -> list[str]:
    """That longer runs are compared in a part only."""
    longer = [run_id for run_id, each_s in durations_s.items() if each_s > _AS_LONG * compared_s]
    if not longer:
        return []
    moments = [str(run_id) for run_id, each_s in durations_s.items() if each_s < SAME_TIME_S]
    if moments:
        return [
            f"all figures are about the first moment of each run, for run {', '.join(moments)} has "
            "no other: ask again without it"
        ]
    which = ", ".join(f"{run_id} ({durations_s[run_id]:.4g} s)" for run_id in longer)
    return [
        f"all figures are about the first {compared_s:.4g} s; for the rest of run {which} ask "
        f"webots_find_events(run_id={longer[0]})"
    ]


def _summarise(
    connection: sqlite3.Connection,
    part: RunPart,
    signals: Sequence[RegisteredSignal],
    deadline: Deadline,
    unread: dict[str, None],
) -> dict[str, Summary] | None:
    """Each signal that the run has over its compared stretch; None where not all was read."""
    rows, found = part.rows, dict[str, Summary]()
    frame, kept = (
        rows.frame,
        read_kept(connection, replace(part.segment, full_rate=False), deadline),
    )
    for signal in (part.known[each.name] for each in signals if each.name in part.known):
        if deadline.passed:
            break
        found[signal.name] = rows.summary_of(signal)
        if kept is not None and signal.name in kept:
            found[signal.name] = with_extremes(
                found[signal.name], frame_summary.summary_of(kept, signal)
            )
    if deadline.passed or frame.cut_at_s is not None:
        unread[OUT_OF_TIME] = None
        return None
    unread |= dict.fromkeys(f"run {part.segment.run_id}: {each}" for each in frame.unread)
    return None if frame.unread else found


def _groups(
    connection: sqlite3.Connection, groups: Mapping[str, Sequence[int]]
) -> tuple[Group, ...]:
    run_ids = [run_id for found in groups.values() for run_id in found]
    runs = {run.run_id: run for run in run_infos(connection, run_ids)}
    unlike = differing(list(parameters_of(connection, run_ids).values()))
    return tuple(
        _group(name, [runs[run_id] for run_id in found], unlike) for name, found in groups.items()
    )


def _group(name: str, runs: Sequence[RunInfo], unlike: Sequence[str]) -> Group:
    had = {each: [r.parameters[each] for r in runs if each in r.parameters] for each in unlike}
    parameters = {each: tuple(dict.fromkeys(values)) for each, values in had.items() if values}
    return Group(name, tuple(runs), sum(run.duration_s for run in runs), parameters)
