"""Trials in the running simulation: tried, scored, ranked; whoever is killed in the middle."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio import to_thread
from mcp import Client, MCPError, StdioServerParameters

from tests.bridge.conftest import Recording
from tests.processes.conftest import Start, data_dir, filed, has_states, start  # fixtures
from tests.processes.stopping import stop_between_writes
from tests.recordings.rows import Recorded
from tests.server.conftest import STEP_MS, Connect, Driver, ask, fail, pictures_of, text_of
from tests.server.story import rows_of
from webots_mcp import MCPBridge
from webots_mcp.connection import connect as database
from webots_mcp.server import create_server
from webots_mcp.standin import InProcessSupervisor, Mode, Simulation
from webots_mcp.store.retention.policy import KEPT

__all__ = ["data_dir", "filed", "start"]
pytestmark = pytest.mark.anyio

# The robot drives as fast as it is told; a file that the test makes lets trials end.
ROVER = """
import math
from pathlib import Path

speed = bridge.parameter("speed", 1.0, low=0.0, high=10.0, unit="rad/s")
motors = [robot.getDevice(f"{{side}} wheel motor") for side in ("left", "right")]
gps = robot.getDevice("gps")
gps.enable(16)
while robot.step(16) != -1:
    for motor in motors:
        motor.setPosition(math.inf)
        motor.setVelocity(speed.value)
    x, y, _ = gps.getValues()
    bridge.publish({{"pose": {{"x": x, "y": y}}, "released": int(Path({release!r}).exists())}})
    bridge.get_command()
"""
SERVER = """
import os, pathlib, sys
from webots_mcp.cli import main

