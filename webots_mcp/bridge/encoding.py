"""A published state as JSON text that SQLite can always read.

JSON has no NaN, no infinity and no bytes, and SQLite before 3.42 fails on every row whose text
holds a NaN. So what JSON cannot hold is replaced, and `odd` names the path and what stood there:

    published value              stored        odd
    NaN, infinity, -infinity     null          "nan", "inf", "-inf"
    several, all of one kind,
    in one array                 null each     "lidar.*": "inf" (every null in it)
    bytes, up to 1 kB            base64 text   "bytes"
    bytes, more                  null          "bytes[2000]"
    array over 4,096 items, in
    a row over 1 MB              null          "array[307200]"
    array over 250,000 items     null          "array[921600]"
    nested over 20 levels        null          "too deep"
    integer beyond all floats    null          "int"
    any other object             null          "type Socket"
    an object that fails while
    it is read                   null          "type Socket: why"
    text with a lone surrogate   with "?"      "surrogate"
    key that has no text         "<Handle>"    "key"
    a row that is still too
    long, or that fails          {}            "": "row of 1500000 characters", or why

Numpy scalars and arrays, dataclasses, enums, tuples, sets, ranges, deques, dates, paths, UUIDs,
decimals and keys that are not text are stored as their plain JSON counterparts and are not odd.
Neither are integers beyond 64 bits: they become the nearest float, as which SQLite reads them.
"""

from __future__ import annotations

import base64
import enum
import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from itertools import compress
from operator import not_
from typing import Any, Final, NamedTuple, cast

orjson: Any
try:
    import orjson
except ImportError:
    orjson = None

MAX_ARRAY_ITEMS: Final = 4096
MAX_DEPTH: Final = 20
MAX_BYTES: Final = 1024
MAX_ROW_BYTES: Final = 1_000_000
MOST_ITEMS: Final = MAX_ROW_BYTES // 4  # no longer array of floats fits: "0.0," is the least
_ITEMS_AT_ONCE: Final = 50_000  # 10 to 20 ms
_MOST_REASON_CHARACTERS: Final = 200


class Encoded(NamedTuple):
    """JSON text, and what had to be replaced in it: dotted path to kind."""

    text: str
    odd: dict[str, str]

    @property
    def odd_text(self) -> str | None:
        """`odd` as the database holds it: null where nothing was replaced."""
        return _encode_plain(self.odd) if self.odd else None


def encode(state: object) -> Encoded:
    """Encode a state, as fast as its content allows; the state itself is never changed."""
    if orjson is not None and (text := _encode_with_orjson(state)) is not None:
        return Encoded(text, {})
    try:
        if not _is_long(state):
            text = _encode_plain(state)
            if len(text.encode()) <= MAX_ROW_BYTES:
                return Encoded(text, {})
    except Exception:  # noqa: BLE001  (something odd is inside: it is found and named below)
        return _encode_odd(state)
    return _encode_odd(state)


def _encode_with_orjson(state: object) -> str | None:
    """None where orjson cannot, or may have turned a NaN silently into null."""
    try:
        text = orjson.dumps(state, _as_json, _ORJSON_OPTIONS)
    except Exception:  # noqa: BLE001  (whatever an object of the user's does: the other way names it)
        return None
    return None if b"null" in text or len(text) > MAX_ROW_BYTES else text.decode()


def _is_long(state: object) -> bool:
    """Whether encoding it only to find it too long would make the loop wait.

    Only what stands at the top is asked: a look at every list would cost more than it saves.
    """
    if not isinstance(state, dict):
        return False
    for value in cast("dict[object, object]", state).values():
        if type(value) is list and len(cast("list[object]", value)) > _ITEMS_AT_ONCE:
            return True
    return False


def _encode_odd(state: object) -> Encoded:
    """Replace what has to be: first what JSON cannot hold, then big arrays, at last the row."""
    text, odd = "", dict[str, str]()
    try:
        for max_items in (MOST_ITEMS, MAX_ARRAY_ITEMS):
            odd.clear()
            cleaned = _Cleaner(odd, max_items).clean(state, "", 0)
            text = _encode_clean({} if cleaned is None and isinstance(state, Mapping) else cleaned)
            if len(text.encode()) <= MAX_ROW_BYTES:
                return Encoded(text, odd)
    except Exception as error:  # noqa: BLE001  (the last resort: the row is there, and says why)
        return Encoded("{}", {"": f"{type(error).__name__}: {_reason(error)}"})
    return Encoded("{}", {"": f"row of {len(text)} characters"})


