"""Random conditions over random states: they hold where a plain look at all the past says so."""

from __future__ import annotations

from hypothesis import given, settings

from tests.conditions.writing import Node, Rows, conditions, judged, rows, written
from webots_mcp.conditions import parse_condition


@settings(deadline=None, max_examples=150)
@given(conditions, rows())
def test_a_condition_holds_where_the_past_says_so(condition: Node, history: Rows) -> None:
    evaluator = parse_condition(written(condition)).evaluator()

    held = [evaluator.holds(state, time_s) for time_s, state in history]

    assert held == [judged(condition, history[: i + 1]) for i in range(len(history))]
