"""Models and migrations say the same, to SQLite and to PostgreSQL."""

from __future__ import annotations

import io
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy.dialects import postgresql
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlmodel import SQLModel

from webots_mcp.contract import bundled
from webots_mcp.store import models
from webots_mcp.store.migrate import upgrade

assert models.Robot  # importing the models filled the metadata
TABLES = SQLModel.metadata.sorted_tables


@pytest.fixture(scope="module")
def _migrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("migrated") / "webots.db"
    upgrade(file)
    return file


@pytest.fixture
def migrated(_migrated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(_migrated, tmp_path))


def is_compared(_object: Any, _name: str | None, kind: str, _reflected: bool, _to: Any) -> bool:
    """All but foreign keys: of a column that was added, SQLAlchemy does not read ON DELETE."""
    return kind != "foreign_key_constraint"


def differences(file: Path) -> list[Any]:
    """What Alembic would have to migrate to make the database as the models say."""
    engine = sqlalchemy.create_engine(f"sqlite:///{file}")
    try:
        with engine.connect() as connection:
            options = {
                "compare_type": True,
                "compare_server_default": True,
                "include_object": is_compared,
            }
            context = MigrationContext.configure(connection, opts=options)
            return compare_metadata(context, SQLModel.metadata)
    finally:
        engine.dispose()


def test_the_migrations_make_what_the_models_say(migrated: Path) -> None:
    assert differences(migrated) == []


@pytest.mark.parametrize("table", TABLES, ids=str)
def test_the_foreign_keys_are_as_the_models_say(table: sqlalchemy.Table, migrated: Path) -> None:
    with closing(sqlite3.connect(migrated)) as connection:
        found = connection.execute(
            'SELECT "from", "table", "to", on_delete FROM pragma_foreign_key_list(?)', (table.name,)
        ).fetchall()
    said = [
        (key.parent.name, key.column.table.name, key.column.name, key.ondelete or "NO ACTION")
        for key in table.foreign_keys
    ]
    assert sorted(found) == sorted(said)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ("ALTER TABLE run RENAME COLUMN note TO remark", ["add_column", "remove_column"]),
        ("ALTER TABLE run DROP COLUMN label; ALTER TABLE run ADD COLUMN label INTEGER", ["type"]),
        (
            "ALTER TABLE session DROP COLUMN adopted_rows; "
            "ALTER TABLE session ADD COLUMN adopted_rows INTEGER DEFAULT 1 NOT NULL",
            ["default"],
        ),
        ("DROP INDEX ix_run_uuid", ["add_index"]),
        ("DROP TABLE lease", ["add_table"]),
    ],
)
def test_what_differs_is_found(migrated: Path, change: str, found: list[str]) -> None:
    with closing(sqlite3.connect(migrated)) as connection:
        for (view,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'view'"):
            connection.execute(f"DROP VIEW {view}")  # they use the columns
        connection.executescript(change)
    kinds = [
        entry[0][0] if isinstance(entry, list) else entry[0] for entry in differences(migrated)
    ]
    assert [kind.removeprefix("modify_") for kind in kinds] == found


@pytest.mark.parametrize("table", TABLES, ids=str)
def test_every_table_can_be_made_by_postgresql(table: sqlalchemy.Table) -> None:
    dialect = postgresql.dialect()
    made = [str(CreateTable(table).compile(dialect=dialect))]
    made += [str(CreateIndex(index).compile(dialect=dialect)) for index in table.indexes]
    assert not re.search("AUTOINCREMENT|ROWID|PRAGMA", "".join(made))
    assert sum("WHERE status" in text for text in made) == 2 * (table.name == "command")


def offline_script(dialect: str) -> str:
    """The SQL of all migrations for a database that is not there."""
    script = io.StringIO()
    config = Config(output_buffer=script)
    config.set_main_option("script_location", str(bundled("migrations")).replace("%", "%%"))
    config.attributes["dialect"] = dialect
    command.upgrade(config, "head", sql=True)
    return script.getvalue()


def test_the_migrations_can_be_written_out_for_postgresql() -> None:
    script = offline_script("postgresql")
    assert "PRAGMA" not in script
    assert "randomblob" not in script
    for table in TABLES:
        for column in table.columns:
            made = rf"CREATE TABLE {table.name} \([^;]*\n\s*{column.name} "
            added = rf"ALTER TABLE {table.name} ADD COLUMN {column.name} "
            assert re.search(f"{made}|{added}", script), f"{table.name}.{column.name}"
