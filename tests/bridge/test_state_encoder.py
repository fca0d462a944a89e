"""A state of known keys is encoded in less time, to the same text as any other."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bridge.keeping.test_state_copies import LEAVES, STATES
from tests.bridge.monsters import MONSTERS
from webots_mcp.bridge import encoding
from webots_mcp.bridge.encoding import (
    StateEncoder,
    _encode_alike,  # pyright: ignore[reportPrivateUsage]
    encode,
)
from webots_mcp.bridge.state_shapes import shape_of

PLAIN: dict[str, Any] = {
    "pose": [1.0, 2.0],
    "mode": "drive",
    "n": 3,
    "deep": {"x": None, "y": [[1]]},
}
VALUES = LEAVES | st.sampled_from(
    [2**63, 2**64 - 1, -(2**63) - 1, 10**40, math.nan, math.inf, "null", "\ud800b", "ä"]
)


def known(state: Any) -> StateEncoder:
    """An encoder that has learned the shape of a state."""
    encoder = StateEncoder()
    encoder.encode(state)
    return encoder


@pytest.fixture(params=[True, False], ids=["orjson", "json"], autouse=True)
def has_orjson(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if not request.param:
        monkeypatch.setattr(encoding, "orjson", None)


def test_the_shape_of_a_plain_state_is_learned_at_once() -> None:
    assert known(PLAIN)._last.shape is not None  # pyright: ignore[reportPrivateUsage]
    assert known({"x": {1, 2}})._last.shape is None  # pyright: ignore[reportPrivateUsage]


@pytest.mark.slow
@given(st.lists(STATES, min_size=1, max_size=4))
def test_states_of_any_shapes_are_encoded_as_alone(states: list[dict[str, Any]]) -> None:
    encoder = StateEncoder()
    for state in [each for each in states for _ in range(2)]:
        before = copy.deepcopy(state)
        assert encoder.encode(state) == encode(before)
        assert repr(state) == repr(before)


@given(st.lists(VALUES, min_size=5, max_size=5))
def test_other_values_at_known_keys_are_checked_as_alone(values: list[Any]) -> None:
    encoder = known(PLAIN)
    state = {
        "pose": values[:2], "mode": values[2], "n": values[3], "deep": {"x": values[4], "y": [[2]]},
    }  # fmt: skip
    assert encoder.encode(state) == encode(copy.deepcopy(state))


@pytest.mark.slow
@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_an_object_of_the_users_own_is_never_taken_for_a_known_state(make: Any) -> None:
    shape = shape_of(PLAIN)
    assert shape is not None
    for key in PLAIN:
        assert _encode_alike({**PLAIN, key: make()}, shape.read) is None


@pytest.mark.parametrize("length", [15_900, 16_100, 50_000, 2_000_000])
def test_a_text_that_grows_is_cut_as_alone(length: int) -> None:
    state = {**PLAIN, "mode": "a" * length}
    assert known(PLAIN).encode(state) == encode(state)


def test_a_known_state_with_a_number_that_is_not_finite_names_it_in_each_row() -> None:
    encoder = known(PLAIN)
    for _ in range(600):
        assert encoder.encode({**PLAIN, "n": math.nan}).replaced == {"n": "nan"}
    assert encoder.encode(PLAIN) == encode(PLAIN)
