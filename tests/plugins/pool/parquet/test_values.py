"""The values of signals as columns: what an engine reads as numbers, and what comes back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.pool.parquet.files import globbed, parquet
from tests.plugins.pool.rows import chunk_values, pooled_rows, rows_of, shipping, uuid_of
from tests.recordings.rows import Recorded
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.pool.parquet_pool import ParquetPool
from webots_mcp.plugins.pool.pool_interface import Batch, table
from webots_mcp.plugins.pool.shipping import ShippingJob, ShippingReport, ship
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.recording import RecordingAccess

STATES: list[tuple[dict[str, Any], dict[str, str] | None]] = [
    ({"x": 1, "mode": "go", "bumper": False, "run": 5, "odd": 1.5}, None),
    ({"x": 2.5, "mode": None, "bumper": True, "run": 6, "odd": "text"}, None),
    ({"x": None, "mode": "go", "run": -0.0, "odd": True}, {"x": "nan"}),
    ({"mode": 7, "bumper": "broken", "run": 2**60, "odd": None}, None),
    ({"x": "text", "mode": True, "bumper": 1, "run": 10**400, "odd": 1}, None),
    ({"odd": 2.0, "bumper": True}, None),
    ({}, None),
]


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Recorded]:
    """A run whose signals have values of all types."""
    folder = tmp_path / "there"
    folder.mkdir()
    recorded = Recorded(folder / DATABASE_NAME)
    with closing(recorded.connection) as connection:
        robot = recorded.robot("rover")
        for number, (state, replaced) in enumerate(STATES):
            robot.state(float(number), state, replaced=replaced)
        robot.end_run("finished")
        assert chunk_whole_run(connection, 1)
        yield recorded


def shipped(pool: Path) -> ShippingReport:
    folder = pool.parent / "there"
    recording = RecordingAccess(folder / DATABASE_NAME, folder, read_only=True)
    report = ShippingReport()
    ship(ShippingJob(recording, lambda: ParquetPool(str(pool), ships=True)), report)
    return report


def test_a_signal_is_a_column_of_its_type_and_others_stand_beside(
    database: Recorded, tmp_path: Path
) -> None:
    assert not shipped(tmp_path / "pool").replaced
    (file,) = (tmp_path / "pool").rglob("table=value/run=1/*.parquet")
    types = {field.name: str(field.type) for field in parquet.read_schema(file)}
    fixed = {"group_id": "int64", "state_id": "int64", "sim_time_s": "double",
             "wall_time_s": "double", "others": "string"}  # fmt: skip
    assert types == fixed | {
        "x": "double", "mode": "string", "bumper": "bool", "run (4)": "double", "odd": "double",
    }  # fmt: skip
    rows = globbed(tmp_path / "pool", "value")
    assert [row["x"] for row in rows] == [1.0, 2.5, None, None, None, None, None]
    assert [row["mode"] for row in rows] == ["go", None, "go", None, None, None, None]
    assert [row["bumper"] for row in rows] == [False, True, None, None, None, True, None]
    assert [row["others"] for row in rows][1:3] == [
        '{"mode": null, "odd": "text"}', '{"x": ["nan"], "odd": true}',
    ]  # fmt: skip


def test_chunks_come_back_with_every_value(database: Recorded, tmp_path: Path) -> None:
    shipped(tmp_path / "pool")
    expected = rows_of(database.connection, table("chunk"))
    found = pooled_rows(
        str(tmp_path / "pool"), uuid_of(database.connection), "chunk", {"run_id": (1,)}
    )
    assert chunk_values(found) == chunk_values(expected) != {}
    assert (
        pooled_rows(str(tmp_path / "pool"), uuid_of(database.connection), "chunk", {"run_id": (2,)})
        == []
    )


@pytest.mark.slow
def test_engines_read_numbers_without_a_word_of_json(database: Recorded, tmp_path: Path) -> None:
    shipped(tmp_path / "pool")
    with ParquetPool(str(tmp_path / "pool")) as pool:
        asked = "SELECT run_id, sum(x), max(sim_time_s), bool_or(bumper) FROM value GROUP BY run_id"
        assert pool.select(asked, 9).rows == ((1, 3.5, 6.0, True),)
        with pytest.raises(InvalidInputError, match="DuckDB says: Catalog Error"):
            pool.select("SELECT * FROM chunk", 1)


def test_groups_that_come_later_are_put_behind_with_their_new_signals(
    database: Recorded, tmp_path: Path
) -> None:
    chunks = table("chunk")
    rows = rows_of(database.connection, chunks)
    group, signal = (chunks.columns.index(each) for each in ("group_id", "signal_id"))
    later = [(*row[:group], 2, *row[group + 1 :]) for row in rows]
    with shipping(tmp_path / "pool", uuid_of(database.connection)) as shipment:
        shipment.write([Batch(table("signal"), rows_of(database.connection, table("signal")))], {})
        shipment.write([Batch(chunks, [row for row in rows if int(str(row[signal])) < 3])], {})
        shipment.write([Batch(chunks, later)], {})
    found = pooled_rows(str(tmp_path / "pool"), uuid_of(database.connection), "chunk")
    values = chunk_values(found)
    expected = {(key, number): each for (_, number), each in chunk_values(rows).items()
                for key in ((2,) if number >= 3 else (1, 2))}  # fmt: skip
    assert values == expected


def test_a_chunk_that_is_damaged_is_counted_and_the_others_are_shipped(
    database: Recorded, tmp_path: Path
) -> None:
    database.connection.execute("UPDATE chunk SET numbers = x'00' WHERE signal_id = 1")
    assert shipped(tmp_path / "pool").replaced == {"damaged chunk": 1}
    (row, *_) = globbed(tmp_path / "pool", "value")
    assert (row["mode"], row["run (4)"]) == ("go", 5.0)
    assert (row["x"], json.loads(row["others"])["x"]) == (None, ["damaged"])
