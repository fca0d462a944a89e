"""Standstills: always told as a fact, and as stuck where something shows that it should move."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from webots_mcp.naming import NAME_POSITION
from webots_mcp.store.analysis.arrays import median
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.standstill import find_standstills, shortest_seen_s
from webots_mcp.store.analysis.track import Track, tracks_of
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.evidence import Evidence, Flags, turned_rad, usual, weigh
from webots_mcp.store.detection.habits import MovedIn
from webots_mcp.store.detection.kind import NotSearchableError
from webots_mcp.store.detection.motion import in_metres, position_noise, tracks_in
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Search

BRIDGED_S: Final = 0.5  # evidence that is missing for less goes on
NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
READ_WHOLE_S: Final = 60.0  # of a longer standstill in a long range both ends are read
SHORTEST_SHARE: Final = 4.0  # of the shortest standstill: shorter ones came nowhere near
MARGIN_S: Final = 8.0  # before and after it that are read


@dataclass(frozen=True)
class Standing:
    """The robot stayed about one place.

    Attributes:
        columns: Rows in which it stood: all, or samples.
        noise_m: Of the positions on the way that it is part of.
        within_s: How exactly begin and end are known; 0 for to the row.
    """

    start_s: float
    end_s: float
    x_m: float
    y_m: float
    columns: Columns
    noise_m: float
    within_s: float = 0.0


@dataclass(frozen=True)
class Standings:
    """All standstills of a segment, as `still` and as `stuck`.

    Attributes:
        not_searched: What could not be looked at.
        nearest: What came near to a standstill: its share of the shortest, and in words.
    """

    events: list[Event]
    not_searched: list[str]
    nearest: tuple[float, str] | None = None


def find_standings(search: Search) -> Standings:
    """Find them once for all kinds that tell of them."""
    position = search.motion.position
    if position is None:
        raise NotSearchableError(NAME_POSITION)
    columns = search.view.places(search.motion.evidence, search.options.stuck_s)
    tracks = _tracks(search, position, columns)
    all_found = _standings(search, tracks, columns)
    seen_s = _shortest_seen_s(search, position, tracks)
    found = [
        each for each in all_found if each.end_s - each.start_s >= NEARLY * seen_s - each.within_s
    ]
    moved_in = MovedIn(search.connection, search.segment.run_id, search.motion, search.deadline)
    events = [event for each in found for event in _weighed(search, each, moved_in)]
    nearest = None if all_found else _nearest(search, tracks)
    notes = search.view.taken_notes()
    if seen_s > search.options.stuck_s / NEARLY:
        notes.append(
            f"none of less than {seen_s:.2g} s: the position's noise of {tracks[0].noise_m:.2g} m "
            "hides slow motion"
        )
    return Standings(events, notes, nearest)


def _shortest_seen_s(
    search: Search, position: tuple[Signal, Signal], tracks: Sequence[Track]
) -> float:
    """How long a standstill has to last that the noise of the position does not feign."""
    times = search.view.sample(position).moments
    interval_s = median(np.diff(times)) if len(times) > 1 else 0.0
    options = search.options
    return shortest_seen_s(tracks[0].noise_m, interval_s, options.stuck_m, options.stuck_s)


def _weighed(search: Search, standing: Standing, moved_in: MovedIn) -> list[Event]:
    """The events of a standstill: of one in samples, the rows about it are read if that matters."""

    def weighed(standing: Standing) -> Evidence:
        columns, noise_m = standing.columns, standing.noise_m
        return weigh(columns, search.motion, search.options, moved_in, noise_m)

    @cache
    def exactly() -> list[Event]:
        fine = _from_rows(search, standing)
        return [event for each in fine for event in _told(search, each, weighed(each))]

    evidence = weighed(standing)
    if not standing.within_s:
        return list(_told(search, standing, evidence))
    if not _is_certain(standing, evidence, search.options.stuck_s):
        return exactly()
    told = list(_told(search, standing, evidence))

    def exactly_of(kind: str) -> list[Event]:
        return [event for event in exactly() if event.kind == kind]

    return [replace(each, exactly=partial(exactly_of, each.kind)) for each in told]


def _is_certain(standing: Standing, evidence: Evidence, least_s: float) -> bool:
    """Whether samples tell how many events it is: what lasts nearly the least time may be one.

    It lasts at least from the first of its samples to the last one, and not up to the next ones.
    """
    times, flags = standing.columns.times, evidence.should_move
    runs = [*_runs(flags, times), *_runs(~flags, times)]
    lengths_s = [times[end - 1] - times[start] for start, end in runs]
    shortest_s = least_s - 2 * standing.within_s
    return standing.end_s - standing.start_s >= least_s and not any(
        shortest_s < length_s < least_s for length_s in lengths_s
    )


def _told(search: Search, standing: Standing, evidence: Evidence) -> Iterator[Event]:
    """What it was stuck for; and the standstill, unless that is the same."""
    spans = _spans(standing, evidence.should_move, NEARLY * search.options.stuck_s)
    for start, end in spans:
        yield _stuck(search, standing, evidence, slice(start, end))
    least_s = search.options.stuck_s
    covered = any(
        standing.columns.times[start] - standing.start_s < least_s
        and standing.end_s - standing.columns.times[end - 1] < least_s
        for start, end in spans
    )
    if not covered or all(kind.name != "stuck" for kind in search.kinds):
        details = _details(search, standing, standing.columns)
        details["not_stuck"] = "; ".join(evidence.against) or "only for moments should it move"
        ends = (standing.start_s, standing.end_s)
        if covered or spans:
            details.pop("not_stuck")
        yield search.event("still", *ends, None, **details)


def _stuck(search: Search, standing: Standing, evidence: Evidence, rows: slice) -> Event:
    part = _rows(standing.columns, rows)
    all_of_it = len(part.times) >= NEARLY * len(standing.columns.times)
    start_s = standing.start_s if all_of_it else part.times[0]
    end_s = standing.end_s if all_of_it else part.times[-1]
    details = _details(search, standing, part)
    commanded = search.motion.commanded
    if commanded is not None and commanded.name in part.values:
        details["commanded"] = usual(part.values[commanded.name])
    details["evidence"] = "; ".join(evidence.shown_by)
    if evidence.against:
        details["against"] = "; ".join(evidence.against)
    return search.event("stuck", start_s, end_s, None, **details)


def _details(search: Search, standing: Standing, rows: Columns) -> dict[str, Any]:
    """What is told of a standstill, whether it was stuck or not."""
    details: dict[str, Any] = {"x_m": standing.x_m, "y_m": standing.y_m}
    mode = search.motion.mode
    if mode is not None and mode.name in rows.values:
        details["mode"] = usual(rows.values[mode.name])
    if (turned := turned_rad(rows, search.motion.heading)) is not None:
        details["turned_rad"] = round(turned, 3)
    return details | ({"within_s": standing.within_s} if standing.within_s else {})


def _tracks(search: Search, position: tuple[Signal, Signal], columns: Columns) -> list[Track]:
    """The way of the robot."""
    if missing := [each.name for each in position if each.name not in columns.values]:
        raise NotSearchableError(f"{missing[0]} is not in every row: ask for less time")
    sampled = search.view.sampled_s > 0
    noise_m = position_noise(search.view.sample(position), position) if sampled else None
    tracks = tracks_in(columns, position, noise_m)
    if not tracks:
        names = " and ".join(signal.name for signal in position)
        raise NotSearchableError(f"{names} have no value in run {search.segment.run_id} there")
    return tracks


def _standings(search: Search, tracks: Sequence[Track], columns: Columns) -> list[Standing]:
    """From all rows; of a long segment from samples."""
    sampled_s, stuck_s = search.view.sampled_s, search.options.stuck_s
    least_s = max(stuck_s - 2 * sampled_s, stuck_s / 2)
    found = [each for track in tracks for each in _in_track(search, track, columns, least_s)]
    return [replace(each, within_s=sampled_s) for each in found] if sampled_s else found


def _in_track(search: Search, track: Track, columns: Columns, least_s: float) -> Iterator[Standing]:
    for each in find_standstills(track, search.options.stuck_m, least_s):
        start_s, end_s = float(track.times[each.start]), float(track.times[each.last])
        rows = slice(bisect_left(columns.times, start_s), bisect_right(columns.times, end_s))
        standing_rows = _rows(columns, rows)
        place = Standing(start_s, end_s, each.x_m, each.y_m, standing_rows, track.noise_m)
        yield from _at_one_height(search, place, least_s)


def _at_one_height(search: Search, standing: Standing, least_s: float) -> Iterator[Standing]:
    """The parts of a standstill in which it neither climbs nor sinks."""
    height, columns = search.motion.height, standing.columns
    times, heights = columns.numbers(height.name) if height else (np.empty(0), np.empty(0))
    if height is None or not len(times):
        yield standing
        return
    heights = in_metres(height, heights)
    if np.ptp(heights) <= search.options.stuck_m:
        yield standing
        return
    for track in tracks_of(times, heights, np.zeros(len(times)), noise_of(heights)):
        for each in find_standstills(track, search.options.stuck_m, least_s):
            first_s, last_s = float(track.times[each.start]), float(track.times[each.last])
            rows = slice(bisect_left(columns.times, first_s), bisect_right(columns.times, last_s))
            yield replace(standing, start_s=first_s, end_s=last_s, columns=_rows(columns, rows))


def _from_rows(search: Search, rough: Standing) -> list[Standing]:
    """What the rows about a standstill that samples show tell of it."""
    if search.deadline.passed:
        search.view.notes.append("the time was over: not exactly where they begin and end")
        return [rough]
    start_s, end_s = rough.start_s - MARGIN_S, rough.end_s + MARGIN_S
    if rough.end_s - rough.start_s <= READ_WHOLE_S:
        return _about(search, rough, start_s, end_s)
    head = _about(search, rough, start_s, rough.start_s + READ_WHOLE_S / 2)
    foot = _about(search, rough, rough.end_s - READ_WHOLE_S / 2, end_s)
    first_s = head[-1].start_s if head else rough.start_s
    last_s = foot[0].end_s if foot else rough.end_s
    return [replace(rough, start_s=first_s, end_s=last_s, within_s=0.0)]


def _about(search: Search, rough: Standing, start_s: float, end_s: float) -> list[Standing]:
    """The standstills in the rows from one time to another that touch a rough one."""
    position = search.motion.position
    assert position is not None
    columns = search.view.rows_between(start_s, end_s, search.motion.evidence)
    tracks = tracks_in(columns, position)
    found = (
        each
        for track in tracks
        for each in _in_track(search, track, columns, search.options.stuck_s)
    )
    return [each for each in found if each.start_s <= rough.end_s and each.end_s >= rough.start_s]


def _rows(columns: Columns, rows: slice) -> Columns:
    return Columns(
        columns.run_id,
        columns.ids[rows],
        columns.times[rows],
        columns.walls[rows],
        {name: values[rows] for name, values in columns.values.items()},
    )


def _spans(standing: Standing, flags: Flags, least_s: float) -> list[tuple[int, int]]:
    """Row ranges [start, end) of at least that duration in which the flags hold."""
    times = standing.columns.times
    spans = _runs(flags, times)
    return [(start, end) for start, end in spans if times[end - 1] - times[start] >= least_s]


def _runs(flags: Flags, times: Sequence[float]) -> list[tuple[int, int]]:
    """Row ranges [start, end) in which the flags hold, but for moments."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0])))).tolist()
    spans: list[tuple[int, int]] = []
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if spans and times[start] - times[spans[-1][1] - 1] <= BRIDGED_S:
            start = spans.pop()[0]
        spans.append((start, end))
    return spans


