"""`compare_runs`: is this run better than the last one, and in what?"""

from __future__ import annotations

import math
import sqlite3
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.store.analysis.motion import Motion, find_motion, path_length
from webots_mcp.store.analysis.summary import Summary, merge
from webots_mcp.store.detection.event import Event, EventOptions, Kind
from webots_mcp.store.questions.events import collect
from webots_mcp.store.questions.runs import RunInfo, run_info
from webots_mcp.store.reading.changes import change_points, longest_values
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange, whole_run
from webots_mcp.store.reading.rollups import read_pieces
from webots_mcp.store.reading.rows import exceeds, read_columns
from webots_mcp.store.reading.sampling import MOST_SAMPLES, read_sampled
from webots_mcp.store.reading.snapshot import in_one_snapshot
from webots_mcp.store.reading.subject import Subject
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.runs import fetch_run
from webots_mcp.store.signals.catalogue import catalogue, resolve_signals
from webots_mcp.store.signals.registry import Signal

COMPARE_DEADLINE_S: Final = 5.0
MOST_COMPARED: Final = 10
SAMPLE_S: Final = 0.5  # between the positions from which a long run's distance is summed
COUNTED: Final[tuple[Kind, ...]] = (
    "gap", "change", "stuck", "silent", "flat", "jump", "oscillation", "command", "log", "noticed",
)  # fmt: skip

_CODE_OF_RUNS: Final = (
    "SELECT r.id, s.controller_sha256 FROM run r JOIN session s ON s.id = r.session_id "
    "WHERE r.robot_id = ? AND (r.rows > 0 OR EXISTS (SELECT 1 FROM state WHERE run_id = r.id)) "
    "ORDER BY r.id DESC"
)


@dataclass(frozen=True)
class Group:
    """Runs that are looked at as one: a single run, or all with the same code.

    Attributes:
        duration_s: Simulated seconds, of all its runs together like the next three.
        distance_m: Travelled; None if one of its runs publishes no position, or lost rows to a
            purge: summaries of 10 s do not tell the way in between.
        time_by_mode_s: Simulated seconds in each mode; empty if no mode is published.
        events: How many of each kind.
    """

    name: str
    runs: tuple[RunInfo, ...]
    duration_s: float
    distance_m: float | None
    time_by_mode_s: dict[str, float]
    events: dict[Kind, int]


@dataclass(frozen=True)
class Difference:
    """A signal in each group, over the compared stretch; lists are in the order of the groups.

    Attributes:
        mean: Of an angle the circular mean.
        effect: How far each mean is from that of the first group, in pooled standard deviations:
            Cohen's d, (m - m1) / sqrt(((n1 - 1) s1**2 + (n - 1) s**2) / (n1 + n - 2)) (J. Cohen,
            Statistical Power Analysis for the Behavioral Sciences, 2nd ed. 1988, section 2.5.2);
            0.2 is called small, 0.5 medium, 0.8 large. None where it is not defined: without
            values, or both constant and not equal. Rows follow each other too closely to be
            independent, so it describes, and proves nothing.
    """

    name: str
    kind: str
    unit: str | None
    mean: list[float | None]
    deviation: list[float | None]
    min: list[float | None]
    max: list[float | None]
    count: list[int]
    effect: list[float | None]


@dataclass(frozen=True)
class Comparison:
    """The answer of `compare_runs`.

    Attributes:
        compared_s: The differences are about the first so many simulated seconds of each run, as
            many as the shortest has.
        differences: What differs most comes first; at most `limit` of `total`.
        only_in: Signals that not every group has, with the groups that have them.
        notes: What is not complete.
    """

    groups: tuple[Group, ...]
    compared_s: float
    differences: tuple[Difference, ...]
    total: int
    only_in: dict[str, tuple[str, ...]]
    notes: tuple[str, ...]


@in_one_snapshot
def compare_runs(
    connection: sqlite3.Connection,
    run_ids: Sequence[int],
    *,
    names: Sequence[str] = ("*",),
    limit: int = 30,
    options: EventOptions | None = None,
    deadline_s: float = COMPARE_DEADLINE_S,
) -> Comparison:
    """Compare two or more runs, aligned at their start; the first one is the reference.

    Args:
        connection: Any.
        run_ids: 2 to 10 different runs.
        names: Signals, with `*`.
        limit: At most so many differences.
        options: What counts as an event, and what the position and the mode are.
        deadline_s: After it, the answer is made from what was read, and the notes say so.

    Raises:
        InvalidInputError: Fewer than 2 or more than 10 runs, or one twice.
        UnknownRunError, UnknownSignalError: As they say.
        NothingRecordedError: A run has no state row.
    """
    if not 2 <= len(run_ids) <= MOST_COMPARED or len(set(run_ids)) < len(run_ids):
        raise InvalidInputError(
            f"give 2 to {MOST_COMPARED} different runs to compare, not {list(run_ids)}"
        )
    groups = {f"run {run_id}": [run_id] for run_id in run_ids}
    return _compare(connection, groups, names, limit, options or EventOptions(), deadline_s)


