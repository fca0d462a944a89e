"""Trials on a Dask cluster: a real scheduler, and workers as processes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from anyio import to_thread
from mcp import Client

from tests.plugins.cluster.dask_cluster import Cluster
from tests.server.conftest import ask, fail
from tests.steering.trials.conftest import Run, command, rows
from tests.waiting import wait_for
from webots_mcp import __version__
from webots_mcp.plugins.cluster import dask_cluster as cluster
from webots_mcp.plugins.cluster.dask_cluster import (
    WorkerRequirements,
    digest_of,
    missing_requirement,
    packed,
)
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.trial_sets import TrialResult

Write = Callable[[str], Path]

pytestmark = [pytest.mark.skipif(os.name != "posix", reason="signals"), pytest.mark.slow]

GRID = 'score = "last(x)"\nfor_s = 0.3\n[grid]\nspeed = [1.0, 2.0, 5.0]'


@pytest.fixture(scope="module")
def dask_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    started = Cluster(tmp_path_factory.mktemp("cluster"))
    yield started
    started.end()


@pytest.fixture
def started(project: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the plan; whoever still works on it afterwards is ended."""
    running: list[subprocess.Popen[str]] = []

    def start(*options: str) -> subprocess.Popen[str]:
        line = command(project, *options)
        process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        running.append(process)
        return process

    yield start
    for process in running:
        process.kill()
        process.communicate()


