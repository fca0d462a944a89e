"""What goes into a picture: curves, panels, bands, paths."""

from __future__ import annotations

import contextlib
import math
import sqlite3
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.plotting.conftest import Record, whole
from tests.recordings.rover import WALL_START_S
from webots_mcp.errors import NothingRecordedError
from webots_mcp.plotting.canvas import MOST_PANELS, Sheet
from webots_mcp.plotting.colours import MERGED, MOST_VALUES, OTHER_VALUES, area_styles
from webots_mcp.plotting.curves import MOST_CURVES, Curve, by_scale, by_signal
from webots_mcp.plotting.intervals import Interval, Lane, at_resolution
from webots_mcp.plotting.robot_path import PathPoint, RobotPath, headings, thinned
from webots_mcp.plotting.signal_plot import SignalAxes, compose_signals, paint_signals
from webots_mcp.plotting.trajectory import compose_trajectory, paint_trajectory
from webots_mcp.store.chunk_making import chunk_whole_run


def signals_of_run(connection: sqlite3.Connection, *names: str, **limits: Any) -> SignalAxes:
    return compose_signals(connection, [whole(connection, **limits)], names)[0]


def only_curve(axes: SignalAxes) -> Curve:
    ((curve,),) = [panel.curves for panel in axes.panels]
    return curve


def test_one_odd_row_among_a_thousand_is_in_the_band(rover: sqlite3.Connection) -> None:
    curve = only_curve(signals_of_run(rover, "ir"))
    (spike,) = [point for point in curve.points if point[3] == 5.0]
    assert spike[0] == pytest.approx(70, abs=0.5)
    assert spike[1] < 2


def test_a_line_is_broken_where_rows_or_values_are_missing(rover: sqlite3.Connection) -> None:
    curve = only_curve(signals_of_run(rover, "sensors.front"))
    assert sum(math.isnan(time) for time, *_ in curve.points) == 2
    assert not [t for t, *_ in curve.points if 90.5 < t < 94.5 or 100.5 < t < 103.5]


def test_an_angle_that_goes_round_is_no_line_across_the_picture(
    rover: sqlite3.Connection,
) -> None:
    curve = only_curve(signals_of_run(rover, "heading", start_s=60, end_s=66))
    means = [mean for _, mean, *_ in curve.points]
    assert max(means) > math.pi > min(means)  # its turns are counted
    assert all(abs(after - before) < math.pi for before, after in pairwise(means))


def test_a_value_that_stands_alone_is_not_lost(record: Record) -> None:
    connection = record(lambda t: {"n": 1.0 if t < 2 or round(t, 1) == 7 else None})
    curve = only_curve(signals_of_run(connection, "n"))
    assert [time for time, *_ in curve.points if time > 3] == pytest.approx([7.0])


def test_modes_stand_behind_the_curves_and_not_where_nothing_was_recorded(
    rover: sqlite3.Connection,
) -> None:
    bands = signals_of_run(rover, "pose.0").bands
    assert bands is not None
    assert [(i.value, round(i.start_s), round(i.end_s)) for i in bands.intervals] == [
        ("cruise", 0, 52), ("back_up", 52, 60), ("avoid", 60, 90), ("cruise", 95, 120),
    ]  # fmt: skip


def test_more_modes_than_can_be_told_apart_share_a_name_and_a_note_lists_them(
    record: Record,
) -> None:
    connection = record(lambda t: {"mode": f"m{int(t)}", "x": t, "y": t}, 200)
    axes, notes = compose_signals(connection, [whole(connection)], ["x"])
    assert axes.bands is not None
    assert (len(axes.bands.values), axes.bands.values[-1]) == (16, "others")
    merged = "mode has 5 more values than colours, drawn as others: m15, m16, m17, m18, m19"
    assert merged in notes
    assert merged in compose_trajectory(connection, [whole(connection)])[1]


def test_each_of_many_modes_is_drawn_where_it_was(record: Record) -> None:
    connection = record(lambda t: {"mode": "go" if t % 1 < 0.5 else "turn", "x": t}, 4000)
    axes, notes = compose_signals(connection, [whole(connection)], ["x"])
    assert axes.bands is not None
    assert (len(axes.bands.intervals), axes.bands.intervals[0].start_s) == (800, 0)
    assert not [note for note in notes if "changes" in note]


