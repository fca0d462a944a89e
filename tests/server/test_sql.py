"""SQL over MCP: tricks are refused or answered in time, and nothing else waits for them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import anyio
import pytest
from mcp import Client
from mcp.types import CallToolResult

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail, text_of
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.errors import WebotsMCPError
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.sql import FOLDER, LINE, Statement, decode

pytestmark = pytest.mark.anyio

LONG = "printf('%.*c', 9000000, 'a')"
NEEDLE = "printf('%.*c', 4000000, 'a') || 'b'"
OTHERS_FIRST = "printf('%.*c', 4000000, 'b') || 'a'"  # all are compared before the one that fits
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
DOUBLING = (
    "WITH RECURSIVE d(n, x) AS (SELECT 1, 'x' UNION ALL SELECT n + 1, x || x FROM d WHERE n < 60)"
)
# One call of a function, or one comparison, that would run for minutes or for ever.
LONG_STEPS = (
    f"SELECT length(replace({LONG}, {NEEDLE}, ''))",
    f"SELECT instr({LONG}, {NEEDLE})",
    f"SELECT {LONG} GLOB '*' || {NEEDLE} || '*a*b*'",
    f"SELECT trim({LONG}, {OTHERS_FIRST})",
    f"SELECT rtrim({LONG}, {OTHERS_FIRST})",
)
WRITES = (
    "DELETE FROM state",
    "INSERT INTO robot (name) VALUES ('x')",
    "INSERT OR REPLACE INTO lease VALUES ('x', 'thief', 9e9)",
    "REPLACE INTO lease VALUES ('x', 'thief', 9e9)",
    "UPDATE run SET label = 'x'",
    "DROP TABLE state",
    "DROP VIEW robot_now",
    "ALTER TABLE run ADD COLUMN x",
    "CREATE TABLE x (y)",
    "CREATE TEMP TABLE x (y)",
    "CREATE TEMP VIEW state AS SELECT 1",
    "CREATE TEMP TRIGGER x AFTER INSERT ON state BEGIN DELETE FROM run; END",
    "CREATE VIRTUAL TABLE x USING fts5(y)",
    "CREATE INDEX x ON state (data)",
    "WITH a AS (SELECT 1) DELETE FROM state",
    "WITH a AS (SELECT 1) INSERT INTO run (id) SELECT * FROM a",
    "WITH a AS (SELECT 1) UPDATE run SET label = 'x' RETURNING *",
    "WITH a AS (SELECT 1) REPLACE INTO lease VALUES ('x', 'y', 1.0)",
    "EXPLAIN DELETE FROM state",
    "EXPLAIN QUERY PLAN DELETE FROM state",
    "/* SELECT */ DELETE FROM state",
    "-- SELECT\nDELETE FROM state",
    "SELECT 1; DELETE FROM state",
    "SELECT 1;;DELETE FROM state",
    "SELECT 1 /* ; */; VACUUM",
    ";DELETE FROM state",
    "VALUES (1); DROP TABLE state",
    "REINDEX",
    "ANALYZE",
    "VACUUM",
    "VACUUM INTO 'copy.db'",
    "BEGIN IMMEDIATE",
    "BEGIN EXCLUSIVE",
    "COMMIT",
    "ROLLBACK",
    "SAVEPOINT x",
    "RELEASE x",
)
ESCAPES = (
    "ATTACH 'other.db' AS other",
    "ATTACH ':memory:' AS other",
    "DETACH main",
    "SELECT * FROM other.state",
    "PRAGMA journal_mode = DELETE",
    "PRAGMA user_version",
    "PRAGMA query_only = 0",
    "PRAGMA writable_schema = 1",
    "PRAGMA trusted_schema = 1",
    "PRAGMA hard_heap_limit = 0",
    "SELECT * FROM pragma_journal_mode('delete')",
    "SELECT * FROM pragma_query_only(0)",
    "SELECT * FROM pragma_database_list",
    "SELECT * FROM pragma_function_list",
    "SELECT load_extension('x')",
    "SELECT LOAD_EXTENSION('x', 'y')",
    "SELECT fts3_tokenizer('simple')",
    "SELECT Fts3_Tokenizer('simple', x'0000000000000000')",
    "SELECT hex(fts3_tokenizer('simple')) FROM state LIMIT 1",
    "SELECT * FROM (SELECT fts3_tokenizer('simple'))",
    "SELECT readfile('/etc/passwd')",
    "SELECT writefile('x', 'y')",
    "SELECT edit('x')",
    "SELECT * FROM fsdir('.')",
    "SELECT * FROM csv",
    "SELECT * FROM generate_series(1, 9)",
    "SELECT length(zeroblob(1000000000))",
    "SELECT hex(randomblob(900000000))",
)
TOO_MUCH = (
    f"{ENDLESS} SELECT count(*) FROM c",
    f"{ENDLESS} SELECT group_concat(x, '') FROM c",
    f"{ENDLESS} SELECT x FROM c ORDER BY x DESC",
    f"{DOUBLING} SELECT max(length(x)) FROM d",
    f"{DOUBLING} SELECT x FROM d ORDER BY x",
    "SELECT count(*) FROM state a, state b, state c, state d, state e, state f, state g, state h",
    "SELECT printf('%.*c', 2000000000, 'x')",
    "SELECT replace(printf('%.*c', 9000000, 'a'), 'a', printf('%.*c', 9000000, 'b'))",
    "SELECT " + ", ".join(["printf('%.*c', 9000000, 'x')"] * 90),
    "SELECT " + ", ".join(["1"] * 3000),
    "SELECT " + "(" * 3000 + "1" + ")" * 3000,
    "SELECT " + "-" * 5000 + "1",
    "",
    "   ",
    "\0",
    "SELECT 1\0; DELETE FROM state",
    "SELECT '\ud800'",
)


@pytest.fixture
def recording(file: Path) -> Path:
    recorded = Recorded(file)
    robot = recorded.robot()
    for step in range(100):
        robot.state(step * 0.1, {"x": step, "text": "y" * 1000})
    recorded.connection.execute("INSERT INTO lease VALUES ('x', 'owner', 1.0)")
    recorded.close()
    return file


@pytest.mark.slow
@pytest.mark.parametrize(
    "tricks",
    [(*WRITES, *ESCAPES), TOO_MUCH, LONG_STEPS],
    ids=["writes and escapes", "too much", "one long step"],
)
async def test_a_trick_is_refused_with_a_reason_and_changes_nothing(
    recording: Path, connect: Connect, tricks: tuple[str, ...]
) -> None:
    before = recording.read_bytes()
    answers: dict[str, CallToolResult] = {}

    async def play(trick: str) -> None:
        answers[trick] = await client.call_tool("webots_query_sql", {"sql": trick})

    async with connect(read_only=True) as client:
        with anyio.fail_after(100):
            async with anyio.create_task_group() as tasks:
                for trick in tricks:
                    tasks.start_soon(play, trick)
        assert (await ask(client, "webots_query_sql", sql="SELECT 1"))["result"]["rows"] == [[1]]
    for trick, answer in answers.items():
        said = text_of(answer).removeprefix("Error executing tool webots_query_sql").strip(": ")
        assert said and len(said) < 8000, trick
        assert answer.is_error or trick in TOO_MUCH, (trick, said)
    assert recording.read_bytes() == before
    assert [path.name for path in recording.parent.iterdir()] == [recording.name]


async def test_statements_that_take_long_do_not_keep_others_waiting(
    recording: Path, connect: Connect
) -> None:
    ended = anyio.Event()

    async def ask_for_much() -> None:
        assert "no row within 2 s" in await fail(client, "webots_query_sql", sql=LONG_STEPS[0])
        ended.set()

    async with connect(read_only=True) as client, anyio.create_task_group() as tasks:
        for _ in range(46):
            tasks.start_soon(ask_for_much)
        await anyio.wait_all_tasks_blocked()
        for _ in range(10):
            assert (await ask(client, "webots_get_robot_state"))["robot"] == "rover"
        assert not ended.is_set()
        tasks.cancel_scope.cancel()


@pytest.mark.slow
async def test_a_database_in_memory_is_asked_in_the_same_way() -> None:
    database = MemoryDatabase()
    recorded = Recorded(database)
    recorded.robot().state(1.5, {"x": 1})
    async with Client(create_server(database, database.data_dir)) as client:
        answer = await ask(client, "webots_query_sql", sql="SELECT sim_time_s FROM state")
        assert answer["result"]["rows"] == [[1.5]]
        assert "no row within 2 s" in await fail(client, "webots_query_sql", sql=LONG_STEPS[1])
    recorded.close()
    database.close()


async def test_it_is_said_that_states_were_deleted_where_a_statement_asks_of_states(
    recorded: Recorded, connect: Connect
) -> None:
    recorded.robot().state(1.5, {"x": 1})
    recorded.connection.execute("UPDATE run SET purged_rows = 7")
    async with connect() as client:
        of_states = await ask(client, "webots_query_sql", sql="SELECT count(*) FROM State")
        of_runs = await ask(client, "webots_query_sql", sql="SELECT count(*) FROM run")
    assert "retention has deleted 7 states" in of_states["hint"]
    assert "hint" not in of_runs


def test_a_file_of_the_users_folder_is_not_taken_for_a_module(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recording.parent / "json.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(recording.parent)
    asked = Statement(str(recording), "SELECT 1", 1, 100, 2.0)
    ended = subprocess.run(LINE, input=asked.encoded(), capture_output=True, cwd=FOLDER)
    assert decode(ended.stdout, ended.returncode, asked).rows == ((1,),)


def test_a_process_that_could_not_run_the_statement_is_not_called_a_slow_statement() -> None:
    asked = Statement("webots.db", "SELECT 1", 1, 100, 2.0)
    line = (sys.executable, "-m", "webots_mcp.moved_away")
    ended = subprocess.run(line, input=asked.encoded(), capture_output=True, cwd=FOLDER)
    with pytest.raises(WebotsMCPError, match=r"exit code 1.*start the server again"):
        decode(ended.stdout, ended.returncode, asked)