@in_one_snapshot
def compare_code(
    connection: sqlite3.Connection,
    *,
    robot: str | None = None,
    names: Sequence[str] = ("*",),
    limit: int = 30,
    options: EventOptions | None = None,
    deadline_s: float = COMPARE_DEADLINE_S,
) -> Comparison:
    """Compare the runs before and after the last edit of the robot's controller.

    An edit is seen by the SHA-256 of the controller file: "after" are the newest runs that share
    one, "before" those just before them that share another; at most the newest 10 of each.

    Raises:
        NothingRecordedError: All runs had the same code.
        UnknownRobotError, AmbiguousRobotError, UnknownSignalError: As they say.
    """
    robot_id = resolve_robot(connection, robot, time.time()).id
    runs = connection.execute(_CODE_OF_RUNS, (robot_id,)).fetchall()
    blocks: list[tuple[str | None, list[int]]] = []
    for run_id, code in runs:
        if not blocks or blocks[-1][0] != code:
            if len(blocks) == 2:
                break
            blocks.append((code, []))
        blocks[-1][1].append(run_id)
    if len(blocks) < 2:
        raise NothingRecordedError(
            "every recorded run had the same controller file: there is no edit to compare across"
        )
    (_, after), (_, before) = blocks
    groups = {"before": before[:MOST_COMPARED][::-1], "after": after[:MOST_COMPARED][::-1]}
    return _compare(connection, groups, names, limit, options or EventOptions(), deadline_s)


def _compare(
    connection: sqlite3.Connection,
    groups: dict[str, list[int]],
    names: Sequence[str],
    limit: int,
    options: EventOptions,
    deadline_s: float,
) -> Comparison:
    parts = {
        name: [_part(connection, run_id, options) for run_id in run_ids]
        for name, run_ids in groups.items()
    }
    every = [part for found in parts.values() for part in found]
    compared_s = min(part.segment.end_s - part.segment.start_s for part in every)
    known = {name: signal for part in reversed(every) for name, signal in part.known.items()}
    numbers = [signal for signal in resolve_signals(known, names) if signal.is_number]
    deadline = Deadline(deadline_s)
    summaries = [
        _summarise(connection, found, numbers, compared_s, deadline) for found in parts.values()
    ]
    differences = [_difference(signal, summaries) for signal in numbers]
    shared = sorted((each for each in differences if all(each.count)), key=_size, reverse=True)
    told = tuple(
        _group(connection, name, found, options, deadline) for name, found in parts.items()
    )
    notes = _notes([run for group in told for run in group.runs])
    if deadline.passed:
        notes.append(f"the time of {deadline_s:g} s was over: not all rows were looked at")
    return Comparison(
        groups=told,
        compared_s=compared_s,
        differences=tuple(shared[:limit]),
        total=len(shared),
        only_in=_only_in(differences, list(groups)),
        notes=tuple(notes),
    )


def _notes(runs: Sequence[RunInfo]) -> list[str]:
    notes: list[str] = []
    robots = list(dict.fromkeys(run.robot for run in runs))
    if len(robots) > 1:
        notes.append(f"these are runs of different robots: {', '.join(robots)}")
    purged = [str(run.run_id) for run in runs if run.purged_rows]
    if purged:
        notes.append(
            f"rows of run {', '.join(purged)} were purged: events lack them, and the distance is "
            "not known (null)"
        )
    return notes


@dataclass(frozen=True)
class _Part:
    """A run, and what its own robot's signals are."""

    robot_id: int
    segment: Segment
    known: dict[str, Signal]
    motion: Motion


def _part(connection: sqlite3.Connection, run_id: int, options: EventOptions) -> _Part:
    robot_id = fetch_run(connection, run_id).robot_id
    segment = whole_run(connection, run_id)
    if segment is None:
        raise NothingRecordedError(f"run {run_id} has no state row: there is nothing to compare")
    known = catalogue(connection, Subject(robot_id, "", run_id))
    return _Part(robot_id, segment, known, find_motion(known, options))


def _summarise(
    connection: sqlite3.Connection,
    parts: Sequence[_Part],
    signals: Sequence[Signal],
    compared_s: float,
    deadline: Deadline,
) -> dict[str, Summary]:
    """Each signal over the first `compared_s` of all the runs."""
    found: dict[str, list[Summary]] = {signal.name: [] for signal in signals}
    for part in parts:
        own = [part.known[name] for name in found if name in part.known]
        stretch = replace(part.segment, end_s=part.segment.start_s + compared_s)
        pieces = read_pieces(connection, stretch, own, deadline)
        for signal in own:
            found[signal.name].append(pieces.whole(signal.name))
    return {name: merge(each) if each else Summary() for name, each in found.items()}


