"""What a shipment writes into PostgreSQL: all of it or nothing, and nothing twice."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any
from uuid import UUID

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict

from tests.memory import memory_connection
from tests.pool.postgres.shipped import (
    all_batches,
    assert_equal,
    pooled_rows,
    rows_of,
    ship,
    uuid_of,
)
from tests.postgres import Server
from tests.recordings.rover import record_rover
from webots_mcp.connection import connect
from webots_mcp.errors import PoolBusyError, PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.pool_interface import Batch, Row, table, tables
from webots_mcp.plugins.pool.postgres_pool import PostgresShipment, PostgresTarget
from webots_mcp.plugins.pool.postgres_schema import connect as connect_pool
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.slow

SECRET = "quite-a-secret-7"
OTHER = "00000000-0000-4000-8000-00000000000a"
COUNT = "SELECT count(*) FROM "


@pytest.fixture(scope="module")
def rover() -> Iterator[sqlite3.Connection]:
    """The known story; do not change it."""
    with memory_connection() as connection:
        record_rover(connection)
        assert make_chunks(connection, 100_000).done
        connection.execute("UPDATE run SET uuid = 'run ' || id")
        yield connection


@pytest.fixture
def target(postgres: Server, pool: str) -> Iterator[PostgresTarget]:
    with PostgresTarget(postgres.url(pool)) as opened:
        yield opened


def batch(of: str, /, **values: Any) -> Batch:
    """One row of a table, with the least of values where nothing is said."""
    shipped = table(of)
    usual = {"id": 1, "uuid": None} | {
        column: kind() for column, kind in zip(shipped.columns, shipped.types, strict=True)
        if column not in shipped.nullable and column != "id"
    }  # fmt: skip
    usual |= dict.fromkeys(shipped.json_columns - shipped.nullable, "{}")
    row = usual | values
    return Batch(shipped, [tuple(row.get(column) for column in shipped.columns)])


def first(server: Server, pool: str, sql: str) -> Any:
    return server.execute(pool, sql)[0][0]


def replaced(server: Server, pool: str) -> int:
    return first(server, pool, "SELECT replaced_values FROM shipment")


def test_a_pool_has_each_row_of_each_table_as_it_was_recorded(
    postgres: Server, pool: str, rover: sqlite3.Connection, bridge_recording: Path
) -> None:
    with closing(connect(bridge_recording, "reader")) as bridge:
        for recording in (rover, bridge):
            ship(postgres, pool, recording)
        for recording in (rover, bridge):
            assert_equal(postgres, pool, recording)
    assert {
        count for (count,) in postgres.execute(pool, "SELECT replaced_values FROM shipment")
    } == {0}


def test_what_is_written_again_changes_no_row(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    ship(postgres, pool, rover)
    versions = {each.name: versions_of(postgres, pool, each.name) for each in tables()}
    ship(postgres, pool, rover)
    assert {each.name: versions_of(postgres, pool, each.name) for each in tables()} == versions


def versions_of(server: Server, pool: str, name: str) -> list[Any]:
    return sorted(server.execute(pool, f"SELECT ctid::text, xmin::text FROM {name}"))


def test_a_row_that_changed_replaces_the_one_of_before(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("command", status="pending", session_id=7)], {"command": 1})
        shipment.write([batch("command", id=2, status="done")], {"command": 2})
        changed = batch("command", status="done", result='{"a": 1}', session_id=None)
        shipment.write([changed], {"other": -5})
        assert shipment.progress() == {"command": 2, "other": -5}
    found = postgres.execute(pool, "SELECT id, status, result, session_id FROM command ORDER BY id")
    assert found == [(1, "done", {"a": 1}, 7), (2, "done", None, None)]


def test_a_row_that_is_there_twice_in_a_write_is_the_last(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("robot", name="a"), batch("robot", name="b")], {})
        log = batch("log", message="a")
        shipment.write([log, batch("log", message="b"), log], {})
    assert postgres.execute(pool, "SELECT name FROM robot") == [("b",)]
    assert postgres.execute(pool, "SELECT message FROM log") == [("a",)]


def test_a_text_that_postgresql_lacks_comes_near_and_is_counted(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    texts = ["a\0b", "\\N \t tab\\ \n \u2028 \\."]
    with target.shipment(OTHER) as shipment:
        for number, text in enumerate(texts):
            found = shipment.write([batch("log", id=number, message=text)], {})
            assert found == ({"log.message": 1} if number == 0 else {})
    held = [text for (text,) in postgres.execute(pool, "SELECT message FROM log ORDER BY id")]
    assert held == ["a\N{REPLACEMENT CHARACTER}b", texts[1]]
    assert replaced(postgres, pool) == 1


def test_what_jsonb_lacks_is_held_as_text(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    texts = ["", "{", '{"a": NaN}', '{"a": "\\u0000"}', "[" * 100_000, "1e999999"]
    good = batch("state", data='{"pose": [1, 2]}')
    odd = [batch("state", id=2 + number, data=text) for number, text in enumerate(texts)]
    signals = [
        batch("signal", id=3 + number, name=f"pose.{number}", path=f"$.pose[{number}]", role=role)
        for number, role in enumerate("xy")
    ]
    with target.shipment(OTHER) as shipment:
        shipment.write([Batch(good.table, [*good.rows, *each.rows]) for each in odd], {})
        shipment.write([batch("run", id=0), *signals], {})
    sql = "SELECT data #>> '{}' FROM state WHERE jsonb_typeof(data) = 'string' ORDER BY id"
    assert postgres.execute(pool, sql) == [(text,) for text in texts]
    assert first(postgres, pool, "SELECT x_m FROM robot_trajectory WHERE state_id = 1") == 1


def test_a_state_that_retention_moved_after_it_was_shipped_is_there_once(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("state", sim_time_s=1.5, wall_time_s=3.0)], {})
        moved = [batch("kept_state", id=n, sim_time_s=n + 0.5, wall_time_s=3.0) for n in (1, 2)]
        called = batch("kept_state", id=3, sim_time_s=1.5, wall_time_s=3.0, call=7)
        shipment.write([*moved, called], {})
    sql = "SELECT sim_time_s, state_id FROM all_state ORDER BY 1, 2"
    assert postgres.execute(pool, sql) == [(1.5, 1), (1.5, None), (2.5, None)]


def test_rows_stand_in_the_partition_of_their_month(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    times = {-5.0: "before_2000", 1e300: "after_2099", 1.7e9: "2023_11", 1701388799.9: "2023_11",
             1701388800.0: "2023_12", 4102444799.0: "2099_12", 951782400.0: "2000_02"}  # fmt: skip
    with target.shipment(OTHER) as shipment:
        batches = [batch("event", id=n, wall_time_s=time) for n, time in enumerate(times)]
        shipment.write(batches, {})
    found = postgres.execute(pool, "SELECT tableoid::regclass::text, id FROM event ORDER BY id")
    assert [name for name, _ in found] == [f"event_{each}" for each in times.values()]


def test_a_month_that_somebody_dropped_is_made_again(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("log", wall_time_s=1.7e9)], {})
        postgres.execute(pool, "DROP TABLE log_2023_11")
        shipment.write([batch("log", id=2, wall_time_s=1.7e9)], {})
    assert postgres.execute(pool, "SELECT id FROM log") == [(2,)]


def test_several_that_need_the_same_months_at_once_all_get_them(
    postgres: Server, pool: str
) -> None:
    months = [batch("event", id=n, wall_time_s=1.6e9 + n * 2_700_000.0) for n in range(12)]

    def write_all(number: int) -> None:
        uuid = f"00000000-0000-4000-8000-00000000000{number}"
        with PostgresTarget(postgres.url(pool)) as target, target.shipment(uuid) as shipment:
            shipment.write(months[::-1] if number % 2 else months, {"a": 1})

    with ThreadPoolExecutor(4) as threads:
        list(threads.map(write_all, range(4)))
    sql = "SELECT count(*), count(DISTINCT tableoid) FROM event"
    assert postgres.execute(pool, sql) == [(48, 12)]


def test_who_ships_need_not_own_the_tables(postgres: Server, pool: str) -> None:
    postgres.execute(pool, "CREATE ROLE shipper LOGIN")
    postgres.execute(pool, "GRANT SELECT, INSERT, UPDATE ON ALL TABLES IN SCHEMA public TO shipper")
    with PostgresTarget(postgres.url(pool, user="shipper")) as opened:
        opened.prepare()
        with opened.shipment(OTHER) as shipment:
            log = batch("log", wall_time_s=1.7e9)
            with pytest.raises(PoolError, match=r"make_partition.*what to grant"):
                shipment.write([log], {})
            postgres.execute(pool, "GRANT EXECUTE ON ALL FUNCTIONS IN SCHEMA public TO shipper")
            shipment.write([log], {})
    assert postgres.execute(pool, "SELECT id FROM log") == [(1,)]


def test_who_makes_a_month_cannot_slip_a_table_of_his_own_under_it(
    postgres: Server, pool: str
) -> None:
    postgres.execute(pool, "CREATE ROLE sly LOGIN; GRANT SELECT ON event TO sly")
    postgres.execute(pool, "GRANT EXECUTE ON ALL FUNCTIONS IN SCHEMA public TO sly")
    with psycopg.connect(postgres.url(pool, user="sly")) as connection:
        own = "CREATE TEMPORARY TABLE event (LIKE public.event) PARTITION BY RANGE (wall_time_s)"
        connection.execute(own.encode())
        connection.execute("SELECT make_partition('event', 2023, 11)")
    sql = "SELECT inhparent::regclass::text FROM pg_inherits WHERE inhrelid = %s::regclass"
    assert postgres.execute(pool, sql, "public.event_2023_11") == [("event",)]


def test_a_picture_is_kept_by_its_path(postgres: Server, pool: str, target: PostgresTarget) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write_picture("camera/1.png", b"old")
        shipment.write_picture("camera/1.png", b"\x89PNG\0\xff")
        shipment.write([], {})
    found = postgres.execute(pool, "SELECT recording_uuid, path, content FROM picture")
    assert found == [(UUID(OTHER), "camera/1.png", b"\x89PNG\0\xff")]


def test_a_run_belongs_to_the_recording_that_shipped_it_first(
    postgres: Server, pool: str, rover: sqlite3.Connection, target: PostgresTarget
) -> None:
    ship(postgres, pool, rover)
    with target.shipment(OTHER) as shipment:
        owners = shipment.foreign_runs(["run 1", "run 3", "run 9"])
        assert owners == dict.fromkeys(("run 1", "run 3"), uuid_of(rover))
        with pytest.raises(PoolError, match="run 3"):
            shipment.write([batch("robot"), batch("run", uuid="run 3")], {"robot": 1})
        assert shipment.progress() == {}
        shipment.write([batch("run", uuid="run 9")], {})
    with target.shipment(uuid_of(rover)) as shipment:
        assert shipment.foreign_runs(["run 1", "run 9"]) == {"run 9": OTHER}
    assert postgres.execute(pool, "SELECT name FROM robot") == [("rover",)]


def test_of_two_that_ship_a_run_at_once_one_does(postgres: Server, pool: str) -> None:
    uuids = [f"00000000-0000-4000-8000-00000000000{n}" for n in range(6)]

    def shipped(uuid: str) -> bool:
        with PostgresTarget(postgres.url(pool)) as opened, opened.shipment(uuid) as shipment:
            try:
                shipment.write([batch("run", uuid="the same")], {})
            except PoolError:
                return False
            return True

    with ThreadPoolExecutor(len(uuids)) as all_at_once:
        assert sorted(all_at_once.map(shipped, uuids)) == [False] * 5 + [True]
    assert first(postgres, pool, f"{COUNT} run") == 1


def test_a_second_shipper_of_a_recording_is_refused_until_the_first_is_gone(
    postgres: Server, pool: str
) -> None:
    url = postgres.url(pool)
    with PostgresTarget(url) as one, PostgresTarget(url) as two:
        with one.shipment(OTHER):
            with pytest.raises(PoolBusyError, match=OTHER), two.shipment(OTHER):
                pass
            with two.shipment("00000000-0000-4000-8000-00000000000b"):
                pass
            assert postgres.end_backends(pool) == 2
            with pytest.raises(PoolUnavailableError), two.shipment(OTHER):
                pass
            with two.shipment(OTHER) as shipment:  # connected anew
                shipment.write([], {"a": 1})
        with one.shipment(OTHER) as shipment:
            assert shipment.progress() == {"a": 1}


def test_two_that_write_the_same_rows_all_the_same_write_none_twice(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    """As if a lock had been lost: the rows themselves keep them apart."""
    batches = [part for each in all_batches(rover) for part in pieces(each, 300)]

    def write_all(ways: Sequence[Batch]) -> None:
        with connect_pool(postgres.url(pool), "here") as connection:
            shipment = PostgresShipment(connection, "here", uuid_of(rover))
            for number, each in enumerate(ways):
                shipment.write([each], {each.table.name: number})

    with ThreadPoolExecutor(3) as threads:
        list(threads.map(write_all, [batches, batches[::-1], batches]))
    assert_equal(postgres, pool, rover)


def pieces(whole: Batch, rows: int) -> Iterator[Batch]:
    for start in range(0, len(whole.rows), rows):
        yield Batch(whole.table, whole.rows[start : start + rows])


def test_a_recording_is_deleted_as_the_page_says_and_shipped_anew(
    postgres: Server, pool: str, rover: sqlite3.Connection, target: PostgresTarget
) -> None:
    ship(postgres, pool, rover)
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("log"), batch("run", uuid="its own")], {"a": 1})
    page = (Path(__file__).parents[3] / "docs" / "pool.md").read_text("utf-8")
    found = re.search(r"```postgresql\n(DO .*?)```", page, re.DOTALL)
    assert found
    named = re.compile("'6719d286-[-0-9]*'")
    postgres.execute(pool, named.sub(f"'{uuid_of(rover)}'", found[1]))
    for name in ("log", "run", "run_owner", "progress"):
        assert owners_in(postgres, pool, name) == {OTHER}
    ship(postgres, pool, rover)
    assert_equal(postgres, pool, rover)


def owners_in(server: Server, pool: str, name: str) -> set[str]:
    return {uuid for (uuid,) in server.execute(pool, f"SELECT recording_uuid::text FROM {name}")}


class Interrupted(list[Row]):
    """Rows amid which something happens, once."""

    def __init__(self, rows: Sequence[Row], at: int, happens: Callable[[], object]) -> None:
        super().__init__(rows)
        self._at, self._happens = at, happens

    def __iter__(self) -> Iterator[Row]:
        for number, row in enumerate(super().__iter__()):
            if number == self._at:
                self._happens()
            yield row


def test_a_shipper_that_is_cut_off_50_times_loses_nothing_and_writes_nothing_twice(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    uuid, number, ends = uuid_of(rover), 0, 0
    for number, part in enumerate((p for each in all_batches(rover) for p in pieces(each, 300)), 1):
        with PostgresTarget(postgres.url(pool)) as target:
            for end in range(ends, min(ends + 3, 50)):
                rows = Interrupted(
                    part.rows, 13 * end % len(part.rows), lambda: cut(postgres, pool)
                )
                also = batch("robot", id=99, name=f"attempt {end}")
                with pytest.raises(PoolUnavailableError), target.shipment(uuid) as shipment:
                    shipment.write([also, Batch(part.table, rows)], {"parts": number, "end": end})
                ends = end + 1
            with target.shipment(uuid) as shipment:
                assert shipment.progress() == ({"parts": number - 1} if number > 1 else {})
                shipment.write([part], {"parts": number})
    assert ends == 50
    assert_equal(postgres, pool, rover)


def cut(server: Server, pool: str) -> None:
    assert server.end_backends(pool) == 1


def test_a_server_that_crashes_amid_a_write_has_all_of_it_or_nothing(
    postgres: Server, pool: str, rover: sqlite3.Connection
) -> None:
    uuid, states = uuid_of(rover), table("state")
    rows = rows_of(rover, states)

    def crash() -> None:
        postgres.stop()

    with PostgresTarget(postgres.url(pool)) as target:
        with target.shipment(uuid) as shipment:
            shipment.write([Batch(states, rows[:100])], {"state": 100})
        with pytest.raises(PoolUnavailableError), target.shipment(uuid) as shipment:
            shipment.write([Batch(states, Interrupted(rows[100:], 500, crash))], {"state": 2050})
        with pytest.raises(PoolUnavailableError), target.shipment(uuid):
            pass
        postgres.start()
        with target.shipment(uuid) as shipment:
            assert shipment.progress() == {"state": 100}
            assert len(pooled_rows(postgres, pool, uuid, states)) == 100
            shipment.write([Batch(states, rows[100:])], {"state": 2050})
    assert [row[0] for row in pooled_rows(postgres, pool, uuid, states)] == [row[0] for row in rows]


def test_a_disk_that_is_full_is_said_and_left_as_it_was(
    postgres: Server, pool_template: str, rover: sqlite3.Connection
) -> None:
    with postgres.small_disk(40) as disk:
        pool = postgres.new_database(pool_template, disk.tablespace)
        uuid, url = uuid_of(rover), postgres.url(pool)
        with PostgresTarget(url) as target, target.shipment(uuid) as shipment:
            shipment.write([batch("robot", name="rover")], {"some": 1})
            disk.fill()
            with pytest.raises(PoolUnavailableError, match="full"):
                shipment.write(list(all_batches(rover)), {"some": 2})
            assert shipment.progress() == {"some": 1}
            assert first(postgres, pool, f"{COUNT} state") == 0
            disk.empty()
            shipment.write(list(all_batches(rover)), {"some": 2})
        assert_equal(postgres, pool, rover)
        postgres.execute("postgres", f"DROP DATABASE {pool} WITH (FORCE)")


def test_a_target_that_became_read_only_is_said(
    postgres: Server, pool: str, target: PostgresTarget
) -> None:
    with target.shipment(OTHER) as shipment:
        shipment.write([batch("log")], {"a": 1})
        shipment._connection.execute("SET default_transaction_read_only = on")
        with pytest.raises(PoolError, match="read-only") as refused:
            shipment.write([batch("log", id=2)], {"a": 2})
    assert not isinstance(refused.value, PoolUnavailableError)
    assert postgres.execute(pool, "SELECT id FROM log") == [(1,)]


def test_nothing_is_shipped_into_an_older_pool(postgres: Server, pool: str) -> None:
    postgres.execute(pool, "UPDATE pool_version SET version_num = '0008'")
    opened = PostgresTarget(postgres.url(pool))
    with opened as target, pytest.raises(PoolError, match="has schema 8"), target.shipment(OTHER):
        pass


@pytest.fixture
def guarded(postgres: Server, pool: str) -> Iterator[str]:
    """The URL of a pool for a role that has to tell a password."""
    postgres.execute(pool, f"CREATE ROLE guarded LOGIN SUPERUSER PASSWORD '{SECRET}'")
    yield postgres.url(pool, user="guarded")
    postgres.execute(pool, "DROP OWNED BY guarded; DROP ROLE guarded")


def test_a_password_comes_from_where_libpq_looks(
    guarded: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "pgpass"
    file.write_text(f"*:*:*:guarded:{SECRET}\n")
    file.chmod(0o600)
    for name, value in (("PGPASSWORD", SECRET), ("PGPASSFILE", str(file))):
        with monkeypatch.context() as environment:
            environment.setenv(name, value)
            with PostgresTarget(guarded) as target:
                target.prepare()
    service = tmp_path / "services"
    fields = conninfo_to_dict(guarded)
    text = "\n".join(f"{name}={value}" for name, value in fields.items())
    service.write_text(f"[lab]\n{text}\npassword={SECRET}\n")
    monkeypatch.setenv("PGSERVICEFILE", str(service))
    with PostgresTarget("postgresql:///?service=lab") as target:
        assert target.address == "postgresql:///?service=lab"
        target.prepare()


@pytest.mark.parametrize(
    ("password", "said"), [(None, "asks for a password"), (f"{SECRET}x", "authentication failed")]
)
def test_a_password_that_is_missing_or_wrong_is_told_and_not_shown(
    guarded: str, monkeypatch: pytest.MonkeyPatch, password: str | None, said: str
) -> None:
    if password:
        monkeypatch.setenv("PGPASSWORD", password)
    monkeypatch.setenv("PGPASSFILE", "/nonexistent")
    with pytest.raises(PoolError, match=said) as refused, PostgresTarget(guarded):
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
        ("postgresql://127.0.0.1:1/robots?colour=red", False, "invalid URI query parameter"),
    ],
)
def test_a_server_that_does_not_answer_is_told_from_one_that_never_will(
    url: str, unavailable: bool, said: str
) -> None:
    with pytest.raises(PoolError, match=said) as refused, PostgresTarget(url):
        pass
    assert isinstance(refused.value, PoolUnavailableError) is unavailable


def test_a_database_or_role_that_is_not_there_is_told(postgres: Server) -> None:
    for url in (postgres.url("nothing"), postgres.url("postgres", user="nobody-here")):
        with pytest.raises(PoolError, match="does not exist") as refused, PostgresTarget(url):
            pass
        assert not isinstance(refused.value, PoolUnavailableError)
