"""A condition reads of what is published what `flatten` finds in the row that is recorded of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from webots_mcp.bridge import json_cleaning
from webots_mcp.bridge.encoding import encode, plain
from webots_mcp.signals.conditions.signal_values import reader
from webots_mcp.signals.naming import flatten


def _float64(number: float) -> Any:
    return np.float64(number)


def _float32(number: int) -> Any:
    return np.float32(number / 4)  # orjson shortens others


def _uint8(number: int) -> Any:
    return np.uint8(number)


KEYS: st.SearchStrategy[Any] = st.sampled_from(
    ["a", "b", "a.b", "0", "1", "min", "null", 0, 1, 16, True, None, 1.5, "é"]
)
NUMBERS: st.SearchStrategy[Any] = st.one_of(
    st.floats(),
    st.integers(-(2**70), 2**70),
    st.booleans(),
    st.sampled_from([10**400, -(2**63), 2**63, 1.5, -0.0]),
)
ODD: st.SearchStrategy[Any] = st.sampled_from(["\ud800x", "é", b"bytes", math.nan])
NUMPY: st.SearchStrategy[Any] = st.one_of(
    st.floats(allow_nan=True).map(_float64),
    st.integers(-1000, 1000).map(_float32),
    st.integers(0, 255).map(_uint8),
)
LEAVES: st.SearchStrategy[Any] = st.one_of(
    NUMBERS,
    st.none(),
    st.text(max_size=5),
    ODD,
    NUMPY,
)
ARRAYS = st.one_of(
    st.lists(st.floats(), min_size=14, max_size=20),
    st.lists(st.floats(-5, 5), min_size=17, max_size=20),
    st.lists(st.integers(-5, 5), min_size=17, max_size=20),
    st.lists(NUMBERS | st.none(), min_size=15, max_size=18).map(tuple),
    st.lists(st.floats(), min_size=15, max_size=18).map(np.array),
)
VALUES = st.recursive(
    LEAVES | ARRAYS,
    lambda inner: (
        st.dictionaries(KEYS, inner, max_size=4)
        | st.lists(inner, max_size=4)
        | st.lists(inner, max_size=3).map(tuple)
    ),
    max_leaves=12,
)
NAMES = ("a", "a.b", "b.0", "a.1", "a.b.min", "1", "null", "a.mean", "0.a", "True", "é.é", "a.16")


@pytest.fixture(scope="module", autouse=True)
def all_the_time_that_objects_need() -> Iterator[None]:
    """A row holds null for an object that is read on a machine too busy for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_cleaning, "OBJECTS_BUDGET_S", 60.0)
        yield


@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(st.dictionaries(KEYS, VALUES, max_size=4))
def test_whatever_is_published(state: dict[Any, Any]) -> None:
    row = flatten(json.loads(encode(state).text))

    for name in {*row, *NAMES}:
        read = reader(name, plain)(state)
        assert type(read) is type(row.get(name)), name
        assert read == row.get(name), name


@pytest.mark.parametrize(
    "array",
    [
        [0.5] * 5000,
        [*range(4500)],
        [0.5] * 30_000,
        np.linspace(0, 1, 5000),
        np.zeros(30_000),
        np.zeros((20, 3)),
        [True] * 20,
        ["a"] * 20,
        [1e308] * 20,
        [2**62] * 20,
        np.array([1.5], dtype=np.longdouble),
        np.full(20, 1.5, dtype=np.longdouble),
    ],
    ids=str,
)
def test_arrays_of_any_size_and_kind(array: Any) -> None:
    state = {"ranges": array}
    row = flatten(json.loads(encode(state).text))

    for name in ("ranges", *(f"ranges.{last}" for last in ("0", "min", "mean", "argmin", "count"))):
        assert reader(name, plain)(state) == row.get(name), name