def test_events_are_of_the_drawn_signals_and_of_the_robot(rover: sqlite3.Connection) -> None:
    axes = signals_of_run(rover, "ir")
    events = {lane.name: [interval.value for interval in lane.intervals] for lane in axes.events}
    assert events["jump"] == ["ir", "position"]
    assert events["command"] == ["set_speed"]
    assert events["log"] == ["warning", "error"]
    assert set(events.get("oscillation", ["ir"])) == {"ir"}  # the heading swings too, undrawn
    (stuck,) = next(lane.intervals for lane in axes.events if lane.name == "stuck")
    assert (stuck.start_s, stuck.end_s) == pytest.approx((40, 52), abs=0.3)


def test_of_an_event_that_reaches_out_of_the_range_the_part_in_it_is_drawn(
    rover: sqlite3.Connection,
) -> None:
    part = whole(rover, start_s=45, end_s=50)
    axes, _ = compose_signals(rover, [part], ["pose.0"])
    (stuck,) = next(lane.intervals for lane in axes.events if lane.name == "stuck")
    assert (stuck.start_s, stuck.end_s) == axes.x_range == (45, 50)


def test_the_same_data_looks_the_same_in_a_short_and_in_a_long_run(record: Record) -> None:
    connection = record(lambda t: {"wave": math.sin(2 * math.pi * t)}, 600, 3000)
    runs = [whole(connection, 1), whole(connection, 2)]
    (panel,) = compose_signals(connection, runs, ["wave"])[0].panels
    short, long = (curve.points for curve in panel.curves)
    assert len(long) >= 200
    assert short[:-1] == long[: len(short) - 1]


def test_a_wider_picture_shows_more(record: Record) -> None:
    connection = record(lambda t: {"wave": math.sin(t)}, 3000)
    points = [
        len(
            only_curve(
                compose_signals(connection, [whole(connection)], ["wave"], room=sheet.room)[0]
            ).points
        )
        for sheet in (Sheet(500), Sheet(1600))
    ]
    assert points[1] > 3 * points[0]


def test_a_unit_is_an_axis_and_so_is_a_scale(rover: sqlite3.Connection) -> None:
    axes = signals_of_run(rover, "pose", "battery_v", "heading")
    panels = [(panel.unit, panel.names) for panel in axes.panels]
    assert panels == [
        (None, ["pose.0", "pose.1"]), ("V", ["battery_v"]), ("rad", ["heading"]),
    ]  # fmt: skip


# Laws ---------------------------------------------------------------------------------------------

NUMBERS = st.floats(-1e6, 1e6)


@st.composite
def curves_of_runs(draw: st.DrawFn) -> list[Curve]:
    curves: list[Curve] = []
    for number in draw(st.lists(st.integers(0, 30), max_size=30)):
        unit, run_id = draw(st.sampled_from([None, "m", "rad"])), draw(st.integers(1, 2))
        low, high = sorted((draw(NUMBERS), draw(NUMBERS)))
        curves.append(Curve(f"s{number}", unit, run_id, (), low, high))
    return curves


@given(curves_of_runs())
def test_every_curve_is_drawn_once_or_named_as_left_out(curves: list[Curve]) -> None:
    panels, left_out = by_scale(curves, MOST_PANELS)
    drawn = [curve for panel in panels for curve in panel.curves]
    assert sorted([*(curve.name for curve in drawn), *left_out]) == sorted(c.name for c in curves)
    assert len(panels) <= MOST_PANELS
    for panel in panels:
        assert len(panel.curves) <= MOST_CURVES
        assert {curve.unit for curve in panel.curves} == {panel.unit}


@given(curves_of_runs())
def test_runs_share_a_panel_per_signal(curves: list[Curve]) -> None:
    panels, left_out = by_signal(curves, MOST_PANELS)
    assert [panel.names for panel in panels] == [[panel.names[0]] for panel in panels]
    assert {name for panel in panels for name in panel.names} | set(left_out) == {
        curve.name for curve in curves
    }


@given(st.lists(st.text().filter(lambda value: value != OTHER_VALUES), max_size=24))
def test_values_have_styles_of_their_own_as_long_as_there_are_any(values: list[str]) -> None:
    styles = area_styles(values)
    assert styles == area_styles(reversed(values))
    own = [style for style in styles.values() if style != MERGED]
    assert len(own) == len(set(own)) == min(len(styles), MOST_VALUES)


PLACES = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=60).map(
    lambda points: [PathPoint(float(index), x, y) for index, (x, y) in enumerate(points)]
)


