"""The commands that list what a recording holds, and the one that labels a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.cli.test_history_commands import line_with
from tests.recordings.rows import Recorded
from tests.server.story import copy_of, write_story
from webots_mcp.cli import main

Say = Callable[..., str]


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_story(tmp_path_factory.mktemp("story") / "webots.db")


@pytest.fixture
def say(story: Path, capsys: pytest.CaptureFixture[str]) -> Say:
    """What a command prints when it succeeds."""

    def said(*arguments: str, database: Path = story) -> str:
        assert main([*arguments, "--database", str(database)]) == 0
        return capsys.readouterr().out

    return said


def test_signals_have_their_kind_and_range(say: Say) -> None:
    assert "num" in line_with(say("signals", "--run", "1"), "pose.0 ", "12.78")
    some = say("signals", "po*", "--run", "1")
    assert "pose.0" in some
    assert "mode" not in some
    assert "1 of 15: go on with --after" in say("signals", "-n", "1")
    told = json.loads(say("signals", "pose.0", "--run", "1", "--json"))
    assert [row[:2] for row in told["signals"]["rows"]] == [["pose.0", "num"]]


def test_logs_are_those_of_all_runs_or_of_a_range(tmp_path: Path, say: Say) -> None:
    recording = Recorded(tmp_path / "webots.db")
    robot = recording.robot("rover")
    robot.state(1.0, {"x": 1})
    robot.log(1.0, "begun")
    robot.log(2.0, "battery low", level="warning")
    robot.end_run("reset")
    robot.begin_run("reset")
    robot.state(5.0, {"x": 1})
    robot.log(1.0, "begun again")
    robot.log(4.5, "wheel lost", level="error")
    recording.close()
    database = tmp_path / "webots.db"

    def lines(*arguments: str) -> list[str]:
        told = json.loads(say("logs", *arguments, "--json", database=database))
        rows = told["lines"]["rows"]
        return [dict(zip(told["lines"]["columns"], row, strict=True))["message"] for row in rows]

    assert lines() == ["begun", "battery low", "begun again", "wheel lost"]
    assert lines("--level", "warning") == ["battery low", "wheel lost"]
    assert lines("--run", "1") == ["begun", "battery low"]
    assert lines("--last", "1") == ["wheel lost"]
    assert lines("--end", "2") == ["begun again"]
    assert lines("--text", "BEGUN", "-n", "1") == ["begun again"]
    table = say("logs", "-n", "1", database=database)
    assert line_with(table, "4.5", "error", "2", "wheel lost")
    assert "the newest 1 of 4: ask again with --before for older ones" in table
    told = json.loads(say("logs", "-n", "2", "--json", database=database))
    assert lines("--before", str(told["cursor"])) == ["begun", "battery low"]
    assert "no line matches" in say("logs", "--text", "fire", database=database)


def test_a_person_reads_log_lines_whole_and_as_many_as_were_asked_for(
    tmp_path: Path, say: Say
) -> None:
    recording = Recorded(tmp_path / "webots.db")
    robot = recording.robot("rover")
    for number in range(100):
        robot.log(1.0, "x" * 1000 + f"end {number}")
    recording.close()
    told = json.loads(say("logs", "-n", "100", "--json", database=tmp_path / "webots.db"))
    assert [row[-1][1000:] for row in told["lines"]["rows"]] == [f"end {n}" for n in range(100)]


def test_sql_reads_and_a_null_is_seen(say: Say) -> None:
    table = say("sql", "SELECT id, label, 1e999 AS big FROM run ORDER BY id")
    assert line_with(table, "id", "label", "big")
    assert line_with(table, "1", "NULL", "inf")
    assert "only the first 1 rows" in say("sql", "SELECT id FROM run", "-n", "1")
    told = json.loads(say("sql", "SELECT 1e999, 'a'", "--json"))
    assert told["result"]["rows"] == [["inf", "a"]]
    assert "no row" in say("sql", "SELECT id FROM run WHERE id > 99")


def test_a_label_is_given_shown_and_taken_away(story: Path, tmp_path: Path, say: Say) -> None:
    database = copy_of(story, tmp_path / "webots.db")
    given = say("label", "2", "kp 3", "--note", "on ice", database=database)
    assert "run_id 2, robot rover, label kp 3" in given and "note on ice" in given
    assert line_with(say("runs", database=database), "  2  kp 3", "on ice")
    told = json.loads(say("label", "2", "-", "--json", database=database))
    assert (told["run"].get("label"), told["run"]["note"]) == (None, "on ice")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["signals", "moed"], "mode"),
        (["signals", "--run", "99"], "newest runs are [3, 2, 1]"),
        (["logs", "--last", "-3"], "--last must be greater than 0, not -3.0"),
        (["logs", "--start", "9", "--end", "3"], "reversed"),
        (["logs", "--robot", "rovr"], "did you mean 'rover'"),
        (["sql", "DELETE FROM run"], "only one reading statement"),
        (["sql", "WITH a AS (SELECT 1) DELETE FROM run"], "only reading is allowed"),
        (["sql", "SELECT lable FROM run"], "label"),
        (["sql", "SELECT 1", "-n", "5000"], "-n must be less than or equal to 500, not 5000"),
        (["label", "1"], "give a label or a note"),
        (["label", "99", "x"], "newest runs are"),
        (["label", "1", "x" * 101], "at most 100"),
        (["label", "1", "\udcff"], "TEXT must be a valid string"),
        (["logs", "--text", "\udcff"], "--text must be a valid string"),
        (["logs", "--follow", "--before", "3"], "leave out --before"),
        (["logs", "--level", "loud"], "--level"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    story: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    assert main([*arguments, "--database", str(story)]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
