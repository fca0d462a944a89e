"""The range of time that a tool was asked about."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.store.reading.ranges import TimeRange, resolve_range
from webots_mcp.store.recording import View

MOST_RUNS: Final = 5  # of which one answer tells


@dataclass(frozen=True)
class Bounds:
    """The parameters of a range, as tools have them; all None is the whole run."""

    last_s: float | None = None
    start_s: float | None = None
    end_s: float | None = None
    since: float | str | None = None
    until: float | str | None = None

    def resolve(self, view: View, run_id: int | None) -> TimeRange:
        """What they mean for the robot of a view, in its newest few runs.

        Raises:
            InvalidRangeError: See `resolve_range`.
            NothingRecordedError: There is no row, or none in that wall time.
        """
        found = resolve_range(
            view.connection,
            robot=view.robot.name,
            run_id=run_id,
            start_s=self.start_s,
            end_s=self.end_s,
            last_s=self.last_s,
            since=self.since,
            until=self.until,
        )
        if not found.segments:
            raise NothingRecordedError(
                f"{'; '.join(found.notes)}: webots_list_runs tells when each run was"
            )
        return newest_runs(found)


def newest_runs(found: TimeRange) -> TimeRange:
    """The range within its newest few runs; a note tells of earlier ones."""
    earlier = len(found.segments) - MOST_RUNS
    if earlier <= 0:
        return found
    note = f"the range holds {earlier} earlier runs too (webots_list_runs): ask with run_id"
    return replace(found, segments=found.segments[-MOST_RUNS:], notes=(*found.notes, note))
