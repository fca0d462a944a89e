"""The tables of a pool in PostgreSQL: made, brought forward, refused."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.postgres import Server
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.errors import PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.pool_interface import Table, tables
from webots_mcp.plugins.pool.postgres_schema import VIEWS, prepare

pytestmark = pytest.mark.slow

COLUMNS = (
    "SELECT column_name, data_type, is_nullable = 'YES' FROM information_schema.columns "
    "WHERE table_schema = 'public' AND table_name = %s ORDER BY ordinal_position"
)
KEY = (
    "SELECT a.attname FROM pg_index i, unnest(i.indkey) WITH ORDINALITY k (attnum, at) "
    "JOIN pg_attribute a ON a.attnum = k.attnum "
    "WHERE i.indisprimary AND i.indrelid = %s::regclass AND a.attrelid = i.indrelid ORDER BY k.at"
)
RELATIONS = (
    "SELECT relname FROM pg_class WHERE relnamespace = 'public'::regnamespace "
    "AND relkind IN ('r', 'p', 'v') ORDER BY relname"
)
TYPES = {int: "bigint", float: "double precision", str: "text", bytes: "bytea"}


def relations(server: Server, database: str) -> list[str]:
    return [name for (name,) in server.execute(database, RELATIONS)]


def refusal(server: Server, database: str, **options: str) -> str:
    with pytest.raises(PoolError) as refused:
        prepare(server.url(database, **options), "here")
    assert not isinstance(refused.value, PoolUnavailableError)
    return str(refused.value)


@pytest.mark.parametrize("table", tables(), ids=lambda table: table.name)
def test_a_pool_has_the_columns_of_a_recording_behind_the_recordings_uuid(
    postgres: Server, pool_template: str, table: Table
) -> None:
    found = postgres.execute(pool_template, COLUMNS, table.name)
    wanted = {
        name: ("jsonb" if name in table.json_columns else TYPES[kind], name in table.nullable)
        for name, kind in zip(table.columns, table.types, strict=True)
    }
    assert found[0] == ("recording_uuid", "uuid", False)
    assert {name: (kind, may_be_null) for name, kind, may_be_null in found[1:]} == wanted
    time = (table.time_column,) if table.time_column else ()
    key = tuple(name for (name,) in postgres.execute(pool_template, KEY, table.name))
    assert key == ("recording_uuid", *table.key, *time)


def test_a_pool_has_the_views_of_a_recording(postgres: Server, pool_template: str) -> None:
    said = (
        "SELECT relname, obj_description(oid) FROM pg_class "
        "WHERE relkind = 'v' AND relnamespace = 'public'::regnamespace"
    )
    found = dict(postgres.execute(pool_template, said))
    assert found.keys() == VIEWS.keys()
    assert all(found.values())
    assert "recording_uuid = ..., run_id" in found["robot_trajectory"]


def test_two_that_prepare_at_once_make_one_pool(postgres: Server, database: str) -> None:
    with ThreadPoolExecutor() as both:
        made = [both.submit(prepare, postgres.url(database), "here") for _ in range(3)]
        assert [each.result() for each in made] == [None] * 3
    assert postgres.execute(database, "SELECT version_num FROM pool_version") == [
        (str(SCHEMA_VERSION),)
    ]


def test_an_older_pool_is_left_alone(postgres: Server, pool: str) -> None:
    postgres.execute(pool, "UPDATE pool_version SET version_num = '0009'")
    assert "schema 9, of an older webots-mcp: ship the recordings anew" in refusal(postgres, pool)


def test_a_newer_pool_is_left_alone(postgres: Server, pool: str) -> None:
    postgres.execute(pool, "UPDATE pool_version SET version_num = '0999'")
    assert "schema 999" in refusal(postgres, pool)


def test_tables_of_something_else_are_not_touched(postgres: Server, database: str) -> None:
    postgres.execute(database, "CREATE TABLE run (distance_km integer)")
    postgres.execute(database, "CREATE TABLE alembic_version (version_num text)")
    assert "tables of something else" in refusal(postgres, database)
    assert relations(postgres, database) == ["alembic_version", "run"]


def test_a_pool_may_stand_in_a_schema_of_its_own(postgres: Server, database: str) -> None:
    postgres.execute(database, "CREATE TABLE run (distance_km integer)")
    postgres.execute(database, "CREATE SCHEMA robots")
    prepare(postgres.url(database, options="-csearch_path=robots"), "here")
    postgres.execute(database, "SELECT * FROM robots.robot_trajectory")
    assert relations(postgres, database) == ["run"]
    assert "no schema on the search path" in refusal(
        postgres, database, options="-csearch_path=nowhere"
    )


def test_a_role_without_a_right_is_told_which_and_nothing_is_made(
    postgres: Server, database: str, pool: str
) -> None:
    postgres.execute(database, "CREATE ROLE visitor LOGIN")
    postgres.execute(database, "REVOKE CREATE ON SCHEMA public FROM PUBLIC")  # as from 15 on
    said = refusal(postgres, database, user="visitor")
    assert "permission denied for schema public; see docs/pool.md for what to grant" in said
    assert relations(postgres, database) == []
    assert "permission denied for table" in refusal(postgres, pool, user="visitor")


def test_a_database_that_is_read_only_is_refused(postgres: Server, database: str) -> None:
    postgres.execute(database, f"ALTER DATABASE {database} SET default_transaction_read_only = on")
    assert "read-only" in refusal(postgres, database)


def test_an_encoding_that_lacks_letters_is_refused(postgres: Server) -> None:
    postgres.execute(
        "postgres",
        "CREATE DATABASE latin ENCODING 'LATIN1' LC_COLLATE 'C' LC_CTYPE 'C' TEMPLATE template0",
    )
    assert "LATIN1" in refusal(postgres, "latin")


def test_without_psycopg_the_extra_is_named() -> None:
    without = (
        "import sys; sys.modules['psycopg'] = None\n"
        "from webots_mcp.cli import main; sys.exit(main(['pool', 'postgresql:///robots']))"
    )
    ended = subprocess.run([sys.executable, "-c", without], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("webots-mcp: a pool in PostgreSQL needs psycopg: ")
    assert "-m pip install 'psycopg[binary]" in ended.stderr
    assert ended.stderr.count("\n") == 1
