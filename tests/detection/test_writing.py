"""A labelled recording is written as what a bridge would have written."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from tests.detection.labelled import LabelledRun
from tests.detection.writing import Writer, purge, put_in_chunks, write_all
from tests.memory import memory_connection

TIMES = np.round(0.1 * np.arange(50, dtype=np.float64), 6)
RUN = LabelledRun(
    TIMES, {"front": [1.0, math.nan, None] + [2.0] * 47, "pose": [[0, 1, 2]] * 50}, 0.1
)


def test_rows_hold_what_was_drawn_and_name_what_was_no_number() -> None:
    with memory_connection() as connection:
        (run_id,) = write_all(connection, [RUN])
        rows = connection.execute("SELECT run_id, sim_time_s, data, replaced FROM state").fetchall()
    assert [row[:2] for row in rows] == [(run_id, time_s) for time_s in TIMES.tolist()]
    assert json.loads(rows[0][2]) == {"front": 1.0, "pose": [0, 1, 2]} and rows[0][3] is None
    assert json.loads(rows[1][2])["front"] is None and json.loads(rows[1][3]) == {"front": "nan"}
    assert json.loads(rows[2][2])["front"] is None and rows[2][3] is None


def test_runs_of_a_session_follow_each_other_and_an_edit_begins_another() -> None:
    with memory_connection() as connection:
        writer = Writer(connection)
        for code in "aab":
            if code == "b" or not writer.runs:
                writer.begin_session(code)
            writer.write(RUN)
        runs = connection.execute(
            "SELECT start_reason, row_count, session_id, "
            "ended_wall_time_s - started_wall_time_s > 0, "
            "started_wall_time_s >= coalesce(lag(ended_wall_time_s) OVER (ORDER BY id), 0) FROM run"
        ).fetchall()
    assert runs == [("start", 50, 1, 1, 1), ("reset", 50, 1, 1, 1), ("start", 50, 2, 1, 1)]


def test_of_purged_rows_the_summaries_stay(tmp_path: Path) -> None:
    with memory_connection() as connection:
        write_all(connection, [RUN])
        put_in_chunks(connection)
        purge(connection, tmp_path, 20)
        assert connection.execute("SELECT count(*) FROM state").fetchone() == (20,)
        found = connection.execute("SELECT sum(row_count) FROM chunk GROUP BY signal_id").fetchall()
    assert set(found) == {(50,)}