pathlib.Path(sys.argv[1]).write_text(str(os.getpid()))
main(["serve", "--database", sys.argv[2]])
"""
DISTANCE = "max(pose.x) - min(pose.x) + max(pose.y) - min(pose.y)"
TRIED = "SELECT count(*) FROM command WHERE json_extract(params, '$.until') IS NOT NULL"
HANGS_AT = 99.0
SPEEDS = {"speed": [1.0, 2.0, 3.0, 4.0, 5.0]}


class TunableDriver(Driver):
    """A robot whose `distance` grows with `kp`."""

    def __init__(self, file: Path) -> None:
        super().__init__(file)
        self.kp = self.bridge.parameter("kp", 2.0, low=0, high=100)
        self.gait = self.bridge.parameter("gait", "trot", choices=["trot", "walk"])
        self.goes_on = threading.Event()
        self.resets = 0

    def run(self) -> None:
        before_s = 0.0
        while self.robot.step(STEP_MS) != -1:
            self.resets += self.robot.getTime() < before_s
            before_s = self.robot.getTime()
            distance = self.kp.value * before_s
            self.bridge.publish({"distance": distance, "gait": self.gait.value})
            if self.kp.value == HANGS_AT and self.robot.getTime() > 0.1:
                self.goes_on.wait()
            self.bridge.get_command()

    def stop(self) -> None:
        self.goes_on.set()
        super().stop()


@pytest.fixture
def tunable(file: Path) -> Iterator[TunableDriver]:
    driving = TunableDriver(file)
    driving.start()
    yield driving
    driving.stop()


@pytest.fixture
def release(tmp_path: Path) -> Path:
    return tmp_path / "release"


@pytest.fixture
def simulation(start: Start, filed: Recording, release: Path) -> Simulation:
    arena = start(ROVER.format(release=str(release)), mode="realtime")
    arena.wait_for(lambda: has_states(filed), 30)
    return arena


async def trials(client: Client, **arguments: Any) -> dict[str, Any]:
    arguments = {"score": "last(distance)", "for_s": 0.16} | arguments
    return await ask(client, "webots_run_trials", **arguments)


async def value_of(client: Client, name: str) -> Any:
    rows = rows_of((await ask(client, "webots_get_parameters"))["parameters"])
    return next(row["value"] for row in rows if row["name"] == name)


@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_a_grid_is_tried_and_ranked_and_the_parameters_are_set_back(
    connect: Connect, tunable: TunableDriver, mode: str
) -> None:
    async with connect(mode=mode) as client:
        await ask(client, "webots_set_parameters", values={"kp": 7.0})
        answer = await trials(client, parameters={"kp": [1, 4], "gait": ["trot"]}, repeats=2)
        assert (answer["state"], answer["over"], answer["trials"]) == ("done", 4, 4)
        best, other = rows_of(answer["ranked"])
        assert (best["kp"], best["score"]) == (4.0, pytest.approx(0.64))
        assert (other["kp"], other["score"]) == (1.0, pytest.approx(0.16))
        assert best["range"] == [best["score"]] * 2
        assert answer["ranked"]["in_every_row"]["gait"] == "trot"
        assert answer["best_is_better"] is True
        assert "beats the next" in answer["verdict"]
        assert await ask(client, "webots_get_trials") == answer | {
            name: pytest.approx(answer[name], abs=5) for name in ("age_s",)
        }
        assert await value_of(client, "kp") == 7.0
        compared = await ask(client, "webots_compare_runs", trial_set=1)
        groups = {row["name"]: row["runs"] for row in rows_of(compared["groups"])}
        assert groups == {
            "kp 4.0, gait trot": best["runs"],
            "kp 1.0, gait trot": other["runs"],
        }
        drawn = await client.call_tool("webots_plot", {"trial_set": 1})
        assert not drawn.is_error
        assert "trial set 1, 4 trials: last(distance) over kp" in text_of(drawn)
        assert len(pictures_of(drawn)) == 1
        runs = rows_of((await ask(client, "webots_list_runs", parameters={"kp": 4.0}))["runs"])
        assert [row["run_id"] for row in runs] == sorted(best["runs"], reverse=True)
        assert runs[-1]["label"] == "trial 2 of set 1: kp 4.0, gait trot"
        assert (await ask(client, "webots_get_robot_state"))["status"] == "paused"
        asked_by = "SELECT DISTINCT requested_by FROM command ORDER BY 1"
        told = await ask(client, "webots_query_sql", sql=asked_by)
        assert [row["requested_by"] for row in rows_of(told["result"])] == ["mcp", "trials"]
        set_by = "SELECT DISTINCT set_by FROM robot_parameter WHERE run_id = 2 AND name = 'kp'"
        told = await ask(client, "webots_query_sql", sql=set_by)
        assert rows_of(told["result"]) == [{"set_by": "trial"}]
        now = await ask(client, "webots_list_runs", limit=2)
        newest, last = rows_of(now["runs"])
        assert newest["run_id"] == max(best["runs"] + other["runs"]) + 1
        assert last["parameters"]["kp"] == 4.0, "what was set back is of another run"


async def test_a_trial_in_which_prune_holds_ends_there_and_ranks_below_those_with_a_score(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await trials(
            client, parameters={"kp": [1.0, 5.0]}, repeats=2, prune="distance > 0.2 for 0.05"
        )
        assert (answer["state"], answer["over"], answer["pruned"]) == ("done", 4, 2)
        assert "failed" not in answer
        good, pruned = rows_of(answer["ranked"])
        assert (good["kp"], good["scored"], pruned["kp"], pruned["scored"]) == (1.0, 2, 5.0, 0)
        ended = "SELECT DISTINCT status, ended_by, error FROM trial WHERE score IS NULL"
        (told,) = rows_of((await ask(client, "webots_query_sql", sql=ended))["result"])
        assert (told["status"], told["ended_by"]) == ("pruned", "prune")
        assert told["error"].startswith("'distance > 0.2 for 0.05' held at 0.")
        asked = {"score": "last(distance)", "for_s": 1, "parameters": {"kp": [1.0]}}
        said = await fail(client, "webots_run_trials", prune="distanc > 2", **asked)
        assert "there is distance" in said


async def test_without_repeats_one_set_is_tried_twice_to_measure_the_noise(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await trials(
            client, parameters=[{"kp": 3.0}, {"kp": 1.0}], until="distance > 0.3", best="lowest",
            score="duration", for_s=None,
        )  # fmt: skip
        best, other = rows_of(answer["ranked"])
        assert [best["scored"], other["scored"]] == [2, 1]
        assert best["score"] < other["score"] == pytest.approx(0.304)
        assert answer["noise"] == 0


async def test_out_of_wall_time_they_go_on_and_a_second_call_waits(
    connect: Connect, tunable: TunableDriver
) -> None:
    reports: list[tuple[float, float | None, str]] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append((progress, total, message or ""))

    async with connect() as client:
        first = await trials(client, parameters={"kp": [1.0, 2.0]}, repeats=8, timeout_s=0.1)
        assert first["state"] == "under way"
        assert first["over"] < first["trials"] == 16
        assert f"trial_set={first['trial_set']}" in first["hint"]
        refused = await fail(
            client, "webots_run_trials", parameters={"kp": [1]}, score="duration", for_s=1
        )
        assert f"trial set {first['trial_set']} of this robot is under way" in refused
        arguments = {"trial_set": first["trial_set"], "timeout_s": 60}
        result = await client.call_tool(
            "webots_run_trials", arguments, progress_callback=on_progress
        )
        assert result.structured_content is not None
        assert result.structured_content["state"] == "done"
        assert result.structured_content["over"] == 16
    assert all(total == 16 and "of 16 trials" in message for _, total, message in reports)


async def test_cancel_stops_after_the_current_trial_and_sets_the_parameters_back(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        first = await trials(client, parameters={"kp": [5.0]}, repeats=500, timeout_s=0.1)
        ended = await ask(
            client, "webots_run_trials", trial_set=first["trial_set"], cancel=True, timeout_s=30
        )
        assert ended["state"] == "stopped: it was cancelled"
        assert ended["over"] < 500
        assert "failed" not in ended
        assert await value_of(client, "kp") == 2.0
        again = await trials(client, parameters={"kp": [1.0]})
        assert again["state"] == "done"


async def test_what_a_set_does_not_name_is_as_it_was_before_the_trials(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        await ask(client, "webots_set_parameters", values={"kp": 7.0})
        sets = [{"kp": 3.0, "gait": "walk"}, {"gait": "trot"}, {}]
        answer = await trials(client, parameters=sets, repeats=2, score="max(distance) / 0.16")
        scores = [(row["kp"], row["range"]) for row in rows_of(answer["ranked"])]
        assert scores == [
            (None, [pytest.approx(7.0)] * 2),
            (None, [pytest.approx(7.0)] * 2),
            (3.0, [pytest.approx(3.0)] * 2),
        ]


async def test_trials_that_change_nothing_end(connect: Connect, tunable: TunableDriver) -> None:
    async with connect() as client:
        answer = await trials(client, parameters=[{}], repeats=2)
        assert (answer["state"], answer["over"]) == ("done", 2)
        assert (await trials(client, parameters={"kp": [1.0]}))["state"] == "done"


async def test_a_controller_that_knows_a_reset_only_by_its_time_notices_each(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        for _ in range(2):
            await trials(client, parameters={"kp": [1.0, 2.0]})
        told = await ask(client, "webots_list_runs")
        assert tunable.resets == told["total"] - 1


async def test_a_trial_that_nobody_ran_because_the_controller_ended_says_why(
    connect: Connect, file: Path
) -> None:
    with MCPBridge(InProcessSupervisor("silent"), throttle_interval=1, database=file) as bridge:
        bridge.parameter("kp", 2.0, low=0, high=100)
        bridge.publish({"distance": 1.0})
        async with connect() as client:
            await trials(client, parameters={"kp": [1.0]}, timeout_s=0.1)
            bridge.close()
            with closing(database(file, "writer")) as connection:
                connection.execute("UPDATE command SET expires_wall_time_s = 1.0")
            answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=30)
            assert "no live controller" in answer["state"]
            assert (answer["over"], answer["trials"]) == (0, 2)


async def test_what_cannot_be_tried_is_refused_before_anything_is_done(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        with anyio.fail_after(20):
            while (await ask(client, "webots_get_robot_state"))["sim_time_s"] < 0.1:
                await anyio.sleep(0.01)

        async def refused(**changed: Any) -> str:
            asked = {"parameters": {"kp": [1.0]}, "score": "last(distance)", "for_s": 1} | changed
            return await fail(client, "webots_run_trials", **asked)

        assert "the nearest are kp" in await refused(parameters={"k": [1.0]})
        assert "up to 100, not 101" in await refused(parameters={"kp": [1, 101]})
        assert "one of 'trot', 'walk'" in await refused(parameters=[{"gait": "hop"}])
        assert "given twice" in await refused(parameters=[{"kp": 1}, {"kp": 1.0}])
        assert "kp must be a list of values" in await refused(parameters={"kp": []})
        for wrong in ({"kp": 2}, [1.0], [], {}, 3, {"kp": [1.0], "gait": "trot"}):
            assert "parameters must be sets, [{" in await refused(parameters=wrong)
        assert "more than 10000" in await refused(parameters={"kp": [0.01 * n for n in range(101)],
                                                              "gait": ["trot"] * 101})  # fmt: skip
        assert "there is distance" in await refused(score="last(distanc)")
        assert "no kind of event 'stcuk'" in await refused(score="count(stcuk)")
        assert "column" in await refused(score="last(distance")
        assert "distance" in await refused(until="distanc > 3")
        assert "give until" in await refused(for_s=None)
        assert "give both" in await refused(score=None)
        assert "not both" in await refused(trial_set=1)
        assert "no trial set 1: none was begun" in await fail(
            client, "webots_run_trials", trial_set=1
        )
        assert "commands" not in await ask(client, "webots_list_commands")
        told = await ask(client, "webots_get_trials")
        assert told["hint"] == "no trials were begun: webots_run_trials"


async def test_robots_that_cannot_try_are_refused_with_the_next_step(
    connect: Connect, driver: Driver, recorded: Recorded
) -> None:
    recorded.robot("gone", ended_wall_time_s=1.0).state(1.0, {"x": 1})
    recorded.robot("plain", supervisor=False).state(1.0, {"x": 1})
    asked = {"parameters": {"kp": [1.0]}, "score": "duration", "for_s": 1}
    async with connect() as client:
        for robot, said in (
            ("gone", "no live controller"),
            ("plain", "needs a Supervisor"),
            (driver.robot.getName(), "declares no parameters"),
        ):
            assert said in await fail(client, "webots_run_trials", robot=robot, **asked)
    async with connect(read_only=True) as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        assert "webots_run_trials" not in names
        assert "no trials were begun" in (await ask(client, "webots_get_trials"))["hint"]


async def test_a_trial_without_a_score_or_an_end_failed_and_is_not_zero(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await trials(client, parameters={"kp": [0.0, 1.0]}, score="1 / last(distance)")
        good, failed = rows_of(answer["ranked"])
        assert (good["kp"], failed["kp"]) == (1.0, 0.0)
        assert (failed["scored"], failed["failed"]) == (0, 2)
        assert "division by zero" in failed["why"]
        late = await trials(
            client, parameters={"kp": [1.0]}, until="distance < 0", for_s=None, trial_timeout_s=0.05
        )
        (row,) = rows_of(late["ranked"])
        assert row["failed"] == 2
        assert row["why"].startswith("never reached its end, but ")
        assert "longer than 0.05 s" in row["why"]


async def test_a_loop_that_hangs_fails_its_trial_with_the_time_that_it_reached(
    connect: Connect, tunable: TunableDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.server.trial_worker._PATIENCE_S", 0.1)
    async with connect() as client:
        answer = await trials(client, parameters={"kp": [HANGS_AT]}, trial_timeout_s=1)
        (row,) = rows_of(answer["ranked"])
        assert row["why"].startswith("never reached its end, but 0.112 s: it took longer than 1 s")
        assert "does not come to bridge.get_command() any more" in answer["state"]


async def test_a_pause_by_somebody_else_stops_the_set_and_it_can_go_on(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        first = await trials(
            client, parameters={"kp": [1.0]}, until="distance < 0", for_s=100_000, timeout_s=0.2
        )
        await ask(client, "webots_simulation_control", command="pause")
        with anyio.fail_after(20):
            while "stopped" not in (told := await ask(client, "webots_get_trials"))["state"]:
                await anyio.sleep(0.02)
        assert told["state"].startswith("stopped: trial 1 was interrupted")
        assert told["over"] == 0
        assert f"webots_run_trials(trial_set={first['trial_set']}) goes on" in told["hint"]
        assert await value_of(client, "kp") == 2.0


async def test_a_parameter_that_somebody_else_sets_stops_the_set(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        await ask(client, "webots_set_parameters", values={"kp": 3.0})
        plan = {"parameters": {"kp": [1.0]}, "until": "gait == 'walk'", "for_s": 100_000}
        await trials(client, **plan, timeout_s=0.2)
        await ask(client, "webots_set_parameters", values={"gait": "walk"})
        with anyio.fail_after(20):
            while "stopped" not in (told := await ask(client, "webots_get_trials"))["state"]:
                await anyio.sleep(0.02)
        assert told["state"].startswith(
            "stopped: trial 1 was interrupted: gait was set to walk at "
        )
        assert told["over"] == 0
        assert await value_of(client, "kp") == 3.0


async def test_rows_that_were_purged_leave_the_score_and_the_answer_says_so(
    connect: Connect, tunable: TunableDriver, file: Path
) -> None:
    async with connect() as client:
        answer = await trials(client, parameters={"kp": [1.0]}, repeats=2)
        (row,) = rows_of(answer["ranked"])
        with closing(database(file, "writer")) as connection:
            (kept,) = connection.execute(f"SELECT count(*) FROM run WHERE {KEPT}").fetchone()
            assert kept == 0, "a trial's label does not keep its rows for good"
            connection.execute("UPDATE run SET purged_rows = 3 WHERE id = ?", row["runs"][:1])
            connection.execute("DELETE FROM run WHERE id = ?", row["runs"][1:])
        told = await ask(client, "webots_get_trials")
        assert rows_of(told["ranked"])[0]["score"] == row["score"]
        assert told["notes"] == ["rows of trial 1, 2 were purged since: the scores stay"]


async def test_a_hundred_trials_are_told_in_a_short_answer(
    connect: Connect, tunable: TunableDriver
) -> None:
    grid = {"kp": [0.37 * n for n in range(1, 51)], "gait": ["trot", "walk"]}
    async with connect() as client:
        answer = await trials(client, parameters=grid, for_s=0.032, timeout_s=90)
        assert answer["over"] == 101
        assert len(json.dumps(answer, separators=(",", ":"))) < 8_000
        kps = [row["kp"] for row in rows_of(answer["ranked"])]
        assert len(kps) == 100
        assert kps == sorted(kps, reverse=True)


async def test_of_many_trials_that_fail_the_first_are_told_and_how_many_more(
    connect: Connect, tunable: TunableDriver
) -> None:
    grid = {"kp": [float(n) for n in range(100)]}
    async with connect() as client:
        answer = await trials(client, parameters=grid, score="1 / (last(distance) * 0)", for_s=0.02)
        assert answer["failed"] == 101
        assert answer["verdict"] == "no trial gave a score"
        assert len(json.dumps(answer, separators=(",", ":"))) < 8_000
        shown = len(rows_of(answer["ranked"]))
        if shown < 100:
            assert answer["notes"][0].startswith(f"{100 - shown} sets that rank lower")


async def test_five_speeds_of_the_rover_three_times_each(
    simulation: Simulation, data_dir: Path
) -> None:
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        answer = await trials(
            client, parameters=SPEEDS, repeats=3, score=DISTANCE, for_s=1, timeout_s=90
        )
        assert (answer["state"], answer["over"]) == ("done", 15)
        rows = rows_of(answer["ranked"])
        assert [row["speed"] for row in rows] == [5.0, 4.0, 3.0, 2.0, 1.0]
        assert all(len(row["runs"]) == 3 for row in rows)
        assert answer["best_is_better"] is True
        assert simulation.mode is Mode.PAUSE
        assert await value_of(client, "speed") == 1.0


async def _ask_in_vain(client: Client, arguments: dict[str, Any]) -> None:
    with anyio.fail_after(60), pytest.raises(MCPError, match="closed"):
        await client.call_tool("webots_run_trials", arguments)


async def _until(filed: Recording, sql: str, found: object) -> None:
    with anyio.fail_after(30):
        while filed.rows(sql) != [found]:
            await anyio.sleep(0.01)


async def test_a_set_whose_server_was_killed_is_gone_on_with_by_another(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path, tmp_path: Path
) -> None:
    database, pid = str(data_dir / "webots.db"), tmp_path / "pid"
    server = StdioServerParameters(
        command=sys.executable, args=["-c", SERVER, str(pid), database], env=dict(os.environ)
    )
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(_ask_in_vain, client, asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        os.kill(int(pid.read_text()), signal.SIGKILL)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        left = await ask(client, "webots_get_trials")
        assert left["state"] == "left by a server that ended"
        said = await fail(client, "webots_run_trials", parameters=SPEEDS, score="duration", for_s=1)
        assert "trial set 1 of this robot is not over (it was left by a server that ended)" in said
        release.touch()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=90)
        assert (answer["state"], answer["over"]) == ("done", 6)
        assert "failed" not in answer
        assert await value_of(client, "speed") == 1.0
    assert filed.rows(TRIED) == [6], "what the killed server had sent was not sent again"


def let_leases_run_out(file: Path) -> None:
    """As time does, where nobody renews them."""
    with closing(database(file, "writer")) as connection:
        connection.execute("UPDATE lease SET until_wall_time_s = 1.0 WHERE name <> 'maintainer'")


async def test_a_set_whose_server_was_stopped_is_taken_over_and_never_run_by_both(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path, tmp_path: Path
) -> None:
    file, pid = data_dir / "webots.db", tmp_path / "pid"
    server = StdioServerParameters(
        command=sys.executable, args=["-c", SERVER, str(pid), str(file)], env=dict(os.environ)
    )
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    told: list[dict[str, Any]] = []

    async def ask_the_stopped_one(client: Client) -> None:
        told.append(await ask(client, "webots_run_trials", **asked, timeout_s=90))

    async with Client(server) as client, anyio.create_task_group() as tasks:
        tasks.start_soon(ask_the_stopped_one, client)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        async with Client(create_server(file, data_dir)) as other:
            stop_between_writes(int(pid.read_text()), file)
            assert (await ask(other, "webots_get_trials"))["state"] == "under way"
            let_leases_run_out(file)
            assert (await ask(other, "webots_get_trials"))["state"] == "left by a server that ended"
            await ask(other, "webots_run_trials", trial_set=1, timeout_s=0.1)
            os.kill(int(pid.read_text()), signal.SIGCONT)
            release.touch()
            answer = await ask(other, "webots_run_trials", trial_set=1, timeout_s=90)
            assert (answer["state"], answer["over"]) == ("done", 6)
            assert await value_of(other, "speed") == 1.0
    assert (told[0]["state"], told[0]["over"]) == ("done", 6)
    assert filed.rows(TRIED) == [6]
    assert filed.rows("SELECT count(*) FROM command WHERE action = 'cancel_run'") == [0]


@pytest.mark.parametrize("renewed", [True, False])
async def test_a_set_at_work_on_another_host_is_its_own_as_long_as_it_renews_the_lease(
    connect: Connect, tunable: TunableDriver, file: Path, renewed: bool
) -> None:
    async with connect() as client:
        await trials(client, parameters={"kp": [1.0, 2.0]})
        with closing(database(file, "writer")) as connection:
            connection.execute("UPDATE trial_set SET host = 'elsewhere', pid = 1, process = 'x'")
            connection.execute("UPDATE trial SET status = 'waiting', run_id = NULL, score = NULL")
            until_s = time.time() + (20 if renewed else -1)
            values = ("trial set 1", "elsewhere 1", until_s)
            connection.execute("INSERT INTO lease VALUES (?, ?, ?)", values)
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=1 if renewed else 60)
        assert answer["state"] == ("under way" if renewed else "done")


async def test_a_server_that_ends_leaves_the_parameters_as_they_were(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path
) -> None:
    asked = {"parameters": {"speed": [3.0]}, "score": "last(released)", "until": "released > 0"}
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        await ask(client, "webots_run_trials", timeout_s=0.1, **asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        assert await value_of(client, "speed") == 1.0
        assert (await ask(client, "webots_get_trials"))["state"] == "left by a server that ended"
        release.touch()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=60)
        assert (answer["state"], answer["over"]) == ("done", 2)


async def test_a_killed_controller_fails_its_trial_and_the_set_says_why_it_stops(
    simulation: Simulation, filed: Recording, data_dir: Path, release: Path
) -> None:
    asked = {"parameters": SPEEDS, "score": "last(released)", "until": "released > 0"}
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        await ask(client, "webots_run_trials", timeout_s=0.1, **asked)
        await _until(filed, "SELECT count(*) FROM command WHERE status = 'claimed'", 1)
        await _until(filed, "SELECT max(id) FROM run", 2)
        simulation.controller("rover").kill()
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=60)
        assert "no live controller" in answer["state"]
        assert (answer["over"], answer["failed"]) == (1, 1)
        (row,) = rows_of(answer["ranked"])
        assert row["runs"] == [2]
        assert "its controller ended before it finished" in row["why"]
        await to_thread.run_sync(simulation.reload)
        release.touch()
        with anyio.fail_after(30):
            while (await ask(client, "webots_get_robot_state"))["status"].startswith("stopped"):
                await anyio.sleep(0.05)
        answer = await ask(client, "webots_run_trials", trial_set=1, timeout_s=60)
        assert (answer["state"], answer["over"], answer["failed"]) == ("done", 6, 1)
