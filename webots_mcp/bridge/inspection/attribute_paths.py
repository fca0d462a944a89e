"""Dotted paths to a controller's variables, such as `self.pid.integral` or `path[3]['x']`.

A path begins with a variable of the innermost of the controller's own frames that has it, or with
a name of a module. Following it runs no code of the user: see `objects`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from itertools import chain, islice
from types import FunctionType
from typing import Any, Final

from webots_mcp.bridge.inspection.frames import OwnFrame, has_text_keys
from webots_mcp.bridge.inspection.objects import (
    attributes_of,
    c_array_class,
    class_member,
    class_members,
    class_of,
    dict_items,
    field_value,
    has_base,
    instance_dict,
    is_field,
    name_of,
    numpy_class,
)
from webots_mcp.database.variable_paths import AttributePath

_MOST_KEYS: Final = 1000  # of a dict: all of them may have to be compared
_MOST_NAMED: Final = 8
_TEXT_OR_INT: Final = frozenset(map(id, (str, int)))
_SEQUENCES: Final = (list, tuple, deque, str, bytes, bytearray, range)
_MISSING: Final = object()


class PathEndsError(Exception):
    """A path cannot be followed to its end."""


def find_root(path: AttributePath, frames: list[OwnFrame]) -> Any:
    """Return the variable that a path begins with.

    Raises:
        PathEndsError: No frame has it.
    """
    for names in chain(
        (each.variables for each in frames), (each.module_variables for each in frames)
    ):
        found = names.get(path.root, _MISSING)  # another thread may remove it at any time
        if found is not _MISSING:
            return found
    if not frames:
        raise PathEndsError("no code of the controller is being executed")
    names = (name for name in frames[0].variables if not name.startswith("__"))
    known = ", ".join(sorted(names)[:_MOST_NAMED])
    where = frames[0].frame.f_code.co_name
    raise PathEndsError(f"there is no variable {path.root!r}; {where} has {known or 'none'}")


def follow(path: AttributePath, value: Any) -> Any:
    """Return the value at the end of a path, from the variable that it begins with.

    Raises:
        PathEndsError: An attribute or item is not there, or reading it would run code.
    """
    for is_name, key in path.steps:
        value = _attribute(value, str(key)) if is_name else _item(value, key)
    return value


def _attribute(value: Any, name: str) -> Any:
    own, cls = instance_dict(value), class_of(value)
    if own is not None:
        if has_text_keys(own):
            if (found := own.get(name, _MISSING)) is not _MISSING:
                return found
        else:
            for known, found in attributes_of(value):
                if known == name:
                    return found
    is_class = has_base(cls, type)
    try:
        member = class_member(value if is_class else cls, name)
    except KeyError:
        raise PathEndsError(_no_attribute(value, name)) from None
    if is_field(member) and not is_class:
        try:
            return field_value(member, value)
        except AttributeError:
            raise PathEndsError(f"{name!r} of {name_of(cls)} has no value yet") from None
    if _has_getter(class_of(member)) and class_of(member) is not FunctionType:
        raise PathEndsError(
            f"{name!r} of {name_of(value if is_class else cls)} is computed "
            f"({name_of(class_of(member))}): reading it would run code of the controller"
        )
    return member


def _has_getter(cls: type) -> bool:
    try:
        class_member(cls, "__get__")
    except KeyError:
        return False
    return True


def _no_attribute(value: Any, name: str) -> str:
    is_class = has_base(class_of(value), type)
    members = class_members(value) if is_class else (known for known, _ in attributes_of(value))
    names = [known for known in members if not known.startswith("__")][:_MOST_NAMED]
    has = f"; it has {', '.join(names)}" if names else ""
    return f"{name_of(value if is_class else class_of(value))} has no {name!r}{has}"


def _item(value: Any, key: str | int) -> Any:
    cls = class_of(value)
    if has_base(cls, dict):
        return _entry(value, key)
    base = _sequence_of(cls)
    if base is None:
        raise PathEndsError(f"[{key!r}] of {name_of(cls)} would run code of that class")
    if base is numpy_class("ndarray"):
        if isinstance(key, str) and key in (value.dtype.names or ()):
            return base.__getitem__(value, key)
        count = base.__len__(value) if value.ndim else 0
    else:
        count = base.__len__(value)
    if isinstance(key, int):
        with suppress(IndexError):  # another thread may shorten it at any time
            return base.__getitem__(value, key if key >= 0 else count + key)
    raise PathEndsError(f"there is no [{key!r}] in a {name_of(cls)} of {count}")


def _sequence_of(cls: type) -> Any:
    """Return the class of Python's own or numpy's whose method reads an item."""
    base = next((known for known in _SEQUENCES if has_base(cls, known)), None)
    if base is None and cls is numpy_class("ndarray"):
        return cls
    return c_array_class(cls) if base is None else base


def _entry(value: Any, key: str | int) -> Any:
    """Return the value of a key, without calling the `__eq__` of any other key."""
    base: Any = dict
    count = base.__len__(value)
    if count > _MOST_KEYS:
        raise PathEndsError(f"a dict of over {_MOST_KEYS} entries is too large")
    if _TEXT_OR_INT.issuperset(map(id, map(type, base.__iter__(value)))):  # compares no other keys
        found = base.get(value, key, _MISSING)
    else:
        entries = list(dict_items(value))
        same = (
            item for known, item in entries if class_of(known) is class_of(key) and known == key
        )
        found = next(same, _MISSING)
    if found is not _MISSING:
        return found
    known_keys: Iterable[Any] = islice(list(base.__iter__(value)), _MOST_KEYS)
    keys = [f"{known!r:.60}" for known in known_keys if id(class_of(known)) in _TEXT_OR_INT]
    has = f"; it has {', '.join(keys[:_MOST_NAMED])}" if keys else ""
    raise PathEndsError(f"there is no [{key!r}] in a {name_of(class_of(value))}{has}")
