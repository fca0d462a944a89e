"""Answers and arguments of Webots' API as JSON, and back, to the last digit.

Numbers, texts and lists of them stand for themselves. Anything else is an object with one key that
begins with `$`.
"""

from __future__ import annotations

import base64
import ctypes
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from types import SimpleNamespace
from typing import Any, Final, cast

MOST_BYTES: Final = 4096
_PLAIN: Final = frozenset({type(None), bool, int, float, str})
_VECTORS: Final = ("getValues", ".values", ".value", "getEmitterDirection", ".emitter_direction")

NameOf = Callable[[Any], "str | None"]
"""Returns the path of an object of Webots' package; None for any other object."""


@dataclass(frozen=True)
class PackedValues:
    """Sizes of values on a tape.

    Attributes:
        numbers: Maximum numbers of an answer that is not a picture; more needs `tape_images`.
        packed_from: Number of floats in a list from which they are packed.
    """

    numbers: int = 256
    packed_from: int = 16


_PACKED: Final = PackedValues()


class UnrecordedValueError(Exception):
    """A value is not on the tape: it was too large, or of a type that a tape cannot hold."""


class UnreadablePointer:
    """A pointer that is not null, to memory that no tape holds."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    def __getitem__(self, index: object) -> Any:
        raise UnrecordedValueError(f"what a pointer of the type {self._kind} points to")

    def __bool__(self) -> bool:
        return True


def encode_value(value: Any, member: str, name_of: NameOf, *, images: bool) -> Any:
    """Return a value as JSON can hold it.

    Args:
        value: An argument, or an answer.
        member: The method or property that it belongs to.
        name_of: Returns the path of an object of Webots' package.
        images: Whether large values are recorded too.
    """
    kind: Any = value.__class__
    if kind in _PLAIN:
        is_large = kind is str and len(value) > MOST_BYTES and not images
        return {"$large": f"{len(value):,} characters"} if is_large else value
    if isinstance(value, (bytes, bytearray, memoryview)):
        content = bytes(cast("bytes", value))
        if len(content) > MOST_BYTES and not images:
            return {"$large": f"{len(content):,} bytes"}
        return {"$bytes": base64.b64encode(content).decode()}
    if isinstance(value, (list, tuple)):
        return _encode_items(cast("list[Any]", value), member, name_of, images=images)
    if isinstance(value, dict):
        pairs = cast("dict[Any, Any]", value).items()
        coded = [
            [encode_value(each, member, name_of, images=images) for each in pair] for pair in pairs
        ]
        return {"$dict": coded}
    if isinstance(value, (ctypes.Structure, ctypes._Pointer)):  # pyright: ignore[reportPrivateUsage]
        return _encode_foreign(value, member, name_of, images=images)
    path = name_of(value)
    return {"$type": kind.__name__} if path is None else {"$object": path, "class": kind.__name__}


def _encode_items(items: Any, member: str, name_of: NameOf, *, images: bool) -> Any:
    if len(items) <= _PACKED.packed_from and items.__class__ is list and all(map(_is_float, items)):
        return items[:]
    count = _count_numbers(items)
    if count > _PACKED.numbers and not images:
        return {"$large": f"{count:,} numbers"}
    if len(items) > _PACKED.packed_from and all(type(each) is float for each in items):
        single = array("f", items)
        exact = single.tolist() == list(items)  # not where one is NaN
        packed = single if exact else array("d", items)
        name = "$float32" if exact else "$float64"
        return {name: base64.b64encode(packed.tobytes()).decode()}
    coded = [
        each if type(each) in _PLAIN else encode_value(each, member, name_of, images=images)
        for each in items
    ]
    return {"$tuple": coded} if isinstance(items, tuple) else coded


def _is_float(value: object) -> bool:
    return type(value) is float


def _count_numbers(items: Any) -> int:
    """Return the number of items, nested ones included; the first of them says how deep."""
    if items and isinstance(items[0], (list, tuple)):
        return sum(len(each) for each in chain(items) if hasattr(each, "__len__"))
    return len(items)


def _encode_foreign(value: Any, member: str, name_of: NameOf, *, images: bool) -> Any:
    if isinstance(value, ctypes.Structure):
        names = [field[0] for field in getattr(value, "_fields_", ())]
        fields = {
            name: encode_value(getattr(value, name), member, name_of, images=images)
            for name in names
        }
        return {"$fields": fields, "class": type(value).__name__}
    if not value:
        return {"$pointer": []}
    if member in _VECTORS:  # of older releases: a bare pointer to three numbers
        return {"$pointer": [value[i] for i in range(3)]}
    return {"$address": type(value).__name__}  # how far it may be read is not known


def decode_value(coded: Any, make: Callable[[str, str], Any]) -> Any:
    """Return the value that `encode_value` has encoded.

    Args:
        coded: From the tape.
        make: Returns the object of a class at a path.

    Raises:
        UnrecordedValueError: The tape does not hold it.
    """
    if isinstance(coded, list):
        return [decode_value(each, make) for each in cast("list[Any]", coded)]
    if not isinstance(coded, dict):
        return coded
    coded = cast("dict[str, Any]", coded)
    name = next(iter(coded))
    held: Any = coded[name]
    if name == "$object":
        return make(held, coded["class"])
    if name == "$bytes":
        return base64.b64decode(held)
    if name in ("$float32", "$float64"):
        numbers = array("f" if name == "$float32" else "d")
        numbers.frombytes(base64.b64decode(held))
        return numbers.tolist()
    if name == "$tuple":
        return tuple(decode_value(each, make) for each in held)
    if name == "$dict":
        return {decode_value(key, make): decode_value(each, make) for key, each in held}
    if name == "$fields":
        return SimpleNamespace(**{key: decode_value(each, make) for key, each in held.items()})
    if name == "$pointer":
        kind = ctypes.c_double * len(held)
        pointer = ctypes.POINTER(ctypes.c_double)
        return ctypes.cast(kind(*held), pointer) if held else pointer()
    if name == "$address":
        return UnreadablePointer(held)
    if name == "$large":
        raise UnrecordedValueError(
            f"its answer of {held} was not recorded: record with tape_images=True"
        )
    raise UnrecordedValueError(f"its answer of the type {held} cannot be recorded")
