"""What is read of rows: each value as it was published, whatever stands beside it."""

from __future__ import annotations

import json
import math
import sqlite3
from typing import Any

import pytest

from tests.recordings.rover import Recorder
from webots_mcp.store.reading import rows
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.rows import Columns, read_columns
from webots_mcp.store.rollup.rolling import roll
from webots_mcp.store.signals.registry import registered

HUGE = 2**70
STATES: list[dict[str, Any]] = [
    {"speed": 0.1 + 0.2, "mode": "go", "load": 1},
    {"speed": "1.5", "mode": '\u00e9, "x"', "load": [1, 2]},
    {"speed": {"x": 1.0}, "mode": None, "load": HUGE},
    {"speed": True, "mode": "a,b]", "load": 1e99},
    {"mode": "stop"},
]


@pytest.fixture(params=["orjson, if installed", "standard library"])
def decoder(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "standard library":
        monkeypatch.setattr(rows, "orjson", None)


def read(connection: sqlite3.Connection, names: list[str]) -> Columns:
    recorder = Recorder(connection)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    connection.execute("BEGIN")
    for step, state in enumerate(STATES):
        recorder.insert("state", **recorder.at(0.1 * step), data=json.dumps(state))
    connection.execute("COMMIT")
    roll(connection, 1000)
    known = registered(connection, robot_id)
    segment = whole_run(connection, recorder.run_id)
    assert segment is not None
    return read_columns(connection, segment, [known[name] for name in names], Deadline(math.inf))


@pytest.mark.usefixtures("decoder")
def test_values_of_other_types_in_between_change_no_others(empty: sqlite3.Connection) -> None:
    columns = read(empty, ["speed", "mode", "load"])
    assert columns.values["speed"] == ["0.30000000000000004", "1.5", None, "true", None]
    assert columns.values["mode"] == ["go", '\u00e9, "x"', None, "a,b]", "stop"]
    assert columns.values["load"] == [1, None, HUGE, 1e99, None]


@pytest.mark.usefixtures("decoder")
def test_a_signal_is_read_alone_as_it_is_among_others(empty: sqlite3.Connection) -> None:
    assert read(empty, ["load"]).values["load"] == [1, None, HUGE, 1e99, None]
