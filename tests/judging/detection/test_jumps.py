"""A jump is what a value does, not what a recording, or the way an angle is written, does."""

from __future__ import annotations

import math
import random
import sqlite3
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range


def record(
    connection: sqlite3.Connection, state: Callable[[float], dict[str, Any]], *, gap: bool = False
) -> None:
    """200 s, with rows missing from 95 to 105 s if there is a gap."""
    recorder = start_run(connection)
    for step in range(2000):
        if not (gap and 950 <= step < 1050):
            recorder.publish(step * 0.1, state(step * 0.1))
    make_chunks(connection, 100_000)


def jumps(connection: sqlite3.Connection, **options: Any) -> list[Event]:
    asked = EventOptions(kinds=("jump",), **options)
    return list(find_events(connection, find_range(connection, Scope()), asked).events)


def step_at_100_s(time_s: float) -> dict[str, Any]:
    return {"temp_c": 20 + 0.01 * time_s + (50 if time_s >= 100 else 0)}


def quick_swing_with_a_dropout() -> Callable[[float], dict[str, Any]]:
    dice = random.Random(3)

    def steering(time_s: float) -> dict[str, Any]:
        swing = 0.25 * math.sin(4 * (time_s - 100)) if 0 <= time_s - 100 < 2.5 * math.pi else 0.0
        return {"steering": 9.0 if time_s == 105.0 else 0.7 + swing + dice.gauss(0, 0.005)}

    return steering


# What is published, whether rows are missing from 95 to 105 s, and which jumps are told.
COURSES: dict[str, tuple[Callable[[float], dict[str, Any]], bool, list[tuple[str, float]]]] = {
    "goes on smoothly during a gap": (
        lambda t: {"pose": [0.3 * t, 0.0], "battery_v": 12 - 0.01 * t + 1e-4 * (t % 7)}, True, [],
    ),
    "at the border of two chunks": (step_at_100_s, False, [("temp_c", 100.0)]),
    "elsewhere after a gap": (step_at_100_s, True, [("temp_c", 105.0)]),
    "back only after a gap": (  # nobody knows what it did in between
        lambda t: {"steer": 0.2 * (94.9 <= t < 95) + 0.1 * (40 <= t < 60)}, True, [],
    ),
    **{
        f"over the end of a scale of {turn:.3g}": (
            lambda t, name=name, turn=turn: {name: math.remainder(0.01 * turn * t, turn), "x": t},
            False, [],
        )
        for name, turn in (("course", math.tau), ("course_deg", 360.0))
    },
    "a swing with two rows at each turn, at the same height": (
        lambda t: {"steer": (0.1, 0.2, 0.2, 0.1)[round(10 * t) % 4] if 40 <= t < 44 else 0.0},
        False, [],
    ),
    "a dropout in a quick swing": (quick_swing_with_a_dropout(), False, [("steering", 105.0)]),
}  # fmt: skip


@pytest.mark.parametrize(("state", "gap", "expected"), COURSES.values(), ids=COURSES)
def test_a_value_jumps_where_it_does_and_nowhere_else(
    empty: sqlite3.Connection, looked_at: str, state: Callable[[float], dict[str, Any]],
    expected: list[tuple[str, float]], *, gap: bool,
) -> None:  # fmt: skip
    record(empty, state, gap=gap)
    assert [(event.name, event.start_s) for event in jumps(empty)] == expected


def test_a_signal_that_the_asker_names_is_searched_for_swings(empty: sqlite3.Connection) -> None:
    record(empty, lambda t: {"sensors": {"front": math.sin(math.pi * t)}})
    whole = find_range(empty, Scope())
    unasked = find_events(empty, whole, EventOptions(kinds=("oscillation",)))
    asked = EventOptions(kinds=("oscillation",), signals=("sensors.front",))
    assert unasked.events == ()
    assert "1 of 1 numeric signal was not searched" in unasked.verdicts.not_searched["oscillation"]
    (swing,) = find_events(empty, whole, asked).events
    assert swing.details["period_s"] == pytest.approx(2.0, rel=0.02)


