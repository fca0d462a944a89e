"""New code on an old run: by the command line, an assistant and pytest, where it is allowed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from mcp import Client

from tests.rerun.taping import (
    AVOID,
    WORLD,
    data_dir_of,
    project,
    record,
    recorded,
    rerun_of,
    taped_run,
)
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import NotAllowedError
from webots_mcp.questions.declaration import Caller
from webots_mcp.questions.rerun_controller import require_rerun
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import OpenRequest, Requester
from webots_mcp.testing import assert_same_commands

pytestmark = pytest.mark.slow

EDITED = AVOID.replace("NEAR_M = 0.35", "NEAR_M = 0.45")


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a run on tape, whose controller was edited since."""
    folder = tmp_path_factory.mktemp("edited")
    recorded(folder).write_text(EDITED, "utf-8")
    return folder


def ask(folder: Path, *words: str) -> list[str]:
    return ["rerun", *words, "--data-dir", str(data_dir_of(folder))]


def test_the_command_names_time_command_and_line(
    edited: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(ask(edited)) in (0, None)
    said = capsys.readouterr().out
    assert "; then left wheel motor.setVelocity -3.0 instead of 5.0;" in said
    line = EDITED.splitlines().index("    elif min(left_m, right_m) < NEAR_M:") + 1
    assert f"decided at controllers/rover/rover.py:{line}" in " ".join(said.split())


def test_its_json_has_the_values_on_the_line_in_both_versions(
    edited: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(ask(edited, "1", "--json"))
    answer = json.loads(capsys.readouterr().out)
    line = answer["deciding_line"]
    assert line["text"] == "elif min(left_m, right_m) < NEAR_M:"
    assert (line["old_values"]["NEAR_M"], line["new_values"]["NEAR_M"]) == ("0.35", "0.45")
    assert line["old_values"]["left_m"] == line["new_values"]["left_m"]
    assert answer["comparison"] == "differs"


@pytest.mark.anyio
async def test_an_assistant_gets_the_same_from_a_tool_that_is_not_listed(edited: Path) -> None:
    data_dir = data_dir_of(edited)
    server = create_server(data_dir / DATABASE_NAME, data_dir)
    async with Client(server) as client:
        listed = {each.name for each in (await client.list_tools()).tools}
        assert "webots_rerun_controller" not in listed
        result = await client.call_tool("webots_rerun_controller", {"run_id": 1, "until_s": 1.0})
    assert result.structured_content is not None
    assert result.structured_content["comparison"] == "equal"


def test_a_debugger_begins_at_a_moment_of_the_old_run(edited: Path) -> None:
    command = [sys.executable, "-m", "webots_mcp", *ask(edited, "1", "--pdb", "--break-at", "1.0")]
    lines = "n\np round(robot.getTime(), 3), turning\nc\n"
    said = subprocess.run(command, input=lines, capture_output=True, text=True, check=False)
    assert "rover.py(" in said.stdout
    assert "(1.008, 0)" in said.stdout


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("1", "nowhere.py"), "There is no file"),
        (("1", "worlds/arena.wbt"), "is not Python"),
        (("1", __file__), "lies outside of the project"),
        (("99",), "There is no run 99"),
        (("1", "--break-at", "1"), "--break-at applies only to --pdb"),
    ],
)
def test_what_cannot_be_run_is_refused(
    edited: Path, words: tuple[str, ...], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(edited / each) if each.startswith("worlds") else each for each in words]
    assert main(ask(edited, *given)) != 0
    assert why in " ".join(capsys.readouterr().err.split())


