"""`find_events`: what happened in a range, on one clock; `timeline`: the same page by page."""

from __future__ import annotations

import json
import math
import sqlite3
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any, Final

from webots_mcp.database.session_cleanup import find_dead_sessions
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event import Event, count_by_kind
from webots_mcp.judging.detection.event_kinds import asked_kinds, kind_named, stored_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import Search, events_touching, find_motion
from webots_mcp.judging.verdicts import SearchCoverage, Verdicts
from webots_mcp.signals.naming import flatten
from webots_mcp.store.chunks import parse
from webots_mcp.store.reading.catalogue import known_signals, resolve_signals
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.reading.segment import (
    QUESTION_DEADLINE_S,
    SEARCH_DEADLINE_S,
    Deadline,
    Segment,
    in_one_snapshot,
    just_after,
)
from webots_mcp.store.registered_signals import RegisteredSignal

_ERRORS: Final = ("error", "critical")  # levels of log lines
MOST_AROUND: Final = 6  # values that are reported with an event

_IS_OPEN: Final = "SELECT id, session_id, ended_wall_time_s IS NULL FROM run WHERE id = ?"
_ROW_AT: Final = (  # of a run of which the table has all rows
    "SELECT data FROM state JOIN run r ON r.id = run_id WHERE sim_time_s <= ? AND run_id = ? "
    "AND r.purged_rows = 0 ORDER BY sim_time_s DESC, state.id DESC LIMIT 1"
)


# Of an event in the one order of all: wall time, run, simulation time, kind, and its number among
# those of one kind and moment. Pages and cursors go on from it.
Place = tuple[float, int, float, str, int]
MOST_ENTRIES: Final = 500
_NO_CURSOR: Final = (
    "{!r} is not a cursor of this tool. Give the `cursor` of this tool's previous answer "
    "unchanged, or leave cursor out to begin at the start."
)


@dataclass(frozen=True)
class LeftOut:
    """Events of one kind that were found and left out: how many, and the first and the last.

    Attributes:
        errors: How many of them are log lines of level error or critical.
    """

    count: int
    first: Event
    last: Event
    errors: int = 0

    @property
    def span(self) -> str:
        """From when to when they began; each run has a time of its own."""
        first_s, last_s = round(self.first.start_s, 3), round(self.last.start_s, 3)
        if self.first.run_id == self.last.run_id:
            return f"from {first_s} to {last_s} s"
        return (
            f"from {first_s} s of run {self.first.run_id} to {last_s} s of run {self.last.run_id}"
        )


@dataclass(frozen=True)
class Events:
    """The answer of `find_events`.

    Attributes:
        events: In the order of wall time; at most `limit` of all that were found.
        verdicts: What became of each kind: found, not found, or not looked for and why.
        left_out: Events that are reported neither here nor on the pages before.
        cursor: Give it as `after` for those that are left out; None where none are.
        notes: Where the range leaves the recording, and the like.
    """

    robot: str
    events: tuple[Event, ...]
    verdicts: Verdicts
    left_out: dict[str, LeftOut]
    cursor: str | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """All that happened in a range; an answer shows a part of it.

    Attributes:
        entries: In order, without those of the pages before.
        context: The signals whose values are reported with each event.
        borders: By kind, the place before which nothing has been reported yet; None: nowhere.
    """

    robot: str
    entries: tuple[tuple[Place, Event], ...]
    verdicts: Verdicts
    notes: tuple[str, ...]
    context: tuple[RegisteredSignal, ...]
    borders: dict[str, Place | None] = field(default_factory=dict[str, "Place | None"])

    @property
    def events(self) -> list[Event]:
        """Without their places."""
        return [event for _, event in self.entries]

    def only(self, events: Sequence[Event]) -> Found:
        """The same of these events alone."""
        wanted = {id(event) for event in events}
        entries = tuple(entry for entry in self.entries if id(entry[1]) in wanted)
        counts = count_by_kind(events)
        return replace(self, entries=entries, verdicts=replace(self.verdicts, found=dict(counts)))

    def in_groups(self, known: dict[str, RegisteredSignal]) -> Found:
        """The same with many alike as one, where each was searched for by itself."""
        events = grouped(self.events, known)
        counts = count_by_kind(events)
        found = {kind: counts[kind] for kind in self.verdicts.found}
        verdicts = replace(self.verdicts, found=found)
        return replace(self, entries=tuple(placed(events)), verdicts=verdicts)

    def page(self, connection: sqlite3.Connection, limit: int) -> Events:
        """An answer of at most `limit` events: see `choose`.

        Args:
            connection: Any.
            limit: How many.
        """
        chosen = {id(event) for event in choose(self.events, limit)}
        on_page = [entry for entry in self.entries if id(entry[1]) in chosen]
        rest = [entry for entry in self.entries if id(entry[1]) not in chosen]
        return Events(
            self.robot,
            tuple(_with_values(connection, event, self.context) for _, event in on_page),
            self.verdicts,
            _left_out([event for _, event in rest]),
            _cursor(on_page, rest, self.borders),
            self.notes,
        )


