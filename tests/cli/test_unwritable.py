"""A recording that cannot be written (a CI artifact, a read-only mount, a colleague's folder)."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcp import Client, StdioServerParameters

from tests import unprivileged
from tests.recordings.rows import Recorded
from tests.server.conftest import ask, fail
from webots_mcp.contract import new_uuid
from webots_mcp.database.waiting_file import waiting_path

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.skipif(not unprivileged.POSSIBLE, reason="permissions do not stop this user here"),
]
SAID = "the file cannot be written from here"
# Each command line of its own program would start Python a dozen times.
MAIN = """
import json, sys
from webots_mcp.cli import main
for arguments in json.loads(sys.argv[1]):
    print(arguments[0], main(arguments))
"""


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "artifact" / "webots.db")
    robot = recording.robot(now=1_700_000_000.0)
    for step in range(50):
        robot.state(step / 10, {"x": step, "mode": "cruise"})
    robot.end_run("finished")
    robot.begin_run("reset")
    robot.state(0.1, {"x": 49})
    yield recording
    recording.close()


@pytest.fixture
def artifact(recorded: Recorded) -> Iterator[Path]:
    """The file of a finished recording in a folder that cannot be written."""
    assert isinstance(recorded.database, Path)
    recorded.close()
    with unprivileged.unwritable(recorded.database.parent):
        yield recorded.database


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    line = unprivileged.line(*arguments)
    return subprocess.run(line, capture_output=True, text=True, check=False)


def serve(file: Path, *options: str) -> StdioServerParameters:
    line = unprivileged.line("-m", "webots_mcp", "serve", "--database", str(file), *options)
    return StdioServerParameters(command=line[0], args=line[1:], env=dict(os.environ))


def test_the_permissions_stop_the_process_of_these_tests(artifact: Path) -> None:
    ended = run("-c", f"open({str(artifact.with_name('new'))!r}, 'w')")
    assert "PermissionError" in ended.stderr


@pytest.mark.slow
def test_every_command_that_reads_reads_it_and_says_how(artifact: Path, tmp_path: Path) -> None:
    commands = [
        ["status"],
        ["runs"],
        ["history", "x"],
        ["trends"],
        ["events"],
        ["compare", "1", "2"],
        ["export", "--run", "1", "-o", str(tmp_path / "x.csv")],
        ["plot", "x", "-o", str(tmp_path / "x.png")],
        ["tail"],
        ["prune", "--dry-run"],
    ]
    lines = [[name, "--database", str(artifact), *rest] for name, *rest in commands]
    ended = run("-c", MAIN, json.dumps(lines))
    for name, *_ in commands:
        assert f"{name} 0\n" in ended.stdout, ended.stderr
    assert (ended.stdout + ended.stderr).count(SAID) == len(commands)
    assert (tmp_path / "x.csv").read_text().count("\n") == 51


@pytest.mark.slow
async def test_what_waits_beside_it_is_said_not_to_be_in_it(recorded: Recorded) -> None:
    """Rows of a bridge that was killed, and the journal of a controller in C."""
    assert isinstance(recorded.database, Path)
    recorded.close()
    waiting_path(recorded.database, new_uuid()).touch()
    journal = waiting_path(recorded.database, new_uuid())
    journal.with_name(f"{journal.stem}-0001{journal.suffix}").touch()
    with unprivileged.unwritable(recorded.database.parent):
        ended = run("-m", "webots_mcp", "runs", "--database", str(recorded.database))
        async with Client(serve(recorded.database, "--read-only")) as client:
            answer = await ask(client, "webots_get_robot_state")
    assert ended.returncode == 0
    for said in (ended.stdout, answer["storage"]):
        assert "without the rows in 2 waiting files" in said


@pytest.mark.slow
async def test_a_read_only_server_answers_from_it_and_says_how(artifact: Path) -> None:
    async with Client(serve(artifact, "--read-only")) as client:
        for tool, arguments in (
            ("webots_get_robot_state", {}),
            ("webots_list_robots", {}),
            ("webots_list_runs", {}),
            ("webots_query_history", {"signals": ["x"]}),
            ("webots_list_commands", {}),
            ("webots_query_sql", {"sql": "SELECT count(*) FROM state"}),
        ):
            answer = await ask(client, tool, **arguments)
            assert answer["storage"].startswith(SAID), tool
        assert answer["result"]["rows"] == [[51]]


@pytest.mark.slow
async def test_a_server_that_wants_to_write_to_it_names_the_one_that_does_not(
    artifact: Path,
) -> None:
    async with Client(serve(artifact)) as client:
        assert (await ask(client, "webots_get_robot_state"))["state"]["x"] == 49
        said = await fail(client, "webots_annotate_run", label="good")
    assert "cannot be written" in said
    assert "--read-only" in said


def test_a_recording_with_a_log_beside_it_is_never_read_without_that_log(
    recorded: Recorded,
) -> None:
    assert isinstance(recorded.database, Path)
    log = recorded.database.with_name("webots.db-wal")
    index = recorded.database.with_name("webots.db-shm")
    assert log.stat().st_size > 0
    kept = index.read_bytes()
    index.unlink()  # as an artifact of a killed robot comes without it
    try:
        with unprivileged.unwritable(recorded.database.parent):
            ended = run("-m", "webots_mcp", "status", "--database", str(recorded.database))
    finally:
        index.write_bytes(kept)
    assert ended.returncode == 2
    assert "copy both to a folder of your own" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("command", ["status", "tail"])
def test_a_folder_that_cannot_be_looked_into_is_said_to_be_one(
    recorded: Recorded, command: str
) -> None:
    assert isinstance(recorded.database, Path)
    folder = recorded.database.parent
    folder.chmod(0)
    try:
        ended = run("-m", "webots_mcp", command, "--database", str(recorded.database))
    finally:
        folder.chmod(0o700)
    assert ended.returncode == 2
    assert "cannot be checked" in ended.stderr
    assert "Traceback" not in ended.stderr
