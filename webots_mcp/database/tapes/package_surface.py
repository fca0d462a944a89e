"""The classes of Webots' Python packages: their members, and which of these ask or command."""

from __future__ import annotations

import inspect
import sys
from typing import Any, Final, cast

caller_frame: Final = sys._getframe  # pyright: ignore[reportPrivateUsage]
"""Returns the frame of a caller, one call up for 1."""
PACKAGES: Final = ("controller", "vehicle")
STEPS: Final = ("step", "stepBegin", "stepEnd")
_COMMANDS: Final = (
    "set", "send", "enable", "disable", "turnOn", "turnOff", "lock", "unlock", "presence", "reset",
    "add", "remove", "import", "insert", "simulationReset", "simulationQuit", "simulationSetMode",
    "simulationRevert", "world", "save", "wwiSend", "speak", "play", "stop", "loop", "draw", "fill",
    "lay", "exportImage", "moveViewpoint", "loadState", "batterySensorEnable",
    "batterySensorDisable", "movieSt", "animationSt", "restart", "imageNew", "imagePaste",
    "imageDelete", "nextPacket", "erase", "recognitionEnable", "recognitionDisable", "attach",
    "detach", "imageSave", "write",
)  # fmt: skip


def kind_of_member(name: str) -> str:
    """Return `command` for a method that sets something, `question` for one that only returns."""
    return "command" if name.startswith(_COMMANDS) else "question"


def classes_of(package: str) -> dict[str, type]:
    """Return the classes of a package that is loaded, base classes too, by name."""
    module = sys.modules.get(package)
    if module is None:
        return {}
    public = [each for each in vars(module).values() if isinstance(each, type)]
    found: dict[str, type] = {}
    for cls in public:
        for base in cls.__mro__:
            if base.__module__.partition(".")[0] == package:
                found.setdefault(base.__name__, base)
    return found


def describe_package(package: str) -> dict[str, Any]:
    """Return what a replay needs to make the classes of a package again, by class."""
    return {name: _describe_class(cls) for name, cls in classes_of(package).items()}


def _describe_class(cls: type) -> dict[str, Any]:
    methods: list[str] = []
    static: list[str] = []
    properties: dict[str, bool] = {}
    constants: dict[str, Any] = {}
    for name, member in vars(cls).items():
        if name.startswith("_"):
            continue
        if inspect.isfunction(member):
            methods.append(name)
        elif isinstance(member, (staticmethod, classmethod)):
            static.append(name)
        elif isinstance(member, property):
            properties[name] = cast("Any", member).fset is not None
        elif type(member) in (int, float, str, bool):
            constants[name] = member
    return {
        "bases": [base.__name__ for base in cls.__bases__ if base is not object],
        "methods": methods,
        "static": static,
        "properties": properties,
        "constants": constants,
    }
