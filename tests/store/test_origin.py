"""A recording of foreign origin is refused where something of its author's would run in it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp import MCPBridge
from webots_mcp.cli import main
from webots_mcp.database import connection
from webots_mcp.database.connection import Role, connect, keep_deadline
from webots_mcp.database.schema import shipped_objects
from webots_mcp.errors import DatabaseError, ForeignDatabaseError
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.merging import merge
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.sql import describe_schema

ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT {} FROM n"
AS_ROBOT = ENDLESS.format("i AS id, 'rover' AS name") + " WHERE i < 0"
RUNS = "BEGIN SELECT count(*) FROM robot_trajectory; END"
HOSTILE = {
    "view 'robot'": ("DROP TABLE robot", f"CREATE VIEW robot AS {AS_ROBOT}"),
    "view 'ROBOT'": ("DROP TABLE robot", f"CREATE VIEW ROBOT AS {AS_ROBOT}"),
    "view 'robot_now'": ("DROP VIEW robot_now", f"CREATE VIEW robot_now AS {AS_ROBOT}"),
    "view 'pragma_user_version'": (f"CREATE VIEW pragma_user_version AS {AS_ROBOT}",),
    "table 'json_each'": ("CREATE TABLE json_each (value)",),
    "trigger 'spy'": (f"CREATE TRIGGER spy AFTER INSERT ON robot {RUNS}",),
    "trigger 'on_view'": (f"CREATE TRIGGER on_view INSTEAD OF INSERT ON robot_now {RUNS}",),
    "trigger 'cascade'": (
        "CREATE TABLE note (run_id REFERENCES run (id) ON DELETE CASCADE)",
        f"CREATE TRIGGER cascade AFTER DELETE ON NOTE {RUNS}",
    ),
    "table 'lease'": (
        "DROP TABLE lease",
        "CREATE TABLE lease (name TEXT NOT NULL, holder TEXT NOT NULL, until_wall_time_s FLOAT "
        "NOT NULL, PRIMARY KEY (name), CHECK (hex(zeroblob(500000000)) > '1'))",
    ),
    "table 'watermark'": (
        "DROP TABLE watermark",
        "CREATE TABLE watermark (name TEXT NOT NULL /* chunk */, state_id INTEGER AS "
        "(length(hex(zeroblob(1000000000)))), PRIMARY KEY (name))",
    ),
    "table 'recording'": (
        "DROP TABLE recording",
        "CREATE VIRTUAL TABLE recording USING fts4(uuid, created_wall_time_s)",
    ),
    "index 'dear'": ("CREATE INDEX dear ON state (replace(data, 'a', data))",),
    "index 'some'": ("CREATE INDEX some ON state (id) WHERE data GLOB '*?*?*?*?*?x'",),
}
OWN = (
    "CREATE TABLE diary (day TEXT, words TEXT, length AS (length(words)))",
    "CREATE TRIGGER counted AFTER INSERT ON diary BEGIN DELETE FROM diary WHERE day = ''; END",
    "CREATE TABLE note (run_id INTEGER REFERENCES run (id) ON DELETE CASCADE, note TEXT)",
    f"CREATE VIEW endless AS {ENDLESS.format('i')}",
    "CREATE VIEW mine AS SELECT * FROM state",
    "CREATE INDEX by_level ON log (level, sim_time_s DESC)",
    "CREATE UNIQUE INDEX \"by_name\" ON \"robot\" (\"name\")",
    "CREATE VIRTUAL TABLE words USING fts4(message)",
    "ANALYZE",
)  # fmt: skip


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A recording of a robot's few steps."""
    recorded = Recorded(tmp_path / "webots.db")
    recorded.robot().state(1.0, {"x": 1})
    recorded.close()
    return tmp_path / "webots.db"


def change(file: Path, *statements: str) -> None:
    with closing(sqlite3.connect(file)) as other, other:
        for statement in statements:
            other.execute(statement)


@pytest.mark.parametrize("role", ["reader", "writer", "loop"])
@pytest.mark.parametrize("what", HOSTILE)
def test_what_would_run_in_our_processes_is_refused_by_name(
    file: Path, what: str, role: Role
) -> None:
    change(file, *HOSTILE[what])
    with pytest.raises(ForeignDatabaseError) as refused:
        connect(file, role)
    said = str(refused.value)
    assert said.startswith(f"the {what} in {file} ")
    assert "remove it (sqlite3 FILE 'DROP " in said


