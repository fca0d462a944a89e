"""What a URL of a pool may be, and what of it may be shown."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from sqlmodel import SQLModel

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.pool_interface import (
    Batch,
    ShippedTable,
    fitted,
    redacted,
    table,
    tables,
)
from webots_mcp.store import models

SECRET = "hunter2"
_REGISTERED = models  # which enters its tables into the metadata of SQLModel


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql://robot:{SECRET}@db.lab/pool",
        f"postgresql://robot:{SECRET}/@x@db.lab/pool",
        f"postgresql://robot:{SECRET}?x@db.lab/pool",
        f"postgresql://robot:a?{SECRET}@db.lab/pool",
        f"postgresql://db.lab/pool?password={SECRET}",
        f"s3://key:{SECRET}@bucket/prefix",
        f"s3://bucket/prefix?secret_access_key={SECRET}",
        f"https://store.lab/prefix?apikey={SECRET}",
    ],
)
def test_a_secret_in_a_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(InvalidInputError, match="every process on this machine can see") as raised:
        open_pool(url)
    assert SECRET not in str(raised.value)
    assert SECRET not in redacted(url)


@pytest.mark.parametrize("url", ["", " ", "postgresql:pool", "mailto:me", "s3:bucket"])
def test_what_is_neither_a_url_nor_a_folder_is_refused_with_examples(url: str) -> None:
    with pytest.raises(InvalidInputError, match="postgresql://HOST/DATABASE"):
        open_pool(url)


@pytest.mark.parametrize(
    "text", [f"host=db.lab password={SECRET}", f"password = {SECRET}", "service=lab"]
)
def test_a_connection_string_makes_no_folder_of_its_password(text: str) -> None:
    with pytest.raises(InvalidInputError, match="is no URL: write postgresql://") as raised:
        open_pool(text)
    assert SECRET not in str(raised.value)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql:///?service=lab",
        "postgresql:///?service=me@lab",
        "./robots/day=2026-01-01",
        "postgresql://robot@db.lab:5433/pool?sslmode=require&passfile=/home/me/.pgpass",
        "/srv/pool",
        "s3://bucket/prefix",
        "memory://",
    ],
)
def test_a_url_without_a_secret_is_shown_as_it_is(url: str) -> None:
    assert redacted(url) == url


def test_each_table_comes_after_those_that_it_refers_to() -> None:
    names = [table.name for table in tables()]
    assert names.index("robot") < names.index("session") < names.index("run")
    assert all(names.index("run") < names.index(name) for name in ("state", "chunk", "log"))
    assert not {"lease", "watermark", "retention_limit"} & set(names)


@pytest.mark.parametrize("shipped", tables(), ids=lambda shipped: shipped.name)
def test_a_table_is_shipped_as_its_model_says(shipped: ShippedTable) -> None:
    model: Any = SQLModel.metadata.tables[shipped.name]
    columns = [model.columns[name] for name in shipped.columns]
    said = {column.name: column.comment or "" for column in columns}
    of_json = {name for name, comment in said.items() if comment.startswith("JSON")}
    assert shipped.key == tuple(column.name for column in model.primary_key.columns)
    assert shipped.json_columns == of_json | ({"replaced"} & {*said})
    assert shipped.json_values == {name for name in of_json if said[name].startswith("JSON value")}
    assert shipped.nullable == {column.name for column in columns if column.nullable}
    assert shipped.lasting == {
        column.name
        for column in columns
        if any(key.ondelete == "SET NULL" for key in column.foreign_keys)
    }


def test_a_value_of_another_type_becomes_what_comes_nearest_and_is_counted() -> None:
    odd = {
        "id": 1, "run_id": "one", "sim_time_s": "soon", "wall_time_s": 2**60 + 1, "kind": b"\xff",
        "path": 5, "width": 3.0, "height": 2.75, "size_bytes": float("inf"), "device": None,
    }  # fmt: skip
    images, counts = table("image"), Counter[str]()
    (row,) = fitted(Batch(images, [tuple(odd.get(each) for each in images.columns)]), counts).rows
    found = dict(zip(images.columns, row, strict=True))
    assert {name: found[name] for name in odd} == {
        "id": 1, "run_id": 0, "sim_time_s": 0.0, "wall_time_s": float(2**60), "kind": "\ufffd",
        "path": "5", "width": 3, "height": 2, "size_bytes": 0, "device": None,
    }  # fmt: skip
    wrong = ("run_id", "sim_time_s", "wall_time_s", "kind", "path", "height", "size_bytes")
    assert +counts == {f"image.{name}": 1 for name in wrong}
