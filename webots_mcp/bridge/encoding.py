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
    pointer of ctypes                  null            "null pointer",
                                                       "pointer of unknown length"
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

Numpy scalars and arrays, numbers, arrays and structures of ctypes (which Webots' getters return),
Webots' lidar points and radar targets, dataclasses, enums, tuples, sets, ranges, deques, dates,
paths, UUIDs, decimals and keys that are not text are stored as their plain JSON counterparts and
are not named in `replaced`. Neither are integers beyond 64 bits: they become the nearest float, as
SQLite would read them anyway.

Values are copied breadth first: where there is no room for everything, the deepest levels are cut.
"""

from __future__ import annotations

import base64
import enum
import io
import json
import math
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import compress, islice
from json.encoder import encode_basestring
from operator import not_
from typing import Any, Final, NamedTuple, TypeAlias, cast

# -- values of types that JSON does not know -------------------------------------------------------


MOST_ITEMS: Final = 20_000  # of one array or container; a row has no room for more
MOST_ARRAY_BYTES: Final = 1_000_000  # of one array, whose items may be long texts
_MOST_KIND_CHARACTERS: Final = 100

# Classes of Webots' `controller` package whose instances are nothing but their attributes.
_WEBOTS_RECORDS: Final = ("LidarPoint", "RadarTarget", "MouseState", "ContactPoint")
# The codes of ctypes for numbers and flags, for characters, and for addresses: char *, wchar_t *,
# void *, BSTR and PyObject *.
_C_NUMBERS: Final = frozenset("bBhHiIlLqQfdg?v")
_C_CHARACTERS: Final = frozenset("cu")
_C_ADDRESSES: Final = frozenset("zZPXO")
_UNKNOWN_LENGTH: Final = "pointer of unknown length"
MAX_ROOM: Final = MOST_ITEMS
ROOM_OF_A_VALUE: Final = 5  # an item of an array of numbers takes 1
MAX_DEPTH: Final = 20
MAX_BYTES: Final = 1024
MAX_TEXT_BYTES: Final = 100_000
MAX_TEXTS_BYTES: Final = 300_000  # of all texts of a row
MAX_KEYS_BYTES: Final = 150_000  # of all keys of a row
MAX_KEY_CHARACTERS: Final = 200
MAX_NAMED: Final = 1000
_TOP_KEYS: Final = 1000  # of a state that has more keys than there is room for
_MOST_PATHS_CHARACTERS: Final = 50_000  # of all paths of a row
_MOST_REASON_CHARACTERS: Final = 200
_LONGEST_ESCAPE: Final = 6  # bytes of JSON for one character, as in \u0000
_MOST_KEY_BITS: Final = 1000  # the text of a longer integer takes long to make
# For all objects of a row together, since converting them runs code of unknown cost. Processor
# time: by the wall clock, another process that runs in between would cost values.
LONGEST_S: Final = 0.01
# Numpy's type codes. Half and single floats are not here: orjson writes them with fewer digits.
_ORDINARY_NUMBERS: Final = frozenset("?bBhHiIlLqQd")
MAX_ROW_BYTES: Final = 1_000_000
MAX_PLAIN_VALUES: Final = MAX_ROOM // ROOM_OF_A_VALUE
_CHARACTERS_OF_A_VALUE: Final = 16  # a text takes the room of one more value for each so many
_SHORT_KEY_CHARACTERS: Final = 60
_MOST_SHORT_KEYS: Final = 10_000
# Types that take the room of one value and need no further check.
_LEAVES: Final = frozenset((float, bool, type(None)))
_SHORT_ARRAY: Final = 16
_MANY: Final = (dict, list, tuple, set, frozenset, deque)
_NON_FINITE: Final = frozenset(("nan", "inf", "-inf"))
_MOST_NON_FINITE_PATHS: Final = 64
_LONGEST_PATH_CHARACTERS: Final = 500


class NoCounterpartError(TypeError):
    """The value cannot be stored; the text names what it was."""


class _Pointer:
    """Stands for a pointer that ctypes would follow as soon as it is read."""


def convert(value: Any) -> object:
    """The JSON counterpart of a value; its items may have to be converted in their turn.

    Raises:
        NoCounterpartError: It has no counterpart, or more items than a row takes.
        Exception: Whatever the value raises while it is read.
    """
    if isinstance(value, _Pointer):
        raise NoCounterpartError(_UNKNOWN_LENGTH)
    if type(value) in (type, memoryview) or isinstance(value, type):
        raise NoCounterpartError(f"type {kind_name(value)}")
    if (ctypes := _ctypes_of(value)) is not None:
        return _read_c_data(ctypes, value)
    if type(value).__name__ in _WEBOTS_RECORDS:
        attributes: dict[str, object] = value.__dict__
        return {name: item for name, item in attributes.items() if not name.startswith("_")}
    _require_few(item_count(value))
    _require_short(value)
    for name, conversion in _CONVERSIONS:
        if hasattr(value, name):
            return conversion(value)
    raise NoCounterpartError(f"type {kind_name(value)}")


def kind_name(value: object) -> str:
    """The name of its class, cut: a class may have a name of any length."""
    return type(value).__name__[:_MOST_KIND_CHARACTERS]


def item_count(value: Any) -> int:
    """The number of items of an array or a container; 0 of anything else.

    Numpy's `size` is not used: on classes that are neither it may be a method or a tuple.
    """
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return math.prod(cast("tuple[int, ...]", shape))
    return len(value) if hasattr(value, "__len__") else 0


def _require_few(count: int) -> None:
    if count > MOST_ITEMS:
        raise NoCounterpartError(f"array[{count}]")


def _require_short(array: Any) -> None:
    size_bytes = getattr(array, "nbytes", 0)
    if isinstance(size_bytes, int) and size_bytes > MOST_ARRAY_BYTES:
        raise NoCounterpartError(f"array of {size_bytes} bytes")


def is_number_array(value: Any) -> bool:
    """Whether it is a numpy array, or a scalar, of nothing but numbers or booleans."""
    return getattr(getattr(value, "dtype", None), "kind", None) in ("b", "i", "u", "f")


# -- data of ctypes ----------------------------------------------------------------------------


def _ctypes_of(value: object) -> Any:
    """The ctypes module if the value is of one of its types, else None; it is never imported here.

    All data of ctypes derives from one class, which has no public name.
    """
    ctypes = sys.modules.get("ctypes")
    if ctypes is None:
        return None
    is_reference = type(value).__name__ == "CArgObject"  # what byref() returns
    return ctypes if is_reference or isinstance(value, ctypes.Structure.__mro__[1]) else None


def _read_c_data(ctypes: Any, value: Any) -> object:
    """Read numbers, arrays and structures; a pointer is never followed, not even to a C string.

    What it points to may have been freed, and reading it would crash the controller.

    Raises:
        NoCounterpartError: It is a pointer, or an array of more items than a row takes.
    """
    if isinstance(value, (ctypes.Structure, ctypes.Union)):
        return dict(_read_c_fields(value))
    if isinstance(value, ctypes.Array):
        return _read_c_array(value)
    code = getattr(value, "_type_", None)
    if not isinstance(code, str) or code in _C_ADDRESSES:
        raise NoCounterpartError(_UNKNOWN_LENGTH if value else "null pointer")
    return value.value


def _read_c_array(array: Any) -> object:
    _require_few(len(array))
    code = getattr(array._type_, "_type_", None)
    if code == "c":
        return bytes(array)
    if code == "u":
        return array.value
    return [_Pointer()] * len(array) if _is_followed(array._type_) else list(array)


def _read_c_fields(structure: Any) -> Iterator[tuple[str, object]]:
    for cls in reversed(type(structure).__mro__):
        for name, kind, *_ in vars(cls).get("_fields_", ()):
            yield name, _Pointer() if _is_followed(kind) else getattr(structure, name)


def _is_followed(kind: Any) -> bool:
    """Whether ctypes follows such a pointer by itself as soon as the field is read."""
    code = getattr(kind, "_type_", None)
    return isinstance(code, str) and code in _C_ADDRESSES


def _is_c_number_array(value: Any) -> bool:
    """Whether it is an array of ctypes of nothing but numbers, such as a position of Webots."""
    ctypes = sys.modules.get("ctypes")
    if ctypes is None or not isinstance(value, ctypes.Array):
        return False
    code = getattr(value._type_, "_type_", None)
    return isinstance(code, str) and code in _C_NUMBERS


# -- everything else ---------------------------------------------------------------------------

# By the object's attributes, not by its type: importing numpy, dataclasses, datetime and pathlib to
# test types would slow down every controller's start.
_CONVERSIONS: Final[tuple[tuple[str, Callable[[Any], object]], ...]] = (
    ("tolist", lambda array: _listed(array)),  # numpy scalars and arrays, array.array
    ("__dataclass_fields__", lambda data: {name: getattr(data, name) for name in _fields(data)}),
    ("_value_", lambda member: member.value),  # enum
    ("isoformat", lambda moment: moment.isoformat()),
    ("total_seconds", lambda span: span.total_seconds()),
    ("__fspath__", lambda path: path.__fspath__()),
    ("urn", str),  # UUID
    ("__float__", float),  # decimal, fraction
    ("keys", lambda mapping: {key: mapping[key] for key in _bounded(mapping.keys())}),
    ("isdisjoint", lambda items: list(_bounded(items))),  # set, frozenset
    ("__reversed__", lambda items: list(_bounded(items))),  # deque, range, sequences
)


def _listed(array: Any) -> object:
    """A numpy array or scalar as plain values."""
    plain = array.tolist()  # which returns a long double itself: there is no plain number for it
    return float(plain) if type(plain) is type(array) else plain


def _fields(data: Any) -> Iterable[str]:
    """A dataclass's fields, without ClassVar and InitVar ones."""
    fields: dict[str, Any] = data.__dataclass_fields__
    return (name for name, field in fields.items() if str(field._field_type) == "_FIELD")


def _bounded(items: Iterable[Any]) -> Iterable[Any]:
    """As many items as `len` says: an object's own iterator may be endless."""
    return islice(items, min(MOST_ITEMS, item_count(items) or MOST_ITEMS))


# Where a value is: a linked list, since most places are never named and need no path text.
Place: TypeAlias = "tuple[Place | None, str | int]"


class _Pairs(list[tuple[Any, Any]]):
    """Items that were taken from a mapping, whose keys need not be hashable."""

    def items(self) -> Iterable[tuple[Any, Any]]:
        """As a mapping gives them."""
        return self


class _Unfilled(NamedTuple):
    """A copy whose items are still to come."""

    cleaned: dict[str, object] | list[object]
    value: object
    items: Iterable[Any]
    place: Place
    depth: int


class Cleaner:
    """Copies one value, and names in `replaced` what it had to replace or to cut.

    Attributes:
        replaced: Dotted path to kind.
        unnamed: How many more there are that `replaced` does not name.
    """

    def __init__(self) -> None:
        self.replaced: dict[str, str] = {}
        self.unnamed = 0
        self._room = MAX_ROOM
        self._texts_bytes = MAX_TEXTS_BYTES
        self._keys_bytes = MAX_KEYS_BYTES
        self._paths = _MOST_PATHS_CHARACTERS
        self._unfilled: deque[_Unfilled] = deque()
        self._until_s = time.thread_time() + LONGEST_S

    def clean(self, state: object) -> object:
        """The plain counterpart of any value; an item that fails is left out, and no other."""
        cleaned = self._value(state, (None, ""), 0)
        while self._unfilled:
            self._fill(self._unfilled.popleft())
        if self.unnamed:
            named = self.replaced.get("")
            more = f"{self.unnamed} more"
            self.replaced[""] = f"{named}; {more}" if named else more
        return cleaned

    def _value(self, value: Any, place: Place, depth: int) -> object:
        try:
            return self._plain(value, place, depth)
        except Exception as error:  # noqa: BLE001  (the user's objects may raise anything)
            return self._replace(place, failure(value, error))

    def _plain(self, value: Any, place: Place, depth: int) -> object:
        kind = type(value)  # pyright: ignore[reportUnknownVariableType]
        if value is None or kind is bool:
            return value
        if kind is float:
            return value if math.isfinite(value) else self._replace(place, str(value))
        if isinstance(value, int):
            return self._int(int(value), place)
        if isinstance(value, float):
            return self._plain(float(value), place, depth)
        if isinstance(value, str):
            return self._text(str(value.value) if isinstance(value, enum.Enum) else value, place)
        if depth >= MAX_DEPTH:
            return self._replace(place, "too deep")
        if kind is dict:
            return self._mapping(cast("dict[object, object]", value), place, depth)
        if isinstance(value, (list, tuple, set, frozenset, deque)):
            return self._items(cast("Iterable[object]", value), place, depth)
        if isinstance(value, Mapping):
            return self._own_mapping(cast("Mapping[object, object]", value), place, depth)
        return self._object(value, place, depth)

    # -- numbers and texts ---------------------------------------------------------------------

    def _int(self, value: int, place: Place) -> int | float | None:
        if -(2**63) <= value < 2**63:
            return value
        try:
            return float(value)
        except OverflowError:
            return self._replace(place, "int")

    def _text(self, value: str, place: Place) -> str:
        most_bytes = min(MAX_TEXT_BYTES, self._texts_bytes)
        text = _without_surrogates(value[:most_bytes])
        if (size_bytes := _size_bytes(text)) > most_bytes:
            text = text[: most_bytes // _LONGEST_ESCAPE]
            size_bytes = _size_bytes(text)
        self._texts_bytes -= size_bytes
        if text != value:
            self._name(place, "surrogate" if len(text) == len(value) else f"text[{len(value)}]")
        return text

    def _bytes(self, value: memoryview, place: Place) -> str | None:
        count = value.nbytes
        if count > MAX_BYTES:
            return self._replace(place, f"bytes[{count}]")
        text = base64.b64encode(value.tobytes()).decode("ascii")
        if len(text) > self._texts_bytes:
            return self._replace(place, f"bytes[{count}]")
        self._texts_bytes -= len(text)
        self._name(place, "bytes")
        return text

    # -- dicts ---------------------------------------------------------------------------------

    def _mapping(self, value: Mapping[object, object] | _Pairs, place: Place, depth: int) -> object:
        count = len(value)
        if not self._take(ROOM_OF_A_VALUE * count):
            self._name(place, f"dict[{count}]")
            if depth:
                return None
            count = _TOP_KEYS
            self._take(ROOM_OF_A_VALUE * count)
        cleaned: dict[str, object] = {}
        items = islice(value.items(), count)
        self._unfilled.append(_Unfilled(cleaned, value, items, place, depth + 1))
        return cleaned

    def _own_mapping(self, value: Mapping[object, object], place: Place, depth: int) -> object:
        """The items of a type of the user: until one fails, or as its length says if too many."""
        most = max(self._room // ROOM_OF_A_VALUE, _TOP_KEYS)
        if (count := len(value)) > most:
            return self._mapping(value, place, depth)
        found = _Pairs()
        try:
            found.extend((key, item) for key, item in islice(value.items(), most + 1))
        except Exception as error:  # noqa: BLE001  (as for any value)
            self._name(place, failure(value, error))
        if len(found) > most:
            del found[count:]
            self._name(place, f"dict cut after {count}")
        return self._mapping(found, place, depth)

    def _fill(self, unfilled: _Unfilled) -> None:
        cleaned, value, items, place, depth = unfilled
        try:
            if isinstance(cleaned, dict):
                self._fill_dict(cleaned, items, place, depth)
            else:
                cleaned.extend(self._value(item, (place, i), depth) for i, item in enumerate(items))
        except Exception as error:  # noqa: BLE001  (as for any value)
            self._name(place, failure(value, error))

    def _fill_dict(
        self, cleaned: dict[str, object], items: Iterable[Any], place: Place, depth: int
    ) -> None:
        for key, item in items:
            name = self._key(key, place)
            self._keys_bytes -= _size_bytes(name)
            if self._keys_bytes < 0:
                self._name(place, f"dict cut after {len(cleaned)}")
                return
            cleaned[name] = self._value(item, (place, name), depth)

    def _key(self, key: object, place: Place) -> str:
        try:
            text = key_text(key)
        except Exception:  # noqa: BLE001  (as with values: only this key is replaced)
            name, kind = f"<{kind_name(key)}>", "key"
        else:
            name, kind = _without_surrogates(text[:MAX_KEY_CHARACTERS]), "surrogate"
            if name == text:
                return name
            if len(text) > MAX_KEY_CHARACTERS:
                kind = f"key[{len(text)}]"
        self._name((place, name), kind)
        return name

    # -- arrays --------------------------------------------------------------------------------

    def _items(self, value: Iterable[object], place: Place, depth: int) -> object:
        if (count := item_count(value)) > self._room:
            return self._replace(place, f"array[{count}]")
        items: list[Any] = list(islice(value, count))
        kinds = set(map(type, items))
        if _are_numbers(items, kinds):
            self._take(count)
            return self._numbers(_plain_numbers(items, kinds), place)
        count, room = _nested(items)
        if room > self._room:
            return self._replace(place, f"array[{count}]")
        self._take(ROOM_OF_A_VALUE * len(items))
        cleaned: list[object] = []
        self._unfilled.append(_Unfilled(cleaned, value, items, place, depth + 1))
        return cleaned

    def _numbers(self, items: list[Any], place: Place) -> list[Any]:
        """Copy an array of numbers: thousands of them (lidars), so without a call for each."""
        plain, names = _replace_non_finite(items)
        for name, kind in names:
            self._name((place, name), kind)
        return plain

    # -- everything else -----------------------------------------------------------------------

    def _object(self, value: Any, place: Place, depth: int) -> object:
        if isinstance(value, (bytes, bytearray, memoryview)):
            return self._bytes(memoryview(cast("bytes", value)), place)
        if time.thread_time() > self._until_s:
            return self._replace(place, f"type {kind_name(value)}: no time left")
        if (count := item_count(value)) > self._room:
            return self._replace(place, f"array[{count}]")
        return self._plain(convert(value), place, depth + 1)

    def _take(self, room: int) -> bool:
        if room > self._room:
            return False
        self._room -= room
        return True

    def _replace(self, place: Place, kind: str) -> None:
        self._name(place, kind)

    def _name(self, place: Place, kind: str) -> None:
        if (
            len(self.replaced) + self.unnamed < MAX_NAMED
            and len(path := _path(place)) <= self._paths
            and path not in self.replaced  # as {"a.b": NaN, "a": {"b": NaN}} has
        ):
            self._paths -= len(path)
            self.replaced[path] = kind
        else:
            self.unnamed += 1


def _replace_non_finite(items: list[Any]) -> tuple[list[Any], list[tuple[str | int, str]]]:
    """The numbers with null for those that are not finite, and the names of these.

    Returns:
        The items, and pairs of index and kind; ("*", kind) if all are of one kind.
    """
    finite = list(map(math.isfinite, items))
    kinds = set(map(str, compress(items, map(not_, finite))))
    if not kinds:
        return items, []
    plain = [item if good else None for item, good in zip(items, finite, strict=True)]
    if len(kinds) == 1:
        return plain, [("*", kinds.pop())]
    return plain, [(i, str(item)) for i, item in compress(enumerate(items), map(not_, finite))]


def _path(place: Place) -> str:
    """Dotted; empty for the whole state."""
    names: list[str] = []
    above, name = place
    while above is not None:
        names.append(str(name))
        above, name = above
    return ".".join(reversed(names))


def key_text(key: object) -> str:
    """Object keys as the JSON encoder writes them; any other key as its text."""
    if key is None or isinstance(key, bool):
        return {None: "null", True: "true", False: "false"}[key]
    if isinstance(key, str):  # also enums of it, whose own text is another
        return str.__str__(key)
    if isinstance(key, int):
        _require_length(key.bit_length(), _MOST_KEY_BITS)
        return int.__repr__(key)
    if issubclass(type(key), (tuple, frozenset)):
        _require_length(len(cast("tuple[object, ...]", key)), MAX_KEY_CHARACTERS)
    return str(key)


def _require_length(length: int, limit: int) -> None:
    if length > limit:
        raise NoCounterpartError(f"its text is too long: {length}")


def _size_bytes(text: str) -> int:
    """As JSON, without the quotes."""
    quoted = encode_basestring(text)
    return (len(quoted) if quoted.isascii() else len(quoted.encode())) - 2


def _without_surrogates(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def _are_numbers(items: list[Any], kinds: set[type]) -> bool:
    """Whether all are numbers, and no integer is beyond 64 bits."""
    if not kinds or not all(issubclass(kind, (float, int)) for kind in kinds):
        return False
    if not any(issubclass(kind, int) for kind in kinds):
        return True
    return all(isinstance(item, float) or -(2**63) <= item < 2**63 for item in items)


def _plain_numbers(items: list[Any], kinds: set[type]) -> list[Any]:
    """The numbers as Python's own types, where they are of a subclass (numpy's, enums)."""
    return items if kinds <= {float, int, bool} else [_plain_number(item) for item in items]


def _plain_number(item: Any) -> float:
    if isinstance(item, float):
        return float(item)
    return item if isinstance(item, bool) else int(item)


def _nested(items: list[Any]) -> tuple[int, int]:
    """The number of items of a list of equal lists, judged by the first ones, and their room."""
    count, lists, inside = len(items), 0, items
    for _ in range(MAX_DEPTH):
        if not _are_equal_lists(inside):
            break
        lists += count
        inside = cast("list[Any]", inside[0])
        count *= len(inside)
    numeric = lists and inside and isinstance(inside[0], (float, int))
    return count, ROOM_OF_A_VALUE * lists + count * (1 if numeric else ROOM_OF_A_VALUE)


def _are_equal_lists(items: list[Any]) -> bool:
    if not items or not all(isinstance(item, (list, tuple)) for item in items):
        return False
    return len(set(map(len, items))) == 1


def failure(value: object, error: Exception) -> str:
    """Why a value is not stored."""
    if isinstance(error, NoCounterpartError):
        return str(error)
    return f"type {kind_name(value)}: {_reason(error)}"


def _reason(error: Exception) -> str:
    """The text of an error, which may be long, or raise as well."""
    try:
        return str(error)[:_MOST_REASON_CHARACTERS]
    except Exception:  # noqa: BLE001  (the user's exception may raise in its __str__)
        return kind_name(error)


# -- their JSON ------------------------------------------------------------------------------------


orjson: Any
try:
    import orjson
except ImportError:
    orjson = None


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
        return _replaced_text(tuple(self.replaced.items())) if self.replaced else None


@lru_cache(maxsize=8)  # mostly the same in each row
def _replaced_text(replaced: tuple[tuple[str, str], ...]) -> str:
    return _encode_plain(dict(replaced))


class _NotPlainError(Exception):
    """The value is too large, or of a type that only the slow path can encode."""


def encode(state: object) -> Encoded:
    """Encode a state, as fast as its content allows; the state itself is never changed."""
    try:
        _look((state,), MAX_PLAIN_VALUES, 0)
        return _encode_looked_at(state)
    except Exception:  # noqa: BLE001  (the slow path finds and names what cannot be encoded)
        encoded = _encode_replacing(state)
        _remember_non_finite(state, encoded)
        return encoded


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
    if _is_c_number_array(value):
        return left - item_count(value)
    if not isinstance(value, float):
        raise _NotPlainError
    return left


def _encode_looked_at(state: object) -> Encoded:
    replaced: dict[str, str] = {}
    null_count = 0
    if _path_count and state.__class__ is dict:
        values = cast("dict[str, Any]", state)
        state, null_count = _without_non_finite(values, _non_finite_paths, replaced)
    text = _encode_with_orjson(state, null_count) or _encode_plain(state)
    if (len(text) if text.isascii() else len(text.encode())) > MAX_ROW_BYTES:
        raise _NotPlainError
    return Encoded(text, replaced)


class _Copier(pickle.Pickler):
    """Copies dicts, lists, tuples, texts, numbers and None, but no subclasses of them.

    The check before does not see subclasses among keys and in long arrays; copies could differ.
    """

    def reducer_override(self, obj: object) -> Any:
        """Refuse whatever is of another type."""
        raise _NotPlainError


def _in_lists(value: Any) -> object:
    """The values of an array of numbers, for an encoder that does not know it."""
    if is_number_array(value):
        return value.tolist()
    if _is_c_number_array(value):
        return list(value)
    raise _NotPlainError


def _orjson_options() -> int:
    """Arrays of numpy as they are; orjson would import numpy at the first array of another kind.

    That takes a quarter of a second, and no state has arrays of what was never imported.
    """
    return orjson.OPT_SERIALIZE_NUMPY if "numpy" in sys.modules else 0


def _encode_with_orjson(state: object, null_count: int) -> str | None:
    """None where orjson cannot, or may have turned a NaN silently into null.

    Args:
        state: What to encode.
        null_count: The number of nulls that its text has if no NaN was turned into one.
    """
    if orjson is None:
        return None
    try:
        text = orjson.dumps(state, _in_lists, _orjson_options())
    except Exception:  # noqa: BLE001  (the user's objects may raise anything; `json` comes next)
        return None
    return text.decode() if text.count(b"null") == null_count else None


# Nesting is bounded before, so nothing contains itself; without this check it is 8 % faster.
_encode_plain: Final = json.JSONEncoder(
    check_circular=False,
    allow_nan=False,
    ensure_ascii=False,
    separators=(",", ":"),
    default=_in_lists,
).encode


# -- the fast path: numbers that JSON does not have --------------------------------------------
# A wheel in velocity mode has an infinite target position in each row, a lidar infinities where
# nothing is in reach. The slow path finds them; their paths are remembered, and numbers there are
# replaced in the rows after that before the encoder runs. At any other path the encoder fails, and
# the slow path finds and remembers it too. The paths of all robots of the process are kept
# together: one that a state does not have costs one look-up.


class _PathTree:
    """The remembered paths below one key.

    Attributes:
        path: The keys from the top of the state to here, dotted.
        below: The keys that follow, of a dict at this path.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.below: dict[str, _PathTree] = {}


_non_finite_paths = _PathTree("")
_path_count = 0


def _remember_non_finite(state: object, encoded: Encoded) -> None:
    """Remember where a state that the slow path encoded has numbers that are not finite."""
    global _non_finite_paths, _path_count
    if encoded.unnamed or not encoded.replaced or state.__class__ is not dict:
        return
    if not _NON_FINITE.issuperset(encoded.replaced.values()):
        return  # such states take the slow path for another reason
    found = list(_find_non_finite(cast("dict[object, object]", state), (), 0))
    if len(found) > _MOST_NON_FINITE_PATHS:
        return
    if _path_count + len(found) > _MOST_NON_FINITE_PATHS:
        _non_finite_paths, _path_count = _PathTree(""), 0
    for keys in found:
        tree = _non_finite_paths
        for depth, key in enumerate(keys, 1):
            if key not in tree.below:  # replaced as a whole: another thread may read the old dict
                tree.below = {**tree.below, key: _PathTree(".".join(keys[:depth]))}
            tree = tree.below[key]
        _path_count += 1


def _find_non_finite(
    values: dict[Any, Any], above: tuple[str, ...], length: int
) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        if type(key) is not str or (longer := length + len(key) + 1) > _LONGEST_PATH_CHARACTERS:
            continue
        kind: Any = value.__class__
        if kind is dict:
            yield from _find_non_finite(value, (*above, key), longer)
        elif kind is float:
            if not math.isfinite(value):
                yield (*above, key)
        elif _is_plain_array(value) and not all(map(math.isfinite, value)):
            yield (*above, key)


def _is_plain_array(value: object) -> bool:
    """Whether it is a list or a tuple of Python's own numbers."""
    return value.__class__ in (list, tuple) and {float, int}.issuperset(
        map(type, cast("list[object]", value))
    )


def _without_non_finite(
    values: dict[str, Any], tree: _PathTree, replaced: dict[str, str]
) -> tuple[dict[str, Any], int]:
    """The values with null for numbers that are not finite at the remembered paths.

    Dicts on such a path are copied; nothing is changed in the user's own.

    Args:
        values: Were looked at, and are not changed.
        tree: The paths below them.
        replaced: Receives dotted path to kind, as the slow path would name it.

    Returns:
        The values, and the number of nulls that were put into them.

    Raises:
        _NotPlainError: More have to be named than the fast path does.
    """
    copy, null_count = values, 0
    for key, under in tree.below.items():
        value: Any = values.get(key)
        kind: Any = value.__class__
        if kind is float:
            if value - value == 0.0:
                continue
            plain, count = None, 1
            _name_each(replaced, [(under.path, str(value))])
        elif kind is dict:
            plain, count = _without_non_finite(value, under, replaced)
        elif _is_plain_array(value):
            plain, names = _replace_non_finite(cast("list[Any]", value))
            if len(replaced) + len(names) > _MOST_NON_FINITE_PATHS:
                raise _NotPlainError
            _name_each(replaced, [(f"{under.path}.{item}", what) for item, what in names])
            count = plain.count(None) if names else 0
        else:
            continue
        if count:
            if copy is values:
                copy = dict(values)
            copy[key] = plain
            null_count += count
    return copy, null_count


def _name_each(replaced: dict[str, str], names: list[tuple[str, str]]) -> None:
    """Name what was replaced; where two places have one path, the slow path counts them.

    Raises:
        _NotPlainError: There are two such places.
    """
    expected = len(replaced) + len(names)
    replaced.update(names)
    if len(replaced) != expected:
        raise _NotPlainError


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
