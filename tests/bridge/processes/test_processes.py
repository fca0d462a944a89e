"""What only real processes show: kills, reloads, races."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import Recording
from tests.bridge.processes.conftest import Start, has_states, last_number
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.session_cleanup import reap
from webots_mcp.database.waiting_file import adopt

COUNTING = """
n = 0
while robot.step(16) != -1:
    bridge.publish({"n": n})
    print(0, n, flush=True)  # only after publish() has returned
    bridge.get_command()
    n += 1
"""

Script = Callable[..., "subprocess.Popen[str]"]


@pytest.mark.parametrize("rounds", [3, 150, 400])
def test_a_controller_that_is_killed_loses_no_published_row(
    start: Start, filed: Recording, rounds: int
) -> None:
    simulation = start(COUNTING)
    simulation.wait_for(lambda: last_number(simulation) >= rounds, timeout_s=30)
    simulation.controller("rover").kill()
    simulation.wait_for(lambda: simulation.controller("rover").exit_code is not None)
    assert isinstance(filed.database, Path)
    with closing(connect(filed.database, "writer")) as connection:
        adopt(connection, filed.database)
    recorded = [state["n"] for state in filed.states()]
    assert recorded == list(range(len(recorded)))
    assert len(recorded) > last_number(simulation)
    assert filed.rows("PRAGMA integrity_check") == ["ok"]


def test_an_exception_that_ends_a_controller_is_how_its_run_ended(
    start: Start, filed: Recording
) -> None:
    simulation = start(
        """
robot.step(16)
bridge.publish({"n": 1})
{}["speed"]
"""
    )
    simulation.wait_for(lambda: simulation.controller("rover").exit_code is not None, timeout_s=30)
    assert filed.rows("SELECT end_reason FROM session") == ["crashed"]
    assert filed.rows("SELECT end_reason FROM run") == ["crashed"]
    (line,) = filed.rows("SELECT message FROM log WHERE level = 'error'")
    assert line.startswith("the controller ended by KeyError: 'speed' (rover.py, line ")


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        ('{}["speed"]', "KeyError: 'speed'"),
        ("raise KeyboardInterrupt", "KeyboardInterrupt"),
    ],
)
def test_each_step_before_an_exception_that_ends_a_controller_is_recorded(
    start: Start, filed: Recording, end: str, reason: str
) -> None:
    simulation = start(
        f"""
bridge = MCPBridge(robot, throttle_interval=1_000_000)
for n in range(1007):
    robot.step(16)
    bridge.publish({{"n": n}})
{end}
"""
    )
    simulation.wait_for(lambda: simulation.controller("rover").exit_code is not None, timeout_s=30)
    ((start_s, end_s, why),) = filed.rows(
        "SELECT start_sim_time_s, end_sim_time_s, reason FROM kept_stretch"
    )
    assert end_s - start_s == pytest.approx(5, abs=0.02)
    assert why.startswith(f"the controller ended by {reason}")
    assert why.count(reason) == 1  # it is logged as well
    steps = filed.rows(
        "SELECT json_extract(data, '$.n') FROM all_state "
        "WHERE sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s",
        start_s,
        end_s,
    )
    assert steps == list(range(1007 - len(steps), 1007))
    assert len(steps) == 313


def test_a_killed_controllers_session_is_judged_and_its_command_is_lost(
    start: Start, filed: Recording
) -> None:
    simulation = start(
        """
def hang(command):
    print("hanging", flush=True)
    while True:
        pass

bridge.register_command("hang", hang)
while robot.step(16) != -1:
    bridge.publish({"n": 1})
    bridge.get_command()
"""
    )
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    sent = filed.send("hang")
    simulation.wait_for(lambda: any("hanging" in line for line in simulation.console))
    assert filed.fate(sent)[0] == "claimed"
    simulation.controller("rover").kill()
    simulation.wait_for(lambda: simulation.controller("rover").exit_code is not None)
    connection = connect(filed.database, "writer")
    reap(connection, 2e9)
    connection.close()
    status, _, error = filed.fate(sent)
    assert (status, error) == (
        "lost",
        "its controller ended before it finished; it may have run in part",
    )
    assert filed.rows("SELECT end_reason FROM session") == ["crashed"]
    sql = "SELECT end_reason, row_count = (SELECT count(*) FROM state) FROM run"
    assert filed.rows(sql) == [("crashed", 1)]


def test_a_commanded_reload_is_confirmed_by_the_new_session_and_fires_once(
    start: Start, filed: Recording
) -> None:
    simulation = start(
        """
bridge.on_reload(lambda: print("reloaded", flush=True))
while robot.step(16) != -1:
    bridge.publish({"n": 1})
    bridge.get_command()
