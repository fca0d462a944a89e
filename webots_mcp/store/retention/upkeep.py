"""Retention as a maintainer's work: a plan once a minute, carried out a little in each round."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from webots_mcp.store.retention.planning import plan
from webots_mcp.store.retention.policy import DEFAULT, Retention
from webots_mcp.store.retention.purge import PAUSE_S, Purged, purge

INTERVAL_S: Final = 60.0
BUDGET_S: Final = 0.25  # of each round of the maintainer: about 2,500 rows a second
SPARE_PAGES: Final = 2500  # 10 MB that stay in the file: what is recorded next needs them again


class Upkeep:
    """Called once in each round of the maintainer, which alone does this work.

        Maintainer(database, "server", work=Upkeep(data_dir))

    Args:
        data_dir: The folder that the paths of pictures are relative to.
        retention: The limits.
        interval_s: Between two plans.
        budget_s: How long a call may last, pauses included; a batch more at most.
    """

    def __init__(
        self,
        data_dir: Path,
        retention: Retention = DEFAULT,
        *,
        interval_s: float = INTERVAL_S,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._data_dir = data_dir
        self._retention = retention
        self._interval_s = interval_s
        self._budget_s = budget_s
        self._next_plan_s = 0.0
        self._connection: sqlite3.Connection | None = None
        self._under_way: Iterator[Purged] | None = None

    def __call__(self, connection: sqlite3.Connection) -> None:
        """Delete for a moment, if anything is beyond the limits.

        Raises:
            sqlite3.Error, DatabaseError: The next call begins with a new plan.
        """
        if connection is not self._connection:
            self._connection, self._under_way = connection, None
        try:
            self._work(connection)
        except BaseException:
            self._under_way = None
            raise

    def _work(self, connection: sqlite3.Connection) -> None:
        now_s = time.monotonic()
        if self._under_way is None:
            if now_s < self._next_plan_s:
                return
            self._next_plan_s = now_s + self._interval_s
            wanted = plan(connection, self._retention)
            self._under_way = purge(connection, wanted, self._data_dir, SPARE_PAGES)
        for _ in self._under_way:
            if time.monotonic() - now_s > self._budget_s:
                return
            time.sleep(PAUSE_S)
        self._under_way = None
