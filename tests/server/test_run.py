"""webots_run: one call that runs the simulation, waits, and says what happened."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from tests.recordings.rows import Recorded, insert
from tests.server.conftest import (
    STEP_MS,
    Connect,
    Driver,
    ask,
    ask_until,
    fail,
    pictures_of,
    text_of,
)
from tests.server.story import rows_of
from tests.waiting import until
from webots_mcp.errors import CommandRefusedError
from webots_mcp.steering.dispatch import Dispatcher
from webots_mcp.steering.routes import CLAIMING_S
from webots_mcp.steering.run_command import require_possible
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import BY_COMMAND_LINE, OpenRequest

pytestmark = pytest.mark.anyio


async def paused(client: Client) -> dict[str, Any]:
    return await ask(client, "webots_simulation_control", command="pause")


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_it_says_why_and_where_it_stopped_and_what_happened(
    connect: Connect, driver: Driver, mode: str
) -> None:
    async with connect(mode=mode) as client:
        goal = (await paused(client))["sim_time_s"] * 1000 // STEP_MS + 60
        answer = await ask(client, "webots_run", until=f"steps >= {goal}", pace="real_time")
        assert (answer["outcome"], answer["stopped"]) == ("done", "condition held")
        assert answer["status"] == "paused"
        assert answer["values"] == {"steps": goal}
        assert answer["state"]["steps"] == goal
        assert (
            answer["state_at_s"] == answer["ran"]["end_s"] == pytest.approx(goal * STEP_MS / 1000)
        )
        assert [goal - row[1] for row in answer["rows"]["rows"]] == [5, 4, 3, 2, 1, 0]
        assert {row[0] for row in answer["trends"]["numbers"]["rows"]} >= {"steps"}
        events = answer["events"]
        rows = [dict(zip(events["columns"], row, strict=True)) for row in events["rows"]]
        assert [row["kind"] for row in rows].count("change") >= 2
        assert "run" not in [row["name"] for row in rows], "it needs no telling"
        assert len(json.dumps(answer)) < 8_000
    assert driver.is_alive()


@pytest.mark.slow
async def test_out_of_wall_time_it_goes_on_and_a_second_call_gives_the_same_answer(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        first = await ask(client, "webots_run", for_s=1.2, pace="as_it_is", timeout_wall_s=0.3)
        assert (first["outcome"], first["stopped"]) == ("claimed", "wall time limit reached")
        number = first["command_id"]
        (sent,) = rows_of((await ask(client, "webots_list_commands"))["commands"])
        assert "pace" not in sent["params"], "no mode is set where it goes on as it runs"
        assert f"command_id={number}" in first["hint"]
        assert 0 <= first["ran"]["advanced_s"] < 1.2
        then = await ask(client, "webots_wait_for_command", command_id=number, timeout_wall_s=30)
        assert then["stopped"] == "simulation time reached"
        assert then["ran"]["advanced_s"] == pytest.approx(1.2)
        assert then["state"]
        assert then["trends"]
        assert (await ask(client, "webots_get_robot_state"))["status"] == "paused"


@pytest.mark.slow
async def test_progress_is_in_simulated_seconds(connect: Connect, driver: Driver) -> None:
    reports: list[tuple[float, float | None, str]] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append((progress, total, message or ""))

    async with connect() as client:
        arguments = {"for_s": 4, "until": "steps < 0", "then": "go_on"}
        await client.call_tool("webots_run", arguments, progress_callback=on_progress)
    assert reports
    assert [progress for progress, _, _ in reports] == sorted(p for p, _, _ in reports)
    assert all(0 <= progress <= 4.1 and total == 4 for progress, total, _ in reports)
    assert "of 4 s simulated, until steps < 0" in reports[-1][2]


@pytest.mark.parametrize(("then", "status"), [("pause", "paused"), ("go_on", "running")])
async def test_a_cancelled_call_leaves_the_simulation_as_then_says(
    connect: Connect, driver: Driver, then: str, status: str
) -> None:
    async with connect() as client:
        async with anyio.create_task_group() as tasks:
            arguments = {"until": "steps < 0", "then": then}
            tasks.start_soon(client.call_tool, "webots_run", arguments)
            await _until_run_is(client, "claimed")
            tasks.cancel_scope.cancel()
        ended = await _until_run_is(client, "done")
        assert ended["result"]["ended"] == "interrupted"
        assert ended["result"]["why"] == "it was cancelled"
        assert (await ask(client, "webots_get_robot_state"))["status"] == status
    assert driver.is_alive()


@pytest.mark.slow
async def test_a_step_whose_asker_leaves_long_after_it_was_claimed_ends_too(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        async with anyio.create_task_group() as tasks:

            async def leave_at_last(progress: float, total: float | None, message: str | None):
                reports.append(progress)
                if len(reports) > CLAIMING_S + 1:  # one comes each second
                    tasks.cancel_scope.cancel()

            reports: list[float] = []
            arguments = {"command": "step", "steps": 5000}
            await client.call_tool(
                "webots_simulation_control", arguments, progress_callback=leave_at_last
            )
        ended = await _until_run_is(client, "done", "step")
        assert ended["result"]["why"] == "it was cancelled before the last step"


@pytest.mark.slow
async def test_an_interrupt_that_meets_the_waiting_itself_ends_the_run(
    connect: Connect, driver: Driver, file: Path
) -> None:
    async def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    recording = RecordingAccess(file, file.parent)
    async with connect() as client:
        with pytest.raises(KeyboardInterrupt):
            async with OpenRequest(recording, BY_COMMAND_LINE, ["webots_run"], {}):
                await Dispatcher(recording, interrupt).ask(None, "run", 60, {"for_s": 900.0})
        ended = await _until_run_is(client, "done")
        assert ended["result"]["why"] == "it was cancelled"


async def _until_run_is(client: Client, outcome: str, action: str = "run") -> dict[str, Any]:
    """The newest command of that action, once it is that far."""

    async def look() -> dict[str, Any] | None:
        rows = rows_of((await ask(client, "webots_list_commands")).get("commands"))
        wanted = (action, outcome)
        return next((row for row in rows if (row["action"], row["outcome"]) == wanted), None)

    return await until(look)


async def test_a_picture_comes_beside_the_data(
    connect: Connect, driver: Driver, file: Path
) -> None:
    async with connect() as client:
        result = await client.call_tool("webots_run", {"for_s": 0.1, "picture": True})
        assert not result.is_error, text_of(result)
        assert len(pictures_of(result)) == 1
        assert result.structured_content is not None
        picture = result.structured_content["picture"]
        assert Path(picture["file"]).is_file()
        assert "webots_take_screenshot" in picture["see"]


@pytest.mark.slow
async def test_where_no_screenshot_comes_the_frame_of_that_step_does_and_the_answer_says_which(
    connect: Connect, driver: Driver, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise RuntimeError("nothing is rendered")

    monkeypatch.setattr(driver.robot, "exportImage", refuse)
    async with connect() as client:
        steps = (await paused(client))["sim_time_s"] * 1000 // STEP_MS
        without = await ask(client, "webots_run", until=f"steps >= {steps + 20}", picture=True)
        assert "nothing is rendered" in without["picture"]["missing"]
        camera = driver.robot.getDevice("camera")
        camera.enable(STEP_MS)
        driver.bridge.keep_camera(camera)
        condition = f"steps >= {steps + 60}"
        await ask(client, "webots_breakpoint", condition=condition, action="keep")
        asked = {"until": condition, "picture": True}
        result = await client.call_tool("webots_run", asked)
        assert not result.is_error, text_of(result)
        assert result.structured_content is not None
        answer = result.structured_content
        assert len(pictures_of(result)) == 1, answer["picture"]
        picture = answer["picture"]
        assert picture["camera"] == "camera"
        assert picture["sim_time_s"] == answer["ran"]["end_s"]
        assert "nothing is rendered" in picture["no_screenshot"]
        assert "webots_get_camera" in picture["see"]
        assert Path(picture["file"]).is_file()


@pytest.mark.slow
async def test_what_cannot_end_is_refused_before_anything_is_sent(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.5)
        misspelt = await fail(client, "webots_run", until="step > 70")
        assert "steps" in misspelt
        assert "never published" in misspelt
        holds = await fail(client, "webots_run", until="steps >= 3")
        assert "already holds" in holds
        assert "since 0.048 s" in holds
        assert "reset=true" in holds
        assert "until" in await fail(client, "webots_run")
        assert "column" in await fail(client, "webots_run", until="steps >")
        assert "pace must" in await fail(client, "webots_run", for_s=1, pace="slow")
        assert "steps < 'a'" in await fail(client, "webots_run", until="steps < 'a'")
        undeclared = await fail(client, "webots_run", for_s=1, parameters={"gain": 1})
        assert "declares no parameters" in undeclared
        assert (await ask(client, "webots_get_robot_state"))["status"] == "running"
        sent = rows_of((await ask(client, "webots_list_commands"))["commands"])
        assert [row["action"] for row in sent] == ["run"], "only the parameter met the bridge"
        again = await ask(client, "webots_run", until="steps >= 3", reset=True, then="go_on")
        assert again["ran"]["end_s"] <= 0.064


def test_a_change_in_the_newest_row_is_not_the_one_that_is_waited_for(recorded: Recorded) -> None:
    robot = recorded.robot()
    for n, mode in enumerate(("cruise", "turn")):
        robot.state(1.0 + n, {"mode": mode})
    assert isinstance(recorded.database, Path)
    recording = RecordingAccess(recorded.database, recorded.database.parent)
    require_possible(recording, None, "changed(mode)", None, reset=False)
    with pytest.raises(CommandRefusedError, match=r"since 2\.000 s"):
        require_possible(recording, None, "mode == 'turn'", None, reset=False)


@pytest.mark.parametrize(
    ("action", "is_known"),
    [("start", False), ("set_parameters", False), ("pause", True), ("take_frame", True)],
)
def test_what_held_before_a_command_that_may_have_ended_it_is_waited_for(
    recorded: Recorded, action: str, is_known: bool
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"mode": "idle"})
    times = ("created", "expires", "claimed", "finished")
    command = {"robot_id": robot.id, "action": action, "status": "done", "params": "{}"}
    command |= {f"{name}_wall_time_s": robot.now + 5 for name in times}
    insert(recorded.connection, "command", command | {"session_id": robot.session_id})
    assert isinstance(recorded.database, Path)
    recording = RecordingAccess(recorded.database, recorded.database.parent)

    def refused() -> bool:
        try:
            require_possible(recording, None, "mode == 'idle'", None, reset=False)
        except CommandRefusedError:
            return True
        return False

    assert refused() == is_known
    recorded.connection.execute("UPDATE state SET wall_time_s = ?", (robot.now + 6,))
    assert refused(), "this row shows what the command did"
    require_possible(recording, None, "mode == 'idle'", None, reset=False, parameters=True)


async def test_a_run_right_after_a_command_ends_when_its_condition_holds_again(
    connect: Connect, driver: Driver
) -> None:
    async with connect() as client:
        await paused(client)
        await ask(client, "webots_send_command", action="set_speed", params={"speed": 2.0})
        answer = await ask(client, "webots_run", until="steps >= 3", then="go_on")
    assert answer["stopped"] == "condition held"
    assert answer["ran"]["advanced_s"] <= 2 * STEP_MS / 1000


async def test_a_run_that_ended_before_its_row_was_written_is_told_of_all_the_same(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    result = {
        "ended": "simulation time reached",
        "from_s": 0.0,
        "sim_time_s": 1.0,
        "advanced_s": 1.0,
    }
    times = ("created", "expires", "claimed", "finished")
    number = insert(
        recorded.connection,
        "command",
        {
            "robot_id": robot.id, "action": "run", "params": '{"for_s": 1.0}', "status": "done",
            "session_id": robot.session_id, "result": json.dumps(result),
            **{f"{name}_wall_time_s": robot.now for name in times},
        },
    )  # fmt: skip
    async with connect() as client:
        answer = await ask(client, "webots_wait_for_command", command_id=number)
    assert answer["ran"]["run_id"] == robot.run_id
    assert answer["state"] == {"x": 1}


@pytest.mark.slow
async def test_two_at_once_are_refused(connect: Connect, driver: Driver) -> None:
    async with connect() as client:
        first = await ask(client, "webots_run", until="steps < 0", then="go_on", timeout_wall_s=0.3)
        said = await fail(client, "webots_run", for_s=1)
        assert f"command {first['command_id']} (run) is still running" in said
        await paused(client)
        ended = await ask(client, "webots_wait_for_command", command_id=first["command_id"])
        assert ended["stopped"] == "interrupted"
        assert "(pause)" in ended["stop_reason"]
