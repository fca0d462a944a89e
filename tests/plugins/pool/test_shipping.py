"""A pool comes to hold what a recording holds, whatever happens in between."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests import unprivileged
from tests.older_recording import OLDER_SCHEMA
from tests.plugins.pool.conftest import Shipped
from tests.plugins.pool.parquet import bucket
from tests.plugins.pool.rows import BeforeWrite, pooled, shipping
from tests.recordings.runs import states
from webots_mcp.contract import host_name, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import (
    DatabaseError,
    PoolBusyError,
    PoolError,
    PoolUnavailableError,
    SchemaTooOldError,
)
from webots_mcp.plugins.pool.pool_contents import open_pool, pooled_runs
from webots_mcp.plugins.pool.pool_interface import BATCH_BYTES, is_whole, table
from webots_mcp.plugins.pool.shipping import LAST_GROUP, ShippingJob, ShippingReport, follow
from webots_mcp.plugins.pool.shipping_source import ShippingSource
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.merging import merge
from webots_mcp.store.recording import RecordingAccess


def test_a_pool_at_full_rate_holds_every_row_as_the_recording_does(shipped: Shipped) -> None:
    shipped.add_run(2500)
    shipped.add_run(60, end=None)
    shipped.ship(full=True)
    rows = shipped.rows()
    assert shipped.pooled() == rows
    assert all(rows[table] for table in ("state", "row_group", "chunk", "signal"))


def test_a_run_whose_process_was_killed_is_over_in_the_pool(shipped: Shipped) -> None:
    shipped.add_run(end=None)
    gone = subprocess.Popen(["true"])
    gone.wait()
    shipped.connection.execute(
        "UPDATE session SET pid = ?, host = ?, ended_wall_time_s = NULL, end_reason = NULL",
        (gone.pid, host_name()),
    )
    shipped.ship()
    with open_pool(str(shipped.pool)) as pool:
        (run,) = pooled_runs(pool)
        assert run.end_reason == "crashed"
        assert is_whole(pool.progress(shipped.uuid), run.run_id)


def test_the_last_rows_of_a_run_that_is_over_are_in_chunks_in_the_pool(shipped: Shipped) -> None:
    shipped.recorded.add_run(1100)
    assert not shipped.ship().notes
    rows = table("row_group").columns.index("row_count")
    assert [group[rows] for group in shipped.pooled()["row_group"]] == [1024, 76]


def test_states_that_are_neither_shipped_nor_in_chunks_are_said(shipped: Shipped) -> None:
    shipped.recorded.add_run(1044, end=None)
    assert shipped.ship().notes[0].startswith("20 states are in no chunk yet")
    assert not shipped.ship(full=True).notes
    assert not shipped.ship().notes  # the pool has them since


def test_what_is_shipped_is_not_sent_again(shipped: Shipped) -> None:
    shipped.add_run()
    shipped.ship(full=True)
    assert shipped.ship(full=True).rows.total() == 0


def test_only_what_came_since_is_sent(shipped: Shipped) -> None:
    shipped.add_run(2000, end=None)
    shipped.ship(full=True)
    shipped.recorded.publish(1000.0, {"x": 1, "mode": "c"})
    shipped.make_chunks()
    sent = shipped.ship(full=True).rows
    assert shipped.pooled() == shipped.rows()
    assert (sent["state"], sent["event"], sent["chunk"]) == (1, 0, 0)


def test_without_full_rate_no_states_are_sent_but_those_of_kept_stretches(
    shipped: Shipped,
) -> None:
    run_id = shipped.add_run(60)
    shipped.keep(run_id, 2, 4)
    shipped.ship()
    pooled, rows = shipped.pooled(), shipped.rows()
    sim_time_s = 2
    assert pooled["state"] == [row for row in rows["state"] if 2 <= row[sim_time_s] <= 4]
    assert {**pooled, "state": []} == {**rows, "state": []}
    assert shipped.ship().rows.total() == 0
    shipped.ship(full=True)
    assert shipped.pooled() == rows


@pytest.mark.parametrize("full", [False, True])
def test_a_kept_state_that_retention_moved_stays_in_the_pool_as_it_was(
    shipped: Shipped, full: bool
) -> None:
    run_id = shipped.add_run(60)
    shipped.keep(run_id, 2, 4)
    shipped.ship(full=full)
    before = shipped.pooled()["state"]
    shipped.recorded.prune(states(rows=0))
    assert shipped.rows()["kept_state"]
    shipped.ship(full=full)
    assert shipped.pooled()["state"] == before
    assert shipped.pooled()["kept_state"] == shipped.rows()["kept_state"]


def test_states_of_stretches_that_overlap_are_sent_once(shipped: Shipped) -> None:
    run_id = shipped.add_run(60, end=None)
    shipped.keep(run_id, 2, 4)
    assert shipped.ship().rows["state"] == 5
    shipped.keep(run_id, 3, 6)
    shipped.keep(run_id, 5, 6)
    assert shipped.ship().rows["state"] == 4
    assert shipped.ship(full=True).rows["state"] == 60 - 9
    shipped.keep(run_id, 0, 20)
    assert shipped.ship().rows["state"] == 0


def test_kept_states_that_were_moved_before_anything_was_shipped_are_in_the_pool(
    shipped: Shipped,
) -> None:
    run_id = shipped.add_run(60)
    shipped.keep(run_id, 2, 4)
    shipped.recorded.prune(states(rows=0))
    shipped.ship()
    assert shipped.pooled()["kept_state"] == shipped.rows()["kept_state"] != []


def test_what_retention_deletes_stays_in_the_pool(shipped: Shipped) -> None:
    shipped.add_run(60)
    shipped.ship(full=True)
    before = shipped.pooled()
    shipped.connection.execute("DELETE FROM run")
    shipped.connection.execute("DELETE FROM command")
    shipped.ship(full=True)
    assert shipped.pooled() == before


def test_rows_that_retention_deleted_too_early_are_counted(shipped: Shipped) -> None:
    shipped.add_run(60)
    shipped.ship(full=True)
    shipped.add_run(60)
    shipped.add_run(60)
    shipped.recorded.prune(states(rows=70))
    assert shipped.ship(full=True).lost == {"state": 60}


def test_a_run_that_another_recording_has_shipped_stays_that_ones(
    shipped: Shipped, tmp_path: Path
) -> None:
    shipped.add_run(60)
    shipped.recorded.insert(
        "parameter", robot_id=shipped.recorded.robot_id, session_id=1, name="kp", kind="float",
        default_value="1.0", doc="", declared_wall_time_s=1.0,
    )  # fmt: skip
    folder = tmp_path / "other"
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        other = Shipped(folder, connection, shipped.pool)
        own = other.add_run(20)
        shipped.connection.execute("UPDATE session SET uuid = ?", (new_uuid(),))
        merge(connection, folder, shipped.folder / "webots.db")
        other.make_chunks()
        shipped.ship(full=True)
        report = other.ship(full=True)
        (run,) = other.pooled()["run"]
        assert run[0] == own
        assert {row[1] for row in other.pooled()["state"]} == {own}
        for of_session, here, there in (("session", 2, 1), ("command", 2, 1), ("parameter", 1, 0)):
            assert other.recorded.count(of_session) == here
            assert len(other.pooled()[of_session]) == there
        assert list(report.foreign.values()) == [shipped.uuid]
    assert shipped.pooled() == shipped.rows()


def test_pictures_are_shipped_when_they_are_asked_for_also_later(shipped: Shipped) -> None:
    shipped.add_run()
    shipped.ship()
    assert shipped.ship(pictures=True).pictures == 1
    assert shipped.ship(pictures=True).pictures == 0
    shipped.add_run()
    (shipped.folder / "camera" / "2.png").unlink()
    assert shipped.ship(pictures=True).lost_pictures == 1


def test_an_older_copy_is_refused_and_changes_nothing(shipped: Shipped, tmp_path: Path) -> None:
    shipped.add_run()
    copy = tmp_path / "copy.db"
    shipped.connection.execute("VACUUM INTO ?", (str(copy),))
    shipped.add_run()
    shipped.ship(full=True)
    before = shipped.pooled()
    with closing(connect(copy, "writer")) as connection:
        restored = Shipped(tmp_path, connection, shipped.pool)
        shutil.copy(copy, tmp_path / "webots.db")
        with pytest.raises(PoolError, match="is an older copy"):
            restored.ship(full=True)
    assert shipped.pooled() == before


def test_a_copy_that_was_gone_on_with_elsewhere_is_refused(
    shipped: Shipped, tmp_path: Path
) -> None:
    shipped.add_run()
    shipped.connection.execute("VACUUM INTO ?", (str(tmp_path / "webots.db"),))
    shipped.add_run()
    shipped.ship(full=True)
    before = shipped.pooled()
    with closing(connect(tmp_path / "webots.db", "writer")) as connection:
        copy = Shipped(tmp_path, connection, shipped.pool)
        for table in ("log", "event", "state"):
            of_the_copy = f"INSERT INTO {table} SELECT NULL, {{}} FROM {table}"
            names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")][1:]
            connection.execute(of_the_copy.format(", ".join(names)))
        connection.execute("UPDATE log SET message = 'elsewhere' WHERE id > 30")
        with pytest.raises(PoolError, match="gone on with elsewhere"):
            copy.ship(full=True)
    assert shipped.pooled() == before


def test_a_recording_without_uuid_is_refused(shipped: Shipped) -> None:
    shipped.add_run()
    shipped.connection.execute("DELETE FROM recording")
    with pytest.raises(DatabaseError, match="no UUIDs"):
        shipped.ship()
    assert not shipped.pool.exists()


def test_a_recording_of_an_older_schema_is_not_shipped(shipped: Shipped) -> None:
    shipped.connection.execute(f"PRAGMA user_version = {OLDER_SCHEMA}")
    with pytest.raises(SchemaTooOldError, match="move it aside"):
        shipped.ship()
    assert not shipped.pool.exists()


@pytest.mark.slow
def test_a_second_shipper_of_the_same_recording_is_refused(shipped: Shipped) -> None:
    shipped.add_run()
    with shipping(shipped.pool, shipped.uuid), pytest.raises(PoolBusyError):
        shipped.ship()


@pytest.mark.slow
def test_a_pool_that_is_away_is_tried_again_and_then_gets_everything(shipped: Shipped) -> None:
    shipped.add_run()
    url = bucket.empty()
    away = partial(open_pool, url, ships=True)
    said: list[str] = []

    def hear(text: str) -> None:
        said.append(text)
        bucket.Bucket.puts_left = None
        if "is there again" in text:
            raise KeyboardInterrupt

    with bucket.failing(0, ConnectionResetError("reset")):
        with pytest.raises(PoolUnavailableError):
            shipped.ship(open_pool=away)
        with pytest.raises(KeyboardInterrupt):
            follow(replace(shipped.order, open_pool=away, full=True), ShippingReport(), hear, 0.0)
    assert "does not answer: reset; trying again in 1 s" in said[0]
    shipped.ship(open_pool=away, full=True)
    assert pooled(url, shipped.uuid) == shipped.rows()


def ship_unwritable(shipped: Shipped, *, full: bool) -> str:
    """Ship a recording that nobody can write; what was noted."""
    shipped.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    shipped.connection.close()
    code = (
        "import functools, sys; from pathlib import Path; "
        "from webots_mcp.plugins.pool.pool_contents import open_pool; "
        "from webots_mcp.plugins.pool.shipping import ShippingReport; "
        "from webots_mcp.plugins.pool.shipping import ShippingJob, ship; "
        "from webots_mcp.store.recording import RecordingAccess; "
        "folder, pool = map(Path, sys.argv[1:]); "
        "recording = RecordingAccess(folder / 'webots.db', folder, read_only=True); "
        "report = ShippingReport(); "
        "opened = functools.partial(open_pool, str(pool), ships=True); "
        f"ship(ShippingJob(recording, opened, full={full}), report); "
        "print(*report.notes)"
    )
    with unprivileged.unwritable(shipped.folder):
        line = unprivileged.line("-c", code, str(shipped.folder), str(shipped.pool))
        return subprocess.run(line, check=True, stdout=subprocess.PIPE, text=True).stdout


@pytest.mark.slow
@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="root may write everywhere")
def test_a_recording_that_nobody_can_write_is_shipped(shipped: Shipped) -> None:
    shipped.add_run()
    uuid, rows = shipped.uuid, shipped.rows()
    assert not ship_unwritable(shipped, full=True).strip()
    assert pooled(shipped.pool, uuid) == rows


@pytest.mark.slow
@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="root may write everywhere")
def test_of_a_recording_that_nobody_can_write_a_copy_is_asked_for(shipped: Shipped) -> None:
    """It was to be shipped again when its run has ended, which it had."""
    shipped.recorded.add_run(300)
    told = ship_unwritable(shipped, full=False)
    assert "300 states are in no chunk yet" in told
    assert "ship a copy, or with --full" in told


def test_rows_of_other_programs_that_hold_no_text_and_no_times_are_shipped_as_what_is_near(
    shipped: Shipped,
) -> None:
    run_id = shipped.add_run()
    shipped.connection.execute(
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
        "VALUES (?, 1, 'soon', 'info', 'controller', CAST(x'61ff62' AS TEXT))",
        (run_id,),
    )
    shipped.ship()
    for time_s in ("'soon'", "-9e999", "9e999"):
        shipped.connection.execute(
            "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
            f"VALUES (?, {time_s}, {time_s}, '{{}}')",
            (run_id,),
        )
    shipped.keep(run_id, 0, 9e999)
    shipped.recorded.publish(100.0, {"x": 1})
    shipped.make_chunks()
    shipped.ship()
    shipped.ship(full=True)
    pooled = shipped.pooled()
    assert pooled["log"].pop()[3:] == (0.0, "info", "controller", "a\ufffdb", None)
    shipped.connection.execute("DELETE FROM log WHERE wall_time_s = 'soon'")
    shipped.connection.execute(
        "UPDATE state SET sim_time_s = 0, wall_time_s = 0 WHERE sim_time_s = 'soon'"
    )
    assert pooled == shipped.rows()


def test_a_row_that_is_larger_than_a_batch_is_shipped(shipped: Shipped) -> None:
    shipped.add_run()
    for _ in range(3):
        shipped.recorded.publish(100.0, {"x": "y" * (BATCH_BYTES + 1)})
    shipped.make_chunks()
    shipped.ship(full=True)
    assert shipped.pooled() == shipped.rows()


@pytest.mark.slow
def test_more_changes_than_a_transaction_takes_are_shipped_in_several(shipped: Shipped) -> None:
    shipped.add_run()
    shipped.connection.execute(
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 200) "
        "INSERT INTO command (robot_id, action, params, status, created_wall_time_s, "
        "expires_wall_time_s, result) SELECT 1, 'a', '{}', 'done', i, i, hex(zeroblob(60000)) "
        "FROM n"
    )
    shipped.ship(full=True)
    assert shipped.pooled() == shipped.rows()


def test_a_row_group_that_is_not_complete_is_shipped_when_it_is(shipped: Shipped) -> None:
    shipped.add_run(2500)
    shipped.connection.execute("UPDATE row_group SET is_complete = 0 WHERE id > 1")
    assert ShippingSource(shipped.connection).number(LAST_GROUP) == 1


def test_late_rows_are_shipped_as_a_group_of_their_own(shipped: Shipped) -> None:
    shipped.add_run(1100, end=None)
    shipped.ship()
    shipped.connection.execute(
        "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) "
        "VALUES (1, 3.25, 0, '{\"x\": 7}')"
    )
    assert shipped.ship().rows["row_group"] == 1
    assert shipped.pooled()["chunk"] == shipped.rows()["chunk"]


def test_while_a_pool_writes_the_log_of_the_database_can_be_cut_back(shipped: Shipped) -> None:
    shipped.add_run(2500)
    busy: list[int] = []

    def cut_back() -> None:
        answer = shipped.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
        busy.append(answer[0])

    shipped.ship(full=True, open_pool=lambda: BeforeWrite(shipped.order.open_pool(), cut_back))
    assert busy == [0] * len(busy) != []


@pytest.mark.parametrize("full", [False, True])
def test_states_that_retention_moved_while_no_shipper_ran_are_in_the_pool(
    shipped: Shipped, full: bool
) -> None:
    run_id = shipped.add_run(20, end=None)
    shipped.keep(run_id, 2, 40)
    shipped.ship(full=full)
    for i in range(20, 60):
        shipped.recorded.publish(i / 2, {"x": i, "mode": "c"})
    shipped.make_chunks()
    shipped.recorded.prune(states(rows=0))
    assert shipped.ship(full=full).lost.keys() <= {"state"}
    pooled = shipped.pooled()
    in_state = [row[2] for row in pooled["state"]]
    in_kept = [row[3] for row in pooled["kept_state"]]
    first = 0 if full else 4
    assert {*in_state, *in_kept} == {i / 2 for i in range(first, 60)}
    assert len(in_state) == len({*in_state}) > 0


def test_a_recording_that_is_not_there_yet_is_waited_for_and_one_in_its_place_is_noticed(
    shipped: Shipped, tmp_path: Path
) -> None:
    assert chunk_whole_run(shipped.connection, shipped.add_run())
    shipped.connection.execute("VACUUM INTO ?", (str(tmp_path / "copy.db"),))
    database, other = tmp_path / "late" / "webots.db", new_uuid()
    said: list[str] = []

    def hear(text: str) -> None:
        said.append(text)
        database.parent.mkdir(exist_ok=True)
        shutil.copy(tmp_path / "copy.db", database)
        if len(said) > 1:
            raise KeyboardInterrupt

    def replace_it() -> None:
        with closing(connect(database, "writer")) as connection:
            connection.execute("UPDATE recording SET uuid = ?", (other,))

    recording = RecordingAccess(database, database.parent, read_only=True)
    opened: Any = lambda: BeforeWrite(shipped.order.open_pool(), replace_it)  # noqa: E731
    with pytest.raises(KeyboardInterrupt):
        follow(ShippingJob(recording, opened, full=True), ShippingReport(), hear, 0.0)
    assert said[0] == f"nothing is recorded at {database} now: it is shipped as soon as it is there"
    assert f"the recording {other} stands now where {shipped.uuid} was" in said[1]
    assert shipped.pooled() == shipped.rows()


@pytest.mark.slow
def test_what_comes_while_a_shipper_follows_is_shipped_with_all_that_it_refers_to(
    shipped: Shipped,
) -> None:
    for _ in range(40):
        shipped.add_run(2)
    looks = iter(range(8))

    def record_more() -> None:
        if next(looks, None) is None:
            raise KeyboardInterrupt
        shipped.add_run(4, end=None)

    opened: Any = lambda: BeforeWrite(shipped.order.open_pool(), record_more)  # noqa: E731
    with pytest.raises(KeyboardInterrupt):
        order = ShippingJob(shipped.order.recording, opened, full=True)
        follow(order, ShippingReport(), lambda _: None, 0.0)
    found = shipped.pooled()
    runs = {row[0] for row in found["run"]}
    assert len(runs) == 47
    assert {row[1] for row in found["state"]} == runs
    assert {row[1] for row in found["run"]} <= {row[0] for row in found["session"]}