def _nearest(search: Search, tracks: Sequence[Track]) -> tuple[float, str] | None:
    """The longest time for which it stood, else where it went least."""
    least_s, radius_m = search.options.stuck_s, search.options.stuck_m
    short = [
        (float(track.times[each.last] - track.times[each.start]), float(track.times[each.start]))
        for track in tracks
        for each in find_standstills(track, radius_m, least_s / SHORTEST_SHARE)
    ]
    if short:
        lasted_s, start_s = max(short)
        climbed = ", but climbed or sank" if lasted_s >= least_s else ""
        what = f"stood for {lasted_s:.2g} s at most, from {start_s:.1f} s on{climbed}"
        return lasted_s / least_s, what
    ways = [each for track in tracks for each in _ways(track, least_s)]
    if not ways:
        return None
    way_m, start_s = min(ways)
    return 0.0, f"went least from {start_s:.1f} s on: {way_m:.2g} m in {least_s:g} s"


def _ways(track: Track, within_s: float) -> Iterator[tuple[float, float]]:
    """The shortest way of a track in so many seconds, and when it began."""
    later = np.searchsorted(track.times, track.times + within_s)
    starts = np.flatnonzero(later < len(track.times))
    if len(starts):
        ends = later[starts]
        way_m = np.hypot(track.x[ends] - track.x[starts], track.y[ends] - track.y[starts])
        least = int(way_m.argmin())
        yield float(way_m[least]), float(track.times[starts[least]])
