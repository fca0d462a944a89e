"""The command queue: at most once, idempotent, cancelled or expired but never in between."""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.database import session_cleanup
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.queue import (
    CLAIM,
    MAX_PARAMS_BYTES,
    CommandQueue,
    any_unfinished,
    fetch_command,
    find_command,
    list_commands,
)
from webots_mcp.database.transactions import repeat_while_busy
from webots_mcp.errors import InvalidInputError


def claim(connection: sqlite3.Connection, robot_id: int, session_id: int) -> list[int]:
    times = {"now": time.time(), "sim_time": 0.0}
    ids = {"robot": robot_id, "session": session_id}
    return [row[0] for row in connection.execute(CLAIM, times | ids).fetchall()]


def count(connection: sqlite3.Connection) -> int:
    return int(connection.execute("SELECT count(*) FROM command").fetchone()[0])


def test_a_command_waits_with_its_parameters_and_its_time_to_live(database: Database) -> None:
    recorded = Recorded(database)
    robot = recorded.robot()
    queue = CommandQueue(recorded.connection, clock=lambda: 1000.0)
    command = queue.enqueue(robot.id, "go", {"b": 1, "a": "ü"}, time_to_live_s=3.0)
    assert json.loads(command.params) == {"a": "ü", "b": 1}
    assert (command.status, command.expires_wall_time_s) == ("pending", 1003.0)
    assert any_unfinished(recorded.connection)
    recorded.close()


