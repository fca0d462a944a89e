"""Rows that meet a lock survive their process, and are taken in once, by whoever comes next."""

from __future__ import annotations

import json
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
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
from webots_mcp import MCPBridge
from webots_mcp.adoption import adopt
from webots_mcp.bridge.row_writer import RowWriter
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.entries import waiting_paths
from webots_mcp.maintenance import Maintainer
from webots_mcp.settlement import settle
from webots_mcp.standin import InProcessSupervisor

KILLED = """
import json, os, signal, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.standin import InProcessSupervisor

folder = Path(sys.argv[1])
robot = InProcessSupervisor("rover")
bridge = MCPBridge(robot, folder, 1)

def publish(first, last):
    for n in range(first, last):
        robot.step(16)
        bridge.publish({"n": n})

publish(0, 5)
other = connect(folder / DATABASE_NAME, "writer")
other.execute("BEGIN IMMEDIATE")
"""
END = "os.kill(os.getpid(), signal.SIGKILL)\n"


@pytest.fixture
def bridge(robot: InProcessSupervisor, file: Path) -> Iterator[MCPBridge]:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        yield bridge


@pytest.fixture
def locked(bridge: MCPBridge, file: Path) -> Iterator[sqlite3.Connection]:
    """Another writer in the middle of its transaction."""
    with write_lock(file) as other:
        yield other


@pytest.fixture
def kill(tmp_path: Path) -> Callable[[str], Path]:
    """Run a controller that is killed after what `program` does; the database's file."""

    def run(program: str) -> Path:
        line = [sys.executable, "-c", KILLED + program + END, str(tmp_path)]
        done = subprocess.run(line, check=False, capture_output=True, text=True)
        assert done.returncode == -signal.SIGKILL, done.stderr
        return tmp_path / DATABASE_NAME

    return run


POSIX = pytest.mark.skipif(sys.platform == "win32", reason="kills by signal")


def adopt_into(file: Path) -> int:
    with closing(connect(file, "writer")) as connection:
        return adopt(connection, file)


@POSIX
def test_rows_of_a_killed_controller_are_taken_in_by_the_next_bridge_in_order(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 300)\nbridge.log('last words')\n")
    recording = Recording(file)
    assert numbers(recording) == list(range(5))
    MCPBridge(InProcessSupervisor("other"), file.parent).close()
    assert numbers(recording) == list(range(300))
    times = recording.rows("SELECT sim_time_s FROM state ORDER BY id")
    assert times == [pytest.approx(n * 0.016) for n in range(1, 301)]
    assert recording.rows("SELECT message FROM log") == ["last words"]
    assert waiting_paths(file) == []


@POSIX
def test_rows_of_a_killed_controller_are_taken_in_by_a_maintainer(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 9)\n")
    maintainer = Maintainer(file, "server")
    maintainer.tick()
    maintainer.tick()
    assert numbers(Recording(file)) == list(range(9))
    maintainer.stop()


@POSIX
def test_a_run_that_began_while_the_database_was_locked_is_taken_in_as_well(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 9)\nrobot.simulationReset()\npublish(9, 12)\n")
    assert adopt_into(file) > 0
    recording = Recording(file)
    per_run = recording.rows("SELECT run_id, count(*) FROM state GROUP BY run_id")
    assert [count for _, count in per_run] == [9, 3]
    reasons = recording.rows("SELECT start_reason, end_reason, rows FROM run ORDER BY id")
    assert reasons[0] == ("start", "reset", 9)
    assert reasons[1][:2] == ("reset", None)


@POSIX
def test_of_several_that_open_the_database_at_once_one_takes_each_row_in(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 600)\n")
    barrier, counts = threading.Barrier(4), list[int]()

    def take() -> None:
        barrier.wait()
        counts.append(adopt_into(file))

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(counts)[:3] == [0, 0, 0]
    assert numbers(Recording(file)) == list(range(600))


@POSIX
def test_an_adopter_that_is_killed_before_it_removes_the_file_costs_no_row_and_doubles_none(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 300)\n")
    (path,) = waiting_paths(file)
    content = path.read_bytes()
    assert adopt_into(file) == 295
    path.write_bytes(content)  # as if it had been killed right before it removed the file
    assert adopt_into(file) == 0
    assert not path.exists()
    assert numbers(Recording(file)) == list(range(300))


