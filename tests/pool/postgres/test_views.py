"""The views of a pool give what those of each recording give."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import pytest

from tests.memory import memory_connection
from tests.pool.postgres.shipped import ship, uuid_of
from tests.postgres import Server
from tests.recordings.rover import Recorder, record_rover, start_run
from tests.store.test_views import (
    CHOICES,
    MODES,
    PLACES,
    POSES,
    SPEEDS,
    record_robots,
    some_states,
)
from webots_mcp.connection import connect
from webots_mcp.plugins.pool.postgres_schema import VIEWS
from webots_mcp.store.chunk_making import make_chunks

pytestmark = pytest.mark.slow

# Whole states, each other than those of `tests/store/test_views.py`.
STATES: list[dict[str, Any]] = [
    {"pose": [1e400, 2e-400, -1e400]},
    {"pose": {"x": 10**400, "y": 3, "yaw": None, "heading": 0.25}, "yaw": 1},
    {"lidar": list(range(40)), "arm": {"gps": [[1, 2], [3, 4]]}},
    {"x": True, "y": False, "mode": True, "state": "on"},
    {"robotX_cm": 150, "robotY_cm": -20.5, "STATUS": 3, "MODE_NAME": "home"},
    {"a.b": {"x": 1, "y": 2}, "x y": {"mode": "quiet"}, "ü": {"state": "größer"}},
    {"imuX": 1, "imuY": 2, "GPSPose": [4, 5], "nextMode": "wait", "currentTask": "go"},
]


@pytest.fixture(scope="module")
def recordings(bridge_recording: Path) -> Iterator[dict[str, sqlite3.Connection]]:
    """What a bridge recorded; the known story; states of all kinds; a bit of all else."""
    with (
        closing(connect(bridge_recording, "reader")) as bridge,
        memory_connection() as rover,
        memory_connection() as odd,
    ):
        record_rover(rover)
        assert make_chunks(rover, 100_000).done
        record_odd(odd)
        yield {"bridge": bridge, "rover": rover, "odd": odd}


@pytest.fixture(scope="module")
def shipped(postgres: Server, pool_template: str, recordings: dict[str, sqlite3.Connection]) -> str:
    """A pool with all of them."""
    pool = postgres.new_database(pool_template)
    for recording in recordings.values():
        ship(postgres, pool, recording)
    return pool


def record_odd(connection: sqlite3.Connection) -> None:
    states = [*(state for state, _ in POSES), *PLACES, *MODES, *CHOICES, *SPEEDS, *STATES]
    record_robots(connection, [*states, *some_states(200)])
    recorder = start_run(connection)
    for number, state in enumerate(states):
        text = json.dumps(state, ensure_ascii=False).replace("Infinity", "1e400")
        recorder.insert("state", **recorder.at(float(number)), data=text)
    for data in ("", "no JSON", "[1, 2]", "3", "null", '{"a":', '"text"'):
        recorder.insert("state", **recorder.at(1000.0), data=data)
        recorder.insert("event", **recorder.at(2.0), kind="change", name="mode", data=data)
    for change in ({"from": True, "to": False}, {"from": 1.5, "to": None}, {"from": "a", "to": 7}):
        text = json.dumps(change)
        recorder.insert("event", **recorder.at(3.25), kind="change", name="flag", data=text)
    record_parameters(recorder)
    recorder.insert(
        "kept_stretch", run_id=recorder.run_id, uuid="k", start_sim_time_s=2.0, end_sim_time_s=9.0,
        wall_time_s=recorder.wall_s, reason="bump",
    )  # fmt: skip
    recorder.insert("kept_state", **recorder.at(2.5), call=3, data='{"x": 1}')
    recorder.end_run("finished")
    recorder.robot("idle")
    assert make_chunks(connection, 100_000).done


def record_parameters(recorder: Recorder) -> None:
    for name, value in (("kp", "2.5"), ("fast", "true"), ("word", '"a"'), ("none", "null")):
        recorder.insert(
            "parameter", robot_id=1, session_id=1, name=name, kind="str", default_value="1",
            doc="", unit="V", declared_wall_time_s=1.0,
        )  # fmt: skip
        recorder.insert(
            "parameter_value", **recorder.at(1.0), name=name, value=value, is_default=1,
            set_by="code",
        )  # fmt: skip


def told(value: Any) -> Any:
    """A value of a view, whatever tells the time, the type of a text or the spaces of JSON."""
    if isinstance(value, str):
        try:
            return told(json.loads(value))
        except ValueError:
            return value
    if isinstance(value, dict):
        return {str(key): told(item) for key, item in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [told(item) for item in cast("list[Any]", value)]
    if isinstance(value, bool | int | float):
        return round(float(value), 9) if abs(value) < 1e308 else "infinite"
    return value


@pytest.mark.parametrize("of", ["bridge", "rover", "odd"])
@pytest.mark.parametrize("view", VIEWS)
def test_a_view_has_the_rows_that_it_has_in_the_recording(
    postgres: Server, shipped: str, recordings: dict[str, sqlite3.Connection], view: str, of: str
) -> None:
    recording = recordings[of]
    cursor = recording.execute(f"SELECT * FROM {view}")
    names = [name for name, *_ in cursor.description if name != "age_s"]
    columns = ", ".join(f'"{each}"' for each in names)
    wanted = recording.execute(f"SELECT {columns} FROM {view}").fetchall()
    found = postgres.execute(
        shipped,
        f"SELECT {columns} FROM {view} WHERE recording_uuid = %s",
        UUID(uuid_of(recording)),
    )
    assert sorted(map(comparable, found)) == sorted(map(comparable, wanted))


def comparable(row: tuple[Any, ...]) -> str:
    return json.dumps([told(value) for value in row], sort_keys=True)


def test_how_old_the_newest_state_is(
    postgres: Server, shipped: str, recordings: dict[str, sqlite3.Connection]
) -> None:
    sql = "SELECT age_s FROM robot_now WHERE robot = 'rover' AND run_id = 3"
    (here,) = recordings["rover"].execute(sql).fetchone()
    ((there,),) = postgres.execute(shipped, sql)
    assert there == pytest.approx(here, abs=60)
