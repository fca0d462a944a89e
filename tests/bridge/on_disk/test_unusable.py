"""A database that cannot be used costs rows, never the robot."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.bridge.conftest import (
    STEP_MS,
    Recording,
    catch_up,
    heartbeat_now,
    keep_in_memory,
    numbers,
    write_lock,
)
from webots_mcp import MCPBridge
from webots_mcp.bridge import backlog, recorder
from webots_mcp.contract import DATABASE_NAME, SCHEMA_VERSION
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import DatabaseError
from webots_mcp.standin import InProcessSupervisor


@pytest.mark.usefixtures("retry_at_once")
def test_a_full_disk_makes_rows_wait_until_there_is_room(
    bridge: MCPBridge, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    connection = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
    assert connection is not None
    bridge.publish({"n": 0})
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    connection.execute(f"PRAGMA max_page_count={pages}")
    n = 0
    while not bridge.stats().rows_waiting:
        n += 1
        bridge.publish({"n": n, "padding": "x" * 1000})
    bridge.publish({"n": n + 1})
    assert capfd.readouterr().err.count("database or disk is full") == 1
    connection.execute("PRAGMA max_page_count=1000000")
    bridge.publish({"n": n + 2})
    catch_up(bridge)
    assert numbers(filed) == list(range(n + 3))


@pytest.mark.usefixtures("retry_at_once")
@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be deleted there")
def test_a_deleted_database_is_made_again_and_told(
    bridge: MCPBridge, file: Path, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    bridge.publish({"n": 0})
    for part in file.parent.glob(f"{DATABASE_NAME}*"):
        part.unlink()
    heartbeat_now(bridge)
    bridge.publish({"n": 1})
    catch_up(bridge)
    assert numbers(filed) == [1]
    assert filed.rows("SELECT count(*) FROM event WHERE kind = 'storage'") == [1]
    assert "deleted or replaced" in capfd.readouterr().err


@pytest.mark.usefixtures("retry_at_once")
@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be deleted there")
def test_breakpoints_stay_armed_in_a_new_database(
    robot: InProcessSupervisor, bridge: MCPBridge, file: Path, filed: Recording
) -> None:
    bridge.breakpoint("n == 1", "log")
    with closing(connect(file, "writer")) as connection:
        connection.execute(
            "INSERT INTO breakpoint (robot_id, condition, action, created_wall_time_s) "
            "SELECT id, 'n == 1 or n > 9', 'log', 0 FROM robot"
        )
    bridge._session.breakpoints.load()  # pyright: ignore[reportPrivateUsage]
    for part in file.parent.glob(f"{DATABASE_NAME}*"):
        part.unlink()
    heartbeat_now(bridge)
    for reset in (False, True):
        if reset:
            robot.simulationReset()
        for n in range(3):
            robot.step(STEP_MS)
            bridge.publish({"n": n})
            catch_up(bridge)
    hits = filed.rows("SELECT condition, hit_count FROM breakpoint ORDER BY condition")
    assert hits == [("n == 1", 2), ("n == 1 or n > 9", 2)]
    assert filed.rows("SELECT count(*) FROM event WHERE kind = 'breakpoint'") == [4]


@pytest.mark.usefixtures("retry_at_once")
@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be moved there")
@pytest.mark.parametrize("schema", [b"CREATE nonsense", b"CREATE \xff\xfe"])
def test_a_database_that_is_damaged_in_mid_run_is_moved_aside_and_a_new_one_begun(
    bridge: MCPBridge,
    file: Path,
    filed: Recording,
    capfd: pytest.CaptureFixture[str],
    schema: bytes,
) -> None:
    bridge.publish({"n": 0})
    damage_schema(file, schema)
    bridge.publish({"n": 1})
    bridge.publish({"n": 2})
    catch_up(bridge)
    assert numbers(filed) == [1, 2]
    assert len(list(file.parent.glob(f"{DATABASE_NAME}.damaged-*"))) >= 1
    assert filed.rows("SELECT count(*) FROM event WHERE kind = 'storage'") == [1]
    assert capfd.readouterr().err.count("was damaged") == 1


def test_a_damaged_database_is_moved_aside_at_the_start(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    MCPBridge(robot, data_dir=file.parent).close()
    content = bytearray(file.read_bytes())
    content[100:] = b"\xa5" * (len(content) - 100)
    file.write_bytes(content)
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
    assert numbers(filed) == [1]
    (kept,) = file.parent.glob(f"{DATABASE_NAME}.damaged-*")
    assert kept.read_bytes() == content


def test_a_file_that_is_no_database_is_moved_aside_only_under_our_name(
    robot: InProcessSupervisor, file: Path, filed: Recording, tmp_path: Path
) -> None:
    file.parent.mkdir()
    file.write_text("this is no database, but it is long enough to look like one" * 20)
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
    assert numbers(filed) == [1]
    notes = tmp_path / "notes.txt"
    notes.write_text("my notes" * 200)
    with MCPBridge(robot, database=notes, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
        assert bridge.stats().rows_dropped > 0
        assert "not recording into" in (bridge.stats().last_error or "")
    assert notes.read_text() == "my notes" * 200


def test_a_database_of_another_application_is_left_alone(
    robot: InProcessSupervisor, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.db"
    connection = sqlite3.connect(other)
    connection.execute("CREATE TABLE customer (name)")
    connection.close()
    content = other.read_bytes()
    with MCPBridge(robot, database=other, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
    assert "belongs to another application" in capfd.readouterr().err
    assert other.read_bytes() == content
    assert [path.name for path in tmp_path.iterdir()] == ["other.db"]


@pytest.mark.parametrize(
    ("version", "next_step"),
    [
        (SCHEMA_VERSION + 1, "pip install --upgrade"),
        (SCHEMA_VERSION - 1, "move it aside"),
    ],
)
def test_another_schema_is_said_and_the_robot_drives_on(
    robot: InProcessSupervisor,
    file: Path,
    version: int,
    next_step: str,
    capfd: pytest.CaptureFixture[str],
) -> None:
    connection = connect(file, "writer", create=True)
    create_schema(connection)
    connection.execute(f"PRAGMA user_version={version}")
    connection.close()
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
        assert bridge.get_command() is None
        assert bridge.stats().rows_dropped > 0
    assert next_step in capfd.readouterr().err


def test_an_sqlite_that_is_too_old_is_said_and_the_robot_drives_on(
    robot: InProcessSupervisor,
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 34, 1))
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
    assert "3.38 is needed" in capfd.readouterr().err


def test_a_relative_path_is_opened_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    connect(Path("here.db"), "writer", create=True).close()
    assert (tmp_path / "here.db").exists()


def test_strict_mode_raises_instead(
    robot: InProcessSupervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(Exception, match="cannot be made"):
        MCPBridge(robot, data_dir=blocked / "below")


def test_in_strict_mode_a_row_that_is_dropped_raises(
    robot: InProcessSupervisor, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    monkeypatch.setattr(backlog, "MAX_WAITING_ROWS", 1)
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=1) as bridge:
        keep_in_memory(bridge)
        with write_lock(file):
            bridge.publish({"n": 0})
            with pytest.raises(DatabaseError, match="rows are being dropped"):
                bridge.publish({"n": 1})


def test_a_folder_that_cannot_be_made_costs_rows_only(
    robot: InProcessSupervisor, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with MCPBridge(robot, data_dir=blocked / "below", throttle_interval=1) as bridge:
        robot.step(STEP_MS)
        bridge.publish({"n": 1})
        assert bridge.get_command() is None
        assert bridge.stats().rows_waiting >= 1
    assert "cannot be made" in capfd.readouterr().err


@pytest.mark.usefixtures("retry_at_once")
def test_a_database_that_turns_read_only_costs_rows_only(
    bridge: MCPBridge, filed: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    connection = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
    assert connection is not None
    connection.execute("PRAGMA query_only=ON")
    bridge.publish({"n": 0})
    bridge.publish({"n": 1})
    assert bridge.stats().rows_waiting == 2
    assert capfd.readouterr().err.count("readonly") == 1
    connection.execute("PRAGMA query_only=OFF")
    bridge.publish({"n": 2})
    catch_up(bridge)
    assert numbers(filed) == [0, 1, 2]


@pytest.mark.parametrize("method", ["publish", "log", "get_command", "auto_publish"])
def test_after_close_nothing_raises(bridge: MCPBridge, method: str) -> None:
    bridge.close()
    arguments = {"publish": ({"n": 1},), "log": ("late",)}.get(method, ())
    answer = getattr(bridge, method)(*arguments)
    assert answer is None or method == "auto_publish"  # which returns the state all the same


def test_a_log_line_may_hold_any_text(bridge: MCPBridge, filed: Recording) -> None:
    bridge.log("null \0 and \ud800 surrogate", level="warning")
    bridge.log(42, level="loud")
    sql = "SELECT level, message FROM log ORDER BY id"
    assert filed.rows(sql) == [("warning", "null \\0 and ? surrogate"), ("info", "42")]


def test_importing_the_bridge_needs_nothing_but_the_standard_library(tmp_path: Path) -> None:
    package = Path(recorder.__file__).parents[2]
    program = (
        f"import sys; sys.path.insert(0, {str(package)!r}); sys.modules['orjson'] = None; "
        "from webots_mcp import MCPBridge; "
        "heavy = {'sqlmodel', 'sqlalchemy', 'alembic', 'mcp', 'pydantic', 'PIL', 'numpy', "
        "'subprocess', 'asyncio', 'dataclasses', 'controller'} & set(sys.modules); "
        "print(sorted(heavy))"
    )
    line = [sys.executable, "-I", "-S", "-c", program]
    done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path, check=True)
    assert done.stdout.strip() == "[]"


def damage_schema(file: Path, schema: bytes) -> None:
    """Make every statement fail that is prepared from now on."""
    other = sqlite3.connect(file, isolation_level=None)
    other.execute("PRAGMA writable_schema=ON")
    damage = "UPDATE sqlite_master SET sql = CAST(? AS TEXT) WHERE name = 'state'"
    other.execute(damage, (schema,))
    other.execute("PRAGMA schema_version=9999")
    other.close()
