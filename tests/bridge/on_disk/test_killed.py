"""Rows that meet a lock survive their process, and are taken in once, by whoever comes next."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording, numbers
from tests.bridge.on_disk.conftest import POSIX, adopt_into
from webots_mcp import MCPBridge
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.maintenance import Maintainer
from webots_mcp.database.session_cleanup import reap
from webots_mcp.database.waiting_file import adopt, waiting_paths
from webots_mcp.standin import InProcessSupervisor

pytestmark = pytest.mark.slow

KILLED = """
import json, os, signal, sys
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.database.connection import connect
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
def kill(tmp_path: Path) -> Callable[[str], Path]:
    """Run a controller that is killed after what `program` does; the database's file."""

    def run(program: str) -> Path:
        line = [sys.executable, "-c", KILLED + program + END, str(tmp_path)]
        done = subprocess.run(line, check=False, capture_output=True, text=True)
        assert done.returncode == -signal.SIGKILL, done.stderr
        return tmp_path / DATABASE_NAME

    return run


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
        "SELECT r.name, s.end_reason, u.end_reason, u.row_count FROM run u "
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
        reap(connection, time.time())
        assert adopt(connection, file) > 0
        reap(connection, time.time())
    recording = Recording(file)
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]
    assert recording.rows("SELECT end_reason FROM run") == ["finished"]
