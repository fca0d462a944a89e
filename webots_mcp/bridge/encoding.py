"""A published state as JSON text that SQLite can always read.

JSON has no NaN, no infinity and no bytes, and SQLite before 3.42 fails on every row whose text
holds a NaN. So what JSON cannot hold is replaced, and `odd` names the path and what stood there:

    published value              stored        odd
    NaN, infinity, -infinity     null          "nan", "inf", "-inf"
    several, all of one kind,
    in one array                 null each     "lidar.*": "inf" (every null in it)
    bytes, up to 1 kB            base64 text   "bytes"
    array over 4,096 items, in
    a row over 1 MB              null          "array[921600]"
    nested over 20 levels        null          "too deep"
    any other object             null          "type Socket"
    text with a lone surrogate   with "?"      "surrogate"

Numpy scalars and arrays, dataclasses, enums, tuples, sets, dates, paths, decimals and keys
that are not text are stored as their plain JSON counterparts and are not odd.
"""

from __future__ import annotations

import base64
import enum
import json
import math
from collections.abc import Callable, Iterable, Mapping
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
        text = _encode_plain(state)
        if len(text.encode()) <= MAX_ROW_BYTES:
            return Encoded(text, {})
    except (ValueError, TypeError, RecursionError):
        pass  # something odd is inside: walk it, once, and name it
    return _encode_odd(state)


def _encode_with_orjson(state: object) -> str | None:
    """None where orjson cannot, or may have turned a NaN silently into null."""
    try:
        text = orjson.dumps(state, _as_json, orjson.OPT_SERIALIZE_NUMPY)
    except TypeError:
        return None
    return None if b"null" in text or len(text) > MAX_ROW_BYTES else text.decode()


def _encode_odd(state: object) -> Encoded:
    """Replace what has to be: first what JSON cannot hold, then big arrays, at last the row."""
    text, odd = "", dict[str, str]()
    for max_items in (MAX_ROW_BYTES, MAX_ARRAY_ITEMS):
        odd.clear()
        text = _encode_plain(_Cleaner(odd, max_items).clean(state, "", 0))
        if len(text.encode()) <= MAX_ROW_BYTES:
            return Encoded(text, odd)
    return Encoded("{}", {"": f"row of {len(text)} characters"})


def _as_json(value: object) -> object:
    """What the encoder asks for a value it does not know: its lossless JSON counterpart.

    Raises:
        TypeError: There is none.
    """
    convert = _conversion(value)
    if convert is None:
        raise TypeError(f"{type(value).__name__} has no JSON counterpart")
    try:
        return convert(value)
    except Exception as error:
        raise TypeError(f"{type(value).__name__} failed to convert: {error}") from error


# Without the check a circle ends as a RecursionError, which is handled as well, and all that is
# no circle is encoded 8 % faster.
_encode_plain: Final = json.JSONEncoder(
    check_circular=False,
    allow_nan=False,
    ensure_ascii=False,
    separators=(",", ":"),
    default=_as_json,
).encode


def _conversion(value: Any) -> Callable[[Any], object] | None:
    """How a value that is no plain JSON becomes some; the first rule that fits."""
    if getattr(value, "size", 0) > MAX_ROW_BYTES // 2:
        return None  # an array whose text would be longer than a row may be
    return next((convert for name, convert in _CONVERSIONS if hasattr(value, name)), None)


# By what the object can do, not by its type: numpy, dataclasses, datetime and pathlib would cost
# the controller their import.
_CONVERSIONS: Final[tuple[tuple[str, Callable[[Any], object]], ...]] = (
    ("tolist", lambda array: array.tolist()),  # numpy scalars and arrays, array.array
    ("__dataclass_fields__", lambda data: {name: getattr(data, name) for name in _fields(data)}),
    ("_value_", lambda member: member.value),  # enum
    ("isoformat", lambda moment: moment.isoformat()),
    ("total_seconds", lambda span: span.total_seconds()),
    ("__fspath__", lambda path: path.__fspath__()),
    ("__float__", float),  # decimal, fraction
    ("keys", lambda mapping: {key: mapping[key] for key in mapping}),
    ("isdisjoint", list),  # set, frozenset
)


def _fields(data: Any) -> Iterable[str]:
    return data.__dataclass_fields__


class _Cleaner:
    """Copies a value into what JSON can hold, and names in `odd` what it had to replace."""

    def __init__(self, odd: dict[str, str], max_items: int) -> None:
        self._odd = odd
        self._max_items = max_items

    def clean(self, value: Any, path: str, depth: int) -> object:
        if value is None or isinstance(value, (bool, int)):
            return int(value) if isinstance(value, enum.Enum) else value
        if isinstance(value, float):
            return self._float(float(value), path)
        if isinstance(value, str):
            return self._text(value, path)
        if depth >= MAX_DEPTH:
            return self._replaced(path, "too deep")
        if isinstance(value, Mapping):
            return self._mapping(cast("Mapping[object, object]", value), path, depth)
        if isinstance(value, (list, tuple, set, frozenset)):
            return self._items(list(cast("Iterable[object]", value)), path, depth)
        return self._object(value, path, depth)

    def _float(self, value: float, path: str) -> float | None:
        return value if math.isfinite(value) else self._replaced(path, str(value))

    def _text(self, value: str, path: str) -> str:
        plain = str(value.value) if isinstance(value, enum.Enum) else value
        encoded = plain.encode("utf-8", "replace").decode()
        if encoded != plain:
            self._odd[path] = "surrogate"
        return encoded

    def _mapping(self, value: Mapping[object, object], path: str, depth: int) -> object:
        prefix = f"{path}." if path else ""
        return {
            (name := _key(key)): self.clean(item, prefix + name, depth + 1)
            for key, item in value.items()
        }

    def _items(self, items: list[object], path: str, depth: int) -> object:
        if len(items) > self._max_items:
            return self._replaced(path, f"array[{len(items)}]")
        prefix = f"{path}." if path else ""
        kinds = {str(item) for item in items if _is_odd_float(item)}
        if len(kinds) == 1 and None not in items:
            self._odd[f"{prefix}*"] = kinds.pop()
            items = [None if _is_odd_float(item) else item for item in items]
        return [self.clean(item, f"{prefix}{i}", depth + 1) for i, item in enumerate(items)]

    def _object(self, value: Any, path: str, depth: int) -> object:
        if isinstance(value, (bytes, bytearray, memoryview)):
            return self._bytes(bytes(cast("bytes", value)), path)
        convert = _conversion(value)
        if convert is None:
            return self._replaced(path, _kind(value))
        try:
            return self.clean(convert(value), path, depth + 1)
        except Exception as error:  # noqa: BLE001  (any object may fail in its own way: it costs itself)
            return self._replaced(path, f"{_kind(value)}: {error}")

    def _bytes(self, value: bytes, path: str) -> str | None:
        if len(value) > MAX_BYTES:
            return self._replaced(path, f"bytes[{len(value)}]")
        self._odd[path] = "bytes"
        return base64.b64encode(value).decode("ascii")

    def _replaced(self, path: str, kind: str) -> None:
        self._odd[path] = kind


def _is_odd_float(value: object) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def _key(key: object) -> str:
    """Object keys as the JSON encoder writes them; any other key as its text."""
    if isinstance(key, str):
        return key.encode("utf-8", "replace").decode()
    if key is None or isinstance(key, bool):
        return {None: "null", True: "true", False: "false"}[key]
    return str(key)


def _kind(value: Any) -> str:
    return f"array[{value.size}]" if hasattr(value, "size") else f"type {type(value).__name__}"
