"""`compare_runs`: what a run came to, and whether it is better than the last one, and in what."""

from __future__ import annotations

import math
import sqlite3
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from webots_mcp.analysis.summary import MIN_EFFECT_SD, Spread, Summary, spread_of, verdicts_on
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.kinds import EventOptions
from webots_mcp.judging.detection.search import motion_in
from webots_mcp.judging.run_measures import OUT_OF_TIME, Measure, RunPart, outcomes_of
from webots_mcp.signals.conditions.signal_values import SAME_TIME_S
from webots_mcp.signals.parameter import Value
from webots_mcp.store.parameters import differing, parameters_of, scored_runs
from webots_mcp.store.reading.catalogue import catalogue, resolve_signals
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.frame_summary import summary_of
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline, Subject, in_one_snapshot
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import RunInfo, run_infos
from webots_mcp.store.signals import RegisteredSignal

# -- how a signal differs between groups of runs ---------------------------------------------------


_DUST: Final = 1e-9  # of a signal's largest value: what varies by less does not vary
COMPARE_DEADLINE_S: Final = 5.0
MOST_COMPARED: Final = 10
MOST_SETS: Final = 5  # of a trial set
_AS_LONG: Final = 1.01  # times the compared stretch: the ends of like runs differ by a few rows
_CODE_OF_RUNS: Final = (
    "SELECT r.id, s.controller_sha256 FROM run r JOIN session s ON s.id = r.session_id "
    "WHERE r.robot_id = ? "
    "AND (r.row_count > 0 OR EXISTS (SELECT 1 FROM state WHERE run_id = r.id)) "
    "ORDER BY r.id DESC"
)


@dataclass(frozen=True)
class Difference:
    """A signal in each group, over the compared stretch; lists are in the order of the groups.

    Attributes:
        mean: Over the runs of the group; of an angle the circular mean.
        deviation: The standard deviation within a run, over the runs of the group.
        deviation_ratio: Of its median to that of the first group; None where that is 0.
        effect: How far each mean is from that of the first group, in pooled standard deviations:
            Cohen's d, (m - m1) / sqrt((s1**2 + s**2) / 2) (J. Cohen, Statistical Power Analysis
            for the Behavioral Sciences, 2nd ed. 1988, section 2.2 with the note on unequal
            deviations); 0.2 is called small, 0.5 medium, 0.8 large. None where it is not defined:
            without values, or both constant and not equal. Rows follow each other too closely to
            be independent, so it describes, and proves nothing.
        different: Whether the means or the deviations differ by more than those of like runs do;
            None where that cannot be decided (`analysis.summary`).
        interval: The difference of the means of the groups lies in it nine times of ten.
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


def difference_of(
    signal: RegisteredSignal,
    groups: Sequence[Sequence[dict[str, Summary] | None]],
    tests: int,
    min_effect_sd: float,
) -> Difference:
    """A signal in each run of each group.

    Args:
        signal: Which.
        groups: Of each run its summaries; None of one of which not all was read.
        tests: So many are made at once.
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
    verdicts = zip(of_means, of_deviations, strict=True)
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
        different=[_either(a.different, b.different) for a, b in verdicts],
        interval=[each.interval for each in of_means],
    )


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


def _either(one: bool | None, other: bool | None) -> bool | None:
    return True if one or other else None if None in (one, other) else False


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
    return any(difference.different), max((0.0, *effects, *doublings))


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
        raise InvalidInputError(f"min_effect_sd={min_effect_sd} must be a number above 0")
    notes: list[str] = []
    if run_ids is not None:
        groups = _repeats(connection, run_ids)
    elif set_id is not None:
        found = scored_runs(connection, set_id)
        groups = {name: found[name][:MOST_COMPARED] for name in list(found)[:MOST_SETS]}
        if len(found) > len(groups):
            notes += [f"the best {len(groups)} of {len(found)} sets of parameters"]
    else:
        groups = _around_last_edit(connection, robot)
    options = options or EventOptions()
    deadline = Deadline(deadline_s)
    parts = [
        [_part(connection, run_id, options, deadline) for run_id in found]
        for found in groups.values()
    ]
    segments = [part.segment for found in parts for part in found]
    durations_s = {segment.run_id: segment.end_s - segment.start_s for segment in segments}
    compared_s = min(durations_s.values())
    cut = [[each.cut(compared_s) for each in found] for found in parts]
    unread: dict[str, None] = {}
    differences = _differences(connection, cut, names, min_effect_sd, deadline, unread)
    shared = [each for each in differences if 0 not in each.count]
    shared.sort(key=size_of, reverse=True)
    compared = _groups(connection, groups)
    outcomes = outcomes_of(connection, cut, options, deadline, min_effect_sd)
    return Comparison(
        groups=compared,
        compared_s=compared_s,
        measures=outcomes.measures,
        unknown=outcomes.unknown
        | ({"means of signals": "; ".join(unread)} if unread and differences else {}),
        differences=tuple(shared[:limit]),
        total=len(shared),
        only_in=only_in(differences, list(groups)),
        notes=(*notes, *_notes(compared), *_cut_notes(durations_s, compared_s)),
    )


