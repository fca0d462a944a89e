"""The data folder of a bridge that writes JSON files becomes a run."""

from __future__ import annotations

import json
import sqlite3
from datetime import datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.store.json_folder.conftest import NOON, STATUS, Peer, counts, rows
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.json_folder import import_folder, read_folder


def test_a_folder_becomes_a_finished_run(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    made = import_folder(database, peer.folder, data_dir, "old rover")
    assert made == ("old rover", 1, 1, 3, 1, 3)
    run = rows(
        database, "SELECT robot, started_utc, duration_s, row_count, end_reason FROM robot_run"
    )[0]
    started = datetime(2026, 5, 4, 11, 59).astimezone()
    assert run[0] == "old rover"
    assert datetime.fromisoformat(f"{run[1]}+00:00") == started
    assert run[2:] == (60.25, 1, "finished")
    assert rows(database, "SELECT robot, x_m, yaw_rad, mode FROM robot_now") == [
        ("old rover", 1.0, 0.5, "navigate")
    ]
    assert rows(database, "SELECT sim_time_s, message FROM log") == [
        (0, "start"),
        (30, "turn\nleft"),
        (60, "go"),
    ]
    assert json.loads(rows(database, "SELECT data FROM state")[0][0]) == STATUS


def test_pictures_are_copied_and_found_by_their_rows(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    import_folder(database, peer.folder, data_dir, "a/b")
    images = rows(database, "SELECT kind, path, width, height, size_bytes FROM image")
    assert [image[:2] for image in images] == [
        ("camera", "camera/a_b/frame_0000.png"),
        ("camera", "camera/a_b/frame_0001.png"),
        ("screenshot", "screenshots/a_b/shot.png"),
    ]
    for _, path, width, height, size in images:
        assert (width, height, size) == (8, 6, (data_dir / path).stat().st_size)


def test_a_command_that_nobody_took_is_shown_and_will_never_run(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    import_folder(database, peer.folder, data_dir)
    command = rows(database, "SELECT action, params, status, error FROM command")[0]
    assert command[:3] == ("grasp", '{"force":3}', "expired")
    assert "never run" in command[3]


def test_a_state_with_nan_is_stored_as_the_bridge_stores_it(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.write("status.json", '{"front": NaN, "lidar": [1.0, -Infinity], "deep": {"a": Infinity}}')
    import_folder(database, peer.folder, data_dir)
    data, replaced, wall_s = rows(database, "SELECT data, replaced, wall_time_s FROM state")[0]
    assert json.loads(data) == {"front": None, "lidar": [1.0, None], "deep": {"a": None}}
    assert json.loads(replaced) == {"front": "nan", "lidar.1": "-inf", "deep.a": "inf"}
    assert wall_s == NOON.timestamp()  # without a timestamp the file's own time


def test_a_log_over_midnight_gets_its_dates_from_the_newest_state(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.write("status.json", '{"timestamp": "2026-05-04T00:00:10"}')
    lines = "[23:59:58] a\n[00:00:01] b\n[23:59:59] c\n[00:00:11] d\n"
    peer.write("logs/controller.log", lines, datetime(2027, 1, 1))  # copied since
    import_folder(database, peer.folder, data_dir)
    days = [
        datetime.fromtimestamp(wall_s).isoformat(" ")
        for (wall_s,) in rows(database, "SELECT wall_time_s FROM log")
    ]
    assert days == [
        "2026-05-02 23:59:58",
        "2026-05-03 00:00:01",
        "2026-05-03 23:59:59",
        "2026-05-04 00:00:11",
    ]


@settings(max_examples=60)
@given(st.lists(st.integers(1, 86_399), min_size=1, max_size=8))
def test_lines_less_than_a_day_apart_keep_their_distance(gaps_s: list[int]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        moments = [NOON.timestamp()]
        for gap_s in gaps_s:
            moments.append(moments[-1] + gap_s)
        text = "".join(f"[{datetime.fromtimestamp(moment):%H:%M:%S}] line\n" for moment in moments)
        peer = Peer(Path(folder))
        peer.write("logs/controller.log", text, datetime.fromtimestamp(moments[-1]))
        assert [wall_s for wall_s, _ in read_folder(peer.folder).lines] == moments


def test_a_log_from_windows_is_read(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.write("logs/controller.log", "[12:00:00] Motor läuft\r\n".encode("cp1252"))
    import_folder(database, peer.folder, data_dir)
    assert rows(database, "SELECT message FROM log") == [("Motor läuft",)]


def test_what_no_float_and_no_utf8_can_hold_is_replaced_and_named(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    huge = "9" * 400
    peer.write("status.json", f'{{"a": [{huge}, 1e999, NaN], "t": "x\\ud800", "\\udfff": 1}}')
    at = "2026-05-04T11:59:59"
    peer.write("commands.json", f'{{"action": "gr\\ud800asp", "timestamp": "{at}", "x": {huge}}}')
    import_folder(database, peer.folder, data_dir)
    ((data, replaced),) = rows(database, "SELECT data, replaced FROM state")
    assert json.loads(data) == {"a": [None, None, None], "t": "x?", "?": 1}
    assert json.loads(replaced) == {
        "a.0": "int", "a.1": "inf", "a.2": "nan", "t": "surrogate", "?": "surrogate",
    }  # fmt: skip
    assert rows(database, "SELECT action, params FROM command") == [("gr?asp", '{"x":null}')]


def test_a_folder_is_imported_once(
    peer: Peer, database: sqlite3.Connection, data_dir: Path
) -> None:
    peer.everything()
    import_folder(database, peer.folder, data_dir, "first")
    before = counts(database)
    with pytest.raises(InvalidInputError, match="imported before, as run 1 of robot 'first'"):
        import_folder(database, peer.folder, data_dir, "second")
    assert counts(database) == before


def test_pictures_of_our_own_data_folder_stay_where_they_are(
    database: sqlite3.Connection, data_dir: Path
) -> None:
    peer = Peer(data_dir)
    peer.picture("camera/frame_0000.png")
    import_folder(database, data_dir, data_dir)
    assert rows(database, "SELECT path FROM image") == [("camera/frame_0000.png",)]
    assert [file.name for file in data_dir.rglob("*.png")] == ["frame_0000.png"]
