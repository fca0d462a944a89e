"""What became of commands and runs of a process that is gone: never more than is known."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded, RecordedRobot, insert
from webots_mcp.contract import ISSUED_TIME_TO_LIVE_S
from webots_mcp.database.processes import process_identity
from webots_mcp.database.session_cleanup import reap
from webots_mcp.database.waiting_file import FORMAT, adopt
from webots_mcp.store.recording import view_robot

STATUS = "SELECT status FROM command"
NOBODY = 2**31  # no system gives that pid


def claimed(robot: RecordedRobot) -> None:
    insert(robot.connection, "command", {
        "robot_id": robot.id, "action": "dance", "params": "{}", "status": "claimed",
        "created_wall_time_s": robot.now, "expires_wall_time_s": robot.now + 10,
        "session_id": robot.session_id,
    })  # fmt: skip


def leave_waiting(database: Path, entry: list[object]) -> None:
    """As the session of the UUID `u` does that the database could not take a row of."""
    lines = [{"webots_mcp_waiting": FORMAT, "robot": {}, "session": {"uuid": "u"}}, entry]
    file = Path(f"{database}-waiting-u.jsonl")
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_a_command_is_not_lost_while_its_result_waits_beside_the_database(
    recorded: Recorded,
) -> None:
    assert isinstance(recorded.database, Path)
    claimed(recorded.robot(uuid="u", pid=NOBODY))
    done = {"now": 1.0, "sim_time": 1.0, "command": 1, "status": "done", "result": "7"}
    leave_waiting(recorded.database, [1, "command finished", None, done | {"error": None}])
    reap(recorded.connection, time.time())
    assert recorded.connection.execute(STATUS).fetchone() == ("claimed",)
    adopt(recorded.connection, recorded.database)
    reap(recorded.connection, time.time())
    assert recorded.connection.execute(STATUS).fetchone() == ("done",)


def test_a_command_of_a_dead_process_is_lost_where_nothing_waits(recorded: Recorded) -> None:
    claimed(recorded.robot(uuid="u", pid=NOBODY))
    reap(recorded.connection, time.time())
    assert recorded.connection.execute(STATUS).fetchone() == ("lost",)


def test_a_reload_is_lost_where_no_session_has_confirmed_it_for_a_minute(
    recorded: Recorded,
) -> None:
    claimed(recorded.robot(uuid="u", pid=NOBODY))
    now_s = time.time()
    sql = "UPDATE command SET action = 'reload', issued_wall_time_s = ?"
    recorded.connection.execute(sql, (now_s,))
    for after_s, status in ((1, "claimed"), (ISSUED_TIME_TO_LIVE_S + 1, "lost")):
        reap(recorded.connection, now_s + after_s)
        assert recorded.connection.execute(STATUS).fetchone() == (status,)


def test_rows_that_are_adopted_after_a_crash_are_counted(recorded: Recorded) -> None:
    assert isinstance(recorded.database, Path)
    robot = recorded.robot(uuid="u", pid=NOBODY)
    robot.state(1.0, {"n": 1})
    reap(recorded.connection, time.time())
    recorded.connection.execute("UPDATE run SET uuid = 'r'")
    leave_waiting(recorded.database, [1, "state", "r", [2.0, time.time(), "{}", None]])
    assert adopt(recorded.connection, recorded.database) == 1
    assert recorded.connection.execute("SELECT row_count FROM run").fetchone() == (2,)


def test_rows_that_a_dead_controller_left_beside_the_database_are_told_until_they_are_adopted(
    recorded: Recorded,
) -> None:
    """A server that may not write answered as if the recording ended before them."""
    assert isinstance(recorded.database, Path)
    robot = recorded.robot(uuid="u", pid=NOBODY)
    robot.state(1.0, {"n": 1})
    recorded.connection.execute("UPDATE run SET uuid = 'r'")
    leave_waiting(recorded.database, [1, "state", "r", [2.0, time.time(), "{}", None]])
    why = view_robot(recorded.connection, None).status.why
    assert "killed or crashed); its last rows wait in webots.db-waiting-u.jsonl" in (why or "")
    adopt(recorded.connection, recorded.database)
    assert "wait in" not in (view_robot(recorded.connection, None).status.why or "")


@pytest.mark.skipif(process_identity(os.getpid()) is None, reason="needs the system's word")
def test_a_living_process_that_got_the_pid_of_a_dead_one_is_not_it(recorded: Recorded) -> None:
    recorded.robot(pid=os.getpid(), process="another start of the machine 7")
    reap(recorded.connection, time.time())
    assert recorded.connection.execute("SELECT end_reason FROM session").fetchone() == ("crashed",)


def test_rows_of_a_crashed_run_are_counted_by_no_statement_that_writes(recorded: Recorded) -> None:
    robot = recorded.robot(pid=NOBODY)
    robot.state(1.0, {"x": 1})
    robot.state(2.0, {"x": 1})
    recorded.connection.execute("UPDATE run SET row_count = 0, purged_rows = 3")
    writes: list[str] = []
    recorded.connection.set_trace_callback(writes.append)
    reap(recorded.connection, time.time())
    recorded.connection.set_trace_callback(None)
    assert recorded.connection.execute("SELECT row_count, last_sim_time_s FROM run").fetchone() == (
        5,
        2,
    )
    assert not [sql for sql in writes if sql.startswith("UPDATE") and "FROM state" in sql]


def test_forgetting_a_session_reads_no_command_of_another(recorded: Recorded) -> None:
    sql = "EXPLAIN QUERY PLAN UPDATE command SET session_id = NULL WHERE session_id = 1"
    (plan,) = recorded.connection.execute(sql).fetchall()
    assert "USING" in plan[3] and "INDEX ix_command_session_id" in plan[3]