def find_events(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions | None = None,
    *,
    limit: int = 50,
    around: Sequence[str] | None = None,
    group: bool = True,
    after: str | None = None,
    deadline_s: float = SEARCH_DEADLINE_S,
) -> Events:
    """What happened in a range: with its true begin and end, also where it reaches out of it.

    The verdicts say what was not searched.

    Args:
        connection: Any.
        time_range: From `find_range`.
        options: What counts as an event; None for the defaults.
        limit: The most events to return: see `choose`.
        around: Signals whose values are reported with each event; None for mode, position and
            commanded speed.
        group: Many dropouts, steps or silences of one signal are reported as one event with their
            number; else each is one.
        after: The `cursor` of an answer, for the events that it left out.
        deadline_s: After it, what was found so far is the answer, and the verdicts say what was
            not looked at.

    Raises:
        UnknownSignalError: A name in the options or in `around` meets nothing.
        InvalidInputError: `after` is no cursor.
    """
    found = search_events(
        connection, time_range, options, around=around, group=group, after=after,
        deadline_s=deadline_s,
    )  # fmt: skip
    return found.page(connection, limit)


@in_one_snapshot
def search_events(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions | None = None,
    *,
    around: Sequence[str] | None = None,
    group: bool = True,
    after: str | None = None,
    deadline_s: float = SEARCH_DEADLINE_S,
) -> Found:
    """All that happened in a range; see `find_events` for the arguments."""
    options = options or EventOptions()
    borders = _read_cursor(after) if after else {}
    kinds, known = asked_kinds(options), known_signals(connection, time_range)
    context = _context(known, options, around)
    if known and tuple(options.signals) != EventOptions.signals:  # single items of arrays as well
        known = {each.name: each for each in resolve_signals(known, options.signals)} | known
    import_module("numpy")  # once per process, before the time counts
    deadline, segments = Deadline(deadline_s), time_range.segments
    coverage = SearchCoverage(list(time_range.notes), of_several_runs=len(segments) > 1)
    found: list[Event] = []
    for index, segment in enumerate(segments):  # each run gets its share of the time
        part = deadline.part(1 / (len(segments) - index))
        search = Search(connection, segment, known, kinds, options, part, coverage)
        found += events_touching(search)
    for kind in kinds if not segments else ():
        coverage.not_searched(kind.name, "nothing was recorded in that range")
    over = _runs_over(connection, [segment.run_id for segment in segments])
    found = [replace(e, ongoing=False) if e.ongoing and e.run_id in over else e for e in found]
    found = grouped(found, known) if group else found
    entries = placed(found)
    return Found(
        time_range.robot,
        tuple(entry for entry in entries if not after or _is_left(entry[0], borders)),
        coverage.verdicts([kind.name for kind in kinds], count_by_kind(found)),
        coverage.all_notes,
        tuple(context),
        borders,
    )


def placed(events: Iterable[Event]) -> list[tuple[Place, Event]]:
    """The events in order, each with its place; those of one kind and moment are numbered."""
    seen: Counter[tuple[float, int, float, str]] = Counter()
    entries: list[tuple[Place, Event]] = []
    for event in sorted(events, key=lambda each: (*_moment(each), each.name or "")):
        entries.append(((*_moment(event), seen[_moment(event)]), event))
        seen[_moment(event)] += 1
    return entries


