"""A pool in PostgreSQL: what it is made of, who may use it, and what it survives."""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import pytest
from psycopg.conninfo import conninfo_to_dict

from tests.memory import memory_connection
from tests.plugins.pool.rows import (
    OTHER_UUID,
    all_batches,
    batch,
    logs,
    pooled,
    recorded,
    rows_of,
    run_row,
    ship,
    shipping,
    uuid_of,
)
from tests.postgres import Server
from tests.recordings.rover import record_rover
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidInputError, PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.pool_contents import open_pool
from webots_mcp.plugins.pool.pool_interface import Batch, PoolRow, ShippedTable, table, tables
from webots_mcp.plugins.pool.postgres_schema import prepare, views
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.slow

SECRET = "quite-a-secret-7"
PAGE = (Path(__file__).parents[4] / "docs" / "pool.md").read_text("utf-8")
TYPES = {int: "bigint", float: "double precision", str: "text", bytes: "bytea"}
COLUMNS = (
    "SELECT column_name, data_type, is_nullable = 'YES' FROM information_schema.columns "
    "WHERE table_schema = 'public' AND table_name = %s ORDER BY ordinal_position"
)
RELATIONS = (
    "SELECT relname FROM pg_class WHERE relnamespace = 'public'::regnamespace "
    "AND relkind IN ('r', 'p', 'v') ORDER BY relname"
)


@pytest.fixture
def database(postgres: Server) -> str:
    """The name of an empty database."""
    return postgres.new_database()


@pytest.fixture(scope="module")
def pool_template(postgres: Server) -> str:
    """The name of a database that is a pool."""
    name = postgres.new_database()
    prepare(postgres.url(name), "the template")
    return name


@pytest.fixture
def pool(postgres: Server, pool_template: str) -> str:
    """The name of a database that is a pool without a row."""
    return postgres.new_database(pool_template)


@pytest.fixture(scope="module")
def rover() -> Iterator[sqlite3.Connection]:
    """The known story; do not change it."""
    with memory_connection() as connection:
        record_rover(connection)
        assert make_chunks(connection, 100_000).done
        connection.execute("UPDATE run SET uuid = 'run ' || id")
        yield connection


def relations(server: Server, database: str) -> list[str]:
    return [name for (name,) in server.execute(database, RELATIONS)]


def refusal(url: str) -> str:
    """What a pool says that cannot be used, and will not be better by itself."""
    with pytest.raises(PoolError) as refused, open_pool(url, ships=True):
        pass
    assert not isinstance(refused.value, PoolUnavailableError)
    return str(refused.value)


# -- tables and views -------------------------------------------------------------------------


@pytest.mark.parametrize("table", tables(), ids=lambda table: table.name)
def test_a_pool_has_the_columns_of_a_recording_behind_the_recordings_uuid(
    postgres: Server, pool_template: str, table: ShippedTable
) -> None:
    found = postgres.execute(pool_template, COLUMNS, table.name)
    wanted = [
        (name, "json" if name in table.json_columns else TYPES[kind], name in table.nullable)
        for name, kind in zip(table.columns, table.types, strict=True)
    ]
    assert found == [("recording_uuid", "uuid", False), *wanted]


@pytest.mark.parametrize("view", views())
def test_a_view_has_the_rows_that_it_has_in_the_recording(
    postgres: Server, pool: str, rover: sqlite3.Connection, bridge_recording: Path, view: str
) -> None:
    with closing(connect(bridge_recording, "reader")) as bridge:
        for recording in (rover, bridge):
            ship(recording, postgres.url(pool))
            cursor = recording.execute(f"SELECT * FROM {view}")
            columns = ", ".join(f'"{name}"' for name, *_ in cursor.description)
            there = f"SELECT {columns} FROM {view} WHERE recording_uuid = %s"
            found = postgres.execute(pool, there, UUID(uuid_of(recording)))
            assert sorted(map(comparable, found)) == sorted(map(comparable, cursor.fetchall()))
    (said,) = postgres.execute(pool, f"SELECT obj_description('{view}'::regclass)")[0]
    assert said


