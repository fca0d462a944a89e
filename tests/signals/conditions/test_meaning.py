"""When a condition holds, as one state follows another."""

from __future__ import annotations

import math
from typing import Any

import pytest

from webots_mcp.errors import ConditionFailedError
from webots_mcp.signals.conditions import Evaluator, parse_condition


def holding(text: str, *states: dict[str, Any], every_s: float = 0.1) -> list[bool]:
    evaluator = parse_condition(text).evaluator()
    return [evaluator.holds(state, i * every_s) for i, state in enumerate(states)]


def of(**values: list[Any]) -> list[dict[str, Any]]:
    """One state per item; None stands for a missing value."""
    rows = zip(*values.values(), strict=True)
    return [dict(zip(values, row, strict=True)) for row in rows]


@pytest.mark.parametrize(
    ("text", "state", "holds"),
    [
        ("x < 1", {"x": 0.5}, True),
        ("x < 1", {"x": 1}, False),
        ("0 < x <= 1", {"x": 1}, True),
        ("0 < x < 1", {"x": 1}, False),
        ("x + 2 * y == 7", {"x": 1, "y": 3}, True),
        ("(x + 2) * y == 9", {"x": 1, "y": 3}, True),
        ("x / y > 1", {"x": 1, "y": 0}, False),  # no value
        ("missing(x / y)", {"x": 1, "y": 0}, True),
        ("missing(x * x)", {"x": 1e200}, True),
        ("abs(-x) == 2 and min(x, 3, 4) == 2 and max(x, 3) == 3", {"x": 2}, True),
        ("mode == 'drive'", {"mode": "drive"}, True),
        ("mode != 'drive'", {"mode": "turn"}, True),
        ("mode == 1", {"mode": "turn"}, False),
        ("not a or b and c", {"a": True, "b": True, "c": True}, True),
        ("a == true and b == False", {"a": True, "b": False}, True),
        ("bumper", {"bumper": True}, True),
        ("bumper", {"bumper": 0}, False),
        ("bumper", {}, False),
        ("x < 1", {}, False),
        ("x != 1", {}, False),
        ("x == x", {}, False),
        ("not x < 1", {}, True),
        ("missing(x) and missing(y)", {"x": None}, True),
        ("x < 1 or x >= 1", {"x": math.nan}, False),
        ("x > 1", {"x": math.inf}, False),
        ("missing(lidar)", {"lidar": [1.0]}, True),  # the branch has no value, its items have
        (
            "lidar.min == 1 and lidar.argmin == 1 and lidar.count == 17",
            {"lidar": [5, *[1] * 16]},
            1,
        ),
        ("front[1] == 2", {"front": [1, 2]}, True),
        ("missing(front[2])", {"front": [1, 2]}, True),
        ("signal('a.b') == 1", {"a.b": 1}, True),
        ("a.b == 2", {"a.b": 1, "a": {"b": 2}}, True),  # the last counts
        ("a.b == 1", {"a": {"b": 2}, "a.b": 1}, True),
        ("k['1'] == 2", {"k": {"1": 2}}, True),
    ],
)
def test_of_one_state(text: str, state: dict[str, Any], holds: bool) -> None:
    assert holding(text, state) == [holds]


def test_a_value_has_changed_when_it_is_another_than_the_last_that_was_there() -> None:
    modes = of(mode=["a", "a", "b", None, "b", None, "a", "a"])

    assert holding("changed(mode)", *modes) == [
        False,
        False,
        True,
        False,
        False,
        False,
        True,
        False,
    ]


def test_a_rate_is_per_second_from_value_to_value() -> None:
    states = of(x=[0.0, 1.0, None, 2.0, 2.0])

    assert holding("rate(x) > 9", *states) == [False, True, False, False, False]
    assert holding("4.9 < rate(x) < 5.1", *states) == [False, False, False, True, False]
    assert holding("missing(rate(x))", *states) == [True, False, True, False, False]


def test_while_time_stands_still_a_rate_stays_as_it_is() -> None:
    evaluator = parse_condition("rate(x) > 9").evaluator()

    held = [evaluator.holds({"x": x}, t) for t, x in [(0.0, 0), (0.1, 1), (0.1, 5), (0.2, 2)]]

    assert held == [False, True, True, True]


def test_a_condition_holds_for_a_time_when_it_held_in_each_state_of_it() -> None:
    states = of(x=[0, 0, 0, 1, 0, 0, 0, 0])

    held = holding("x == 0 for 0.2", *states)

    assert held == [False, False, True, False, False, False, True, True]


def test_a_missing_value_breaks_a_time() -> None:
    assert holding("x == 0 for 0.2", *of(x=[0, 0, None, 0, 0])) == [False] * 5