def _encode_clean(state: object) -> str:
    """Of what a cleaner made: the faster way never meets anything odd."""
    return _encode_plain(state) if orjson is None else orjson.dumps(state).decode()


def _as_json(value: object) -> object:
    """What the encoder asks for a value it does not know: its lossless JSON counterpart.

    Raises:
        TypeError: There is none.
        Exception: Whatever an object raises while it is asked.
    """
    convert = _conversion(value)
    if convert is None:
        raise TypeError(f"{type(value).__name__} has no JSON counterpart")
    return convert(value)


# Without the check a circle ends as a RecursionError, which is handled as well, and all that is
# no circle is encoded 8 % faster.
_encode_plain: Final = json.JSONEncoder(
    check_circular=False,
    allow_nan=False,
    ensure_ascii=False,
    separators=(",", ":"),
    default=_as_json,
).encode
# A dataclass of orjson's own encoding would lose the fields that begin with an underscore.
_ORJSON_OPTIONS: Final[int] = (
    orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_PASSTHROUGH_DATACLASS if orjson is not None else 0
)


def _conversion(value: Any) -> Callable[[Any], object] | None:
    """How a value that is no plain JSON becomes some; the first rule that fits."""
    if isinstance(value, (type, memoryview)) or _item_count(value) > MOST_ITEMS:
        return None
    return next((convert for name, convert in _CONVERSIONS if hasattr(value, name)), None)


def _item_count(value: Any) -> int:
    """Of an array or a container; `size` would be a method or a tuple on some that are neither."""
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return math.prod(cast("tuple[int, ...]", shape))
    return len(value) if hasattr(value, "__len__") else 0


# By what the object can do, not by its type: numpy, dataclasses, datetime and pathlib would cost
# the controller their import.
_CONVERSIONS: Final[tuple[tuple[str, Callable[[Any], object]], ...]] = (
    ("tolist", lambda array: array.tolist()),  # numpy scalars and arrays, array.array
    ("__dataclass_fields__", lambda data: {name: getattr(data, name) for name in _fields(data)}),
    ("_value_", lambda member: member.value),  # enum
    ("isoformat", lambda moment: moment.isoformat()),
    ("total_seconds", lambda span: span.total_seconds()),
    ("__fspath__", lambda path: path.__fspath__()),
    ("urn", str),  # UUID
    ("__float__", float),  # decimal, fraction
    ("keys", lambda mapping: {key: mapping[key] for key in mapping}),
    ("isdisjoint", list),  # set, frozenset
    ("__reversed__", list),  # deque, range and other sequences
)


def _fields(data: Any) -> Iterable[str]:
    """Without those that belong to the class or only to its constructor."""
    fields: dict[str, Any] = data.__dataclass_fields__
    return (name for name, field in fields.items() if str(field._field_type) == "_FIELD")