def _moment(event: Event) -> tuple[float, int, float, str]:
    return event.wall_time_s, event.run_id, event.start_s, event.kind


def _is_left(place: Place, borders: dict[str, Place | None]) -> bool:
    """Whether no earlier page has shown the event at that place."""
    border = borders.get(place[3])
    return place[3] in borders and (border is None or place < border)


def _runs_over(connection: sqlite3.Connection, run_ids: Sequence[int]) -> set[int]:
    """Those in which nothing goes on any more: they have ended, or their process is gone."""
    gone = dict(find_dead_sessions(connection))
    sessions = [connection.execute(_IS_OPEN, (run_id,)).fetchone() for run_id in set(run_ids)]
    return {run_id for run_id, session_id, is_open in sessions if not is_open or session_id in gone}


def _context(
    known: dict[str, RegisteredSignal], options: EventOptions, around: Sequence[str] | None
) -> list[RegisteredSignal]:
    if around is None:
        return find_motion(known, options).signals[:MOST_AROUND]
    return resolve_signals(known, around)[:MOST_AROUND] if around else []


def choose(events: Sequence[Event], limit: int) -> list[Event]:
    """At most `limit` of the events, in their order: rare kinds whole, of the others the newest.

    What happens all the time (changes, pictures) gets the room that the other kinds leave.
    """
    matter = [event for event in events if not kind_named(event.kind).routine]
    routine = [event for event in events if kind_named(event.kind).routine]
    kept = _shared_out(matter, limit)
    kept |= _shared_out(routine, limit - len(kept))
    return [event for event in events if id(event) in kept]


def _shared_out(events: Sequence[Event], limit: int) -> set[int]:
    """The ids of at most `limit` events; each kind gets what the rarer ones leave it."""
    left = limit
    kept: set[int] = set()
    counts = Counter(event.kind for event in events)
    for rank, (kind, _) in enumerate(reversed(counts.most_common())):
        share = left // (len(counts) - rank)
        newest = [event for event in events if event.kind == kind][-share:] if share else []
        kept.update(id(event) for event in newest)
        left -= len(newest)
    return kept


def _left_out(events: Sequence[Event]) -> dict[str, LeftOut]:
    """By kind; the events are in order."""
    by_kind: dict[str, list[Event]] = {}
    for event in events:
        by_kind.setdefault(event.kind, []).append(event)
    return {
        kind: LeftOut(
            sum(event.count for event in each),
            each[0],
            each[-1],
            sum(event.count for event in each if kind == "log" and event.name in _ERRORS),
        )
        for kind, each in by_kind.items()
    }


def _cursor(
    on_page: Sequence[tuple[Place, Event]],
    rest: Sequence[tuple[Place, Event]],
    borders: dict[str, Place | None],
) -> str | None:
    """Of each kind with events left out, before which place they are; null: anywhere.

    Of a kind the newest are reported first, so that newly recorded rows move nothing.
    """
    firsts = borders | {place[3]: place for place, _ in reversed(on_page)}
    kinds = dict.fromkeys(place[3] for place, _ in rest)
    return json.dumps({kind: firsts.get(kind) for kind in kinds}) if kinds else None


