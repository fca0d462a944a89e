"""A published state as JSON text that SQLite can always read, of at most 1,000,000 bytes.

JSON has no NaN, no infinity and no bytes, and SQLite before 3.42 fails on every row whose text
contains a NaN. A row that grows without limit stops the control loop. So a state that is not plain
is cleaned first (`json_cleaning` has the limits and what is stored instead), and the column
`replaced` names what was replaced or cut.

Stored as their plain counterparts, and not named in `replaced`, are numpy scalars and arrays;
numbers, arrays and structures of ctypes, which Webots' getters return; Webots' lidar points and
radar targets; dataclasses, enums, tuples, sets, ranges, deques, dates, paths, UUIDs, decimals and
keys that are not text. Integers beyond 64 bits become the nearest float.
"""

from __future__ import annotations

import json
import sys
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.conversion import MAX_ITEMS, is_c_number_array, is_number_array, item_count
from webots_mcp.bridge.json_cleaning import Cleaner
from webots_mcp.bridge.non_finite import remember_non_finite, without_non_finite
from webots_mcp.bridge.plain_values import NotPlainError, is_plain, require_plain
from webots_mcp.bridge.state_shapes import ShapeOfLast

orjson: Any
try:
    import orjson
except ImportError:
    orjson = None

MAX_ROW_BYTES: Final = 1_000_000
_USUAL_ROW_CHARACTERS: Final = 16_000  # of such a row no text has to be checked or cut
# Numpy's type codes. Half and single floats are not here: orjson writes them with fewer digits.
_ORDINARY_NUMBERS: Final = frozenset("?bBhHiIlLqQd")
_WITH_ITEMS: Final = frozenset((dict, list, tuple))  # in which a plain value may hold a None
_CONTAINERS: Final = (dict, list, tuple, set, frozenset, deque)


class Encoded(NamedTuple):
    """JSON text, and what had to be replaced or cut in it.

    Attributes:
        text: The JSON text.
        replaced: Maps dotted paths to what stood there.
        unnamed: Number of further places that `replaced` does not name.
    """

    text: str
    replaced: dict[str, str]
    unnamed: int = 0

    @property
    def replaced_text(self) -> str | None:
        """The value of the column `replaced`: null if nothing was replaced."""
        return _replaced_text(tuple(self.replaced.items())) if self.replaced else None


@lru_cache(maxsize=8)  # mostly the same in each row
def _replaced_text(replaced: tuple[tuple[str, str], ...]) -> str:
    return _encode_with_json(dict(replaced))


def encode(state: object) -> Encoded:
    """Encode a state as fast as its content allows; the state itself is never changed."""
    try:
        require_plain(state)
        return _encode_plain(state)
    except Exception:  # noqa: BLE001  (the cleaner finds and names what cannot be encoded)
        encoded = _clean_and_encode(state)
        if not encoded.unnamed:
            with suppress(RuntimeError):  # another thread changes the user's dict
                remember_non_finite(state, encoded.replaced)
        return encoded


class StateEncoder:
    """Encodes states as `encode` does, in two thirds of the time while their keys stay the same.

    A shape is learned only from a state that passed the check of `encode`. So of a state of the
    same shape only what may differ is checked: the kinds of its values, large integers, long texts
    and numbers that are not finite.
    """

    def __init__(self) -> None:
        self._last = ShapeOfLast()

    def encode(self, state: object) -> Encoded:
        """Encode a state as fast as its content allows; the state itself is never changed."""
        if (shape := self._last.shape) is not None:
            text = _encode_alike(state, shape.read)
            if text is not None:
                return Encoded(text, {})
        encoded = encode(state)
        if encoded.replaced or len(encoded.text) > _USUAL_ROW_CHARACTERS:
            self._last.learn_seldom()
        self._last.learn(state, is_plain)
        return encoded


def plain(value: Any) -> Any:
    """Return what a row holds of a value, in JSON's terms; numbers of numpy may still be NaN."""
    is_ordinary = is_number_array(value) and value.dtype.char in _ORDINARY_NUMBERS
    if is_ordinary and item_count(value) <= MAX_ITEMS:
        return value.tolist()
    return json.loads(encode(value).text)


