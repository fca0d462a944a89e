"""What is read of rows: each value as it was published, whatever stands beside it."""

from __future__ import annotations

import json
import math
import sqlite3
from dataclasses import replace
from typing import Any

import pytest
from webots_mcp.store.reading.rows import Columns, Numbers, read_columns, read_numbers
from webots_mcp.store.rollup.rolling import roll

from tests.recordings.rover import Recorder
from webots_mcp.store.reading import rows
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Segment, whole_run
from webots_mcp.store.signals.registry import Signal, registered

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


MEASURED: list[dict[str, Any]] = [
    {"near": 1, "far": 10.5, "ray": [0.5, 0.25]},
    {"near": 2.5, "far": None, "ray": [0.5, None]},
    {"near": "lost", "ray": None},
    {"near": 10**400, "far": 1e200, "ray": [True]},
    {"near": {"x": 1}, "far": -HUGE, "ray": list(range(20))},
]


def recorded(
    connection: sqlite3.Connection, states: list[dict[str, Any]]
) -> tuple[Segment, dict[str, Signal]]:
    recorder = Recorder(connection)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    connection.execute("BEGIN")
    for step, state in enumerate(states):
        recorder.insert("state", **recorder.at(0.1 * step), data=json.dumps(state))
    connection.execute("COMMIT")
    roll(connection, 1000)
    segment = whole_run(connection, recorder.run_id)
    assert segment is not None
    return segment, registered(connection, robot_id)


def read(connection: sqlite3.Connection, names: list[str]) -> Columns:
    segment, known = recorded(connection, STATES)
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


def numbers_read(connection: sqlite3.Connection, states: list[dict[str, Any]]) -> Numbers:
    segment, known = recorded(connection, states)
    numbers = [
        replace(signal, kind="num", decoded=False)
        for signal in known.values()
        if signal.reduction is None
    ]
    return read_numbers(connection, segment, numbers, Deadline(math.inf))


@pytest.mark.usefixtures("decoder")
def test_numbers_are_those_of_each_row_and_nothing_else_is_one(empty: sqlite3.Connection) -> None:
    found = numbers_read(empty, MEASURED)
    assert found.times.tolist() == [0.1 * step for step in range(5)]
    nan = math.nan
    assert found.values["near"].tolist() == pytest.approx([1, 2.5, nan, math.inf, nan], nan_ok=True)
    assert found.values["far"].tolist() == pytest.approx(
        [10.5, nan, nan, 1e200, -HUGE], nan_ok=True
    )
    assert found.values["ray.1"].tolist() == pytest.approx([0.25, nan, nan, nan, 1], nan_ok=True)


@pytest.mark.usefixtures("decoder")
def test_the_numbers_of_a_signal_alone_are_those_among_others(empty: sqlite3.Connection) -> None:
    found = numbers_read(empty, [{"near": 1}, {"near": None}, {"near": 2}])
    assert found.values["near"].tolist() == pytest.approx([1, math.nan, 2], nan_ok=True)
    assert [each.tolist() for each in found.of("near")] == [[0.0, 0.2], [1.0, 2.0]]


@pytest.mark.parametrize(("count", "cut"), [(5, False), (6, True), (10, True)])
def test_rows_that_were_all_read_when_the_time_was_over_are_not_cut(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch, *, count: int, cut: bool
) -> None:
    monkeypatch.setattr(rows, "_CHUNK_ROWS", 5)
    segment, known = recorded(empty, [{"near": step} for step in range(count)])
    columns = read_columns(empty, segment, list(known.values()), Deadline(0))
    assert (columns.values["near"], columns.cut) == (list(range(5)), cut)
