"""Standstills: always reported as a fact, and as stuck where the robot should have moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.naming import NAME_POSITION, listed
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.evidence import Evidence, Part, turned_rad, usual, weigh
from webots_mcp.store.detection.habits import MovedIn
from webots_mcp.store.detection.kind import NotSearchableError
from webots_mcp.store.detection.motion import position_noise, tracks_in
from webots_mcp.store.detection.standstills import (
    NEARLY,
    Standing,
    StretchStandings,
    in_all,
    standings_in,
    standings_of,
)
from webots_mcp.store.rollup.buckets import BUCKET_S
from webots_mcp.store.rollup.standstills import stored_standstills
from webots_mcp.store.signals.flatten import shown

if TYPE_CHECKING:
    from webots_mcp.store.detection.search import Search

BRIDGED_S: Final = 0.5  # evidence that is missing for less goes on
READ_WHOLE_S: Final = 60.0  # of a longer standstill in a long range both ends are read
MARGIN_S: Final = 8.0  # before and after it that are read
MOST_NAMED: Final = 3


@dataclass(frozen=True)
class Standings:
    """All standstills of a segment, as `still` and as `stuck`.

    Attributes:
        not_searched: What could not be looked at.
        not_weighed: Why one of them may be `stuck` that is reported as `still`.
        nearest: What came near to a standstill: its share of the shortest, and in words.
    """

    events: list[Event]
    not_searched: list[str]
    not_weighed: list[str]
    nearest: tuple[float, str] | None = None


def find_standings(search: Search) -> Standings:
    """Find them once for all kinds that tell of them."""
    if search.motion.position is None:
        raise NotSearchableError(NAME_POSITION)
    found = _found(search)
    moved_in = search.moved_in
    events = [event for each in found.standings for event in _weighed(search, each, moved_in)]
    notes = search.view.taken_notes()
    if found.seen_s > search.options.stuck_s / NEARLY:
        notes.append(
            f"none under {found.seen_s:.2g} s: position noise of {found.noise_m:.2g} m hides slow "
            "motion"
        )
    modes = listed([shown(mode) or "null" for mode in sorted(moved_in.cut, key=str)], MOST_NAMED)
    unknown = f"time limit reached before it was known whether it moves in mode {modes}"
    not_weighed = [unknown] if moved_in.cut else []
    nearest = None if found.standings else _told_nearest(search, found)
    return Standings(events, notes, not_weighed, nearest)


def _found(search: Search) -> StretchStandings:
    """Those that are stored, and those of the rows of which none are."""
    inside, run_id = search.view.inside, search.segment.run_id
    stored, found = stored_standstills(
        search.connection, run_id, inside, search.motion, search.options
    )
    in_rows = _found_in_rows(search, stored)
    if stored:
        about = [fine for each in in_rows.standings for fine in _at_border(search, each, stored)]
        in_rows = in_all([*found, replace(in_rows, standings=about)])
    if in_rows.noise_m is None:
        search.require_rows()
        if search.deadline.passed:
            raise NotSearchableError("time limit reached: ask for this kind alone")
        names = " and ".join(signal.name for signal in search.motion.position or ())
        raise NotSearchableError(f"{names} have no value in that range of run {run_id}")
    return in_rows


def _at_border(search: Search, rough: Standing, stored: range) -> list[Standing]:
    """A standstill of samples; to the row where it may be a part of one that is stored."""
    start_s, end_s = stored.start * BUCKET_S, stored.stop * BUCKET_S
    meets = rough.start_s <= end_s and rough.end_s >= start_s
    return _from_rows(search, rough) if meets and rough.within_s else [rough]


def _found_in_rows(search: Search, outside: range) -> StretchStandings:
    """Those of the rows outside of some buckets; of a long segment those that samples show."""
    motion, options, position = search.motion, search.options, search.motion.position
    assert position is not None
    columns = search.view.places(motion.evidence, options.stuck_s, outside)
    if missing := [each.name for each in position if each.name not in columns.values]:
        raise NotSearchableError(f"not every row has {missing[0]}: ask for less time")
    sampled_s, sample = search.view.sampled_s, search.view.sample(position)
    tracks = tracks_in(columns, position, position_noise(sample, position) if sampled_s else None)
    return standings_of(columns, tracks, motion, options, sample, sampled_s)


def _weighed(search: Search, standing: Standing, moved_in: MovedIn) -> list[Event]:
    """The events of a standstill: of one in samples, the rows about it are read if that matters."""

    def weighed(standing: Standing) -> Evidence:
        return weigh(standing.observed, search.motion, search.options, moved_in)

    @cache
    def exactly() -> list[Event]:
        fine = _from_rows(search, standing)
        return [event for each in fine for event in _reported(search, each, weighed(each))]

    evidence = weighed(standing)
    if not standing.within_s:
        return list(_reported(search, standing, evidence))
    if not _is_certain(standing, evidence, search.options.stuck_s):
        return exactly()
    found = list(_reported(search, standing, evidence))

    def exactly_of(rough: Event) -> list[Event]:
        return [each for each in exactly() if each.kind == rough.kind and _overlap(each, rough)]

    return [replace(each, exactly=partial(exactly_of, each)) for each in found]


def _overlap(one: Event, other: Event) -> bool:
    return one.start_s <= other.end_s and other.start_s <= one.end_s


def _is_certain(standing: Standing, evidence: Evidence, least_s: float) -> bool:
    """Whether samples tell how many events it is: what lasts nearly the least time may be one.

    It lasts at least from the first of its samples to the last one, and not up to the next ones.
    """
    parts, flags = standing.observed.parts, evidence.should_move
    spans = [*_spans(parts, flags), *_spans(parts, [not flag for flag in flags])]
    shortest_s = least_s - 2 * standing.within_s
    return standing.end_s - standing.start_s >= least_s and not any(
        shortest_s < _lasted_s(span) < least_s for span in spans
    )


def _reported(search: Search, standing: Standing, evidence: Evidence) -> Iterator[Event]:
    """What it was stuck for; and the standstill, unless that is the same."""
    least_s, parts = search.options.stuck_s, standing.observed.parts
    all_spans = _spans(parts, evidence.should_move)
    spans = [span for span in all_spans if _lasted_s(span) >= NEARLY * least_s]
    for span in spans:
        yield _stuck(search, standing, evidence, span)
    covered = any(
        span[0].start_s - standing.start_s < least_s and standing.end_s - span[-1].end_s < least_s
        for span in spans
    )
    if not covered or all(kind.name != "stuck" for kind in search.kinds):
        details = _details(search, standing, parts)
        details["not_stuck"] = "; ".join(evidence.against) or "it should have moved only briefly"
        ends = (standing.start_s, standing.end_s)
        if covered or spans:
            details.pop("not_stuck")
        yield search.event("still", *ends, None, **details)


def _stuck(search: Search, standing: Standing, evidence: Evidence, parts: Sequence[Part]) -> Event:
    rows = sum(part.rows for part in parts)
    all_of_it = rows >= NEARLY * standing.observed.counts.rows
    start_s = standing.start_s if all_of_it else parts[0].start_s
    end_s = standing.end_s if all_of_it else parts[-1].end_s
    details = _details(search, standing, parts)
    if (commanded := usual(part.commanded for part in parts)) is not None:
        details["commanded"] = commanded
    details["evidence"] = "; ".join(evidence.shown_by)
    if evidence.against:
        details["against"] = "; ".join(evidence.against)
    return search.event("stuck", start_s, end_s, None, **details)


def _details(search: Search, standing: Standing, parts: Sequence[Part]) -> dict[str, Any]:
    """The facts reported of a standstill, whether it was stuck or not."""
    details: dict[str, Any] = {"x_m": standing.x_m, "y_m": standing.y_m}
    if search.motion.mode is not None:
        details["mode"] = usual((part.mode, part.rows) for part in parts)
    if (turned := turned_rad(parts)) is not None:
        details["turned_rad"] = round(turned, 3)
    return details | ({"within_s": standing.within_s} if standing.within_s else {})


def _from_rows(search: Search, rough: Standing) -> list[Standing]:
    """What the rows about a standstill that samples show tell of it."""
    if search.deadline.passed:
        search.view.notes.append("time limit reached: begin and end are approximate")
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
    motion, options = search.motion, search.options
    assert motion.position is not None
    columns = search.view.rows_between(start_s, end_s, motion.evidence)
    found = standings_in(
        columns, tracks_in(columns, motion.position), motion, options, options.stuck_s
    )
    return [each for each in found if each.start_s <= rough.end_s and each.end_s >= rough.start_s]


def _spans(parts: Sequence[Part], flags: Sequence[bool]) -> list[Sequence[Part]]:
    """Parts one after the other for which the flags hold, but for moments."""
    spans: list[tuple[int, int]] = []
    for at in (at for at, flag in enumerate(flags) if flag):
        start, end = spans[-1] if spans else (0, -1)
        if at == end or (spans and parts[at].start_s - parts[end - 1].end_s <= BRIDGED_S):
            spans[-1] = (start, at + 1)
        else:
            spans.append((at, at + 1))
    return [parts[start:end] for start, end in spans]


def _lasted_s(span: Sequence[Part]) -> float:
    return span[-1].end_s - span[0].start_s


def _told_nearest(search: Search, found: StretchStandings) -> tuple[float, str] | None:
    """The longest time for which it stood, else its smallest movement."""
    if found.nearest is None:
        return None
    least_s, nearest = search.options.stuck_s, found.nearest
    if not nearest.lasted_s:
        moved = f"smallest movement in {least_s:g} s: {-nearest.way_m:.2g} m"
        return 0.0, f"{moved}, from {nearest.start_s:.1f} s on"
    climbed = ", but its height changed" if nearest.lasted_s >= least_s else ""
    stood = f"longest standstill: {nearest.lasted_s:.2g} s, from {nearest.start_s:.1f} s on"
    return nearest.lasted_s / least_s, stood + climbed