class _Cleaner:
    """Copies a value into what JSON can hold, and names in `odd` what it had to replace."""

    def __init__(self, odd: dict[str, str], max_items: int) -> None:
        self._odd = odd
        self._max_items = max_items

    def clean(self, value: Any, path: str, depth: int) -> object:
        """The plain counterpart of any value; one that fails costs itself and no other."""
        try:
            return self._clean(value, path, depth)
        except Exception as error:  # noqa: BLE001  (any object may fail in its own way)
            return self._replaced(path, f"type {type(value).__name__}: {_reason(error)}")

    def _clean(self, value: Any, path: str, depth: int) -> object:
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, int):
            return self._int(int(value), path)
        if isinstance(value, float):
            return self._float(float(value), path)
        if isinstance(value, str):
            return self._text(str(value.value) if isinstance(value, enum.Enum) else value, path)
        if depth >= MAX_DEPTH:
            return self._replaced(path, "too deep")
        if isinstance(value, Mapping):
            return self._mapping(cast("Mapping[object, object]", value), path, depth)
        if isinstance(value, (list, tuple, set, frozenset, deque)):
            return self._items(cast("Iterable[object]", value), path, depth)
        return self._object(value, path, depth)

    def _int(self, value: int, path: str) -> int | float | None:
        if -(2**63) <= value < 2**63:
            return value
        try:
            return float(value)
        except OverflowError:
            return self._replaced(path, "int")

    def _float(self, value: float, path: str) -> float | None:
        return value if math.isfinite(value) else self._replaced(path, str(value))

    def _text(self, value: str, path: str) -> str:
        encoded = value.encode("utf-8", "replace").decode()
        if encoded != value:
            self._odd[path] = "surrogate"
        return encoded

    def _mapping(self, value: Mapping[object, object], path: str, depth: int) -> object:
        prefix = f"{path}." if path else ""
        return {
            (name := self._key(key, prefix)): self.clean(item, prefix + name, depth + 1)
            for key, item in value.items()
        }

    def _key(self, key: object, prefix: str) -> str:
        try:
            text = _key_text(key)
        except Exception:  # noqa: BLE001  (as with values: it costs itself)
            name, kind = f"<{type(key).__name__}>", "key"
        else:
            name, kind = text.encode("utf-8", "replace").decode(), "surrogate"
            if name == text:
                return name
        self._odd[prefix + name] = kind
        return name

    def _items(self, value: Iterable[object], path: str, depth: int) -> object:
        items = value if isinstance(value, list) else list(value)
        if (count := _nested_count(items)) > self._max_items:
            return self._replaced(path, f"array[{count}]")
        prefix = f"{path}." if path else ""
        if set(map(type, items)) == {float}:
            return self._floats(cast("list[float]", items), prefix)
        kinds = {str(item) for item in items if _is_odd_float(item)}
        if len(kinds) == 1 and None not in items:
            self._odd[f"{prefix}*"] = kinds.pop()
            items = [None if _is_odd_float(item) else item for item in items]
        return [self.clean(item, f"{prefix}{i}", depth + 1) for i, item in enumerate(items)]

    def _floats(self, items: list[float], prefix: str) -> list[float] | list[float | None]:
        """What lidars and cameras give: thousands of numbers, without a call for each."""
        finite = list(map(math.isfinite, items))
        kinds = set(map(str, compress(items, map(not_, finite))))
        if len(kinds) == 1:
            self._odd[f"{prefix}*"] = kinds.pop()
        elif kinds:
            places = compress(enumerate(items), map(not_, finite))
            self._odd.update((f"{prefix}{i}", str(item)) for i, item in places)
        else:
            return items
        return [item if good else None for item, good in zip(items, finite, strict=True)]

    def _object(self, value: Any, path: str, depth: int) -> object:
        if isinstance(value, (bytes, bytearray, memoryview)):
            return self._bytes(bytes(cast("bytes", value)), path)
        convert = _conversion(value)
        if convert is None:
            return self._replaced(path, _kind(value))
        return self.clean(convert(value), path, depth + 1)

    def _bytes(self, value: bytes, path: str) -> str | None:
        if len(value) > MAX_BYTES:
            return self._replaced(path, f"bytes[{len(value)}]")
        self._odd[path] = "bytes"
        return base64.b64encode(value).decode("ascii")

    def _replaced(self, path: str, kind: str) -> None:
        self._odd[path] = kind


def _key_text(key: object) -> str:
    """Object keys as the JSON encoder writes them; any other key as its text."""
    if key is None or isinstance(key, bool):
        return {None: "null", True: "true", False: "false"}[key]
    if isinstance(key, (str, int)):  # also enums of them, whose own text is another
        return str.__str__(key) if isinstance(key, str) else int.__repr__(key)
    return str(key)


def _is_odd_float(value: object) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _nested_count(items: list[object]) -> int:
    """How many items a list of lists has, if the others are as long as the first."""
    count, first = len(items), items
    while first and isinstance(first[0], list):
        first = cast("list[object]", first[0])
        count *= len(first)
    return count


def _kind(value: Any) -> str:
    if not isinstance(value, type) and (count := _item_count(value)) > MOST_ITEMS:
        return f"array[{count}]"
    return f"type {type(value).__name__}"


def _reason(error: Exception) -> str:
    """Its text, which may be long, or fail as well."""
    try:
        return str(error)[:_MOST_REASON_CHARACTERS]
    except Exception:  # noqa: BLE001  (an exception of the user's own)
        return type(error).__name__
