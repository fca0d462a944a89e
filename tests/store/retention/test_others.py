"""Logs, events, pictures and commands are kept and go by limits of their own."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest

from tests.recordings.runs import Recorded
from tests.store.retention.conftest import TABLES
from webots_mcp.store import retention_plan
from webots_mcp.store.retention_limits import Limit, Retention


def test_logs_events_and_pictures_have_limits_of_their_own(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = {"kept_state": 1, "log": 5, "event": 5, "image": 1}
    monkeypatch.setattr(retention_plan, "_BLOCK_IDS", blocks)
    for _ in range(3):
        recorded.add_run(40)
    before = Counter({table: recorded.count(table) for table in TABLES})
    few = Limit(rows=26, spared_rows=0)
    limits = Retention(Limit(), Limit(), few, few, Limit(rows=2, spared_rows=0), outlive=0)
    done = recorded.prune(limits)
    assert [recorded.count(table) for table in ("log", "event", "image")] == [26, 26, 2]
    assert done.rows == Counter(log=34, event=34, image=1)
    assert done.files == 1
    assert recorded.count("state") == before["state"]


def test_finished_commands_go_with_the_age_of_events(recorded: Recorded) -> None:
    for _ in range(3):
        recorded.add_run(10)
    recorded.connection.execute("UPDATE command SET status = 'pending' WHERE id = 1")
    recorded.connection.execute("UPDATE run SET keep = 1 WHERE id = 2")
    limits = Retention(Limit(), Limit(), Limit(), Limit(age_s=0), Limit(), outlive=0)
    recorded.prune(limits, recorded.wall_s + 1)
    rows = recorded.connection.execute("SELECT id FROM command").fetchall()
    assert rows == [(1,), (2,)]  # the one that waits, and the one of the run that is kept


def test_what_is_left_of_a_run_outlives_the_limits_of_states_and_chunks_ten_times(
    recorded: Recorded,
) -> None:
    for _ in range(13):
        recorded.add_run(10)
    few = Limit(rows=10, spared_rows=0)
    recorded.prune(Retention(few, few, Limit(), Limit(), Limit()))
    assert recorded.rows() == {13: 10}
    for table in ("run", "session", "command"):
        assert recorded.connection.execute(f"SELECT min(id) FROM {table}").fetchone() == (3,)
    chunked = recorded.connection.execute("SELECT DISTINCT run_id FROM row_group").fetchall()
    assert chunked == [(run_id,) for run_id in range(3, 13)]
    for table in ("log", "event", "image", "parameter_value"):
        sql = f"SELECT count(DISTINCT run_id), min(run_id) FROM {table}"
        assert recorded.connection.execute(sql).fetchone() == (11, 3)
    assert recorded.connection.execute("PRAGMA foreign_key_check").fetchall() == []


@pytest.mark.parametrize("limits", [{"state": Limit(rows=0)}, {"chunk": Limit(rows=0)}])
def test_a_run_is_not_forgotten_while_its_states_or_chunks_are_within_their_limit(
    recorded: Recorded, limits: dict[str, Any]
) -> None:
    for _ in range(3):
        recorded.add_run(10)
    recorded.prune(Retention(**limits))
    held = "SELECT run_id FROM state UNION SELECT run_id FROM row_group"
    assert recorded.connection.execute(held).fetchall() == [(1,), (2,), (3,)]


def test_a_picture_whose_path_leads_out_of_the_folder_is_forgotten_but_not_deleted(
    recorded: Recorded, tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("elsewhere") / "mine.png"
    outside.write_bytes(b"mine")
    for _ in range(2):
        recorded.add_run(2)
    recorded.connection.execute("UPDATE image SET path = ? WHERE id = 1", (str(outside),))
    limits = Retention(Limit(), Limit(), Limit(), Limit(), Limit(rows=0, spared_rows=0), outlive=0)
    done = recorded.prune(limits)
    assert outside.exists()
    assert (done.rows["image"], done.files) == (2, 1)


def test_a_file_that_another_row_stands_for_stays(recorded: Recorded) -> None:
    for _ in range(2):
        recorded.add_run(2)
    recorded.connection.execute("UPDATE image SET path = 'camera/2.png'")
    limits = Retention(Limit(), Limit(), Limit(), Limit(), Limit(rows=1, spared_rows=0), outlive=0)
    assert recorded.prune(limits).files == 0
    assert (recorded.folder / "camera" / "2.png").exists()