def _difference(signal: Signal, groups: Sequence[dict[str, Summary]]) -> Difference:
    angle = signal.kind == "angle"
    summaries = [group[signal.name] for group in groups]
    counts = [summary.present if summary.sum is not None else 0 for summary in summaries]
    means = [summary.direction if angle else summary.mean for summary in summaries]
    deviations = [each.circular_deviation if angle else each.deviation for each in summaries]
    effects = [
        _effect(mean, means[0], deviation, deviations[0], count, counts[0], angle=angle)
        for mean, deviation, count in zip(means, deviations, counts, strict=True)
    ]
    return Difference(
        name=signal.name,
        kind=signal.kind,
        unit=signal.unit,
        mean=means,
        deviation=deviations,
        min=[summary.min for summary in summaries],
        max=[summary.max for summary in summaries],
        count=counts,
        effect=effects,
    )


def _effect(
    mean: float | None,
    mean1: float | None,
    deviation: float | None,
    deviation1: float | None,
    count: int,
    count1: int,
    *,
    angle: bool,
) -> float | None:
    """Cohen's d of a group against the first; see `Difference`."""
    if mean is None or mean1 is None or deviation is None or deviation1 is None:
        return None
    apart = math.remainder(mean - mean1, 2 * math.pi) if angle else mean - mean1
    squares = (count1 - 1) * deviation1**2 + (count - 1) * deviation**2
    pooled = math.sqrt(squares / (count1 + count - 2))
    if pooled <= 1e-12 * max(abs(mean), abs(mean1)):
        return 0.0 if math.isclose(mean, mean1, rel_tol=1e-9) else None
    return apart / pooled


def _size(difference: Difference) -> float:
    """What differs most: the largest effect; constants that are not equal come before all."""
    return max(math.inf if effect is None else abs(effect) for effect in difference.effect[1:])


def _only_in(
    differences: Sequence[Difference], groups: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    return {
        each.name: tuple(group for group, count in zip(groups, each.count, strict=True) if count)
        for each in differences
        if any(each.count) and not all(each.count)
    }


def _group(
    connection: sqlite3.Connection,
    name: str,
    parts: Sequence[_Part],
    options: EventOptions,
    deadline: Deadline,
) -> Group:
    runs = tuple(run_info(connection, part.segment.run_id) for part in parts)
    distances = [
        None if run.purged_rows else _distance(connection, part, deadline)
        for run, part in zip(runs, parts, strict=True)
    ]
    known = [distance for distance in distances if distance is not None]
    distance_m = sum(known) if len(known) == len(distances) else None
    modes: dict[str, float] = {}
    for part in parts:
        for mode, seconds in _mode_times(connection, part, deadline).items():
            modes[mode] = modes.get(mode, 0.0) + seconds
    events: Counter[Kind] = Counter()
    for part in parts:
        events.update(event.kind for event in _events(connection, part, options, deadline))
    duration_s = sum(run.duration_s for run in runs)
    by_mode = dict(sorted(modes.items(), key=lambda item: -item[1]))
    return Group(name, runs, duration_s, distance_m, by_mode, dict(events))


def _distance(connection: sqlite3.Connection, part: _Part, deadline: Deadline) -> float | None:
    """Of a long run from samples, of which each cuts corners a little."""
    position = part.motion.position
    if position is None:
        return None
    if not exceeds(connection, part.segment) or not all(each.is_plain for each in position):
        columns = read_columns(connection, part.segment, position, deadline)
    else:
        every_s = max(SAMPLE_S, (part.segment.end_s - part.segment.start_s) / MOST_SAMPLES)
        columns = read_sampled(connection, part.segment, position, every_s, deadline)
    return path_length(columns, position)


def _mode_times(
    connection: sqlite3.Connection, part: _Part, deadline: Deadline
) -> dict[str, float]:
    if part.motion.mode is None:
        return {}
    points = change_points(connection, part.segment, [part.motion.mode], deadline)
    segment = part.segment
    return longest_values(points[part.motion.mode.name], segment.start_s, segment.end_s)


def _events(
    connection: sqlite3.Connection, part: _Part, options: EventOptions, deadline: Deadline
) -> list[Event]:
    kinds = tuple(kind for kind in COUNTED if kind in options.kinds)
    whole = TimeRange(part.robot_id, "", (part.segment,), "simulation")
    return collect(connection, whole, replace(options, kinds=kinds), deadline.left_s)[0]
