"""Recording gaps: where the next row came much later than the rows usually do."""

from __future__ import annotations

import math
import sqlite3
from typing import Final

from webots_mcp.store.analysis.rhythm import (
    GAP_INTERVALS,
    Rhythm,
    gaps_in,
    interruptions,
    rhythm_of,
    usual_interval_s,
)
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.frame_summary import FULL_ROWS
from webots_mcp.store.reading.ranges import Segment

_SAMPLE_ROWS: Final = 2000
_ROWS_AROUND: Final = 20  # before and after a stretch: they tell what is usual


def frame_around(connection: sqlite3.Connection, segment: Segment, deadline: Deadline) -> Frame:
    """A segment with some rows before and after it: a gap at its end, or all around it, shows."""
    run = read_frame(connection, Segment(segment.run_id, -math.inf, math.inf), deadline)
    start, stop = run.places([segment.start_s, segment.end_s]).tolist()
    return run.rows(start - _ROWS_AROUND, stop + _ROWS_AROUND)


def rhythm_in(frame: Frame) -> Rhythm:
    """The rhythm of the rows of a frame; of many, only chunks that have a gap are opened.

    The median is then that of the first 2,000 rows.
    """
    if len(frame) <= FULL_ROWS:
        return rhythm_of(frame.times)
    interval_s = usual_interval_s(frame.rows(0, _SAMPLE_ROWS).times)
    if interval_s is None:
        return rhythm_of(frame.times)
    around = frame.around_steps(GAP_INTERVALS * interval_s)
    gaps = [gap for times in around for gap in gaps_in(times, interval_s)]
    return Rhythm(interval_s, interruptions(gaps))
