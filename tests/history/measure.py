"""What questions cost: `python -m tests.history.measure [ROWS ...]`, medians in ms of wall time.

It also says how many stuck places were found, and how many the recording has.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TypeVar

from tests.history.long_recording import CYCLE_S, INTERVAL_S, build
from webots_mcp.connection import connect
from webots_mcp.store.history.event import EventOptions
from webots_mcp.store.history.events import find_events
from webots_mcp.store.history.ranges import resolve_range
from webots_mcp.store.history.series import query_history
from webots_mcp.store.history.signals import list_signals
from webots_mcp.store.history.trends import trends

NAIVE = (
    "SELECT CAST(sim_time_s / 640 AS INTEGER), min(json_extract(data, '$.pose[0]')), "
    "max(json_extract(data, '$.pose[0]')), avg(json_extract(data, '$.pose[0]')) "
    "FROM state WHERE run_id = 1 GROUP BY 1"
)
TEN = ("pose", "ds.0", "ds.1", "ds.2", "battery_v", "imu.roll", "imu.pitch", "accel.0")
T = TypeVar("T")


def measure(name: str, question: Callable[[], T], repeats: int = 5) -> T:
    """Ask several times and print the median."""
    spent_ms: list[float] = []
    while True:
        began_s = time.perf_counter()
        answer = question()
        spent_ms.append((time.perf_counter() - began_s) * 1000)
        if len(spent_ms) == repeats:
            print(f"  {name:36s} {statistics.median(spent_ms):9.1f}")
            return answer


def measure_all(file: Path, rows: int) -> None:
    """Ask each question of a recording of that length, which is built where it is missing."""
    began_s = time.perf_counter()
    if not file.exists():
        build(file, rows)
    print(f"{rows} rows, built in {time.perf_counter() - began_s:.0f} s, {file.stat().st_size} B")
    with closing(connect(file, "reader")) as db:
        whole = resolve_range(db)
        minute, ten = (resolve_range(db, last_s=last_s) for last_s in (60, 600))
        stuck = EventOptions(kinds=("stuck",))
        measure("naive whole run, 1 signal", lambda: db.execute(NAIVE).fetchall(), 1)
        measure("query_history whole run, 1 signal", lambda: query_history(db, whole, TEN[:1]))
        measure("query_history whole run, 10 signals", lambda: query_history(db, whole, TEN))
        measure("query_history last minute, 10", lambda: query_history(db, minute, TEN))
        measure("query_history whole run, mode", lambda: query_history(db, whole, ["mode"]))
        measure("list_signals", lambda: list_signals(db))
        measure("trends of all signals, 10 minutes", lambda: trends(db, ten), 3)
        measure("find_events of all kinds, 10 minutes", lambda: find_events(db, ten), 3)
        measure("find_events of all kinds, whole run", lambda: find_events(db, whole), 3)
        found = measure("find_events stuck, whole run", lambda: find_events(db, whole, stuck))
        expected = sum(40 + CYCLE_S * k + 6 < rows * INTERVAL_S for k in range(rows))
        print(f"  stuck places found {found.totals.get('stuck', 0)}, in the recording {expected}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for size in [int(text) for text in sys.argv[1:]] or [10_000]:
            measure_all(Path(folder) / f"{size}.db", size)
