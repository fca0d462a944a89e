"""The names of Webots' own package, and how its C functions take arguments and print errors.

`surface.txt` is the table of the real package. Names that the stand-in does not define itself come
from it: constants, properties for existing getters, and errors for everything else.
"""

from __future__ import annotations

import ctypes
import inspect
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

_ACCESSORS: Final = {
    "target_position": ("getTargetPosition", "setPosition"),
    "target_velocity": ("getVelocity", "setVelocity"),
    "target_acceleration": ("getAcceleration", "setAcceleration"),
    "sampling_period": ("getSamplingPeriod", "enable"),
    "simulation_mode": ("simulationGetMode", "simulationSetMode"),
}
"""Getters and setters of properties that are not named like their methods."""
_WITHOUT_CONSTANT: Final = {"POSE": 26}
"""Numbers of node types that the table has no constant for."""


if TYPE_CHECKING:

    class _Names(type):
        def __getattr__(cls, name: str) -> Any: ...

    class Completed(metaclass=_Names):
        """A class with names from the table, which a type checker cannot know."""

        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...
else:
    Completed = object  # Classes must have only the bases that they have in Webots.


class NotInStandInError(AttributeError, NotImplementedError):
    """Webots has it, but the stand-in lacks it.

    `hasattr` is false, as for any missing attribute.
    """


def lacking(what: str) -> NotInStandInError:
    """Return the error for something that Webots has and the stand-in lacks."""
    return NotInStandInError(
        f"the stand-in has no {what}; see 'webots-mcp help standin' for what it has"
    )


class Lacking:
    """An attribute that fails when it is read or set."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __get__(self, instance: object, owner: type) -> NoReturn:
        raise lacking(self._what)

    def __set__(self, instance: object, value: object) -> NoReturn:
        raise lacking(self._what)


class _LackingClass(type):
    """The type of classes that can only be imported."""

    def __call__(cls, *arguments: Any, **named: Any) -> NoReturn:
        raise lacking(cls.__name__)

    def __getattr__(cls, name: str) -> NoReturn:
        raise lacking(f"{cls.__name__}.{name}")


def lacking_class(name: str) -> type:
    """Return a class that can only be imported: controllers may import more than they use."""
    return _LackingClass(name, (), {"__doc__": "In Webots, but not in the stand-in."})


def _members_by_class() -> dict[str, dict[str, str]]:
    text = Path(__file__).with_name("surface.txt").read_text(encoding="utf-8")
    table: dict[str, dict[str, str]] = {}
    members: dict[str, str] = {}
    for line in text.splitlines():
        if line.startswith("  "):
            member = line.strip().partition(" [R20")[0]
            name = member.replace("(", " ").split()[0]
            members[name] = member.removeprefix(name).strip()
        elif not line.startswith("#"):
            members = table.setdefault(line.partition(":")[0], {})
    return table


MEMBERS: Final = _members_by_class()
"""Description of each member by class and name: `(self, index)`, `property` or `= 3`."""


def type_number(owner: str, type_name: str) -> int:
    """Return the number of a node type or field type by its name in world files; 0 if unknown.

    Args:
        owner: The class with the constants, `Node` or `Field`.
        type_name: Such as `DistanceSensor` or `SFVec3f`.
    """
    return _NUMBERS[owner].get(type_name.upper(), 0)


_NUMBERS: Final = {
    owner: _WITHOUT_CONSTANT
    | {
        name.replace("_", ""): int(kind[2:])
        for name, kind in MEMBERS[owner].items()
        if kind.startswith("= ")
    }
    for owner in ("Node", "Field")
}


def complete(owner: type) -> None:
    """Give a class of the stand-in every name of the same class in Webots."""
    for name, kind in MEMBERS[owner.__name__].items():
        if hasattr(owner, name) or name in _annotated(owner):
            continue
        made: Any = Lacking(f"{owner.__name__}.{name}")
        if kind.startswith("= "):
            made = int(kind[2:])
        elif kind.startswith("property"):
            made = _property(owner, name, is_writable=kind.endswith("write")) or made
        setattr(owner, name, made)


def _annotated(owner: type) -> set[str]:
    return {name for each in owner.__mro__ for name in inspect.get_annotations(each)}


def _property(owner: type, name: str, *, is_writable: bool) -> property | None:
    """Return a property of the methods that it is named after; None without a getter."""
    methods = {method.lower(): method for method in dir(owner) if hasattr(owner, method)}
    accessors = [*_accessors(name)]
    found = [(methods[get.lower()], set_) for get, set_ in accessors if get.lower() in methods]
    if not found:
        return None
    getter, setter = found[0]

    def get(self: Any) -> Any:
        return getattr(self, getter)()

    def set_(self: Any, value: Any) -> None:
        if setter not in methods.values():
            raise lacking(f"{owner.__name__}.{setter}")
        getattr(self, setter)(value)

    return property(get, set_ if is_writable else None)


def _accessors(name: str) -> Iterator[tuple[str, str]]:
    """Yield names of getters and setters that may belong to a property, the likeliest first."""
    if name in _ACCESSORS:
        yield _ACCESSORS[name]
    plain = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
    yield f"get{plain}", f"set{plain}"
    if name == "value":
        yield "getValues", "setValues"
        yield "get", "set"


# Arguments, as ctypes converts them in the real package -------------------------------------------


def integer(value: Any, position: int = 1) -> int:
    """Return an `int` argument; anything else is refused, even `32.0`.

    Args:
        value: The argument.
        position: Its position in the C function, for the message.
    """
    if not isinstance(value, int):
        raise ctypes.ArgumentError(
            f"argument {position}: TypeError: Don't know how to convert parameter {position}"
        )
    return value


def number(value: Any) -> float:
    """Return a `double` argument: any number, no text."""
    return ctypes.c_double(value).value


def numbers(values: Any, count: int) -> list[float]:
    """Return a `double` array argument of at most `count` numbers, filled up with zeros."""
    return [*(ctypes.c_double * count)(*values)]


def text(value: Any) -> str:
    """Return a `char *` argument: `str` only, no path objects, no None."""
    str.encode(value)
    return value


def say(line: str) -> None:
    """Write a line to the C stderr as the real library does, bypassing Python's `sys.stderr`."""
    os.write(2, f"{line}\n".encode())
