"""A recording of the schema before is imported with all that was recorded; others are refused."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.older_recording import record_older
from webots_mcp.cli import main
from webots_mcp.connection import connect
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, find_range, whole_run
from webots_mcp.store.reading.segment import Deadline


@pytest.fixture
def older(tmp_path: Path) -> Path:
    file = tmp_path / "there" / "webots.db"
    (file.parent / "camera").mkdir(parents=True)
    (file.parent / "camera" / "1.png").write_bytes(b"picture")
    record_older(file)
    return file


def imported(older: Path, here: Path) -> int:
    return main(["import", str(older), "--data-dir", str(here), "--json"])


def rows(file: Path, query: str) -> list[Any]:
    with closing(connect(file, "reader")) as connection:
        return connection.execute(query).fetchall()


def test_all_that_was_recorded_comes_over_once_and_the_older_file_stays_as_it_is(
    older: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, here = older.read_bytes(), tmp_path / "here"
    assert imported(older, here) == 0
    assert json.loads(capsys.readouterr().out)["new_run_ids"] == [1, 2]
    assert imported(older, here) == 0
    assert json.loads(capsys.readouterr().out)["known_run_ids"] == [1, 2]
    assert older.read_bytes() == before
    file = here / "webots.db"
    counts = {
        "robot": 1, "session": 1, "run": 2, "state": 40, "kept_stretch": 1, "kept_state": 1,
        "log": 1, "event": 2, "image": 1, "command": 1, "breakpoint": 1, "parameter": 1,
        "parameter_value": 1, "trial_set": 1, "trial": 1,
    }  # fmt: skip
    assert {table: rows(file, f"SELECT count(*) FROM {table}")[0][0] for table in counts} == counts
    runs = rows(file, "SELECT row_count, purged_rows, end_reason, label FROM run ORDER BY id")
    assert runs == [(60, 30, "reset", None), (10, 0, "superseded", "second")]
    assert rows(file, "SELECT condition, hit_count FROM breakpoint") == [("front < 0.5", 2)]
    ((path, size_bytes),) = rows(file, "SELECT path, size_bytes FROM image")
    assert (here / path).read_bytes() == b"picture" and size_bytes == 1000
    (named,) = rows(file, "SELECT data, replaced FROM state WHERE replaced IS NOT NULL")
    assert json.loads(named[1]) == {"front": "nan"}
    ((command, run_id),) = rows(
        file, "SELECT c.action, v.run_id FROM parameter_value v JOIN command c ON c.id = command_id"
    )
    assert (command, run_id) == ("run", 1)


def test_its_values_are_put_into_chunks_and_what_was_deleted_is_not_said_to_be_searched(
    older: Path, tmp_path: Path
) -> None:
    imported(older, tmp_path / "here")
    with closing(connect(tmp_path / "here" / "webots.db", "writer")) as connection:
        assert make_chunks(connection).done
        segment = whole_run(connection, 1)
        assert segment is not None
        frame = read_frame(connection, segment, Deadline(60))
        assert frame.numbers("pose.0").tolist() == [round(3.0 + i / 10, 1) for i in range(30)]
        (lost,) = frame.unread
        assert (lost.start_s, lost.end_s, lost.why) == (0.0, 15.0, "deleted by retention")
        (second,) = trends(connection, find_range(connection, Scope(run_id=2)), ["front"]).runs
        assert second.numbers[0].mean == 1.0


@pytest.mark.parametrize(
    ("version", "said"),
    [(8, "read it with the webots-mcp that made it"), (99, "pip install --upgrade")],
)
def test_one_of_another_schema_is_refused_with_what_to_do(
    older: Path, tmp_path: Path, version: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(sqlite3.connect(older)) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    assert imported(older, tmp_path / "here") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


def test_one_that_stands_where_the_new_one_is_to_be_is_refused_with_what_to_do(
    older: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = older.read_bytes()
    assert imported(older, older.parent) == 2
    said = capsys.readouterr().err
    assert "move it aside" in said and "'webots-mcp import FILE'" in said
    assert older.read_bytes() == before
    shutil.move(older, older.with_name("older.db"))
    assert imported(older.with_name("older.db"), older.parent) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("DROP TABLE log; CREATE VIEW log AS SELECT 1 AS id", "no table log"),
        ("ALTER TABLE state DROP COLUMN odd", "not as webots-mcp made it"),
    ],
)
def test_one_that_is_not_as_it_was_made_is_refused(
    older: Path, tmp_path: Path, change: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(sqlite3.connect(older)) as connection:
        connection.executescript(change)
    assert imported(older, tmp_path / "here") == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


def test_rows_that_wait_next_to_it_are_not_left_behind_in_silence(
    older: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    older.with_name("webots.db-waiting-1.jsonl").write_text("{}\n")
    assert imported(older, tmp_path / "here") == 2
    assert "rows wait next to" in capsys.readouterr().err
