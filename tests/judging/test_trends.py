"""A trend says what the signal did, in numbers that can be computed another way."""

from __future__ import annotations

import json
import math
import random
import re
import sqlite3
import statistics
from collections.abc import Callable
from typing import Any

import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.trends import RunTrends, Trend, trends
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

Course = Callable[[float], float | None]  # from the time; None leaves the key out


def ask(connection: sqlite3.Connection, *names: str, **bounds: Any) -> RunTrends:
    found = find_range(connection, Scope(run_id=1, **bounds))
    return trends(connection, found, names or ("*",)).runs[0]


def one(connection: sqlite3.Connection, name: str, **bounds: Any) -> Trend:
    return ask(connection, name, **bounds).numbers[0]


def test_a_falling_battery_falls(rover: sqlite3.Connection, looked_at: str) -> None:
    battery = one(rover, "battery_v")
    assert (battery.shape, battery.monotonic) == ("falling", "falling")
    assert battery.slope_per_s == pytest.approx(-0.001, rel=0.05)
    assert battery.r2 == pytest.approx(1.0, abs=0.01)
    assert battery.says == "falls from 12.6 to 12.48 V (-0.001 V/s)"


def test_mean_and_deviation_are_exact_from_values_and_from_chunks(
    rover: sqlite3.Connection, looked_at: str
) -> None:
    battery = one(rover, "battery_v", start_s=2.05, end_s=80.0)
    values = [12.6 - 0.0001 * step for step in range(21, 800)]
    assert battery.mean == pytest.approx(statistics.fmean(values))
    assert battery.deviation == pytest.approx(statistics.stdev(values))
    assert battery.summary.present == len(values)


def record(
    connection: sqlite3.Connection, *, rows: int, interval_s: float, **courses: Course
) -> None:
    """One run: each signal by name with its course."""
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for index in range(rows):
        time_s = round(index * interval_s, 6)
        state = {name: course(time_s) for name, course in courses.items()}
        present = {name: value for name, value in state.items() if value is not None}
        recorder.publish(time_s, present)
    connection.execute("COMMIT")
    make_chunks(connection, 100_000)
    make_chunks(connection, 100_000)


