"""The runs in a picture: what was recorded of each, and its events.

Several runs in one picture each begin at time 0.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_kinds import drawn_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, Found, find_events
from webots_mcp.judging.detection.search import find_motion
from webots_mcp.judging.verdicts import Verdicts, cause_of
from webots_mcp.plotting.canvas import short
from webots_mcp.plotting.colours import EVENT_COLOURS
from webots_mcp.plotting.intervals import Interval, Lane
from webots_mcp.store.reading.catalogue import one_signal, signals_of
from webots_mcp.store.reading.ranges import TimeRange, recorded_bounds
from webots_mcp.store.reading.segment import QUESTION_DEADLINE_S, SEARCH_DEADLINE_S
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.run_parameters import differing, parameters_of
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.signal_history import MOST_POINTS, History, RunHistory, query_history

Known = dict[str, RegisteredSignal]
MOST_CHANGES: Final = 5000  # of one text or flag; more would be a grey haze
MOST_RUNS: Final = 10  # each with a colour and dashes of its own
MOST_EVENTS: Final = 500
MOST_LANES: Final = 5  # in one picture


@dataclass(frozen=True)
class PlottedRun:
    """One run of a picture.

    Attributes:
        range: The run's part of what was asked for.
        name: "run 3", with its label where it has one, and the parameters in which the runs differ.
        start_s: The first moment that was recorded and asked for; `end_s` the last one.
        origin_s: The simulation time that is drawn as 0.
    """

    range: TimeRange
    name: str
    run: RunHistory
    start_s: float
    end_s: float
    origin_s: float

    @property
    def has_rows(self) -> bool:
        """Whether anything was recorded; where there was no time to read it, something may be."""
        is_empty = self.run.rows == 0 and self.run.cut_at_s is None
        return not is_empty and self.start_s <= self.end_s

    @property
    def unread(self) -> Interval | None:
        """The interval that was not read completely; None if all was read."""
        cut_s = self.run.cut_at_s
        if cut_s is None:
            return None
        return Interval("", min(max(cut_s, self.start_s), self.end_s), self.end_s)

    @property
    def robot(self) -> str:
        """Whose run it is."""
        return self.range.robot

    @property
    def notes(self) -> tuple[str, ...]:
        """Where the range reaches outside the recording, and what of it could not be read."""
        unread = (f"run {self.run.run_id}: {each}" for each in self.run.unread)
        return (*self.range.notes, *unread)


def plotted_runs(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    points: int = MOST_POINTS,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> list[PlottedRun]:
    """Read the signals of each run in the ranges; several runs begin at 0 each.

    Args:
        connection: Any.
        ranges: Those of the picture.
        names: Signals, with `*`.
        points: The most buckets of a run; the buckets of all runs have one length.
        deadline_s: After it nothing more is read of a range, and the part says from where on.

    Raises:
        UnknownSignalError: A name meets nothing.
        InvalidInputError: No name is given, or there are more than ten runs.
        NothingRecordedError: There is no row in the ranges.
    """
    count = sum(len(each.segments) for each in ranges)
    if count > MOST_RUNS:
        raise InvalidInputError(
            f"The range holds {count} runs, and at most {MOST_RUNS} can be drawn over each other. "
            "Name them, as in run_ids=[1, 2]; webots_list_runs shows the runs."
        )
    parts: list[PlottedRun] = []
    histories = _histories(connection, ranges, names, points, deadline_s)
    for each, history in zip(ranges, histories, strict=True):
        for segment, run in zip(each.segments, history.runs, strict=True):
            alone = replace(each, segments=(segment,))
            parts.append(_part(connection, alone, run, count > 1))
    if not any(part.has_rows for part in parts):
        notes = [note for history in histories for note in history.notes]
        raise NothingRecordedError("; ".join(["there are no values in the range", *notes]))
    return _named_by_parameters(connection, [part for part in parts if part.has_rows])


def _named_by_parameters(
    connection: sqlite3.Connection, parts: list[PlottedRun]
) -> list[PlottedRun]:
    """Runs that differ in parameters are reported apart by them: run 3 (kp 2)."""
    had = parameters_of(connection, [part.run.run_id for part in parts])
    unlike = differing(list(had.values()))[:3]
    named: list[PlottedRun] = []
    for part in parts:
        own = had[part.run.run_id]
        values = [f"{name} {short(str(own[name].described))}" for name in unlike if name in own]
        name = f"{part.name} ({', '.join(values)})" if values else part.name
        named.append(replace(part, name=name))
    return named


def _histories(
    connection: sqlite3.Connection,
    ranges: Sequence[TimeRange],
    names: Sequence[str],
    points: int,
    deadline_s: float,
) -> list[History]:
    """Return histories with the longest run's bucket length, so that equal data looks equal."""
    least_step_s = 0.0
    while True:
        histories = [
            query_history(
                connection, each, names, max_points=points, max_changes=MOST_CHANGES,
                least_step_s=least_step_s, deadline_s=deadline_s,
            )
            for each in ranges
        ]  # fmt: skip
        runs = [run for history in histories for run in history.runs if run.sim_time_s]
        steps_s = {run.step_s or 0.0 for run in runs}
        if len(steps_s) <= 1 or max(steps_s) == least_step_s:
            return histories
        least_step_s = max(steps_s)


