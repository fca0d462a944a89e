"""Trials in the running simulation: tried, scored and ranked."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import anyio
import pytest

from tests.exploring import attempts
from tests.server.conftest import Connect, ask, ask_until, fail, pictures_of, text_of
from tests.server.story import rows_of
from tests.server.trials.conftest import TunableDriver, trials, value_of
from tests.waiting import until
from webots_mcp import MCPBridge
from webots_mcp.answers.shortening import tokens_of
from webots_mcp.database.connection import connect as database
from webots_mcp.standin import InProcessSupervisor

pytestmark = pytest.mark.anyio
_MANY = attempts(64, exploring=100)  # trials, of which an answer shows about 50


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "legacy"])
async def test_a_grid_is_tried_and_ranked_and_the_parameters_are_set_back(
    connect: Connect, tunable: TunableDriver, mode: str
) -> None:
    async with connect(mode=mode) as client:
        await ask(client, "webots_set_parameters", values={"kp": 7.0})
        answer = await trials(client, parameters={"kp": [1, 4], "gait": ["trot"]}, repeats=4)
        assert (answer["state"], answer["over"], answer["trials"]) == ("done", 8, 8)
        best, other = rows_of(answer["ranked"])
        assert (best["kp"], best["score"]) == (4.0, pytest.approx(0.64))
        assert (other["kp"], other["score"]) == (1.0, pytest.approx(0.16))
        assert best["range"] == [best["score"]] * 2
        assert answer["ranked"]["in_every_row"]["gait"] == "trot"
        assert answer["is_best_confirmed"] is True
        assert "is ahead of the second best" in answer["verdict"]
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
        assert "trial set 1, 8 trials: last(distance) over kp" in text_of(drawn)
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


@pytest.mark.slow
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
        assert "signals: distance" in said


@pytest.mark.slow
async def test_out_of_wall_time_they_go_on_and_a_second_call_waits(
    connect: Connect, tunable: TunableDriver
) -> None:
    reports: list[tuple[float, float | None, str]] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append((progress, total, message or ""))

    async with connect() as client:
        first = await trials(client, parameters={"kp": [1.0, 2.0]}, repeats=8, timeout_wall_s=0.1)
        assert first["state"] == "under way"
        assert first["over"] < first["trials"] == 16
        assert f"trial_set={first['trial_set']}" in first["hint"]
        refused = await fail(
            client, "webots_run_trials", parameters={"kp": [1]}, score="duration", for_s=1
        )
        assert f"Trial set {first['trial_set']} of this robot is under way" in refused
        arguments = {"trial_set": first["trial_set"], "timeout_wall_s": 60}
        result = await client.call_tool(
            "webots_run_trials", arguments, progress_callback=on_progress
        )
        assert result.structured_content is not None
        assert result.structured_content["state"] == "done"
        assert result.structured_content["over"] == 16
    assert all(total == 16 and "of 16 trials" in message for _, total, message in reports)


@pytest.mark.slow
async def test_cancel_stops_after_the_current_trial_and_sets_the_parameters_back(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        first = await trials(client, parameters={"kp": [5.0]}, repeats=500, timeout_wall_s=0.1)
        ended = await ask(
            client,
            "webots_run_trials",
            trial_set=first["trial_set"],
            cancel=True,
            timeout_wall_s=30,
        )
        assert ended["state"] == "stopped: it was cancelled"
        assert ended["over"] < 500
        assert "failed" not in ended
        assert await value_of(client, "kp") == 2.0
        again = await trials(client, parameters={"kp": [1.0]})
        assert again["state"] == "done"


@pytest.mark.slow
async def test_a_cancelled_call_ends_the_trial_that_runs_and_no_other_begins(
    connect: Connect, tunable: TunableDriver
) -> None:
    tried = "SELECT count(*) AS n, max(id) AS last FROM command WHERE action = 'run'"
    async with connect() as client:
        async with anyio.create_task_group() as tasks:
            asked = {
                "parameters": {"kp": [5.0]},
                "score": "last(distance)",
                "until": "distance < 0",
            }
            tasks.start_soon(client.call_tool, "webots_run_trials", {**asked, "repeats": 50})
            await until(lambda: value_of(client, "kp"), lambda kp: kp == 5.0)
            tasks.cancel_scope.cancel()
        left = await ask_until(
            client, "webots_get_trials", lambda told: "stopping" not in told["state"]
        )
        assert (left["state"], left["over"]) == ("stopped: it was cancelled", 0)
        (count,) = rows_of((await ask(client, "webots_query_sql", sql=tried))["result"])
        assert count["n"] == 1
        assert await value_of(client, "kp") == 2.0
        assert (await ask(client, "webots_get_robot_state"))["status"] == "paused"
        resets = tunable.resets
        assert (await trials(client, parameters={"kp": [1.0]}))["state"] == "done"
        assert tunable.resets > resets


@pytest.mark.slow
async def test_a_trial_that_nobody_ran_because_the_controller_ended_says_why(
    connect: Connect, file: Path
) -> None:
    with MCPBridge(InProcessSupervisor("silent"), throttle_interval=1, database=file) as bridge:
        bridge.parameter("kp", 2.0, low=0, high=100)
        bridge.publish({"distance": 1.0})
        async with connect() as client:
            await trials(client, parameters={"kp": [1.0]}, timeout_wall_s=0.1)
            bridge.close()
            with closing(database(file, "writer")) as connection:
                connection.execute("UPDATE command SET expires_wall_time_s = 1.0")
            answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=30)
            assert "no live controller" in answer["state"]
            assert (answer["over"], answer["trials"]) == (0, 1)


@pytest.mark.slow
async def test_more_trials_than_an_answer_holds_are_told_in_a_short_one(
    connect: Connect, tunable: TunableDriver
) -> None:
    grid = {"kp": [0.37 * n for n in range(1, _MANY // 2 + 1)], "gait": ["trot", "walk"]}
    async with connect() as client:
        answer = await trials(client, parameters=grid, for_s=0.032, timeout_wall_s=90)
        while answer["state"] == "under way":
            answer = await ask(client, "webots_run_trials", trial_set=1, timeout_wall_s=90)
        assert answer["over"] == _MANY
        assert tokens_of(answer) < 2_000
        kps = [row["kp"] for row in rows_of(answer["ranked"])]
        assert len(kps) > 40
        assert any(f"{_MANY - len(kps)} sets that rank lower" in note for note in answer["notes"])
        assert kps == sorted(kps, reverse=True)