"""
    )
    simulation.wait_for(lambda: has_states(filed), timeout_s=30)
    sent = filed.send("reload")
    simulation.wait_for(lambda: filed.fate(sent)[0] == "done", timeout_s=30)
    simulation.wait_for(lambda: len(filed.rows("SELECT DISTINCT run_id FROM state")) == 2)
    why = "a reload keeps the mode"
    assert filed.fate(sent)[1] == {"run_id": 2, "mode": "fast", "why": why}
    assert filed.rows("SELECT end_reason FROM session ORDER BY id") == ["reload", None]
    assert filed.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reload"]
    assert sum("reloaded" in line for line in simulation.console) == 1


def test_a_person_reloading_in_webots_is_noticed_as_well(start: Start, filed: Recording) -> None:
    simulation = start(COUNTING)
    simulation.wait_for(lambda: last_number(simulation) >= 3, timeout_s=30)
    simulation.reload()
    simulation.wait_for(
        lambda: filed.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reload"]
    )


@pytest.mark.slow
def test_pause_step_resume_and_reset_work_on_a_real_controller(
    start: Start, filed: Recording
) -> None:
    simulation = start(COUNTING, mode="realtime")
    simulation.wait_for(lambda: last_number(simulation) >= 3, timeout_s=30)

    def run(action: str, **params: Any) -> dict[str, object]:
        sent = filed.send(action, **params)
        simulation.wait_for(lambda: filed.fate(sent)[0] in ("done", "failed"), timeout_s=15)
        status, result, error = filed.fate(sent)
        assert (status, error) == ("done", None)
        return result

    run("pause")
    paused_at_s = simulation.time_s
    stepped = run("step", steps=5)
    assert simulation.time_s == pytest.approx(paused_at_s + 5 * 0.016)
    assert stepped["advanced_s"] == pytest.approx(5 * 0.016)
    run("resume")
    simulation.wait_for(lambda: simulation.time_s > paused_at_s + 0.5)
    assert run("reset")["run_id"] == 2
    simulation.wait_for(lambda: filed.rows("SELECT count(*) FROM run") == [2])
    assert simulation.controller("rover").starts == 1


STARTER = """
import sys
from webots_mcp import MCPBridge

class Robot:
    devices = {}
    def step(self, time_step): return 0
    def getTime(self): return 0.0
    def getName(self): return "twin"
    def getBasicTimeStep(self): return 16.0
    def getWorldPath(self): return ""
    def getSupervisor(self): return False

robot = Robot()
sys.stdout.write("ready\\n"); sys.stdout.flush(); sys.stdin.readline()
bridge = MCPBridge(robot, data_dir=sys.argv[1], throttle_interval=1)
bridge.publish({"x": 1})
print(bridge.robot_name, bridge.stats().rows_waiting, flush=True)
sys.stdin.readline()
"""


@pytest.mark.slow
def test_controllers_that_start_at_once_on_a_missing_database_all_come_up(
    script: Script, filed: Recording, data_dir: object
) -> None:
    processes = [script(STARTER, data_dir) for _ in range(5)]
    for process in processes:
        assert process.stdout is not None and process.stdin is not None
        if process.stdout.readline() != "ready\n":
            pytest.fail(process.communicate()[1])
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    answers = [process.stdout.readline().split() for process in processes if process.stdout]
    finished = [process.communicate("end\n", timeout=30) for process in processes]
    assert [stderr for _, stderr in finished] == [""] * 5
    assert {name for name, _ in answers} == {"twin", "twin#2", "twin#3", "twin#4", "twin#5"}
    assert filed.rows("SELECT count(DISTINCT run_id) FROM state") == [5]


CLAIMER = """
import sqlite3, sys, time
from webots_mcp.database.queue import CLAIM, PEEK
from webots_mcp.database.connection import connect
from webots_mcp.database.transactions import never_wait
from pathlib import Path

connection = connect(Path(sys.argv[1]), "loop")
never_wait(connection)
sys.stdout.write("ready\\n"); sys.stdout.flush(); sys.stdin.readline()
claimed = []
while connection.execute(PEEK, (1, time.time())).fetchone():
    values = {"session": None, "now": time.time(), "sim_time": 0.0, "robot": 1}
    try:
        claimed += connection.execute(CLAIM, values).fetchall()
    except sqlite3.OperationalError as error:
        assert "locked" in str(error), error
print(*[row[0] for row in claimed])
"""


def test_of_many_claimers_exactly_one_gets_each_command(script: Script, filed: Recording) -> None:
    commands = 1000
    connection = connect(filed.database, "writer", create=True)
    create_schema(connection)
    connection.execute("INSERT INTO robot VALUES (1, 'rover', 'Robot', '{}', 0, 0)")
    connection.execute("BEGIN")
    connection.executemany(
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s) VALUES (1, 'move', '{}', 'pending', ?, 9e9)",
        [(n,) for n in range(commands)],
    )
    connection.execute("COMMIT")
    connection.close()
    processes = [script(CLAIMER, filed.database) for _ in range(6)]
    for process in processes:
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            pytest.fail(process.communicate()[1])
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    outputs = [process.communicate(timeout=60) for process in processes]
    assert [stderr for _, stderr in outputs] == [""] * 6
    claimed = [int(word) for stdout, _ in outputs for word in stdout.split()]
    assert sorted(claimed) == list(range(1, commands + 1))
