"""Which rollups and change points a pool lacks.

They are too many to be compared. What tells is the last state row that they hold: one number for
all runs at the pool, and while a shipper lives one for each run. Of a run that went on, only
buckets that rows after that number lie in are sent again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from webots_mcp.plugins.pool.outbox import Put
from webots_mcp.plugins.pool.reading import NOT_YET, Mark, Source, coarse_after, digest
from webots_mcp.plugins.pool.shipped_tables import table

_ROLLED: Final = "rolled"  # up to that state row, the rollups of all runs are shipped
# Of a first time, which may be long: up to that run they are shipped up to another state row.
_THROUGH_RUN: Final = "rolled.run"
_THROUGH_ROW: Final = "rolled.next"
_ENDS: Final = "coarse_rollup:{}"  # digests of how far coarse rollups are, so many runs each
_RUNS: Final = 64
_LATER: Final = 2**62  # than any bucket
_UNKNOWN: Final = -(2**61)  # is no end of coarse rollups


class Summaries:
    """What is known of the rollups at a pool.

    Args:
        progress: Of the pool; what is put is in it at once.
        put: Takes rows to be sent, and the progress that they make.
    """

    def __init__(self, progress: Mapping[str, int], put: Put) -> None:
        self._progress = progress
        self._put = put
        self._known = dict[int, Mark]()

    def ship(self, source: Source, marks: Sequence[Mark], watermark: int) -> None:
        """Ship what is new.

        Args:
            source: The recording.
            marks: Of its runs, in their order.
            watermark: Up to that state row, those of all runs are in.
        """
        if watermark < self._progress.get(_ROLLED, 0):  # they are being made anew
            self._put(None, {_ROLLED: 0, _THROUGH_RUN: 0})
        ends = _ends(marks)
        for mark in marks:
            name = _name_of(mark)
            known = self._known_mark(mark, is_same=self._progress.get(name) == ends[name])
            if mark != known:
                self._ship_run(source, mark, known)
                self._put(None, {_THROUGH_ROW: watermark, _THROUGH_RUN: mark.run_id})
            self._known[mark.run_id] = mark
        done = {_ROLLED: watermark, _THROUGH_RUN: 0, **ends}
        if changed := {key: value for key, value in done.items() if self._is_new(key, value)}:
            self._put(None, changed)

    def _is_new(self, name: str, value: int) -> bool:
        return self._progress.get(name, 0) != value

    def _known_mark(self, mark: Mark, *, is_same: bool) -> Mark:
        """What the pool has of a run."""
        if mark.run_id in self._known:
            return self._known[mark.run_id]
        is_through = mark.run_id <= self._progress.get(_THROUGH_RUN, 0)
        state_id = self._progress.get(_THROUGH_ROW if is_through else _ROLLED, 0)
        if mark.state_id > state_id or state_id == 0:
            return mark._replace(state_id=state_id, coarse_end=_UNKNOWN)
        return mark if is_same else mark._replace(coarse_end=_UNKNOWN)

    def _ship_run(self, source: Source, mark: Mark, known: Mark) -> None:
        since: int | None = _LATER
        if mark.state_id != known.state_id or known.state_id == 0:
            since = source.since_bucket(mark, known.state_id)
            self._send(source, "rollup", mark, NOT_YET if since is None else since - 1)
            self._send(source, "change", mark, NOT_YET if since is None else known.state_id)
        end = None if known.coarse_end == _UNKNOWN else known.coarse_end
        self._send(source, "coarse_rollup", mark, coarse_after(end, since))

    def _send(self, source: Source, name: str, mark: Mark, after: int) -> None:
        for batch in source.rolled(table(name), mark, after):
            self._put(batch, {})


def _name_of(mark: Mark) -> str:
    return _ENDS.format(mark.run_id // _RUNS)


def _ends(marks: Sequence[Mark]) -> dict[str, int]:
    """Digests of how far the coarse rollups of runs are, by their names in the progress."""
    rows = dict[str, list[tuple[int, int | None]]]()
    for mark in marks:
        rows.setdefault(_name_of(mark), []).append((mark.run_id, mark.coarse_end))
    return {name: digest(each) for name, each in rows.items()}
