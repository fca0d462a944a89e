"""What a run came to: its path, speed, modes and events, compared over groups of runs."""

from __future__ import annotations

import re
import sqlite3
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.analysis.summary import (
    Spread,
    Verdict,
    chance_of,
    chance_of_counts,
    may_differ,
    spread_of,
    verdicts_on,
)
from webots_mcp.analysis.track import PathLength, tracks_of, travelled
from webots_mcp.judging.detection.events import Found, asked_kinds, search_events
from webots_mcp.judging.detection.kinds import EventOptions
from webots_mcp.judging.detection.search import Motion, doubt_of_length, doubt_of_unit, in_metres
from webots_mcp.signals.naming import FARTHEST_M, NAME_POSITION
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.frame_summary import change_points
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.reading.unread import Unread
from webots_mcp.store.runs import run_info
from webots_mcp.store.signals import RegisteredSignal

_SHARE: Final = "share of "
_DUST: Final = 1e-9  # of a figure
_OF_THIS_RUN: Final = re.compile(r"^run \d+ lasted only [^;,]*|(?<=a period is over )\S+")
_RATE: Final = " per min"
NO_MODE: Final = (
    "no mode is known: publish one as a text, such as mode, or name the signal of one: mode=NAME"
)
NO_WAY: Final = "fewer than two rows have a position"
OUT_OF_TIME: Final = "time limit reached before all rows were read: compare fewer runs at once"
_SPEED: Final = "mean_speed_m_s"


