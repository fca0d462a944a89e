"""What was shipped comes back as what it was: once, whole, and with the same answers."""

from __future__ import annotations

import json
import math
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import pytest

from tests.plugins.pool.lab import IN_EACH_POOL, Lab
from tests.recordings import answers as recorded_answers
from tests.recordings.rounds import PART, record_rounds
from tests.recordings.runs import Recorded
from tests.store.export.test_export import publish
from tests.waiting import wait_for
from webots_mcp import MCPBridge
from webots_mcp.contract import DATABASE_NAME, new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.trends import trends
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.runs import run_info
from webots_mcp.store.trial_sets import find_trial_set, trials_of

OF_RUN = ("kept_stretch", "kept_state", "log", "event", "image", "parameter_value", "state")
LOCAL = {"id", "run_id", "session_id", "robot_id", "command_id", "trial_set_id", "path",
         "is_chunked", "idempotency_key"}  # fmt: skip


TIMES = "SELECT id FROM chunk WHERE run_id = 1 AND signal_id = 0 ORDER BY group_id LIMIT 1 OFFSET 1"
KEPT = "SELECT sim_time_s, data, replaced FROM {} WHERE run_id = ? ORDER BY sim_time_s"


@pytest.fixture(scope="module")
def _rounds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("rounds") / DATABASE_NAME
    record_rounds(file)
    return file


@pytest.fixture
def rounds(_rounds: Path, tmp_path: Path) -> Path:
    """The recording of a long run and a short one."""
    (tmp_path / "there").mkdir()
    return Path(shutil.copy(_rounds, tmp_path / "there"))


def uuid_of(database: Path, run_id: int) -> str:
    with closing(connect(database, "reader")) as connection:
        return connection.execute("SELECT uuid FROM run WHERE id = ?", (run_id,)).fetchone()[0]


def everything(connection: sqlite3.Connection, folder: Path, run_id: int) -> dict[str, Any]:
    """All of a run but what names it here; JSON by value; with the bytes of its pictures."""
    found = {each: rows(connection, each, f"run_id = {run_id}") for each in OF_RUN}
    found["run"] = rows(connection, "run", f"id = {run_id}")
    session = f"(SELECT session_id FROM run WHERE id = {run_id})"
    found["session"] = rows(connection, "session", f"id = {session}")
    found["command"] = rows(connection, "command", f"session_id = {session}")
    found["parameter"] = rows(connection, "parameter", f"session_id = {session}")
    found["trial"] = rows(connection, "trial", f"run_id = {run_id}")
    pictures = connection.execute(f"SELECT path FROM image WHERE run_id = {run_id} ORDER BY id")
    found["pictures"] = [(folder / path).read_bytes() for (path,) in pictures]
    return found


def rows(connection: sqlite3.Connection, table: str, where: str) -> list[Any]:
    names = [name for (_, name, *_) in connection.execute(f"PRAGMA table_info({table})")]
    columns = ", ".join(name for name in names if name not in LOCAL)
    query = f"SELECT {columns} FROM {table} WHERE {where} ORDER BY id"
    return valued(connection.execute(query))


