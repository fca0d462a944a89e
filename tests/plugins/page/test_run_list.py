"""The list of runs on the page: outcome, reward, and curves that can be compared by eye."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import Recorder, start_run
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.plugins.page import run_list
from webots_mcp.plugins.page.page_data import all_runs, page_request
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.recording import RecordingAccess

SPEEDS = (1.0, 2.0, -0.5, None)


def write_runs(data_dir: Path, *, has_chunks: bool = True) -> None:
    """Four runs of 10 s in which x grows at one speed each or is missing; a fifth goes on."""
    with closing(connect(data_dir / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        for number, speed in enumerate(SPEEDS):
            if number:
                recorder.run(1, 1, "reset")
            for row in range(201):
                x = None if speed is None else speed * row * 0.05
                recorder.publish(row * 0.05, {"x": x, "mode": "go"})
            reward(recorder, number * 10.0)
            recorder.end_run("reset")
        recorder.run(1, 1, "reset")
        recorder.publish(0.0, {"y": 1.0})
        while has_chunks and not make_chunks(connection, 2000).done:
            pass


def reward(recorder: Recorder, value: float) -> None:
    data = f'{{"reward": {value}}}'
    recorder.insert("event", **recorder.at(10.0), kind="episode", name="", data=data)


def listed(data_dir: Path, *signals: str) -> dict[str, Any]:
    asked = page_request({"robot": "rover", "signals": json.dumps(signals)})
    return all_runs(RecordingAccess(data_dir / DATABASE_NAME, data_dir), asked)


@pytest.mark.parametrize("has_chunks", [True, False])
def test_curves_of_all_runs_share_their_axes(tmp_path: Path, has_chunks: bool) -> None:
    write_runs(tmp_path, has_chunks=has_chunks)
    answer = listed(tmp_path, "x")
    rows = {row["id"]: row for row in answer["rows"]}
    assert [*rows] == [5, 4, 3, 2, 1]
    assert (answer["signal"], answer["total"], answer["is_whole"]) == ("x", 5, True)
    span = answer["high"] - answer["low"]
    assert answer["low"] == pytest.approx(-5, abs=0.2)
    assert answer["high"] == pytest.approx(20, abs=0.2)
    for number, speed in ((1, 1.0), (2, 2.0), (3, -0.5)):
        x, y = rows[number]["curve"][-1]
        assert x == pytest.approx(1, abs=0.01)
        assert answer["low"] + y * span == pytest.approx(speed * 10, abs=0.3)
    assert rows[4]["curve"] == rows[5]["curve"] == []


def test_rewards_are_those_of_the_episodes(tmp_path: Path) -> None:
    write_runs(tmp_path)
    answer = listed(tmp_path, "x")
    assert answer["has_rewards"]
    assert [row["reward"] for row in answer["rows"]] == [None, 30.0, 20.0, 10.0, 0.0]


@pytest.mark.parametrize("signal", ["mode", "never recorded"])
def test_what_is_no_number_has_no_curve(tmp_path: Path, signal: str) -> None:
    write_runs(tmp_path)
    answer = listed(tmp_path, signal)
    assert answer["signal"] == ""
    assert all(row["curve"] == [] for row in answer["rows"])


def test_the_first_signal_that_is_no_text_is_drawn(tmp_path: Path) -> None:
    write_runs(tmp_path)
    assert listed(tmp_path, "mode", "x", "y")["signal"] == "x"


def curve_of(tmp_path: Path, values: Sequence[float | None]) -> list[tuple[float, float] | None]:
    """The curve of a run with one row for each value."""
    with closing(connect(tmp_path / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        for row, value in enumerate(values):
            recorder.publish(row * 0.1, {"n": row} | ({} if value is None else {"x": value}))
        recorder.end_run("reset")
    (row,) = listed(tmp_path, "x")["rows"]
    return row["curve"]


def test_a_signal_that_is_sampled_slowly_is_one_line(tmp_path: Path) -> None:
    curve = curve_of(tmp_path, [row / 100 if row % 8 == 0 else None for row in range(101)])
    assert None not in curve
    assert len(curve) == 13


def test_the_line_breaks_where_values_are_missing_for_long(tmp_path: Path) -> None:
    curve = curve_of(tmp_path, [None if 200 <= row < 400 else row for row in range(600)])
    assert curve.count(None) == 1
    (before, after) = (curve[curve.index(None) + step] for step in (-1, 1))
    assert before is not None and after is not None
    assert (before[0], after[0]) == (pytest.approx(1 / 3, abs=0.02), pytest.approx(2 / 3, abs=0.02))


def test_a_single_value_is_a_point(tmp_path: Path) -> None:
    assert curve_of(tmp_path, [None, None, 5.0, None]) == [(pytest.approx(2 / 3, abs=0.01), 0.0)]


def test_a_long_run_does_not_keep_the_curves_of_others_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(connect(tmp_path / DATABASE_NAME, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        for rows in (20, 30, 3000):
            if rows != 20:
                recorder.run(1, 1, "reset")
            for row in range(rows):
                recorder.publish(row * 0.1, {"x": row})
            recorder.end_run("reset")
    read: list[int] = []

    def note(*asked: Any) -> Any:
        read.append(asked[1])
        return curve(*asked)

    curve = run_list._curve
    monkeypatch.setattr(run_list, "_curve", note)
    listed(tmp_path, "x")
    assert read == [1, 2, 3]


def test_without_time_for_all_curves_the_next_requests_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_runs(tmp_path)
    monkeypatch.setattr(run_list, "LIMITS", replace(run_list.LIMITS, curves_s=0.0))
    answer = listed(tmp_path, "x")
    assert (answer["is_whole"], answer["has_more"]) == (False, False)
    assert all(row["curve"] == [] for row in answer["rows"])
    monkeypatch.undo()
    answer = listed(tmp_path, "x")
    assert (answer["is_whole"], answer["has_more"]) == (True, True)
    monkeypatch.setattr(run_list, "LIMITS", replace(run_list.LIMITS, curves_s=0.0))
    answer = listed(tmp_path, "x")
    assert [row["id"] for row in answer["rows"] if row["curve"]] == [3, 2, 1]
    assert not answer["is_whole"]  # that of the run that goes on is read anew each time
