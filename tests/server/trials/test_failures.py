"""Trials that cannot be made, fail or are stopped by somebody else."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.server.conftest import Connect, ask, ask_until, fail
from tests.server.story import rows_of
from tests.server.trials.conftest import HANGS_AT, TunableDriver, trials, value_of
from webots_mcp.database.connection import connect as database
from webots_mcp.steering import trial_worker
from webots_mcp.store.retention_limits import KEPT

pytestmark = pytest.mark.anyio


@pytest.mark.slow
async def test_what_cannot_be_tried_is_refused_before_anything_is_done(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        await ask_until(client, "webots_get_robot_state", lambda told: told["sim_time_s"] >= 0.1)

        async def refused(**changed: Any) -> str:
            asked = {"parameters": {"kp": [1.0]}, "score": "last(distance)", "for_s": 1} | changed
            return await fail(client, "webots_run_trials", **asked)

        assert "that the controller declares: kp" in await refused(parameters={"k": [1.0]})
        assert "up to 100, not 101" in await refused(parameters={"kp": [1, 101]})
        assert "one of 'trot', 'walk'" in await refused(parameters=[{"gait": "hop"}])
        assert "given twice" in await refused(parameters=[{"kp": 1}, {"kp": 1.0}])
        assert "kp must be a list of values" in await refused(parameters={"kp": []})
        for wrong in ({"kp": 2}, [1.0], [], {}, 3, {"kp": [1.0], "gait": "trot"}):
            assert "parameters must be sets, [{" in await refused(parameters=wrong)
        assert "more than 10000" in await refused(parameters={"kp": [0.01 * n for n in range(101)],
                                                              "gait": ["trot"] * 101})  # fmt: skip
        assert "Nearest signals: distance" in await refused(score="last(distanc)")
        assert "unknown kind of event 'stcuk'" in await refused(score="count(stcuk)")
        assert "column" in await refused(score="last(distance")
        assert "distance" in await refused(until="distanc > 3")
        assert "It is not said when to stop" in await refused(for_s=None)
        assert "an end" in await refused(score=None)
        assert "it excludes parameters and score" in await refused(trial_set=1)
        assert "No trial set 1 is recorded: none was started yet" in await fail(
            client, "webots_run_trials", trial_set=1
        )
        assert "commands" not in await ask(client, "webots_list_commands")
        told = await ask(client, "webots_get_trials")
        assert told["hint"] == "no trials were begun: webots_run_trials"


@pytest.mark.slow
async def test_a_trial_without_a_score_or_an_end_failed_and_is_not_zero(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        answer = await trials(client, parameters={"kp": [0.0, 1.0]}, score="1 / last(distance)")
        good, failed = rows_of(answer["ranked"])
        assert (good["kp"], failed["kp"]) == (1.0, 0.0)
        assert (failed["scored"], failed["failed"]) == (0, 1)
        assert "division by zero" in failed["why"]
        late = await trials(
            client,
            parameters={"kp": [1.0]},
            until="distance < 0",
            for_s=None,
            trial_timeout_wall_s=0.05,
        )
        (row,) = rows_of(late["ranked"])
        assert row["failed"] == 1
        assert row["why"].startswith("did not reach its end, only ")
        assert "longer than 0.05 s" in row["why"]


@pytest.mark.slow
async def test_a_loop_that_hangs_fails_its_trial_with_the_time_that_it_reached(
    connect: Connect, tunable: TunableDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial_worker, "_TIMES", replace(trial_worker._TIMES, patience_s=0.1))
    async with connect() as client:
        answer = await trials(client, parameters={"kp": [HANGS_AT]}, trial_timeout_wall_s=1)
        (row,) = rows_of(answer["ranked"])
        assert row["why"].startswith("did not reach its end, only 0.112 s: it took longer than 1 s")
        assert "no longer calls bridge.get_command()" in answer["state"]


@pytest.mark.slow
async def test_a_pause_by_somebody_else_stops_the_set_and_it_can_go_on(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        first = await trials(
            client,
            parameters={"kp": [1.0]},
            until="distance < 0",
            for_s=100_000,
            timeout_wall_s=0.2,
        )
        await ask(client, "webots_simulation_control", command="pause")
        told = await ask_until(client, "webots_get_trials", lambda told: "stopped" in told["state"])
        assert told["state"].startswith("stopped: trial 1 was interrupted")
        assert told["over"] == 0
        assert f"webots_run_trials(trial_set={first['trial_set']}) continues" in told["hint"]
        assert await value_of(client, "kp") == 2.0


@pytest.mark.slow
async def test_a_parameter_that_somebody_else_sets_stops_the_set(
    connect: Connect, tunable: TunableDriver
) -> None:
    async with connect() as client:
        await ask(client, "webots_set_parameters", values={"kp": 3.0})
        plan = {"parameters": {"kp": [1.0]}, "until": "gait == 'walk'", "for_s": 100_000}
        await trials(client, **plan, timeout_wall_s=0.2)
        await ask(client, "webots_set_parameters", values={"gait": "walk"})
        told = await ask_until(client, "webots_get_trials", lambda told: "stopped" in told["state"])
        assert told["state"].startswith(
            "stopped: trial 1 was interrupted: gait was set to walk at "
        )
        assert told["over"] == 0
        assert await value_of(client, "kp") == 3.0


async def test_rows_that_were_purged_leave_the_score(
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
