"""Kept stretches: where each call of `publish` was recorded, and why."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from typing import Final

from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind, but_for_numbers
from webots_mcp.store.detection.search import Search
from webots_mcp.store.images import count_kept_frames
from webots_mcp.store.reading.kept import kept_stretches


def kept_events(search: Search) -> Iterator[Event]:
    """The stretches that the segment touches; one that is not over reaches up to the newest row."""
    segment = search.segment
    span = (segment.holds_from_s, segment.holds_to_s)
    for each in kept_stretches(search.connection, segment.run_id, *span):
        ongoing = each.end_s > search.ended_s
        end_s = max(each.start_s, min(each.end_s, search.ended_s))
        place = (segment.run_id, each.start_s, end_s, each.wall_time_s)
        details: dict[str, object] = {"reason": each.reason}
        if frames := count_kept_frames(search.connection, segment.run_id, each.start_s, each.end_s):
            details["frames"] = frames  # of cameras
        yield Event("kept", *place, None, details, ongoing=ongoing)


def _reason(event: Event) -> Hashable:
    return but_for_numbers(event.details["reason"])


KEPT: Final = EventKind(
    "kept",
    "at full rate",
    kept_events,
    stored=True,
    routine=True,
    counted=False,
    alike=Alike(lambda events, unit: "kept stretches", sort=_reason),
)
