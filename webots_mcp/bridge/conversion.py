"""Plain counterparts of values that JSON does not know, such as those of numpy and ctypes.

Types are recognised by their attributes, because importing numpy, ctypes, dataclasses or pathlib
only to test for their types would slow down the start of every controller.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import accumulate, islice
from operator import mul
from typing import Any, Final, cast

MAX_ITEMS: Final = 20_000  # of one row, and so of each of its containers
MAX_ARRAY_BYTES: Final = 1_000_000  # of one array, whose items may be long texts
_MAX_TYPE_NAME_CHARACTERS: Final = 100
# Classes of Webots' `controller` package whose instances are nothing but their attributes.
_WEBOTS_RECORDS: Final = ("LidarPoint", "RadarTarget", "MouseState", "ContactPoint")
# The codes of ctypes for numbers and flags, and for addresses: char *, wchar_t *, void *, BSTR and
# PyObject *.
_C_NUMBERS: Final = frozenset("bBhHiIlLqQfdg?v")
_C_ADDRESSES: Final = frozenset("zZPXO")


class UnsupportedError(TypeError):
    """A value has no counterpart in JSON.

    Attributes:
        type_name: The name of its type.
    """

    def __init__(self, type_name: str) -> None:
        super().__init__(type_name)
        self.type_name = type_name


class TooLargeError(ValueError):
    """A value has more items or bytes than a row has space for."""


def convert(value: Any) -> object:
    """Return the plain counterpart of a value, whose items may need a conversion of their own.

    Args:
        value: Anything but a number, text, dict, list, tuple or set.

    Returns:
        A number, text, list or dict.

    Raises:
        UnsupportedError: If the value has no counterpart in JSON.
        TooLargeError: If the value has more items or bytes than a row has space for.
        Exception: Whatever the value raises while it is read.
    """
    if isinstance(value, _Pointer):
        raise UnsupportedError(value.type_name)
    if isinstance(value, (type, memoryview)):
        raise UnsupportedError(type_name(cast("object", value)))
    if (ctypes := _ctypes_of(value)) is not None:
        return _convert_c_data(ctypes, value)
    if type(value).__name__ in _WEBOTS_RECORDS:
        attributes: dict[str, object] = value.__dict__
        return {name: item for name, item in attributes.items() if not name.startswith("_")}
    _require_few_items(item_count(value))
    size_bytes = getattr(value, "nbytes", 0)
    if isinstance(size_bytes, int) and size_bytes > MAX_ARRAY_BYTES:
        raise TooLargeError(f"{size_bytes} bytes")
    for attribute, conversion in _CONVERSIONS:
        if hasattr(value, attribute):
            return conversion(value)
    raise UnsupportedError(type_name(value))


def type_name(value: object) -> str:
    """Return the name of a value's type, cut because a type may have a name of any length."""
    return type(value).__name__[:_MAX_TYPE_NAME_CHARACTERS]


def item_count(value: Any) -> int:
    """Return the number of items of an array or a container, including those of inner arrays.

    Numpy's `size` is not used, because other classes may have a method or a tuple of that name.

    Returns:
        The count, or 0 for a value that is neither array nor container.
    """
    if isinstance(shape := getattr(value, "shape", None), tuple):
        return sum(accumulate(cast("tuple[int, ...]", shape), mul))
    return len(value) if hasattr(value, "__len__") else 0


def is_number_array(value: Any) -> bool:
    """Return whether a value is a numpy array or scalar that holds only numbers or booleans."""
    return getattr(getattr(value, "dtype", None), "kind", None) in ("b", "i", "u", "f")


def is_c_number_array(value: Any) -> bool:
    """Return whether a value is an array of numbers of ctypes, such as a position of Webots."""
    ctypes = sys.modules.get("ctypes")
    if ctypes is None or not isinstance(value, ctypes.Array):
        return False
    code = getattr(value._type_, "_type_", None)
    return isinstance(code, str) and code in _C_NUMBERS


