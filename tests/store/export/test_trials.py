"""The trials of a set as a flat table: each trial is a row, with the figures of its parameters."""

from __future__ import annotations

import csv
import io
import json
import sqlite3
from collections.abc import Iterator
from typing import Any

import pytest

from tests.memory import memory_connection
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.export import TrialTable, export
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

TRIED: list[tuple[dict[str, Any], float | None]] = [
    ({"kp": 1, "gait": "trot", "score": True}, 4.0),
    ({"kp": 2.5, "gait": "=walk", "score": False}, 9.0),
    ({"kp": 1, "gait": "trot", "score": True}, 6.0),
    ({"kp": 2.5, "gait": "=walk", "score": False}, 8.5),
    ({"kp": 7, "gait": "trot", "score": True}, None),
    ({"kp": 9, "gait": "trot", "score": True}, None),  # waits
]


@pytest.fixture
def connection() -> Iterator[sqlite3.Connection]:
    with memory_connection() as connection:
        create_trial_set(connection, "{}", [{"kp": 0}])
        set_id = create_trial_set(connection, "{}", [parameters for parameters, _ in TRIED])
        for trial, (_, score) in zip(trials_of(connection, set_id)[:5], TRIED, strict=False):
            failed = None if score else "ValueError: it fell"
            finish_trial(connection, trial, TrialResult(None, score, failed, "for_s", 20.0))
        yield connection


def exported(connection: sqlite3.Connection, form: str, **how: Any) -> bytes:
    sink = io.BytesIO()
    rows = export(connection, TrialTable.of(connection, 2), form, sink, **how)
    assert rows == len(TRIED)
    return sink.getvalue()


def test_each_trial_is_a_row_with_its_parameters_and_how_those_did(
    connection: sqlite3.Connection,
) -> None:
    rows = [json.loads(line) for line in exported(connection, "jsonl").splitlines()]
    assert [row["number"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert [row["score"] for row in rows] == [score for _, score in TRIED]
    for row, (parameters, _) in zip(rows, TRIED, strict=True):
        assert (row["kp"], row["gait"], row["parameter score"]) == tuple(parameters.values())
    figures = ("rank", "mean", "least", "greatest", "scores", "pruned", "failed")
    assert [[row[name] for name in figures] for row in rows[2:]] == [
        [2, 5.0, 4.0, 6.0, 2, 0, 0],
        [1, 8.75, 8.5, 9.0, 2, 0, 0],
        [3, None, None, None, 0, 0, 1],
        [None] * 7,
    ]
    assert [row["status"] for row in rows] == [*["done"] * 4, "failed", "waiting"]
    assert rows[4]["error"] == "ValueError: it fell"
    assert (rows[0]["trial_set_id"], rows[0]["ended_sim_time_s"]) == (2, 20.0)


def test_csv_has_a_column_for_each_parameter_and_figure(connection: sqlite3.Connection) -> None:
    text = exported(connection, "csv", safe_cells=True).decode()
    rows = list(csv.DictReader(io.StringIO(text, newline="")))
    assert [row["kp"] for row in rows] == ["1", "2.5", "1", "2.5", "7", "9"]
    assert [row["gait"] for row in rows[:2]] == ["trot", "'=walk"]
    assert [row["parameter score"] for row in rows[:2]] == ["true", "false"]
    assert [row["mean"] for row in rows] == ["5.0", "8.75", "5.0", "8.75", "", ""]


def test_parquet_reads_back_with_types(connection: sqlite3.Connection) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")
    table = parquet.read_table(io.BytesIO(exported(connection, "parquet")))
    assert table.column("kp").to_pylist() == [1.0, 2.5, 1.0, 2.5, 7.0, 9.0]
    assert table.column("rank").to_pylist() == [2, 1, 2, 1, 3, None]
    assert table.column("score").to_pylist() == [score for _, score in TRIED]


def test_a_set_that_is_not_there_is_named(connection: sqlite3.Connection) -> None:
    with pytest.raises(InvalidInputError, match=r"No trial set 9 is recorded\. The newest is 2"):
        TrialTable.of(connection, 9)