@POSIX
def test_a_line_that_was_cut_off_by_the_kill_costs_itself_only(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 9)\n")
    (path,) = waiting_paths(file)
    path.write_bytes(path.read_bytes()[:-10])
    assert adopt_into(file) == 3
    assert numbers(Recording(file)) == list(range(8))


@POSIX
def test_rows_of_a_session_that_the_database_does_not_know_are_entered_with_it(
    kill: Callable[[str], Path],
) -> None:
    file = kill("publish(5, 9)\n")
    for suffix in ("", "-wal", "-shm"):
        file.with_name(file.name + suffix).unlink()
    MCPBridge(InProcessSupervisor("other"), file.parent).close()
    recording = Recording(file)
    assert numbers(recording) == list(range(5, 9))
    told = recording.rows(
        "SELECT r.name, s.end_reason, u.end_reason, u.rows FROM run u "
        "JOIN session s ON s.id = u.session_id JOIN robot r ON r.id = s.robot_id "
        "WHERE r.name = 'rover'"
    )
    assert told == [("rover", "crashed", "crashed", 4)]


@POSIX
def test_the_result_of_a_command_that_met_a_lock_survives_the_kill(
    kill: Callable[[str], Path],
) -> None:
    file = kill(
        "from tests.bridge.conftest import Recording, eager\n"
        "other.execute('COMMIT')\n"
        "def lock(_):\n"
        "    other.execute('BEGIN IMMEDIATE')\n"
        "    return 'finished'\n"
        "bridge.register_command('lock', lock)\n"
        "Recording(folder / DATABASE_NAME).send('lock')\n"
        "while not other.in_transaction:\n"
        "    eager(bridge)\n"
    )
    MCPBridge(InProcessSupervisor("other"), file.parent).close()
    assert Recording(file).fate(1) == ("done", "finished", None)


@POSIX
def test_a_session_whose_rows_still_wait_is_not_judged_before_they_are_in(
    kill: Callable[[str], Path],
) -> None:
    file = kill("bridge.close()\n")
    with closing(connect(file, "writer")) as connection:
        settle(connection, time.time())
        assert adopt(connection, file) > 0
        settle(connection, time.time())
    recording = Recording(file)
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]
    assert recording.rows("SELECT end_reason FROM run") == ["finished"]


@pytest.mark.usefixtures("locked")
def test_the_file_of_a_living_session_is_left_to_it(bridge: MCPBridge, file: Path) -> None:
    bridge.publish({"n": 0})
    assert adopt_into(file) == 0
    assert waiting_file(bridge).exists()


def test_rows_that_waited_are_followed_by_later_ones_and_the_file_goes_with_the_bridge(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        for n in range(0, 60, 3):
            bridge.publish({"n": n})
            with write_lock(file):
                bridge.publish({"n": n + 1})
                bridge.publish({"n": n + 2})
        catch_up(bridge)
        path = waiting_file(bridge)
        assert path.exists()
    assert not path.exists()
    assert numbers(filed) == list(range(60))
    assert filed.rows("SELECT rows FROM run") == [60]


def test_what_waits_when_a_bridge_closes_is_kept_and_said(
    robot: InProcessSupervisor, file: Path, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    bridge = MCPBridge(robot, data_dir=file.parent, throttle_interval=1)
    with write_lock(file):
        bridge.publish({"n": 1})
        path = waiting_file(bridge)
        bridge.close()
        assert bridge.stats().rows_dropped == 0
        assert f"rows wait in {path}, because database is locked" in capfd.readouterr().err
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
        code = getattr(frame, "f_code")  # noqa: B009
        if code is RowWriter.write.__code__ and event == "call":
            sys.settrace(None)
            bridge.log("from within")
        return None

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


@pytest.mark.usefixtures("locked")
def test_the_status_tells_how_many_rows_wait_and_where(bridge: MCPBridge, file: Path) -> None:
    for n in range(3):
        bridge.publish({"n": n})
    line = [sys.executable, "-m", "webots_mcp", "status", "--database", str(file)]
    done = subprocess.run(line, check=True, capture_output=True, text=True)
    assert f"rows waiting 3 (in {waiting_file(bridge).name})" in done.stdout