@given(PLACES)
def test_a_thinned_path_keeps_its_ends_and_its_shape(places: list[PathPoint]) -> None:
    kept = thinned(places)
    assert (kept[0], kept[-1]) == (places[0], places[-1])
    size = max(max(p[i] for p in places) - min(p[i] for p in places) for i in (1, 2))
    for place in places:
        assert min(math.dist(place[1:3], near[1:3]) for near in kept) <= size / 2000


@given(PLACES, st.frozensets(st.integers(1, 59)))
def test_the_pieces_of_a_path_are_all_of_it(
    places: list[PathPoint], breaks: frozenset[int]
) -> None:
    path = RobotPath(places, None, frozenset(index for index in breaks if index < len(places)))
    assert [place for piece in path.pieces() for place in piece] == places


# Trajectories -------------------------------------------------------------------------------------


def test_a_path_is_broken_at_a_gap_and_at_a_leap(rover: sqlite3.Connection) -> None:
    axes, _ = compose_trajectory(rover, [whole(rover)])
    path = axes.tracks[0].path
    assert [round(path.places[index].time_s) for index in sorted(path.breaks)] == [95, 110]


def test_the_path_of_a_run_is_that_of_its_own_position(record: Record) -> None:
    published = iter([{"pose": [1, 2]}] * 100)
    connection = record(lambda t: next(published, {"gps": {"x": t, "y": 0}}), 100, 100)
    assert all(chunk_whole_run(connection, run_id) for run_id in (1, 2))
    axes, _ = compose_trajectory(connection, [whole(connection, 2)])
    assert axes.tracks[0].path.places[-1][:3] == (9.9, 9.9, 0)


def test_trouble_is_marked_where_it_was(rover: sqlite3.Connection) -> None:
    axes, _ = compose_trajectory(rover, [whole(rover)])
    (track,) = axes.tracks
    places = {
        mark.name: [track.path.at(i.start_s)[1:3] for i in mark.intervals] for mark in track.marks
    }
    assert places == {
        "stuck over 3 s": [pytest.approx((8, 0), abs=0.05)],
        "sensors.bumper": [pytest.approx((8, 0))],
    }
    without, _ = compose_trajectory(rover, [whole(rover)], events=False)
    assert not without.tracks[0].marks


def test_arrows_point_the_way_that_was_taken() -> None:
    square = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]
    path = RobotPath([PathPoint(i, *place) for i, place in enumerate(square)], None, frozenset())
    found = headings(path, 4)
    assert [heading.degrees for heading in found] == pytest.approx([0, 90, 180, -90])
    assert headings(RobotPath([PathPoint(0, 1, 1)], None, frozenset()), 4) == []


def moded(time_s: float) -> dict[str, object]:
    return {"mode": "rest" if time_s < 60 else "walk", "x": time_s, "y": -time_s}


@pytest.mark.parametrize("deadline_s", [0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 30.0])
def test_what_was_not_read_in_time_is_hatched_and_is_no_end(
    record: Record, deadline_s: float
) -> None:
    """Whenever the time is over; only that of the last one is sure not to be."""
    connection = record(moded, 2000)
    asked: dict[str, Any] = {"deadline_s": deadline_s, "events": False}
    with contextlib.suppress(NothingRecordedError):
        axes, notes = compose_signals(connection, [whole(connection)], ["x"], **asked)
        from_s = axes.unread[0].start_s if axes.unread else 199.9
        assert [each.end_s for each in axes.unread] == [199.9] * bool(axes.unread)
        told = [(each.value, each.start_s) for each in axes.bands.intervals] if axes.bands else []
        assert told == [("rest", 0.0), ("walk", 60.0)][: len(told)]
        said = f"not all of run 1 was read from {from_s:g} s on: it took too long"
        assert (said in notes) == bool(axes.unread)
        assert not any("without a value" in note for note in notes)
        assert not axes.unread or deadline_s < 30
    with contextlib.suppress(NothingRecordedError):
        way, notes = compose_trajectory(connection, [whole(connection)], **asked)
        path = way.tracks[0].path
        last_s = path.places[-1].time_s
        assert path.is_whole == (last_s == pytest.approx(199.9))
        assert (f"The path of run 1 was not read after {last_s:g} s" in notes) != path.is_whole


@pytest.mark.parametrize(("events", "lines"), [(1, 1), (30, 30), (31, 0)])
def test_events_are_marked_through_the_panels_all_or_none(
    rover: sqlite3.Connection, events: int, lines: int
) -> None:
    axes, _ = compose_signals(rover, [whole(rover)], ["pose.0"])
    lane = Lane("jump", [Interval("", float(at), float(at)) for at in range(events)], [])
    canvas, _ = paint_signals(replace(axes, events=[lane]), 900, 500)
    assert canvas.svg().count('stroke-dasharray="1 3"') == lines