def _require_few_items(count: int) -> None:
    if count > MAX_ITEMS:
        raise TooLargeError(f"{count} items")


# -- data of ctypes, in which Webots' getters answer -------------------------------------------


class _Pointer:
    """Stands in for a pointer inside a structure or an array.

    Reading the pointer itself would make ctypes follow it. What it points to may have been freed,
    and the read would crash the controller.
    """

    def __init__(self, type_name: str) -> None:
        self.type_name = type_name


def _ctypes_of(value: object) -> Any:
    """Return the ctypes module if the value is of one of its types, else None; never import it."""
    ctypes = sys.modules.get("ctypes")
    if ctypes is None:
        return None
    is_reference = type(value).__name__ == "CArgObject"  # what byref() returns
    # All data of ctypes derives from one class, which has no public name.
    return ctypes if is_reference or isinstance(value, ctypes.Structure.__mro__[1]) else None


def _convert_c_data(ctypes: Any, value: Any) -> object:
    """Return the counterpart of a number, array or structure without following any pointer."""
    if isinstance(value, (ctypes.Structure, ctypes.Union)):
        return dict(_c_fields(value))
    if isinstance(value, ctypes.Array):
        return _convert_c_array(value)
    code = getattr(value, "_type_", None)
    if not isinstance(code, str) or code in _C_ADDRESSES:
        raise UnsupportedError(type_name(value))
    return value.value


def _convert_c_array(array: Any) -> object:
    _require_few_items(len(array))
    code = getattr(array._type_, "_type_", None)
    if code == "c":
        return bytes(array)
    if code == "u":
        return array.value
    if _is_followed_when_read(array._type_):
        return [_Pointer(array._type_.__name__)] * len(array)
    return list(array)


def _c_fields(structure: Any) -> Iterator[tuple[str, object]]:
    for cls in reversed(type(structure).__mro__):
        for name, kind, *_ in vars(cls).get("_fields_", ()):
            is_followed = _is_followed_when_read(kind)
            yield name, _Pointer(kind.__name__) if is_followed else getattr(structure, name)


def _is_followed_when_read(kind: Any) -> bool:
    code = getattr(kind, "_type_", None)
    return isinstance(code, str) and code in _C_ADDRESSES


# -- all other types, by the attribute that identifies them -----------------------------------

_CONVERSIONS: Final[tuple[tuple[str, Callable[[Any], object]], ...]] = (
    ("tolist", lambda array: _convert_array(array)),  # numpy scalars and arrays, array.array
    ("__dataclass_fields__", lambda data: {name: getattr(data, name) for name in _fields(data)}),
    ("_value_", lambda member: member.value),  # enum
    ("isoformat", lambda moment: moment.isoformat()),
    ("total_seconds", lambda span: span.total_seconds()),
    ("__fspath__", lambda path: path.__fspath__()),
    ("urn", str),  # UUID
    ("__float__", float),  # decimal, fraction
    ("keys", lambda mapping: {key: mapping[key] for key in _bounded(mapping.keys())}),
    ("isdisjoint", lambda items: list(_bounded(items))),  # views of dicts
    ("__reversed__", lambda items: list(_bounded(items))),  # range and other sequences
)


def _convert_array(array: Any) -> object:
    plain = array.tolist()
    # Numpy returns a long double itself, because Python has no number of its precision.
    return float(plain) if type(plain) is type(array) else plain


def _fields(data: Any) -> Iterable[str]:
    """Return the names of a dataclass's fields, without its ClassVar and InitVar members."""
    fields: dict[str, Any] = data.__dataclass_fields__
    return (name for name, field in fields.items() if str(field._field_type) == "_FIELD")


def _bounded(items: Iterable[Any]) -> Iterable[Any]:
    """Return as many items as `len` reports, because an object's iterator may be endless."""
    return islice(items, min(MAX_ITEMS, item_count(items) or MAX_ITEMS))