def test_a_time_inside_a_condition_goes_on_whatever_stands_beside_it() -> None:
    states = of(x=[0, 0, 0, 0], mode=["a", "a", "a", "b"])

    held = holding("mode == 'b' and (x == 0 for 0.3)", *states)

    assert held == [False, False, False, True]


def test_clocks_that_add_up_steps_do_not_miss_the_end_of_a_time() -> None:
    evaluator = parse_condition("x == 0 for 0.8").evaluator()
    time_s, held = 0.0, list[bool]()
    for _ in range(101):
        held.append(evaluator.holds({"x": 0}, time_s))
        time_s += 0.008

    assert held.index(True) == 100


def test_a_displacement_is_the_straight_way_from_where_it_was() -> None:
    places = [(0, 0), (0, 0), (3, 4), (3, 4), (3, 4)]
    states = [{"pose": [x, y, 0.5]} for x, y in places]

    held = holding("displacement(0.2) == 5", *states)

    assert held == [False, False, True, True, False]
    assert holding("missing(displacement(0.2))", *states) == [True, True, False, False, False]


def test_after_a_gap_there_is_no_displacement_until_there_are_places_again() -> None:
    evaluator = parse_condition("missing(displacement(1))").evaluator()
    times = [0.0, 0.5, 1.0, 5.0, 5.5, 6.0]

    held = [evaluator.holds({"gps": {"x": 1.0, "y": 2.0}}, time_s) for time_s in times]

    assert held == [True, True, False, True, True, False]


def test_a_displacement_takes_the_position_that_the_tools_take() -> None:
    evaluator = parse_condition("displacement(0.1) > 0.5").evaluator()
    states = [
        {"goal": {"x": 1.0 * i, "y": 0.0}, "position": {"x_m": 2.0 * i, "y_m": 1.0}, "name": "x"}
        for i in range(3)
    ]

    assert [evaluator.holds(state, i * 0.1) for i, state in enumerate(states)] == [
        False,
        True,
        True,
    ]
    assert evaluator.values(states[2]) == {"position.x_m": 4.0, "position.y_m": 1.0}


def test_a_displacement_is_in_metres_whatever_the_unit_of_the_position() -> None:
    evaluator = parse_condition("displacement(0.1) > 0.5").evaluator()
    states = [{"x_mm": 400.0 * i * i, "y_mm": 0.0} for i in range(3)]

    assert [evaluator.holds(state, i * 0.1) for i, state in enumerate(states)] == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize(
    "text", ["changed(x)", "rate(x) > 0", "x == 0 for 0.1", "displacement(0.1) >= 0"]
)
def test_time_that_goes_back_begins_anew(text: str) -> None:
    evaluator = parse_condition(text).evaluator()
    states = [(0.0, 0), (0.1, 0), (0.2, 5), (0.0, 0), (0.1, 1)]

    held = [evaluator.holds({"x": x, "y": 0.0}, time_s) for time_s, x in states]

    assert any(held[:3])
    assert not held[3]
    fresh = parse_condition(text).evaluator()
    assert [fresh.holds({"x": x, "y": 0.0}, t) for t, x in states[3:]] == held[3:]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("mode < 3", r"column 1: cannot compare the text 'drive' with the number 3 by <"),
        ("1 + mode > 2", "column 5: the text 'drive' is not a number"),
        ("mode", "column 1: the text 'drive' is not a condition"),
        ("rate(mode) > 1", "column 6: the text 'drive' is not a number"),
        ("mode < 3 for 1", "column 1: cannot compare the text"),
        ("changed(mode - 1)", "column 9: the text"),
    ],
)
def test_what_cannot_be_asked_of_a_text_fails_and_says_where(text: str, why: str) -> None:
    evaluator = parse_condition(text).evaluator()

    with pytest.raises(ConditionFailedError, match=why):
        evaluator.holds({"mode": "drive"}, 0.0)


@pytest.mark.parametrize("text", ["rate(x) > 1", "changed(x + 1)", "x < 1 for 1"])
def test_what_stands_behind_and_is_not_asked_and_does_not_fail(text: str) -> None:
    evaluator = parse_condition(f"x != 'n/a' and ({text})").evaluator()

    assert not evaluator.holds({"x": "n/a"}, 0.0)


def test_the_values_of_a_state_are_those_that_the_condition_reads() -> None:
    evaluator: Evaluator = parse_condition("x < 1 and absent > lidar.min").evaluator()

    values = evaluator.values({"x": 0.5, "y": 2, "lidar": [3.0] * 20})

    assert values == {"x": 0.5, "absent": None, "lidar.min": 3.0}
