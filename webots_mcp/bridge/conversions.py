"""Converting a value of a type that JSON does not know to its plain counterpart, if it has one."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Final, cast

MOST_ITEMS: Final = 20_000  # of one array or container; a row has no room for more
MOST_ARRAY_BYTES: Final = 1_000_000  # of one array, whose items may be long texts
_MOST_KIND_CHARACTERS: Final = 100

# Classes of Webots' `controller` package whose instances are nothing but their attributes.
_WEBOTS_RECORDS: Final = ("LidarPoint", "RadarTarget", "MouseState", "ContactPoint")
_ADDRESSES: Final = "zZPXO"  # the ctypes codes of char *, wchar_t *, void *, BSTR and PyObject *
_TEXTS: Final = ("c", "u")  # of char and wchar_t
_UNKNOWN_LENGTH: Final = "pointer of unknown length"


class NoCounterpartError(TypeError):
    """The value cannot be stored; the text names what it was."""


class Unreadable:
    """Placeholder of a field that must not be read."""


def convert(value: Any) -> object:
    """The JSON counterpart of a value; its items may have to be converted in their turn.

    Raises:
        NoCounterpartError: It has no counterpart, or more items than a row takes.
        Exception: Whatever the value raises while it is read.
    """
    if isinstance(value, Unreadable):
        raise NoCounterpartError(_UNKNOWN_LENGTH)
    if type(value) in (type, memoryview) or isinstance(value, type):
        raise NoCounterpartError(f"type {kind_name(value)}")
    if (ctypes := _ctypes_of(value)) is not None:
        return _read_c(ctypes, value)
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


# -- ctypes ------------------------------------------------------------------------------------


def _ctypes_of(value: object) -> Any:
    """The ctypes module if the value is of one of its types, else None; it is never imported here.

    All data of ctypes derives from one class, which has no public name.
    """
    ctypes = sys.modules.get("ctypes")
    if ctypes is None:
        return None
    is_reference = type(value).__name__ == "CArgObject"  # what byref() gives
    return ctypes if is_reference or isinstance(value, ctypes.Structure.__mro__[1]) else None


def _read_c(ctypes: Any, value: Any) -> object:
    """Read numbers, arrays and structures; a pointer is never followed, not even to a C string.

    What it points to may be freed by now, and reading it would crash the controller.

    Raises:
        NoCounterpartError: It is a pointer, or an array of more items than a row takes.
    """
    if isinstance(value, (ctypes.Structure, ctypes.Union)):
        return dict(_c_fields(value))
    if isinstance(value, ctypes.Array):
        return _c_items(value)
    code = getattr(value, "_type_", None)
    if not isinstance(code, str) or code in _ADDRESSES:
        raise NoCounterpartError(_UNKNOWN_LENGTH if value else "null pointer")
    return value.value


def _c_items(array: Any) -> object:
    _require_few(len(array))
    if (code := getattr(array._type_, "_type_", None)) in _TEXTS:
        return bytes(array) if code == "c" else array.value
    return [Unreadable()] * len(array) if _is_followed(array._type_) else list(array)


def _c_fields(structure: Any) -> Iterator[tuple[str, object]]:
    for cls in reversed(type(structure).__mro__):
        for name, kind, *_ in vars(cls).get("_fields_", ()):
            yield name, Unreadable() if _is_followed(kind) else getattr(structure, name)


def _is_followed(kind: Any) -> bool:
    """Whether ctypes follows such a pointer by itself as soon as the field is read."""
    code = getattr(kind, "_type_", None)
    return isinstance(code, str) and code in _ADDRESSES


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