@pytest.mark.parametrize("role", ["reader", "writer", "loop"])
def test_what_was_removed_is_named_before_a_question_fails_over_it(file: Path, role: Role) -> None:
    change(file, "DROP INDEX ix_session_robot_id_id")
    connect(file, role).close()  # slower, and as true
    change(file, "DROP TABLE log")
    with pytest.raises(ForeignDatabaseError, match=r"webots\.db has no 'log'"):
        connect(file, role)


@pytest.mark.parametrize(
    "asked",
    [
        ("status",), ("runs",), ("events",), ("trends",), ("history", "x"), ("logs",), ("signals",),
        ("export",), ("sql", "SELECT 1"), ("prune",), ("pause",),
    ],
    ids=" ".join,
)  # fmt: skip
def test_every_command_refuses_it(
    file: Path, asked: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    change(file, *HOSTILE["view 'robot'"])
    assert main([*asked, "--database", str(file)]) != 0
    assert "the view 'robot' in" in capsys.readouterr().err


def test_a_robot_drives_on_beside_it_and_says_why_nothing_is_recorded(
    file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    change(file, *HOSTILE["trigger 'spy'"])
    with MCPBridge(InProcessSupervisor(), data_dir=file.parent, throttle_interval=1) as bridge:
        bridge.publish({"n": 1})
        assert bridge.get_command() is None
    assert "the trigger 'spy' in" in capfd.readouterr().err


def test_it_is_not_taken_into_another_recording(file: Path, tmp_path: Path) -> None:
    change(file, *HOSTILE["view 'robot_now'"])
    recorded = Recorded(tmp_path / "here.db")
    with pytest.raises(ForeignDatabaseError, match=r"the view 'robot_now' in .*webots\.db"):
        merge(recorded.connection, tmp_path, file)
    recorded.close()
    assert main(["import", str(file), "--data-dir", str(tmp_path / "new")]) != 0


def test_what_a_person_has_added_is_left_alone(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(file, *OWN)
    with closing(connect(file, "writer")) as writer:
        writer.execute("UPDATE run SET label = 'mine'")
    with closing(connect(file, "reader")) as reader:
        described = describe_schema(reader)
        assert "table state" in described
        assert not {"endless", "mine", "diary"} & set(described.split())
    assert main(["sql", "SELECT i FROM endless LIMIT 1", "--json", "--database", str(file)]) == 0
    assert main(["export", "--database", str(file)]) == 0  # past invalid rows, by views of ours
    assert "1" in capsys.readouterr().out


@pytest.mark.parametrize("version", [-5, 0])
def test_a_version_that_was_never_made_is_refused(file: Path, version: int) -> None:
    change(file, *HOSTILE["view 'robot'"], f"PRAGMA user_version = {version}")
    with pytest.raises(ForeignDatabaseError, match=f"tables of schema {version}, which no"):
        connect(file, "loop", create=True)


def spaced(sql: str) -> str:
    return sql.replace(", \n\t", ",").replace("CREATE TABLE lease", 'CREATE  TABLE "lease"')


def commented(sql: str) -> str:
    return sql.replace("name TEXT", "NAME text /* of it */ -- and so on\n")


@pytest.mark.parametrize("spell", [spaced, commented])
def test_the_same_table_in_other_spelling_is_ours(file: Path, spell: Callable[[str], str]) -> None:
    ours = shipped_objects()["lease"]
    assert spell(ours) != ours
    change(file, "DROP TABLE lease", spell(ours))
    connect(file, "reader").close()


def test_a_comment_within_a_text_hides_nothing(file: Path) -> None:
    ours = shipped_objects()["lease"]
    hidden = "name TEXT DEFAULT '/*' CHECK (hex(zeroblob(500000000)) > '*/')"
    change(file, "DROP TABLE lease", ours.replace("name TEXT", hidden))
    with pytest.raises(ForeignDatabaseError, match="the table 'lease'"):
        connect(file, "reader")


def test_a_statement_that_never_ends_is_ended(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "LONGEST_READ_S", 0.05)
    with (
        pytest.raises(DatabaseError, match="one statement took longer than"),
        RecordingAccess(file, file.parent).reader() as reader,
    ):
        keep_deadline(reader)  # as after a deadline of a question's own
        reader.execute(ENDLESS.format("i") + " WHERE i < 0").fetchall()
