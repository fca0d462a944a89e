"""The stand-in's `controller` package has no name of its own: all are Webots', or refused."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import controller
import pytest
from controller.lacking import CLASSES, NotInStandInError

from webots_mcp.standin import LIBRARY

INSTANCE_ATTRIBUTES = {"Robot": {"keyboard", "mouse", "joystick"}}
"""In Webots they are made by the constructor, so they stand in no table of classes."""


class Member(NamedTuple):
    """A member of a class of the real package."""

    class_name: str
    name: str
    kind: str
    """Parameters in parentheses, `property`, `property read-write`, `= 3` or `constant`."""


def surface() -> Iterator[Member]:
    class_name = ""
    path = Path(__file__).with_name("real_surface.txt")
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("  "):
            member = line.strip().partition(" [R20")[0]
            name = member.replace("(", " ").split()[0]
            yield Member(class_name, name, member.removeprefix(name).strip())
        elif not line.startswith("#"):
            class_name = line.partition(":")[0]
            yield Member(class_name, "__init__", "constant")


REAL = [*surface()]
HAD = sorted({member.class_name for member in REAL} - set(CLASSES))


def raw(class_name: str, name: str) -> Any:
    return inspect.getattr_static(getattr(controller, class_name), name, None)


def kind_of(value: Any) -> str:
    if isinstance(value, property):
        return "property" if value.fset is None else "property read-write"
    if isinstance(value, staticmethod):
        return f"static{_parameters(value.__func__)}"
    return _parameters(value) if inspect.isfunction(value) else f"= {value}"


def _parameters(function: Any) -> str:
    parameters = inspect.signature(function).parameters.values()
    plain = [p.replace(annotation=inspect.Parameter.empty) for p in parameters]
    return str(inspect.Signature(plain)).replace("0.0", "0").replace("_arg_self", "self")


def is_lacking(value: Any) -> bool:
    return type(value).__name__ == "_Lacking"


@pytest.mark.parametrize("class_name", HAD)
def test_what_the_stand_in_has_is_named_as_in_webots(class_name: str) -> None:
    real: dict[str, set[str]] = {}
    for member in REAL:
        if member.class_name == class_name and member.name != "__init__":
            real.setdefault(member.name, set()).add(member.kind)
    mine = {
        name: raw(class_name, name)
        for name in dir(getattr(controller, class_name))
        if not name.startswith("_")
    }
    assert set(mine) - set(real) - INSTANCE_ATTRIBUTES.get("Robot", set()) == set()
    assert set(real) - set(mine) == set(), "neither there nor said to be lacking"
    kinds = {name: kind_of(value) for name, value in mine.items() if not is_lacking(value)}
    wrong = {
        name: (kind, real[name])
        for name, kind in kinds.items()
        if real[name] != {"constant"} and kind not in real[name]
    }
    assert wrong == {}


@pytest.mark.parametrize("class_name", HAD)
def test_what_a_class_lacks_says_so_when_it_is_read_or_set(class_name: str) -> None:
    owner = getattr(controller, class_name)
    lacked = [m.name for m in REAL if m.class_name == class_name and is_lacking(raw(*m[:2]))]
    for name in lacked:
        with pytest.raises(NotInStandInError, match=rf"has no \w+\.{name}; see docs/standin.md"):
            getattr(owner, name)
        with pytest.raises(NotInStandInError):
            setattr(owner.__new__(owner), name, 1)


@pytest.mark.parametrize("class_name", sorted(CLASSES))
def test_a_class_that_is_lacking_can_be_imported_but_not_used(class_name: str) -> None:
    assert class_name in {member.class_name for member in REAL}
    lacked = getattr(controller, class_name)
    with pytest.raises(NotInStandInError, match=rf"has no {class_name}; see docs/standin.md"):
        lacked("x")
    with pytest.raises(NotInStandInError, match=rf"has no {class_name}\.RGB; see"):
        _ = lacked.RGB


@pytest.mark.parametrize(
    ("statement", "error"),
    [
        ("from controller import Device", "ImportError: cannot import name 'Device'"),
        ("from controller import Sensor", "ImportError: cannot import name 'Sensor'"),
        ("from controller import *", "TypeError: Item in controller.__all__ must be str, not type"),
        ("import controller; controller.Joint", "has no attribute 'Joint'"),
    ],
)
def test_imports_that_fail_in_webots_fail_here(statement: str, error: str) -> None:
    run = subprocess.run(
        [sys.executable, "-c", statement],
        env={"PYTHONPATH": str(LIBRARY)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert error in run.stderr
