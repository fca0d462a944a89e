"""The stand-in's `controller` package has no name of its own: all are Webots', or refused."""

from __future__ import annotations

import inspect
import subprocess
import sys
from typing import Any

import controller
import pytest
from controller.surface import MEMBERS, Lacking, NotInStandInError

from webots_mcp.standin import LIBRARY

HAD = sorted(each.__name__ for each in controller.__all__)
LACKED = sorted(set(MEMBERS) - set(HAD))


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


@pytest.mark.parametrize("class_name", HAD)
def test_what_the_stand_in_has_is_named_as_in_webots(class_name: str) -> None:
    real = {name: kind for name, kind in MEMBERS[class_name].items() if kind != "attribute"}
    names = {name for name in dir(getattr(controller, class_name)) if not name.startswith("_")}
    made = {name for name, kind in MEMBERS["Robot"].items() if kind == "attribute"}
    assert names - {*MEMBERS[class_name]} - made == set()
    assert real.keys() - names == set(), "neither there nor said to be lacking"
    wrong = {
        name: (kind_of(value), kind)
        for name, kind in real.items()
        if kind != "constant"
        and not isinstance(value := raw(class_name, name), Lacking)
        and kind_of(value) != kind
    }
    assert wrong == {}


@pytest.mark.parametrize("class_name", HAD)
def test_what_a_class_lacks_says_so_when_it_is_read_or_set(class_name: str) -> None:
    owner = getattr(controller, class_name)
    for name in MEMBERS[class_name]:
        if isinstance(raw(class_name, name), Lacking):
            with pytest.raises(
                NotInStandInError, match=rf"has no \w+\.{name}; see 'webots-mcp help standin'"
            ):
                getattr(owner, name)
            with pytest.raises(NotInStandInError):
                setattr(owner.__new__(owner), name, 1)


@pytest.mark.parametrize("class_name", LACKED)
def test_a_class_that_is_lacking_can_be_imported_but_not_used(class_name: str) -> None:
    lacked = getattr(controller, class_name)
    with pytest.raises(
        NotInStandInError, match=rf"has no {class_name}; see 'webots-mcp help standin'"
    ):
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
