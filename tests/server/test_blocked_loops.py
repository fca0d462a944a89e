"""Nobody waits for a loop that is known to be blocked: what it cannot claim is withdrawn."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio import to_thread
from mcp import Client

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import data_dir, filed, has_states, start  # fixtures
from tests.server.conftest import ask, text_of
from tests.waiting import until
from webots_mcp.contract import HANG_VARIABLE
from webots_mcp.database.connection import connect
from webots_mcp.database.queue import CommandQueue, fetch_command
from webots_mcp.server.mcp_server import create_server
from webots_mcp.standin import Mode, Simulation
from webots_mcp.steering.dispatch import withdraw_if_blocked
from webots_mcp.store.recording import RecordingAccess as Store
from webots_mcp.store.robot_status import WAITING_IN_STEP, BlockedLoop, find_block

__all__ = ["data_dir", "filed", "start"]
pytestmark = pytest.mark.anyio

LOOP = """
kp = bridge.parameter("kp", 2.0, low=0.0, high=10.0)
ran = []
def note(command):
    ran.append(command["id"])
bridge.register_command("note", note)
while robot.step(16) != -1:
    bridge.publish({"kp": kp.value, "ran": len(ran)})
    bridge.get_command()
"""
TRIALS = "webots_run_trials"
LONG: dict[str, Any] = {"timeout_wall_s": 90}
# Each would wait longer than this test may take, if it waited for its time to be up.
ASKED: list[tuple[str, dict[str, Any]]] = [
    ("webots_simulation_control", {"command": "step", **LONG}),
    ("webots_simulation_control", {"command": "resume", **LONG}),
    ("webots_world_reset", LONG),
    ("webots_world_reload", LONG),
    ("webots_run", {"for_s": 1.0, **LONG}),
    ("webots_send_command", {"action": "note", **LONG}),
    ("webots_set_parameters", {"values": {"kp": 3.0}, **LONG}),
    ("webots_reset_controller_state", LONG),
    ("webots_take_screenshot", LONG),
    ("webots_get_scene", {}),
    ("webots_breakpoint", {"condition": "kp > 9"}),
    (TRIALS, {"parameters": {"kp": [1.0]}, "score": "last(kp)", "for_s": 0.2, **LONG}),
]


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(HANG_VARIABLE, "0.5")


async def paused_by_hand(simulation: Simulation, client: Client) -> None:
    """Press pause, and wait until it is known that the loop waits in a step."""
    simulation.pause()

    async def why() -> str:
        return str((await ask(client, "webots_get_robot_state")).get("why"))

    await until(why, lambda text: text == WAITING_IN_STEP)


@pytest.mark.slow
async def test_while_a_person_has_paused_webots_every_command_is_withdrawn_and_none_runs_later(
    soon: None, start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    server = create_server(data_dir / "webots.db", data_dir)
    async with Client(server, read_timeout_seconds=60) as client:
        await paused_by_hand(simulation, client)
        said = await ask_all(client)
        said[TRIALS] = text_of(await client.call_tool(TRIALS, dict(ASKED)[TRIALS]))
        assert len(said) == len(ASKED)
        for asked, text in said.items():
            assert "paused by hand in Webots" in text, (asked, text)
        assert set(filed.rows("SELECT status FROM command")) == {"cancelled"}
        errors = filed.rows("SELECT error FROM command")
        assert {error.startswith(WAITING_IN_STEP) for error in errors} == {True}
        assert {error.endswith("was withdrawn and will not run") for error in errors} == {True}

        (rows,) = filed.rows("SELECT count(*) FROM state")
        simulation.resume()
        simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM state")[0] > rows + 20)
        done = await ask(client, "webots_send_command", action="note")
    assert done["outcome"] == "done"
    statuses = filed.rows(
        "SELECT DISTINCT status FROM command WHERE id <> (SELECT max(id) FROM command)"
    )
    assert statuses == ["cancelled"]
    assert filed.rows("SELECT DISTINCT json_extract(data, '$.kp') FROM state") == [2.0]
    assert filed.rows("SELECT count(*) FROM run") == [1]


async def ask_all(client: Client) -> dict[str, str]:
    """Ask at the same time for everything but trials, which refuse others; return the answers."""
    said: dict[str, str] = {}

    async def send(tool: str, given: dict[str, Any]) -> None:
        said[f"{tool} {given}"] = text_of(await client.call_tool(tool, given))

    async with anyio.create_task_group() as tasks:
        for tool, given in ASKED:
            if tool != TRIALS:
                tasks.start_soon(send, tool, given)
    return said


async def paused_in_webots(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> tuple[Simulation, Store]:
    """A robot that records, in a simulation that a person has paused."""
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    database = data_dir / "webots.db"
    async with Client(create_server(database, data_dir)) as client:
        await paused_by_hand(simulation, client)
    return simulation, Store(database, data_dir)


@pytest.mark.slow
async def test_what_a_controller_has_claimed_meanwhile_is_not_withdrawn(
    soon: None, start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation, store = await paused_in_webots(start, filed, data_dir)

    def is_known() -> bool:
        with store.view() as view:
            block = find_block(view.connection, view.session, view.run, view.now_s)
            return block is not None

    simulation.wait_for(is_known)
    with closing(connect(data_dir / "webots.db", "writer")) as connection:
        first, second = (CommandQueue(connection).enqueue(1, "note") for _ in range(2))
        connection.execute("UPDATE command SET status = 'claimed', session_id = 1 WHERE id = 1")
        assert not withdraw_if_blocked(store, first)
        assert withdraw_if_blocked(store, second)
        found = [fetch_command(connection, each.id).status for each in (first, second)]
    assert found == ["claimed", "cancelled"]


@pytest.mark.slow
async def test_a_step_that_takes_no_longer_than_others_is_not_taken_for_a_pause(
    soon: None, start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation, store = await paused_in_webots(start, filed, data_dir)

    def block() -> BlockedLoop | None:
        with store.view() as view:
            return find_block(view.connection, view.session, view.run, view.now_s)

    simulation.wait_for(lambda: block() is not None)
    with closing(connect(data_dir / "webots.db", "writer")) as connection:
        connection.execute("UPDATE run SET steps = 10, step_wait_wall_s = 36000.0")
        assert block() is None
        connection.execute("UPDATE run SET steps = 10, step_wait_wall_s = 0.2")
        assert block() is not None


@pytest.mark.slow
async def test_a_loop_that_asks_seldom_gets_its_command(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    seldom = LOOP.replace("    bridge.get_command()", "    if rounds(): bridge.get_command()")
    simulation = start(
        "import time\nlast = [time.monotonic()]\n"
        "def rounds():\n"
        "    is_due = time.monotonic() - last[0] > 4\n"
        "    if is_due: last[0] = time.monotonic()\n"
        f"    return is_due\n{seldom}",
        mode="realtime",
    )
    simulation.wait_for(lambda: has_states(filed))
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        for _ in range(2):
            done = await ask(client, "webots_send_command", action="note", **LONG)
            assert done["outcome"] == "done"


@pytest.mark.slow
async def test_a_controller_that_a_signal_stopped_is_said_to_be_stopped(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    pid = simulation.controller("rover").pid
    assert pid is not None
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        os.kill(pid, signal.SIGSTOP)
        try:
            asked = {"action": "note", **LONG}
            said = text_of(await client.call_tool("webots_send_command", asked))
        finally:
            os.kill(pid, signal.SIGCONT)
        answer = json.loads(said)
        assert f"its controller (process {pid}) is stopped" in answer["error"]
        assert f"kill -CONT {pid}" in answer["hint"]


@pytest.mark.slow
async def test_a_controller_that_dies_while_a_command_waits_is_said_to_be_gone(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    dies = LOOP.replace(
        "    bridge.get_command()", "    if robot.getTime() > 1: raise SystemExit(3)"
    )
    simulation = start(dies, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        said = text_of(await client.call_tool("webots_send_command", {"action": "note", **LONG}))
    assert "start its controller" in said or "no live controller" in said


async def test_the_answer_of_fast_names_the_mode_in_which_a_later_step_has_left_the_simulation(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        fast = await ask(client, "webots_simulation_control", command="fast")
        step = await ask(client, "webots_simulation_control", command="step", steps=2)
        assert (fast["result"]["mode"], step["result"]["mode"]) == ("fast", "pause")
        again = await ask(client, "webots_wait_for_command", command_id=fast["command_id"])
        assert again["result"]["mode"] == "pause"
        assert f"command {step['command_id']} (step) came after it" in again["hint"]
        assert simulation.mode is Mode.PAUSE


@pytest.mark.slow
async def test_a_run_that_is_under_way_is_answered_when_a_person_pauses_it(
    soon: None, start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    simulation = start(LOOP, mode="realtime")
    simulation.wait_for(lambda: has_states(filed))

    def pause_when_claimed() -> None:
        claimed = "SELECT count(*) FROM command WHERE status = 'claimed'"
        simulation.wait_for(lambda: filed.rows(claimed) == [1])
        newest = "SELECT max(sim_time_s) FROM state"
        (begun_s,) = filed.rows(newest)
        simulation.wait_for(lambda: filed.rows(newest)[0] > begun_s + 0.2)  # in the run's own mode
        simulation.pause()

    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        answers: list[dict[str, Any]] = []

        async def run() -> None:
            asked = {"for_s": 500.0, "pace": "real_time", **LONG}
            answers.append(json.loads(text_of(await client.call_tool("webots_run", asked))))

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run)
            await to_thread.run_sync(pause_when_claimed)
    (answer,) = answers
    assert answer["outcome"] == "claimed"
    assert answer["hint"].startswith(WAITING_IN_STEP)
    assert simulation.mode is Mode.PAUSE


@pytest.mark.slow
def test_a_loop_that_computes_is_no_hang_until_it_is_silent_for_twice_the_limit(
    start: Callable[..., Simulation], filed: Recording, data_dir: Path
) -> None:
    computes = "import time\n" + LOOP + "    if robot.getTime() > 1:\n        time.sleep(600)\n"
    simulation = start(computes, mode="fast")
    store = Store(data_dir / "webots.db", data_dir)

    def silent_and_block() -> tuple[float, object] | None:
        if not has_states(filed):
            return None
        with store.view() as view:
            assert view.session is not None
            block = find_block(view.connection, view.session, view.run, view.now_s)
            return view.session.silent_s(view.now_s), block

    seen: list[tuple[float, object]] = []

    def is_known() -> bool:
        found = silent_and_block()
        seen.extend([found] if found else [])
        return bool(found and found[1])

    simulation.wait_for(is_known)
    silent_s, block = seen[-1]
    assert silent_s >= 6.0
    assert "rover.py:" in str(block)


# Where the loop is blocked once the file `hang` is there, and how it is let go.
BLOCKED = {
    "stopped by a signal": "pass",
    "asleep": "while os.path.exists('hang'): time.sleep(0.05)",
    "reading": "open('answer').readline()",
    "computing": "while os.path.exists('hang'): pass",
}


@pytest.mark.slow
@pytest.mark.parametrize("how", BLOCKED)
async def test_whatever_blocks_the_loop_each_command_is_withdrawn_and_none_runs_later(
    soon: None,
    start: Callable[..., Simulation],
    filed: Recording,
    data_dir: Path,
    tmp_path: Path,
    how: str,
) -> None:
    hang, answer = tmp_path / "hang", tmp_path / "answer"
    os.mkfifo(answer)
    blocks = LOOP + f"    if os.path.exists('hang'):\n        {BLOCKED[how]}\n"
    simulation = start(f"import os, time\nos.chdir({str(tmp_path)!r})\n{blocks}", mode="realtime")
    simulation.wait_for(lambda: has_states(filed))
    pid = simulation.controller("rover").pid
    assert pid is not None
    hang.touch()
    if how == "stopped by a signal":
        os.kill(pid, signal.SIGSTOP)
    reasons = {"stopped by a signal": f"(process {pid}) is stopped"}
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        said = await ask_all(client)
    for asked, text in said.items():
        assert reasons.get(how, "in rover.py:") in text, (asked, text)
    sent = "SELECT max(sent) FROM (SELECT count(*) AS sent FROM command GROUP BY action)"
    assert filed.rows(sent) == [1]
    assert set(filed.rows("SELECT status FROM command")) == {"cancelled"}

    (rows,) = filed.rows("SELECT count(*) FROM state")
    hang.unlink()
    if how == "reading":
        answer.write_text("yes\n")
    if how == "stopped by a signal":
        os.kill(pid, signal.SIGCONT)
    simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM state")[0] > rows + 20)
    assert set(filed.rows("SELECT status FROM command")) == {"cancelled"}
    values = "SELECT DISTINCT json_extract(data, '$.kp'), json_extract(data, '$.ran') FROM state"
    assert filed.rows(values) == [(2.0, 0)]
    assert filed.rows("SELECT count(*) FROM run") == [1]
    assert simulation.mode is Mode.REAL_TIME