def _part(
    connection: sqlite3.Connection, time_range: TimeRange, run: RunHistory, overlaid: bool
) -> PlottedRun:
    first_s, newest_s = recorded_bounds(connection, run.run_id) or (run.start_s, run.end_s)
    label = fetch_run(connection, run.run_id).label
    name = f"run {run.run_id}" + (f" “{short(label)}”" if label else "")
    start_s, end_s = max(run.start_s, first_s), min(run.end_s, newest_s)
    origin_s = first_s if overlaid else 0.0
    return PlottedRun(time_range, name, run, start_s, end_s, origin_s)


def title_of(parts: Sequence[PlottedRun]) -> str:
    """Robots, runs and the time range."""
    robots = " and ".join(dict.fromkeys(part.robot for part in parts))
    if len(parts) > 1:
        return f"{robots}: {', '.join(part.name for part in parts)}"
    (part,) = parts
    return f"{robots}, {part.name}, {_seconds(part.start_s)} to {_seconds(part.end_s)} s"


def _seconds(time_s: float) -> str:
    return f"{time_s:.2f}".rstrip("0").rstrip(".")


def range_notes(parts: Sequence[PlottedRun]) -> list[str]:
    """Return where a range reaches outside the recording, and what of it is not drawn."""
    notes = [note for part in parts for note in part.notes]
    notes += [f"{unread}: it took too long" for unread in unread_parts(parts)]
    return notes + [
        f"of {columns.total} changes of {columns.name} in {part.name} only the newest "
        f"{len(columns.points)} are shown"
        for part in parts
        for columns in part.run.changes
        if columns.total > len(columns.points)
    ]


def unread_parts(parts: Sequence[PlottedRun]) -> list[str]:
    """From where on not all of each run was read, of those of which not all was."""
    return [
        f"not all of {part.name} was read from {_seconds(unread.start_s)} s on"
        for part in parts
        if (unread := part.unread) is not None
    ]


def known_signals(connection: sqlite3.Connection, ranges: Sequence[TimeRange]) -> Known:
    """Return all signals of the robot of the last range, by name.

    Raises:
        NothingRecordedError: No range is given.
        UnknownSignalError: No signal has been recorded.
    """
    if not ranges:
        raise NothingRecordedError(
            "No run is given, so there is nothing to draw. webots_list_runs shows the runs."
        )
    return {signal.name: signal for signal in signals_of(connection, ranges[-1], ["*"])}


def mode_signal(known: Known, wanted: str | None) -> str | None:
    """Return the text signal that colours a picture: the one wanted, else a mode.

    Raises:
        UnknownSignalError: No signal has the wanted name.
        InvalidInputError: The wanted signal holds numbers.
    """
    if wanted == "":
        return None
    if wanted is None:
        mode = find_motion(known, EventOptions()).mode
        return mode.name if mode else None
    signal = one_signal(known, wanted)
    if signal.is_number and not signal.is_choice:
        raise InvalidInputError(
            f"{wanted!r} holds numbers, but only a text or a flag can colour a picture. Name one."
        )
    return signal.name


def event_lanes(
    connection: sqlite3.Connection,
    part: PlottedRun,
    names: Sequence[str],
    rows: int = MOST_LANES,
    known: Mapping[int, Found] | None = None,
    deadline_s: float = SEARCH_DEADLINE_S,
) -> tuple[list[Lane], list[str]]:
    """One lane per kind of event, and notes: of the drawn signals, and of the robot as a whole.

    Args:
        connection: Any.
        part: The run.
        names: The drawn signals.
        rows: Number of lanes that fit.
        known: By run, what an earlier search of all of it found.
        deadline_s: For the search; a note says which kinds were not searched for.
    """
    most = min(rows, MOST_LANES)
    drawn = tuple(kind.name for kind in drawn_kinds())
    options = EventOptions(kinds=drawn, signals=tuple(names))
    found = _found(connection, part, options, known or {}, deadline_s)
    kinds = [kind for kind in drawn if any(event.kind == kind for event in found.events)]
    lanes = [_lane(kind, found, part) for kind in kinds[:most]]
    notes = list[str]()
    if not known:
        notes = [note for note in found.notes if note not in part.notes]
        notes += _unsearched(found.verdicts)
    if found.left_out:
        kind, rest = max(found.left_out.items(), key=lambda item: item[1].count)
        notes.append(
            f"Not drawn: {rest.count} events of kind {kind} up to {rest.last.start_s:.3f} s"
        )
    if left_out := kinds[most:]:
        notes.append(f"No room for events of kind {', '.join(left_out)}")
    return lanes, notes


