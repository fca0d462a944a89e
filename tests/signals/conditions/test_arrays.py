"""Conditions on arrays: in each row they say what the closures say of its state."""

from __future__ import annotations

import operator
import re
from itertools import accumulate
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.frames import frame_of, frame_of_states
from tests.signals.conditions.writing import Node, Rows, conditions, rows, written
from webots_mcp.errors import ConditionFailedError
from webots_mcp.judging.detection.condition import holds_in
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.signals.naming import find_position

pytestmark = pytest.mark.slow

COMPARISON: dict[str, Any] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
    "==": operator.eq, "!=": operator.ne,
}  # fmt: skip


def by_closures(text: str, history: Rows) -> list[bool]:
    evaluator = parse_condition(text).evaluator()
    return [evaluator.holds(state, time_s) for time_s, state in history]


def by_arrays(text: str, history: Rows) -> list[bool]:
    condition, frame = parse_condition(text), frame_of_states(history)
    position = find_position({name for _, state in history for name in state})
    return holds_in(condition.scanned, condition.tree, frame, position).tolist()


def agree(text: str, history: Rows) -> None:
    try:
        expected = by_closures(text, history)
    except ConditionFailedError as error:
        with pytest.raises(ConditionFailedError, match=re.escape(str(error).partition(": ")[0])):
            by_arrays(text, history)
    else:
        assert by_arrays(text, history) == expected


@settings(deadline=None, max_examples=200)
@given(conditions, rows())
def test_arrays_say_what_closures_say(condition: Node, history: Rows) -> None:
    agree(written(condition), history)


_mixed = st.sampled_from([None, 0, 1, 2, 0.5, True, False, "a", "b"])
_states = st.fixed_dictionaries(
    {"x": st.just(0.0), "y": st.just(0.0)},
    optional={"u": _mixed, "v": _mixed, "w": st.sampled_from([0, 1, 2.5, None])},
)
_steps = st.sampled_from([0.0, 5e-7, 1e-6, 0.0005, 0.001, 0.05, 0.1, 0.2, 1.0])
_of_w = ["rate(w)", "(w + u)", "max(u, w)"]
_operands = st.sampled_from(["u", "v", "w", "1", "0.5", "'a'", "true", "rate(u)", "abs(v)", *_of_w])
_sign = st.sampled_from(["<", "<=", ">", ">=", "==", "!="])
_simple = st.one_of(
    st.tuples(_operands, _sign, _operands).map(" ".join),
    st.tuples(_operands, _sign, _operands, _sign, _operands).map(" ".join),
    st.sampled_from(["u", "w", "missing(u)", "changed(v)", "changed(u)", "displacement(0.1) < 1"]),
)


def _combined(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.one_of(
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(
            lambda parts: f"({parts[0]}) {parts[1]} ({parts[2]})"
        ),
        inner.map(lambda part: f"not ({part})"),
        st.tuples(inner, st.sampled_from([0.1, 0.2])).map(
            lambda parts: f"(({parts[0]}) for {parts[1]})"
        ),
    )


_texts = st.recursive(_simple, _combined, max_leaves=5).filter(
    lambda text: re.search(r"\b[uvw]\b|displacement", text) is not None
)


@st.composite
def _mixed_rows(draw: st.DrawFn) -> Rows:
    pairs = draw(st.lists(st.tuples(_steps, _states), min_size=1, max_size=20))
    times = accumulate(step_s for step_s, _ in pairs)
    return [(at_s, state) for at_s, (_, state) in zip(times, pairs, strict=True)]


@settings(deadline=None, max_examples=200)
@given(_texts, _mixed_rows())
def test_texts_among_numbers_and_time_that_stands_still_are_judged_alike(
    text: str, history: Rows
) -> None:
    agree(text, history)


@pytest.mark.parametrize("sign", ["<", "<=", ">", ">=", "==", "!="])
@pytest.mark.parametrize("limit", [-60, 0, 30, 31, 1e150])
def test_rows_are_judged_alike_where_chunks_are_left_closed(sign: str, limit: float) -> None:
    course = np.repeat([0.0, 40.0, 30.0, 31.0, -50.0], 1500)
    course[100], course[3000] = 31.0, np.nan
    course[4000:5500] = np.nan
    course[7000] = 1e200
    condition = parse_condition(f"x {sign} {limit}")

    frame = frame_of(np.arange(len(course)) / 10, {"x": course})
    held = holds_in(condition.scanned, condition.tree, frame, None)

    expected = COMPARISON[sign](course, limit) & ~np.isnan(course)
    assert (held == expected).all()
