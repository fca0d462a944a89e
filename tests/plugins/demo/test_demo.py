"""`webots-mcp demo`: what it prints can be read, and is enough to go on."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from webots_mcp.cli import main
from webots_mcp.errors import WebotsMCPError
from webots_mcp.plugins.demo import demo_command as demo
from webots_mcp.questions import all_questions
from webots_mcp.setup.client_entries import can_be_started, is_ours, words_of

TURNS = tuple(
    turn for turn in demo.CONVERSATION if turn[1] in ("webots_get_parameters", "webots_plot")
)
QUESTIONS = {each.name: each for each in all_questions()}
CLIENTS = (Path(__file__).parents[3] / "docs" / "clients.md").read_text("utf-8")


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What two of its questions print."""
    with redirect_stdout(StringIO()) as out:
        demo.run(tmp_path_factory.mktemp("demo"), conversation=TURNS)
    return out.getvalue()


@pytest.mark.slow
def test_answers_are_tables_for_people(printed: str) -> None:
    assert re.search(r"(?m)^ +name +value +unit +default +low +high ", printed)
    assert re.search(r"(?m)^ +speed +5 +rad/s +5 +0 +10 ", printed)
    assert '"columns"' not in printed


def test_the_plot_is_saved_where_it_says(printed: str) -> None:
    (file,) = re.findall(r"The plot is saved: (.+)", printed)
    assert Path(file).read_bytes().startswith(b"\x89PNG")


def test_the_last_lines_connect_a_client(printed: str) -> None:
    end = printed[printed.index("Connect an assistant") :]
    (entry,) = re.findall(r"(?m)^ +(\{.+\})$", end)
    server = json.loads(entry)["mcpServers"]["webots"]
    assert is_ours(server)
    assert can_be_started(server)
    (line,) = re.findall(r"(?m)^ +(claude mcp add .+)$", end)
    shown, command = re.search(r"(?m)^claude mcp add \S+ -- ", CLIENTS), words_of(server)
    assert shown is not None
    assert line == shown[0] + shlex.join(command)
    assert "webots-mcp init" in end.splitlines()[-1]


def test_the_next_step_is_a_line_that_can_be_typed(printed: str) -> None:
    (line,) = re.findall(r"(?m)^ +(.+ view --data-dir .+)$", printed)
    program, *arguments = shlex.split(line)
    assert Path(program).is_file()
    shown = subprocess.run([program, *arguments, "--help"], capture_output=True, check=True)
    assert b"webots-mcp view" in shown.stdout


def test_it_ends_with_a_drive_and_not_with_a_reset() -> None:
    """Whoever looks at the recording afterwards sees the newest run first."""
    begins_anew = [
        place
        for place, (_, tool, arguments) in enumerate(demo.CONVERSATION)
        if tool == "webots_run_trials" or arguments.get("command") == "reset"
    ]
    drives = demo.CONVERSATION[begins_anew[-1] + 1 :]
    assert sum(arguments.get("for_s", 0) for _, _, arguments in drives) >= 20


@pytest.mark.slow
def test_a_second_one_in_the_same_folder_is_refused_as_long_as_the_first_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = [sys.executable, "-m", "webots_mcp", "demo", "--keep", "--data-dir", str(tmp_path)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        try:
            assert first.stdout.readline().startswith("Running arena.wbt")
            assert main(["demo", "--data-dir", str(tmp_path)]) == 2
            said = capsys.readouterr().err
            assert "a demo is already running there" in said
            assert "view --data-dir" in said
        finally:
            first.kill()
            first.stdout.close()
    demo.run(tmp_path, conversation=TURNS)  # what was killed keeps nobody out
    assert "Next" in capsys.readouterr().out


def test_everything_that_it_asks_can_be_asked() -> None:
    for _, tool, arguments in demo.CONVERSATION:
        assert arguments.keys() <= QUESTIONS[tool].arguments.model_fields.keys()
        QUESTIONS[tool].arguments.model_validate(arguments)


@pytest.mark.slow
def test_an_answer_that_is_an_error_ends_it_with_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = (("What next?", "webots_get_robot_state", {"robot": "nobody"}), *TURNS)
    with pytest.raises(WebotsMCPError, match="answered with an error, see above"):
        demo.run(tmp_path, conversation=asked)
    assert "'nobody'" in capsys.readouterr().out.partition(asked[0][1])[2]


@pytest.mark.slow
def test_as_json_its_answers_are_one_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo.run(tmp_path, as_json=True, conversation=TURNS)
    shown = capsys.readouterr()
    told = json.loads(shown.out)
    assert told["database"] == str(tmp_path / "webots.db")
    assert [(each["tool"], bool(each["answer"])) for each in told["answers"]] == [
        (tool, True) for _, tool, _ in TURNS
    ]
    assert "Connect an assistant" in shown.err
