"""Parameters are declared in a controller, and the declaration is recorded."""

from __future__ import annotations

import enum
import math
from typing import Any

import numpy as np
import pytest

from tests.bridge.conftest import Recording
from tests.bridge.parameters.conftest import VALUES, ask
from webots_mcp import MCPBridge
from webots_mcp.signals.parameter import MOST_PARAMETERS


def test_a_declaration_is_recorded_with_all_that_it_says(
    bridge: MCPBridge, recording: Recording
) -> None:
    kp = bridge.parameter("kp", 2.0, low=0, high=10.0, doc="steering gain", unit="1/s")
    gait = bridge.parameter("gait", "trot", choices=["trot", "walk"])
    assert (kp.value, gait.value) == (2.0, "trot")
    sql = "SELECT name, kind, default_value, low, high, choices, doc, unit FROM parameter"
    assert recording.rows(f"{sql} ORDER BY id") == [
        ("kp", "float", "2.0", 0.0, 10.0, None, "steering gain", "1/s"),
        ("gait", "str", '"trot"', None, None, '["trot", "walk"]', "", None),
    ]
    assert recording.rows(VALUES) == [
        (1, "kp", "2.0", 1, "code", None),
        (1, "gait", '"trot"', 1, "code", None),
    ]


@pytest.mark.parametrize(
    ("default", "kind", "held"),
    [
        (2, "int", 2),
        (True, "bool", True),
        (np.float32(0.5), "float", 0.5),
        (np.int64(7), "int", 7),
        (np.bool_(True), "bool", True),
        (np.array(1.5), "float", 1.5),
        (np.str_("a"), "str", "a"),
        (enum.IntEnum("Gear", {"LOW": 1}).LOW, "int", 1),
    ],
)
def test_the_default_decides_the_type_as_a_plain_python_value(
    bridge: MCPBridge, recording: Recording, default: Any, kind: str, held: Any
) -> None:
    parameter = bridge.parameter("p", default)
    assert (type(parameter.value), parameter.value) == (type(held), held)
    assert recording.rows("SELECT kind FROM parameter") == [kind]


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"default": None}, TypeError, "the default is a float, int, bool or str, not None"),
        ({"default": [1.0]}, TypeError, "not [1.0] (list)"),
        ({"default": np.array([1.0, 2.0])}, TypeError, "ndarray"),
        ({"default": math.nan}, ValueError, "must be a number, not nan"),
        ({"default": math.inf}, ValueError, "must be a number, not inf"),
        ({"default": 2**53 + 1}, ValueError, "at most 53 bits"),
        ({"default": 10**5000}, ValueError, "no text"),
        ({"default": 1.0, "low": 2}, ValueError, "must be a number from 2, not 1.0"),
        ({"default": 1.0, "low": 3, "high": 2}, ValueError, "low=3 is greater than high=2"),
        ({"default": 1.0, "low": math.nan}, ValueError, "a bound is a finite number"),
        ({"default": 1.0, "low": math.inf}, ValueError, "a bound is a finite number"),
        ({"default": 1.0, "low": "0"}, TypeError, "a bound is a number, not '0'"),
        ({"default": 1, "low": True}, TypeError, "a bound is a number, not True"),
        ({"default": "a", "low": 1}, TypeError, "a str has no bounds"),
        ({"default": True, "high": 1}, TypeError, "a bool has no bounds"),
        ({"default": "a", "choices": "abc"}, TypeError, "choices is a list of values"),
        ({"default": "a", "choices": []}, ValueError, "give 1 to 100 choices, not 0"),
        ({"default": "a", "choices": ["b"]}, ValueError, "must be one of 'b', not 'a'"),
        ({"default": 1, "choices": [1, "2"]}, ValueError, "not '2'"),
        ({"default": 9, "choices": [1, 9], "high": 5}, ValueError, "up to 5, not 9"),
        ({"default": "\ud800"}, ValueError, "must be a text"),
        ({"default": "a\0b"}, ValueError, "must be a text"),
        ({"default": "x" * 1001}, ValueError, "at most 1000 characters"),
        ({"default": 1.0, "unit": 3}, TypeError, "the unit is a short text"),
        ({"name": "", "default": 1.0}, ValueError, "needs another name"),
        ({"name": "a b", "default": 1.0}, ValueError, "needs another name"),
        ({"name": "a=b", "default": 1.0}, ValueError, "needs another name"),
        ({"name": "x" * 101, "default": 1.0}, ValueError, "needs another name"),
        ({"name": "a\ud800", "default": 1.0}, ValueError, "needs another name"),
        ({"name": 7, "default": 1.0}, TypeError, "the name of a parameter is a text, not 7"),
    ],
)
def test_a_wrong_declaration_is_refused_where_it_stands(
    bridge: MCPBridge,
    recording: Recording,
    arguments: dict[str, Any],
    error: type[Exception],
    said: str,
) -> None:
    given: dict[str, Any] = {"name": "p", **arguments}
    with pytest.raises(error) as raised:
        bridge.parameter(**given)
    assert said in str(raised.value)
    assert recording.rows("SELECT name FROM parameter") == []


