"""`webots-mcp pool` and `fetch`: what a person reads of a pool, and of what came from it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.pool.lab import IN_EACH_POOL, Lab
from tests.recordings.runs import Recorded
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME

Ask = Callable[..., Any]


@pytest.fixture
def ask(lab: Lab, runs: Recorded, capsys: pytest.CaptureFixture[str]) -> Ask:
    """Runs a command on a pool of Parquet files, and gives what it prints."""
    lab.ship(runs.folder / DATABASE_NAME)

    def run(*words: str, code: int = 0) -> str:
        url = [lab.url if word == "POOL" else word for word in words]
        assert main(url) == code
        said = capsys.readouterr()
        return said.err if code == 2 else said.out

    return run


def test_robots_runs_and_trial_sets_are_listed(ask: Ask) -> None:
    answer, *table = ask("pool", "POOL").splitlines()
    robots = [line.split()[:4] for line in table]
    assert answer.startswith("2 robots in ")
    assert robots[0] == ["robot", "recordings", "runs", "rows"]
    assert sorted(robots[1:]) == [["drone", "1", "1", "4"], ["rover", "1", "2", "16"]]
    assert "wall 1" in ask("pool", "POOL", "runs", "--robot", "rover")
    assert "wall 3" not in ask("pool", "POOL", "runs", "--robot", "rover")
    assert "the first 1 of which are shown (-n shows more)" in ask("pool", "POOL", "-n", "1")
    assert ask("pool", "POOL", "trials").splitlines()[2].split()[3:5] == ["3", "2"]


def test_programs_read_json(ask: Ask, runs: Recorded) -> None:
    found = json.loads(ask("pool", "POOL", "runs", "--label", "wall 2", "--json"))
    (run,) = found["runs"]
    (uuid,) = runs.connection.execute("SELECT uuid FROM run WHERE id = 2").fetchone()
    assert (run["uuid"], run["row_count"], found["total"]) == (uuid, 6, 1)
    assert json.loads(ask("pool", "POOL", "trials", "--json"))["total"] == 1


@pytest.mark.slow
def test_a_select_is_answered_with_its_first_rows(ask: Ask) -> None:
    query = ("--sql", "SELECT label, NULL AS empty FROM run ORDER BY label")
    said = ask("pool", "POOL", *query, "-n", "2").splitlines()
    assert [line.split() for line in said[:3]] == [
        ["label", "empty"], ["wall", "1", "NULL"], ["wall", "2", "NULL"],
    ]  # fmt: skip
    assert said[3].startswith("note: only the first 2 rows; narrow the question")
    answer = json.loads(ask("pool", "POOL", *query, "--json"))
    assert (answer["columns"], len(answer["rows"])) == (["label", "empty"], 3)


@pytest.mark.slow
@IN_EACH_POOL
def test_an_answer_has_the_limits_of_sql_and_is_json_for_strict_readers(ask: Ask) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    floats = ", ".join(f"CAST('{each}' AS FLOAT8)" for each in ("NaN", "Infinity", "-Infinity"))
    query = f"SELECT repeat('x', 1000000), {floats}, 2.50, CAST('x' AS BYTEA), true, NULL"
    said = ask("pool", "POOL", "--json", "--sql", query)
    answer = json.loads(said, parse_constant=refuse)
    assert answer["rows"] == [
        ["x" * 200 + "... (1000000 characters)", "nan", "inf", "-inf", 2.5, "<blob of 1 bytes>",
         True, None]
    ]  # fmt: skip
    assert answer["shortened"] == 1
    texts = "SELECT repeat('x', 190) FROM generate_series(1, 900) AS many"
    shown = ask("pool", "POOL", "-n", "1000", "--sql", texts)
    assert len(shown) < 30_000
    assert "their values are too long" in shown
    assert "must be from 1 to 1000" in ask("pool", "POOL", "-n", "1001", "--sql", texts, code=2)
    columns = ", ".join(f"{number} AS c{number}" for number in range(101))
    assert "name at most 100" in ask("pool", "POOL", "--sql", f"SELECT {columns}", code=2)


def test_what_came_is_said_and_what_is_missing_of_it(ask: Ask, lab: Lab) -> None:
    words = ("fetch", "--from", "POOL", "--data-dir", str(lab.here), "--robot", "rover")
    assert ask(*words).splitlines() == [
        f"Fetched runs 1 to 2 from {lab.url}.",
        "Only chunks were shipped of runs 1 to 2, and no states. To ship states use 'webots-mcp "
        "ship --full'.",
    ]
    assert ask(*words).splitlines()[1] == "Already in this recording: runs 1 to 2."
    told = json.loads(ask(*words, "--json"))
    assert (told["fetched_run_ids"], told["known_run_ids"]) == ([], [1, 2])
    assert told["not_taken"] == {"going_on": [], "not_wholly_shipped": []}


def test_what_is_not_there_is_refused_with_what_is_and_makes_no_recording(
    ask: Ask, tmp_path: Path
) -> None:
    words = ("fetch", "--from", "POOL", "--data-dir", str(tmp_path / "new"))
    assert "nearest are 'rover'" in ask(*words, "--robot", "rovr", code=2)
    assert "which runs?" in ask(*words, code=2)
    assert not (tmp_path / "new").exists()


def test_a_select_that_is_no_text_is_refused_in_one_line(ask: Ask) -> None:
    said = ask("pool", "POOL", "--sql", "SELECT '\udcff'", code=2)
    assert "cannot be written as utf-8" in said
    assert said.count("\n") == 1
