"""The mode that `status` shows: read from a few rows, as the question about trends tells it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import start_run
from webots_mcp.cli import status_command
from webots_mcp.cli.options import Where
from webots_mcp.cli.status_command import _mode_by_trends, _mode_in_newest_rows, _mode_of
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store.chunk_making import make_chunks

MODES: dict[str, list[Any]] = {
    "a change": ["turn", "turn", "cruise", "cruise", "cruise"],
    "two changes": ["cruise", "turn", "cruise", "cruise"],
    "a flag": [False, True, True],
    "other scripts": ["gerät", "fährt", "fährt"],
    "a quote": ['say "go"', "it's", "it's"],
    "a value that came late": [None, None, "go", "go"],
}
UNTOLD: dict[str, list[Any]] = {
    "none at the end": ["go", "go", None],
    "a number": [1, 2, 2],
    "a structure": ["go", {"name": "go"}],
}


def write(folder: Path, modes: list[Any], *, has_chunks: bool = False) -> sqlite3.Connection:
    connection = connect(folder / DATABASE_NAME, "writer", create=True)
    create_schema(connection)
    recorder = start_run(connection)
    for row, mode in enumerate(modes):
        recorder.publish(row * 0.5, {"x": row} if mode is None else {"mode": mode, "x": row})
    while has_chunks and not make_chunks(connection, 2000).done:
        pass
    return connection


@pytest.mark.parametrize("has_chunks", [False, True])
@pytest.mark.parametrize("case", MODES)
def test_few_rows_tell_what_the_trends_tell(tmp_path: Path, case: str, has_chunks: bool) -> None:
    with closing(write(tmp_path, MODES[case], has_chunks=has_chunks)) as connection:
        found = _mode_in_newest_rows(connection, 1)
    asked = {"robot": "rover", "run_id": 1}
    assert found
    assert found == _mode_by_trends(asked, Where(data_dir=tmp_path))


@pytest.mark.parametrize("purged", [0, 7])
def test_a_mode_that_never_changed_is_told_since_when_unless_older_rows_are_gone(
    tmp_path: Path, purged: int
) -> None:
    with closing(write(tmp_path, ["go", "go", "go"])) as connection:
        connection.execute("UPDATE run SET purged_rows = ?", (purged,))
        found = _mode_in_newest_rows(connection, 1)
    assert found == {"mode": "go"} | ({} if purged else {"mode_since_s": 0.0})


def test_the_mode_of_a_long_run_is_told_although_it_never_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_command, "_MOST_ROWS", 2)
    write(tmp_path, ["go", "go", "go"]).close()
    asked = {"robot": "rover", "run_id": 1}
    assert _mode_of(asked, Where(data_dir=tmp_path)) == {"mode": "go"}


def test_one_mode_in_two_spellings_of_json_is_one(tmp_path: Path) -> None:
    with closing(write(tmp_path, ["a", "b", "b"])) as connection:
        connection.execute("UPDATE state SET data = ? WHERE id = 3", ('{"mode": "\\u0062"}',))
        assert _mode_in_newest_rows(connection, 1) == {"mode": "b", "mode_since_s": 0.5}


@pytest.mark.parametrize("case", UNTOLD)
def test_where_few_rows_do_not_tell_the_trends_are_asked(tmp_path: Path, case: str) -> None:
    with closing(write(tmp_path, UNTOLD[case])) as connection:
        assert _mode_in_newest_rows(connection, 1) == {}


def test_a_row_that_is_no_json_ends_nothing(tmp_path: Path) -> None:
    with closing(write(tmp_path, ["turn", "cruise", "cruise"])) as connection:
        connection.execute("UPDATE state SET data = '{' WHERE id = 2")
        assert _mode_in_newest_rows(connection, 1) == {}


def test_rows_of_full_rate_may_tell_an_earlier_change(tmp_path: Path) -> None:
    with closing(write(tmp_path, ["turn", "cruise"])) as connection:
        connection.execute(
            "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, "
            "wall_time_s, reason) VALUES (1, 'u', 0, 1, 0, 'asked for')"
        )
        assert _mode_in_newest_rows(connection, 1) == {}
