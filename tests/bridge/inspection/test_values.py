"""Values of any objects are shown bounded, and none of the user's code runs meanwhile."""

from __future__ import annotations

import enum
import math
from collections import OrderedDict, defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pytest

from tests.bridge.inspection import hostile
from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.inspection.attribute_paths import PathEndsError, follow
from webots_mcp.bridge.inspection.values import MOST_CHARACTERS, Renderer, signal_value
from webots_mcp.database.secret_names import LEFT_OUT, SecretNames
from webots_mcp.database.variable_paths import parse_path
from webots_mcp.errors import InvalidInputError

NO_SECRETS = SecretNames()


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """No code of the hostile objects may run in any test of this file."""
    hostile.calls.clear()
    yield
    assert hostile.calls == []


def shown(value: object, depth: int = 2, secrets: SecretNames = NO_SECRETS) -> Any:
    return Renderer(secrets).render(value, depth, "x")


def at(path: str, **variables: object) -> Any:
    parsed = parse_path(path, NO_SECRETS)
    return follow(parsed, variables[parsed.root])


class Mode(enum.Enum):
    DRIVE = 1


class Level(enum.IntEnum):
    LOW = 1


class Pid:
    gain = 2.5

    def __init__(self) -> None:
        self.integral = 0.5
        self.history = [1, 2]

    @property
    def error(self) -> float:
        raise AssertionError("a property was read")

    def step(self) -> None: ...


@dataclass
class Goal:
    x_m: float
    parent: Any = None


class Metres(float):
    pass


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (3, 3),
        (True, True),
        (None, None),
        (2.5, 2.5),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
        (10**40, "<int of 133 bits>"),
        (1 + 2j, "(1+2j)"),
        (b"abc", "<bytes of 3>"),
        (range(3), "<range of 3>"),
        ("a" * 200, "a" * 120 + "..."),
        ([1, (2, 3)], [1, [2, 3]]),
        (deque([1]), [1]),
        (OrderedDict[str, int](a=1), {"a": 1}),
        (defaultdict(int, {2: 3}), {"2": 3}),
        (list(range(20)), [*range(8), "... 20 in all"]),
        (Mode.DRIVE, "Mode.DRIVE"),
        (Level.LOW, "Level.LOW"),
        (Decimal("1.50"), "1.50"),
        (PurePosixPath("/a/b"), "/a/b"),
        (np.float64(0.25), 0.25),
        (np.int8(3), 3),
        (np.arange(3.0), "<array 3 of float64: 0, 1, 2>"),
        (np.zeros((480, 640)), "<array 480 x 640 of float64: 0, 0, 0, 0, 0, 0, ...>"),
        (np.array([object()]), "<array 1 of object>"),
        (Pid, "<class Pid>"),
        (shown, "<function shown>"),
        (Pid().step, "<method Pid.step>"),
        (len, "<function len>"),
        (math, "<module math>"),
        (partial(len), "<partial>"),
        (Pid(), {"<class>": "Pid", "integral": 0.5, "history": [1, 2]}),
        (Goal(1.0), {"<class>": "Goal", "x_m": 1.0, "parent": None}),
        (Metres(2.0), {"<class>": "Metres", "<value>": 2.0}),
        (hostile.Slotted(), {"<class>": "Slotted", "filled": 4}),
        (hostile.Loud(), {"<class>": "Loud", "kept": 3}),
        (hostile.Loud, "<class Loud>"),
        ({hostile.Loud(): 1}, {"<Loud>": 1}),
        (hostile.LoudDict(a=1), {"<class>": "LoudDict", "<items>": {"a": 1}}),
    ],
)
def test_a_value_is_shown_as_what_it_is(value: object, expected: object) -> None:
    found = shown(value)
    assert found == expected
    assert not encode({"x": found}).replaced


def test_an_object_that_masks_its_class_and_dict_shows_its_own_attributes() -> None:
    masked = hostile.Masked()
    assert shown(masked)["<class>"] == "Masked"


def test_generators_are_named_with_their_line_and_not_advanced() -> None:
    def count() -> Iterator[int]:
        yield 1
        yield 2

    generator = count()
    next(generator)
    assert shown(generator).startswith("<generator count, at line ")
    assert next(generator) == 2


def test_an_object_is_shown_once_and_a_circle_ends() -> None:
    goal = Goal(1.0)
    goal.parent = goal
    assert shown(goal) == {"<class>": "Goal", "x_m": 1.0, "parent": "(the same as x)"}
    both = shown([goal.x_m, goal, goal])
    assert both[2] == "(the same as x[1])"


