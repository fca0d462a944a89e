"""Writing rows in order: waiting rows come before new ones."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

from webots_mcp.bridge.backlog import Backlog, Row
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.recovery import Recovery
from webots_mcp.bridge.row_counts import RowCounts
from webots_mcp.bridge.run import Run
from webots_mcp.bridge.session_connection import SessionConnection, patiently
from webots_mcp.connection import FAILURES, in_transaction, is_busy, roll_back
from webots_mcp.signal_register import Seen, find_changes, write_changes
from webots_mcp.waiting_file import STATEMENTS, Kind, Taken, Values, bind, is_unfit, take_in

_CATCH_UP_S: Final = 0.002  # per call: writing waiting rows must not stall the loop


class RowWriter:
    """Writes a row, or lets it wait. The caller must have the connection lock."""

    def __init__(
        self,
        session: SessionConnection,
        backlog: Backlog,
        recovery: Recovery,
        counts: RowCounts,
        clock: Clock,
    ) -> None:
        self._session = session
        self._backlog = backlog
        self._recovery = recovery
        self._counts = counts
        self._clock = clock

    def write(self, kind: Kind, run: Run | None, values: Values) -> int | None:
        """Write a row; returns how many rows the statement changed, or None if it was deferred."""
        session = self._session
        if self._is_behind(run) and not self.catch_up(run):
            self._keep(Row(kind, run, values))
            return None
        assert session.registration is not None
        bound = bind(run.id if run else None, session.registration.session_id, values)
        try:
            changed = session.execute(STATEMENTS[kind], bound)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._write_failed(Row(kind, run, values), error)
            return None
        self._counts.written += 1
        if kind == "state" and run is not None:
            run.rows += 1
        return changed

    def write_together(self, kind: Kind, run: Run, rows: Sequence[tuple[Any, ...]]) -> None:
        """Write rows of a run in one transaction; one by one where that fails."""
        if self._is_behind(run) and not self.catch_up(run):
            for values in rows:
                self._keep(Row(kind, run, values))
            return
        connection, registration = self._session.opened
        bound = [bind(run.id, registration.session_id, values) for values in rows]
        try:
            patiently(
                lambda: in_transaction(
                    connection, lambda: connection.executemany(STATEMENTS[kind], bound)
                )
            )
        except Exception:  # noqa: BLE001  (written one by one, each row fails by itself)
            for values in rows:
                self.write(kind, run, values)
            return
        self._counts.written += len(rows)

    def enter_signals(self, seen: Mapping[str, Seen]) -> bool:
        """Enter names into the register of signals; False where another writer has the lock.

        What fails for another reason is left to the maintainer.
        """
        if not self.is_ready(None):
            return False
        connection, registration = self._session.opened
        robot_id = registration.robot_id
        try:
            changes = find_changes(connection, robot_id, seen)
            if changes.new or changes.changed:
                write = partial(write_changes, connection, robot_id, changes)
                patiently(lambda: in_transaction(connection, write))
        except FAILURES as error:
            return not is_busy(error)
        return True

    def fetch(self, statement: str, values: Values) -> Sequence[Any] | None:
        """The rows that a statement reads or returns; None while waiting rows come first."""
        if not self.is_ready(None):
            return None
        connection, _ = self._session.opened
        # All rows are fetched: an UPDATE ... RETURNING keeps the write lock until its last row.
        return connection.execute(statement, values).fetchall()

    def is_ready(self, run: Run | None) -> bool:
        """Whether all rows that precede a new row of that run are written; tries to write them."""
        return not self._is_behind(run) or self.catch_up(run)

    def catch_up(self, run: Run | None) -> bool:
        """Write the waiting rows and the run's own row; False where some are still waiting."""
        if not self._recovery.is_connected():
            return False
        connection, _ = self._session.opened
        roll_back(connection)  # an interrupt may have left a transaction open
        try:
            self._take_in_waiting()
            if run is not None and run.id is None and not self._backlog.waits:
                self._session.enter_run(run)
        except Exception as error:  # noqa: BLE001  (see `is_busy`)
            self._backlog.save()
            self._recovery.put_off(error)
            return False
        if self._backlog.waits:
            return False
        self._report_dropped()
        return not self._backlog.waits

    def _is_behind(self, run: Run | None) -> bool:
        connection = self._session.connection
        return (
            connection is None
            or self._backlog.waits
            or connection.in_transaction
            or (run is not None and run.id is None)
            or self._counts.unreported > 0
        )

    def _write_failed(self, row: Row, error: Exception) -> None:
        if is_unfit(error):
            self._counts.drop(1, str(error))
        else:
            self._keep(row)
            self._recovery.put_off(error)

    def _keep(self, row: Row) -> None:
        if self._recovery.off is not None:
            self._counts.drop(1, self._recovery.off)
        else:
            self._backlog.keep(row)

    def _take_in_waiting(self) -> None:
        connection, registration = self._session.opened
        until_s = time.monotonic() + _CATCH_UP_S
        while self._backlog.waits and (entries := self._backlog.next_entries()):
            taken = take_in(connection, registration.session_id, entries)
            self._backlog.forget(taken.number)
            self._count(taken)
            if time.monotonic() > until_s:
                break

    def _count(self, taken: Taken) -> None:
        run = self._session.run
        self._counts.written += sum(entry.kind != "run" for entry in taken.written)
        run.rows += sum(e.kind == "state" and e.run == run.uuid for e in taken.written)
        for why in taken.unfit:
            self._counts.drop(1, why)

    def _report_dropped(self) -> None:
        if self._counts.unreported:
            run, text = self._session.run, self._counts.report()
            now = (self._clock.newest_s(run), time.time())
            self.write("event", run, (*now, "dropped", None, text))
