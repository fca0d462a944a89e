"""Since when a run was slow."""

from __future__ import annotations

import re
import sqlite3
from itertools import accumulate
from random import Random

import pytest

from tests.judging.asking import ask, spans
from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.checks.check_run import check_run


def record(recorder: Recorder, factors: list[float], lasts_s: float = 20.0) -> None:
    """So many seconds of simulation time at each pace, a row each 0.1 s, with jitter of 10 %."""
    random = Random(str(factors))
    waits = [
        0.1 / factor * random.uniform(0.9, 1.1)
        for factor in factors
        for _ in range(round(10 * lasts_s))
    ]
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
    said = re.fullmatch(r"(.+) times real time from 39.9 s to 59.9 s, else (.+)", evidence)
    assert said is not None
    assert [float(each) for each in said.groups()] == pytest.approx([0.5, 1.0], abs=0.01)
    assert since_s == pytest.approx(40.0, abs=0.2)


def test_a_run_that_became_slow_is_slow_since_then() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [2.0, 2.0, 0.6])
        outcome, evidence, since_s = pace(connection)
    assert (outcome, since_s) == ("warn", pytest.approx(40.0, abs=1.0))
    assert re.fullmatch(
        r"0.(6|59|60)\d* times real time from 39.9 s on, else (2|1.99)\d*", evidence
    )


def test_a_run_that_is_slow_from_its_start_is_said_to_be_so() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [0.5, 0.5])
        outcome, evidence, since_s = pace(connection)
    assert (outcome, since_s) == ("warn", 0.0)
    assert float(evidence.split()[0]) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("dips_s", [6.0, 17.0])
def test_a_pace_that_drops_and_recovers_is_one_event_with_its_times(dips_s: float) -> None:
    ahead = [1.0] * 20
    with memory_connection() as connection:
        record(start_run(connection), [*ahead, 0.36, *ahead], dips_s)
        events = ask(connection, "slow_simulation")
        part = ask(
            connection,
            "slow_simulation",
            bounds={"run_id": 1, "start_s": 0.0, "end_s": 20.5 * dips_s},
        )
    ((start_s, end_s),) = spans(events)
    assert start_s == pytest.approx(20 * dips_s, abs=0.2)
    assert end_s == pytest.approx(21 * dips_s, abs=0.2)
    assert events.events[0].details["real_time_factor"] == pytest.approx(0.36, abs=0.01)
    assert events.events[0].details["otherwise"] == pytest.approx(1.0, abs=0.01)
    assert spans(part) == spans(events)


def test_a_run_as_fast_as_possible_that_drops_to_a_third_is_an_event_and_no_warning() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [9.0, 9.0, 9.0, 3.0, 9.0, 9.0])
        ((start_s, end_s),) = spans(ask(connection, "slow_simulation"))
        assert pace(connection)[0] == "pass"
    assert (start_s, end_s) == (pytest.approx(60, abs=0.2), pytest.approx(80, abs=0.2))


def test_a_steady_run_has_no_slow_part() -> None:
    with memory_connection() as connection:
        record(start_run(connection), [1.0] * 6)
        events = ask(connection, "slow_simulation")
    assert events.events == ()
    assert "slow_simulation" in events.verdicts.not_found