@dataclass(frozen=True)
class Way:
    """Where a robot was in a stretch of one run.

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
    """The way of a robot in a frame, as far as it is read before the deadline."""
    x, y = (in_metres(each, frame.numbers(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    return Way(frame.times[there], x[there], y[there], frame.cut_at_s, frame.unread)


@dataclass(frozen=True)
class RunPart:
    """A run, and what its own robot's signals are."""

    robot_id: int
    segment: Segment
    known: dict[str, RegisteredSignal]
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
        name: distance_m, mean_speed_m_s, `share of MODE` (of the time), `KIND per min` (events),
            own_ms_per_step (wall time in the controller's own code, of the whole run).
        spread: Over the runs of the group; None where it is not known of all of them.
        different: Whether the group differs from the first by more than like runs do; None where
            that cannot be decided, because both groups are one run each, a figure is missing, or
            more runs are wanted; False where a difference that matters is excluded.
        runs_wanted: So many runs of each group would tell, if they went on like these; None where
            nothing shows that they would.
        interval: The difference of the means lies in it nine times of ten (`analysis.summary`).
    """

    name: str
    spread: list[Spread | None]
    different: list[bool | None]
    runs_wanted: list[int | None]
    interval: list[tuple[float, float] | None]


@dataclass(frozen=True)
class Outcomes:
    """What the runs came to.

    Attributes:
        unknown: Figures that are not known, or not wholly: of which runs, why, and what would
            make them known.
    """

    measures: tuple[Measure, ...]
    unknown: dict[str, str]


def outcomes_of(
    connection: sqlite3.Connection,
    groups: Sequence[Sequence[RunPart]],
    options: EventOptions,
    deadline: Deadline,
    min_effect_sd: float,
) -> Outcomes:
    """What the runs came to: the way, the modes and the events of the compared stretch."""
    found = [[_outcome(connection, part, options, deadline) for part in group] for group in groups]
    runs = [run for group in found for run in group]
    names = dict.fromkeys(name for run in runs for name in run.figures)
    kinds: list[str] = list(dict.fromkeys(kind for run in runs for kind in run.events))
    tests, of_more = _facts(found, list(names), kinds)
    measures = [
        _measure(name, figures, verdicts_on(figures, tests, chance_of, of_more, min_effect_sd))
        for name in names
        for figures in [[[run.figure(name) for run in group] for group in found]]
    ]
    measures += [_counted(kind, found, tests, of_more, min_effect_sd) for kind in kinds]
    return Outcomes(tuple(measures), _not_known(runs))


def _facts(
    groups: Sequence[Sequence[_Outcome]], names: Sequence[str], kinds: Sequence[str]
) -> tuple[int, int]:
    """How many figures can differ by chance, each on its own, and how many if runs are repeated.

    Not those that are the same in all runs, nor counts of too few events (`may_differ`); the
    distance and the mean speed over the same time are one fact, and the last share of the time
    follows from the others.
    """
    runs = [run for group in groups for run in group]
    vary = [name for name in names if _varies([run.figure(name) for run in runs])]
    shares = sum(name.startswith(_SHARE) for name in vary)
    alike = (_SPEED in vary) + (shares > 0)
    kinds = [kind for kind in kinds if len({run.events_of(kind) for run in runs}) > 1]
    counts = [[[run.events_of(kind) or 0 for run in group] for group in groups] for kind in kinds]
    figures, counted = len(vary) - alike, sum(map(may_differ, counts))
    return max(1, figures + counted), max(1, figures + len(kinds))


def _varies(figures: Sequence[float | None]) -> bool:
    """Whether the figures of some runs differ, by more than adding makes of one."""
    known = [figure for figure in figures if figure is not None]
    spread = max(known, default=0.0) - min(known, default=0.0)
    return len(known) < len(figures) or spread > _DUST * max(map(abs, known), default=0.0)


def _measure(
    name: str, groups: Sequence[Sequence[float | None]], verdicts: Sequence[Verdict]
) -> Measure:
    different, wanted, interval = map(list, zip(*verdicts, strict=True))
    return Measure(name, [spread_of(each) for each in groups], different, wanted, interval)


def _counted(
    kind: str,
    groups: Sequence[Sequence[_Outcome]],
    tests: int,
    of_more: int,
    min_effect_sd: float,
) -> Measure:
    """Events per minute; whether they differ is asked of their counts, in stretches of a length."""
    counts = [[run.events_of(kind) for run in group] for group in groups]
    rate = 60 / groups[0][0].duration_s
    per_min = [[None if each is None else each * rate for each in group] for group in counts]
    verdicts = verdicts_on(counts, tests, chance_of_counts, of_more, min_effect_sd)
    scaled = [
        each._replace(interval=each.interval and (each.interval[0] * rate, each.interval[1] * rate))
        for each in verdicts
    ]
    return _measure(f"{kind}{_RATE}", per_min, scaled)


def _not_known(runs: Sequence[_Outcome]) -> dict[str, str]:
    """Why figures are not known: those that share a reason under one key, reasons in one text."""
    alike: dict[tuple[str, str], dict[int, str]] = {}
    for run in runs:
        for name, reasons in run.unknown.items():
            for why in reasons:
                key = (name, _OF_THIS_RUN.sub("", why))
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


class _Outcome(NamedTuple):
    """What one run came to in the compared stretch.

    Attributes:
        has_mode: Its mode is known: one in which it never was took no time.
        events: How many of each kind.
        unknown: What is not known of it, or not wholly, with why.
        unlooked: Kinds that were not looked for at all, or not in rows that could not be read.
        complete: All rows were looked at.
    """

    run_id: int
    duration_s: float
    figures: dict[str, float | None]
    has_mode: bool
    events: Counter[str]
    unknown: dict[str, tuple[str, ...]]
    unlooked: frozenset[str]
    complete: bool

    def figure(self, name: str) -> float | None:
        """The way, or the share of the time that a mode took."""
        none = 0.0 if name.startswith(_SHARE) and self.has_mode else None
        return self.figures.get(name, none)

    def events_of(self, kind: str) -> int | None:
        """How many events of a kind, where that is known."""
        return self.events[kind] if self.complete and kind not in self.unlooked else None


def _outcome(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> _Outcome:
    run_id, duration_s = part.segment.run_id, part.segment.end_s - part.segment.start_s
    figures: dict[str, float | None] = {}
    own_ms = run_info(connection, run_id).own_ms
    if own_ms is not None:
        figures["own_ms_per_step"] = own_ms
    unknown: dict[str, tuple[str, ...]] = {}
    position = part.motion.position
    if position is None:
        unknown["distance_m, mean_speed_m_s"] = (NAME_POSITION,)
    else:
        read = way_in(read_frame(connection, part.segment, deadline), position)
        is_known = len(read.times) > 1 and not (deadline.passed or read.unread)
        way = read.length if is_known else None
        speed = None if way is None else way.length_m / duration_s
        figures |= {"distance_m": way and way.length_m, _SPEED: speed}
        doubt = OUT_OF_TIME if deadline.passed else "; ".join(map(str, read.unread))
        doubt = doubt or (NO_WAY if way is None else doubt_of_unit(position, speed or 0.0))
        if doubt := doubt or (way and doubt_of_length(way)):
            unknown["distance_m, mean_speed_m_s"] = (doubt,)
    modes, unread = _mode_times(connection, part, deadline)
    if deadline.passed or unread:
        modes = {}
    figures |= {f"{_SHARE}{mode}": seconds / duration_s for mode, seconds in modes.items()}
    if not modes:
        unknown["share of each mode"] = (OUT_OF_TIME if deadline.passed else unread or NO_MODE,)
    found = _events(connection, part, options, deadline)
    verdicts, counts = found.verdicts, Counter(event.kind for event in found.events)
    kinds = sorted(asked_kinds(options), key=lambda kind: not kind.stored)
    counts = {kind.name: counts[kind.name] for kind in kinds}
    if deadline.passed:
        unknown[f"events{_RATE}"] = (OUT_OF_TIME,)
    else:
        unknown |= {f"{kind}{_RATE}": reasons for kind, reasons in verdicts.reasons.items()}
    return _Outcome(
        run_id,
        duration_s,
        figures,
        bool(modes),
        Counter({kind: count for kind, count in counts.items() if count}),
        unknown,
        frozenset(e for e in verdicts.reasons if verdicts.unlooked(e) or verdicts.unread(e)),
        not deadline.passed,
    )


def _mode_times(
    connection: sqlite3.Connection, part: RunPart, deadline: Deadline
) -> tuple[dict[str, float], str]:
    """Seconds in each mode, and what was not read."""
    if part.motion.mode is None:
        return {}, ""
    changes = change_points(connection, part.segment, [part.motion.mode], deadline)
    times = changes.longest_values(part.motion.mode.name, part.segment.end_s)
    return times, "; ".join(map(str, changes.unread))


def _events(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> Found:
    kinds = tuple(kind.name for kind in asked_kinds(options) if kind.counted)
    whole = TimeRange(part.robot_id, "", (part.segment,), "simulation")
    wanted = replace(options, kinds=kinds)
    return search_events(
        connection, whole, wanted, around=(), group=False, deadline_s=deadline.left_s
    )