def test_a_view_tells_a_moment_to_the_millisecond_that_sqlite_tells(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    moments = [1_790_000_000 + n * 1234.567891 for n in range(400)]
    moments += [1_790_000_000 + n + 0.2675 + sign * 1e-7 for n in range(50) for sign in (-1, 0, 1)]
    rover.execute("UPDATE event SET wall_time_s = 0")  # only those below are compared
    values = [(moment, f"moment {n}") for n, moment in enumerate(moments)]
    rover.executemany(
        "INSERT INTO event (run_id, sim_time_s, wall_time_s, kind, name) "
        "SELECT max(id), 0, ?, 'bridge_event', ? FROM run",
        values,
    )
    rover.commit()
    ship(rover, postgres.url(pool))
    query = "SELECT name, utc FROM robot_event WHERE name LIKE 'moment %'"
    told = dict(rover.execute(query))
    assert len(told) == len(moments)
    assert dict(postgres.execute(pool, query)) == told


def comparable(row: tuple[Any, ...]) -> str:
    return json.dumps([told(value) for value in row], sort_keys=True)


def told(value: Any) -> Any:
    """A value of a view, whatever tells the time, the type of a text or the spaces of JSON."""
    if isinstance(value, str):
        try:
            return told(json.loads(value))
        except ValueError:
            return value
    if isinstance(value, dict):
        return {str(key): told(item) for key, item in cast("dict[str, Any]", value).items()}
    return round(float(value), 9) if isinstance(value, bool | int | float) else value


def test_several_that_ship_for_the_first_time_at_once_make_one_pool(
    postgres: Server, database: str
) -> None:
    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(prepare, [postgres.url(database)] * 3, "123")) == [None] * 3


def test_tables_of_something_else_are_not_touched_and_a_pool_may_stand_beside_them(
    postgres: Server, database: str
) -> None:
    postgres.execute(database, "CREATE TABLE run (distance_km integer); CREATE SCHEMA robots")
    assert "tables of something else" in refusal(postgres.url(database))
    prepare(postgres.url(database, options="-csearch_path=robots"), "here")
    postgres.execute(database, "SELECT * FROM robots.robot_run")
    assert relations(postgres, database) == ["run"]
    nowhere = postgres.url(database, options="-csearch_path=nowhere")
    assert "no schema on the search path" in refusal(nowhere)


# -- rights -----------------------------------------------------------------------------------


