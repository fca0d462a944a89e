"""The event kind `gap`: intervals in which no rows were recorded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from webots_mcp.analysis.arrays import longest_usual_s, usual_interval_s
from webots_mcp.judging.detection.event import Alike, Event
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.judging.detection.stored_events import note_unread, recorded_segment
from webots_mcp.store.reading.frame_summary import frame_around, rhythm_in, rows_around
from webots_mcp.store.reading.unread import Unread

END_OF_RUN: Final = "the end of the run"
_LAST_ROWS: Final = 21  # of a run: they tell what is usual at its end
_ENDED: Final = "SELECT last_sim_time_s FROM run WHERE id = ? AND end_reason IS NOT NULL"


def gap_events(search: Search) -> Iterator[Event]:
    """Where rows are missing: gaps that the segment touches, also all around it."""
    segment = recorded_segment(search)
    whole = search.whole
    if whole.unread or whole.cut_at_s is not None or search.segment.full_rate:
        around = frame_around(search.connection, segment, search.deadline)
    else:  # the run is read already, from its first row to its newest one
        around = rows_around(whole, segment)
    note_unread(search, "gap", around.cut_at_s)
    asked = search.segment
    for e in around.unread:
        if e.end_s > asked.start_s and e.start_s < asked.end_s:
            here = (max(e.start_s, asked.start_s), min(e.end_s, asked.end_s))
            search.not_searched("gap", str(Unread(*here, e.why)))
    rhythm = rhythm_in(around)
    for gap in rhythm.gaps:
        if gap.end_s > segment.start_s and gap.start_s < segment.end_s:
            place = (segment.run_id, gap.start_s, gap.end_s, search.wall_time_at(gap.start_s))
            yield Event("gap", *place, None, {"usual_interval_s": rhythm.interval_s})
    yield from _gap_at_end(search, rhythm.interval_s)


def _gap_at_end(search: Search, interval_s: float | None) -> Iterator[Event]:
    """Yield the gap between the last row of a run that ended and its end, if there is one.

    The next row would have come after the end, at the earliest a usual interval later.
    """
    run_id = search.segment.run_id
    ended = search.connection.execute(_ENDED, (run_id,)).fetchone()
    rows = search.whole.rows(len(search.whole) - _LAST_ROWS, len(search.whole))
    if ended is None or interval_s is None or len(rows) < 2 or search.whole.cut_at_s is not None:
        return
    last_s, end_s = float(rows.times[-1]), float(ended[0])
    most_s, usual_s = longest_usual_s(rows.times), usual_interval_s(rows.times)
    is_asked = search.segment.start_s < end_s and search.segment.end_s > last_s
    if most_s and usual_s and is_asked and end_s - last_s + usual_s > most_s:
        place = (run_id, last_s, end_s, search.wall_time_at(last_s))
        details = {"usual_interval_s": interval_s, "until": END_OF_RUN}
        yield Event("gap", *place, None, details)


GAP: Final = EventKind(
    "gap",
    "no rows recorded",
    gap_events,
    stored=True,
    alike=Alike(lambda events, unit: "gaps"),
    severity=10,
)