def test_attributes_are_shown_one_level_deep() -> None:
    goal = Goal(1.0, Goal(2.0, Goal(3.0)))
    assert shown(goal, depth=1) == {"<class>": "Goal", "x_m": 1.0, "parent": "<Goal>"}


@pytest.mark.parametrize(
    "huge",
    [
        {f"key {i}": ["x" * 500] * 50 for i in range(500)},
        [[[[0] * 100] * 100] * 100] * 100,
        Goal(0.0, [Goal(float(i), "y" * 1000) for i in range(1000)]),
    ],
)
def test_whatever_it_is_it_stays_short(huge: object) -> None:
    text = encode({"x": shown(huge, depth=3)}).text
    assert len(text) < 3 * MOST_CHARACTERS


@pytest.mark.parametrize(
    "name",
    ["password", "db_passwd", "API_KEY", "accessToken", "client_secret", "auth", "authHeader"],
)
def test_values_of_names_that_look_secret_are_left_out(name: str) -> None:
    assert shown({name: "s3cr3t"}) == {name: LEFT_OUT}
    with pytest.raises(InvalidInputError, match="looks secret"):
        parse_path(f"self.{name}", NO_SECRETS)


@pytest.mark.parametrize("name", ["author", "passed", "bypass", "distance", "key"])
def test_other_names_are_not_secret(name: str) -> None:
    assert shown({name: 1}) == {name: 1}


def test_a_project_names_more_secrets() -> None:
    assert shown({"door_pin": 1, "pin": 2}, secrets=SecretNames(("*_pin",))) == {
        "door_pin": LEFT_OUT,
        "pin": 2,
    }


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("pid.integral", 0.5),
        ("pid.gain", 2.5),
        ("pid . history [ -1 ]", 2),
        ("table['a'][1]", 7),
        ('table["b"]', None),
        ("table[3]", "three"),
        ("grid[1]", 5.0),
        ("slots.filled", 4),
        ("loud.kept", 3),
        ("own['a']", 1),
    ],
)
def test_a_path_is_followed(path: str, value: object) -> None:
    variables = {
        "pid": Pid(), "table": {"a": [6, 7], "b": None, 3: "three"}, "grid": np.array([4.0, 5.0]),
        "slots": hostile.Slotted(), "loud": hostile.Loud(), "own": hostile.LoudDict(a=1),
    }  # fmt: skip
    assert at(path, **variables) == value


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("pid.integrall", "Pid has no 'integrall'; it has integral, history"),
        ("pid.error", "'error' of Pid is computed .property.: reading it would run code"),
        ("loud.computed", "'computed' of Loud is computed"),
        ("loud[3]", ".3. of Loud would run code"),
        ("table['c']", "there is no .'c'. in a dict; it has 'a'"),
        ("table['a'][5]", "there is no .5. in a list of 2"),
        ("slots.empty", "'empty' of Slotted has no value yet"),
        ("keyed['kept']", "there is no .'kept'. in a dict"),
    ],
)
def test_a_path_that_ends_early_says_where_and_what_is_there(path: str, why: str) -> None:
    variables = {
        "pid": Pid(), "table": {"a": [6, 7]}, "slots": hostile.Slotted(), "loud": hostile.Loud(),
        "keyed": {hostile.Loud(): 1},
    }  # fmt: skip
    hostile.calls.clear()  # of the hash, when the dict was made here
    with pytest.raises(PathEndsError, match=why):
        at(path, **variables)


@pytest.mark.parametrize(
    "text",
    ["", "3", ".x", "a b", "a..b", "a[", "a[x]", "a()", "a.b()", "a[1:2]", "a" * 300, None, 3],
)
def test_what_is_no_path_is_refused_with_an_example(text: object) -> None:
    with pytest.raises(InvalidInputError, match=r"self\.pid\.integral"):
        parse_path(text, NO_SECRETS)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (1, 1),
        ("drive", "drive"),
        ([1, 2.0], [1, 2.0]),
        (np.array([1.0, 2.0]), [1.0, 2.0]),
        (np.float32(0.5), 0.5),
        (Mode.DRIVE, "Mode.DRIVE"),
        (Metres(2.0), 2.0),
        (Pid(), "<Pid>"),
        (hostile.Loud(), "<Loud>"),
        ({"a": 1}, "<dict>"),
    ],
)
def test_a_watched_value_is_plain(value: object, expected: object) -> None:
    assert signal_value(value) == expected