def test_sending_again_with_the_same_key_makes_no_second_command(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    first = queue.enqueue(robot.id, "go", {"x": 1}, idempotency_key="k")
    again = queue.enqueue(robot.id, "go", {"x": 1}, idempotency_key="k")
    assert first.id == again.id
    assert count(recorded.connection) == 1


def test_a_key_that_belongs_to_another_request_is_refused(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    queue.enqueue(robot.id, "go", {"x": 1}, idempotency_key="k")
    with pytest.raises(InvalidInputError, match="already belongs"):
        queue.enqueue(robot.id, "go", {"x": 2}, idempotency_key="k")


def test_a_busy_database_is_waited_for(recorded: Recorded) -> None:
    robot = recorded.robot()
    recorded.connection.execute("BEGIN IMMEDIATE")
    with closing(connect(recorded.database, "writer")) as other:
        other.execute("PRAGMA busy_timeout=50")
        thread = threading.Timer(0.07, lambda: recorded.connection.execute("COMMIT"))
        thread.start()
        command = CommandQueue(other).enqueue(robot.id, "go")
        thread.join()
    assert command.status == "pending"
    assert count(recorded.connection) == 1


def test_a_database_that_stays_locked_is_an_error_and_no_command(recorded: Recorded) -> None:
    robot = recorded.robot()
    recorded.connection.execute("BEGIN IMMEDIATE")
    with closing(connect(recorded.database, "writer")) as other:
        other.execute("PRAGMA busy_timeout=1")
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            CommandQueue(other).enqueue(robot.id, "go")
    recorded.connection.execute("ROLLBACK")
    assert count(recorded.connection) == 0


@pytest.mark.parametrize(
    ("params", "said"),
    [({"x": [float("nan"), 0]}, r"NaN or infinity, which JSON cannot hold: {'x': \[nan, 0\]}\."),
     ({"x": object()}, "not plain JSON")],
)  # fmt: skip
def test_parameters_that_are_no_json_are_refused(
    recorded: Recorded, params: dict[str, object], said: str
) -> None:
    robot = recorded.robot()
    with pytest.raises(InvalidInputError, match=said):
        CommandQueue(recorded.connection).enqueue(robot.id, "go", params)


def test_parameters_beyond_the_limit_are_refused(recorded: Recorded) -> None:
    robot = recorded.robot()
    with pytest.raises(InvalidInputError, match="the limit is 65,536"):
        CommandQueue(recorded.connection).enqueue(
            robot.id, "go", {"x": "ü" * (MAX_PARAMS_BYTES // 2)}
        )


def test_a_cancelled_command_is_never_claimed(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    command = queue.enqueue(robot.id, "go")
    assert queue.cancel(command.id, "nobody claimed it")
    assert claim(recorded.connection, robot.id, robot.session_id) == []
    assert fetch_command(recorded.connection, command.id).error == "nobody claimed it"
    assert not any_unfinished(recorded.connection)


def test_a_claimed_command_cannot_be_cancelled(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    command = queue.enqueue(robot.id, "go")
    assert claim(recorded.connection, robot.id, robot.session_id) == [command.id]
    assert not queue.cancel(command.id, "too late")
    assert fetch_command(recorded.connection, command.id).status == "claimed"


def test_of_cancelling_and_claiming_at_once_exactly_one_wins(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "race.db")
    robot = recorded.robot()
    queue = CommandQueue(recorded.connection)
    ids = [queue.enqueue(robot.id, "go").id for _ in range(200)]
    claimed: list[int] = []

    def claim_all() -> None:
        with closing(connect(recorded.database, "writer")) as controller:
            while rows := claim(controller, robot.id, robot.session_id):
                claimed.extend(rows)

    thread = threading.Thread(target=claim_all)
    thread.start()
    cancelled = [i for i in reversed(ids) if queue.cancel(i, "taken back")]
    thread.join()
    assert sorted(claimed + cancelled) == ids
    recorded.close()


def test_an_unclaimed_command_expires_and_is_never_run(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    command = queue.enqueue(robot.id, "go", time_to_live_s=0.0)
    session_cleanup.reap(recorded.connection, time.time() + 1)
    assert fetch_command(recorded.connection, command.id).status == "expired"
    assert claim(recorded.connection, robot.id, robot.session_id) == []


def test_commands_are_listed_newest_first_in_pages(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    other = recorded.robot("crane")
    ids = [queue.enqueue(robot.id, f"a{i}").id for i in range(5)]
    queue.enqueue(other.id, "not mine")
    queue.cancel(ids[0], "x")
    page = list_commands(recorded.connection, robot.id, limit=2)
    assert [c.id for c in page] == [ids[4], ids[3]]
    rest = list_commands(recorded.connection, robot.id, limit=9, before_id=ids[3])
    assert [c.id for c in rest] == [ids[2], ids[1], ids[0]]
    only = list_commands(recorded.connection, robot.id, limit=9, status="cancelled")
    assert [c.id for c in only] == [ids[0]]
    everything = list_commands(recorded.connection, robot.id, limit=-1)
    assert [c.id for c in everything] == ids[::-1]


def test_an_unknown_command_is_an_error(recorded: Recorded) -> None:
    with pytest.raises(InvalidInputError, match="no command 5"):
        fetch_command(recorded.connection, 5)


def test_the_same_parameters_in_another_order_are_the_same_request(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    first = queue.enqueue(robot.id, "go", {"x": 1, "y": 2}, idempotency_key="k")
    assert queue.enqueue(robot.id, "go", {"y": 2, "x": 1}, idempotency_key="k").id == first.id


def test_parameters_of_exactly_the_limit_are_taken_as_they_are_written(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    text = "ü" * ((MAX_PARAMS_BYTES - len('{"t": ""}')) // 2)
    filled = text + "x" * (
        MAX_PARAMS_BYTES - len(json.dumps({"t": text}, ensure_ascii=False).encode())
    )
    command = queue.enqueue(robot.id, "go", {"t": filled})
    assert len(command.params.encode()) == MAX_PARAMS_BYTES
    assert json.loads(command.params) == {"t": filled}


def test_a_caller_that_leaves_cancels_what_waits_and_only_notes_what_runs(
    recorded: Recorded,
) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    waits = queue.enqueue(robot.id, "go")
    assert queue.leave(waits.id, "the client left") is False
    assert fetch_command(recorded.connection, waits.id).status == "cancelled"
    runs = queue.enqueue(robot.id, "go")
    assert claim(recorded.connection, robot.id, robot.session_id) == [runs.id]
    assert queue.leave(runs.id, "the client left") is True
    noted = fetch_command(recorded.connection, runs.id)
    assert (noted.status, noted.error) == ("claimed", "the client left; the command continues")
    assert queue.leave(waits.id, "again") is False
    assert fetch_command(recorded.connection, waits.id).error == "the client left"


def test_a_command_is_found_by_its_key(recorded: Recorded) -> None:
    queue, robot = CommandQueue(recorded.connection), recorded.robot()
    command = queue.enqueue(robot.id, "go", idempotency_key="k")
    assert find_command(recorded.connection, "k") == command
    assert find_command(recorded.connection, "another") is None


@pytest.mark.parametrize(
    ("result", "decoded"), [(None, None), ('{"x": 1}', {"x": 1}), ("no JSON", None)]
)
def test_a_result_that_is_no_json_is_none(
    recorded: Recorded, result: str | None, decoded: object
) -> None:
    command = CommandQueue(recorded.connection).enqueue(recorded.robot().id, "go")
    assert command._replace(result=result).decoded_result() == decoded


def test_a_statement_is_sent_three_times_while_the_database_is_busy_and_else_once(
    tmp_path: Path,
) -> None:
    file, sent = tmp_path / "webots.db", list[str]()
    with closing(sqlite3.connect(file)) as holder, closing(sqlite3.connect(file, 0)) as other:
        holder.execute("CREATE TABLE t (x)")
        holder.execute("BEGIN IMMEDIATE")

        def insert(table: str, released_at: int) -> sqlite3.Cursor:
            sent.append(table)
            if len(sent) == released_at:
                holder.rollback()
            return other.execute(f"INSERT INTO {table} VALUES (1)")

        with pytest.raises(sqlite3.OperationalError, match="locked"):
            repeat_while_busy(lambda: insert("t", released_at=0))
        assert sent == ["t"] * 3
        sent.clear()
        with pytest.raises(sqlite3.OperationalError, match="no such table"):
            repeat_while_busy(lambda: insert("missing", released_at=0))
        assert sent == ["missing"]
        sent.clear()
        assert repeat_while_busy(lambda: insert("t", released_at=3)).rowcount == 1
        assert sent == ["t"] * 3
