"""Objects that a controller often has, and objects whose parts are not what they seem.

No code of the user runs meanwhile, and one strange part does not hide the others.
"""

from __future__ import annotations

import array
import ctypes
import enum
import types
from collections import namedtuple
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone, tzinfo
from fractions import Fraction
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.bridge.inspection import hostile
from webots_mcp.bridge.inspection.attribute_paths import PathEndsError, follow
from webots_mcp.bridge.inspection.values import Renderer, signal_value
from webots_mcp.database.secret_names import LEFT_OUT, SecretNames
from webots_mcp.database.variable_paths import parse_path

NO_SECRETS = SecretNames()
Loose: Any = namedtuple("Loose", "x y")  # pyright: ignore[reportUntypedNamedTuple]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """No code of the hostile objects may run in any test of this file."""
    hostile.calls.clear()
    yield
    assert hostile.calls == []


def shown(value: object, depth: int = 2) -> Any:
    return Renderer(NO_SECRETS).render(value, depth, "x")


def at(path: str, **variables: object) -> Any:
    parsed = parse_path(path, NO_SECRETS)
    return follow(parsed, variables[parsed.root])


class Mode(enum.Enum):
    DRIVE = 1
    TURN = 2


class Fault(enum.Flag):
    WHEEL = 1
    LIDAR = 2


class Pose(NamedTuple):
    x_m: float
    y_m: float


class Reading(ctypes.Structure):
    _fields_ = (("range_m", ctypes.c_double), ("layer", ctypes.c_int))


class Limits:
    speed = 2.5
    _hidden = 1

    @staticmethod
    def computed() -> float:
        hostile.calls.append("staticmethod")
        return 1.0


class Route(list[int]):
    def __iter__(self) -> Any:
        hostile.calls.append("list iter")
        return super().__iter__()


class Zone(tzinfo):
    def utcoffset(self, dt: datetime | None) -> timedelta:
        hostile.calls.append("utcoffset")
        return timedelta(0)


class Text(str):
    def __str__(self) -> str:
        hostile.calls.append("text str")
        return "text"

    def __format__(self, spec: str) -> str:
        hostile.calls.append("text format")
        return "text"


class Lender:
    __slots__ = ("lent",)


class Borrower:
    """Has the slot and the `__dict__` of other classes."""

    lent = Lender.__dict__["lent"]

    def __init__(self) -> None:
        self.own = 1


class Pretender:
    """Its class's module is an object that says that it is a text."""


Pretender.__module__ = hostile.Masked()  # type: ignore[assignment]
renamed = type("Renamed", (), {})
renamed.__name__ = Text("Renamed")
hollow = types.ModuleType("hollow")
hollow.__dict__["__name__"] = hostile.Loud()
borrowed_dict = type("Borrowed", (), {"__dict__": Borrower.__dict__["__dict__"]})


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({Mode.DRIVE: 1, Mode.TURN: 2}, {"Mode.DRIVE": 1, "Mode.TURN": 2}),
        ({(3, 4): 1.5, (3, 5): 2.5}, {"(3, 4)": 1.5, "(3, 5)": 2.5}),
        ({np.int64(3): 1}, {"3": 1}),
        ({1: "a", "1": "b"}, {"1": "a", "1 (2)": "b"}),
        ({10**5000: 1}, {"<int of 16610 bits>": 1}),
        (Pose(1.0, 2.0), {"<class>": "Pose", "x_m": 1.0, "y_m": 2.0}),
        (Loose(1, 2), {"<class>": "Loose", "x": 1, "y": 2}),
        (Route([1, 2]), {"<class>": "Route", "<items>": [1, 2]}),
        (Reading(1.5, 3), {"<class>": "Reading", "range_m": 1.5, "layer": 3}),
        (ctypes.c_double(1.5), 1.5),
        ((ctypes.c_float * 3)(1, 2, 3), "<c_float_Array_3: 1, 2, 3>"),
        (Fault.WHEEL, "Fault.WHEEL"),
        (ValueError("too far"), "<ValueError: too far>"),
        (np.str_("a"), "a"),
        (np.complex128(1j), "1j"),
        (np.zeros((0, 3)), "<array 0 x 3 of float64>"),
        (array.array("d", [1.5, 2.5]), "<array: 1.5, 2.5>"),
        (np.ma.masked_array([1, 2], mask=[False, True]), "<MaskedArray 2 of int64>"),
        (np.array(3.5), "<array 1 value of float64: 3.5>"),
        (Fraction(1, 3), "1/3"),
        (Fraction(10**5000), "<Fraction>"),
        (PurePosixPath("a"), "a"),
        (datetime(2025, 1, 2, 3, 4, 5, tzinfo=timezone.utc), "2025-01-02 03:04:05"),
        (datetime(2025, 1, 2, 3, 4, 5, tzinfo=Zone()), "2025-01-02 03:04:05"),
        (Borrower(), {"<class>": "Borrower", "own": 1}),
        (borrowed_dict(), {"<class>": "Borrowed"}),
        (Pretender(), {"<class>": "Pretender"}),
        (renamed(), {"<class>": "Renamed"}),
        (hollow, "<module>"),
    ],
)  # fmt: skip
def test_a_value_is_shown_as_what_it_is(value: object, expected: object) -> None:
    hostile.calls.clear()  # of what the parameters did
    assert shown(value) == expected