def test_who_ships_need_not_own_the_tables(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    postgres.execute(pool, "CREATE ROLE shipper LOGIN")
    url = postgres.url(pool, user="shipper")
    assert "permission denied for table" in refusal(url)
    (grants,) = re.findall(r"(?ms)^```sql\n(GRANT .*?)```", PAGE)
    postgres.execute(pool, grants)
    ship(rover, url)
    assert pooled(url, uuid_of(rover)) == recorded(rover)


def test_a_role_without_a_right_is_told_which_and_nothing_is_made(
    postgres: Server, database: str
) -> None:
    postgres.execute(database, "CREATE ROLE visitor LOGIN")
    postgres.execute(database, "REVOKE CREATE ON SCHEMA public FROM PUBLIC")  # as from 15 on
    said = refusal(postgres.url(database, user="visitor"))
    assert (
        "permission denied for schema public; see 'webots-mcp help pool' for what to grant" in said
    )
    postgres.execute(database, f"ALTER DATABASE {database} SET default_transaction_read_only = on")
    assert "read-only" in refusal(postgres.url(database))
    assert relations(postgres, database) == []


def test_the_role_of_the_page_reads_the_pool_and_nothing_else(postgres: Server, pool: str) -> None:
    (role,) = re.findall(r"(?ms)^```postgresql\n(CREATE ROLE reader.*?)```", PAGE)
    postgres.execute(pool, role)
    with open_pool(postgres.url(pool, user="reader")) as opened:
        assert opened.select("SELECT count(*) FROM run", 1).rows == ((0,),)
        with pytest.raises(InvalidInputError, match="permission denied for function pg_read_file"):
            opened.select("SELECT pg_read_file('/etc/passwd')", 1)


def test_nothing_that_a_select_makes_stays(postgres: Server, pool: str) -> None:
    with open_pool(postgres.url(pool)) as opened:
        opened.select("SELECT lo_from_bytea(0, 'made')", 1)
        assert opened.select("SELECT count(*) FROM pg_largeobject_metadata", 1).rows == ((0,),)


@pytest.fixture
def guarded(postgres: Server, pool: str) -> Iterator[str]:
    """The URL of a pool for a role that has to tell a password."""
    postgres.execute(pool, f"CREATE ROLE guarded LOGIN SUPERUSER PASSWORD '{SECRET}'")
    yield postgres.url(pool, user="guarded")
    postgres.execute(pool, "DROP OWNED BY guarded; DROP ROLE guarded")


def test_a_password_comes_from_where_libpq_looks(
    guarded: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PGPASSWORD", SECRET)
    with open_pool(guarded):
        pass
    monkeypatch.delenv("PGPASSWORD")
    service = tmp_path / "services"
    text = "\n".join(f"{name}={value}" for name, value in conninfo_to_dict(guarded).items())
    service.write_text(f"[lab]\n{text}\npassword={SECRET}\n")
    monkeypatch.setenv("PGSERVICEFILE", str(service))
    with open_pool("postgresql:///?service=lab") as opened:
        assert opened.address == "postgresql:///?service=lab"


@pytest.mark.parametrize(
    ("password", "said"), [(None, "asks for a password"), (f"{SECRET}x", "authentication failed")]
)
def test_a_password_that_is_missing_or_wrong_is_told_and_not_shown(
    guarded: str, monkeypatch: pytest.MonkeyPatch, password: str | None, said: str
) -> None:
    if password:
        monkeypatch.setenv("PGPASSWORD", password)
    monkeypatch.setenv("PGPASSFILE", "/nonexistent")
    with pytest.raises(PoolError, match=said) as refused, open_pool(guarded):
        pass
    assert not isinstance(refused.value, PoolUnavailableError)
    assert SECRET not in str(refused.value)
    assert refused.value.__context__ is None  # psycopg's error knows the password


@pytest.mark.parametrize(
    ("url", "unavailable", "said"),
    [
        ("postgresql://127.0.0.1:1/robots", True, "does not answer: .*refused"),
        ("postgresql:///?service=nowhere", False, 'definition of service "nowhere" not found'),
        ("postgresql://127.0.0.1:1/robots?sslmode=odd", False, "invalid sslmode"),
        ("nothing", False, "does not exist"),
        ("user=nobody-here", False, "does not exist"),
    ],
)
def test_a_server_that_does_not_answer_is_told_from_one_that_never_will(
    postgres: Server, url: str, unavailable: bool, said: str
) -> None:
    if "://" not in url:
        _, _, user = url.partition("user=")
        url = postgres.url("postgres", user=user) if user else postgres.url(url)
    with pytest.raises(PoolError, match=said) as refused, open_pool(url):
        pass
    assert isinstance(refused.value, PoolUnavailableError) is unavailable


def test_without_psycopg_the_extra_is_named() -> None:
    without = (
        "import sys; sys.modules['psycopg'] = None\n"
        "from webots_mcp.cli import main; sys.exit(main(['pool', 'postgresql:///robots']))"
    )
    ended = subprocess.run([sys.executable, "-c", without], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("webots-mcp: a pool in PostgreSQL needs psycopg: ")
    assert "-m pip install 'psycopg[binary]" in ended.stderr


# -- what it survives -------------------------------------------------------------------------


def test_what_is_written_again_changes_no_row(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    def versions() -> list[Any]:
        of_table = "SELECT ctid::text, xmin::text FROM {} ORDER BY ctid"
        return [postgres.execute(pool, of_table.format(each.name)) for each in tables()]

    ship(rover, postgres.url(pool))
    before = versions()
    ship(rover, postgres.url(pool))
    assert versions() == before


def test_of_several_that_ship_a_run_at_once_one_does(postgres: Server, pool: str) -> None:
    def shipped(number: int) -> bool:
        with shipping(postgres.url(pool), f"{OTHER_UUID[:-1]}{number}") as shipment:
            try:
                shipment.write([batch("run", run_row(1, 1))], {})
            except PoolError as error:
                assert "by another" in str(error)
                return False
            return True

    with ThreadPoolExecutor(6) as all_at_once:
        assert sorted(all_at_once.map(shipped, range(6))) == [False] * 5 + [True]
    assert postgres.execute(pool, "SELECT count(*) FROM run") == [(1,)]


def test_a_recording_is_deleted_as_the_page_says_and_shipped_anew(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    url = postgres.url(pool)
    ship(rover, url)
    with shipping(url, OTHER_UUID) as shipment:
        shipment.write([logs(1), batch("run", run_row(1, 1))], {"a": 1})
    (script,) = re.findall(r"(?ms)^```postgresql\n(DO .*?)```", PAGE)
    named = re.compile("'6719d286-[-0-9]*'")
    postgres.execute(pool, named.sub(f"'{uuid_of(rover)}'", script))
    for name in ("log", "run", "progress"):
        owners = postgres.execute(pool, f"SELECT DISTINCT recording_uuid::text FROM {name}")
        assert owners == [(OTHER_UUID,)]
    ship(rover, url)
    assert pooled(url, uuid_of(rover)) == recorded(rover)


class Interrupted(list[PoolRow]):
    """Rows amid which something happens, once."""

    def __init__(self, rows: Sequence[PoolRow], at: int, happens: Callable[[], object]) -> None:
        super().__init__(rows)
        self._at, self._happens = at, happens

    def __iter__(self) -> Iterator[PoolRow]:
        for number, row in enumerate(super().__iter__()):
            if number == self._at:
                self._happens()
            yield row


def pieces(recording: sqlite3.Connection, rows: int) -> Iterator[Batch]:
    for whole in all_batches(recording):
        for start in range(0, len(whole.rows), rows):
            yield Batch(whole.table, whole.rows[start : start + rows])


def test_a_shipper_that_is_cut_off_50_times_loses_nothing_and_writes_nothing_twice(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    uuid, url, ends = uuid_of(rover), postgres.url(pool), 0
    cut = partial(postgres.end_backends, pool)
    for number, part in enumerate(pieces(rover, 300), 1):
        for end in range(ends, min(ends + 3, 50)):
            rows = Interrupted(part.rows, 13 * end % len(part.rows), cut)
            also = batch("robot", {"id": 99, "name": f"attempt {end}"})
            with pytest.raises(PoolUnavailableError), shipping(url, uuid) as shipment:
                shipment.write([also, Batch(part.table, rows)], {"parts": number, "end": end})
            ends = end + 1
        with shipping(url, uuid) as shipment:
            assert shipment.progress() == ({"parts": number - 1} if number > 1 else {})
            shipment.write([part], {"parts": number})
    assert ends == 50
    assert pooled(url, uuid) == recorded(rover)


def test_a_server_that_crashes_amid_a_write_has_all_of_it_or_nothing(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    uuid, url, states = uuid_of(rover), postgres.url(pool), table("state")
    rows = rows_of(rover, states)
    with shipping(url, uuid) as shipment:
        shipment.write([Batch(states, rows[:100])], {"state": 100})
        with pytest.raises(PoolUnavailableError):
            shipment.write([Batch(states, Interrupted(rows[100:], 500, postgres.stop))], {"a": 1})
    with pytest.raises(PoolUnavailableError), shipping(url, uuid):
        pass
    postgres.start()
    with shipping(url, uuid) as shipment:
        assert shipment.progress() == {"state": 100}
        assert postgres.execute(pool, "SELECT count(*) FROM state") == [(100,)]
        shipment.write([Batch(states, rows[100:])], {"state": 2050})
    assert pooled(url, uuid)["state"] == rows


def test_a_disk_that_is_full_is_said_and_left_as_it_was(
    postgres: Server, pool_template: str, rover: sqlite3.Connection
) -> None:
    with postgres.small_disk(40) as disk:
        pool = postgres.new_database(pool_template, disk.tablespace)
        uuid, url = uuid_of(rover), postgres.url(pool)
        with shipping(url, uuid) as shipment:
            shipment.write([batch("robot", {"name": "rover"})], {"some": 1})
            disk.fill()
            with pytest.raises(PoolUnavailableError, match="No space left"):
                shipment.write(list(all_batches(rover)), {"some": 2})
            assert shipment.progress() == {"some": 1}
            assert postgres.execute(pool, "SELECT count(*) FROM state") == [(0,)]
            disk.empty()
            shipment.write(list(all_batches(rover)), {"some": 2})
        assert pooled(url, uuid) == recorded(rover)
        postgres.execute("postgres", f"DROP DATABASE {pool} WITH (FORCE)")
