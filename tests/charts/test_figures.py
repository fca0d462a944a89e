"""What stands in the interactive figures."""

from __future__ import annotations

import math
import re
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bokeh.embed import file_html
from bokeh.models import GlyphRenderer, HoverTool, LegendItem, Patches, Plot, Scatter, VStrip
from bokeh.resources import INLINE

from tests.plotting.conftest import Record, whole
from webots_mcp.errors import NothingRecordedError, UnknownSignalError
from webots_mcp.plotting.signals import compose_signals
from webots_mcp.plugins.report.charts import signals_chart, way_chart

ARENA = Path(__file__).parents[2] / "examples" / "worlds" / "arena.wbt"


def models(layout: Any, kind: type[Any]) -> list[Any]:
    return [each for each in layout.select({}) if isinstance(each, kind)]


def sources(layout: Any, glyph: type[Any]) -> list[dict[str, Any]]:
    """The data of all glyphs of a kind."""
    drawn = models(layout, GlyphRenderer)
    return [dict(each.data_source.data) for each in drawn if isinstance(each.glyph, glyph)]


def test_a_curve_has_the_recorded_values_and_is_broken_where_there_are_none(
    rover: sqlite3.Connection,
) -> None:
    chart: Any = signals_chart(rover, [whole(rover)], ["pose.0"])
    data = chart.sources["curve", "pose.0", 1].data
    times, means = np.asarray(data["time_s"]), np.asarray(data["mean"])
    assert np.interp(20.0, times[:100], means[:100]) == pytest.approx(4.0, abs=0.05)
    assert np.isnan(times).sum() == 1
    assert not ((times > 90.5) & (times < 94.5)).any()


def test_an_extreme_between_two_buckets_is_in_the_data(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover)], ["ir"])
    assert np.nanmax(chart.sources["curve", "ir", 1].data["high"]) == 5.0


def test_modes_are_the_ground_of_each_panel_with_their_names(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover)], ["pose.0", "battery_v"])
    bands = chart.sources["ground", "mode", 0].data
    assert list(bands["value"]) == ["cruise", "back_up", "avoid", "cruise"]
    grounds = [data for data in sources(chart.layout, VStrip) if "colour" in data]
    assert len(grounds) == 2


def test_all_figures_share_one_range_of_time(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover)], ["pose.0", "battery_v", "sensors.bumper"])
    figures = models(chart.layout, Plot)
    assert len(figures) == 3
    assert {id(each.x_range) for each in figures} == {id(chart.x_range)}


def test_events_and_commands_are_marks_that_tell_what_they_are(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover)], ["pose.0"])
    told = {
        label
        for tool in models(chart.layout, HoverTool)
        for label, text in tool.tooltips
        if text == "@value"
    }
    assert {"stuck", "command", "log"} <= told
    marks = [data for data in sources(chart.layout, Scatter) if "start_s" in data]
    assert any(pytest.approx(data["start_s"][0], abs=0.3) == 40.0 for data in marks)


def test_runs_over_each_other_begin_at_zero_each(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover, 1), whole(rover, 2)], ["pose.0"])
    starts = [chart.sources["curve", "pose.0", run].data["time_s"][0] for run in (1, 2)]
    assert max(starts) < 1


def test_the_way_ends_where_the_robot_is_and_has_equal_scales(rover: sqlite3.Connection) -> None:
    chart: Any = way_chart(rover, [whole(rover)])
    end = chart.sources["end", 0].data
    assert (end["x"][0], end["y"][0]) == pytest.approx((12.79, 1.0), abs=0.05)
    (plot,) = models(chart.layout, Plot)
    assert plot.match_aspect
    way = chart.sources["way", 0].data
    assert set(way["value"]) == {"cruise", "back_up", "avoid"}


def test_obstacles_come_from_the_world_file(record: Record) -> None:
    connection = record(lambda t: {"pose": [t / 10, 0.0]})
    connection.execute("UPDATE run SET world = ?", (str(ARENA),))
    (shapes,) = sources(way_chart(connection, [whole(connection)]).layout, Patches)
    corners = dict(zip(shapes["name"], zip(shapes["xs"], shapes["ys"], strict=True), strict=True))
    xs, ys = corners["wall east"]
    assert (min(xs), max(xs)) == pytest.approx((2.0, 2.04))
    assert (min(ys), max(ys)) == pytest.approx((-2.04, 2.04))
    assert "crate" not in corners  # it is pushed about


@pytest.mark.parametrize("world", ["/nowhere/at/all.wbt", "", "a\0b.wbt", __file__])
def test_a_way_is_drawn_where_the_world_file_is_not_to_be_read(record: Record, world: str) -> None:
    connection = record(lambda t: {"pose": [t, 0.0]})
    connection.execute("UPDATE run SET world = ?", (world,))
    (shapes,) = sources(way_chart(connection, [whole(connection)]).layout, Patches)
    assert list(shapes["name"]) == []


def test_figures_stand_in_a_file_that_needs_nothing_else(rover: sqlite3.Connection) -> None:
    layout = signals_chart(rover, [whole(rover)], ["pose.0"]).layout
    html = file_html(layout, INLINE, "run 1")
    assert "cdn.bokeh.org" not in html
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", html.split("<body>")[1])


def test_a_recorded_name_is_no_formula_and_no_markup(record: Record) -> None:
    connection = record(lambda t: {"$$x$$": t, "<b>": t, "mode": "<script>alert(1)</script>"})
    layout = signals_chart(connection, [whole(connection)], ["*"]).layout
    assert "<script>alert(1)" not in file_html(layout, INLINE, "run")
    labels = [str(item.label) for item in models(layout, LegendItem)]
    titles = [each.title.text for each in models(layout, Plot)]
    assert any("x" in text for text in (*labels, *titles))
    assert not any("$$" in text for text in (*labels, *titles))


def test_a_single_row_is_seen(record: Record) -> None:
    connection = record(lambda t: {"n": 1.0}, 1)
    chart: Any = signals_chart(connection, [whole(connection)], ["n"])
    data = chart.sources["curve", "n", 1].data
    assert [value for value in data["mean"] if not math.isnan(value)] == [1.0]
    assert list(chart.sources["lone", "n", 1].data["mean"]) == [1.0]


def test_what_cannot_be_drawn_is_said(rover: sqlite3.Connection, record: Record) -> None:
    with pytest.raises(UnknownSignalError, match="nothing_such"):
        signals_chart(rover, [whole(rover)], ["nothing_such"])
    empty = record(lambda t: {"n": None}, 3)
    with pytest.raises(NothingRecordedError):
        signals_chart(empty, [whole(empty)], ["n"])


def test_the_same_figures_show_what_has_come_since(rover: sqlite3.Connection) -> None:
    chart: Any = signals_chart(rover, [whole(rover, end_s=30)], ["pose.0"], events=False)
    later, _ = compose_signals(rover, [whole(rover, end_s=50)], ["pose.0"], events=False)
    assert chart.refresh(later)
    assert chart.sources["curve", "pose.0", 1].data["time_s"][-1] > 49
    others, _ = compose_signals(rover, [whole(rover)], ["battery_v"], events=False)
    assert not chart.refresh(others)