def test_a_jump_exactly_at_the_begin_of_a_range_is_in_it(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    record(empty, lambda t: {"temp_c": 20 + 0.01 * t + (50 if t >= 100 else 0)})
    for start_s, end_s, count in ((100.0, 150.0, 1), (50.0, 100.0, 0), (99.9, 100.0, 0)):
        asked = find_range(empty, Scope(start_s=start_s, end_s=end_s))
        assert len(find_events(empty, asked, EventOptions(kinds=("jump",))).events) == count


SWINGS: dict[str, Callable[[float], float]] = {
    "sine": lambda angle: math.sin(angle),
    "from side to side": lambda angle: math.copysign(1.0, math.sin(angle + 0.1)),
}


@pytest.mark.parametrize("swing", SWINGS.values(), ids=SWINGS)
@pytest.mark.parametrize("hz", [0.8, 1.2])
def test_the_steps_of_a_quick_swing_are_no_jumps_and_a_dropout_beside_it_is_one(
    empty: sqlite3.Connection, swing: Callable[[float], float], hz: float
) -> None:
    noise = np.random.default_rng(1).normal(0, 0.001, 2000).tolist()

    def state(time_s: float) -> dict[str, Any]:
        swings = 50 <= time_s < 70 or 120 <= time_s < 130
        value = 0.3 * swing(math.tau * hz * time_s) if swings else 0.0
        dropout = -2.0 if round(time_s, 1) == 100.0 else 0.0
        return {"steering": value + dropout + noise[round(10 * time_s)]}

    record(empty, state)
    found = find_events(
        empty, find_range(empty, Scope()), EventOptions(kinds=("jump", "oscillation"))
    )
    ends = [(each.kind, round(each.start_s), round(each.end_s)) for each in found.events]
    assert ends == [("oscillation", 50, 70), ("jump", 100, 100), ("oscillation", 120, 130)]


def test_which_beam_is_the_shortest_neither_jumps_nor_freezes(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    nearest = random.Random(1)

    def scans(time_s: float) -> dict[str, Any]:
        beam = nearest.randint(10, 12)
        if 50 <= time_s < 100:  # along a wall on the left
            beam = 2
        elif time_s == pytest.approx(150):  # something passes on the right
            beam = 30
        return {"lidar": [1.0 + 0.1 * nearest.random() - (item == beam) for item in range(32)]}

    record(empty, scans)
    asked = EventOptions(kinds=("jump", "flat"))
    assert find_events(empty, find_range(empty, Scope()), asked).events == ()
    asked = EventOptions(kinds=("jump", "flat"), signals=("lidar.argmin",))
    found = find_events(empty, find_range(empty, Scope()), asked).verdicts.not_searched
    assert all("normally jumps and stays constant" in found[kind] for kind in ("jump", "flat"))


def test_what_is_rarer_is_the_disturbance_wherever_it_begins(
    empty: sqlite3.Connection, looked_at: str
) -> None:
    low_s = [(10.0, 14.0), (25.0, 27.5), (40.0, 46.0)]

    def front(time_s: float) -> dict[str, Any]:
        low = any(start_s <= time_s < end_s for start_s, end_s in low_s)
        far_mm = 800 if time_s < 12 else 600
        return {"front_mm": (40 if low else far_mm) + 2 * math.sin(3 * time_s)}

    record(empty, front)
    found = [(each.start_s, each.end_s) for each in jumps(empty) if each.details["after"] < 100]
    assert found == [pytest.approx(each, abs=0.11) for each in low_s]
    assert len(jumps(empty)) == 3


@pytest.mark.parametrize("rests", [True, False], ids=["rests", "noisy"])
def test_an_excursion_is_told_with_where_it_came_from_and_to_and_back(
    empty: sqlite3.Connection, looked_at: str, rests: bool
) -> None:
    away = {1000: 5.5, 1001: 10.8}
    noise = np.random.default_rng(1).normal(5.0, 0.0 if rests else 0.2, 2000).tolist()
    record(empty, lambda t: {"volt": away.get(round(10 * t), noise[round(10 * t)])})
    (jump,) = jumps(empty)
    told = [jump.details[each] for each in ("before", "after", "back")]
    assert told == pytest.approx([5.0, 10.8, 5.0], abs=0.8)


# How fast it goes, how often rows come and how many, how often a place, and when it is lifted.
LIFTED: dict[str, tuple[float, float, int, int, list[float]]] = {
    "three times in 90 s, a row each 0.5 s": (0.2, 0.5, 180, 1, [22.0, 40.5, 78.5]),
    "never, fast in a short recording": (1.0, 0.5, 80, 1, []),
    "never, with a place in each fifth row": (2.0, 0.1, 600, 5, []),
}


@pytest.mark.parametrize(
    ("speed", "interval_s", "rows", "every", "lifted"), LIFTED.values(), ids=LIFTED
)
def test_leaps_do_not_tell_what_is_usual_and_driving_does(
    empty: sqlite3.Connection, speed: float, interval_s: float, rows: int, every: int,
    lifted: list[float],
) -> None:  # fmt: skip
    recorder = start_run(empty)
    for row in range(rows):
        time_s = row * interval_s
        along = speed * interval_s * (row - row % every)
        aside = 0.8 * sum(time_s >= each for each in lifted)
        recorder.publish(time_s, {"pose": [along, aside, 0.0]})
    assert [event.start_s for event in jumps(empty)] == lifted