def _read_cursor(text: str) -> dict[str, Place | None]:
    """By kind, before which place the events are that the cursor's answer left out."""
    try:
        read: dict[str, Any] = json.loads(text)
        return {kind: place and read_place(place) for kind, place in read.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise InvalidInputError(f"cursor={_NO_CURSOR.format(text[:80])}") from error


def read_place(value: Any) -> Place:
    """A place as it comes out of JSON.

    Raises:
        ValueError, TypeError: It is none.
    """
    wall_s, run_id, start_s, kind, number = value
    return float(wall_s), int(run_id), float(start_s), str(kind), int(number)


def _with_values(
    connection: sqlite3.Connection, event: Event, context: Sequence[RegisteredSignal]
) -> Event:
    if event.count > 1:
        return event
    row = connection.execute(_ROW_AT, (event.start_s, event.run_id)).fetchone()
    if row is not None:
        leaves = flatten(parse(row[0])) if context else {}
        return replace(event, around={signal.name: leaves.get(signal.name) for signal in context})
    before = Segment(event.run_id, -math.inf, just_after(event.start_s))  # whose rows are deleted
    frame = read_frame(connection, before, Deadline())
    newest = frame.rows(len(frame) - 1, len(frame))
    values = {signal.name: (newest.values(signal.name) or [None])[0] for signal in context}
    return replace(event, around=values)


@in_one_snapshot
def timeline(
    connection: sqlite3.Connection,
    time_range: TimeRange,
    options: EventOptions | None = None,
    *,
    limit: int = 50,
    after: str | None = None,
    deadline_s: float = QUESTION_DEADLINE_S,
) -> Events:
    """Events, commands, log lines and pictures of a range in the order in which they happened.

    Args:
        connection: Any.
        time_range: From `find_range`.
        options: What counts as an event; None for what was stored when it happened (runs, gaps,
            changes, commands, logs from the level info on, notices, pictures).
        limit: 1 to 500.
        after: The `cursor` of the page before.
        deadline_s: After it, what was found so far is the answer, and the notes say so.

    Returns:
        A page; its `cursor` leads to the next one, and nothing is left out of both.

    Raises:
        InvalidInputError: `limit` is out of bounds, or `after` is no cursor.
    """
    if not 1 <= limit <= MOST_ENTRIES:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_ENTRIES}.")
    options = options or EventOptions(kinds=stored_kinds(), log_level="info")
    found = search_events(
        connection, time_range, options, around=(), group=False, deadline_s=deadline_s
    )
    border = _read_page_cursor(after) if after else None
    left = [entry for entry in found.entries if border is None or entry[0] > border]
    page = left[:limit]
    cursor = json.dumps(page[-1][0]) if len(left) > limit else None
    events = tuple(event for _, event in page)
    return Events(time_range.robot, events, found.verdicts, {}, cursor, found.notes)


def _read_page_cursor(text: str) -> Place:
    try:
        return read_place(json.loads(text))
    except (ValueError, TypeError) as error:
        raise InvalidInputError(_NO_CURSOR.format(text[:80])) from error


# -- many similar events as one: "10 dropouts to 0 m, the first at 3.2 s, ..." ---------------------


def grouped(events: Sequence[Event], known: dict[str, RegisteredSignal]) -> list[Event]:
    """The same events; what the items of an array did at once, and many alike, is one of them.

    A group begins with its first event and ends with its last one. Its details say what they are,
    when, and what they have in common. An event that is still going on is reported by itself.
    """
    grouped: list[Event] = []
    alike: dict[Hashable, list[Event]] = {}
    for event in _of_arrays(events):
        kind = kind_named(event.kind)
        if kind.alike is None or (event.ongoing and kind.lasts and not kind.stored):
            grouped.append(event)
        else:
            sort = (event.run_id, event.kind, event.name, kind.alike.sort(event))
            alike.setdefault(sort, []).append(event)
    for some in alike.values():
        how, signal = kind_named(some[0].kind).alike, known.get(some[0].name or "")
        if how is None or len(some) <= how.most_single:
            grouped += some
        else:
            unit = f" {signal.unit}" if signal and signal.unit else ""
            grouped.append(how.as_one(sorted(some, key=lambda each: each.start_s), unit))
    return grouped


def _of_arrays(events: Iterable[Event]) -> list[Event]:
    """What several items of one array, or parts of one branch, did at once is reported as one.

    Its details are those that all of them have.
    """
    found: dict[tuple[object, ...], Event] = {}
    alone: list[Event] = []
    for event in events:
        how, branch = kind_named(event.kind).alike, (event.name or "").rpartition(".")[0]
        if how is None or not (how.of_arrays and branch):
            alone.append(event)
            continue
        key = (event.kind, event.run_id, branch, event.start_s, event.end_s)
        if other := found.get(key):
            same = dict(each for each in event.details.items() if each in other.details.items())
            event = replace(event, name=f"{branch}.*", details=same)
        found[key] = event
    return [*alone, *found.values()]
