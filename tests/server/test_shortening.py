"""Whatever was published fits its budget, and says by which rule."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from webots_mcp.questions.shortening import GLANCE, WHOLE, compact_json, shorten

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(), inner, max_size=20),
    max_leaves=60,
)


@settings(max_examples=50)
@given(json_values, st.integers(min_value=200, max_value=5000))
def test_whatever_was_published_fits_its_budget(value: Any, budget: int) -> None:
    assert len(compact_json(shorten(value, budget).value)) <= budget + 50


@settings(max_examples=50)
@given(json_values)
def test_what_was_left_out_is_said_and_what_fits_is_unchanged(value: Any) -> None:
    short = shorten(value, 10**9, WHOLE)
    if short.rule is None:
        assert short.value == value


def test_numbers_are_rounded_at_a_glance_and_exact_when_whole() -> None:
    assert shorten([0.000123456, -1.23456, 123456.78912, 7]).value == [
        0.0001235, -1.235, 123456.789, 7,
    ]  # fmt: skip
    assert shorten([0.000123456], levels=WHOLE).value == [0.000123456]


def test_a_long_array_is_summarised_under_the_names_of_its_signals() -> None:
    array: list[Any] = [3.0, 1.0, "inf", 2.0, None] * 4
    assert shorten(array).value == {
        "count": 20, "min": 1.0, "max": 3.0, "mean": 2.0, "argmin": 1, "inf": 4, "null": 4,
    }  # fmt: skip


def test_an_array_of_other_things_shows_its_first_and_its_length() -> None:
    assert shorten([{"a": i} for i in range(20)]).value == {
        "count": 20,
        "first": [{"a": 0}, {"a": 1}, {"a": 2}],
    }


def test_a_cut_text_says_how_long_it_was() -> None:
    short = shorten({"text": "x" * 300})
    assert short.value["text"].endswith("… [300 characters]")
    assert "texts over 200 characters" in (short.rule or "")


def test_too_many_keys_are_counted() -> None:
    assert shorten({str(i): 0 for i in range(70)}).value["…"] == "6 more keys"


@pytest.mark.parametrize("levels", [GLANCE, WHOLE])
def test_a_tighter_level_is_taken_where_the_first_does_not_fit(levels: Any) -> None:
    state = {f"group {i}": {f"key {j}": "text " * 10 for j in range(30)} for i in range(30)}
    short = shorten(state, 2000, levels)
    assert len(compact_json(short.value)) <= 2000
    assert short.rule


def test_integers_that_no_float_holds_do_not_spoil_a_long_array() -> None:
    short = shorten([10**400] * 40 + [1.0]).value
    assert (short["count"], len(short["first"])) == (41, 3)
