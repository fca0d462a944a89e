"""The range of time that a tool was asked about."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.recording import View

MOST_RUNS: Final = 5  # of which one answer tells


def range_in(view: View, scope: Scope) -> TimeRange:
    """What a scope means for the robot of a view, in its newest few runs.

    Raises:
        InvalidRangeError: See `find_range`.
        NothingRecordedError: There is no row, or none in that wall time.
    """
    found = find_range(view.connection, scope, view.subject)
    if not found.segments:
        raise NothingRecordedError(
            f"{'; '.join(found.notes)}: webots_list_runs tells when each run was"
        )
    return newest_runs(found)


def newest_runs(found: TimeRange) -> TimeRange:
    """The range within its newest few runs; a note names earlier ones."""
    earlier = len(found.segments) - MOST_RUNS
    if earlier <= 0:
        return found
    runs = "1 earlier run" if earlier == 1 else f"{earlier} earlier runs"
    note = f"the range holds {runs} too (webots_list_runs): ask with run_id"
    return replace(found, segments=found.segments[-MOST_RUNS:], notes=(*found.notes, note))
