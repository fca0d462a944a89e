"""A value that no bridge has written costs its row, named on stderr, and no command."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.server.malformed import NOT_UTF8, Damage, record
from webots_mcp.cli import main

DAMAGES = (
    Damage("state", "sim_time_s", "late"),
    Damage("state", "data", NOT_UTF8),
    Damage("event", "data", "[1]"),
    Damage("session", "actions", "nonsense"),
    Damage("log", "wall_time_s", b"\x00"),
    Damage("state", "replaced", "[1]"),
    Damage("run", "row_count", "many"),
)
ASKED = (
    ("status",), ("status", "--json"), ("runs",), ("events",), ("trends",), ("history", "pose.0"),
    ("compare", "1", "2"), ("tail", "--no-follow"), ("export",), ("export", "--format", "jsonl"),
    ("signals",), ("logs",), ("sql", "SELECT * FROM run"),
    ("prune", "--dry-run"), ("prune", "--dry-run", "--keep-states", "10rows"),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES, ids=str)
def test_every_question_is_answered_past_a_wrong_value(tmp_path: Path, damage: Damage) -> None:
    file = tmp_path / "webots.db"
    record(file)
    with closing(sqlite3.connect(file)) as connection, connection:
        damage.apply(connection)
    ended = {asked: main([*asked, "--database", str(file)]) for asked in ASKED}
    assert [asked for asked, code in ended.items() if code] == []


def test_an_export_is_whole_but_for_the_row_that_cannot_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, table = tmp_path / "webots.db", tmp_path / "rows.jsonl"
    record(file)
    with closing(sqlite3.connect(file)) as connection, connection:
        rows = sum(
            connection.execute(f"SELECT count(*) FROM {each} WHERE run_id = 2").fetchone()[0]
            for each in ("state", "kept_state")
        )
        connection.execute(
            "UPDATE state SET replaced = '[1]' WHERE id = (SELECT max(id) FROM state)"
        )
        connection.execute(
            "UPDATE state SET data = CAST(x'7b22ff' AS TEXT) "
            "WHERE id = (SELECT max(id) - 5 FROM state)"
        )
    assert main(["export", "--database", str(file), "-o", str(table)]) == 0
    assert len(table.read_text().splitlines()) == rows - 1
    assert "data holds no valid JSON" in capsys.readouterr().err


def test_what_was_left_out_is_said_below_the_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "webots.db"
    record(file)
    with closing(sqlite3.connect(file)) as connection, connection:
        Damage("session", "actions", "nonsense").apply(connection)
    assert main(["status", "--database", str(file)]) == 0
    answer = capsys.readouterr()
    assert "rover" in answer.out
    assert "note: left out: session 1: actions holds no valid JSON\n" in answer.out
