"""What sensors do at times: fall silent, freeze, drop out, wake late, change their shape."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Events, find_events
from webots_mcp.judging.trends import trends
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.catalogue import known_signals, list_signals, resolve_signals
from webots_mcp.store.reading.ranges import Scope, find_range

State = Callable[[float], dict[str, Any]]


def record(connection: sqlite3.Connection, state: State, *, until_s: float = 120.0) -> None:
    """Rows every 0.1 s, in chunks."""
    recorder = start_run(connection)
    connection.execute("BEGIN")
    for step in range(round(until_s * 10)):
        recorder.publish(round(step * 0.1, 6), state(round(step * 0.1, 6)))
    connection.execute("COMMIT")
    make_chunks(connection, 100_000)


def ask(connection: sqlite3.Connection, kind: str, **bounds: Any) -> Events:
    return find_events(
        connection, find_range(connection, Scope(**bounds)), EventOptions(kinds=(kind,))
    )


def told(events: Events) -> list[tuple[str | None, float, float]]:
    return [(e.name, round(e.start_s, 1), round(e.end_s, 1)) for e in events.events]


def range_m(time_s: float) -> float:
    return 2.0 + 0.1 * math.sin(3 * time_s)


def waking(time_s: float) -> dict[str, Any]:
    return {"lidar": None if time_s < 30 else [range_m(time_s)] * 20, "x": time_s}


@lru_cache
def noisy(seed: int) -> Callable[[float], float]:
    """A force with noise, the same at each time again."""
    noise = np.random.default_rng(seed).normal(3.3, 0.05, 2000).tolist()
    return lambda time_s: noise[round(10 * time_s)]


def held(time_s: float, measured: float, value: float) -> float:
    """What is measured, but for ten seconds in which it is that value."""
    return measured if not 50 < time_s < 60 else value


# What a robot publishes, what is looked for, and when it is found (name, begin, end).
SCENARIOS: dict[str, tuple[State, str, list[tuple[str, float, float]]]] = {
    "null before its first value": (
        lambda t: {"front": None if t < 30 else range_m(t), "x": t}, "missing", [],
    ),
    "a scalar null before a lidar's first scan": (waking, "missing", []),
    "a lidar that dies is silent once": (
        lambda t: waking(t) if t < 60 else {"lidar": None, "x": t},
        "missing", [("lidar.*", 60.0, 119.9)],
    ),
    "an array that crosses 16 items": (
        lambda t: {"hit_count": [range_m(t)] * (14 if t % 40 < 20 else 20)}, "missing", [],
    ),
    "a list that is shorter at times, and one with a dead item": (
        lambda t: {
            "seen": [range_m(t)] * (3 if t % 40 < 20 else 14),
            "near": [1.0, None if t > 60 else range_m(t)],
        },
        "missing", [("near.1", 60.1, 119.9)],
    ),
    "dead for most of the run": (
        lambda t: {"front": range_m(t) if t < 20 else None, "x": t},
        "missing", [("front", 20.0, 119.9)],
    ),
    "frozen for most of the run": (
        lambda t: {"front": range_m(min(t, 30.0)), "target": 3, "goal": float(t > 60)},
        "flat", [("front", 30.0, 119.9)],
    ),
    "from one value to the next": (lambda t: {"index": t // 25, "x": t}, "flat", []),
    "noisy, and frozen for 20 s at the end": (
        lambda t: {"gripForceN": noisy(1)(t) if t < 100.2 else 3.3, "x": t},
        "flat", [("gripForceN", 100.2, 119.9)],
    ),
    "frozen for 12 s while another is at its limit": (
        lambda t: {
            "force": 3.3 if 100 <= t < 112 else noisy(1)(t),
            "side": 4.0 if t % 60 > 35 else noisy(2)(t),
        },
        "flat", [("side", 35.1, 59.9), ("side", 95.1, 119.9), ("force", 100.0, 111.9)],
    ),
    "left behind by its target": (
        lambda t: {
            "joints": [math.sin((60 if 60 < t < 66 else t) / 3)],
            "joint_targets": [math.sin(t / 3)],
        },
        "flat", [("joints.0", 60.0, 65.9)],
    ),
    # At rest by nature, for less than 20 s.
    "nothing to feel": (lambda t: {"force": held(t, noisy(2)(t), 0.0)}, "flat", []),
    "saturates at times": (lambda t: {"force": min(noisy(2)(t), 3.32)}, "flat", []),
    "saturates": (lambda t: {"force": held(t, noisy(2)(t), 3.6)}, "flat", []),
    "quantised": (lambda t: {"force": round(noisy(2)(t), 1)}, "flat", []),
    "smooth": (lambda t: {"force": held(t, math.sin(t), 0.3)}, "flat", []),
    "comes back to it": (lambda t: {"force": noisy(2)(t) if int(t / 10) % 2 else 3.3}, "flat", []),
    "with a robot at rest": (
        lambda t: {"accel": held(t, noisy(2)(t), 3.3), "pose": [held(t, t, 50), 0]}, "flat", [],
    ),
    "commanded": (lambda t: {"wheel_speed": held(t, noisy(2)(t), 3.3), "x": t}, "flat", []),
}  # fmt: skip


@pytest.mark.parametrize(("state", "kind", "expected"), SCENARIOS.values(), ids=SCENARIOS)
def test_a_sensor_is_silent_or_flat_when_it_is_and_at_no_other_time(
    empty: sqlite3.Connection, state: State, kind: str, expected: list[tuple[str, float, float]]
) -> None:
    record(empty, state)
    assert told(ask(empty, kind)) == expected
    for name, start_s, end_s in expected:  # whole, also where a range holds a part of it
        middle_s = (start_s + end_s) / 2
        found = told(ask(empty, kind, start_s=middle_s, end_s=middle_s + 1))
        assert (name, start_s, end_s) in found


def test_a_scalar_null_is_the_missing_value_of_what_comes_below_it(
    empty: sqlite3.Connection,
) -> None:
    record(empty, waking)
    known = known_signals(empty, find_range(empty, Scope()))
    assert {s.name for s in resolve_signals(known, ["lidar"])} == {
        "lidar.count", "lidar.min", "lidar.max", "lidar.mean", "lidar.argmin",
    }  # fmt: skip
    assert "lidar" not in [signal.name for signal in list_signals(empty).signals]
    assert trends(empty, find_range(empty, Scope())).runs[0].without_value == ()


def test_a_silence_that_is_exactly_as_long_as_asked_for_is_told(
    empty: sqlite3.Connection,
) -> None:
    record(empty, lambda t: {"front": None if 20 <= t <= 20.5 else range_m(t), "x": t})
    options = EventOptions(kinds=("missing",), missing_s=0.5)
    for scope in (Scope(), Scope(start_s=20.5, end_s=40.0)):  # its end is the range's first row
        found = find_events(empty, find_range(empty, scope), options)
        assert told(found) == [("front", 20.0, 20.5)]


@pytest.mark.parametrize("kind", ["flat", "jump", "oscillation"])
def test_numbers_that_are_too_large_to_be_judged_are_said_to_be_so(
    empty: sqlite3.Connection, kind: str
) -> None:
    record(empty, lambda t: {"speed": 1e305 * math.sin(t), "left": range_m(t), "x": t})
    answer = ask(empty, kind)
    assert "speed was not searched: numbers beyond 1e+100" in answer.verdicts.not_searched[kind]


@pytest.mark.parametrize("items", [8, 40])
def test_a_lidar_that_sees_nothing_at_all_has_no_value(
    empty: sqlite3.Connection, items: int
) -> None:
    recorder = start_run(empty)
    replaced = {f"lidar.{item}": "inf" for item in range(items)}
    for step in range(600):
        blind = 200 <= step < 250
        scan = [None if blind else 2.0 + 0.1 * math.sin(step + item) for item in range(items)]
        recorder.publish(step * 0.1, {"lidar": scan}, replaced if blind else None)
    (silent,) = ask(empty, "missing").events
    assert (silent.start_s, silent.end_s) == pytest.approx((20.0, 24.9))
    assert silent.details["value"] == "inf"


def test_many_silences_are_one_event_but_for_one_that_goes_on(empty: sqlite3.Connection) -> None:
    record(empty, lambda t: {"front": range_m(t) if t % 10 < 8 else None})
    event, newest = ask(empty, "missing").events
    assert (event.count, newest.count) == (11, 1)
    assert event.details["says"] == (
        "11 stretches without a value, the first at 8 s, the last at 108 s, each 1.9 s long"
    )
    assert newest.ongoing and newest.start_s == pytest.approx(118.0)


LOST_S = ((10.0, 12.0), (30.0, 30.5), (50.0, 50.3), (70.0, 73.0), (90.0, 90.8))


def losing_the_line(time_s: float) -> dict[str, Any]:
    lost = any(start_s <= time_s < end_s for start_s, end_s in LOST_S)
    line = [None if lost else range_m(time_s + item) for item in range(3)]
    return {"line": line, "x": time_s}


@pytest.mark.parametrize(
    ("bounds", "found", "note"),
    [
        ({}, 2, "line.* 3 times"),
        ({"start_s": 20.0, "end_s": 45.0}, 0, "line.* 1 time"),
    ],
)
def test_losses_shorter_than_what_counts_are_counted_beside(
    empty: sqlite3.Connection, bounds: dict[str, float], found: int, note: str
) -> None:
    record(empty, losing_the_line)
    answer = ask(empty, "missing", **bounds)
    assert len(answer.events) == found
    (said,) = answer.notes
    too_short = "without a value for less than missing_s=1 s, so not counted as missing"
    assert said == f"run 1: {too_short}: {note}"


def test_what_comes_now_and_then_is_not_silent_meanwhile_and_the_answer_says_so(
    empty: sqlite3.Connection,
) -> None:
    record(empty, lambda t: {"gps": t if round(t * 10) % 20 == 0 else None})
    answer = ask(empty, "missing")
    assert answer.events == ()
    assert "gps is intermittent (a value about every 1.8 s)" in answer.notes[0]


@pytest.mark.parametrize("count", [2, 10, 40])
@pytest.mark.parametrize("quiet", [True, False])
def test_dropouts_are_told_however_many_there_are(
    empty: sqlite3.Connection, count: int, quiet: bool
) -> None:
    times_s = [round(3.2 + place * 110 / count, 1) for place in range(count)]

    def front(time_s: float) -> dict[str, Any]:
        value = 2.0 if quiet else range_m(time_s)
        return {"front_m": 0.0 if time_s in times_s else value}

    record(empty, front)
    answer = ask(empty, "jump")
    if count <= 3:
        assert [event.start_s for event in answer.events] == times_s
        return
    (event,) = answer.events
    assert event.details["says"] == (
        f"{count} dropouts to 0 m, the first at 3.2 s, the last at {times_s[-1]:g} s, "
        "each 0.1 s long"
    )
    for end_s in (3.25, 60.0, 100.0, 119.0):
        until = sum(time_s < end_s for time_s in times_s)
        assert counted(ask(empty, "jump", end_s=end_s).events) == until


def counted(events: tuple[Event, ...]) -> int:
    return sum(event.count for event in events)


def test_large_steps_that_are_how_a_signal_is_are_not_judged(empty: sqlite3.Connection) -> None:
    record(empty, lambda t: {"nearest": range_m(t) + 5 * (round(t * 10) % 8 == 0)})
    answer = ask(empty, "jump")
    assert answer.events == ()
    assert "nearest was not searched: its " in answer.verdicts.not_searched["jump"]


def test_a_freeze_that_is_too_short_to_count_is_told_as_what_came_nearest(
    empty: sqlite3.Connection,
) -> None:
    record(empty, lambda t: {"front": range_m(min(t, 45)), "gear": int(t / 15)}, until_s=60.0)
    nearest = ask(empty, "flat").verdicts.not_found["flat"]
    assert nearest.startswith("front stayed at ")
    assert nearest.endswith(" for 14.9 s from 45 s; 20 s count")


def front(time_s: float) -> float:
    """A distance that a sensor with noise measures up to 2 m."""
    return min(2.0, 1.5 + math.sin(time_s / 15) + noisy(1)(time_s) - 3.3)


SAYS: dict[str, tuple[Callable[[float], dict[str, Any]], str | None]] = {
    "frozen": (lambda t: {"force": 3.31 if 40 < t < 70 else noisy(1)(t)}, None),
    "at the end of a sensor": (lambda t: {"front_m": front(t)}, "at its limit of 2 m"),
    "gated": (
        lambda t: {"stick": 0.0 if 70 < t < 100 or t % 20 < 1 else math.sin(3 * t)},
        "at 0, as at other times",
    ),
    "stops at the farthest place": (lambda t: {"ticks": min(t, 60.0)}, None),
    "behind its target": (
        lambda t: {"arm": {"position": math.sin(min(t, 60) / 3), "target": math.sin(t / 3)}},
        "frozen: its target arm.target went from 0.9129 to -1",
    ),
    "told to move": (
        lambda t: {"belt_position": 0.2 * min(t, 60), "belt_speed_cmd": 0.2},
        "frozen: belt_speed_cmd was 0.2",
    ),
}


@pytest.mark.parametrize(("state", "says"), SAYS.values(), ids=SAYS)
def test_what_stays_the_same_is_told_with_what_shows_why(
    empty: sqlite3.Connection, state: State, says: str | None
) -> None:
    record(empty, state)
    (flat,) = ask(empty, "flat").events
    assert flat.details.get("says") == says


def test_a_short_freeze_of_a_long_run_does_not_contradict_the_verdict(
    empty: sqlite3.Connection,
) -> None:
    record(empty, lambda t: {"force": held(t / 2, noisy(1)(t), 3.31)})
    answer = ask(empty, "flat")
    assert told(answer) == [("force", 100.1, 119.9)]
    assert answer.verdicts.gaps == {}
