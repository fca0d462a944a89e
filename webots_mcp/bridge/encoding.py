"""A published state as JSON text that SQLite can always read, of bounded size.

JSON has no NaN, no infinity and no bytes, and SQLite before 3.42 fails on every row whose text
contains a NaN. A row that grows without bounds stops the control loop. So what JSON cannot hold is
replaced, what is too large is cut, and the column `replaced` names the path and the original value:

    published value                    stored          replaced
    NaN, infinity, -infinity           null            "nan", "inf", "-inf"
    several, all of one kind, in       null each       "lidar.*": "inf" (every null in it)
    one array of numbers
    integer beyond all floats          null            "int"
    bytes, up to 1,024                 base64 text     "bytes"
    bytes, more                        null            "bytes[2000]"
    array or dict with more items      null            "array[307200]", "dict[1000000]"
    than there is room for
    state with more keys than there    the first       "": "dict[1000000]"
    is room for                        1,000
    dict whose keys are more text      its beginning   "dict cut after 900"
    than there is room for
    array of over 1,000,000 bytes      null            "array of 40000000 bytes"
    nested over 20 levels              null            "too deep"
    text over 100,000 bytes            its beginning   "text[50000000]"
    key over 200 characters            its beginning   "key[5000]"
    text with a lone surrogate         with "?"        "surrogate"
    key that has no text               "<Handle>"      "key"
    data of ctypes, also a pointer     null            "type c_double"
    any other object                   null            "type Socket"
    object after those before it took  null            "type Socket: no time left"
    10 ms of processor time
    object that fails while it is read null            "type Socket: why"
    row that fails as a whole          {}              "": why

A row has room for 20,000: an item of an array of numbers takes 1, any other value (a number, a
text, an array, a dict, ...) takes 5. All texts of a row take at most 300,000 bytes of JSON, all
keys 150,000. Where there is no room for everything, the levels near the top come first. `replaced`
names up to 1,000 places; the empty path has the number of further ones: "4000 more". A robot rarely
publishes a tenth of that. A state that contains itself is cut like any other nested too deeply.

Numpy scalars and arrays, Webots' lidar points and radar targets, dataclasses, enums, tuples, sets,
ranges, deques, dates, paths, UUIDs, decimals and keys that are not text are stored as their plain
JSON counterparts and are not named in `replaced`. Neither are integers beyond 64 bits: they become
the nearest float, as SQLite would read them anyway.
"""

from __future__ import annotations

import io
import json
import pickle
from collections import deque
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.cleaning import (
    MAX_DEPTH,
    MAX_ROOM,
    ROOM_OF_A_VALUE,
    Cleaner,
    failure,
    is_number_array,
    item_count,
)

# Numpy's type codes. Half and single floats are not here: orjson writes them with fewer digits.
_ORDINARY_NUMBERS: Final = frozenset("?bBhHiIlLqQd")

orjson: Any
try:
    import orjson
except ImportError:
    orjson = None

MAX_ROW_BYTES: Final = 1_000_000
MAX_PLAIN_VALUES: Final = MAX_ROOM // ROOM_OF_A_VALUE
_CHARACTERS_OF_A_VALUE: Final = 16  # a text takes the room of one more value for each so many
_SHORT_KEY_CHARACTERS: Final = 60
_MOST_SHORT_KEYS: Final = 10_000
# Types that take the room of one value and need no further check.
_LEAVES: Final = frozenset((float, bool, type(None)))
_SHORT_ARRAY: Final = 16
_MANY: Final = (dict, list, tuple, set, frozenset, deque)

# Keys that were checked before: every row has the same ones, so most checks are one set operation.
_short_keys: set[object] = set()


class Encoded(NamedTuple):
    """JSON text, and what had to be replaced or cut in it: dotted path to kind.

    Attributes:
        unnamed: How many more there are that `replaced` does not name.
    """

    text: str
    replaced: dict[str, str]
    unnamed: int = 0

    @property
    def replaced_text(self) -> str | None:
        """The value of the column `replaced`: null where nothing was replaced."""
        return _encode_plain(self.replaced) if self.replaced else None


class _NotPlainError(Exception):
    """The value is too large, or of a type that only the slow path can encode."""


def encode(state: object) -> Encoded:
    """Encode a state, as fast as its content allows; the state itself is never changed."""
    try:
        _look((state,), MAX_PLAIN_VALUES, 0)
        return _encode_looked_at(state)
    except Exception:  # noqa: BLE001  (the slow path finds and names what cannot be encoded)
        return _encode_replacing(state)


def copy_or_encode(state: object) -> bytes | Encoded:
    """A copy from which `encode_copy` makes the text that `encode` would, or that text itself.

    To copy costs less than to encode; only dicts of plain values are copied.
    """
    if state.__class__ is not dict:
        return encode(state)
    file = io.BytesIO()
    try:
        _look((state,), MAX_PLAIN_VALUES, 0)
        _Copier(file, pickle.HIGHEST_PROTOCOL).dump(state)
    except Exception:  # noqa: BLE001  (whatever an object of the user's does)
        return encode(state)
    return file.getvalue()


def encode_copy(copy: bytes) -> Encoded:
    """Encode a state as it was when it was copied."""
    return encode(pickle.loads(copy))


def plain(value: Any) -> Any:
    """What a row holds of a value, in JSON's terms; numbers of numpy may still be NaN."""
    usual = is_number_array(value) and value.dtype.char in _ORDINARY_NUMBERS
    if usual and item_count(value) <= MAX_ROOM:
        return value.tolist()
    return json.loads(encode(value).text)


