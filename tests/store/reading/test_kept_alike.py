"""Equal recordings with and without a kept stretch give equal means, counts, rates and trends."""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.run_score import score_run
from webots_mcp.judging.trends import trends
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import query_history

pytestmark = pytest.mark.slow

ROWS = 60
INTERVAL_S = 0.1
PARTS = 5  # calls of `publish` for each row
SCORE = "mean(v) + time(v > 3) + last(v) + count(jump)"
STRETCHES = st.integers(0, ROWS - 2).flatmap(
    lambda first: st.tuples(st.just(first), st.integers(first + 1, ROWS - 1))
)

_KEPT = "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)"
_STRETCH = (
    "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, reason, wall_time_s)"
    " VALUES (?, ?, ?, ?, 'bumped', 0)"
)


@contextmanager
def recorded(slope: float, kept: tuple[int, int] | None, chunks: bool) -> Generator[Any]:
    """One run, in which rows [start, stop) have the calls between them as well."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        for call in range(ROWS * PARTS):
            time_s = round(call * INTERVAL_S / PARTS, 6)
            v = round(slope * call + 5 * math.sin(call / 40), 6)
            state = {"v": v, "mode": "a" if call < 150 else "b"}
            if call % PARTS == 0:
                recorder.publish(time_s, state)
            elif kept is not None and kept[0] <= call // PARTS < kept[1]:
                values = (recorder.run_id, time_s, time_s, json.dumps(state))
                connection.execute(_KEPT, values)
        if kept is not None:
            ends_s = [round(each * INTERVAL_S, 6) for each in kept]
            connection.execute(_STRETCH, (recorder.run_id, str(uuid.uuid4()), *ends_s))
        if chunks:
            make_chunks(connection, 1000)
        yield connection


def answers(connection: Any) -> dict[str, Any]:
    """What no call between two rows may change; extremes and changes take them in."""
    whole = find_range(connection, Scope())
    (run,) = query_history(connection, whole, ["v"], max_points=7).runs
    (numbers,) = run.numbers
    (trend,) = trends(connection, whole, ["v"]).runs[0].numbers
    return {
        "history": (run.rows, run.sim_time_s, numbers.mean, numbers.count, numbers.last),
        "whole": (numbers.whole.present, numbers.whole.mean, numbers.whole.squares),
        "rhythm": (run.interval_s, run.gaps),
        "trend": (trend.mean, trend.deviation, trend.slope_per_s, trend.r2, trend.summary.present),
        "measures": compare_runs(connection, [1]).measures,
        "score": score_run(connection, 1, SCORE),
    }


@settings(deadline=None, max_examples=25)
@given(st.floats(-0.1, 0.1), STRETCHES, st.booleans())
def test_a_kept_stretch_changes_no_mean_count_rate_or_trend(
    slope: float, kept: tuple[int, int], chunks: bool
) -> None:
    with recorded(slope, kept, chunks) as with_stretch, recorded(slope, None, chunks) as without:
        assert with_stretch.execute("SELECT count(*) FROM kept_state").fetchone()[0] > 0
        assert answers(with_stretch) == answers(without)
