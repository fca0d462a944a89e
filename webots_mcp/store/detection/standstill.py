"""`standstill` and `stuck`: the robot stayed where it was, and should have moved besides."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from webots_mcp.naming import NAME_POSITION
from webots_mcp.store.analysis.arrays import Array, Indexes, noise_of, np
from webots_mcp.store.analysis.creep import MOST_AROUND
from webots_mcp.store.analysis.standstill import NEARLY, find_standstills, shortest_seen_s
from webots_mcp.store.analysis.track import Track, track_of
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.mode_use import ModeUses
from webots_mcp.store.detection.motion import Motion, RunNoise, in_metres, tracks_in
from webots_mcp.store.detection.search import NO_TIME
from webots_mcp.store.detection.stuck import Judged, Place, Standings

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Search
    from webots_mcp.store.reading.frame import Frame

NOISE_RANGE: Final = 6.0  # deviations of noise from the least of some hundred rows to the greatest
SHORTEST_SHARE: Final = 4.0  # of the shortest standstill: shorter ones came nowhere near
MARGIN_ROWS: Final = 50_000  # before and after a range; all where a standstill takes more


@dataclass(frozen=True)
class Findings:
    """What was found in the rows of a run.

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


def standstills_in(search: Search) -> Findings:
    """Those that touch the segment of a search, from as many rows as bear on them.

    Raises:
        NotSearchableError: No position is known, or there is none, or no time.
    """
    if search.deadline.passed:
        raise NotSearchableError(NO_TIME)
    motion, run, asked = search.motion, search.frame, search.asked or search.segment
    if search.whole.cut_at_s is None and not asked.full_rate:
        run = search.whole
    uses = ModeUses(search.connection, run, motion, search.options, search.deadline)
    noise = RunNoise(run, motion)
    first, stop = run.places([asked.start_s, asked.end_s]).tolist()
    found = Findings()
    for margin in (MARGIN_ROWS, len(run)):
        rows = run.rows(before := max(0, first - margin), stop + margin)
        asked_rows = first - before, stop - before
        found = judge_standstills(rows, motion, search.options, uses, noise, asked_rows)
        if len(rows) == len(run) or search.deadline.passed or not _may_reach_out(found, rows, run):
            break
    return found


def _may_reach_out(found: Findings, rows: Frame, run: Frame) -> bool:
    """Whether rows beyond bear on a standstill: a creep shows in so many times its length."""
    lasts_s = max((each.end_s - each.start_s for each in found.events), default=0.0)
    first_s = min((each.start_s for each in found.events), default=math.inf)
    last_s = max((each.end_s for each in found.events), default=-math.inf)
    reach_s, (begin_s, end_s) = MOST_AROUND * lasts_s, rows.bounds_s
    began_s, ended_s = run.bounds_s
    return (began_s < begin_s > first_s - reach_s) or (ended_s > end_s < last_s + reach_s)


def judge_standstills(
    frame: Frame,
    motion: Motion,
    options: EventOptions,
    uses: ModeUses,
    noise: RunNoise,
    asked: tuple[int, int],
) -> Findings:
    """Find where a robot stood still and where it was stuck.

    Args:
        frame: The rows.
        motion: Which signals tell.
        options: What counts.
        uses: In which modes it moves.
        noise: Of the run.
        asked: Rows that the standstills have to touch.

    Raises:
        NotSearchableError: No position is known, or the frame has none.
    """
    if motion.position is None:
        raise NotSearchableError(NAME_POSITION)
    tracks, rows = tracks_in(frame, motion.position, noise)
    if not tracks:
        names = " and ".join(signal.name for signal in motion.position)
        raise NotSearchableError(f"{names} have no value in that range of run {frame.run_id}")
    seen_s = shortest_seen_s(noise.position_m, noise.interval_s, options.stuck_m, options.stuck_s)
    unseen = [
        f"none under {seen_s:.2g} s: position noise of {noise.position_m:.2g} m hides slow motion"
    ] * (seen_s > options.stuck_s / NEARLY)
    found = (
        place
        for track, here in zip(tracks, rows, strict=True)
        for place in _places(track, here, frame, motion, options)
    )
    places = [each for each in found if each.rows[0] < asked[1] and each.rows[-1] >= asked[0]]
    long = [place for place in places if place.lasts_s >= NEARLY * seen_s]
    if not long:
        parts = [np.searchsorted(here, asked).tolist() for here in rows]
        there = [track.part(*part) for track, part in zip(tracks, parts, strict=True)]
        return Findings([], None if places else _nearest(there, options), unseen)
    events = Standings(frame, motion, options, long, noise, uses).judged()
    cut = ["time limit reached before it was known in which modes it moves"] if uses.is_cut else []
    return Findings(events, None, unseen, cut)


