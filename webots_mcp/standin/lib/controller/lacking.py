"""What Webots' package has and the stand-in does not: it says so, in one sentence, when it is used.

Nothing else is missing: what is neither here nor in the classes is not in Webots either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NoReturn, TypeVar

T = TypeVar("T", bound=type)


class NotInStandInError(AttributeError, NotImplementedError):
    """Webots has it, the stand-in has not; `hasattr` is false, as for any missing attribute."""


def lacking(what: str) -> NotInStandInError:
    """The error for something that Webots has and the stand-in has not."""
    return NotInStandInError(f"the stand-in has no {what}; see docs/standin.md for what it has")


class _Lacking:
    """An attribute that fails when it is read or set."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __get__(self, instance: object, owner: type) -> NoReturn:
        raise lacking(self._what)

    def __set__(self, instance: object, value: object) -> NoReturn:
        raise lacking(self._what)


def lacks(names: str) -> Callable[[T], T]:
    """Mark what a class of the stand-in has not of its namesake in Webots.

    Args:
        names: Names of methods, properties and constants, with spaces between them.
    """

    def mark(marked: T) -> T:
        for name in names.split():
            setattr(marked, name, _Lacking(f"{marked.__name__}.{name}"))
        return marked

    return mark


class _LackingClass(type):
    """The type of classes that can be imported and nothing else."""

    def __call__(cls, *arguments: Any, **named: Any) -> NoReturn:
        raise lacking(cls.__name__)

    def __getattr__(cls, name: str) -> NoReturn:
        raise lacking(f"{cls.__name__}.{name}")


CLASSES: Final = {
    name: _LackingClass(name, (), {"__doc__": "In Webots, but not in the stand-in."})
    for name in (
        *("Altimeter", "AnsiCodes", "Brake", "CameraRecognitionObject", "Connector"),
        *("ContactPoint", "Display", "Emitter", "Joystick", "Motion", "Mouse"),
        *("MouseState", "Proto", "Radar", "RadarTarget", "RangeFinder", "Receiver"),
        *("Skin", "Speaker", "VacuumGripper"),
    )
}
"""The classes that the stand-in has only to import: a controller may import more than it uses."""