def _is_small(value: object) -> bool:
    """Whether a look at all of it, as `str` takes, ends soon."""
    try:
        _look((value,), MAX_PLAIN_VALUES, 0)
    except Exception:  # noqa: BLE001  (whatever an object of the user's does)
        return False
    return True


def text_of(value: object) -> str:
    """The text of a value for a person; for a large one its JSON, whose length is bounded."""
    if isinstance(value, str):
        return value
    is_large = issubclass(type(value), _MANY) and not _is_small(value)
    return encode(value).text if is_large else str(value)


# -- the fast path: plain states ---------------------------------------------------------------


def _look(values: Iterable[Any], left: int, depth: int) -> int:
    """Check size and types before encoding, since the encoder has no bounds of its own.

    Args:
        values: The items of one container.
        left: How many more values there may be.
        depth: How deep these are nested.

    Returns:
        How many more there may be after these.

    Raises:
        _NotPlainError: There are too many, or one is of an unusual type.
        Exception: Whatever an object raises while it is read.
    """
    if depth >= MAX_DEPTH:
        raise _NotPlainError
    for value in values:
        kind = type(value)  # pyright: ignore[reportUnknownVariableType]
        if kind is float:
            continue
        if kind is dict:
            left -= len(value)
            if left < 0 or not (_short_keys.issuperset(value) or _has_short_keys(value)):
                raise _NotPlainError
            if not _LEAVES.issuperset(map(type, items := value.values())):
                left = _look(items, left, depth + 1)
        elif kind is list or kind is tuple:
            left -= len(value)
            if left < 0:
                raise _NotPlainError
            if len(value) > _SHORT_ARRAY and type(value[0]) is float and _adds_up(value):
                continue
            if not _LEAVES.issuperset(map(type, value)):
                left = _look(value, left, depth + 1)
        elif kind is str:
            if len(value) >= _CHARACTERS_OF_A_VALUE:
                left -= len(value) // _CHARACTERS_OF_A_VALUE
        elif kind is int:
            if not -(2**63) <= value < 2**63:
                raise _NotPlainError
        elif kind is not bool and value is not None:
            left = _look_at_number(value, left)
    if left < 0:
        raise _NotPlainError
    return left


def _adds_up(items: Iterable[Any]) -> bool:
    """Whether all are numbers, in the fastest possible check.

    Objects that are not numbers and can be added to one are refused by the encoder later.
    """
    try:
        return type(sum(items)) is float
    except Exception:  # noqa: BLE001  (the user's objects may raise anything)
        return False


def _has_short_keys(value: dict[Any, Any]) -> bool:
    for key in value:
        short = len(key) <= _SHORT_KEY_CHARACTERS if type(key) is str else _is_plain_key(key)
        if not short:
            return False
        if len(_short_keys) < _MOST_SHORT_KEYS:
            _short_keys.add(key)
    return True


def _is_plain_key(key: object) -> bool:
    if type(key) is int:
        return -(2**63) <= key < 2**63
    return key is None or type(key) in (bool, float)


def _look_at_number(value: Any, left: int) -> int:
    """Check a number or a text of a subclass, or an array of numbers."""
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return left
    if isinstance(value, str):
        return left - len(value) // _CHARACTERS_OF_A_VALUE
    if is_number_array(value):
        return left - item_count(value)
    if not isinstance(value, float):
        raise _NotPlainError
    return left


def _encode_looked_at(state: object) -> Encoded:
    text = _encode_with_orjson(state) or _encode_plain(state)
    if (len(text) if text.isascii() else len(text.encode())) > MAX_ROW_BYTES:
        raise _NotPlainError
    return Encoded(text, {})


class _Copier(pickle.Pickler):
    """Copies dicts, lists, tuples, texts, numbers and None, but no subclasses of them.

    The check before does not see subclasses among keys and in long arrays; copies could differ.
    """

    def reducer_override(self, obj: object) -> Any:
        """Refuse whatever is of another type."""
        raise _NotPlainError


def _listed(value: Any) -> object:
    """The values of an array of numbers, for an encoder that does not know it."""
    if not is_number_array(value):
        raise _NotPlainError
    return value.tolist()


def _encode_with_orjson(state: object) -> str | None:
    """None where orjson cannot, or may have turned a NaN silently into null."""
    if orjson is None:
        return None
    try:
        text = orjson.dumps(state, _listed, orjson.OPT_SERIALIZE_NUMPY)
    except Exception:  # noqa: BLE001  (the user's objects may raise anything; `json` comes next)
        return None
    return None if b"null" in text else text.decode()


# Nesting is bounded before, so nothing contains itself; without this check it is 8 % faster.
_encode_plain: Final = json.JSONEncoder(
    check_circular=False,
    allow_nan=False,
    ensure_ascii=False,
    separators=(",", ":"),
    default=_listed,
).encode


# -- the slow path: everything else ------------------------------------------------------------


def _encode_replacing(state: object) -> Encoded:
    """Encode with replacements and cuts; at worst, an empty row that names the reason."""
    cleaner = Cleaner()
    try:
        text = _encode_clean(cleaner.clean(state))
    except Exception as error:  # noqa: BLE001  (the row is there, and says why)
        return Encoded("{}", {"": failure(state, error)})
    if text == "null" and hasattr(state, "keys"):
        return Encoded("{}", cleaner.replaced)  # a mapping that cannot be read at all
    if len(text.encode()) > MAX_ROW_BYTES:
        return Encoded("{}", {"": f"row of {len(text)} characters"})
    return Encoded(text, cleaner.replaced, cleaner.unnamed)


def _encode_clean(state: object) -> str:
    """Encode a cleaned value, where orjson cannot meet a NaN that it would turn into null."""
    return _encode_plain(state) if orjson is None else orjson.dumps(state).decode()