def _places(
    track: Track, rows: Indexes, frame: Frame, motion: Motion, options: EventOptions
) -> Iterator[Place]:
    """The standstills of a track, in parts where it climbs or sinks in between."""
    for each in find_standstills(track, options.stuck_m, options.stuck_s):
        ends = [(each.start, each.last + 1)]
        if motion.height is not None:
            high = frame.numbers(motion.height.name)[rows[slice(*ends[0])]]
            ends = list(_at_one_height(track, in_metres(motion.height, high), each.start, options))
        for start, stop in ends:
            part = slice(start, stop)
            course = track.times[part], track.x[part], track.y[part]
            yield Place(rows[part], *course, each.x_m, each.y_m, track.left_m)


def _at_one_height(
    track: Track, heights: Array, first: int, options: EventOptions
) -> Iterator[tuple[int, int]]:
    """The rows of a standstill, from `first` on, in which it neither climbs nor sinks.

    Noise does neither: with it, heights reach farther than the robot does.
    """
    there = np.flatnonzero(np.isfinite(heights))
    up = track_of(
        track.times[first + there], heights[there], np.zeros(len(there)), noise_of(heights[there])
    )
    far_m = np.ptp(up.x) if len(there) > 1 else 0.0
    if far_m <= options.stuck_m + NOISE_RANGE * up.left_m:
        yield first, first + len(heights)
        return
    for each in find_standstills(up, options.stuck_m, options.stuck_s):
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
    ways: list[tuple[float, float]] = []
    for track in tracks:
        later = np.searchsorted(track.times, track.times + least_s)
        starts = np.flatnonzero(later < len(track.times))
        way_m = np.hypot(*(each[later[starts]] - each[starts] for each in (track.x, track.y)))
        ways += zip(way_m.tolist(), track.times[starts].tolist(), strict=True)
    if not ways:
        return None
    way_m, start_s = min(ways)
    return 0.0, f"smallest movement in {least_s:g} s: {way_m:.2g} m, from {start_s:.1f} s on"


def _standstills(search: Search) -> Iterator[Event]:
    """It stayed where it was; beside `stuck`, where that is asked for as well."""
    with_stuck = any(kind.name == "stuck" for kind in search.kinds)
    return _events(search, "standstill", "apart" if with_stuck else "standstill")


def _stuck(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    search.not_searched("stuck", *search.standstills.undecided)
    return _events(search, "stuck", "stuck")


def _events(search: Search, kind: str, judged_as: str) -> Iterator[Event]:
    found = search.standstills
    search.not_searched(kind, *found.unseen)
    if found.nearest is not None:
        search.note_nearest(kind, *found.nearest)
    for each in found.events:
        if each.kind == judged_as:
            yield search.event(kind, each.start_s, each.end_s, None, **each.details)


STANDSTILL: Final = EventKind(
    "standstill",
    "stands",
    _standstills,
    lasts=True,
    least_s=lambda options: options.stuck_s,
    drawn=8,
    alike=Alike(lambda events, unit: "standstills", sort=lambda event: event.details.get("mode")),
)
STUCK: Final = EventKind(
    "stuck",
    "stands when it should move",
    _stuck,
    lasts=True,
    least_s=lambda options: options.stuck_s,
    drawn=0,
    alike=Alike(lambda events, unit: "times stuck", sort=lambda event: event.details.get("mode")),
)
