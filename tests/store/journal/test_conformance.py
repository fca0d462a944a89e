"""Each journal of conformance/ comes to the rows beside it, complete or while it is written.

docs/journal.md describes the format. A reader in another language runs over the same files.
"""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import wait_for
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.waiting_file import journal_parts
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.journal_intake import ingest_journals
from webots_mcp.store.recording import RecordingAccess, view_of
from webots_mcp.store.robots import list_robots

FILES = sorted((Path(__file__).parent / "conformance").glob("*.jsonl"))
SESSION = "5f0d1f6e-3a52-4d8e-9c2b-0a1b2c3d4e5f"
ROWS = {
    "run": "SELECT uuid, start_reason, last_sim_time_s, row_count, end_reason FROM run ORDER BY id",
    "state": "SELECT sim_time_s, data, replaced FROM state ORDER BY id",
    "event": "SELECT sim_time_s, kind, name, data FROM event WHERE kind <> 'dropped' ORDER BY id",
    "log": "SELECT sim_time_s, level, source, message FROM log ORDER BY id",
    "session": "SELECT end_reason, rows_dropped FROM session",
    "dropped": "SELECT coalesce(sum(json_extract(data, '$.row_count')), 0) FROM event "
    "WHERE kind = 'dropped'",
}


def part(folder: Path, number: int = 1) -> Path:
    return folder / f"webots.db-waiting-{SESSION}-{number:04}.jsonl"


def rows(folder: Path, what: str) -> list[list[Any]]:
    with closing(sqlite3.connect(folder / "webots.db")) as connection:
        return [list(row) for row in connection.execute(ROWS[what])]


def require_rows(folder: Path, expected: dict[str, Any]) -> None:
    for what in expected.keys() & ROWS.keys():
        (found,) = rows(folder, what)[0] if what == "dropped" else (rows(folder, what),)
        assert found == expected[what]
    assert "dropped" in expected or rows(folder, "dropped") == [[0]]