def _unsearched(verdicts: Verdicts) -> list[str]:
    """Return in one line the kinds that no signal shows, and why others were searched in part.

    Where a picture shows no number there is none to be judged, which is no news.
    """
    of_numbers = {kind.name for kind in drawn_kinds() if kind.of_numbers}
    nowhere = [kind for kind in verdicts.reasons if verdicts.why_unsearched(kind) is not None]
    undrawn = [kind for kind in nowhere if kind in of_numbers]
    lacking = [kind for kind in nowhere if kind not in undrawn and _is_absent(verdicts, kind)]
    notes = list[str]()
    if lacking:
        notes = [f"Not searched for {', '.join(lacking)}: what would show them is not recorded"]
    kinds_of = dict[str, list[str]]()
    for kind, reasons in verdicts.reasons.items():
        if kind not in lacking and kind not in undrawn:
            kinds_of.setdefault("; ".join(reasons), []).append(kind)
    return notes + [
        f"Not searched everywhere for {', '.join(kinds)}: {why}" for why, kinds in kinds_of.items()
    ]


def _is_absent(verdicts: Verdicts, kind: str) -> bool:
    """Return whether a kind was not searched only because no signal shows it."""
    coverage = verdicts.coverage.get(kind)
    causes = [each.cause for each in coverage.missing] if coverage else []
    causes += map(cause_of, verdicts.reasons[kind])
    return set(causes) == {"absent"}


def _lane(kind: str, found: Events, part: PlottedRun) -> Lane:
    events = sorted((e for e in found.events if e.kind == kind), key=lambda event: event.start_s)
    intervals = [_interval(event, part).moved(part.origin_s) for event in events]
    place = [each.name for each in drawn_kinds()].index(kind)
    return Lane(kind, intervals, (), colour=EVENT_COLOURS[place % len(EVENT_COLOURS)])


def _interval(event: Event, part: PlottedRun) -> Interval:
    """Named by what it is about: the signal, the action, the level, or what the bridge noticed."""
    what = event.details.get("what") if event.kind == "bridge_event" else event.name
    return _within(Interval(str(what or ""), event.start_s, event.end_s), part)


def _within(interval: Interval, part: PlottedRun) -> Interval:
    """Return what of an event is in the picture: it may have begun before, and gone on."""
    start_s = max(interval.start_s, min(part.start_s, interval.end_s))
    return Interval(interval.value, start_s, min(interval.end_s, max(part.end_s, start_s)))


def _found(
    connection: sqlite3.Connection,
    part: PlottedRun,
    options: EventOptions,
    known: Mapping[int, Found],
    deadline_s: float = SEARCH_DEADLINE_S,
) -> Events:
    """Return what is drawn of a run: searched for, or out of what was searched before."""
    if (before := known.get(part.run.run_id)) is None:
        return find_events(
            connection, part.range, options, limit=MOST_EVENTS, around=(), group=False,
            deadline_s=deadline_s,
        )  # fmt: skip
    of_numbers = {kind.name for kind in drawn_kinds() if kind.of_numbers}
    undrawn = known_signals(connection, [part.range]).keys() - set(options.signals)
    drawn = [
        event
        for event in before.events
        if event.kind in options.kinds
        if event.kind not in of_numbers or event.name not in undrawn
    ]
    return replace(before.only(drawn), context=()).page(connection, MOST_EVENTS)


def stuck_mark(
    connection: sqlite3.Connection,
    part: PlottedRun,
    position: tuple[str, str],
    deadline_s: float,
    known: Mapping[int, Found] | None = None,
) -> tuple[Lane, list[str]]:
    """Return when the robot was stuck, and where that was not searched for."""
    options = EventOptions(kinds=("stuck",), signals=position, position=position)
    found = _found(connection, part, options, known or {}, deadline_s)
    intervals = [_within(Interval("stuck", e.start_s, e.end_s), part) for e in found.events]
    lane = Lane(f"stuck over {options.stuck_s:g} s", intervals, ())
    return lane, [] if known else _unsearched(found.verdicts)


# What surrounds axes: titles, ticks, marks, and a legend in as many rows as it needs.


# Marks --------------------------------------------------------------------------------------------