def test_a_rule_forbids_it_and_a_client_over_http_needs_one_that_names_it(edited: Path) -> None:
    data_dir = data_dir_of(edited)
    recording = RecordingAccess(data_dir / DATABASE_NAME, data_dir)
    rules = edited / "webots-mcp.toml"

    def ask_by(transport: str) -> None:
        by = Requester("an assistant", "1", transport)
        asker = Caller("mcp", None, None, by)  # type: ignore[arg-type]
        with OpenRequest(recording, by, ["webots_rerun_controller"], {}):
            require_rerun(recording, asker, None)

    ask_by("stdio")
    with pytest.raises(NotAllowedError, match="HTTP"):
        ask_by("http")
    rules.write_text('[allow]\nactions = ["*"]\n', "utf-8")
    with pytest.raises(NotAllowedError, match="HTTP"):
        ask_by("http")
    rules.write_text('[allow]\nactions = ["*", "rerun"]\n', "utf-8")
    ask_by("http")
    rules.write_text('[allow]\nactions = ["*", "!rerun"]\n', "utf-8")
    with pytest.raises(NotAllowedError, match="line 2"):
        ask_by("stdio")
    rules.unlink()


def test_pytest_asserts_that_a_controller_commands_the_same(edited: Path, tmp_path: Path) -> None:
    bundle = tmp_path / "run.zip"
    main(["export", "--run", "1", "-o", str(bundle), "--data-dir", str(data_dir_of(edited))])
    controller = edited / "controllers" / "rover" / "rover.py"
    with pytest.raises(AssertionError, match=r"setVelocity -3.0 instead of 5.0.*decided at"):
        assert_same_commands(bundle, controller)
    assert assert_same_commands(bundle, controller, until_s=1.0).rounds > 60
    old = tmp_path / "rover.py"
    old.write_text(AVOID, "utf-8")
    assert assert_same_commands(bundle, old).is_unchanged
    assert assert_same_commands(data_dir_of(edited), old).of_rounds == 501


def test_a_line_in_the_projects_file_turns_the_tape_on(tmp_path: Path) -> None:
    project(tmp_path)
    (tmp_path / "webots-mcp.toml").write_text("tape = true\n\n[allow]\nlaunch = true\n", "utf-8")
    record(tmp_path / "worlds" / WORLD.name, data_dir_of(tmp_path), 1.0, tape="")
    assert not taped_run(tmp_path).tape.head["began_late"]


def test_attach_with_a_tape_records_from_there_on(tmp_path: Path) -> None:
    code = AVOID.replace("attach(robot)", "attach(robot, tape=True)")
    controller = recorded(tmp_path, code, tape="")
    taped = taped_run(tmp_path)
    assert taped.tape.head["began_late"]
    controller.write_text(code.replace("NEAR_M = 0.35", "NEAR_M = 0.45"), "utf-8")
    assert rerun_of(tmp_path, controller).outcome == "differs"
    controller.write_text(code, "utf-8")
    assert rerun_of(tmp_path, controller).outcome == "equal"


def test_init_writes_a_first_test_that_passes_until_the_controller_changes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = recorded(tmp_path, duration_s=6.0)
    assert main(["init", str(tmp_path), "--tests"]) in (0, None)
    assert "test_same_commands.py" in capsys.readouterr().out
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"]

    def test() -> subprocess.CompletedProcess[str]:
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert "1 passed" in test().stdout
    controller.write_text(EDITED, "utf-8")
    failed = test().stdout
    assert "1 failed" in failed
    assert "instead of 5.0" in failed
    main(["init", str(tmp_path), "--tests"])
    assert "unchanged" in capsys.readouterr().out


def test_launching_with_a_tape_records_one(tmp_path: Path) -> None:
    ends = "while robot.getTime() < 1.0:\n    robot.step(step_ms)"
    code = AVOID.replace("while robot.step(step_ms) != -1:", ends)
    project(tmp_path, code)
    world = str(tmp_path / "worlds" / WORLD.name)
    command = [sys.executable, "-m", "webots_mcp", "launch", world, "--stand-in", "--mode", "fast"]
    subprocess.run([*command, "--tape"], cwd=tmp_path, capture_output=True, check=True)
    taped = taped_run(tmp_path)
    assert not taped.tape.head["images"]
    subprocess.run([*command, "--tape-images"], cwd=tmp_path, capture_output=True, check=True)
    assert taped_run(tmp_path).tape.head["images"]