def answer_of(ended: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def scores(answer: dict[str, Any]) -> dict[float, set[float]]:
    """By the speed."""
    return {each["parameters"]["speed"]: set(each["scores"]) for each in answer["sets"]}


def test_a_worker_that_is_killed_costs_nothing_and_the_scores_are_those_of_this_machine(
    project: Path,
    plan: Write,
    run: Run,
    started: Callable[..., subprocess.Popen[str]],
    dask_cluster: Cluster,
) -> None:
    workers = dask_cluster.start(4)
    plan(GRID)
    process = started("--scheduler", dask_cluster.address, "--json")
    busy = wait_for(lambda: next((each for each in workers if each.recording), None))
    simulator = busy.kill()
    out, said = process.communicate(timeout=120)

    answer = json.loads(out)
    assert "3/3  speed " in said
    assert [len(each["scores"]) for each in answer["sets"]] == [1, 1, 1]
    counted = "SELECT count(*), count(DISTINCT uuid), count(DISTINCT label) FROM run"
    assert rows(project, counted) == [(3, 3, 3)]
    assert list((project / "data" / "trials").iterdir()) == []
    assert [each.trials for each in dask_cluster.workers] == [[], [], []]
    wait_for(lambda: not any(each.is_running() for each in simulator))
    plan(GRID.replace("1.0, 2.0, 5.0", "2.0"))
    assert scores(answer_of(run("--json")))[2.0] == scores(answer)[2.0]


# Comes to its end only once a file `release` is there, and leaves the processor to others.
WAITING = """
import time
from pathlib import Path
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
speed = bridge.parameter("speed", 1.0)
while robot.step(16) != -1:
    bridge.publish({"x": speed.value, "released": int(Path("../../release").exists())})
    time.sleep(0.02)
"""


# Dies with the worker that runs it, at speed 2.
DEADLY = """
import os, signal
import psutil
from controller import Supervisor
from webots_mcp import MCPBridge

robot = Supervisor()
bridge = MCPBridge(robot, throttle_interval=1)
speed = bridge.parameter("speed", 1.0)
if speed.value == 2.0:
    for each in psutil.Process().parents():
        if any("distributed.cli.dask_" in word for word in each.cmdline()):
            each.kill()
while robot.step(16) != -1:
    bridge.publish({"x": speed.value})
"""


def test_a_trial_that_kills_its_workers_fails_with_that_reason(
    project: Path, plan: Write, run: Run, dask_cluster: Cluster
) -> None:
    dask_cluster.start(3)
    (project / "controllers" / "rover" / "rover.py").write_text(DEADLY)
    plan('score = "last(x)"\nfor_s = 0.3\n[grid]\nspeed = [1.0, 2.0]')

    answer = answer_of(run("--scheduler", dask_cluster.address, "--json"))

    assert [each["scores"] for each in answer["sets"]] == [[1.0], []]
    assert (
        "2 workers died while they ran it, the last one tcp://" in answer["sets"][1]["failures"][0]
    )
    assert rows(project, "SELECT count(*) FROM run") == [(1,)]
    assert len(dask_cluster.workers) == 1


def test_a_search_prunes_there_as_here_and_its_recordings_may_come_through_a_pool(
    project: Path,
    plan: Write,
    run: Run,
    refused: Callable[..., str],
    dask_cluster: Cluster,
) -> None:
    dask_cluster.start(1)
    plan(
        'score = "last(x)"\nfor_s = 0.3\nprune = "x > 2"\nsets = 2\nseed = 1\n[ranges]\n'
        "speed = { choices = [1.0, 9.0] }"
    )
    options = ("--scheduler", dask_cluster.address, "--search", "random", "--jobs", "1")

    no_pool = refused(*options, "--ship-to", str(project / "plan.toml"))
    assert re.match(r"webots-mcp: worker tcp://\S+ on \S+: .*plan\.toml", no_pool)
    answer_of(run(*options, "--ship-to", str(project / "pool"), "--json"))

    told = "SELECT status, ended_by, parameters FROM trial"
    assert set(rows(project, told)) == {
        ("done", "for_s", '{"speed": 1.0}'), ("pruned", "prune", '{"speed": 9.0}'),
    }  # fmt: skip
    counted = "SELECT count(*) > 14 FROM trial t JOIN state s USING (run_id) GROUP BY t.id"
    assert rows(project, counted) == [(1,)] * 2
    assert len(list((project / "pool").glob("recording=*"))) == 2


def test_a_recording_that_is_too_large_to_return_fails_its_trial_and_says_what_to_do(
    bridge_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(bridge_recording.parent, tmp_path / "trial")
    monkeypatch.setattr(cluster, "MOST_BYTES", 10)

    returned = packed(TrialResult(1, 1.0, None), tmp_path / "trial")

    assert (returned.recording, returned.result.run_id) == (None, None)
    assert returned.result.status == "failed"
    assert "--ship-to has it come through a pool" in (returned.result.error or "")


@pytest.mark.anyio
async def test_who_handed_them_out_may_be_ended_and_an_assistant_sees_and_cancels(
    project: Path,
    plan: Write,
    started: Callable[..., subprocess.Popen[str]],
    dask_cluster: Cluster,
) -> None:
    dask_cluster.start(1)
    address, data_dir = dask_cluster.address, project / "data"
    release = project / "release"
    (project / "controllers" / "rover" / "rover.py").write_text(WAITING)
    plan('score = "last(x)"\nuntil = "released > 0"\n[grid]\nspeed = [1.0, 2.0]')
    options = ("--scheduler", address, "--jobs", "1")
    for number, code in ((signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)):
        process = started(*options)
        wait_for(lambda: any(each.recording for each in dask_cluster.workers))
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
        assert process.returncode == code
        assert "Traceback" not in said
        wait_for(lambda: not any(each.trials for each in dask_cluster.workers))
    process = started(*options)
    wait_for(lambda: any(each.recording for each in dask_cluster.workers))
    async with Client(create_server(data_dir / "webots.db", data_dir)) as client:
        assert (await ask(client, "webots_get_trials"))["state"] == "under way"
        await ask(client, "webots_run_trials", trial_set=1, cancel=True, timeout_wall_s=60)
        _, said = await to_thread.run_sync(process.communicate)
        assert said.endswith("webots-mcp: trial set 1 stopped: it was cancelled\n")
        left = await ask(client, "webots_get_trials")
        assert left["hint"].endswith("the command 'webots-mcp trials PLAN' continues it")
        refused = await fail(client, "webots_run_trials", trial_set=1)
        assert "the command 'webots-mcp trials PLAN' continues it" in refused
    release.touch()
    _, said = started(*options).communicate(timeout=120)
    assert "2/2" in said
    assert rows(project, "SELECT count(*), count(DISTINCT uuid) FROM run") == [(2, 2)]


def test_a_scheduler_without_simulators_is_told_at_once_and_one_that_is_lost_as_well(
    project: Path,
    plan: Write,
    refused: Callable[..., str],
    started: Callable[..., subprocess.Popen[str]],
    tmp_path: Path,
) -> None:
    own = Cluster(tmp_path / "own")
    try:
        (project / "controllers" / "rover" / "rover.py").write_text(WAITING)
        plan('score = "last(x)"\nuntil = "released > 0"\n[grid]\nspeed = [1.0]')
        said = refused("--scheduler", own.address)
        assert f"'dask worker {own.address} --resources simulator=1 --nth" in said
        assert not (project / "data").exists()

        (worker,) = own.start(1)
        its_address = worker.said(r"Start worker at:\s+(tcp://\S+)")[1]
        assert f"answers at {its_address}, but a worker" in refused("--scheduler", its_address)
        process = started("--scheduler", own.address)
        wait_for(lambda: worker.recording)
        children = worker.children
        own.scheduler.end()
        _, said = process.communicate(timeout=60)
        wait_for(lambda: not any(each.is_running() for each in children))
    finally:
        own.end()

    assert process.returncode == 2
    assert (
        said == f"webots-mcp: the scheduler {own.address} was lost: what is left can be gone on "
        "with once it is back\n"
    )
    assert rows(project, "SELECT DISTINCT status FROM trial") == [("waiting",)]


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("HOST:8786", "'HOST:8786' is no address, such as tcp://HOST:8786"),
        ("tls://127.0.0.1:1", "needs certificates, of which Dask's configuration tells"),
        ("tcp://127.0.0.1:1", "no Dask scheduler answers at tcp://127.0.0.1:1"),
    ],
)
def test_what_is_no_scheduler_is_refused_before_anything_is_written(
    project: Path,
    plan: Write,
    refused: Callable[..., str],
    monkeypatch: pytest.MonkeyPatch,
    address: str,
    said: str,
) -> None:
    monkeypatch.setattr(cluster, "_TIMES", cluster.ClusterTimes(connect_s=0.5))
    plan(GRID)

    assert said in refused("--scheduler", address)
    assert not (project / "data").exists()


def test_a_server_that_is_no_scheduler_is_not_waited_for(
    plan: Write, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_TIMES", cluster.ClusterTimes(connect_s=0.5))
    plan(GRID)

    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        said = refused("--scheduler", address)

    assert said.endswith(f"answers at {address}: what listens there is something else\n")


def needs(world: Path, **other: Any) -> WorkerRequirements:
    """What a worker has to have, as its client says."""
    said: dict[str, Any] = {"version": __version__, "digest": digest_of(str(world))}
    return WorkerRequirements(world=str(world), is_stand_in=True, **(said | other))


def test_a_worker_says_what_it_lacks(project: Path) -> None:
    world = project / "worlds" / "table.wbt"

    assert missing_requirement(needs(world)) is None
    assert "it has webots-mcp" in (missing_requirement(needs(world, version="0.1")) or "")
    asked = needs(world)
    (project / "controllers" / "rover" / "rover.py").write_text("print('another')")
    assert "are not the same there" in (missing_requirement(asked) or "")
    world.unlink()
    assert f"there is no file {world}: all workers need" in (missing_requirement(asked) or "")
