"""Whatever was published fits its budget, and says by which rule."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from webots_mcp.answers.shortening import (
    GLANCE,
    WHOLE,
    ShorteningLimits,
    shorten,
    tokens_in,
    tokens_of,
)

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(), inner, max_size=20),
    max_leaves=60,
)


@pytest.mark.slow
@settings(max_examples=50)
@given(json_values, st.integers(min_value=40, max_value=1250))
def test_whatever_was_published_fits_its_budget(value: Any, budget_tokens: int) -> None:
    assert tokens_of(shorten(value, budget_tokens).value) <= budget_tokens


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        ("the estimate and the odometry differ", 6),
        ("-1.234", 4),
        ("0.12345678901234567", 8),
        ('{"left":1.5,"right":-2}', 11),
        ("0123456789abcdef0123456789abcdef", 10),
        (" " * 1600, 100),
        ("\u4f60\u597d\U0001f916", 3),
    ],
)
def test_numbers_take_more_tokens_than_words_of_the_same_length(text: str, tokens: int) -> None:
    assert tokens_in(text) == tokens


def test_what_fits_in_words_does_not_fit_in_numbers() -> None:
    words = {"text": "odometry " * 80}
    numbers = {"values": [[0.1234 + i] * 4 for i in range(15)]}
    assert len(str(words)) > len(str(numbers))
    assert shorten(words, 120, WHOLE).rule is None
    assert shorten(numbers, 120, WHOLE).rule is not None


@pytest.mark.slow
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


def test_names_that_would_be_the_same_when_cut_stay_whole() -> None:
    level = (ShorteningLimits(items=2, text=8, keys=9, depth=2),)
    short = shorten({"sensor_left": 1, "sensor_last": 2}, 100, level)
    assert short.value == {"sensor_l… [11 characters]": 1, "sensor_last": 2}


def test_too_many_keys_are_counted() -> None:
    assert shorten({str(i): 0 for i in range(70)}).value["…"] == ("6 more keys: 64 to 69")


@pytest.mark.parametrize("levels", [GLANCE, WHOLE])
def test_a_tighter_level_is_taken_where_the_first_does_not_fit(levels: Any) -> None:
    state = {f"group {i}": {f"key {j}": "text " * 10 for j in range(30)} for i in range(30)}
    short = shorten(state, 500, levels)
    assert tokens_of(short.value) <= 500
    assert short.rule


def test_integers_that_no_float_holds_do_not_spoil_a_long_array() -> None:
    short = shorten([10**400] * 40 + [1.0]).value
    assert (short["count"], len(short["first"])) == (41, 3)