def _repeats(connection: sqlite3.Connection, run_ids: Sequence[int]) -> dict[str, list[int]]:
    """Runs by robot, code and parameters, if that makes groups; by themselves where it does not."""
    if not 1 <= len(run_ids) <= MOST_COMPARED or len(set(run_ids)) < len(run_ids):
        raise InvalidInputError(f"give 1 to {MOST_COMPARED} different runs, not {list(run_ids)}")
    had = parameters_of(connection, run_ids)
    groups: dict[object, list[int]] = {}
    for run_id, run in zip(run_ids, run_infos(connection, run_ids), strict=True):
        values = sorted((name, repr(each.values)) for name, each in had.get(run_id, {}).items())
        code = run.controller_sha256 or run_id  # of unknown code nothing is a repeat
        groups.setdefault((run.robot, code, *values), []).append(run_id)
    alike = groups.values() if len(groups) > 1 else [[run_id] for run_id in run_ids]
    return {f"run{'s' * (len(each) > 1)} {', '.join(map(str, each))}": each for each in alike}


def _around_last_edit(connection: sqlite3.Connection, robot: str | None) -> dict[str, list[int]]:
    robot_id = resolve_robot(connection, robot, time.time()).id
    runs = connection.execute(_CODE_OF_RUNS, (robot_id,)).fetchall()
    blocks = [[run_id for run_id, _ in each] for _, each in groupby(runs, lambda run: run[1])][:2]
    if len(blocks) < 2:
        raise NothingRecordedError(
            "every recorded run had the same controller file: there is no edit to compare across; "
            "give two or more run_ids (webots_list_runs has them)"
        )
    after, before = (each[:MOST_COMPARED][::-1] for each in blocks)
    return {"before": before, "after": after}


def _differences(
    connection: sqlite3.Connection,
    groups: Sequence[Sequence[RunPart]],
    names: Sequence[str],
    min_effect_sd: float,
    deadline: Deadline,
    unread: dict[str, None],
) -> list[Difference]:
    """The numbers of those names, group by group; none for a single run; into `unread` why."""
    parts = [part for group in groups for part in group]
    known = {name: signal for part in reversed(parts) for name, signal in part.known.items()}
    found = resolve_signals(known, names)
    numbers = [each for each in found if each.is_number and len(parts) > 1]
    summaries = [
        [_summarise(connection, part, numbers, deadline, unread) for part in group]
        for group in groups
    ]
    tests = 2 * len(numbers)
    return [difference_of(signal, summaries, tests, min_effect_sd) for signal in numbers]


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
        "webots_find_events(run_id)"
    ]


def _part(
    connection: sqlite3.Connection, run_id: int, options: EventOptions, deadline: Deadline
) -> RunPart:
    robot_id = fetch_run(connection, run_id).robot_id
    segment = whole_run(connection, run_id)
    if segment is None:
        raise NothingRecordedError(f"run {run_id} has no state row: there is nothing to compare")
    known = catalogue(connection, Subject(robot_id, "", run_id))
    frame = read_frame(connection, segment, deadline)
    return RunPart(robot_id, segment, known, motion_in(frame, known, options))


def _summarise(
    connection: sqlite3.Connection,
    part: RunPart,
    signals: Sequence[RegisteredSignal],
    deadline: Deadline,
    unread: dict[str, None],
) -> dict[str, Summary] | None:
    """Each signal that the run has over its compared stretch; None where not all was read."""
    frame = read_frame(connection, part.segment, deadline)
    found: dict[str, Summary] = {}
    for signal in (part.known[each.name] for each in signals if each.name in part.known):
        if deadline.passed:
            break
        found[signal.name] = summary_of(frame, signal)
    if deadline.passed or frame.cut_at_s is not None:
        unread[OUT_OF_TIME] = None
        return None
    unread |= dict.fromkeys(f"run {part.segment.run_id}: {each}" for each in frame.unread)
    return None if frame.unread else found


def _groups(connection: sqlite3.Connection, groups: dict[str, list[int]]) -> tuple[Group, ...]:
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
