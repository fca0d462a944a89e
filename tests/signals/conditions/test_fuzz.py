"""Whatever is written as a condition: it is refused, or asks what is published and nothing else."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from webots_mcp.errors import ConditionFailedError, InvalidConditionError
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.signals.conditions.syntax import MAX_CHARACTERS

pytestmark = pytest.mark.slow

_PIECES = """
    x mode a.b pose lidar.min front[2] for and or not in is if else lambda def yield await 0.5 1
    9e99 1_0 0x1 'a' "b" '' < <= == != = + - * / ** // % ( ) [ ] , . : ; := @ & | ~ ! ? \\ { }
    abs( min( max( rate( changed( missing( displacement( signal( __import__( open( eval(
    .__class__ .__globals__ __builtins__ True None ... # é f' b'' Å
"""
WORDS = st.sampled_from([*_PIECES.split(), "", "\n", "\t", "\0", "\ud800"])
TEXTS = st.text(max_size=40) | st.lists(WORDS, max_size=30).map(" ".join)
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
STATES = st.dictionaries(
    st.sampled_from(["x", "mode", "a", "b", "pose", "lidar", "front"]),
    st.recursive(
        LEAVES,
        lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.sampled_from("ab"), inner),
        max_leaves=20,
    ),
    max_size=5,
)


@settings(deadline=None, max_examples=400)
@given(TEXTS, st.lists(STATES, min_size=1, max_size=3))
def test_any_text(text: str, states: list[dict[str, Any]]) -> None:
    try:
        condition = parse_condition(text)
    except InvalidConditionError as refused:
        assert len(str(refused)) < 3 * MAX_CHARACTERS + 500
        return
    evaluator = condition.evaluator()
    for i, state in enumerate(states):
        try:
            assert type(evaluator.holds(state, i * 0.1)) is bool
        except ConditionFailedError:
            return
        assert set(condition.signals) <= set(evaluator.values(state))
