"""The file in which rows wait that meet a lock: private, plain, and followed by later rows."""

from __future__ import annotations

import json
import sqlite3
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    STEP_MS,
    Recording,
    catch_up,
    keep_in_memory,
    numbers,
    waiting_file,
    write_lock,
)
from tests.bridge.on_disk.conftest import POSIX, adopt_into
from webots_mcp import MCPBridge
from webots_mcp.bridge.recorder import ConnectionLock
from webots_mcp.database.waiting_file import WaitingEntry, WaitingFile
from webots_mcp.standin import InProcessSupervisor


@pytest.fixture
def locked(bridge: MCPBridge, file: Path) -> Iterator[sqlite3.Connection]:
    """Another writer in the middle of its transaction."""
    with write_lock(file) as other:
        yield other


@pytest.mark.usefixtures("locked")
def test_the_file_of_a_living_session_is_left_to_it(bridge: MCPBridge, file: Path) -> None:
    bridge.publish({"n": 0})
    assert adopt_into(file) == 0
    assert waiting_file(bridge).exists()


@pytest.mark.slow
def test_what_waits_when_a_bridge_closes_is_kept_and_said(
    robot: InProcessSupervisor, file: Path, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    bridge = MCPBridge(robot, data_dir=file.parent, throttle_interval=1)
    with write_lock(file):
        bridge.publish({"n": 1})
        path = waiting_file(bridge)
        bridge.close()
        assert bridge.stats().rows_dropped == 0
        assert f"rows are still in {path}, because database is locked" in capfd.readouterr().err
    assert adopt_into(file) > 0
    assert numbers(filed) == [1]
    assert filed.rows("SELECT end_reason FROM session") == ["finished"]


@POSIX
@pytest.mark.usefixtures("locked")
def test_the_file_is_private_and_plain_text(bridge: MCPBridge) -> None:
    bridge.publish({"n": 0, "text": "ü\ud800"})
    path = waiting_file(bridge)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    first, *others = [json.loads(line) for line in path.read_text("ascii").splitlines()]
    assert first["robot"]["name"] == "rover"
    assert [kind for _, kind, *_ in others] == ["run", "state"]


@POSIX
def test_a_file_that_somebody_deletes_is_made_again_with_what_it_held(
    bridge: MCPBridge, file: Path, filed: Recording, locked: sqlite3.Connection
) -> None:
    bridge.publish({"n": 0})
    waiting_file(bridge).unlink()
    bridge.publish({"n": 1})
    lines = waiting_file(bridge).read_text().splitlines()
    assert len(lines) == 4
    locked.execute("ROLLBACK")
    catch_up(bridge)
    assert numbers(filed) == [0, 1]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_where_the_file_takes_nothing_rows_wait_in_memory_and_are_counted(
    bridge: MCPBridge, filed: Recording, locked: sqlite3.Connection
) -> None:
    waiting_file(bridge).symlink_to("/dev/full")
    bridge.publish({"n": 0})
    bridge.publish({"n": 1})
    assert bridge.stats().rows_waiting == 2
    locked.execute("ROLLBACK")
    catch_up(bridge)
    assert numbers(filed) == [0, 1]
    assert bridge.stats().rows_dropped == 0


@POSIX
def test_a_row_of_which_the_disk_took_a_part_is_not_in_the_file(tmp_path: Path) -> None:
    import resource

    file = WaitingFile(tmp_path / "waiting", lambda: {})
    file.append([WaitingEntry(1, "log", None, ("whole",))])
    size = file.path.stat().st_size
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 5, limits[1]))
    try:
        with pytest.raises(OSError, match="the disk is full"):
            file.append([WaitingEntry(2, "log", None, ("cut",))])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.path.stat().st_size == size
    file.close(remove=True)


def test_rows_that_began_to_wait_in_memory_go_to_the_file_once_it_takes_them(
    bridge: MCPBridge, filed: Recording, locked: sqlite3.Connection
) -> None:
    keep_in_memory(bridge)
    bridge.publish({"n": 0})
    waiting_file(bridge).rmdir()
    bridge.publish({"n": 1})
    assert len(waiting_file(bridge).read_text().splitlines()) == 4
    locked.execute("ROLLBACK")
    catch_up(bridge)
    assert numbers(filed) == [0, 1]


