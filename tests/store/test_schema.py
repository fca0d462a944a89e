"""The schema is that of the models, in SQLite and in PostgreSQL."""

from __future__ import annotations

import re

import pytest
import sqlalchemy
from sqlalchemy.dialects import postgresql
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlmodel import SQLModel

from migrations.generate import generated_statements
from webots_mcp.database.schema import shipped_statements
from webots_mcp.store import models

assert models.RobotTable  # importing the models filled the metadata
TABLES = SQLModel.metadata.sorted_tables


def test_the_generated_schema_is_that_of_the_models() -> None:
    assert [each.strip() for each in shipped_statements()] == generated_statements()


@pytest.mark.parametrize("table", TABLES, ids=str)
def test_every_table_can_be_made_by_postgresql(table: sqlalchemy.Table) -> None:
    dialect = postgresql.dialect()
    made = [str(CreateTable(table).compile(dialect=dialect))]
    made += [str(CreateIndex(index).compile(dialect=dialect)) for index in table.indexes]
    assert not re.search("AUTOINCREMENT|ROWID|PRAGMA", "".join(made))
    assert sum("WHERE status" in text for text in made) == 2 * (table.name == "command")
