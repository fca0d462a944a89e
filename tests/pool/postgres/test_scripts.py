"""The scripts for TimescaleDB and Citus, as far as they can be run without either.

Debian has no package of them. Functions of their names stand in, which refuse what their
documentation says that they refuse; all else of the scripts is done by a real PostgreSQL.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from typing import Final

import psycopg
import pytest

from tests.memory import memory_connection
from tests.pool.postgres.shipped import assert_equal, ship
from tests.postgres import Server
from tests.recordings.rover import record_rover
from webots_mcp.contract import bundled
from webots_mcp.plugins.pool.pool_interface import tables
from webots_mcp.plugins.pool.postgres_schema import VIEWS

REFUSALS: Final = """
CREATE TABLE done (name text, by text, beside text);
CREATE FUNCTION require_in_keys(made regclass, by text) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
  IF EXISTS (SELECT 1 FROM pg_index WHERE indrelid = made AND indisunique AND NOT EXISTS (
      SELECT 1 FROM pg_attribute WHERE attrelid = made AND attname = by AND attnum = ANY(indkey)))
    THEN RAISE EXCEPTION '% has a key without %', made, by;
  END IF;
END $$;
CREATE FUNCTION by_range(by text, every interval, partition_func regproc) RETURNS text
LANGUAGE sql AS 'SELECT by';
CREATE FUNCTION create_hypertable(
  made regclass, by text, create_default_indexes boolean, migrate_data boolean) RETURNS text
LANGUAGE plpgsql AS $$
BEGIN
  IF (SELECT relkind FROM pg_class WHERE oid = made) <> 'r' THEN
    RAISE EXCEPTION '% is partitioned', made;
  END IF;
  PERFORM require_in_keys(made, by);
  INSERT INTO done VALUES (made::text, by);
  RETURN made::text;
END $$;
CREATE FUNCTION create_distributed_table(
  made regclass, by text, colocate_with text DEFAULT 'default') RETURNS text
LANGUAGE plpgsql AS $$
BEGIN
  IF colocate_with NOT IN ('default', 'none') AND colocate_with NOT IN (SELECT name FROM done) THEN
    RAISE EXCEPTION '% is not distributed yet', colocate_with;
  END IF;
  PERFORM require_in_keys(made, by);
  INSERT INTO done VALUES (made::text, by, colocate_with);
  RETURN made::text;
END $$;
"""


pytestmark = pytest.mark.slow


@pytest.fixture
def recording() -> Iterator[sqlite3.Connection]:
    with memory_connection() as connection:
        record_rover(connection)
        yield connection


def run_script(server: Server, pool: str, name: str) -> list[tuple[str, ...]]:
    """What a script made of which table, by which column."""
    script = (bundled("examples") / "pool" / f"{name}.sql").read_text("utf-8")
    without, extensions = re.subn(r"(?m)^CREATE EXTENSION IF NOT EXISTS \w+;$", "", script)
    assert extensions == 1
    with psycopg.connect(server.url(pool)) as connection:
        connection.execute(REFUSALS.encode())
        connection.execute(without.encode())
    return server.execute(pool, "SELECT name, by, beside FROM done ORDER BY name")


def views(server: Server, pool: str) -> dict[str, list[tuple[str, ...]]]:
    """Every row of every view but for its age, and what the view says of itself."""
    row = "(to_jsonb({0}) - 'age_s')::text"
    rows = {
        view: server.execute(pool, f"SELECT {row.format(view)} FROM {view} ORDER BY 1")
        for view in VIEWS
    }
    said = "SELECT relname, obj_description(oid) FROM pg_class WHERE relkind = 'v' ORDER BY 1"
    return {**rows, "said": server.execute(pool, said)}


def test_tables_that_grow_become_hypertables_and_all_goes_on(
    postgres: Server, pool: str, recording: sqlite3.Connection
) -> None:
    ship(postgres, pool, recording)
    before = views(postgres, pool)
    cut = {each.name for each in tables() if each.time_column}
    done = run_script(postgres, pool, "timescaledb")
    assert done == [(name, "wall_time_s", None) for name in sorted(cut)]
    assert views(postgres, pool) == before
    recording.execute("UPDATE run SET label = 'again'")
    ship(postgres, pool, recording)
    assert_equal(postgres, pool, recording)
    with memory_connection() as other:
        record_rover(other)
        ship(postgres, pool, other)
        assert_equal(postgres, pool, other)


@pytest.mark.parametrize("odd", ["nan", "infinity", "-infinity", "1e300"])
def test_a_clock_that_was_anywhere_has_a_chunk(postgres: Server, pool: str, odd: str) -> None:
    run_script(postgres, pool, "timescaledb")
    chunk = "SELECT extract(year FROM chunk_time(%s::double precision))::int"
    assert postgres.execute(pool, chunk, odd)[0][0] in (1970, 2100)


def test_all_tables_of_recordings_are_distributed_by_recording_beside_each_other(
    postgres: Server, pool: str
) -> None:
    done = run_script(postgres, pool, "citus")
    own = {"picture", "progress", "shipment"}
    names = own | {each.name for each in tables()}
    assert {(name, by) for name, by, _ in done} == {(name, "recording_uuid") for name in names}
    assert {beside for name, _, beside in done if name != "recording"} == {"recording"}
