"""What both kinds of pools do: take rows once, all or nothing, and give them back as they were."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.plugins.pool.rows import (
    OTHER_UUID,
    UUID,
    batch,
    logs,
    pooled,
    pooled_rows,
    recorded,
    rows_of,
    run_row,
    ship,
    shipping,
    uuid_of,
)
from tests.postgres import Server
from tests.recordings.rover import Recorder, record_rover
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError
from webots_mcp.plugins.pool import duckdb_statement, postgres_pool
from webots_mcp.plugins.pool.pool_contents import open_pool, pooled_runs, pooled_trial_sets
from webots_mcp.plugins.pool.pool_interface import Pool, table
from webots_mcp.store.chunk_making import make_chunks


@dataclass
class Place:
    """Where a pool is, or can be made."""

    kind: str
    url: str
    server: Server | None = None
    database: str = ""

    def now_has_schema(self, version: int) -> None:
        """As if another version had made the pool."""
        if self.server is None:
            (Path(self.url) / "_pool").write_text(f'{{"format": 1, "schema": {version}}}')
        else:
            update = f"UPDATE pool_version SET version_num = '{version:04}'"
            self.server.execute(self.database, update)


def place_of(request: pytest.FixtureRequest, folder: Path) -> Place:
    if request.param == "parquet":
        return Place("parquet", str(folder / "pool"))
    server: Server = request.getfixturevalue("postgres")
    database = server.new_database()
    return Place("postgres", server.url(database), server, database)


KINDS = ["parquet", pytest.param("postgres", marks=pytest.mark.slow)]


@pytest.fixture(params=KINDS)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """Where nothing was shipped to yet."""
    return place_of(request, tmp_path)


@pytest.fixture(scope="module")
def story() -> Iterator[sqlite3.Connection]:
    """The known story, in chunks, with a trial set and JSON of all kinds; do not change it."""
    with memory_connection() as connection:
        record_rover(connection)
        assert make_chunks(connection, 100_000).done
        connection.execute("UPDATE run SET uuid = 'run ' || id")
        connection.execute("UPDATE run SET label = 'first' WHERE id < 3")
        recorder = Recorder(connection)
        recorder.run_id, recorder.run_start_s = 3, recorder.wall_s
        for text in ("[1, 2.50]", "-0.0", '{"b": "\\u0000", "a": 1e400}', '"\\ud800"', "null"):
            recorder.insert("event", **recorder.at(1.0), kind="odd", data=text)
            recorder.insert(
                "parameter_value", **recorder.at(1.0), name="p", value=text, is_default=0,
                set_by="code",
            )  # fmt: skip
        recorder.insert("trial_set", uuid="set", plan="{}", created_wall_time_s=5.0)
        for number, run_id in ((1, 2), (2, None), (3, 1)):
            recorder.insert(
                "trial", trial_set_id=1, uuid=f"trial {number}", number=number, parameters="{}",
                status="done", run_id=run_id,
            )  # fmt: skip
        yield connection


@pytest.fixture(scope="module", params=KINDS)
def shipped(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    story: sqlite3.Connection,
) -> Place:
    """A pool with the story; do not write into it."""
    place = place_of(request, tmp_path_factory.mktemp("shipped"))
    ship(story, place.url)
    return place


@pytest.fixture
def pool(shipped: Place) -> Iterator[Pool]:
    with open_pool(shipped.url) as opened:
        yield opened


# -- shipping ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_each_table_of_two_recordings_is_in_the_pool_row_by_row(
    place: Place, story: sqlite3.Connection, bridge_recording: Path
) -> None:
    with closing(connect(bridge_recording, "reader")) as bridge:
        for recording in (story, bridge):
            ship(recording, place.url)
        for recording in (story, bridge):
            assert pooled(place.url, uuid_of(recording)) == recorded(recording)


def test_a_row_replaces_the_one_of_its_key_but_what_lasts_is_not_lost(place: Place) -> None:
    claimed = {"status": "claimed", "session_id": 4}
    done = {"status": "done", "session_id": None}
    with shipping(place.url) as shipment:
        shipment.write([batch("command", claimed, claimed | {"id": 2})], {"command": 1})
        shipment.write([batch("command", done)], {"command": 2})
        twice = [
            batch("command", done | {"id": 3}),
            batch("command", done | {"id": 3, "error": "e"}),
        ]
        shipment.write(twice, {"other": -5})
        assert shipment.progress() == {"command": 2, "other": -5}
    columns = table("command").columns
    places = [columns.index(name) for name in ("id", "status", "session_id", "error")]
    found = [tuple(row[at] for at in places) for row in pooled_rows(place.url, UUID, "command")]
    assert found == [(1, "done", 4, None), (2, "claimed", 4, None), (3, "done", None, "e")]


def test_what_is_listed_is_what_was_written_last(place: Place) -> None:
    with shipping(place.url) as shipment:
        for rows in ([run_row(1, 3)], [run_row(1, 5)], [run_row(1, 6), run_row(2, 0)]):
            shipment.write([batch("robot", {"name": "r"}), batch("run", *rows)], {})
    with open_pool(place.url) as pool:
        assert {run.uuid: run.row_count for run in pooled_runs(pool)} == {"run-1": 6, "run-2": 0}


def test_a_run_belongs_to_the_recording_that_shipped_it_first(place: Place) -> None:
    with shipping(place.url) as shipment:
        assert shipment.foreign_runs(["run-1"]) == {}
        shipment.write([batch("run", run_row(1, 3))], {})
        assert shipment.foreign_runs(["run-1"]) == {}
    with shipping(place.url, OTHER_UUID) as shipment:
        assert shipment.foreign_runs(["run-1", "run-2"]) == {"run-1": UUID}
        with pytest.raises(PoolError, match="run"):
            shipment.write([logs(1), batch("run", run_row(1, 3))], {"run": 1})
        assert shipment.progress() == {}
        shipment.write([batch("run", run_row(2, 3))], {})
    assert len(pooled_rows(place.url, OTHER_UUID, "run")) == 1
    assert pooled_rows(place.url, OTHER_UUID, "log") == []


def test_a_second_shipper_of_a_recording_is_refused_until_the_first_is_done(place: Place) -> None:
    with shipping(place.url) as shipment:
        with pytest.raises(PoolBusyError), shipping(place.url):
            pass
        with shipping(place.url, OTHER_UUID):
            pass
        shipment.write([], {"a": 1})
    with shipping(place.url) as shipment:
        assert shipment.progress() == {"a": 1}


def test_a_picture_is_kept_by_its_path(place: Place) -> None:
    with shipping(place.url) as shipment:
        shipment.write_picture("camera/1.png", b"old")
        shipment.write_picture("camera/1.png", b"\x89PNG\0\xff")
        shipment.write([], {})
    with open_pool(place.url) as pool:
        assert pool.picture(UUID, "camera/1.png") == b"\x89PNG\0\xff"
        assert pool.picture(UUID, "camera/2.png") is None


@pytest.mark.parametrize("version", [9, 999])
def test_a_pool_of_another_version_is_refused_and_left_alone(place: Place, version: int) -> None:
    with shipping(place.url) as shipment:
        shipment.write([logs(1)], {})
    place.now_has_schema(version)
    for ships in (True, False):
        with (
            pytest.raises(PoolError, match=f"schema {version}, this webots-mcp .*ship .* anew"),
            open_pool(place.url, ships=ships),
        ):
            pass


# -- reading ----------------------------------------------------------------------------------


def test_where_nothing_was_shipped_is_no_pool(place: Place) -> None:
    with pytest.raises(PoolError, match=r"no pool"), open_pool(place.url):
        pass


def test_the_rows_of_some_runs_come_back(shipped: Place, story: sqlite3.Connection) -> None:
    uuid = uuid_of(story)
    for name, runs in (("state", (3, 2)), ("state", (99,)), ("state", ()), ("event", (1,))):
        each = table(name)
        at = each.columns.index("run_id")
        expected = [row for row in rows_of(story, each) if row[at] in runs]
        assert pooled_rows(shipped.url, uuid, name, {"run_id": runs}) == expected
    chunks = pooled_rows(shipped.url, uuid, "chunk", {"run_id": (1, 99)})
    assert len(chunks) == len([row for row in rows_of(story, table("chunk")) if row[2] == 1]) > 0
    assert pooled_rows(shipped.url, "00000000-0000-4000-8000-000000000000", "state") == []


def test_two_tables_can_be_read_at_once(pool: Pool, story: sqlite3.Connection) -> None:
    logs, events = (pool.rows(uuid_of(story), table(name), {}) for name in ("log", "event"))
    assert (len(next(logs).rows), len(next(events).rows)) == (3, 9)


def test_what_is_there_is_listed(pool: Pool, story: sqlite3.Connection) -> None:
    uuid = uuid_of(story)
    assert [(run.robot, run.run_id, run.uuid, run.label) for run in pooled_runs(pool)] == [
        ("rover", 1, "run 1", "first"), ("rover", 2, "run 2", "first"), ("rover", 3, "run 3", None)
    ]  # fmt: skip
    (trials,) = pooled_trial_sets(pool)
    assert (trials.uuid, trials.trials, sorted(trials.runs)) == ("set", 3, [(uuid, 1), (uuid, 2)])
    assert pool.progress(uuid) == {"shipped": 1}


@pytest.mark.slow
def test_one_select_is_answered_up_to_its_limit(pool: Pool) -> None:
    found = pool.select("SELECT id, 1.5 AS number, NULL, true FROM run ORDER BY id -- etc.", 2)
    assert found.columns[:2] == ("id", "number")
    assert found.rows == ((1, 1.5, None, True), (2, 1.5, None, True))
    assert found.truncated == "only the first 2 rows; narrow the question, or count and aggregate"
    assert pool.select("SELECT '; -- no end'", 9).rows == (("; -- no end",),)
    ((uuid,),) = pool.select("SELECT recording_uuid FROM robot", 1).rows
    assert isinstance(uuid, str)
    found = pool.select("SELECT recording_uuid, reason FROM kept_stretch", 1)
    assert (found.columns, found.rows) == (("recording_uuid", "reason"), ())


REFUSED: list[tuple[str, dict[str, str]]] = [
    ("SELECT 1; DROP TABLE run", {"parquet": "this has SELECT, DROP", "postgres": "multiple comm"}),
    ("DROP TABLE run", {"parquet": "only one SELECT .* has DROP", "postgres": "syntax error"}),
    ("COPY (SELECT 1) TO '/tmp/x.csv'", {"parquet": "this has COPY", "postgres": "syntax error"}),
    ("", {"parquet": "no statement", "postgres": "syntax error"}),
    ("SELECT nothing FROM run", {"parquet": "Binder Error", "postgres": 'column "nothing" does'}),
    ("SELECT * FROM read_csv('/etc/passwd')", {"parquet": "Permission", "postgres": "not exist"}),
    ("WITH g AS (DELETE FROM run RETURNING id) SELECT * FROM g", {"postgres": "WITH"}),
    ("SELECT $1", {"postgres": r"a parameter such as \$1 has no"}),
    ("SELECT 1 / 0", {"postgres": "division by zero"}),
]


@pytest.mark.slow
def test_anything_else_than_a_select_is_refused_and_changes_nothing(
    shipped: Place, pool: Pool
) -> None:
    for sql, said in REFUSED:
        if shipped.kind in said:
            with pytest.raises(InvalidInputError, match=said[shipped.kind]):
                pool.select(sql, 10)
        if shipped.kind == "postgres":  # whose connection could be left in a failed transaction
            assert pool.select("SELECT 1", 1).rows == ((1,),)
    assert pool.select("SELECT count(*) FROM run", 1).rows == ((3,),)


SLOW = {
    "parquet": "SELECT sum(a.range * b.range) FROM range(1000000) a, range(1000000) b",
    "postgres": "SELECT pg_sleep(0.06) FROM generate_series(1, 900)",
}


def test_a_select_that_takes_too_long_is_ended(
    shipped: Place, pool: Pool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgres_pool, "SELECT_S", 0.1)
    monkeypatch.setattr(duckdb_statement, "DEADLINE_S", 0.05)
    with pytest.raises(InvalidInputError, match=r"timeout|no answer within 0.05 s: narrow it"):
        pool.select(SLOW[shipped.kind], 900)


def test_a_value_that_is_no_json_is_text_in_postgresql_and_counted(place: Place) -> None:
    texts = ["", "{", '{"a": NaN}', "[" * 100_000, '{"a": 1}']
    rows: list[dict[str, Any]] = [{"id": n, "data": text} for n, text in enumerate(texts)]
    with shipping(place.url) as shipment:
        replaced = shipment.write([batch("state", *rows), batch("log", {"message": "a\0b"})], {})
    data = table("state").columns.index("data")
    found = [row[data] for row in pooled_rows(place.url, UUID, "state")]
    if place.kind == "parquet":
        assert (found, dict(replaced)) == (texts, {})
        return
    assert {name: n for name, n in replaced.items() if n} == {"state.data": 4, "log.message": 1}
    assert found == ['""', '"{"', '"{\\"a\\": NaN}"', f'"{"[" * 100_000}"', '{"a": 1}']
    (log,) = pooled_rows(place.url, UUID, "log")
    assert "a\N{REPLACEMENT CHARACTER}b" in log