def test_a_path_of_a_subclass_of_text_runs_none_of_its_code() -> None:
    path = PurePosixPath(Text("a"))
    hostile.calls.clear()
    assert shown(path) in ("text", "<PurePosixPath>")  # before Python 3.12 it is a text by now


def test_long_arrays_of_many_fields_stay_short() -> None:
    fields = np.zeros(2, dtype=[(f"field_{i}", "f8") for i in range(500)])
    assert len(shown(fields)) < 150


def test_numbers_and_texts_find_space_before_long_lists() -> None:
    scans = {f"scan_{i}": [float(j) for j in range(100)] for i in range(40)}
    found = Renderer(NO_SECRETS).members([*scans.items(), ("speed", 2.5)], 2)
    assert found["speed"] == 2.5
    assert next(iter(found)) == "scan_0"
    assert len(found) < 41


@pytest.mark.parametrize("name", ["db_pwd", "userPwd", "api-key", "ACCESS_KEY", "ssh_key_2"])
def test_more_names_look_secret(name: str) -> None:
    assert shown({name: "s3cr3t"}) == {name: LEFT_OUT}


def test_a_secret_at_the_end_of_a_long_key_is_one() -> None:
    assert list(shown({"x" * 70 + "_password": "s3cr3t"}).values()) == [LEFT_OUT]


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("pose.x_m", 1.0),
        ("pose[1]", 2.0),
        ("reading.range_m", 1.5),
        ("Limits.speed", 2.5),
        ("text[1]", "b"),
        ("ranges[-1]", 2.0),
        ("rows['x'][1]", 4.0),
        ("grid[1]['x']", 4.0),
    ],
)
def test_a_path_is_followed(path: str, value: object) -> None:
    rows = np.array([(3.0, 1), (4.0, 2)], dtype=[("x", "f8"), ("n", "i4")])
    variables = {
        "pose": Pose(1.0, 2.0), "reading": Reading(1.5, 3), "Limits": Limits, "text": "abc",
        "ranges": (ctypes.c_float * 2)(1, 2), "rows": rows, "grid": [{}, {"x": 4.0}],
    }  # fmt: skip
    assert at(path, **variables) == value


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("Limits.sped", "^Limits has no 'sped'; it has speed, _hidden"),
        ("Limits.computed", "'computed' of Limits is computed .staticmethod."),
        ("borrower.lent", "'lent' of Borrower has no value"),
        ("huge['x']", "it has 'a"),
    ],
)
def test_a_path_that_ends_early_says_what_is_there(path: str, why: str) -> None:
    variables = {"Limits": Limits, "borrower": Borrower(), "huge": {"a" * 10_000: 1}}
    with pytest.raises(PathEndsError, match=why) as caught:
        at(path, **variables)
    assert len(str(caught.value)) < 700


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ((ctypes.c_float * 2)(1, 2), [1.0, 2.0]),
        (ctypes.c_int(3), 3),
        (array.array("d", [1.5]), [1.5]),
        (np.arange(100), "<array 100 of int64: 0, 1, 2, 3, 4, 5, ...>"),
        (np.zeros(2, dtype=[("x", "f8")]), "<array 2 of [('x', '<f8')]>"),
        (Fault.LIDAR, "Fault.LIDAR"),
    ],
)
def test_a_watched_value_is_plain(value: object, expected: object) -> None:
    assert signal_value(value) == expected
