"""The questions of examples/queries.sql, asked of what the real bridge recorded."""

from __future__ import annotations

import re
import shutil
import sqlite3
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).parents[2] / "examples" / "queries.sql"
_, *QUESTIONS = re.split(r"(?m)^-- (?=\d+\. )", FILE.read_text("utf-8"))
VIEW = re.search(r"^CREATE TEMP VIEW .*?;", FILE.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def shell(bridge_recording: Path) -> Iterator[sqlite3.Connection]:
    """As a person opens it; `PRAGMA query_only` would forbid the temporary view."""
    with closing(sqlite3.connect(f"{bridge_recording.as_uri()}?mode=ro", uri=True)) as connection:
        yield connection


def ask(connection: sqlite3.Connection, number: int) -> list[dict[str, Any]]:
    assert VIEW is not None
    connection.execute(VIEW[0])
    sql = "\n".join(line for line in QUESTIONS[number - 1].splitlines()[1:] if line[:2] != "--")
    try:
        found = connection.execute(sql)
    except sqlite3.OperationalError as error:
        if "no such function: sqrt" in str(error):
            pytest.skip(f"this SQLite {sqlite3.sqlite_version} has no math functions")
        raise
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found.fetchall()]


def test_there_are_fifteen_numbered_questions_each_with_an_example() -> None:
    assert [int(question.split(".")[0]) for question in QUESTIONS] == list(range(1, 16))
    assert all("\n-- Example:\n" in question for question in QUESTIONS)


@pytest.mark.parametrize("number", range(1, 16), ids=[q.splitlines()[0] for q in QUESTIONS])
def test_each_question_has_an_answer(shell: sqlite3.Connection, number: int) -> None:
    assert ask(shell, number)


def test_the_answers_are_what_the_robot_did(shell: sqlite3.Connection) -> None:
    modes = {row["mode"]: row["total_s"] for row in ask(shell, 4)}
    assert modes == pytest.approx({"cruise": 8.0, "back_up": 1.0, "turn": 3.0}, abs=0.1)
    assert [row["action"] for row in ask(shell, 7)] == ["grasp"]
    gap = ask(shell, 9)
    assert [row["gap_s"] for row in gap] == [pytest.approx(1.5, abs=0.1)]
    silent = ask(shell, 15)[0]
    assert (silent["path"], silent["was"]) == ("front_m", "nan")
    assert (silent["from_s"], silent["to_s"]) == pytest.approx((10.0, 11.0), abs=0.05)
    assert [row["run_id"] for row in ask(shell, 13)] == [2, 1]


def test_the_sqlite3_shell_answers_all_of_them_in_one_go(bridge_recording: Path) -> None:
    program = shutil.which("sqlite3")
    if program is None:
        pytest.skip("there is no sqlite3 shell here")
    line = [program, "-readonly", "-bail", str(bridge_recording)]
    done = subprocess.run(
        line, input=FILE.read_bytes(), capture_output=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert len(done.stdout.splitlines()) > 15
