"""What whole runs came to, in groups: the way, the modes and the events of a stretch."""

from __future__ import annotations

import sqlite3
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from webots_mcp.store.analysis.motion import Motion, path_length, position_noise
from webots_mcp.store.analysis.spread import Spread, spread_of, verdicts_on
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.registry import asked_kinds
from webots_mcp.store.questions.events import collect
from webots_mcp.store.questions.runs import run_info
from webots_mcp.store.reading.changes import change_points, longest_values
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, TimeRange
from webots_mcp.store.reading.rows import exceeds, read_columns
from webots_mcp.store.reading.sampling import MOST_SAMPLES, newest_part, read_sampled
from webots_mcp.store.signals.registry import Signal

NOISE_ROWS: Final = 2000  # of a long run, that tell the noise of its position
SAMPLE_S: Final = 0.5  # between the positions from which a long run's distance is summed
_SHARE: Final = "share of "


@dataclass(frozen=True)
class RunPart:
    """A run, and what its own robot's signals are."""

    robot_id: int
    segment: Segment
    known: dict[str, Signal]
    motion: Motion

    def cut(self, compared_s: float) -> RunPart:
        """The first so many seconds of it."""
        end_s = self.segment.start_s + compared_s
        whole = end_s >= self.segment.end_s
        return self if whole else replace(self, segment=self.segment.until(end_s))


@dataclass(frozen=True)
class Measure:
    """What each run came to as a whole, over the compared stretch, by group.

    Attributes:
        name: distance_m, mean_speed_m_s, `share of MODE` (of the time), `KIND per min` (events).
        spread: Over the runs of the group; None where it is not known of all of them.
        different: Whether the group differs from the first by more than like runs do; None where
            that cannot be told, because both groups are one run each or a figure is missing.
    """

    name: str
    spread: list[Spread | None]
    different: list[bool | None]


def measures_of(
    connection: sqlite3.Connection,
    groups: Sequence[Sequence[RunPart]],
    options: EventOptions,
    deadline: Deadline,
) -> list[Measure]:
    """What the runs came to: the way, the modes and the events of the compared stretch."""
    found = [[_outcome(connection, part, options, deadline) for part in group] for group in groups]
    runs = [run for group in found for run in group]
    names = dict.fromkeys(name for run in runs for name in run.figures)
    kinds: list[str] = list(dict.fromkeys(kind for run in runs for kind in run.events))
    tests = len(names) + len(kinds)
    measures = [
        _measure(name, [[run.figure(name) for run in group] for group in found], tests)
        for name in names
    ]
    return measures + [
        _measure(
            f"{kind} per min",
            [[run.per_min(kind) for run in group] for group in found],
            tests,
            _chance_variance([run.per_min(kind) for run in runs], runs[0].duration_s),
        )
        for kind in kinds
    ]


def _measure(
    name: str,
    groups: Sequence[Sequence[float | None]],
    tests: int,
    least_variance: float = 0.0,
) -> Measure:
    spread = [spread_of(each) for each in groups]
    return Measure(name, spread, verdicts_on(groups, tests, least_variance))


def _chance_variance(rates: Sequence[float | None], duration_s: float) -> float:
    """Of events per minute that come by chance: the variance of a Poisson count is its mean."""
    known = [rate for rate in rates if rate is not None]
    return statistics.fmean(known) * 60 / duration_s if known and duration_s > 0 else 0.0


class _Outcome(NamedTuple):
    """What one run came to in the compared stretch.

    Attributes:
        events: How many of each kind; `complete` if all rows are there and were looked at.
    """

    duration_s: float
    figures: dict[str, float | None]
    events: Counter[str]
    complete: bool

    def figure(self, name: str) -> float | None:
        """A mode in which it never was took no time."""
        return self.figures.get(name, 0.0 if name.startswith(_SHARE) else None)

    def per_min(self, kind: str) -> float | None:
        """Events of a kind per minute, where they are known."""
        return 60 * self.events[kind] / self.duration_s if self.complete else None


def _outcome(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> _Outcome:
    duration_s = part.segment.end_s - part.segment.start_s
    purged = run_info(connection, part.segment.run_id).purged_rows > 0
    figures: dict[str, float | None] = {}
    if part.motion.position is not None:
        distance_m = None if purged else _distance(connection, part, deadline)
        speed = None if distance_m is None else distance_m / duration_s
        figures |= {"distance_m": distance_m, "mean_speed_m_s": speed}
    for mode, seconds in _mode_times(connection, part, deadline).items():
        figures[f"{_SHARE}{mode}"] = seconds / duration_s
    found = _events(connection, part, options, deadline)
    events: Counter[str] = Counter(event.kind for event in found)
    return _Outcome(duration_s, figures, events, not purged and not deadline.passed)


def _distance(connection: sqlite3.Connection, part: RunPart, deadline: Deadline) -> float | None:
    """Of a long run from samples, which cut corners a little; its newest rows tell its noise."""
    position = part.motion.position
    if position is None:
        return None
    if not exceeds(connection, part.segment) or not all(each.is_plain for each in position):
        columns = read_columns(connection, part.segment, position, deadline)
        return path_length(columns, position)
    columns = read_sampled(connection, part.segment, position, _every_s(part.segment), deadline)
    newest = newest_part(connection, part.segment, NOISE_ROWS)
    noise_m = position_noise(read_columns(connection, newest, position, deadline), position)
    return path_length(columns, position, noise_m)


def _every_s(segment: Segment) -> float:
    """Simulated seconds between the samples of a long run."""
    return max(SAMPLE_S, (segment.end_s - segment.start_s) / MOST_SAMPLES)


def sampling_notes(connection: sqlite3.Connection, parts: Sequence[RunPart]) -> list[str]:
    """Says of which runs the distance comes from samples."""
    return [
        f"the distance of run {part.segment.run_id} is that of a position each "
        f"{_every_s(part.segment):.2g} s"
        for part in parts
        if part.motion.position and exceeds(connection, part.segment)
    ]


def _mode_times(
    connection: sqlite3.Connection, part: RunPart, deadline: Deadline
) -> dict[str, float]:
    if part.motion.mode is None:
        return {}
    points = change_points(connection, part.segment, [part.motion.mode], deadline)
    segment = part.segment
    return longest_values(points[part.motion.mode.name], segment.start_s, segment.end_s)


def _events(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> list[Event]:
    kinds = tuple(kind.name for kind in asked_kinds(options) if kind.counted)
    whole = TimeRange(part.robot_id, "", (part.segment,), "simulation")
    return collect(connection, whole, replace(options, kinds=kinds), deadline.left_s).events
