"""Files with the stacks of silent loops, made by others and by dead processes; and whose time the
rounds of a loop take."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import ModuleType

import pytest

from tests.judging.test_outcomes import driving, measure, medians, record
from tests.recordings.rows import Recorded
from webots_mcp import MCPBridge
from webots_mcp.bridge import mcp_bridge
from webots_mcp.database import session_cleanup
from webots_mcp.database.thread_stacks import (
    FORMAT,
    SIGNAL,
    VERSION,
    is_library,
    needs_signal,
    read_stacks,
    stacks_at,
    stacks_path,
)
from webots_mcp.database.waiting_file import adopt
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.recording import view_robot
from webots_mcp.store.run_rows import pace_of

HEAD = {
    VERSION: FORMAT,
    "thread": 255,
    "run": "a run",
    "limit_s": 3.0,
    "step_files": ["/webots/controller/robot.py"],
    "libraries": ["/usr/lib/python3/", "/webots/controller/"],
}
LOOP = "Thread 0x00000000000000ff (most recent call first):"


def written(path: Path, calls: str, head: object = HEAD, thread: str = LOOP) -> Path:
    """A file, with calls as FILE:LINE:FUNCTION, the innermost first."""
    lines = [f'  File "{f}", line {n} in {name}' for f, n, name in map(_parts, calls.split())]
    path.write_text("\n".join([json.dumps(head), thread, *lines, ""]))
    return path


def _parts(call: str) -> list[str]:
    return call.rsplit(":", 2)


@pytest.mark.parametrize(
    ("calls", "place", "hangs"),
    [
        ("/p/nav.py:8:plan /p/r.py:9:<module>", "nav.py:8, plan(), called from r.py:9", True),
        (
            "/usr/lib/python3/threading.py:3:wait /v/site-packages/x.py:4:get /p/nav.py:8:plan",
            "nav.py:8, plan(); there in threading.py:3, wait()",
            True,
        ),
        ("/webots/controller/robot.py:5:step /p/r.py:9:<module>", "r.py:9", False),
        ("/webots/controller/robot.py:5:getDevice /p/r.py:9:run", "r.py:9, run()", True),
        ("/usr/lib/python3/bdb.py:5:trace_dispatch /p/r.py:9:run", "r.py:9, run()", False),
        (
            "/webots/controller/robot.py:5:waitForUserInputEvent /p/r.py:9:run",
            "r.py:9, run(); there in robot.py:5, waitForUserInputEvent()",
            False,
        ),
        ("/usr/lib/python3/runpy.py:5:run", "runpy.py:5, run()", True),
        (f"C:\\p\\{'n' * 300}.py:8:{'f' * 300}", f"{'n' * 59}…:8, {'f' * 59}…()", True),
        (
            " ".join(f"/p/r.py:{n}:f" for n in range(50)),
            "r.py:0, f(), called from f() and f()",
            True,
        ),
    ],
)
def test_the_place_is_the_controllers_own_code_and_a_step_or_a_debugger_is_no_hang(
    tmp_path: Path, calls: str, place: str, hangs: bool
) -> None:
    with written(tmp_path / "stacks", calls).open("rb") as file:
        found = read_stacks(file)
    assert found is not None
    assert (found.place.startswith(place), found.is_hang) == (True, hangs), found.place
    assert len(found.place) < 400


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\n" * 1000,
        b"[1]\n",
        b"[" * 100_000,
        json.dumps(HEAD).encode(),  # nothing was written
        f"{json.dumps(HEAD)}\n{LOOP}\n".encode(),
        *(
            f'{json.dumps(HEAD | wrong)}\n{LOOP}\n  File "a", line 1 in b\n'.encode()
            for wrong in (
                *({VERSION: 99}, {"thread": 3}, {"limit_s": "x"}, {"libraries": None}),
                *({"limit_s": 10**400}, {"run": "\ud800"}),
            )
        ),
    ],
)
def test_a_file_without_the_stacks_of_the_loop_says_nothing_and_is_removed(
    recorded: Recorded, tmp_path: Path, content: bytes
) -> None:
    path = stacks_path(tmp_path / "webots.db", "gone")
    path.write_bytes(content)
    with path.open("rb") as file:
        assert read_stacks(file) is None
    assert stacks_at(path) is None and not needs_signal(path, 1e9)
    recorded.robot()
    assert adopt(recorded.connection, tmp_path / "webots.db") == 0
    assert not path.exists()


@pytest.mark.skipif(not SIGNAL, reason="there is no such signal")
def test_a_controllers_own_handler_of_the_signal_stays_and_no_file_of_others_is_touched(
    tmp_path: Path,
) -> None:
    robot = InProcessSupervisor()
    former = signal.getsignal(SIGNAL)
    try:
        bridge = MCPBridge(robot, tmp_path / "data")
        (path,) = (tmp_path / "data").glob("*-stacks-*")
        assert json.loads(path.read_bytes())["signal"] == SIGNAL
        handled: list[int] = []
        signal.signal(SIGNAL, lambda number, _: handled.append(number))
        watchdog = bridge._session._watchdog  # pyright: ignore[reportPrivateUsage]
        watchdog.check()
        assert "signal" not in json.loads(path.read_bytes())

        shutil.rmtree(tmp_path / "data")
        (tmp_path / "data").write_text("in its place")
        watchdog.check()
        with (tmp_path / "other").open("w") as other:  # which gets the number of the closed file
            other.write("kept")
            other.flush()
            bridge.close()
        assert (tmp_path / "other").read_text() == "kept"
        signal.raise_signal(SIGNAL)
        assert handled == [SIGNAL]
    finally:
        signal.signal(SIGNAL, former)


def test_the_loops_thread_is_the_one_that_steps(tmp_path: Path) -> None:
    robot = InProcessSupervisor()
    bridge = MCPBridge(robot, tmp_path)
    with ThreadPoolExecutor(1) as other:
        stepped_in = other.submit(lambda: (robot.step(16), threading.get_ident())[1]).result()
        bridge._session._watchdog.check()  # pyright: ignore[reportPrivateUsage]
    (path,) = tmp_path.glob("*-stacks-*")
    assert json.loads(path.read_bytes())["thread"] == stepped_in != threading.get_ident()
    bridge.close()


def test_a_loop_that_stays_silent_is_logged_once(tmp_path: Path) -> None:
    robot = InProcessSupervisor()
    bridge = MCPBridge(robot, tmp_path, hang_after_s=1e-6)
    robot.step(16)
    bridge.publish({"x": 1})
    with ThreadPoolExecutor(1) as other:
        for _ in range(3):
            other.submit(bridge._session._watchdog.check).result()  # pyright: ignore[reportPrivateUsage]
    bridge.close()
    with closing(sqlite3.connect(tmp_path / "webots.db")) as connection:
        (count,) = connection.execute(
            "SELECT count(*) FROM log WHERE message LIKE '%test_thread_stacks.py%'"
        ).fetchone()
    assert count == 1


@pytest.mark.parametrize(("silent_s", "rows"), [(3.1, 1), (1.0, 0)])
def test_what_a_dead_process_left_is_logged_where_its_loop_had_been_silent(
    recorded: Recorded, tmp_path: Path, silent_s: float, rows: int
) -> None:
    robot = recorded.robot(now=time.time() - 60, uuid="gone", pid=2**31)
    recorded.connection.execute("UPDATE run SET uuid = 'a run'")
    path = written(stacks_path(tmp_path / "webots.db", "gone"), "/p/nav.py:8:plan")
    os.utime(path, (robot.now + silent_s, robot.now + silent_s))
    said = "it was silent for more than 3 s in nav.py:8, plan()"
    before = view_robot(recorded.connection, None).status.why or ""
    assert (said in before) == bool(rows)  # as nobody has taken it in yet
    assert adopt(recorded.connection, tmp_path / "webots.db") == rows
    found = recorded.connection.execute("SELECT level, message FROM log").fetchall()
    assert [(level, message.split("\n")[0]) for level, message in found] == [
        ("warning", "silent for more than 3 s in nav.py:8, plan()")
    ] * rows


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (
            (31.0, 1.0, 1000),
            "r: controller load 97 % of 32 ms per step; the controller sets the pace, not the "
            "physics (mean of 1000 steps)",
        ),
        (
            (1.0, 31.0, 1000),
            "r: controller load 3.1 % of 32 ms per step; not the bottleneck: Webots",
        ),
        (
            (16.0, 16.0, 1000),
            "r: controller load 50 % of 32 ms per step; controller and Webots (or",
        ),
        ((0.0, 0.0, 1000), "r: controller load 0 % of 0 ms per step; not the bottleneck: Webots"),
        ((0.31, 0.01, 19), "None"),
        (
            (12.0, 0.1, 3),
            "r: controller load 99 % of 4033 ms per step; the controller",
        ),
        ((None, None, None), "None"),
    ],
)
def test_who_sets_the_pace_is_said_where_enough_steps_were_seen(
    recorded: Recorded, times: tuple[float | None, ...], said: str
) -> None:
    run_id = recorded.robot().run_id
    sql = "UPDATE run SET own_wall_s = ?, step_wait_wall_s = ?, steps = ?"
    recorded.connection.execute(sql, times)
    assert str(pace_of(recorded.connection, "r", run_id)).startswith(said)


def test_an_edit_that_made_the_loop_slower_is_noticed_once_enough_runs_show_it(
    empty: sqlite3.Connection,
) -> None:
    for code, own_s in zip("aaaabbbb", (1.0, 1.1, 0.9, 1.05, 3.0, 3.1, 2.9, 3.05), strict=True):
        record(empty, code, driving, end_s=5)
        sql = "UPDATE run SET own_wall_s = ?, step_wait_wall_s = 1, steps = 100 WHERE own_wall_s"
        empty.execute(f"{sql} IS NULL", (own_s,))
    found = measure(compare_runs(empty, [*range(1, 9)]), "own_ms_per_step")
    first = measure(compare_runs(empty, [1, 5]), "own_ms_per_step")
    assert medians(found) == [pytest.approx(10.25), pytest.approx(30.25)]
    assert (found.different[1], first.different[1]) == (True, None)


@pytest.mark.skipif(not SIGNAL, reason="there is no such signal")
@pytest.mark.parametrize(
    ("head", "rest", "untouched_s", "silent_s", "is_needed"),
    [
        ({}, "", 7.0, 7.0, True),
        ({}, "", 7.0, 2.9, False),  # the loop gave a sign of life
        ({}, "", 1.0, 7.0, False),  # a thread of the process could touch the file
        ({}, f"{LOOP}\n", 7.0, 7.0, False),  # it could even write
        ({"signal": None}, "", 7.0, 7.0, False),  # the controller has the signal for itself
        ({"limit_s": 60.0}, "", 50.0, 50.0, False),
    ],
)
def test_the_signal_is_only_for_a_silent_loop_whose_process_could_write_nothing(
    tmp_path: Path,
    head: dict[str, object],
    rest: str,
    untouched_s: float,
    silent_s: float,
    is_needed: bool,
) -> None:
    path = tmp_path / "stacks"
    path.write_text(f"{json.dumps(HEAD | {'signal': SIGNAL} | head)}\n{rest}")
    touched_s = time.time() - untouched_s
    os.utime(path, (touched_s, touched_s))
    assert needs_signal(path, silent_s) == is_needed


@pytest.mark.parametrize("module", [mcp_bridge, session_cleanup, json])
def test_files_of_this_package_and_of_python_are_no_controllers_own(module: ModuleType) -> None:
    assert is_library(str(module.__file__))
    assert not is_library(__file__)
