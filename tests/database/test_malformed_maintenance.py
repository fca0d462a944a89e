"""What no bridge has written costs maintenance that row, and never the rows after it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rows import Recorded, insert
from tests.server.malformed import NOT_UTF8, Damage
from webots_mcp.database.maintenance import Maintainer
from webots_mcp.database.session_cleanup import find_dead_sessions
from webots_mcp.database.waiting_file import FORMAT, adopt
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention

BLOB = b"\x00\xff\x01"
IN_CHUNKS = (
    "SELECT name, sum(c.row_count) FROM chunk c JOIN signal s ON s.id = c.signal_id "
    "GROUP BY name ORDER BY name"
)


@pytest.mark.parametrize(
    "damage",
    [
        Damage("state", "sim_time_s", "late"),
        Damage("state", "sim_time_s", BLOB),
        Damage("state", "data", NOT_UTF8),
    ],
    ids=str,
)
def test_a_row_that_cannot_be_put_into_a_chunk_costs_only_itself_and_is_named(
    recorded: Recorded, damage: Damage, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    robot.state(2.0, {"x": 2, "y": 0})
    damage.apply(recorded.connection)
    robot.state(3.0, {"x": 3})
    assert chunk_whole_run(recorded.connection, robot.run_id)
    assert dict(recorded.connection.execute(IN_CHUNKS).fetchall()) == {"x": 2}
    assert "1 states from state 2 on are left out" in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage",
    [
        Damage("watermark", "state_id", "yesterday"),
        Damage("watermark", "state_id", 2**63 - 1),
        Damage("run", "is_chunked", "yesterday"),
        Damage("signal", "min", "little"),
        Damage("signal", "name", BLOB),
        Damage("signal", "path", BLOB),
    ],
    ids=str,
)
def test_a_wrong_value_in_what_chunks_are_made_by_does_not_keep_new_rows_out(
    recorded: Recorded, damage: Damage, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    make_chunks(recorded.connection)
    assert chunk_whole_run(recorded.connection, robot.run_id)
    damage.apply(recorded.connection)
    for step in range(1024):
        robot.state(2.0 + step, {"x": 1, "fresh": 1})
    assert make_chunks(recorded.connection).done
    found = dict(recorded.connection.execute(IN_CHUNKS).fetchall())
    assert found.pop("fresh") == 1024
    assert damage.column in ("name", "path") or found == {"x": 1025}


@pytest.mark.parametrize("table", ["state", "log", "event", "image"])
@pytest.mark.parametrize("value", ["yesterday", BLOB, 1e300])
@pytest.mark.parametrize("column", ["sim_time_s", "wall_time_s"])
def test_a_row_without_a_time_does_not_keep_others_from_being_purged(
    recorded: Recorded, tmp_path: Path, table: str, value: Any, column: str
) -> None:
    robot = recorded.robot(now=1000.0)
    for step in range(5):
        robot.state(step, {"x": 1})
        robot.log(step, "hello")
        robot.event(step, "change", "x", {})
        robot.image(step, f"{step}.png")
    Damage(table, column, value).apply(recorded.connection)
    limit = Limit(age_s=10, spared_rows=0)
    prune(recorded.connection, tmp_path, Retention(*[limit] * 5, outlive=0), now_s=2000, rest=False)
    assert recorded.connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0] <= 1


def test_the_process_of_a_session_need_not_be_text(recorded: Recorded) -> None:
    recorded.robot(process="x")
    recorded.connection.execute("UPDATE session SET process = CAST(x'7bff' AS TEXT)")
    assert find_dead_sessions(recorded.connection) == [(1, "crashed")]


HEADER = {"webots_mcp_waiting": FORMAT, "robot": {}, "session": {"uuid": "u"}}


@pytest.mark.parametrize(
    "lines",
    [
        [{"webots_mcp_waiting": FORMAT}],
        [HEADER],
        [{**HEADER, "session": {"uuid": ["u"], "started_wall_time_s": 1}}],
    ],
)
def test_a_waiting_file_that_no_controller_has_written_is_passed_over(
    recorded: Recorded, lines: list[Any]
) -> None:
    assert isinstance(recorded.database, Path)
    path = Path(f"{recorded.database}-waiting-u.jsonl")
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert adopt(recorded.connection, recorded.database) == 0


def test_an_entry_that_no_controller_has_written_costs_only_itself(recorded: Recorded) -> None:
    assert isinstance(recorded.database, Path)
    robot = recorded.robot(uuid="u")
    recorded.connection.execute("UPDATE run SET uuid = 'r'")
    state = [1.0, 1.0, "{}", None]
    lines: list[Any] = [
        HEADER, [1, ["state"], "r", state], [2**70, "state", "r", state],
        [2, "state", ["r"], state], [3, "state", "r", 7],
        [4, "state", "r", [{}]], [5, "state", "r", state],
    ]  # fmt: skip
    path = Path(f"{recorded.database}-waiting-u.jsonl")
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert adopt(recorded.connection, recorded.database) == 1
    assert recorded.connection.execute("SELECT run_id FROM state").fetchall() == [(robot.run_id,)]


@pytest.mark.parametrize(
    ("column", "value"),
    [("until_wall_time_s", "tomorrow"), ("until_wall_time_s", BLOB), ("holder", BLOB)],
    ids=str,
)
def test_a_lease_that_nobody_of_ours_wrote_is_taken(
    recorded: Recorded, tmp_path: Path, column: str, value: Any
) -> None:
    lease = {"name": "maintainer", "holder": "server 1 ab", "until_wall_time_s": 0.0}
    insert(recorded.connection, "lease", lease | {column: value})
    maintainer = Maintainer(tmp_path / "webots.db", "server")
    try:
        assert maintainer.tick()
        assert maintainer.tick()
        held = recorded.connection.execute("SELECT holder, until_wall_time_s FROM lease").fetchone()
    finally:
        maintainer.stop()
    assert held[0].startswith("server ") and held[1] > 1e9
