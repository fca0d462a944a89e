"""Standstills in rows, each with what its rows show, and standstills of parts put together."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from webots_mcp.store.analysis.arrays import median, np
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.standstill import find_standstills, shortest_seen_s
from webots_mcp.store.analysis.track import Track, tracks_of
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.evidence import Counts, Observed, Part, observe
from webots_mcp.store.detection.motion import Motion, in_metres
from webots_mcp.store.reading.rows import Columns

NEARLY: Final = 0.95  # of the shortest duration: ends are known to a row or two
NOISE_RANGE: Final = 6.0  # deviations of noise from the least of some hundred rows to the greatest
SHORTEST_SHARE: Final = 4.0  # of the shortest standstill: shorter ones came nowhere near
_SAME_SHARE: Final = 0.5  # of the shorter one that two have in common, if they are the same
_ACROSS_S: Final = 20.0  # or of so long
_MOST_AT_ONCE: Final = 4  # that overlap: those of two parts, which end and begin there


@dataclass(frozen=True)
class Standing:
    """The robot stayed about one place.

    Attributes:
        observed: What the rows show in which it stood: all of them, or samples.
        within_s: How exactly begin and end are known; 0 for to the row.
    """

    start_s: float
    end_s: float
    x_m: float
    y_m: float
    observed: Observed
    within_s: float = 0.0


class Nearest(NamedTuple):
    """What came nearest to a standstill: the longer it stood, else the less far it went.

    Attributes:
        lasted_s: How long it stood at most; 0 where it never did.
        way_m: Where it never stood, how far it went in the shortest time of a standstill; negative,
            so that the greatest is the nearest.
    """

    lasted_s: float
    way_m: float
    start_s: float


@dataclass(frozen=True)
class StretchStandings:
    """The standstills of some rows.

    Attributes:
        seen_s: How long one has to last that the noise of the position does not feign.
        noise_m: That noise; None where there is no position.
        nearest: What came nearest, where there is none.
    """

    standings: list[Standing] = field(default_factory=list[Standing])
    seen_s: float = 0.0
    noise_m: float | None = None
    nearest: Nearest | None = None


def standings_of(
    columns: Columns,
    tracks: Sequence[Track],
    motion: Motion,
    options: EventOptions,
    sample: Columns,
    sampled_s: float = 0.0,
) -> StretchStandings:
    """The standstills on the ways of a robot that its noise does not feign.

    Args:
        columns: Rows, or samples of them.
        tracks: Its ways in them.
        motion: The signals that tell of them.
        options: What counts as a standstill.
        sample: Some rows one after the other, with that noise.
        sampled_s: How far apart samples are; 0 for all rows.
    """
    if not tracks:
        return StretchStandings()
    least_s = max(options.stuck_s - 2 * sampled_s, options.stuck_s / 2)
    found = list(standings_in(columns, tracks, motion, options, least_s))
    noise_m = tracks[0].noise_m
    seen_s = _seen_from_s(sample, noise_m, options)
    seen = [
        replace(each, within_s=sampled_s)
        for each in found
        if each.end_s - each.start_s >= NEARLY * seen_s - sampled_s
    ]
    return StretchStandings(seen, seen_s, noise_m, None if found else _nearest_in(tracks, options))


def standings_in(
    columns: Columns,
    tracks: Iterable[Track],
    motion: Motion,
    options: EventOptions,
    least_s: float,
) -> Iterator[Standing]:
    """The standstills on the ways of a robot that last so long, with what the rows show of them."""
    for track in tracks:
        for each in find_standstills(track, options.stuck_m, least_s):
            start_s, end_s = float(track.times[each.start]), float(track.times[each.last])
            rows = _rows(columns, start_s, end_s)
            for part in _at_one_height(rows, motion, options.stuck_m, least_s):
                observed = observe(part, motion, options.min_commanded, track.noise_m)
                yield Standing(part.times[0], part.times[-1], each.x_m, each.y_m, observed)


def _at_one_height(
    columns: Columns, motion: Motion, radius_m: float, least_s: float
) -> Iterator[Columns]:
    """The parts of a standstill in which it neither climbs nor sinks.

    Noise does neither: with it, heights reach farther than the robot does.
    """
    height = motion.height
    times, heights = columns.numbers(height.name) if height else (np.empty(0), np.empty(0))
    heights = in_metres(height, heights) if height else heights
    tracks = tracks_of(times, heights, np.zeros(len(times)), noise_of(heights))
    reach_m = np.ptp(np.concatenate([track.x for track in tracks])) if tracks else 0.0
    if reach_m <= radius_m + NOISE_RANGE * max((each.left_m for each in tracks), default=0.0):
        yield columns
        return
    for track in tracks:
        for each in find_standstills(track, radius_m, least_s):
            yield _rows(columns, float(track.times[each.start]), float(track.times[each.last]))


def _rows(columns: Columns, start_s: float, end_s: float) -> Columns:
    rows = slice(bisect_left(columns.times, start_s), bisect_right(columns.times, end_s))
    return Columns(
        columns.run_id,
        columns.ids[rows],
        columns.times[rows],
        columns.walls[rows],
        {name: values[rows] for name, values in columns.values.items()},
    )


def _seen_from_s(columns: Columns, noise_m: float, options: EventOptions) -> float:
    """How long a standstill has to last that the noise of the position does not feign."""
    times = columns.moments
    interval_s = median(np.diff(times)) if len(times) > 1 else 0.0
    return shortest_seen_s(noise_m, interval_s, options.stuck_m, options.stuck_s)


def _nearest_in(tracks: Sequence[Track], options: EventOptions) -> Nearest | None:
    """What came nearest on ways without a standstill; None on those that are too short."""
    short = [
        Nearest(float(track.times[each.last] - start_s), 0.0, float(start_s))
        for track in tracks
        for each in find_standstills(track, options.stuck_m, options.stuck_s / SHORTEST_SHARE)
        for start_s in (track.times[each.start],)
    ]
    ways = () if short else (each for track in tracks for each in _ways(track, options.stuck_s))
    return max([*short, *ways], default=None)


def _ways(track: Track, within_s: float) -> Iterator[Nearest]:
    """The shortest way of a track in so many seconds, and when it began."""
    later = np.searchsorted(track.times, track.times + within_s)
    starts = np.flatnonzero(later < len(track.times))
    if len(starts):
        ends = later[starts]
        way_m = np.hypot(track.x[ends] - track.x[starts], track.y[ends] - track.y[starts])
        least = int(way_m.argmin())
        yield Nearest(0.0, -float(way_m[least]), float(track.times[starts[least]]))


def in_all(stretches: Sequence[StretchStandings]) -> StretchStandings:
    """The standstills of all stretches, which may overlap."""
    standings = _joined(each for some in stretches for each in some.standings)
    noises_m = [each.noise_m for each in stretches if each.noise_m is not None]
    near = [each.nearest for each in stretches if each.nearest is not None]
    return StretchStandings(
        standings,
        max((each.seen_s for each in stretches), default=0.0),
        max(noises_m, default=None),
        None if standings else max(near, default=None),
    )


def _joined(standings: Iterable[Standing]) -> list[Standing]:
    """Of parts of a run that overlap each standstill once, also one that several of them show."""
    found: list[Standing] = []
    for each in sorted(standings, key=lambda each: (each.start_s, each.end_s)):
        latest = range(len(found))[-_MOST_AT_ONCE:]
        same = next((at for at in latest if _is_same(found[at], each)), None)
        if same is None:
            found.append(each)
        else:
            found[same] = _together(found[same], each)
    return found


def _is_same(before: Standing, after: Standing) -> bool:
    common_s = min(before.end_s, after.end_s) - max(before.start_s, after.start_s)
    lengths_s = (each.end_s - each.start_s for each in (before, after))
    return common_s >= _SAME_SHARE * min(*lengths_s, _ACROSS_S)


def _together(before: Standing, after: Standing) -> Standing:
    """Of the time that both cover, one describes the first half and one the second."""
    if after.end_s <= before.end_s:
        return before
    border_s = (max(before.start_s, after.start_s) + before.end_s) / 2
    parts = _joined_parts(
        [part for each in before.observed.parts for part in _cut(each, -math.inf, border_s)],
        [part for each in after.observed.parts for part in _cut(each, border_s, math.inf)],
    )
    longer = max(before, after, key=lambda each: each.end_s - each.start_s)
    counts = _sum_of(before.observed.counts, after.observed.counts)
    return replace(
        longer, start_s=before.start_s, end_s=after.end_s, observed=Observed(parts, counts)
    )


def _cut(part: Part, start_s: float, end_s: float) -> Iterator[Part]:
    """What of a part lies between two times, if anything."""
    first_s, last_s = max(part.start_s, start_s), min(part.end_s, end_s)
    if first_s <= last_s:
        share = (last_s - first_s) / (part.end_s - part.start_s or 1.0)
        rows = max(1, round(share * part.rows))
        yield part._replace(start_s=first_s, end_s=last_s, rows=rows)


def _joined_parts(before: list[Part], after: list[Part]) -> list[Part]:
    """Parts one after the other; those at the border are one where they show the same."""
    if not before or not after:
        return before + after
    last, first = before[-1], after[0]
    after = [_turned_on(each, _whole_turns(last, first)) for each in after]
    if last[3:6] != first[3:6]:
        return before + after
    first = after[0]
    looked = [each.looked_rad for each in (last, first) if each.looked_rad is not None]
    whole = last._replace(
        end_s=first.end_s,
        rows=last.rows + first.rows,
        commanded=max(last.commanded, first.commanded, key=lambda each: each[1]),
        looked_rad=(looked[0][0], looked[-1][1]) if looked else None,
    )
    return [*before[:-1], whole, *after[1:]]


def _whole_turns(before: Part, after: Part) -> float:
    """By how much headings have to be counted on, so that one follows the other."""
    if before.looked_rad is None or after.looked_rad is None:
        return 0.0
    return math.tau * round((before.looked_rad[1] - after.looked_rad[0]) / math.tau)


def _turned_on(part: Part, by_rad: float) -> Part:
    if part.looked_rad is None or not by_rad:
        return part
    first, last = part.looked_rad
    return part._replace(looked_rad=(first + by_rad, last + by_rad))


def _sum_of(one: Counts, other: Counts) -> Counts:
    """Counts are added; of a figure that of the more rows is taken."""

    def figure(count: str, name: str) -> float:
        return getattr(max(one, other, key=lambda each: getattr(each, count)), name)

    return Counts(
        rows=one.rows + other.rows,
        told=one.told + other.told,
        told_m_s=figure("told", "told_m_s"),
        stopped=one.stopped + other.stopped,
        stopped_m_s=figure("stopped", "stopped_m_s"),
        driving=one.driving + other.driving,
        wheels=figure("driving", "wheels"),
        resting=one.resting + other.resting,
        turning=one.turning + other.turning,
        swaying=one.swaying + other.swaying,
        reach_m=max(one.reach_m, other.reach_m),
    )