def test_a_counter_of_large_numbers_counts_and_what_adding_leaves_is_constant(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    courses: dict[str, Course] = {
        "counter": lambda time_s: 3_000_000_000_000_001 + int(time_s),
        "sum": lambda time_s: 6.0 + time_s % 1 * 5e-15,
    }
    record(empty, rows=300, interval_s=0.1, **courses)
    told = {each.name: each for each in ask(empty).numbers}
    assert told["counter"].shape == "rising"
    assert told["counter"].says.startswith(
        "rises from 3000000000000001 to 3000000000000030 (0.97/s)"
    )
    assert told["sum"].shape == "constant"


@pytest.mark.parametrize("looked_at", ["chunks"], indirect=True)
def test_a_swing_faster_than_the_chunks_gets_no_period_of_an_alias(
    empty: sqlite3.Connection, looked_at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(empty, rows=4000, interval_s=0.1, sine=math.sin)
    note, _ = trends(empty, find_range(empty, Scope(run_id=1))).notes
    assert "oscillations with a period under 80 s were not searched for" in note
    trend = one(empty, "sine")
    assert (trend.shape, trend.swings, trend.flat_since_s) == ("varying", (), None)
    assert "varies within 10 s: ask for a shorter range" in trend.says
    monkeypatch.undo()
    assert "varies within" not in one(empty, "sine", start_s=100.0, end_s=109.0).says


def test_a_swing_slower_than_the_chunks_is_told_from_values_and_from_chunks(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(empty, rows=8000, interval_s=0.1, sine=lambda t: math.sin(2 * math.pi * t / 80))
    sine = one(empty, "sine")
    (swing,) = sine.swings
    assert sine.shape == "oscillating"
    assert swing.period_s == pytest.approx(80, rel=0.03)
    assert swing.amplitude == pytest.approx(1, rel=0.02)
    assert ("seen in means of 10 s" in sine.says) == (looked_at == "chunks")


def approached(time_s: float) -> float:
    return 2.1 - 0.018 * time_s - max(0.0, 1.2384 * (1 - abs(time_s - 41.2) / 2))


DICE = random.Random(5)
# A course, its rows of 0.1 s, its shape, and what is said of it, as a regular expression.
COURSES: dict[str, tuple[Course, int, str, str]] = {
    "swung and rests": (
        lambda t: 0.3 * math.sin(math.pi * t) if 70 <= t < 82 else 0.0, 1000, "resting",
        "oscillated from 70.1 to 82 s: amplitude 0.3, period 2 s; reaches 0 at 82 s, then flat",
    ),
    "falls, and lower in between": (
        approached, 1001, "falling", r"falls from 2.1 to 0.3 \(-0.0\S+; min 0.12 at 41.2 s",
    ),
    "rises": (lambda t: t, 1001, "rising", r"rises from 0 to 100 \(1/s\)"),
    "what adding leaves": (lambda t: 6.0 + 5e-15 * (t > 4), 100, "constant", "constant at 6"),
    "0 but for adding": (
        lambda t: 0.6 if 4 < t < 6 else -4.857e-17, 100, "resting", r"(?!.*e-17).*",
    ),
    "fell, rested and rose twice": (
        lambda t: 1.0 if t % 60 < 30 else 0.05, 1300, "varying", r"(?!.*oscillat).*",
    ),
    "a swing in noise": (
        lambda t: math.sin(2 * math.pi * t / 5) + DICE.gauss(0, 0.3), 600, "oscillating",
        r"oscillates about \S+: amplitude (0.9|1.0|1)\d*, period (4.9|5)\S* s",
    ),
    "ever faster": (lambda t: 10 ** (t / 10), 600, "rising", r"(?!.*/s\)).*"),
    "a clock": (
        lambda t: 1.7e9 + t, 601, "rising", r"rises from 1700000000 to 1700000060 \(1/s\)",
    ),
    "a staircase": (lambda t: 90.0 * (t // 8), 600, "rising", r"(?!.*oscillat)rises.*"),
    "a ripple": (
        lambda t: 1000 * math.sin(t / 20) + 20 * math.sin(t * 6), 600, "varying",
        "between .*also oscillated from.*amplitude 20.*",
    ),
    "the rate of both ends": (
        lambda t: 16800 - 20 * t - (900 if t > 57 else 0), 581, "falling",
        r"falls from 1.68e\+04 to 1.474e\+04 \(-35.5/s\).*",
    ),
    "a constant that lost its value": (
        lambda t: 40.0 if t < 30 else None, 600, "constant",
        "constant at 40; no value in 300 of 600 rows, the last value at 29.9 s",
    ),
    "a step": (lambda t: 1 if t < 80 else 2, 1000, "rising", "steps from 1 to 2 at 80 s"),
    "a step among noise": (
        lambda t: (0.2 if t < 31.2 else 5.0) + DICE.gauss(0.0, 0.01), 600, "varying",
        r"steps from (0.1|0.2)\d* to (4.9|5.0|5)\d* at 31.2 s.*",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("course", "rows", "shape", "says"), COURSES.values(), ids=COURSES)
def test_a_course_is_told_as_a_person_would_describe_it(
    empty: sqlite3.Connection, course: Course, rows: int, shape: str, says: str
) -> None:
    record(empty, rows=rows, interval_s=0.1, it=course)
    trend = one(empty, "it")
    assert re.fullmatch(says, trend.says), trend.says
    assert trend.shape == shape


@pytest.mark.parametrize("rate_rad_s", [0.2, -0.21])
def test_an_angle_turns_by_as_much_as_it_turned(
    empty: sqlite3.Connection, looked_at: str, rate_rad_s: float
) -> None:
    record(
        empty, rows=2001, interval_s=0.05,
        yaw=lambda t: math.remainder(0.6 + rate_rad_s * t, 2 * math.pi),
    )  # fmt: skip
    yaw = one(empty, "yaw")
    assert yaw.says == f"turns by {rate_rad_s * 100:.3g} rad ({rate_rad_s:.3g} rad/s)"


def test_rows_without_the_signal_are_rows_without_a_value(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(empty, rows=2000, interval_s=0.1, x=float, lidar=lambda t: 1.0 + t if t < 100 else None)
    lidar = one(empty, "lidar")
    assert 2 * lidar.missing == lidar.summary.rows
    assert f"no {'usable ' * (looked_at == 'chunks')}value in 1000 of 2000 rows" in lidar.says


def test_what_changed_most_comes_first(rover: sqlite3.Connection, looked_at: str) -> None:
    run = ask(rover)
    names = [trend.name for trend in run.numbers]
    assert names.index("pose.0") < names.index("battery_v") < names.index("target")
    assert run.total == len(names)
    target = run.numbers[names.index("target")]
    assert (target.shape, target.change, target.says) == ("constant", 0.0, "constant at 3")
    assert run.resolution_s == (None if looked_at == "values" else 10.0)


def test_a_clock_is_never_what_changed_most(empty: sqlite3.Connection, looked_at: str) -> None:
    record(
        empty, rows=2000, interval_s=0.1, time_s=lambda t: t, robotTime=lambda t: t + 1e6,
        loop_steps=lambda t: round(t * 10), lap_time=lambda t: t % 7,
        pose_x=lambda t: 0.5 * t, target=lambda _: 3.0,
    )  # fmt: skip
    names = [trend.name for trend in ask(empty).numbers]
    assert set(names[:2]) == {"pose_x", "lap_time"}
    assert names[2] == "target"
    assert set(names[3:]) == {"time_s", "robotTime", "loop_steps"}


@pytest.mark.parametrize("step", [0.15, 5.0])
def test_what_stepped_from_one_rest_to_another_is_flat_since_the_step(
    empty: sqlite3.Connection, looked_at: str, step: float
) -> None:
    recorder = start_run(empty)
    for row in range(1200):
        time_s = row / 10
        recorder.publish(time_s, {"x": min(time_s, 40.0) + step * (time_s >= 70.3)})
    make_chunks(empty, 100_000)
    (x,) = trends(empty, find_range(empty, Scope())).runs[0].numbers
    assert x.flat_since_s == 70.3


def test_whole_numbers_that_name_a_mode_have_times_and_no_slope(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    recorder = start_run(empty)
    for step in range(1200):
        mode = min(step // 250, 3)
        named = {} if 300 <= step < 320 else {"drive_mode": 1 if step == 700 else mode}
        recorder.publish(round(0.1 * step, 6), {"count": mode, **named})
    make_chunks(empty, 100_000)
    told = ask(empty)
    assert [each.name for each in told.numbers] == ["count"]
    (mode,) = told.states
    assert (mode.changes, mode.last, round(mode.since_s or 0.0, 3)) == (7, "3", 75.0)
    assert mode.time_by_value_s == pytest.approx(
        {"3": 44.9, "0": 25.0, "2": 24.9, "1": 23.1, "null": 2.0}
    )


def test_numbers_that_are_too_large_are_not_told_as_missing(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(
        empty, rows=700, interval_s=0.1,
        range_m=lambda time_s: 1e200 if round(10 * time_s) % 7 == 0 else None if time_s < 5 else 2,
    )  # fmt: skip
    says = one(empty, "range_m").says
    if looked_at == "values":
        assert "beyond 1e+100 in 100 of 700 rows; no value in 42 of 700 rows" in says
    else:
        assert "no usable value in" in says


@pytest.mark.parametrize("centre", [0.0, 2.6])
def test_the_extremes_of_an_angle_are_its_own_and_not_those_of_means(
    empty: sqlite3.Connection, looked_at: str, centre: float
) -> None:
    def yaw(time_s: float) -> float:
        swings = 100 <= time_s < 120
        return centre + 0.1 * math.sin(time_s / 60) + swings * 0.3 * math.sin(4 * time_s)

    record(empty, rows=6000, interval_s=0.1, yaw=yaw)
    summary, values = one(empty, "yaw").summary, [yaw(step * 0.1) for step in range(6000)]
    assert (summary.min, summary.max) == pytest.approx((min(values), max(values)))
    assert yaw(summary.max_sim_time_s or 0.0) == pytest.approx(max(values))


def test_a_signal_whose_chunk_is_damaged_is_not_said_to_have_no_value(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(300):
        recorder.publish(step * 0.1, {"x": step})
    assert chunk_whole_run(empty, 1)
    empty.execute("DELETE FROM state")
    empty.execute("UPDATE chunk SET numbers = x'00' WHERE signal_id > 0")
    told = ask(empty)
    assert (told.numbers, told.without_value) == ((), ())
    assert "the chunk of x is damaged" in told.unread[0]


def test_a_damaged_chunk_costs_its_own_signal_alone(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 100)
    recorder = start_run(empty)
    for step in range(300):
        mode = "a" if step < 50 else "b"
        recorder.publish(step * 0.1, {"x": step, "mode": mode, "left": mode, "y": step})
    assert chunk_whole_run(empty, 1)
    empty.execute("DELETE FROM state")
    empty.execute(
        "UPDATE chunk SET numbers = x'00', codes = x'00' WHERE group_id = 1 AND signal_id IN "
        "(SELECT id FROM signal WHERE name IN ('mode', 'x'))"
    )
    told, later = ask(empty), ask(empty, start_s=10.0, end_s=20.0)
    assert {state.name: state.changes for state in told.states} == {"mode": 0, "left": 1}
    assert {state.name: state.since_s for state in later.states} == {"mode": None, "left": 5.0}
    assert [trend.summary.rows - trend.summary.present for trend in told.numbers] == [0, 0]


@pytest.mark.parametrize("name", ["x", "yaw"])
def test_nothing_rests_before_a_number_elsewhere_in_a_kept_stretch(
    empty: sqlite3.Connection, name: str
) -> None:
    recorder = start_run(empty)
    for step in range(240):
        recorder.publish(step * 0.1, {name: 3.14159})
    recorder.insert(
        "kept_stretch", run_id=1, uuid="k", wall_time_s=0.0, reason="hit",
        start_sim_time_s=10.0, end_sim_time_s=11.0,
    )  # fmt: skip
    last = -3.14159 if name == "yaw" else 1.0  # which is the same angle, and another number
    for time_s, value in ((10.05, 1.0), (10.15, 1.0), (10.25, last)):
        recorder.insert("kept_state", **recorder.at(time_s), data=json.dumps({name: value}))
    trend = one(empty, name)
    assert trend.flat_since_s == pytest.approx(10.2 if name == "yaw" else 10.3)
    assert trend.says.startswith("between 1 (at 10.05 s) and 3.142")


def test_what_swings_beside_one_spike_is_not_called_flat(empty: sqlite3.Connection) -> None:
    record(
        empty, rows=1200, interval_s=0.1,
        ir=lambda time_s: 5.0 if time_s == 70.0 else 0.01 * math.sin(3 * time_s),
        rest=lambda time_s: 5.0 if time_s == 30.0 else 0.01 * math.sin(3 * min(time_s, 62.8)),
    )  # fmt: skip
    told = {each.name: each for each in ask(empty).numbers}
    assert "oscillated" in told["ir"].says
    assert told["ir"].flat_since_s is None
    assert "flat" not in told["ir"].says
    assert told["rest"].flat_since_s == pytest.approx(62.8, abs=0.5)


def test_an_amplitude_is_never_more_than_half_of_the_range(empty: sqlite3.Connection) -> None:
    record(
        empty, rows=600, interval_s=0.1, heading_rad=lambda s: math.pi + 0.5 * math.sin(s * 3.14)
    )
    told = one(empty, "heading_rad")
    said = float(re.findall(r"amplitude ([\d.]+)", told.says)[0])
    half = ((told.summary.max or 0.0) - (told.summary.min or 0.0)) / 2
    assert said <= half + 5e-4  # as it is rounded
