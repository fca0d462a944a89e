"""Every second counts the same: rows that were added or lost shift no mean and no deviation."""

from __future__ import annotations

import json
import sqlite3
import uuid
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tests.recordings.rover import start_run
from webots_mcp.analysis.arrays import time_weights
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.run_score import score_run
from webots_mcp.judging.trends import trends
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signal_history import WEIGHTED, query_history

LASTS_S = 100.0
STEP_S = 0.1
EVEN = [round(step * STEP_S, 6) for step in range(1000)]


def low_then_high(time_s: float) -> float:
    """0 in the first half, 10 in the second one, with a ripple that a deviation shows."""
    return (10.0 if time_s >= LASTS_S / 2 else 0.0) + 0.5 * (round(time_s / STEP_S) % 2)


def record(connection: sqlite3.Connection, times: Sequence[float]) -> None:
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for time_s in times:
        recorder.publish(time_s, {"v": low_then_high(time_s), "far": time_s >= LASTS_S / 2})
    connection.execute("COMMIT")


def with_more_rows() -> list[float]:
    """Ten rows for each one in a tenth of the run, as of breakpoints and expectations."""
    added = [round(80 + step * STEP_S / 10, 6) for step in range(1000)]
    return sorted({*EVEN, *added})


def with_gap() -> list[float]:
    return [time_s for time_s in EVEN if not 60 < time_s < 80]


def at_two_rates() -> list[float]:
    return [time_s for at, time_s in enumerate(EVEN) if time_s < 50 or at % 7 == 0]


@pytest.mark.parametrize("times", [with_more_rows, with_gap, at_two_rates])
def test_uneven_rows_shift_no_figure(
    empty: sqlite3.Connection, looked_at: str, times: Callable[[], list[float]]
) -> None:
    record(empty, times())
    make_chunks(empty, 100_000)
    asked = find_range(empty, Scope())
    found = trends(empty, asked, ["v"])
    (trend,) = found.runs[0].numbers
    # A row next to a gap, or to another rate, stands for up to half of a long step too much.
    assert trend.mean == pytest.approx(5.25, abs=0.3)
    assert trend.deviation == pytest.approx(5.0, abs=0.1)
    assert WEIGHTED in found.notes
    history = query_history(empty, asked, ["v"], max_points=1)
    (whole,) = history.runs[0].numbers[0].mean
    assert whole == pytest.approx(trend.mean, rel=1e-5)
    assert history.runs[0].numbers[0].whole.mean == pytest.approx(trend.mean, rel=1e-5)
    assert WEIGHTED in history.notes
    # A score lets a value count up to the next state, which differs by half a step at a border.
    assert score_run(empty, 1, "mean(v)").value == pytest.approx(5.25, abs=0.3)


def test_a_full_rate_segment_counts_as_long_as_it_lasts(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(empty, EVEN)
    for step in range(2000):
        time_s = round(80 + step * STEP_S / 20, 6)
        row = (1, time_s, time_s, json.dumps({"v": low_then_high(time_s)}))
        empty.execute(
            "INSERT INTO kept_state (run_id, sim_time_s, wall_time_s, data) VALUES (?, ?, ?, ?)",
            row,
        )
    empty.execute(
        "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, reason, "
        "wall_time_s) VALUES (1, ?, 80, 90, 'bumped', 0)",
        (str(uuid.uuid4()),),
    )
    make_chunks(empty, 100_000)
    (trend,) = trends(empty, find_range(empty, Scope()), ["v"]).runs[0].numbers
    assert trend.mean == pytest.approx(5.25)
    event = find_events(
        empty, find_range(empty, Scope()), EventOptions(kinds=("condition",), where="v > -1")
    ).events[0]
    assert event.details["v meanwhile"]["mean"] == pytest.approx(5.25, abs=0.05)


def test_a_condition_tells_what_other_signals_were_while_it_held(
    empty: sqlite3.Connection,
) -> None:
    record(empty, with_more_rows())
    options = EventOptions(kinds=("condition",), where="far", signals=("v",))
    found = find_events(empty, find_range(empty, Scope()), options)
    figures = found.events[0].details["v meanwhile"]
    assert figures == {"mean": pytest.approx(10.25, abs=0.05), "min": 10.0, "max": 10.5}
    (said,) = (note for note in found.notes if "v mean" in note)
    assert "49.9 s" in said and "min 10, max 10.5" in said


def test_even_rows_count_alike() -> None:
    assert time_weights(np.array(EVEN)) is None
    assert time_weights(np.array([0.0, 5.0])) is None


def test_rows_of_one_moment_share_its_time() -> None:
    weights = time_weights(np.array([0.0, 1.0, 1.0, 1.0, 2.0, 3.0]))
    assert weights is not None
    assert weights[1:4].sum() == pytest.approx(weights[4])
