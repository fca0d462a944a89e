"""What the questions tell of a run, without what only names it in its recording."""

from __future__ import annotations

import re
import sqlite3
from dataclasses import fields, is_dataclass
from typing import Any, Final, cast

from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection.events import find_events, timeline
from webots_mcp.judging.trends import Trend, trends
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import query_history

_LOCAL: Final = {
    "id", "ids", "run_id", "run_ids", "session_id", "robot_id", "cursor", "path",
    "age_s",  # told by the clock
    "intervals",  # each begins with its run
}  # fmt: skip
_LONG_S: Final = 600.0  # for slow machines to answer in full as well
_RUN: Final = re.compile(r"\b(runs?) \d+")


def answers(connection: sqlite3.Connection, run_id: int, part: tuple[float, float]) -> Any:
    """Trends, events, timeline, history and comparison of a run; the first two also of a part."""
    whole = find_range(connection, Scope(run_id=run_id))
    some = find_range(connection, Scope(run_id=run_id, start_s=part[0], end_s=part[1]))
    found = {
        "trends": trends(connection, whole, deadline_s=_LONG_S),
        "trends of a part": trends(connection, some, deadline_s=_LONG_S),
        "events": find_events(connection, whole, limit=200, deadline_s=_LONG_S),
        "events of a part": find_events(connection, some, limit=200, deadline_s=_LONG_S),
        "timeline": timeline(connection, whole, limit=200, deadline_s=_LONG_S),
        "history": query_history(connection, whole, ["*"], max_points=40, deadline_s=_LONG_S),
        "comparison": compare_runs(connection, [run_id], deadline_s=_LONG_S),
    }
    return _portable(found)


def _portable(value: Any) -> Any:
    if isinstance(value, Trend):  # what it says is worked out from its course when it is asked for
        members = {field.name: getattr(value, field.name) for field in fields(value)}
        del members["course"]
        said = {"swings": value.swings, "shape": value.shape, "says": value.says}
        return _portable({**members, **said})
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        named = cast("dict[Any, Any]", value)
        return {key: _portable(each) for key, each in named.items() if key not in _LOCAL}
    if isinstance(value, list | tuple):
        return [_portable(each) for each in cast("list[Any]", value)]
    if isinstance(value, str):
        return _RUN.sub(r"\1 N", value)
    if isinstance(value, float):
        return float(f"{value:.9g}")  # sums of rows that were added in another order
    return value
