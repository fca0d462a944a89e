"""The tools that read the present: states, sensors, the world and the log."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Any

import pytest

from tests.recordings.rows import Recorded
from tests.server.conftest import DATA_TOOLS, Connect, ask, fail
from webots_mcp.answers.shortening import tokens_of
from webots_mcp.questions.robot_state import unnamed_devices
from webots_mcp.store.chunk_making import chunk_whole_run

pytestmark = pytest.mark.anyio
TOKENS = 2_000


async def test_the_state_is_rounded_and_long_arrays_are_summarised(
    connect: Connect, recorded: Recorded
) -> None:
    lidar = [5.0 + i for i in range(180)]
    lidar[7] = 0.123456
    recorded.robot().state(1.0, {"pose": [1.23456, -2.0], "lidar": lidar})
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state")
    assert answer["state"]["pose"] == [1.235, -2.0]
    assert answer["state"]["lidar"]["argmin"] == 7
    assert "arrays over 16 items" in answer["shortened"]
    assert "webots_get_full_state" in answer["hint"]


def test_a_device_is_named_in_the_state_however_its_words_are_arranged() -> None:
    names = ("ds0", "ds7", "front left sonar", "leftEncoder", "range_finder", "gps")
    devices: dict[str, str] = dict.fromkeys(names, "DistanceSensor")
    state = {"ds": [1, 2], "sonar": {"front_left": 1.0}, "encoder": {"left": 3}, "seen": {"gps": 1}}
    assert list(unnamed_devices(state, devices)) == ["ds7", "range_finder"]


async def test_a_state_without_sensors_says_where_to_look(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1.0})
    async with connect() as client:
        answer = await ask(client, "webots_get_sensors")
    assert answer["sensors"] == {}
    assert "webots_get_robot_state" in answer["hint"]


@pytest.mark.parametrize(
    "state",
    [
        {"lidar": [0.1 * i for i in range(180)], "pose": [1.0, 2.0, 3.0]},
        {"text": "x" * 1_000_000},
        {f"key {i}": {"value": i * 1.234567, "text": "y" * 50} for i in range(10_000)},
        {"grid": [[float(i * j) for i in range(200)] for j in range(200)]},
        {f"joint_{i}_torque_nm": i / 7 for i in range(400)},
        {
            f"leg {i}": {f"joint {j}": {"q_rad": j / 7, "tau": i} for j in range(10)}
            for i in range(20)
        },
    ],
    ids=["lidar", "long text", "1 MB of keys", "grid", "400 signals", "nested"],
)
async def test_answers_stay_short_whatever_is_published(
    connect: Connect, recorded: Recorded, state: dict[str, Any]
) -> None:
    robot = recorded.robot()
    robot.state(1.0, state)
    robot.beat(actions=json.dumps({f"action {i}": "z" * 5000 for i in range(100)}))
    for i in range(100):
        robot.log(1.0, f"{i} " + "w" * 10_000, "warning")
        robot.event(1.0, "change", "text", {"from": "v" * 5000, "to": "u" * 5000})
    async with connect() as client:
        for tool in DATA_TOOLS:
            assert tokens_of(await ask(client, tool)) < TOKENS, tool


async def test_a_part_of_the_state_comes_whole_in_pages(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"sensors": {"lidar": [i + 0.123456 for i in range(180)]}})
    async with connect() as client:
        path = "sensors.lidar"
        page = await ask(client, "webots_get_full_state", path=path, limit=100)
        assert page["state"][:2] == [0.123456, 1.123456]
        assert (page["total"], page["next_offset"]) == (180, 100)
        rest = await ask(client, "webots_get_full_state", path=path, offset=100)
        assert len(rest["state"]) == 80
        assert "next_offset" not in rest
        assert "Use one of ['lidar']" in await fail(
            client, "webots_get_full_state", path="sensors.lidr"
        )


async def test_a_value_that_is_null_is_told_from_a_path_that_leads_nowhere(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"gps": {"x": None}})
    async with connect() as client:
        answer = await ask(client, "webots_get_full_state", path="gps.x")
        assert answer["hint"] == "the value at this path is null"
        assert "no member 'y'" in await fail(client, "webots_get_full_state", path="gps.y")


async def test_a_large_state_comes_in_pages_that_say_what_is_not_on_them(
    connect: Connect, recorded: Recorded
) -> None:
    state = {f"joint_{i}_torque_nm": i / 7 for i in range(400)}
    recorded.robot().state(1.0, state)
    async with connect() as client:
        page = await ask(client, "webots_get_full_state")
        shown = len(page["state"])
        assert 60 < shown < 400
        assert (page["total"], page["next_offset"]) == (400, shown)
        assert f"joint_{shown}_torque_nm" in page["hint"]
        pages = dict(page["state"])
        while "next_offset" in page:
            page = await ask(client, "webots_get_full_state", offset=page["next_offset"])
            assert tokens_of(page) < TOKENS
            pages |= page["state"]
        asked = await ask(client, "webots_get_full_state", limit=400)
    assert list(pages.items()) == list(state.items())
    assert asked["state"] == state
    assert TOKENS < tokens_of(asked) < 10_000


async def test_the_full_state_has_events_and_the_recorders_health(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot(rows_waiting=3, rows_dropped=2, last_error="disk full")
    robot.state(1.0, {"x": 0.123456789})
    robot.event(0.5, "change", "mode", {"from": "a", "to": "b"})
    async with connect() as client:
        answer = await ask(client, "webots_get_full_state")
    assert answer["state"] == {"x": 0.123456789}
    assert answer["events"]["rows"] == [[0.5, "change", "mode", {"from": "a", "to": "b"}]]
    health = answer["recorder"]
    assert (health["rows_waiting"], health["rows_dropped"]) == (3, 2)
    assert health["last_error"] == "disk full"
    assert health["controller_sha256"] == "a" * 64


async def test_the_world_is_described_with_its_companions(
    connect: Connect, recorded: Recorded
) -> None:
    rover = recorded.robot("rover")
    recorded.robot("referee")
    for i in range(5):
        rover.state(i * 1.0, {}, at=rover.now + i * 0.5)
    async with connect() as client:
        answer = await ask(client, "webots_get_world_info", robot="rover")
    assert answer["world"].endswith("arena.wbt")
    assert answer["basic_time_step_ms"] == 16.0
    assert answer["real_time_factor"] == 2.0
    assert answer["run"]["row_count"] == 5
    assert answer["other_robots"]["rows"] == [["referee", "Supervisor", ""]]
    assert answer["controller"]["file"].endswith("rover.py")


async def test_a_signal_that_could_not_be_read_is_not_said_to_have_no_value(
    recorded: Recorded, connect: Connect
) -> None:
    rover = recorded.robot()
    for step in range(30):
        rover.state(step * 0.1, {"n": step, "m": step})
    assert chunk_whole_run(recorded.connection, 1)
    recorded.connection.execute("DELETE FROM state")
    of_n = "signal_id = (SELECT id FROM signal WHERE name = 'n')"
    recorded.connection.execute(f"UPDATE chunk SET numbers = x'00' WHERE {of_n}")
    async with connect() as client:
        answer = await ask(client, "webots_query_history", signals=["n", "m"])
    (run,) = answer["runs"]
    assert run["numbers"]["n"] == {}
    assert "the chunk of n is damaged" in answer["notes"][0]


async def test_of_many_replaced_values_the_number_of_those_not_shown_is_said(
    connect: Connect, recorded: Recorded
) -> None:
    names = [f"at_{number}" for number in range(50)]
    replaced = {f"front.{name}": "nan" for name in names}
    recorded.robot().state(1.0, {"front": dict.fromkeys(names)}, replaced=replaced)
    async with connect() as client:
        for tool in ("webots_get_full_state", "webots_get_sensors"):
            replaced = (await ask(client, tool))["replaced"]
            assert len(replaced) == 21
            assert replaced["…"].startswith("30 more: ")


async def test_events_and_log_lines_have_their_time_of_day_where_it_is_asked_for(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.event(1.0, "change", "mode", {"from": "cruise", "to": "turn"})
    robot.log(2.0, "front blocked", "warning")
    robot.state(3.0, {"mode": "turn"})
    asked = {"webots_get_logs": "lines", "webots_find_events": "events"}
    async with connect() as client:
        for tool, table in asked.items():
            assert "wall_time" not in (await ask(client, tool))[table]["columns"]
            found = (await ask(client, tool, time_of_day=True))[table]
            told: dict[str, Any] = dict(found.get("in_every_row") or {})
            told |= dict(zip(found["columns"], found["rows"][0], strict=True))
            moment = datetime.fromisoformat(told["wall_time"])
            assert moment.tzinfo is not None
            assert moment.timestamp() == pytest.approx(robot.now, abs=0.001)
