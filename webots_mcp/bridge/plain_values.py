"""A quick check for the usual states: dicts of numbers, texts, lists and arrays of numbers.

A state that passes can be encoded as it is, because it is small, not nested deeply and holds only
types that the encoder knows. Any other state has to be cleaned first.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from webots_mcp.bridge.conversion import MAX_ITEMS, is_c_number_array, is_number_array, item_count
from webots_mcp.bridge.json_cleaning import CONTAINER_ITEMS, MAX_DEPTH

# A text counts as one more item for every two characters. All texts that pass are within the
# limits of the cleaner then, also where each character takes six bytes of JSON.
_CHARACTERS_PER_ITEM: Final = 2
_SHORT_TEXT_CHARACTERS: Final = 16
_LONGEST_TEXT_CHARACTERS: Final = 16_000
_SHORT_KEY_CHARACTERS: Final = 60
_MAX_KNOWN_KEYS: Final = 10_000
_SHORT_ARRAY: Final = 16
_LEAVES: Final = frozenset((float, bool, type(None)))  # need no further check

# Keys that were checked before. Every row has the same ones, so most checks are one set operation.
_known_keys: set[object] = set()


class NotPlainError(Exception):
    """The value is too large, or holds a type that has to be cleaned."""


def require_plain(value: object) -> None:
    """Check that a value can be encoded as it is.

    Raises:
        NotPlainError: If it has to be cleaned first.
        Exception: Whatever an object raises while it is read.
    """
    _check((value,), MAX_ITEMS, 0)


def is_plain(value: object) -> bool:
    """Return whether a value can be encoded as it is, so that reading all of it ends soon."""
    try:
        require_plain(value)
    except Exception:  # noqa: BLE001  (the user's objects may raise anything)
        return False
    return True


def _check(values: Iterable[Any], left: int, depth: int) -> int:
    """Check the items of one container.

    Args:
        values: The items.
        left: How many more items the state may have.
        depth: How deep these are nested.

    Returns:
        How many more items the state may have after these.
    """
    if depth >= MAX_DEPTH:
        raise NotPlainError
    for value in values:
        kind = type(value)  # pyright: ignore[reportUnknownVariableType]
        if kind is float:
            continue
        if kind is dict:
            left -= len(value) + CONTAINER_ITEMS
            if left < 0 or not (_known_keys.issuperset(value) or _has_short_keys(value)):
                raise NotPlainError
            if not _LEAVES.issuperset(map(type, items := value.values())):
                left = _check(items, left, depth + 1)
        elif kind is list or kind is tuple:
            left -= len(value) + CONTAINER_ITEMS
            if left < 0:
                raise NotPlainError
            if len(value) > _SHORT_ARRAY and type(value[0]) is float and _can_be_added(value):
                continue
            if not _LEAVES.issuperset(map(type, value)):
                left = _check(value, left, depth + 1)
        elif kind is str:
            if len(value) >= _SHORT_TEXT_CHARACTERS:
                left = _check_text(value, left)
        elif kind is int:
            if not -(2**63) <= value < 2**63:
                raise NotPlainError
        elif kind is not bool and value is not None:
            left = _check_unusual(value, left)
    if left < 0:
        raise NotPlainError
    return left


def _can_be_added(items: Iterable[Any]) -> bool:
    """Return whether all items are numbers, by the fastest check that there is.

    The encoder refuses objects that are no numbers and can nevertheless be added to one.
    """
    try:
        return type(sum(items)) is float
    except Exception:  # noqa: BLE001  (the user's objects may raise anything)
        return False


def _check_text(text: str, left: int) -> int:
    if len(text) > _LONGEST_TEXT_CHARACTERS:
        raise NotPlainError
    return left - len(text) // _CHARACTERS_PER_ITEM


def _check_unusual(value: Any, left: int) -> int:
    """Check a number or a text of a subclass, or an array of numbers."""
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return left
    if isinstance(value, str):
        return _check_text(value, left)
    if is_number_array(value) or is_c_number_array(value):
        return left - item_count(value) - CONTAINER_ITEMS
    if not isinstance(value, float):
        raise NotPlainError
    return left


def _has_short_keys(value: dict[Any, Any]) -> bool:
    """Check the keys of a dict and remember them."""
    for key in value:
        kind = type(key)  # pyright: ignore[reportUnknownVariableType]
        if kind is str:
            is_short = len(key) <= _SHORT_KEY_CHARACTERS
        elif kind is int:
            is_short = -(2**63) <= key < 2**63
        else:
            is_short = key is None or kind is bool or kind is float
        if not is_short:
            return False
        if len(_known_keys) < _MAX_KNOWN_KEYS:
            _known_keys.add(key)
    return True