@pytest.mark.parametrize("pieces", [1, 2, pytest.param(67, marks=pytest.mark.slow)])
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_journal_comes_to_its_rows(
    file: Path, pieces: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Written at once and left; or in small pieces, with a reader after each of them."""
    expected, data = json.loads(file.with_suffix(".json").read_text("utf-8")), file.read_bytes()
    recording = RecordingAccess(tmp_path / "webots.db", tmp_path)
    with part(tmp_path).open("ab", buffering=0) as journal:
        fcntl.flock(journal, fcntl.LOCK_EX)
        size = len(data) // pieces if pieces > 1 else len(data)
        for start in range(0, len(data), max(size, 1)):
            journal.write(data[start : start + max(size, 1)])
            if pieces > 1:
                recording.ingest()
                assert part(tmp_path).exists()
    recording.ingest()  # its writer is gone
    for _ in range(2):
        with recording.writer() as connection:
            ingest_journals(connection, tmp_path / "webots.db")  # as a server does each second
    require_rows(tmp_path, expected)
    assert part(tmp_path).exists() == expected.get("left", False)
    assert ("cannot be taken in" in capsys.readouterr().err) == expected.get("left", False)


def test_parts_are_taken_in_one_after_the_other_and_deleted_when_they_are_complete(
    tmp_path: Path,
) -> None:
    header, run, *states, _ = (FILES[0].parent / "old_numbers.jsonl").read_text().splitlines()
    lines = [states[0].replace("[5,", f"[{n},").replace("1}", f"{n}}}") for n in range(2, 12)]
    for number in range(1, 11):  # the tenth part is after the ninth
        text = "\n".join([header, run.replace("[1,", f"[{number},"), lines[number - 1], ""])
        part(tmp_path, number).write_text(text)
    recording = RecordingAccess(tmp_path / "webots.db", tmp_path)
    with part(tmp_path, 10).open("ab") as living:
        fcntl.flock(living, fcntl.LOCK_EX)
        recording.ingest()
        assert [json.loads(data)["x"] for _, data, _ in rows(tmp_path, "state")] == [*range(2, 12)]
        assert journal_parts(tmp_path / "webots.db") == {SESSION: [part(tmp_path, 10)]}


def test_no_part_is_read_before_one_that_cannot_be(tmp_path: Path) -> None:
    text = (FILES[0].parent / "cut_line.jsonl").read_text()
    part(tmp_path, 1).write_text(text.replace('waiting":1', 'waiting":9'))
    part(tmp_path, 2).write_text(text)
    RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
    assert rows(tmp_path, "state") == []
    part(tmp_path, 1).unlink()
    RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
    assert len(rows(tmp_path, "state")) == 1


def test_a_reader_that_may_not_write_says_what_waits(tmp_path: Path) -> None:
    text = (FILES[0].parent / "cut_line.jsonl").read_text()
    with part(tmp_path).open("w") as living:
        fcntl.flock(living, fcntl.LOCK_EX)
        living.write(text)
        living.flush()
        RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
        living.write(text.splitlines()[-2].replace("[2,", "\n[3,") + "\n")
        living.flush()
        with RecordingAccess(tmp_path / "webots.db", tmp_path, read_only=True).view() as view:
            assert part(tmp_path).name in view.header()["storage"]
            assert len(rows(tmp_path, "state")) == 1
        with RecordingAccess(
            tmp_path / "webots.db", tmp_path, read_only=True, asker="cli"
        ).reader():
            assert len(rows(tmp_path, "state")) == 2


def test_an_answer_whose_time_is_up_names_the_journal_of_which_rows_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header, run, state, *_ = (FILES[0].parent / "cut_line.jsonl").read_text().splitlines()
    states = [state.replace("[2,", f"[{number},", 1) for number in range(2, 302)]
    part(tmp_path).write_text("\n".join([header, run, *states, ""]))
    monkeypatch.setattr("webots_mcp.store.recording.BUDGET_S", 0.0)

    def is_begun() -> bool:  # another thread that takes in its own journals has its turn first
        with RecordingAccess(tmp_path / "webots.db", tmp_path).view() as view:
            assert f"newer rows of {part(tmp_path).name}" in view.header()["storage"]
        return bool(rows(tmp_path, "state"))

    wait_for(is_begun)
    assert len(rows(tmp_path, "state")) < 300
    monkeypatch.undo()
    with RecordingAccess(tmp_path / "webots.db", tmp_path).view() as view:
        assert "storage" not in view.header()
    assert len(rows(tmp_path, "state")) == 300


def test_what_there_is_no_time_for_waits_also_where_there_are_many_journals(
    tmp_path: Path,
) -> None:
    text = (FILES[0].parent / "cut_line.jsonl").read_text()
    for start in "5678":
        name = part(tmp_path).name.replace("-5f", f"-{start}f")
        (tmp_path / name).write_text(text.replace('"5f', f'"{start}f'))
    with closing(connect(tmp_path / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        begun = [0]
        while journal_parts(tmp_path / "webots.db"):
            ingest_journals(connection, tmp_path / "webots.db", budget_s=0.0)
            begun.append(len(rows(tmp_path, "session")))
    assert all(after - before in (0, 1) for before, after in pairwise(begun))
    assert begun[-1] == 4


def test_a_journal_writes_to_no_run_of_another_session_and_waits_for_no_program(
    tmp_path: Path,
) -> None:
    other = part(tmp_path).with_name(part(tmp_path).name.replace(SESSION[:8], "6" * 8))
    os.mkfifo(tmp_path / "program")
    first = {"uuid": SESSION, "pid": 1, "started_wall_time_s": 2e9}
    second = first | {"uuid": SESSION.replace(SESSION[:8], "6" * 8)}
    second["controller"] = str(tmp_path / "program")
    run = {"uuid": "1", "reason": "start", "wall_time": 1.0, "sim_time": 0.0}
    for path, session, value in ((part(tmp_path), first, 1), (other, second, 2)):
        header = {"webots_mcp_waiting": 1, "robot": {"name": f"r{value}"}, "session": session}
        state = [2, "state", "1", [0.1, 1.1, {"x": value}]]
        end = [3, "run end", "1", {"reason": "finished", "now": 1.0 + value, "sim_time": 1.0}]
        lines = (header, [1, "run", None, run], state, end)
        path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
        os.utime(path, (value, value))  # in this order
    RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
    assert [data for _, data, _ in rows(tmp_path, "state")] == ['{"x":1}']
    assert rows(tmp_path, "run") == [["1", "start", 1.0, 1, "finished"]]


def test_what_a_journal_dates_in_the_future_was_seen_when_it_was_taken_in(tmp_path: Path) -> None:
    later_s = time.time() + 86_400
    session = {"uuid": SESSION, "pid": os.getpid(), "started_wall_time_s": later_s}
    header = {"webots_mcp_waiting": 1, "robot": {"name": "rover"}, "session": session}
    run = {"uuid": "1", "reason": "start", "wall_time": later_s, "sim_time": 0.0}
    state = [2, "state", "1", [0.1, later_s, {"x": 1}]]
    lines = (header, [1, "run", None, run], state)
    with part(tmp_path).open("w") as living:
        fcntl.flock(living, fcntl.LOCK_EX)
        living.write("".join(f"{json.dumps(line)}\n" for line in lines))
        living.flush()
        recording = RecordingAccess(tmp_path / "webots.db", tmp_path)
        recording.ingest()
        with recording.reader() as connection:
            (robot,) = list_robots(connection, in_a_minute_s := time.time() + 60)
            status = view_of(connection, robot, in_a_minute_s).status.text
    assert robot.live and status in ("stopped 60 s ago", "stopped 61 s ago")


def test_a_journal_with_the_uuid_of_a_bridges_session_is_left_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bridge = MCPBridge(InProcessSupervisor("rover"), tmp_path)
    ((uuid,),) = sqlite3.connect(tmp_path / "webots.db").execute("SELECT uuid FROM session")
    journal = tmp_path / f"webots.db-waiting-{uuid}-0001.jsonl"
    session = {"uuid": uuid, "pid": 1, "started_wall_time_s": 1.0}
    header = {"webots_mcp_waiting": 1, "robot": {"name": "rover"}, "session": session}
    end = [9, "session end", None, {"reason": "finished", "now": 1.0}]
    journal.write_text(f"{json.dumps(header)}\n{json.dumps(end)}\n")
    RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
    assert journal.exists() and rows(tmp_path, "session") == [[None, 0]]
    assert "its session is that of a bridge" in capsys.readouterr().err
    bridge.close()
