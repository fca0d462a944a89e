"""The commands about the past, on a recording whose story is known."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from tests.server.story import write_story
from webots_mcp.cli import main
from webots_mcp.cli.terminal import print_table

Say = Callable[..., str]


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_story(tmp_path_factory.mktemp("story") / "webots.db")


@pytest.fixture
def say(story: Path, capsys: pytest.CaptureFixture[str]) -> Say:
    """What a command prints when it succeeds."""

    def said(*arguments: str) -> str:
        assert main([*arguments, "--database", str(story)]) == 0
        return capsys.readouterr().out

    return said


def line_with(text: str, *words: str) -> str:
    lines = [line for line in text.splitlines() if all(word in line for word in words)]
    assert len(lines) == 1, (words, text)
    return lines[0]


def test_runs_tells_how_each_ended(say: Say) -> None:
    text = say("runs")
    assert line_with(text, "robot rover", "controller rover.py")
    assert "finished" in line_with(text, "  3  2023")
    assert "crashed" in line_with(text, "  2  2023")
    assert "log warning 1" in line_with(text, "  1  2023", "reset")
    assert "total 3, cursor 3" in say("runs", "-n", "1")


def test_history_has_a_row_per_bucket_and_names_the_gap(say: Say) -> None:
    text = say("history", "pose.0", "mode", "--run", "1", "--points", "8")
    assert "step_s 15" in text
    assert line_with(text, "pose.0 mean", "min", "max")
    assert line_with(text, "   52  back_up")
    assert "gaps [[89.9, 95.0]]" in text


def test_history_of_few_rows_shows_the_rows(say: Say) -> None:
    text = say("history", "pose.0", "--last", "0.3")
    assert line_with(text, "59.9", "17.97")
    assert "mean" not in text


def test_trends_say_what_each_signal_did(say: Say) -> None:
    text = say("trends", "--run", "1")
    assert "period 2 s" in line_with(text, "heading")
    assert "cruise 76.9, avoid 35" in line_with(text, "mode")
    assert "7 of 9 numbers" in say("trends", "--run", "1", "-n", "2")


def test_events_tell_since_when_it_was_stuck(say: Say) -> None:
    text = say("events", "--run", "1", "--kind", "stuck", "--kind", "gap")
    assert "mode cruise" in line_with(text, "stuck", "40")
    assert line_with(text, "gap", "89.9")
    beyond = say("events", "--run", "1", "--signal", "pose.0", "--above", "7.9", "--for", "2")
    assert beyond.count("  threshold  ") == 2
    held = say("events", "--run", "1", "--where", "pose.0 > 7.9 and displacement(3) < 0.01")
    assert line_with(held, "condition", "43", "9.1")
    assert "nearest: stuck smallest movement" in say("events", "--kind", "stuck")


def test_compare_says_what_differs(say: Say) -> None:
    assert line_with(say("compare"), "commanded_m_s", "0.2", "0.3")
    assert line_with(say("compare"), "mean_speed_m_s", "0.2", "0.3")
    text = say("compare", "1", "3")
    assert line_with(text, "signal", "mean", "effect") and line_with(text, "  run 3  [3]")


def test_compare_says_how_runs_ended_with_which_code_and_what_only_some_of_them_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    published = {"arm": {"grip": 1.0, "reach": 2.0}, "rover": {"speed": 3.0}}
    for name, reason in zip(published, ("finished", "crashed"), strict=True):
        robot = recorded.robot(name)
        for step in range(60):
            robot.state(step / 10, published[name])
        robot.end_run(reason)
    recorded.close()
    assert main(["compare", "1", "2", "--data-dir", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert line_with(said, "sha256 aaaaaaaa")
    assert line_with(said, "run 1 ", "finished")
    assert line_with(said, "run 2 ", "crashed")
    assert line_with(said, '["run 1"]', '["run 2"]')
    assert "differences:" not in said


def test_json_names_the_fields_of_what_it_has(say: Say) -> None:
    run = json.loads(say("trends", "pose.0", "--run", "3", "--json"))["runs"][0]
    assert (run["row_count"], run["numbers"]["columns"][0]) == (600, "signal")
    measures = json.loads(say("compare", "1", "3", "--json"))["measures"]
    assert measures["columns"][:2] == ["name", "median"]


def test_a_picture_and_the_lines_of_a_tail_are_json_objects(say: Say, tmp_path: Path) -> None:
    drawn = json.loads(say("plot", "pose.0", "--run", "1", "-o", str(tmp_path / "a.png"), "--json"))
    assert drawn["file"] == str(tmp_path / "a.png")
    assert "pose.0" in drawn["caption"]
    lines = say("tail", "-n", "3", "--no-follow", "--json").splitlines()
    assert [set(json.loads(line)) for line in lines] == [
        {"wall_time_s", "robot", "run_id", "sim_time_s", "kind", "text"}
    ] * 3


@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml")])
def test_plot_writes_a_picture(say: Say, tmp_path: Path, name: str, start: bytes) -> None:
    file = tmp_path / name
    assert str(file) in say("plot", "pose.0", "--run", "1", "-o", str(file))
    assert sys.platform == "win32" or stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_bytes().startswith(start)


@pytest.mark.parametrize(
    "typed",
    ["--runs 1 3 pose.0 -o {}", "-o {} --runs 1 3 pose.0", "pose.0 -o {} --runs 1 3"],
)
def test_a_plot_of_runs_takes_its_signal_wherever_it_stands(
    say: Say, tmp_path: Path, typed: str
) -> None:
    said = say("plot", *typed.format(tmp_path / "a.png").split())
    assert "pose.0" in said and "run 1" in said and "run 3" in said


def test_options_may_stand_between_arguments(say: Say) -> None:
    text = say("trends", "pose.0", "--run", "1", "battery_v")
    assert line_with(text, "pose.0") and line_with(text, "battery_v")
    answers = [say("compare", *typed.split()) for typed in ("1 -n 3 3", "1 3 -n 3")]
    first, second = (answer.partition("\n")[2] for answer in answers)  # below how old it is
    assert first == second


@pytest.mark.parametrize("command", ["runs", "trends", "events", "compare", "history mode"])
def test_json_is_one_object_for_other_programs(say: Say, command: str) -> None:
    answer = json.loads(say(*command.split(), "--json"))
    assert isinstance(answer, dict)
    assert answer


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("history moed", "mode"),
        ("history mode --points 9999999", "less than or equal to 500"),
        ("history mode --run 99", "newest runs are [3, 2, 1]"),
        ("trends --robot rovr", "did you mean 'rover'"),
        ("trends --start 9 --end 3", "reversed"),
        ("trends --start 3 --last 3", "two ways"),
        ("events --kind explosion", "--kind must be one of"),
        ("events --above 3", "need signals"),
        ("compare 1 1", "1 to 10"),
        ("runs -n 501", "-n must be less than or equal to 500, not 501"),
        ("plot -o a.gif", ".png or .svg"),
        ("plot -o /no/such/folder/a.png", "cannot be written"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    story: Path, capsys: pytest.CaptureFixture[str], arguments: str, words: str
) -> None:
    assert main([*arguments.split(), "--database", str(story)]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1


@pytest.mark.parametrize("name", ["events", "runs", "tail"])
@pytest.mark.parametrize("number", ["-1", "1.5", "many"])
def test_a_count_that_is_none_is_refused_with_its_option_and_its_value(
    capsys: pytest.CaptureFixture[str], name: str, number: str
) -> None:
    assert main([name, "-n", number]) == 2
    said = capsys.readouterr().err
    assert "-n" in said
    assert number in said


@pytest.mark.parametrize("asked", ["report {}", "export --run {}", "plot -o a.png --run {}"])
@pytest.mark.parametrize("number", [str(2**63), "1.5", "x"])
def test_an_id_that_no_row_can_have_is_refused(
    capsys: pytest.CaptureFixture[str], asked: str, number: str
) -> None:
    assert main(asked.format(number).split()) == 2
    assert f"'{number}' is no id" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["compare 1 {}", "label {} x", "trends --run {}", "wait {}"])
@pytest.mark.parametrize("number", [str(2**63), "1.5", "x"])
def test_an_id_that_no_row_can_have_is_named(
    capsys: pytest.CaptureFixture[str], say: Say, story: Path, asked: str, number: str
) -> None:
    assert main([*asked.format(number).split(), "--database", str(story)]) == 2
    assert number in capsys.readouterr().err


def test_what_a_terminal_would_obey_is_spelled_out(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("name", "empty"), [["red \x1b[31m alarm", None], ["two\nlines", None]])
    assert capsys.readouterr().out == "name\nred \\x1b[31m alarm\ntwo\\nlines\n"


def test_questions_load_neither_the_server_nor_what_draws(story: Path) -> None:
    program = (
        "import sys\nfrom webots_mcp.cli import main\n"
        f"main(['trends', '--database', {str(story)!r}])\n"
        "print({'mcp', 'resvg_py', 'sqlmodel'} & set(sys.modules), file=sys.stderr)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.stderr.strip() == "set()"
