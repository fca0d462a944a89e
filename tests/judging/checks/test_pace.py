"""Since when a run was slow."""

from __future__ import annotations

import re
import sqlite3
from itertools import accumulate

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.checks.check_run import check_run


def record(recorder: Recorder, factors: list[float]) -> None:
    """Twenty seconds of simulation time at each pace, a row each 0.1 s."""
    waits = [0.1 / factor for factor in factors for _ in range(200)]
    for row, wall_s in enumerate(accumulate(waits)):
        recorder.insert(
            "state",
            run_id=1,
            sim_time_s=round(row / 10, 3),
            wall_time_s=1e9 + wall_s,
            data='{"x": 1.0}',
        )


def pace(connection: sqlite3.Connection) -> tuple[str, str, float | None]:
    (found,) = (each for each in check_run(connection, 1).findings if each.name == "keeps pace")
    return found.outcome, found.evidence, found.since_s


def test_a_slow_part_of_a_fast_run_is_reported_with_its_times() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [1.0, 1.0, 0.5, 1.0])
        outcome, evidence, since_s = pace(connection)
    assert outcome == "warn"
    # The second in which it changes counts to one of the parts.
    assert re.fullmatch(r"0.51?2? times real time from (39|40) s to (59|60) s, else 1", evidence)
    assert since_s == pytest.approx(40.0, abs=1.0)


def test_a_run_that_became_slow_is_slow_since_then() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [2.0, 2.0, 0.6])
        outcome, evidence, since_s = pace(connection)
    assert (outcome, since_s) == ("warn", pytest.approx(40.0, abs=1.0))
    assert re.fullmatch(r"0.6\d* times real time from (39|40) s on, else 2", evidence)


def test_a_run_that_is_slow_from_its_start_is_said_to_be_so() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [0.5, 0.5])
        assert pace(connection) == ("warn", "0.5 times real time", 0.0)
