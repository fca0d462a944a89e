"""Kept stretches as they are shipped: each of their states once, wherever retention has moved it.

Without full rate only the states of kept stretches are shipped. Those that retention takes from
`state` come to stand in `kept_state` with new ids: such a row is left out where it was shipped as a
state before.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Final

from webots_mcp.plugins.pool.outbox import Put
from webots_mcp.plugins.pool.reading import Source, Stretch, is_finite
from webots_mcp.plugins.pool.row_batch import Batch, Row
from webots_mcp.plugins.pool.shipped_tables import SQLValue, Table, table

_NEVER: Final = -1
# Names of the progress: the wall time of the newest state that was shipped at full rate, and up to
# when states were lacking then.
_SHIPPED: Final = "state.wall_time_us"
_LACKING: Final = "state.lacking_us"
# Of each stretch: its last state that was shipped, and the simulation times from the first to it.
_LAST: Final = "kept_stretch/{}"
_FROM: Final = "kept_stretch/{}.from_us"
_TO: Final = "kept_stretch/{}.to_us"


class Kept:
    """What is known of kept stretches at a pool.

    Args:
        progress: Of the pool; what is put is in it at once.
        put: Takes rows to be sent, and the progress that they make.
    """

    def __init__(self, progress: Mapping[str, int], put: Put) -> None:
        self._progress = progress
        self._put = put

    def told_of(self, states: Sequence[Row], lost: int, after: int) -> dict[str, int]:
        """The progress that states of full rate make, of which so many were deleted too early.

        Args:
            states: The rows.
            lost: How many rows lacked between them, and before the first.
            after: The last id of before.
        """
        row_id, wall_time = map(table("state").columns.index, ("id", "wall_time_s"))
        newest_us = _microseconds(states[-1][wall_time]) if states else None
        told = {_SHIPPED: newest_us} if newest_us is not None else {}
        if lost:
            is_before = bool(states) and states[0][row_id] == after + lost + 1
            first_us = _microseconds(states[0][wall_time]) if is_before else None
            until_us = newest_us if first_us is None else first_us - 1
            told[_LACKING] = round(time.time() * 1e6) if until_us is None else until_us
        return told

    def without_moved(self, source: Source, batch: Batch) -> Batch:
        """Kept states without those that were shipped as states."""
        columns = batch.table.columns
        call, run = columns.index("call"), columns.index("run_id")
        sim, wall = columns.index("sim_time_s"), columns.index("wall_time_s")
        known = [each for each in source.stretches() if _FROM.format(each.id) in self._progress]

        def is_shipped(row: Row) -> bool:
            return row[call] is None and (
                self._is_shipped_state(row[wall])
                or any(self._has_shipped(each, row[run], row[sim]) for each in known)
            )

        return Batch(batch.table, [row for row in batch.rows if not is_shipped(row)])

    def _is_shipped_state(self, wall_time_s: SQLValue) -> bool:
        time_us = _microseconds(wall_time_s)
        lacking_us = self._progress.get(_LACKING, _NEVER)
        return time_us is not None and lacking_us < time_us <= self._progress.get(_SHIPPED, _NEVER)

    def _has_shipped(self, stretch: Stretch, run_id: SQLValue, sim_time_s: SQLValue) -> bool:
        time_us = _microseconds(sim_time_s)
        if run_id != stretch.run_id or time_us is None:
            return False
        first_us, last_us = (self._progress[name.format(stretch.id)] for name in (_FROM, _TO))
        return first_us <= time_us <= last_us

    def ship(self, source: Source, upto: int, *, thorough: bool) -> None:
        """Ship the states of kept stretches, up to an id."""
        for stretch in source.stretches():
            after = self._progress.get(_LAST.format(stretch.id))
            if after is None or thorough or not stretch.is_over:
                self._ship_stretch(source, stretch, after or 0, upto)

    def _ship_stretch(self, source: Source, stretch: Stretch, after: int, upto: int) -> None:
        states, is_all = table("state"), False
        while not is_all:
            batch, is_all = source.kept(states, stretch, after, upto)
            if batch.rows:
                after = int(str(batch.rows[-1][0]))
                self._put(batch, self._told_of_stretch(states, stretch, batch.rows))

    def _told_of_stretch(
        self, states: Table, stretch: Stretch, rows: Sequence[Row]
    ) -> dict[str, int]:
        sim = states.columns.index("sim_time_s")
        times = [time_us for row in rows if (time_us := _microseconds(row[sim])) is not None]
        first, last = _FROM.format(stretch.id), _TO.format(stretch.id)
        return {
            _LAST.format(stretch.id): int(str(rows[-1][0])),
            first: min(times, default=0) if first not in self._progress else self._progress[first],
            last: max([self._progress.get(last, 0), *times]),
        }


def _microseconds(time_s: SQLValue) -> int | None:
    """None of what is no time."""
    return round(time_s * 1e6) if is_finite(time_s) else None