def valued(rows: Iterable[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    return [tuple(map(value_of, row)) for row in rows]


def value_of(cell: Any) -> Any:
    return json.loads(cell) if isinstance(cell, str) and cell[:1] in "{[" and cell else cell


def answers(connection: sqlite3.Connection, run_id: int, part: tuple[float, float]) -> Any:
    """The answers of a run but `course`: arrays, which trends are not compared by either."""
    return without_course(recorded_answers.answers(connection, run_id, part))


def without_course(answer: Any) -> Any:
    if isinstance(answer, dict):
        named = cast("dict[str, Any]", answer)
        return {key: without_course(each) for key, each in named.items() if key != "course"}
    if isinstance(answer, list):
        return [without_course(each) for each in cast("list[Any]", answer)]
    return answer


@pytest.mark.slow
@IN_EACH_POOL
def test_a_run_of_full_rate_comes_back_with_the_same_answers_whatever_was_purged_since(
    lab: Lab, tmp_path: Path
) -> None:
    rounds, part = tmp_path / "there" / DATABASE_NAME, (25.0, 115.0)
    record_rounds(rounds, 1000)
    lab.ship(rounds, full=True)
    uuid = uuid_of(rounds, 1)
    with closing(connect(rounds, "writer")) as there:
        before = everything(there, rounds.parent, 1), answers(there, 1, part)
        prune(there, rounds.parent, Retention(state=Limit(rows=0), outlive=0), rest=False)
    lab.ship(rounds, full=True)

    found = lab.fetch(run_uuid=uuid[:13])

    assert (list(found.runs), found.only_chunks, found.unchunked) == ([uuid], [], {})
    with lab.opened() as here:
        run = found.runs[uuid]
        assert run_info(here, run).purged_rows == 0
        assert (everything(here, lab.here, run), answers(here, run, part)) == before


ODD_STATES: list[dict[str, Any]] = [
    {"z": 1, "a": {"longer": 1, "b": [{"y": 1, "x": 2}]}, "long": list(range(20))},
    {"": 1, "a b": 2, 'q"u': 3, "back\\slash": 4, "ünï": "ö\u2028", "zz": {}, "empty": []},
    {"tiny": 5e-324, "huge": 1.7e308, "e22": 1e22, "third": 1 / 3, "-": -0.0},
    {"int": 2**70 + 1, "round": 10**20, "more": 123456789012345678901234567890},
    {"nul": "a\0b", "flag": True, "none": None, "text": '{"not": "parsed"}', "k": 1e3},
    {"nan": math.nan, "inf": [math.inf, 1.0, -math.inf]},
]


@IN_EACH_POOL
def test_each_value_of_a_state_comes_back(lab: Lab, runs: Recorded) -> None:
    run_id = runs.add_run(0)
    for number, state in enumerate(ODD_STATES):
        publish(runs, float(number), state)
    runs.connection.execute(
        "UPDATE run SET uuid = ?, row_count = ? WHERE id = ?", (new_uuid(), len(ODD_STATES), run_id)
    )
    while not make_chunks(runs.connection).done:
        pass
    lab.ship(runs.folder / DATABASE_NAME, full=True)
    uuid = uuid_of(runs.folder / DATABASE_NAME, run_id)

    run = lab.fetch(run_uuid=uuid).runs[uuid]

    query = "SELECT json_group_array(json(data)) FROM state WHERE run_id = ? ORDER BY id"
    with lab.opened() as here:
        (fetched,) = here.execute(query, (run,)).fetchone()
    (recorded,) = runs.connection.execute(query, (run_id,)).fetchone()
    assert fetched == recorded


@pytest.mark.slow
@IN_EACH_POOL
@pytest.mark.parametrize("full", [True, False])
def test_a_fetched_run_has_the_answers_of_the_recording(lab: Lab, rounds: Path, full: bool) -> None:
    lab.ship(rounds, full=full)
    uuid = uuid_of(rounds, 1)
    with closing(connect(rounds, "writer")) as there:
        before = answers(there, 1, PART)
        if not full:
            prune(there, rounds.parent, Retention(state=Limit(rows=0), outlive=0), rest=False)
        expected = answers(there, 1, PART)

    found = lab.fetch(run_uuid=uuid)

    assert (found.only_chunks, found.unchunked) == ([] if full else [uuid], {})
    with lab.opened() as here:
        run = found.runs[uuid]
        info = run_info(here, run)
        fetched = answers(here, run, PART)
    assert info.purged_rows == (0 if full else info.row_count)
    assert fetched == expected
    for name in ("trends", "trends of a part", "events", "events of a part", "timeline", "history"):
        assert of_values(fetched[name]) == of_values(before[name])


def of_values(answer: Any) -> Any:
    """An answer without what is said of rows that are here or not, and read from a single row."""
    if isinstance(answer, dict):
        named = cast("dict[str, Any]", answer)
        return {k: of_values(each) for k, each in named.items() if k not in ("notes", "around")}
    if isinstance(answer, list):
        return [of_values(each) for each in cast("list[Any]", answer)]
    return answer


@pytest.mark.slow
def test_of_a_run_whose_first_rows_were_purged_before_they_were_shipped_the_others_come(
    lab: Lab, rounds: Path
) -> None:
    with closing(connect(rounds, "writer")) as there:
        there.execute("UPDATE run SET keep = 1 WHERE id = 2")
        prune(there, rounds.parent, Retention(state=Limit(rows=1500), outlive=0), rest=False)
    lab.ship(rounds, full=True)
    uuid = uuid_of(rounds, 1)

    found = lab.fetch(run_uuid=uuid)

    assert found.only_chunks == []
    with closing(connect(rounds, "reader")) as there, lab.opened() as here:
        assert answers(here, found.runs[uuid], PART) == answers(there, 1, PART)
        assert everything(here, lab.here, found.runs[uuid]) == everything(there, rounds.parent, 1)


def test_of_a_run_with_damaged_times_the_rest_is_fetched(lab: Lab, rounds: Path) -> None:
    """It was refused, and free space and permissions were blamed."""
    with closing(connect(rounds, "writer")) as there:
        there.execute(f"UPDATE chunk SET numbers = x'00' WHERE id = ({TIMES})")
    lab.ship(rounds)
    uuid = uuid_of(rounds, 1)
    run_id = lab.fetch(run_uuid=uuid).runs[uuid]
    with lab.opened() as here:
        found = trends(here, find_range(here, Scope(run_id=run_id)), ["mode"])
    assert [each for each in found.notes if "simulation times is missing" in each]


@IN_EACH_POOL
def test_kept_stretches_come_whole_though_only_chunks_were_shipped(
    lab: Lab, tmp_path: Path
) -> None:
    database = tmp_path / "there" / DATABASE_NAME
    robot = InProcessSupervisor("rover")
    camera = robot.getDevice("camera")
    camera.enable(16)
    with MCPBridge(robot, database=database, keep_last_s=0.2) as bridge:
        bridge.keep_camera(camera)
        bridge.parameter("kp", 2.0)
        bridge.breakpoint("n == 40", action="log")
        for number in range(100):
            robot.step(16)
            bridge.publish({"n": number, "odd": float("nan")})
        bridge.log("a line")
        bridge.keep("a look")
    lab.ship(database, pictures=True)
    uuid = uuid_of(database, 1)

    found = lab.fetch(run_uuid=uuid)

    run = found.runs[uuid]
    with closing(connect(database, "reader")) as there, lab.opened() as here:
        before, after = everything(there, database.parent, 1), everything(here, lab.here, run)
        kept = valued(here.execute(KEPT.format("kept_state"), (run,)))
        in_both = "(SELECT * FROM all_state a WHERE EXISTS (SELECT 1 FROM kept_stretch k WHERE "
        in_both += "a.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s))"
        assert kept == valued(there.execute(KEPT.format(in_both), (1,))) != []
    assert after["state"] == [] != before["state"]
    for name in ("log", "event", "image", "parameter_value", "parameter", "session", "pictures"):
        assert after[name] == before[name] != []
    assert found.unchunked == {}


@pytest.mark.slow
@pytest.mark.parametrize("full", [True, False])
def test_states_that_retention_moved_after_they_were_shipped_come_once(
    lab: Lab, rounds: Path, full: bool
) -> None:
    with closing(connect(rounds, "writer")) as there:
        there.execute(
            "INSERT INTO kept_stretch (run_id, uuid, start_sim_time_s, end_sim_time_s, "
            "wall_time_s, reason) VALUES (1, ?, 10, 20, 0, 'a bump')",
            (new_uuid(),),
        )
        lab.ship(rounds, full=full)
        prune(there, rounds.parent, Retention(state=Limit(rows=0), outlive=0), rest=False)
        expected = there.execute("SELECT data FROM kept_state ORDER BY sim_time_s").fetchall()
    lab.ship(rounds, full=full)

    run = lab.fetch(run_uuid=uuid_of(rounds, 1)).runs[uuid_of(rounds, 1)]

    stretch = "SELECT data FROM all_state WHERE run_id = ? AND sim_time_s BETWEEN 10 AND 20"
    with lab.opened() as here:
        found = here.execute(f"{stretch} ORDER BY sim_time_s", (run,)).fetchall()
    assert found == expected != []


@pytest.mark.slow
@IN_EACH_POOL
def test_a_label_a_set_a_robot_and_a_time_say_which_runs_come(lab: Lab, runs: Recorded) -> None:
    database = runs.folder / DATABASE_NAME
    lab.ship(database, full=True, pictures=True)
    uuids = [uuid_of(database, run_id) for run_id in (1, 2, 3)]

    assert list(lab.fetch(label="wall 2").runs) == [uuids[1]]
    assert list(lab.fetch(robot="drone").runs) == [uuids[2]]
    (begun_s,) = runs.connection.execute(
        "SELECT started_wall_time_s FROM run WHERE id = 2"
    ).fetchone()
    found = lab.fetch(until=str(begun_s))
    assert list(found.runs) == [uuids[0]]
    again = lab.fetch(label="wall *")
    assert (sorted(again.runs), sorted(again.known), again.come) == (
        sorted(uuids),
        sorted(uuids),
        [],
    )
    with lab.opened() as here:
        for run_id, uuid in enumerate(uuids, 1):
            assert everything(here, lab.here, again.runs[uuid]) == everything(
                runs.connection, runs.folder, run_id
            )


@IN_EACH_POOL
def test_a_trial_set_comes_with_its_runs_and_the_trials_that_wait(lab: Lab, runs: Recorded) -> None:
    lab.ship(runs.folder / DATABASE_NAME)
    (uuid,) = runs.connection.execute("SELECT uuid FROM trial_set").fetchone()

    found = lab.fetch(trials=uuid[:8])

    assert len(found.runs) == 2
    with lab.opened() as here:
        set_id = find_trial_set(here)
        assert set_id is not None
        told = [(trial.status, trial.score, trial.run_id) for trial in trials_of(here, set_id)]
        one, two = found.runs.values()
        assert told == [("done", 1.5, one), ("done", 3.0, two), ("waiting", None, None)]


def test_fetching_again_changes_nothing(lab: Lab, runs: Recorded) -> None:
    lab.ship(runs.folder / DATABASE_NAME, full=True, pictures=True)
    first = lab.fetch(robot="rover")
    before, files = lab.everything(), sorted(lab.here.rglob("*"))

    again = lab.fetch(robot="rover")

    assert (again.runs, again.come) == (first.runs, [])
    assert lab.everything() == before
    assert sorted(lab.here.rglob("*")) == files


def test_pictures_that_were_not_shipped_are_rows_without_a_file(lab: Lab, runs: Recorded) -> None:
    lab.ship(runs.folder / DATABASE_NAME)
    lab.fetch(robot="rover")
    with lab.opened() as here:
        paths = [path for (path,) in here.execute("SELECT path FROM image").fetchall()]
    assert len(paths) == 2
    assert not [path for path in paths if (lab.here / path).exists()]


def test_what_goes_on_or_is_not_wholly_shipped_is_fetched_when_it_is(
    lab: Lab, runs: Recorded
) -> None:
    database = runs.folder / DATABASE_NAME
    late = runs.add_run(5, end=None)
    runs.connection.execute(
        "UPDATE run SET uuid = ?, row_count = 5 WHERE id = ?", (new_uuid(), late)
    )
    lab.ship(database, full=True)
    uuid = uuid_of(database, late)
    before = lab.everything()

    found = lab.fetch(run_uuid=uuid)
    assert (found.runs, found.going_on) == ({}, [uuid])

    runs.connection.execute(
        "UPDATE run SET ended_wall_time_s = last_wall_time_s, end_reason = 'finished'"
    )
    lab.ship(database, full=True)
    (progress,) = Path(lab.url).glob("recording=*/_progress")
    whole = json.loads(progress.read_text())
    numbers = {name: n for name, n in whole["numbers"].items() if not name.startswith("run.whole")}
    (rows,) = (part["rows"] for name, part in whole["parts"].items() if name == "state")
    fewer = {folder: count - 3 for folder, count in rows.items()}
    parts = whole["parts"] | {"state": whole["parts"]["state"] | {"rows": fewer}}
    for not_yet in ({"numbers": numbers}, {"parts": parts}):
        progress.write_text(json.dumps(whole | not_yet))
        found = lab.fetch(run_uuid=uuid)
        assert (found.runs, found.arriving) == ({}, [uuid])
        assert lab.everything() == before

    progress.write_text(json.dumps(whole))
    assert list(lab.fetch(run_uuid=uuid).runs) == [uuid]


def test_a_run_that_lacks_is_answered_with_the_nearest(lab: Lab, runs: Recorded) -> None:
    lab.ship(runs.folder / DATABASE_NAME)
    uuid = uuid_of(runs.folder / DATABASE_NAME, 1)
    wrong = ("0" if uuid[0] != "0" else "1") + uuid[1:]
    with pytest.raises(InvalidInputError, match=f"nearest are '{uuid}'"):
        lab.fetch(run_uuid=wrong)
    with pytest.raises(InvalidInputError, match="run whose UUID begins with ''"):
        lab.fetch(run_uuid="")
    with pytest.raises(InvalidInputError, match="the label 'wal 2'; nearest are 'wall 2'"):
        lab.fetch(label="wal 2")
    with pytest.raises(InvalidInputError, match="no robot called 'rovr'; nearest are 'rover'"):
        lab.fetch(robot="rovr")
    with pytest.raises(InvalidInputError, match="which runs"):
        lab.fetch()


@pytest.mark.slow
def test_a_fetch_that_is_killed_leaves_whole_runs_and_is_gone_on_with(
    lab: Lab, runs: Recorded
) -> None:
    for _ in range(60):
        run_id = runs.add_run(20)
        for table in ("session", "run"):
            update = f"UPDATE {table} SET uuid = ? WHERE id = ?"
            runs.connection.execute(update, (new_uuid(), run_id))
    lab.ship(runs.folder / DATABASE_NAME, full=True)
    words = ("fetch", "--from", lab.url, "--robot", "rover", "--data-dir", str(lab.here))
    line = [sys.executable, "-m", "webots_mcp", *words]
    with subprocess.Popen(line) as fetching, lab.opened() as here:
        wait_for(lambda: count(here, "run") or fetching.poll() is not None, pause_s=0.001)
        fetching.kill()
        fetching.wait()
        some = count(here, "run")
        assert here.execute(
            "SELECT count(*) FROM run WHERE row_count <> (SELECT count(*) FROM state "
            "WHERE run_id = run.id) OR NOT EXISTS (SELECT 1 FROM image WHERE run_id = run.id)"
        ).fetchone() == (0,)

    found = lab.fetch(robot="rover")

    assert len(found.known) == some
    assert len(found.runs) == 62
    with lab.opened() as here:
        assert count(here, "state") == 16 + 60 * 20
    assert not list(lab.here.glob(".fetch-*"))


def count(connection: sqlite3.Connection, table: str) -> int:
    return connection.execute(f"SELECT count(*) FROM {table}").fetchone()[0]


def test_what_a_killed_fetch_left_is_removed_by_the_next(lab: Lab, runs: Recorded) -> None:
    lab.ship(runs.folder / DATABASE_NAME)
    (lab.here / ".fetch-999999999-x").mkdir()
    lab.fetch(robot="rover")
    assert not list(lab.here.glob(".fetch-*"))


@IN_EACH_POOL
def test_what_was_declared_of_signals_comes_with_the_runs_of_their_robot(
    lab: Lab, rounds: Path
) -> None:
    with closing(connect(rounds, "writer")) as connection:
        connection.execute(
            "INSERT INTO meaning (robot_id, name, source, quantity, low, set_wall_time_s, set_by) "
            "SELECT robot_id, 'u', 'declared', 'speed', -1.5, 1, 'mcp' FROM run WHERE id = 1"
        )
    lab.ship(rounds)
    lab.fetch(run_uuid=uuid_of(rounds, 1))
    with lab.opened() as here:
        rows = here.execute("SELECT name, quantity, low, set_by FROM meaning").fetchall()
    assert rows == [("u", "speed", -1.5, "mcp")]
