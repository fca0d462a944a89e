"""State rows become columns: each name with its value in every row, as a single row is named."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from webots_mcp.signals.naming import flatten
from webots_mcp.store.chunks import ABSENT, StateColumns

_NAMES = st.sampled_from(["a", "b", "a.b", "0"])
_LEAVES = st.sampled_from([None, True, 1, 2.5, "text"])
_VALUES = st.recursive(
    _LEAVES,
    lambda inner: (
        st.dictionaries(_NAMES, inner, max_size=3)
        | st.lists(inner, max_size=3)
        | st.lists(_LEAVES, min_size=16, max_size=18)
    ),
    max_leaves=6,
)
_STATES = st.dictionaries(_NAMES, _VALUES, max_size=3)


@pytest.mark.slow
@given(states=st.lists(_STATES, min_size=1, max_size=4), repeated=st.integers(1, 3))
@example(states=[{"a": [1, 2]}, {"a": [3, 4]}], repeated=1)
@example(states=[{"a": [1, 2]}, {"a": [3]}], repeated=1)
@example(states=[{"a": {"b": 1}, "a.b": 2}, {"a": {"b": 3}, "a.b": 4}], repeated=1)
@example(states=[{"a": [*range(17)]}, {"a": [*range(18)]}], repeated=2)
@example(states=[{"a": {}}, {"a": None}, {}], repeated=1)
def test_each_name_has_the_value_of_each_row(states: list[dict[str, Any]], repeated: int) -> None:
    rows = [state for state in states for _ in range(repeated)]
    columns = StateColumns()
    texts = [json.dumps(state) for state in rows]
    columns.add([(row, float(row), 0.0, text, None) for row, text in enumerate(texts, 1)])
    flat = [flatten(state) for state in rows]
    assert [*columns.values] == [*dict.fromkeys(name for state in flat for name in state)]
    for name, values in columns.values.items():
        assert values == [state.get(name, ABSENT) for state in flat]


def test_a_text_with_white_space_around_it_is_read_and_one_with_more_behind_it_is_not() -> None:
    texts = [' {"a": 1} ', '{"a": 2}\n', '{"a": 3} {"a": 4}', "[5]", "{", ""]
    columns = StateColumns()
    columns.add([(row, float(row), 0.0, text, None) for row, text in enumerate(texts, 1)])
    assert columns.values == {"a": [1, 2, *[ABSENT] * 4]}
