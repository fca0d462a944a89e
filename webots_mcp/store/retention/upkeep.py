"""Retention as a maintainer's work: a plan every few seconds, carried out a little at a time."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from webots_mcp.errors import warn
from webots_mcp.store.retention.limits import in_force
from webots_mcp.store.retention.planning import Plan, plan
from webots_mcp.store.retention.policy import Retention
from webots_mcp.store.retention.purge import Purged, purge
from webots_mcp.store.retention.usage import Holdings

INTERVAL_S: Final = 2.0
PLANNING_SHARE: Final = 0.02  # of the time: looking at ten million rows takes a second
BUDGET_S: Final = 0.75  # of each round of the maintainer, nine tenths of it at rest
# What stays free in the file for the rows to come: a fortieth of it, but no more than 10 MB.
SPARE_SHARE: Final = 40
MOST_SPARE_PAGES: Final = 2500


class Upkeep:
    """Called once in each round of the maintainer, which alone does this work.

        Maintainer(database, "server", work=Upkeep(data_dir))

    Args:
        data_dir: The folder that the paths of pictures are relative to.
        limits: Returns the limits in force.
        interval_s: Between two plans at least; more where planning takes long.
        budget_s: How long a call may last, rests included; a write more at most.
    """

    def __init__(
        self,
        data_dir: Path,
        limits: Callable[[sqlite3.Connection], Retention] = in_force,
        *,
        interval_s: float = INTERVAL_S,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._data_dir = data_dir
        self._limits = limits
        self._interval_s = interval_s
        self._budget_s = budget_s
        self._next_plan_s = 0.0
        self._connection: sqlite3.Connection | None = None
        self._holdings = Holdings()
        self._under_way: Iterator[Purged] | None = None
        self._has_warned = False

    def __call__(self, connection: sqlite3.Connection) -> None:
        """Delete for a moment, if anything is beyond the limits.

        Raises:
            sqlite3.Error, DatabaseError: The next call begins with a new plan.
        """
        if connection is not self._connection:
            self._connection, self._under_way, self._next_plan_s = connection, None, 0.0
            self._holdings = Holdings()
        try:
            self._work(connection)
        except BaseException:
            self._under_way = None
            raise

    def _work(self, connection: sqlite3.Connection) -> None:
        started_s = time.monotonic()
        if self._under_way is None:
            if started_s < self._next_plan_s:
                return
            self._under_way = self._planned(connection)
        for purged in self._under_way:
            if time.monotonic() - started_s > self._budget_s:
                return
            time.sleep(purged.rest_s)
        self._under_way = None

    def _warn_of(self, wanted: Plan) -> None:
        """Once, until there is nothing of the kind any more."""
        if wanted.unshipped and not self._has_warned:
            tables = ", ".join(f"{each.table} {each.rows}" for each in wanted.unshipped)
            warn(
                f"rows are deleted that were not shipped yet ({tables}), because more wait than "
                "--keep-until-shipped keeps: look whether 'webots-mcp ship --follow' runs"
            )
        self._has_warned = bool(wanted.unshipped)

    def _planned(self, connection: sqlite3.Connection) -> Iterator[Purged]:
        started_s = time.monotonic()
        wanted = plan(connection, self._limits(connection), holdings=self._holdings)
        self._warn_of(wanted)
        took_s = time.monotonic() - started_s
        self._next_plan_s = started_s + max(self._interval_s, took_s / PLANNING_SHARE)
        pages = int(connection.execute("PRAGMA page_count").fetchone()[0])
        spare_pages = min(pages // SPARE_SHARE, MOST_SPARE_PAGES)
        return purge(connection, wanted, self._data_dir, spare_pages, self._holdings)