def test_a_file_of_another_version_is_left_alone_and_said(
    bridge: MCPBridge, file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    strange = Path(f"{file}-waiting-x.jsonl")
    strange.write_text('{"webots_mcp_waiting": 99}\n[1, "state", null, []]\n')
    assert adopt_into(file) == 0
    assert strange.exists()
    assert "another version" in capfd.readouterr().err


SESSION = {
    **dict.fromkeys(("uuid", "host", "instance", "versions", "actions"), "x"),
    **dict.fromkeys(("pid", "extern", "supervisor", "started_wall_time_s"), 1),
    **dict.fromkeys(("last_seen_wall_time_s", "last_seen_monotonic_s"), 1.0),
}
ROBOT = {"name": "other", "kind": "Robot", "devices": "{}"}


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"session": None, "robot": ROBOT},
        {"session": {}, "robot": ROBOT},
        {"session": SESSION | {"uuid": ["x"]}, "robot": ROBOT},
        {"session": SESSION | {"instance": None}, "robot": ROBOT},
        {"session": SESSION, "robot": {}},
        {"session": SESSION, "robot": ROBOT | {"name": "\ud800"}},
        {"session": SESSION | {"pid": 2**70}, "robot": ROBOT},
    ],
)
def test_a_damaged_file_of_another_session_keeps_nobody_from_recording(
    told: dict[str, object], file: Path, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    file.parent.mkdir()
    strange = Path(f"{file}-waiting-x.jsonl")
    strange.write_text(json.dumps({"webots_mcp_waiting": 1, **told}) + "\n")
    with MCPBridge(InProcessSupervisor("rover"), file.parent, 1) as bridge:
        bridge.publish({"n": 0})
        assert numbers(filed) == [0]
        assert adopt_into(file) == 0
    assert strange.exists()
    assert capfd.readouterr().err.count(f"{strange} cannot be taken in") == 1


RUN = {"uuid": "r", "world": None, "step_ms": 8, "reason": "start", "wall_time": 1, "sim_time": 0}


@pytest.mark.parametrize(
    "line",
    [
        '[2, "state", "r", 5]',
        '[2, ["state"], "r", [1, 1, "{}", null]]',
        '[1e30, "state", "r", [1, 1, "{}", null]]',
        '[100000000000000000000, "state", "r", [1, 1, "{}", null]]',
        '[-2, "state", "r", [1, 1, "{}", null]]',
        '[2, "state", ["r"], [1, 1, "{}", null]]',
        '[2, "state", "\\ud800", [1, 1, "{}", null]]',
        '[2, "state", "r", [100000000000000000000, 1, "{}", null]]',
        '[2, "state", "r", [[], 1, "{}", null]]',
        '[2, "state", "r", [1]]',
        "[" * 100_000,
    ],
)
def test_a_damaged_line_costs_itself_only(line: str, file: Path, filed: Recording) -> None:
    MCPBridge(InProcessSupervisor("rover"), file.parent).close()
    first = json.dumps({"webots_mcp_waiting": 1, "session": SESSION, "robot": ROBOT})
    run = json.dumps([1, "run", None, RUN])
    last = '[4, "state", "r", [1, 1, "{\\"n\\": 1}", null]]'
    Path(f"{file}-waiting-x.jsonl").write_text("\n".join((first, run, line, last, "")))
    assert adopt_into(file) == 1
    assert numbers(filed) == [1]


def test_a_session_that_was_deleted_while_its_rows_waited_is_entered_again(
    bridge: MCPBridge, robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    bridge.publish({"n": 0})
    with write_lock(file) as other:
        bridge.publish({"n": 1})
        for table in ("state", "event", "log", "run", "session"):
            other.execute(f"DELETE FROM {table}")
    bridge.publish({"n": 2})
    catch_up(bridge)
    assert numbers(filed) == [1, 2]


def test_a_signals_handler_that_logs_in_the_middle_of_a_row_deadlocks_nothing(
    bridge: MCPBridge, robot: InProcessSupervisor, filed: Recording
) -> None:
    def trace(frame: object, event: str, _: object) -> object:
        if getattr(frame, "f_code") is not ConnectionLock.acquire.__code__:  # noqa: B009
            return None
        if event == "return":  # from here on the row has the lock
            sys.settrace(None)
            bridge.log("from within")
        return trace

    sys.settrace(trace)  # pyright: ignore[reportArgumentType]
    try:
        bridge.publish({"n": 0})
    finally:
        sys.settrace(None)
    robot.step(STEP_MS)
    bridge.publish({"n": 1})
    catch_up(bridge)
    assert numbers(filed) == [0, 1]
    assert filed.rows("SELECT message FROM log") == ["from within"]
