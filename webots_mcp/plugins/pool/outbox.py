"""Rows on their way to a pool: gathered, and written with the progress that they make."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from webots_mcp.plugins.pool.report import Report
from webots_mcp.plugins.pool.row_batch import Batch, row_bytes
from webots_mcp.plugins.pool.target import Shipment

WRITE_BYTES: Final = 8_000_000

Put = Callable[["Batch | None", Mapping[str, int]], None]


class Outbox:
    """What waits to be written together, with the progress that it makes."""

    def __init__(self, shipment: Shipment, report: Report, progress: dict[str, int]) -> None:
        self._shipment = shipment
        self._report = report
        self._batches: list[Batch] = []
        self._told = dict[str, int]()
        self._size = 0
        self.progress = progress

    @property
    def is_full(self) -> bool:
        """Whether to send before anything is added."""
        return self._size >= WRITE_BYTES

    def add(self, batch: Batch | None, told: Mapping[str, int]) -> None:
        """Rows, and the numbers that hold once they are written."""
        if batch is not None and batch.rows:
            self._batches.append(batch)
            self._size += sum(map(row_bytes, batch.rows))
        self._told |= told
        self.progress |= told

    def send(self) -> None:
        """Write it all, in one transaction of the pool's."""
        if not self._batches and not self._told:
            return
        self._report.replaced.update(self._shipment.write(self._batches, self._told))
        for batch in self._batches:
            self._report.rows[batch.table.name] += len(batch.rows)
        self._batches, self._told, self._size = [], {}, 0
