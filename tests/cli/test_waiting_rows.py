"""Commands where no server runs ingest what controllers left, or say how many rows are missing."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main
from webots_mcp.database.waiting_file import FORMAT, waiting_path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a state in the database, and 3 in the file of a controller that was killed."""
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    robot.state(0.1, {"n": 0})
    robot.end_run("crashed")
    recorded.close()
    with closing(sqlite3.connect(tmp_path / "webots.db")) as connection:
        session, run = (
            "5f0d1f6e-3a52-4d8e-9c2b-0a1b2c3d4e5f",
            "11111111-2222-4333-8444-555555555555",
        )
        connection.execute("UPDATE session SET uuid = ?", (session,))
        connection.execute("UPDATE run SET uuid = ?", (run,))
        connection.commit()
    described = {"robot": {"name": "rover"}, "session": {"uuid": session}}
    states = [
        [number, "state", run, [number / 10, 1000.0 + number, json.dumps({"n": number}), None]]
        for number in (1001, 1002, 1003)
    ]
    lines = ({"webots_mcp_waiting": FORMAT, **described}, *states)
    waiting_path(tmp_path / "webots.db", session).write_text(
        "".join(f"{json.dumps(line)}\n" for line in lines)
    )
    return tmp_path


def test_an_export_has_the_rows_that_waited(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "-o", str(folder / "a.jsonl"), "--data-dir", str(folder)]) == 0
    rows = (folder / "a.jsonl").read_text().splitlines()
    assert len(rows) == 4
    assert [*folder.glob("*waiting*")] == []
    assert "are not in this answer" not in "".join(capsys.readouterr())


@pytest.mark.slow
def test_an_export_of_a_locked_database_says_how_many_rows_it_lacks(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(sqlite3.connect(folder / "webots.db", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        assert main(["export", "-o", str(folder / "a.jsonl"), "--data-dir", str(folder)]) == 0
        assert "3 rows of controllers that have ended wait" in capsys.readouterr().err
        main(["check", "--data-dir", str(folder)])
        out = capsys.readouterr().out.splitlines()
        (line,) = [line for line in out if "loses no rows" in line and "Of the checks" not in line]
        assert "warn" in line and "3 rows of controllers that have ended wait" in line
    assert len((folder / "a.jsonl").read_text().splitlines()) == 1


def test_an_answer_whose_time_is_up_before_all_rows_are_in_says_how_many_wait(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.store.recording.BUDGET_S", 0.0)
    assert main(["runs", "--data-dir", str(folder)]) == 0
    assert "3 rows of controllers that have ended wait" in "".join(capsys.readouterr())
    monkeypatch.undo()
    assert main(["runs", "--data-dir", str(folder)]) == 0
    assert "are not in this answer" not in "".join(capsys.readouterr())
    assert [*folder.glob("*waiting*")] == []
    with closing(sqlite3.connect(folder / "webots.db")) as connection:
        counts = "SELECT row_count, (SELECT count(*) FROM state) FROM run"
        assert connection.execute(counts).fetchall() == [(4, 4)]
