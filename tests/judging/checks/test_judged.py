"""Each kind of fault is noticed by its check, and nothing fails in healthy runs."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.exploring import attempts
from tests.judging.checks.judging import HEALTHY, checked, judge, render
from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp.judging.checks.check_run import CHECKS, UNDERSTOOD, check_run
from webots_mcp.signals.conditions.expectation import read_expectation
from webots_mcp.store.chunk_making import make_chunks


@pytest.mark.slow
def test_each_fault_is_noticed_by_its_check_and_no_check_fails_in_healthy_runs() -> None:
    judged = judge(attempts(4, exploring=8), 2)
    table = render(judged)
    healthy = judged.pop(HEALTHY)
    assert healthy.wrong == [], table
    assert {kind: each.noticed for kind, each in judged.items()} == {
        kind: each.runs for kind, each in judged.items()
    }, table
    assert {each.checked_by for each in judged.values()} >= {
        check.name for check in CHECKS if check.name not in ("keeps expectations", UNDERSTOOD)
    }


@pytest.mark.slow
def test_what_the_deadline_leaves_unread_is_not_looked_at_and_never_passes() -> None:
    found = checked("healthy", 1, deadline_s=0.0)  # whose rows are in no chunk
    assert not [each for each in found if each.outcome == "pass" and each.name in OF_VALUES]
    assert {each.outcome for each in found if each.name in OF_VALUES} == {"not looked at"}


OF_VALUES = {
    check.name for check in CHECKS
    if (check.of_values or "stuck" in check.kinds) and check.name != "keeps expectations"
}  # fmt: skip


# -- recordings made to fool them ------------------------------------------------------------------


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[RecordedRobot]:
    with closing(Recorded(tmp_path / "webots.db")) as recorded:
        yield recorded.robot(now=1e9)


def outcomes(connection: sqlite3.Connection, *expect: str) -> dict[str, str]:
    """Of each check: outcome and evidence."""
    found = check_run(connection, 1, expect=[read_expectation(each) for each in expect]).findings
    return {each.name: f"{each.outcome}: {each.evidence}" for each in found}


State = Callable[[int], dict[str, Any]]
# A state of each row, the pace, a check, and what it says.
FOOLING: list[tuple[State, float, str, str]] = [
    (
        lambda row: {"pose": [0.02 * row, 0.0], "commanded_m_s": 0.2}, 1.0,
        "rests when commanded",
        "not applicable: it was never commanded to rest: commanded_m_s was never 0",
    ),
    (
        lambda row: {"pose": [0.01 * row, 0.0], "commanded_m_s": 0.0}, 1.0,
        "rests when commanded",
        "warn: moved 2.4 m from 3.95 to 27.45 s (medians of 50 rows) although commanded_m_s was 0 "
        "from 0 to 29.9 s",
    ),
    (
        lambda row: {"front": math.nan if row % 2 else row}, 1.0,
        "sensors speak", "warn: front: NaN in 50 % of the rows",
    ),
    (
        lambda row: {"front": math.nan if row < 200 else row}, 1.0,
        "sensors speak", "warn: front: NaN in 66.7 % of the rows",
    ),
    (
        lambda row: {"front": math.nan if row < 3 else row}, 1.0,
        "sensors speak", "pass: none that had a value",
    ),
    (
        lambda row: {"arm": {"target": 0.0, "position": 0.2}}, 1.0,
        "follows its targets", "not applicable: no signal is known to be the target",
    ),
    (
        lambda row: {"arm": {"target": 1.0, "position": 0.2}}, 1.0,
        "follows its targets", "fail: arm.position: 80 % off arm.target for",
    ),
    (
        lambda row: {"arm": {"target": -(row < 99), "position": max(-1, min(0, row / 200 - 1))}},
        1.0, "sensors live", "pass",
    ),
    (lambda row: {"x": row}, 0.02, "keeps pace", "warn: 0.02 times real time"),
]  # fmt: skip


@pytest.mark.parametrize(("state", "pace", "check", "said"), FOOLING)
def test_what_is_half_broken_does_not_pass_and_what_is_only_unusual_does_not_fail(
    robot: RecordedRobot, state: State, pace: float, check: str, said: str
) -> None:
    for row in range(300):
        data, replaced = state(row), None
        if isinstance(front := data.get("front"), float) and math.isnan(front):
            data, replaced = {"front": None}, {"front": "nan"}
        robot.state(row / 10, data, replaced, at=1e9 + row / 10 / pace)
    robot.end_run("finished")
    assert outcomes(robot.connection)[check].startswith(said)


def test_a_run_without_rows_is_worth_a_look(robot: RecordedRobot) -> None:
    robot.end_run("finished")
    assert outcomes(robot.connection)["loses no rows"] == (
        "warn: run 1 has no state row: call bridge.publish"
    )


@pytest.mark.parametrize("column", ["front", "mode", "simulation times"])
def test_nothing_passes_on_what_a_damaged_chunk_held(robot: RecordedRobot, column: str) -> None:
    robot.connection.execute("BEGIN")
    for row in range(3000):
        robot.state(row / 10, {"front": 0.5 + row % 7, "mode": "drive"}, at=1e9 + row / 10)
    robot.connection.execute("COMMIT")
    robot.end_run("finished")
    robot.beat(ended_wall_time_s=1e9, end_reason="finished")
    assert make_chunks(robot.connection, 100_000).done
    robot.connection.execute("DELETE FROM state")
    robot.connection.execute(
        "UPDATE chunk SET numbers = x'00', codes = x'00' WHERE group_id = 2 AND signal_id = "
        "coalesce((SELECT id FROM signal WHERE name = ?), 0)",
        (column,),
    )
    told = outcomes(robot.connection, "front > 0.1 during mode == 'drive'")
    assert told["expects: front > 0.1 during mode == 'drive'"].startswith("not looked at: not read")
    if column == "simulation times":
        assert told["misses no steps"].startswith("not looked at")