def test_declaring_again_the_same_writes_nothing_and_gives_the_same_parameter(
    bridge: MCPBridge, recording: Recording
) -> None:
    first = bridge.parameter("kp", 2.0, low=0)
    assert bridge.parameter("kp", 2.0, low=0) is first
    assert recording.rows("SELECT count(*) FROM parameter_value") == [1]


def test_a_changed_declaration_brings_its_default_unless_the_value_came_from_outside(
    bridge: MCPBridge, recording: Recording
) -> None:
    kp, ki = bridge.parameter("kp", 2.0), bridge.parameter("ki", 0.5)
    ask(recording, bridge, values={"ki": 0.25})
    assert bridge.parameter("kp", 3.0) is kp
    assert bridge.parameter("ki", 0.75, high=1.0) is ki
    assert (kp.value, ki.value) == (3.0, 0.25)
    assert recording.rows("SELECT default_value, high FROM parameter ORDER BY id") == [
        ("3.0", None),
        ("0.75", 1.0),
    ]
    assert recording.rows("SELECT message FROM log WHERE level = 'warning' ORDER BY id") == [
        "parameter 'kp' is declared again, with default 3.0, not 2.0: the last declaration "
        "is used for both",
        "parameter 'ki' is declared again, with default 0.75, not 0.5, high 1.0, not None: the "
        "last declaration is used for both",
    ]


def test_a_value_that_a_changed_declaration_excludes_gives_way_to_the_default(
    lenient: MCPBridge, recording: Recording, capfd: pytest.CaptureFixture[str]
) -> None:
    kp = lenient.parameter("kp", 2.0)
    ask(recording, lenient, values={"kp": 9.0})
    lenient.parameter("kp", 2.0, high=5.0)
    assert kp.value == 2.0
    assert "up to 5, not 9.0" in capfd.readouterr().err


def test_so_many_parameters_and_no_more(bridge: MCPBridge, recording: Recording) -> None:
    for number in range(MOST_PARAMETERS):
        bridge.parameter(f"p{number}", 1.0)
    with pytest.raises(ValueError, match=f"would be number {MOST_PARAMETERS + 1}, "):
        bridge.parameter("one.more", 1.0)
    assert bridge.parameter("p7", 2.0).value == 2.0
    assert recording.rows("SELECT count(*) FROM parameter") == [MOST_PARAMETERS]


def test_the_value_can_only_be_read(bridge: MCPBridge) -> None:
    kp = bridge.parameter("kp", 2.0)
    with pytest.raises(AttributeError, match=r"call its set\(\)"):
        kp.value = 3.0
    assert repr(kp) == "<parameter kp = 2.0>"
