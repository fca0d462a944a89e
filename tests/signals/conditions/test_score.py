"""What is a score and what is none, and what one comes to over states."""

from __future__ import annotations

import pytest

from tests.frames import frame_of_states
from tests.signals.conditions.writing import Rows
from webots_mcp.errors import ConditionFailedError, InvalidConditionError, UnknownSignalError
from webots_mcp.judging.detection.condition import aggregated
from webots_mcp.signals.conditions.scoring import Facts, Scored, parse_score

STATES: Rows = [
    (0.0, {"x": -1.0, "error": -2.0, "mode": "drive", "bumper": False, "gone": None}),
    (1.0, {"x": 3.0, "error": 4.0, "mode": "drive", "bumper": True, "gone": None}),
    (3.0, {"x": 2.0, "error": 0.0, "mode": "stop", "bumper": True, "gone": None}),
    (4.0, {"x": 2.0, "mode": "stop", "bumper": False, "gone": None}),
]


def score(text: str, states: Rows = STATES, **counts: int | str) -> Scored:
    asked, frame = parse_score(text), frame_of_states(states)
    try:
        found = [aggregated(each, frame) for each in asked.aggregates]
    except ConditionFailedError as error:
        return Scored(None, str(error))
    return asked.of(Facts(4.0, counts, found))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("mean(abs(error))", 2.5),
        ("min(x) + max(x) * 10 - first(x) / 4", 29.25),
        ("last(error)", 0.0),
        ("-last(x)", -2.0),
        ("mean(bumper)", 0.75),
        ("max(min(x, error))", 3.0),
        ("max(first(x), last(x), 1)", 2.0),
        ("min(min(x), 5)", -1.0),
        ("abs(min(x)) + duration", 5.0),
        ("time(mode == 'drive')", 3.0),
        ("time(mode == 'drive') + time(not mode == 'drive')", 4.0),
        ("time(bumper for 2)", 1.0),
        ("time((bumper for 2) and x > 0)", 1.0),
        ("max(rate(x))", 4.0),
        ("max(x) - 2 * count(stuck)", -1.0),
    ],
)
def test_a_score_is_arithmetic_over_what_the_values_of_a_run_come_to(
    text: str, value: float
) -> None:
    assert score(text, stuck=2) == Scored(value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("max(gone)", "max(gone) has no value"),
        ("1 + mean(x / 0)", "mean(x / 0) has no value"),
        ("1 / last(error)", "division by zero"),
        ("count(still)", "count(still) is not known: no position"),
        ("mean(mode)", "column 6: the text 'drive' is not a number"),
        ("max(x) * 1e300 * 1e300", "it is too large"),
    ],
)
def test_a_run_that_does_not_give_a_score_has_none_and_not_0(text: str, why: str) -> None:
    scored = score(text, still="no position")

    assert scored.value is None
    assert why in str(scored.why)


def test_a_mean_is_that_over_time_however_many_states_tell_of_a_stretch() -> None:
    seldom = [0.05 * n for n in range(201)]
    often = [9 + 0.001 * n for n in range(500)]  # the greatest values, as at a breakpoint
    states: Rows = [(t, {"x": t * t, "n": 1}) for t in sorted({*seldom, *often})]

    mean = score("mean(x)", states).value

    assert mean == pytest.approx(100 / 3, rel=0.01)  # of t * t from 0 to 10
    assert score("mean(n)", states).value == 1


def test_a_mean_of_states_of_one_moment_is_that_of_the_states() -> None:
    states: Rows = [(2.0, {"x": 1.0}), (2.0, {"x": 4.0})]
    assert score("mean(x)", states).value == 2.5


def test_a_run_without_a_state_has_no_mean_and_no_time_of_anything() -> None:
    for text in ("mean(x)", "time(x > 0)"):
        scored = score(text, [])
        assert scored.value is None
        assert "no recorded state" in str(scored.why)


@pytest.mark.parametrize(
    ("text", "column", "why"),
    [
        ("1 + error", 5, "write mean(...)"),
        ("mean(x, y)", 1, "takes one value, not 2"),
        ("mean(3)", 6, "no signal is named"),
        ("time(x)  + time(3 < 4)", 17, "no signal is named"),
        ("median(x)", 1, "there is no median() of a run; there are"),
        ("mean(median(x))", 6, "unknown function median()"),
        ("max(x for 2)", 5, "write mean(...)"),
        ("(max(x) for 2)", 9, "`for` belongs to a condition"),
        ("count(1)", 7, "count takes a kind"),
        ("max(x) > 2", 1, "a score is a number"),
        ("'text'", 1, "a number is needed"),
        ("max()", 1, "takes one value or more"),
        ("x.__class__()", 1, "only these functions can be called"),
        ("mean(x if y else z)", 6, "is needed here"),
        ("mean(x", 5, "never closed"),
        ("(lambda: 1)()", 8, "no slices and lambdas"),
    ],
)
def test_what_is_no_score_is_refused_with_its_place(text: str, column: int, why: str) -> None:
    with pytest.raises(InvalidConditionError) as refused:
        parse_score(text)

    assert f"score {text!r}, column {column}: " in str(refused.value)
    assert why in str(refused.value)


def test_an_empty_score_is_refused_with_one_that_is_none() -> None:
    with pytest.raises(InvalidConditionError, match=r"The score is empty\. Give one such as"):
        parse_score("  ")


def test_an_unknown_signal_is_named_with_its_place_and_the_nearest() -> None:
    with pytest.raises(
        UnknownSignalError, match=r"column 14: no signal 'eror' is recorded. Nearest signals: error"
    ):
        parse_score("max(x) + max(eror)").require_known(["x", "error", "mode"])