@pytest.mark.parametrize("room_m", [0.5, 6.0])
@pytest.mark.parametrize("size_px", [(700, 400), (330, 330), (300, 800)])
def test_a_robot_that_is_drawn_anywhere_on_its_path_is_inside_the_map(
    rover: sqlite3.Connection, room_m: float, size_px: tuple[int, int]
) -> None:
    axes, _ = compose_trajectory(rover, [whole(rover)])
    _, box = paint_trajectory(replace(axes, room_m=room_m), *size_px)
    for place in axes.places:
        assert box.x[0] <= place.x - room_m <= place.x + room_m <= box.x[1]
        assert box.y[0] <= place.y - room_m <= place.y + room_m <= box.y[1]


@pytest.mark.parametrize("compose", [compose_signals, compose_trajectory])
def test_where_nothing_was_read_in_time_nobody_says_that_nothing_was_recorded(
    record: Record, compose: Any
) -> None:
    connection = record(moded, 2000)
    names = [["x"]] if compose is compose_signals else []
    with pytest.raises(NothingRecordedError, match="read in time"):
        compose(connection, [whole(connection)], *names, deadline_s=0.0)


@pytest.mark.parametrize("compose", [compose_signals, compose_trajectory])
def test_where_retention_has_deleted_the_values_nobody_says_that_none_were_recorded(
    record: Record, compose: Any
) -> None:
    connection = record(moded, 200)
    assert chunk_whole_run(connection, 1)
    for table in ("state", "chunk", "row_group"):
        connection.execute(f"DELETE FROM {table}")
    connection.execute("UPDATE run SET row_count = 200, purged_rows = 200, last_sim_time_s = 19.9")
    names = [["x"]] if compose is compose_signals else []
    with pytest.raises(NothingRecordedError, match="deleted by retention"):
        compose(connection, [whole(connection)], *names)


def test_what_of_a_picture_could_not_be_read_is_said(record: Record) -> None:
    connection = record(lambda time_s: {"n": time_s, "m": time_s}, 200)
    assert chunk_whole_run(connection, 1)
    connection.execute("DELETE FROM state")
    of_n = "signal_id = (SELECT id FROM signal WHERE name = 'n')"
    connection.execute(f"UPDATE chunk SET numbers = x'00' WHERE {of_n}")
    _, notes = compose_signals(connection, [whole(connection)], ["n", "m"], events=False)
    (note,) = notes
    assert note.startswith("run 1: not read from 0.000 to 19.900 s: the chunk of n is damaged")


def test_what_is_too_far_to_tell_a_distance_to_is_no_place(record: Record) -> None:
    far = record(lambda time_s: {"x": 1.7e308 if 4 <= time_s < 5 else time_s, "y": 0.0})
    axes, _ = compose_trajectory(far, [whole(far)])
    (track,) = axes.tracks
    assert len(track.path.places) == 90
    assert len(headings(track.path, 5)) == 5


def test_events_beyond_those_that_are_drawn_are_counted(record: Record) -> None:
    connection = record(lambda t: {"n": t})
    connection.executemany(
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
        "VALUES (1, ?, ?, 'warning', 'controller', 'hot')",
        [(i * 0.01, WALL_START_S + i * 0.005) for i in range(510)],
    )
    _, notes = compose_signals(connection, [whole(connection)], ["n"])
    assert "Not drawn: 10 events of kind log up to 0.090 s" in notes


def test_of_many_short_intervals_the_longest_in_a_pixel_stands_for_it() -> None:
    flips = [Interval("on" if n % 2 else "off", n * 0.1, n * 0.1 + 0.1) for n in range(10_000)]
    rare = Interval("rare", 500.0, 500.01)
    long = Interval("long", 1000.0, 1500.0)
    shown = at_resolution([*flips, rare, long], 2.0)
    assert long in shown
    assert len(shown) <= 501
    assert {each.value for each in shown} <= {"on", "off", "long"}
    drawn = sorted((each.start_s, each.end_s) for each in shown)
    assert drawn[0][0] == 0.0
    assert all(before[1] == after[0] for before, after in pairwise(drawn))


def test_intervals_that_a_picture_can_show_stay_as_they_are() -> None:
    intervals = [Interval("a", 0.0, 5.0), Interval("b", 5.0, 9.0)]
    assert at_resolution(intervals, 1.0) == intervals
