"""What is a condition and what is none; a refusal names the place and what would be possible."""

from __future__ import annotations

from typing import Any

import pytest

from webots_mcp.errors import InvalidConditionError
from webots_mcp.signals.conditions import parse_condition


@pytest.mark.parametrize(
    ("text", "signals"),
    [
        ("front_m < 0.1", ["front_m"]),
        ("front_m < 0.1 for 0.5", ["front_m"]),
        ("(front_m < 0.1 for 0.5) and mode == 'drive'", ["front_m", "mode"]),
        ("0 < sensors.front <= front[2] + 1", ["sensors.front", "front.2"]),
        ("pose.0 + pose.1 > .5 and grid.2.11 < 1", ["pose.0", "pose.1", "grid.2.11"]),
        ("pose['x y'][0] > -.5e-3", ["pose.x y.0"]),
        ("signal('front left').x > 1", ["front left.x"]),
        ("signal('wheels.left.is') < 5", ["wheels.left.is"]),
        ("wheels.left.true < 5 and state == 'a.is'", ["wheels.left.true", "state"]),
        ("changed(mode) or missing(lidar.min)", ["mode", "lidar.min"]),
        ("not bumper", ["bumper"]),
        ("rate(abs(speed - target)) > max(1, limit)", ["speed", "target", "limit"]),
        ("displacement(3) < 0.05", []),
        ("door == 'waiting for you'", ["door"]),
        ("a.__class__ == 1", ["a.__class__"]),  # the name of a signal, nothing of Python's
        ("Größe_m > 1 for 2", ["Größe_m"]),
    ],
)
def test_a_condition_names_the_signals_that_it_reads(text: str, signals: list[str]) -> None:
    condition = parse_condition(f"  {text} ")

    assert condition.text == text
    assert list(condition.signals) == signals
    assert condition.asks_position == ("displacement" in text)


@pytest.mark.parametrize(
    ("text", "column", "why"),
    [
        ("front_m = 0.1", 9, "write =="),
        ("front_m < ", 10, "ends too early"),
        ("front_m < 0.1 fro 0.5", 15, "'fro 0.5'"),
        ("(front_m < 0.1", 1, "never closed"),
        ("front_m < 0.1)", 14, "unmatched"),
        ("a < 1 && b < 1", 7, "`and`"),
        ("a < 'x", 5, "not closed"),
        ("a == 'it''s'", 10, "no escapes"),
        ("a == 'x' \"y\"", 10, "between two texts"),
        ("a < 1\nb < 2", 6, "one line"),
        ("a < 1 for 1 for 2", 13, "one number of seconds"),
        ("a < 1 for b", 11, "number of seconds"),
        ("a < 1 for 0", 11, "above 0"),
        ("a < 1 for 9999", 11, "at most 3600"),
        ("max(a for 1, 3) < 2", 7, "parentheses"),
        ("a, b < 1", 1, "commas"),
        ("a ** 9 < 1", 3, "+ - * /"),
        ("9**9**9 > a", 2, "+ - * /"),
        ("(é + 1) // 2 < 1", 9, "+ - * /"),
        ("a % 2 < 1", 3, "remainder"),
        ("pose.0 + pose.1 = 3", 17, "write =="),
        ("pose.0 + pose.1 < 3 fro 1", 21, "'fro 1'"),
        ("pose.0 + 'a' < 3", 10, "number"),
        ("pose.1e5 < 3", 5, "from 0"),
        ("pose.0x < 3", 7, "space or an operator"),
        ("a[-1] < 1", 3, "from 0"),
        ("a[b] < 1", 3, "from 0"),
        ("a in b", 1, "instead of `in`"),
        ("a is b", 1, "compare with < <= > >="),
        ("b if a else c", 1, "compares"),
        ("lambda: a", 7, "lambdas"),
        ("[a] < 1", 1, "needed here"),
        ("(a < 1) + 1 < 2", 2, "needed here"),
        ("a + 1", 1, "compares"),
        ("'text' + a < 1", 1, "number"),
        ("1 < 2", 1, "no signal"),
        ("a == None", 6, "missing(x)"),
        ("a < 1e999", 5, "1e+300"),
        ("abs(a, b) < 1", 1, "one value"),
        ("min(a) < 1", 1, "ranges.min"),
        ("min(*a) < 1", 1, "values only"),
        ("abs(x=a) < 1", 6, "=="),
        ("changed(a) < 1", 1, "is a condition"),
        ("chagned(a)", 1, "changed()"),
        ("abs(a)", 1, "compares"),
        ("__import__('os').system('id')", 1, "only these functions can be called: abs(), "),
        ("chagned(a) == 1", 1, "changed()"),
        ("a.b(1) < 1", 1, "functions"),
        ("f'{a}' == b", 2, "space or an operator"),
        ("0x10 < a", 2, "a number has no unit"),
        ("1j < a", 2, "a number has no unit"),
        ("a\\b < 1", 2, "no escapes"),
        ("a @ b < 1", 3, "no meaning"),
        ("a < 1 # why", 7, "no meaning"),
        ("signal(a) < 1", 8, "in quotes"),
        ("héé < 1 fr 2", 9, "'fr 2'"),
        ("wheels.left.is < 5", 1, "write signal('wheels.left.is')"),
        ("a < 'x.is' and wheels.for > 1 for 2", 16, "write signal('wheels.for')"),
        ("not.x < 5", 1, "write signal('not.x')"),
        ("wheels[0].in.y < 5", 1, "write signal('wheels.0.in.y')"),
        ("None.x < 5", 1, "write signal('None.x')"),
        ("lambda < 5", 8, "write signal('lambda')"),
        ("a < 1 and and b", 11, "'and b'"),
    ],
)
def test_a_refusal_names_the_column_and_what_would_do(text: str, column: int, why: str) -> None:
    with pytest.raises(InvalidConditionError, match=f"column {column}: ") as refused:
        parse_condition(text)

    assert why in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "   ",
        "a < 1 or " * 60 + "a < 1",
        "(" * 240 + "a < 1" + ")" * 240,
        "-" * 400 + "a < 1",
        "not " * 100 + "a",
        "+".join(["a"] * 60) + " < 1",
        "a" + "[0]" * 100 + " < 1",
        "9" * 490 + " < a",
    ],
)
def test_what_is_empty_long_or_deep_is_refused(text: str) -> None:
    with pytest.raises(InvalidConditionError):
        parse_condition(text)


@pytest.mark.parametrize("value", [5, None, b"a < 1", ["a < 1"]])
def test_what_is_no_text_is_refused(value: Any) -> None:
    with pytest.raises(InvalidConditionError, match="must be a text such as"):
        parse_condition(value)


def test_a_displacement_says_that_no_position_is_published() -> None:
    condition = parse_condition("displacement(3) < 0.05 or bumper")

    (told,) = condition.describe_unknown(["bumper", "place.x_now", "place.y_now"])
    assert told.startswith("displacement has no value: no position is known")
    assert condition.describe_unknown(["bumper", "pose.x", "pose.y"]) == []
    assert condition.describe_unknown([]) != []


def test_unknown_signals_are_told_with_the_nearest_ones() -> None:
    condition = parse_condition("frnt_m < 0.1 and mode == 'drive'")

    (told,) = condition.describe_unknown(["front_m", "mode", "speed"])

    assert told.startswith("No signal 'frnt_m' is published. The nearest of 3 signals: front_m")
    (short,) = condition.describe_unknown(["front_m", "mode", "speed", "x", "y"])
    assert "The nearest of 5 signals: " in short
    assert "Nothing is published yet" in condition.describe_unknown([])[0]
