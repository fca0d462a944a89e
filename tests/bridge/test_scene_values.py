"""Values of fields: which mean the same, and which is rather one value than another."""

from __future__ import annotations

from typing import Any

import pytest

from webots_mcp.bridge.field_values import is_nearer, is_same


@pytest.mark.parametrize(
    ("type_name", "one", "other", "same"),
    [
        ("SFRotation", [0, 0, 1, -1.57], [0, 0, -1, 1.57], True),
        ("SFRotation", [0, 0, 2, 1.0], [0, 0, 1, 1.0], True),
        ("SFRotation", [0, 0, 1, 0.0], [1, 0, 0, 0.0], True),
        ("SFRotation", [0, 0, 1, 0.0], [0, 0, 1, 6.283185307], True),
        ("SFRotation", [0, 0, 1, 1.0], [0, 1, 0, 1.0], False),
        ("SFFloat", 0.1, 0.10000000149, True),
        ("SFFloat", 1e6, 1e6 + 0.1, True),
        ("SFFloat", 0.1, 0.101, False),
        ("SFVec3f", [0.1, 0, 0], [0.1, 0, 0.001], False),
        ("SFBool", True, False, False),
        ("MFString", ["a"], ["a", "b"], False),
        ("MFColor", [[1, 0, 0]], [[1, 0, 1e-8]], True),
        ("MFFloat", [], [], True),
    ],
)
def test_values_mean_the_same_within_what_webots_rounds(
    type_name: str, one: Any, other: Any, same: bool
) -> None:
    assert is_same(type_name, one, other) is same
    assert is_same(type_name, other, one) is same


@pytest.mark.parametrize(
    ("value", "nearer"),
    [([1.0, 0, 0], True), ([0.9, 0, 0.1], True), ([0.0, 0, 0], False), ([0.1, 0, 0], False)],
)
def test_what_was_moved_on_since_is_nearer_to_where_it_was_put(value: Any, nearer: bool) -> None:
    assert is_nearer("SFVec3f", value, [1.0, 0, 0], [0.0, 0, 0]) is nearer
