"""What a command answers is put in the options that a person can type."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main, names
from webots_mcp.cli.commands import app_for, described
from webots_mcp.cli.terminal import BY_TOOL, as_typed


@pytest.fixture
def data_dir(tmp_path: Path) -> Iterator[Path]:
    recording = Recorded(tmp_path / "webots.db")
    for name in ("rover", "crane"):
        recording.robot(name).state(1.5, {"last_s": 1.0, "mode": "cruise"})
    yield tmp_path
    recording.close()


@pytest.mark.parametrize(
    ("typed", "answered"),
    [
        ("trends --robot rover --last -3", "--last must be greater than 0, not -3"),
        ("trends --robot rover --start 9 --end 3", "--start 9 must be less than --end 3"),
        ("trends --robot rover --last 3 --since 0", "use --start and --end (simulation time)"),
        ("trends --robot rover --last 3 --since 0", "or --since and --until"),
        ("trends", "say which one with --robot "),
        ("trends --run 77", "no run 77: the newest runs are"),
        ("compare 77 78", "no run 77"),
        (
            "history mode --robot rover --points 5000",
            "--points must be less than or equal to 500, not 5000",
        ),
        (
            "history mode --robot rover --after 3",
            "only rows go on with --after: ask for them with --raw",
        ),
        ("step 0", "N must be greater than or equal to 1, not 0"),
        ("parameters --from-reset", "--from-reset needs what is set then: NAME=VALUE"),
        (f"tail -n {10**20} --no-follow", f"{10**20} is too large"),
        ("label --note --json", 'Invalid value "--json" for --note'),
        ("field ROVER.translation --stop", "--stop goes with a VALUE"),
        ("export -o x.zz --robot rover", "or say it with --format"),
        ("runs -n 5000", "-n must be less than or equal to 500"),
        ("events --robot rover --above 1 --below 3", "--above and --below need signals"),
        ("events --robot rover --for 3", "--for 3 needs a limit: give --above or --below"),
        ("events --robot rover --after x", "--after 'x' is not a cursor"),
        ("plot -o p.png --robot rover --width 5000", "--width 5000 must be from 400 to 2000"),
        ("plot -o p.png --robot rover --height 5", "--height 5 must be from 300 to 2000"),
        ("trends lost_s --robot rover", "'lost_s'"),
    ],
)
def test_an_error_names_what_was_typed(
    typed: str, answered: str, data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*typed.split(), "--data-dir", str(data_dir)]) == 2
    assert answered in capsys.readouterr().err


def test_a_line_for_the_controller_stays_python(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["logs", "--robot", "rover", "--data-dir", str(data_dir)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "bridge.log('text', level='info') records one" in said


def test_a_flag_that_is_to_be_turned_off_is_named_by_the_option_that_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = Recorded(tmp_path / "webots.db")
    rover = recording.robot("rover")
    for row in range(1200):
        rover.state(row * 0.1, {"front_m": None if row % 40 > 19 else 1.0})
    recording.close()
    assert main(["events", "--kind", "missing", "--data-dir", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "--one-by-one tells alike events one by one" in said


def test_a_hyphen_is_a_value_and_begins_a_condition(
    data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--data-dir", str(data_dir)]
    assert main(["label", "1", "--note", "of old", *where]) == 0
    assert main(["label", "1", "--note", "-", *where]) == 0
    assert main(["runs", "--robot", "rover", "--json", *where]) == 0
    assert "of old" not in capsys.readouterr().out.splitlines()[-1]
    assert main(["events", "--robot", "rover", "--where", "-last_s < 0", *where]) == 0


def test_an_unknown_command_is_an_error_in_json_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rums", "--json"]) == 2
    assert "rums" in json.loads(capsys.readouterr().out)["error"]


def test_a_hint_names_what_can_be_typed(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--robot", "rover", "--data-dir", str(data_dir)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "give two or more RUN ('webots-mcp runs' has them)" in said


def test_a_hint_names_commands_instead_of_tools() -> None:
    app_for(["send"])
    waits = 'webots_list_commands(what="outcome", command_id=7)'
    hint = f"wait for it with {waits}, or ask with a longer timeout_wall_s"
    assert as_typed(hint) == "wait for it with 'webots-mcp wait 7', or ask with a longer --timeout"
    assert as_typed("webots_list_commands has it") == "'webots-mcp commands' has it"


def test_a_person_is_told_of_no_server_and_no_resource(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--data-dir", str(tmp_path)]) == 2
    assert (
        "If controllers record elsewhere, give --data-dir or --database" in capsys.readouterr().err
    )
    assert "'.schema' in the sqlite3 shell" in described()["sql"].text


def test_examples_can_be_typed() -> None:
    typed = [
        line.strip()
        for command in described().values()
        for line in command.text.splitlines()
        if line.startswith("    webots-mcp ")
    ]
    assert len(typed) > 15
    for line in typed:
        _, name, *given = shlex.split(line)
        app_for([name]).parse_args([name, *given], exit_on_error=False, print_error=False)


def test_help_loses_no_word_of_a_description(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["signals", "--help"]) == 0
    assert "'*' is any text. (*)" in capsys.readouterr().out


def test_help_shows_a_default_of_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["events", "--help"]) == 0
    assert "no value for so long. (1)" in capsys.readouterr().out


def test_each_command_that_stands_for_a_tool_exists() -> None:
    assert {command.partition(" ")[0] for command in BY_TOOL.values()} <= {*names()}


def test_a_quoted_name_is_somebodys_data() -> None:
    app_for(["trends"])
    assert as_typed("no signal 'last_s'; last_s=3 is too much since the start") == (
        "no signal 'last_s'; --last 3 is too much since the start"
    )
