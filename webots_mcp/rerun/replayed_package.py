"""Makes the classes of Webots' packages again, whose objects answer from a tape."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Final

from webots_mcp.database.tapes.package_surface import STEPS, caller_frame, kind_of_member
from webots_mcp.rerun.replayed_tape import ReplayedTape, active

_OWN: Final = frozenset({"webots_mcp", "controller", "vehicle"})
_PARTS: Final = ("keyboard", "mouse", "joystick")  # attributes of a robot


class ReplayedObject:
    """An object of Webots' package; `_path` says which one."""

    _webots_mcp_replayed = True

    def __init__(self, *arguments: Any, **_: Any) -> None:
        owner = _public_class(type(self)).__name__
        if arguments and isinstance(arguments[0], str) and owner in _device_classes():
            path = self.__dict__["_path"] = f"device:{arguments[0]}"
            active().named.add(path)  # which enables a sensor
            return
        unnamed = active().unnamed
        unnamed[owner] += 1
        self.__dict__["_path"] = f"{owner}#{unnamed[owner]}"


def make_package(package: str, namespace: dict[str, Any]) -> None:
    """Put the classes of a package into its namespace, as the tape says that they were."""
    tape = active()
    described: dict[str, Any] = tape.tape.head["packages"].get(package, {})
    for name in described:
        _make_class(tape, described, name)
    for name in described:
        cls = tape.classes[name]
        cls.__module__ = package
        namespace[name] = cls
    namespace["__all__"] = list(described)


def _make_class(tape: ReplayedTape, described: dict[str, Any], name: str) -> type:
    if name in tape.classes:
        return tape.classes[name]
    facts = described[name]
    bases = tuple(
        _make_class(tape, described, base)
        for base in facts["bases"]
        if base in described or base in tape.classes
    )
    members: dict[str, Any] = dict(facts["constants"])
    for each in facts["methods"]:
        members[each] = _method(tape, name, each, is_step=each in STEPS and _is_robot(facts, bases))
    for each in facts["static"]:
        members[each] = staticmethod(_STATIC.get(each) or _missing_static(tape, name, each))
    for each in facts["properties"]:
        members[each] = _property(tape, name, each)
    if name == "Robot":
        members |= {"__init__": _begin_robot, "created": None}
    tape.classes[name] = made = type(name, bases or (ReplayedObject,), members)
    return made


def _is_robot(facts: dict[str, Any], bases: tuple[type, ...]) -> bool:
    return "getTime" in facts["methods"] or any(hasattr(base, "getTime") for base in bases)


def _begin_robot(robot: Any) -> None:
    tape = active()
    tape.classes["Robot"].created = robot
    robot.__dict__["_path"] = "robot"
    devices: dict[str, str] = tape.tape.head["devices"]
    robot.devices = {name: tape.make(f"device:{name}", kind) for name, kind in devices.items()}
    for part in _PARTS:
        kind = part.capitalize()
        if kind in tape.classes and part not in type(robot).__dict__:
            robot.__dict__[part] = tape.make(f"{kind}#1", kind)


def _device_classes() -> set[str]:
    classes = active().classes
    device = classes.get("Device")
    return {name for name, cls in classes.items() if device and issubclass(cls, device)}


@functools.cache
def _public_class(cls: type) -> type:
    """Return the class of Webots' package that a user's class derives from."""
    classes = set(active().classes.values())
    return next((each for each in cls.__mro__ if each in classes), cls)


def _is_own(frame: Any) -> bool:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] in _OWN


def _method(tape: ReplayedTape, owner: str, name: str, *, is_step: bool) -> Callable[..., Any]:
    is_command = kind_of_member(name) == "command"

    def step(_: Any, *args: Any, **kwargs: Any) -> Any:
        frame = caller_frame(1)
        if frame.f_code.co_name in ("exchange", "advance") and _is_own(frame):
            return 0
        return tape.step(name, (*args, *kwargs.values()))

    def call(source: Any, *args: Any, **kwargs: Any) -> Any:
        frame = caller_frame(1)
        arguments = (*args, *kwargs.values())
        path = source.__dict__.get("_path", owner)
        kind = "Robot" if path == "robot" else _public_class(source.__class__).__name__
        is_own = _is_own(frame)
        if is_command:
            return None if is_own else tape.command(path, kind, name, arguments, frame)
        return tape.ask(path, kind, name, arguments, is_own=is_own)

    made = step if is_step else call
    made.__name__ = name
    return made


def _property(tape: ReplayedTape, owner: str, name: str) -> property:
    def get(source: Any) -> Any:
        path = source.__dict__.get("_path", owner)
        return tape.ask(path, owner, f".{name}", (), is_own=_is_own(caller_frame(1)))

    def set_(source: Any, value: Any) -> None:
        frame = caller_frame(1)
        kind = _public_class(source.__class__).__name__
        if not _is_own(frame):
            tape.command(source.__dict__.get("_path", owner), kind, f".{name}", (value,), frame)

    return property(get, set_)


# -- static methods, which compute from their arguments alone --------------------------------------


def _pixel(channel: int) -> Callable[..., int]:
    def read(image: Any, width: int, x: int, y: int) -> int:
        return image[4 * (y * width + x) + channel]

    return read


def _gray(image: Any, width: int, x: int, y: int) -> float:
    start = 4 * (y * width + x)
    return (image[start] + image[start + 1] + image[start + 2]) / 3


def _depth(image: Any, width: int, x: int, y: int) -> float:
    return image[y * width + x]


_STATIC: Final[dict[str, Callable[..., Any]]] = {
    "imageGetBlue": _pixel(0), "imageGetGreen": _pixel(1), "imageGetRed": _pixel(2),
    "imageGetGray": _gray, "imageGetGrey": _gray, "rangeImageGetDepth": _depth,
}  # fmt: skip


def _missing_static(tape: ReplayedTape, owner: str, name: str) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        return tape.ask(owner, owner, name, (*args, *kwargs.values()), is_own=False)

    return call
