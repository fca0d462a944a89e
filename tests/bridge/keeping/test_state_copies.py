"""A state that waits in the ring is copied as it is, whatever its controller changes later."""

from __future__ import annotations

import copy
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bridge.monsters import MONSTERS
from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.state_copies import StateCopier
from webots_mcp.bridge.state_shapes import shape_of

LEAVES = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=5)
)
STATES = st.dictionaries(
    st.text(max_size=3),
    st.recursive(
        LEAVES,
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.lists(inner, max_size=4).map(tuple)
            | st.dictionaries(st.text(max_size=3), inner, max_size=4)
        ),
        max_leaves=12,
    ),
    max_size=5,
)


def copied(copier: StateCopier, state: Any) -> Any:
    """The copy of a state, as it is found later; None where none was made."""
    found = copier.copy(state)
    return None if found is None else found.state()


@pytest.mark.slow
@given(STATES)
def test_a_copy_is_encoded_as_the_state_was(state: dict[str, Any]) -> None:
    copier = StateCopier()
    assert copier.copy(state) is None  # the first one shows the shape
    found, expected = encode(copied(copier, state)), encode(state)
    assert json.loads(found.text) == json.loads(expected.text)
    assert found.replaced == expected.replaced


@pytest.mark.slow
@given(STATES, STATES)
def test_a_state_of_another_shape_is_never_copied_by_the_wrong_one(
    first: dict[str, Any], second: dict[str, Any]
) -> None:
    copier = StateCopier()
    copier.copy(first)
    found = copied(copier, second)
    if found is not None:
        assert encode(found).replaced == encode(second).replaced
        assert repr(sorted(found.items())) == repr(sorted(second.items()))


def test_what_the_controller_changes_later_is_not_in_the_copy() -> None:
    state: dict[str, Any] = {"pose": [1.0, 2.0], "deep": {"list": [[1], {"x": 2}]}}
    copier = StateCopier()
    copier.copy(state)
    before, found = copy.deepcopy(state), copier.copy(state)
    state["pose"][0] = 9.0
    state["deep"]["list"][1]["x"] = 9
    assert found is not None
    assert found.state() == before


@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_an_object_of_the_users_own_is_not_copied(make: Any) -> None:
    plain, copier = {"x": 1.0, "y": [1.0]}, StateCopier()
    copier.copy(plain)
    assert copied(copier, plain) == plain
    for strange in ({"x": make(), "y": [1.0]}, {"x": 1.0, "y": make()}, {"x": 1.0, "y": [make()]}):
        copier = StateCopier()
        copier.copy(plain)
        assert copier.copy(strange) is None or type(strange["x"]) in (float, int, str)


@pytest.mark.parametrize(
    "state",
    [{1: 2}, {"x": {2, 3}}, {"x": b"bytes"}, {"x": list(range(5000))}, [1.0], None, "text"],
    ids=repr,
)
def test_what_is_no_small_plain_state_has_no_shape(state: object) -> None:
    assert shape_of(state) is None


def test_a_text_that_grows_is_left_to_the_encoder_that_cuts_it() -> None:
    copier = StateCopier()
    copier.copy({"x": "short"})
    assert copier.copy({"x": "a" * 1_000_000}) is None
    assert copier.copy({"x": "short"}) is None


def test_keys_that_change_with_each_call_do_not_compile_a_function_each_time() -> None:
    copier = StateCopier()
    for number in range(100):
        assert copier.copy({f"key{number}": math.pi}) is None
    assert copier._last._learned == 8  # pyright: ignore[reportPrivateUsage]
