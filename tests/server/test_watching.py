"""Windows of wall time: what the rows in them show, and how far the robot went."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import Connect, ask
from tests.server.story import rows_of
from webots_mcp.answers.movement import movement
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import RecordingAccess

pytestmark = pytest.mark.anyio


@pytest.fixture
def rover(recorded: Recorded) -> RecordedRobot:
    return recorded.robot()


def drive(rover: RecordedRobot, *places: object) -> None:
    for step, place in enumerate(places):
        rover.state(step * 0.5, {"pose": place}, at=rover.now + step * 0.5)


NOISE = np.random.default_rng(1).normal(0, 0.03, (60, 2)).tolist()


@pytest.mark.parametrize(
    ("places", "distance_m", "said"),
    [
        ([[0, 0], [3, 4], [0, 0]], 10.0, {"displacement_m": 0.0}),
        ([[0, 0], [None, 1], [0, 1]], 1.0, {}),  # a lost position is no movement
        ([[0, 0], [300, 400], [0, 0]], 1000.0, {"unit": "pose.0 is taken as metres"}),
        (
            [[0.015 * step + x, y] for step, (x, y) in enumerate(NOISE)],
            pytest.approx(0.9, abs=0.1),
            {"distance_note": "the path may be up to"},
        ),
    ],
    ids=["there and back", "lost", "in metres that no robot drives", "slow under noise"],
)
async def test_a_movement_has_its_distance_and_what_makes_it_doubtful(
    connect: Connect, rover: RecordedRobot, places: list[Any], distance_m: Any, said: dict[str, Any]
) -> None:
    drive(rover, *places)
    async with connect() as client:
        movement = (await ask(client, "webots_monitor", lookback_wall_s=60))["movement"]
    assert movement["distance_m"] == distance_m
    for name, value in said.items():
        assert value in movement[name] if isinstance(value, str) else value == movement[name]


async def test_rows_before_the_window_do_not_count_even_at_the_same_simulation_time(
    connect: Connect, rover: RecordedRobot
) -> None:
    for second in range(10):
        rover.state(5.0, {"count": second}, at=rover.now + second)
    async with connect() as client:
        answer = await ask(client, "webots_monitor", lookback_wall_s=3)
    (trend,) = answer["trends"]
    (count,) = rows_of(trend["numbers"])
    assert answer["row_count"] == 4
    assert count["last"] == 9 and "from 6 to 9" in count["says"]


async def test_what_began_before_the_window_and_goes_on_is_told_with_its_begin(
    connect: Connect, rover: RecordedRobot
) -> None:
    for step in range(200):
        x = min(step * 0.1, 5.0)
        state = {"pose": [x, 0.0], "commanded_m_s": 1.0}
        rover.state(step * 0.1, state, at=rover.now + step * 0.1)
    async with connect() as client:
        answer = await ask(client, "webots_monitor", lookback_wall_s=4)
    (stuck,) = [row for row in rows_of(answer["events"]) if row["kind"] == "stuck"]
    assert (stuck["start_s"], stuck["duration_s"]) == (pytest.approx(5.0, abs=0.2), 14.9)
    assert stuck["ongoing"]


async def test_over_a_reset_the_movement_is_told_run_by_run(
    connect: Connect, rover: RecordedRobot
) -> None:
    drive(rover, [0, 0], [3, 4])
    rover.end_run("reset")
    rover.begin_run("reset")
    drive(rover, [0, 0], [0, 1])
    async with connect() as client:
        answer = await ask(client, "webots_monitor", lookback_wall_s=60)
    first, second = answer["movement"]["runs"]
    assert (first["to_m"], first["distance_m"], first["displacement_m"]) == ([3, 4], 5.0, 5.0)
    assert (second["to_m"], second["distance_m"], second["displacement_m"]) == ([0, 1], 1.0, 1.0)
    assert second["run_id"] == first["run_id"] + 1


def test_a_movement_says_from_when_on_rows_were_not_read(
    recorded: Recorded, rover: RecordedRobot, tmp_path: Path
) -> None:
    recorded.connection.execute("BEGIN")
    drive(rover, *([0.01 * step, 0] for step in range(3000)))
    recorded.connection.execute("COMMIT")
    with RecordingAccess(recorded.database, tmp_path).view(None, None) as view:
        whole = find_range(view.connection, Scope())
        answer = movement(view, whole, 0)
    assert answer is not None
    assert answer["rows_missing_from_s"] < 1499.5


async def test_a_robot_that_ended_is_not_waited_for_and_nothing_is_absent(
    connect: Connect, recorded: Recorded, rover: RecordedRobot
) -> None:
    for step in range(3):
        rover.state(step * 0.5, {"pose": [step, 0]}, at=rover.now - 5 + step)
    recorded.connection.execute("UPDATE session SET ended_wall_time_s = last_seen_wall_time_s")
    async with connect() as client:
        answer = await ask(client, "webots_monitor", duration_wall_s=60)
    assert (answer["row_count"], answer["window_wall_s"] < 30) == (0, True)
    (kinds,) = (k for k, why in answer["verdicts"]["not_searched"].items() if "no row" in why)
    assert {"gap", "missing", "flat", "jump", "standstill", "stuck"} <= set(kinds.split(", "))


async def test_what_was_logged_after_the_last_row_is_told(
    connect: Connect, rover: RecordedRobot
) -> None:
    rover.state(1.0, {"x": 1})
    rover.log(2.0, "the arm is blocked", level="error")
    async with connect() as client:
        answer = await ask(client, "webots_monitor", lookback_wall_s=5)
    (event,) = [row for row in rows_of(answer["events"]) if row["kind"] == "log"]
    assert event["details"]["message"] == "the arm is blocked"


async def test_each_run_moved_by_its_own_position(connect: Connect, rover: RecordedRobot) -> None:
    drive(rover, [0, 0], [3, 4])
    rover.end_run("reset")
    rover.begin_run("reset")
    for step in range(3):
        rover.state(step * 0.5, {"gps": {"x": step, "y": 0}}, at=rover.now + step * 0.5)
    async with connect() as client:
        answer = await ask(client, "webots_monitor", lookback_wall_s=60)
    first, second = answer["movement"]["runs"]
    assert (first["position"], first["distance_m"]) == (["pose.0", "pose.1"], 5.0)
    assert (second["position"], second["distance_m"]) == (["gps.x", "gps.y"], 2.0)
