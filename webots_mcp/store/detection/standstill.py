"""`standstill` and `stuck`: the robot stayed where it was, and should have moved besides."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from webots_mcp.naming import NAME_POSITION
from webots_mcp.store.analysis.arrays import Array, Indexes, median, np
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.standstill import NEARLY, find_standstills, shortest_seen_s
from webots_mcp.store.analysis.track import Track, track_of
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.motion import Motion, in_metres, tracks_of_frame
from webots_mcp.store.detection.stuck import Judged, Place, Standings, Weighing

if TYPE_CHECKING:
    from webots_mcp.store.detection.mode_use import ModeUses
    from webots_mcp.store.detection.search import Search
    from webots_mcp.store.reading.frame import Frame

NOISE_RANGE: Final = 6.0  # deviations of noise from the least of some hundred rows to the greatest
SHORTEST_SHARE: Final = 4.0  # of the shortest standstill: shorter ones came nowhere near


@dataclass(frozen=True)
class Findings:
    """What a detector found in a frame.

    Attributes:
        nearest: What came nearest to a standstill where there is none: its share of the shortest,
            and in words.
        unseen: What could not be looked at.
        undecided: Why one of them may be `stuck` that is told as a standstill.
    """

    events: list[Judged] = field(default_factory=list[Judged])
    nearest: tuple[float, str] | None = None
    unseen: list[str] = field(default_factory=list[str])
    undecided: list[str] = field(default_factory=list[str])


def judge_standstills(
    frame: Frame, motion: Motion, options: EventOptions, uses: ModeUses
) -> Findings:
    """Find where a robot stood still and where it was stuck.

    Raises:
        NotSearchableError: No position is known, or the frame has none.
    """
    if motion.position is None:
        raise NotSearchableError(NAME_POSITION)
    tracks, rows = tracks_of_frame(frame, motion.position)
    if not tracks:
        names = " and ".join(signal.name for signal in motion.position)
        raise NotSearchableError(f"{names} have no value in that range of run {frame.run_id}")
    noise_m = tracks[0].noise_m
    times = np.concatenate([track.times for track in tracks])
    interval_s = median(np.diff(times)) if len(times) > 1 else 0.0
    seen_s = shortest_seen_s(noise_m, interval_s, options.stuck_m, options.stuck_s)
    places = [
        place
        for track, here in zip(tracks, rows, strict=True)
        for place in _places(track, here, frame, motion, options)
    ]
    unseen: list[str] = []
    if seen_s > options.stuck_s / NEARLY:
        unseen.append(
            f"none under {seen_s:.2g} s: position noise of {noise_m:.2g} m hides slow motion"
        )
    seen = [each for each in places if each.lasts_s >= NEARLY * seen_s]
    if not seen:
        return Findings([], None if places else _nearest(tracks, options), unseen)
    weighing = Weighing(Standings(frame, motion, options, seen), uses)
    events = list(weighing.events())
    cut = ["time limit reached before it was known in which modes it moves"] if uses.is_cut else []
    return Findings(events, None, unseen, cut)


def _places(
    track: Track, rows: Indexes, frame: Frame, motion: Motion, options: EventOptions
) -> Iterator[Place]:
    """The standstills of a track, in parts where it climbs or sinks in between."""
    heights = None if motion.height is None else frame.numbers(motion.height.name)[rows]
    for each in find_standstills(track, options.stuck_m, options.stuck_s):
        ends = [(each.start, each.last + 1)]
        if heights is not None and motion.height is not None:
            here = slice(*ends[0])
            high = in_metres(motion.height, heights[here])
            ends = list(_at_one_height(track.times[here], high, each.start, options))
        for start, stop in ends:
            here = slice(start, stop)
            course = track.times[here], track.x[here], track.y[here]
            yield Place(rows[here], *course, each.x_m, each.y_m, track.left_m)


def _at_one_height(
    times: Array, heights: Array, first: int, options: EventOptions
) -> Iterator[tuple[int, int]]:
    """The rows of a standstill, from `first` on, in which it neither climbs nor sinks.

    Noise does neither: with it, heights reach farther than the robot does.
    """
    there = np.flatnonzero(np.isfinite(heights))
    if len(there) < 2:
        yield first, first + len(times)
        return
    heights = heights[there]
    track = track_of(times[there], heights, np.zeros(len(there)), noise_of(heights))
    if np.ptp(track.x) <= options.stuck_m + NOISE_RANGE * track.left_m:
        yield first, first + len(times)
        return
    for each in find_standstills(track, options.stuck_m, options.stuck_s):
        yield first + int(there[each.start]), first + int(there[each.last]) + 1


def _nearest(tracks: Sequence[Track], options: EventOptions) -> tuple[float, str] | None:
    """The longest time for which it stood, else its smallest movement in the shortest one."""
    least_s = options.stuck_s
    short = [
        (float(track.times[each.last] - track.times[each.start]), float(track.times[each.start]))
        for track in tracks
        for each in find_standstills(track, options.stuck_m, least_s / SHORTEST_SHARE)
    ]
    if short:
        lasts_s, start_s = max(short)
        climbed = ", but its height changed" if lasts_s >= least_s else ""
        stood = f"longest standstill: {lasts_s:.2g} s, from {start_s:.1f} s on{climbed}"
        return lasts_s / least_s, stood
    ways = [way for track in tracks for way in _ways(track, least_s)]
    if not ways:
        return None
    way_m, start_s = min(ways)
    return 0.0, f"smallest movement in {least_s:g} s: {way_m:.2g} m, from {start_s:.1f} s on"


def _ways(track: Track, within_s: float) -> Iterator[tuple[float, float]]:
    """The shortest way of a track in so many seconds, and when it began."""
    later = np.searchsorted(track.times, track.times + within_s)
    starts = np.flatnonzero(later < len(track.times))
    if len(starts):
        ends = later[starts]
        way_m = np.hypot(track.x[ends] - track.x[starts], track.y[ends] - track.y[starts])
        least = int(way_m.argmin())
        yield float(way_m[least]), float(track.times[starts[least]])


def _standstills(search: Search) -> Iterator[Event]:
    """It stayed where it was; not where it was stuck all the time, which is asked for as well."""
    with_stuck = any(kind.name == "stuck" for kind in search.kinds)
    for each in _noted(search, "standstill").events:
        if each.kind == "standstill" and not (each.covered and with_stuck):
            yield search.event(each.kind, each.start_s, each.end_s, None, **each.details)


def _stuck(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    found = _noted(search, "stuck")
    search.not_searched("stuck", *found.undecided)
    for each in found.events:
        if each.kind == "stuck":
            yield search.event(each.kind, each.start_s, each.end_s, None, **each.details)


def _noted(search: Search, kind: str) -> Findings:
    found = search.standstills
    search.not_searched(kind, *found.unseen)
    if found.nearest is not None:
        search.came_near(kind, *found.nearest)
    return found


def _least_s(options: EventOptions) -> float:
    return options.stuck_s


def _mode(event: Event) -> Hashable:
    return event.details.get("mode")


STANDSTILL: Final = EventKind(
    "standstill",
    "stands",
    _standstills,
    lasts=True,
    least_s=_least_s,
    drawn=8,
    alike=Alike(lambda events, unit: "standstills", sort=_mode),
    of_frame=True,
    effort=3,
)
STUCK: Final = EventKind(
    "stuck",
    "stands when it should move",
    _stuck,
    lasts=True,
    least_s=_least_s,
    drawn=0,
    alike=Alike(lambda events, unit: "times stuck", sort=_mode),
    of_frame=True,
    effort=3,
)