def text_of(value: object) -> str:
    """Return the text of a value for a person; for a large one its JSON, which is limited."""
    if isinstance(value, str):
        return value
    is_large = issubclass(type(value), _CONTAINERS) and not is_plain(value)
    return encode(value).text if is_large else str(value)


def _encode_plain(state: object) -> Encoded:
    """Encode a state that passed the check.

    Raises:
        NotPlainError: If its text is too long.
        Exception: If it holds what the encoder does not know.
    """
    replaced: dict[str, str] = {}
    state, null_count = without_non_finite(state, replaced)
    text = _encode_with_orjson(state, null_count) or _encode_with_json(state)
    if (len(text) if text.isascii() else len(text.encode())) > MAX_ROW_BYTES:
        raise NotPlainError
    return Encoded(text, replaced)


def _encode_alike(state: object, read: Callable[[object], tuple[Any, ...]]) -> str | None:
    """Encode a state of a known shape; return None if it has another one or needs more checks."""
    try:
        values = read(state)
        integers = [value for value in values if value.__class__ is int]
        if integers and (min(integers) < -(2**63) or max(integers) >= 2**63):
            return None
        if orjson is None:
            text = _encode_with_json(state)
            if not text.isascii():
                text.encode()  # fails where half a surrogate pair stands
        else:
            data: bytes = orjson.dumps(state)
            nulls = data.count(b"null")
            if nulls and nulls != values.count(None):  # a NaN became one, or a text holds the word
                return None
            text = data.decode()
    except Exception:  # noqa: BLE001  (another shape, or an object of the user's raises)
        return None
    return text if len(text) <= _USUAL_ROW_CHARACTERS else None


def _clean_and_encode(state: object) -> Encoded:
    """Encode a state with replacements and cuts; a mapping that cannot be read is an empty row."""
    cleaner = Cleaner()
    cleaned = cleaner.clean(state)
    if cleaned is None and isinstance(state, Mapping):
        cleaned = {}
    # A cleaned state has no NaN that orjson would turn into null.
    text = _encode_with_json(cleaned) if orjson is None else orjson.dumps(cleaned).decode()
    return Encoded(text, cleaner.replaced, cleaner.unnamed)


def _encode_with_orjson(state: object, null_count: int) -> str | None:
    """Encode with orjson, which turns a NaN silently into null.

    Args:
        state: What to encode.
        null_count: Number of nulls that were put into it for numbers that are not finite.

    Returns:
        The text, or None if orjson cannot encode the state or may have met a NaN.
    """
    if orjson is None:
        return None
    # At the first array of another kind orjson would import numpy, which takes a quarter of a
    # second. A state has no arrays of numpy if it was never imported.
    options = orjson.OPT_SERIALIZE_NUMPY if "numpy" in sys.modules else 0
    try:
        text = orjson.dumps(state, _in_lists, options)
    except Exception:  # noqa: BLE001  (the user's objects may raise anything; `json` comes next)
        return None
    nulls = text.count(b"null")
    return text.decode() if nulls == null_count or nulls == _count_none(state) else None


def _count_none(value: Any) -> int:
    """Return how many None a plain value holds in its dicts, lists and tuples."""
    kind: Any = value.__class__
    if kind is dict:
        value = value.values()
    elif kind is not list and kind is not tuple:
        return value is None
    count = 0
    for item in value:
        if item is None:
            count += 1
        elif item.__class__ in _WITH_ITEMS:
            count += _count_none(item)
    return count


def _in_lists(value: Any) -> object:
    """Return the values of an array of numbers, for an encoder that does not know its type."""
    if is_number_array(value):
        return value.tolist()
    if is_c_number_array(value):
        return list(value)
    raise NotPlainError


# The check and the cleaner limit the depth, so nothing contains itself. Without a check for that
# the encoder is 8 % faster.
_encode_with_json: Final = json.JSONEncoder(
    check_circular=False,
    allow_nan=False,
    ensure_ascii=False,
    separators=(",", ":"),
    default=_in_lists,
).encode
