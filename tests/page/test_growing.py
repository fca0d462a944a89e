"""Rows that have just come, at the end of what is drawn already."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import record_rover
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plugins.page.growing import grow_signals, grow_way
from webots_mcp.plugins.page.tab_data import NewRows
from webots_mcp.plugins.report.charts import draw_signals, draw_way
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range


@pytest.fixture(scope="module")
def rover() -> Iterator[sqlite3.Connection]:
    with memory_connection() as connection:
        record_rover(connection)
        yield connection


def beginning(rover: sqlite3.Connection, end_s: float) -> list[TimeRange]:
    return [find_range(rover, Scope(run_id=1, end_s=end_s))]


def test_a_curve_goes_on_and_the_mode_changes_where_it_did(rover: sqlite3.Connection) -> None:
    chart: Any = draw_signals(compose_signals(rover, beginning(rover, 50), ["pose.0"])[0])
    rows: dict[str, list[Any]] = {
        "pose.0": [8.0, 7.9, None],
        "mode": ["cruise", "back_up", "back_up"],
    }
    grow_signals(chart, NewRows(times=[50.0, 50.1, 50.2], values=rows))
    assert list(chart.sources["curve", "pose.0", 1].data["mean"][-3:-1]) == [8.0, 7.9]
    assert math.isnan(chart.sources["curve", "pose.0", 1].data["mean"][-1])
    modes = chart.sources["ground", "mode", 0].data
    assert list(zip(modes["value"], modes["start_s"], modes["end_s"], strict=True)) == [
        ("cruise", 0.0, 50.1),
        ("back_up", 50.1, 50.2),
    ]


def test_an_angle_that_goes_round_is_no_line_across_the_figure(rover: sqlite3.Connection) -> None:
    chart: Any = draw_signals(compose_signals(rover, beginning(rover, 50), ["heading"])[0])
    later = NewRows(times=[50.0, 50.1, 50.2], values={"heading": [3.1, -3.1, -3.0]})
    grow_signals(chart, later, {"heading"})
    means = list(chart.sources["curve", "heading", 1].data["mean"][-4:])
    assert means[0] == 3.1
    assert math.isnan(means[1])
    assert means[2:] == [-3.1, -3.0]


def test_a_way_goes_on_to_where_the_robot_is(rover: sqlite3.Connection) -> None:
    chart: Any = draw_way(compose_trajectory(rover, beginning(rover, 30))[0])
    values: dict[str, list[Any]] = {
        "pose.0": [6.0, None, 6.2],
        "pose.1": [0.1, 0.1, 0.2],
        "mode": ["turn"] * 3,
    }
    grow_way(chart, ("pose.0", "pose.1"), NewRows(times=[30.0, 30.1, 30.2], values=values))
    way, end = chart.sources["way", 0].data, chart.sources["end", 0].data
    assert (way["x0"][-1], way["x1"][-1], way["value"][-1]) == (6.0, 6.2, "turn")
    assert (end["x"], end["y"]) == ([6.2], [0.2])


def test_a_way_that_was_not_read_to_its_end_is_drawn_without_one(rover: sqlite3.Connection) -> None:
    plot = compose_trajectory(rover, beginning(rover, 30))[0]
    (track,) = plot.tracks
    cut = replace(plot, tracks=[replace(track, path=replace(track.path, is_whole=False))])
    chart = draw_way(cut)
    assert not chart.sources["end", 0].data["x"]
    assert not chart.refresh(plot), "the figure with an end is another one"
    assert draw_way(plot).sources["end", 0].data["x"]
