"""Data of ctypes, which Webots' getters return, is recorded as numbers; no pointer is followed."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from typing import Any

import pytest

from tests.bridge.conftest import Recording
from webots_mcp import MCPBridge
from webots_mcp.bridge import encoding

POSE = [1.5, 2.5, 0.25]


class RecognisedObject(ctypes.Structure):
    """Fields as those of Webots' `CameraRecognitionObject`."""

    _fields_ = (
        ("id", ctypes.c_int),
        ("position", ctypes.c_double * 3),
        ("orientation", ctypes.c_double * 4),
        ("size", ctypes.c_double * 2),
        ("size_on_image", ctypes.c_int * 2),
        ("number_of_colors", ctypes.c_int),
        ("colors", ctypes.POINTER(ctypes.c_double)),
        ("_model", ctypes.c_char_p),
    )


@pytest.mark.usefixtures("encoder")
def test_numbers_arrays_and_structures_are_recorded_as_numbers(
    bridge: MCPBridge, recording: Recording
) -> None:
    class Flagged(RecognisedObject):
        _fields_ = (("flag", ctypes.c_bool),)

    seen = Flagged(7, (1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.5), (0.25, 0.75), (64, 48), 2)
    seen.flag = True
    bridge.publish(
        {
            "position": seen.position,
            "matrix": ((ctypes.c_float * 2) * 2)((1, 2), (3, 4)),
            "force": ctypes.c_double(0.5),
            "name": (ctypes.c_char * 4)(*b"abc"),
            "wide": (ctypes.c_wchar * 3)(*"abc"),
            "empty": (ctypes.c_double * 0)(),
            "seen": [seen],
        }
    )
    (state,) = recording.states()
    assert state == {
        "position": [1.0, 2.0, 3.0],
        "matrix": [[1.0, 2.0], [3.0, 4.0]],
        "force": 0.5,
        "name": "YWJjAA==",
        "wide": "abc",
        "empty": [],
        "seen": [
            {
                "id": 7,
                "position": [1.0, 2.0, 3.0],
                "orientation": [0.0, 0.0, 1.0, 0.5],
                "size": [0.25, 0.75],
                "size_on_image": [64, 48],
                "number_of_colors": 2,
                "colors": None,
                "_model": None,
                "flag": True,
            }
        ],
    }
    (replaced,) = recording.rows("SELECT replaced FROM state")
    assert json.loads(replaced) == {
        "name": "unsupported: bytes",
        "seen.0.colors": "unsupported: LP_c_double",
        "seen.0._model": "unsupported: c_char_p",
    }


NUMBERS: list[Any] = [
    *(ctypes.c_byte, ctypes.c_ubyte, ctypes.c_short, ctypes.c_ushort, ctypes.c_int, ctypes.c_uint),
    *(ctypes.c_long, ctypes.c_ulong, ctypes.c_longlong, ctypes.c_ulonglong, ctypes.c_bool),
    *(ctypes.c_float, ctypes.c_double, ctypes.c_longdouble),
]


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number.__name__)
def test_each_number_of_c_is_a_number_alone_and_in_arrays(number: Any) -> None:
    text, replaced, _ = encoding.encode({"one": number(1), "several": (number * 2)(1, 0)})
    assert (json.loads(text), replaced) == ({"one": 1, "several": [1, 0]}, {})


@pytest.mark.usefixtures("encoder")
def test_a_position_costs_no_more_than_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(state: object) -> Any:
        raise AssertionError(f"{state} took the slow path")

    monkeypatch.setattr(encoding, "_clean_and_encode", refuse)
    position = (ctypes.c_double * 3)(*POSE)
    assert json.loads(encoding.encode({"at": position}).text) == {"at": POSE}


NOWHERE = 8  # an address that ends the process when it is followed


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize(
    "pointer",
    [
        ctypes.cast(NOWHERE, ctypes.POINTER(ctypes.c_double)),
        ctypes.cast(NOWHERE, ctypes.c_char_p),
        ctypes.cast(NOWHERE, ctypes.c_wchar_p),
        ctypes.c_void_p(NOWHERE),
        ctypes.byref(ctypes.c_double()),
        ctypes.cast(NOWHERE, ctypes.POINTER(RecognisedObject)),
    ],
    ids=lambda pointer: type(pointer).__name__,
)
def test_a_pointer_is_named_and_never_followed(pointer: Any) -> None:
    text, replaced, _ = encoding.encode({"touch": pointer, "pose": POSE})
    assert json.loads(text) == {"touch": None, "pose": POSE}
    assert replaced == {"touch": f"unsupported: {type(pointer).__name__}"}


@pytest.mark.usefixtures("encoder")
def test_an_array_of_c_strings_is_not_read_through() -> None:
    names = (ctypes.c_char_p * 2)()
    ctypes.cast(names, ctypes.POINTER(ctypes.c_void_p))[0] = NOWHERE
    assert json.loads(encoding.encode({"names": names}).text) == {"names": [None, None]}


@pytest.mark.usefixtures("encoder")
def test_a_null_pointer_is_named() -> None:
    null = ctypes.POINTER(ctypes.c_double)()
    assert encoding.encode({"touch": null}) == (
        '{"touch":null}',
        {"touch": "unsupported: LP_c_double"},
        0,
    )


def test_ctypes_is_not_imported_for_a_state_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "ctypes")
    assert encoding.encode({"handle": object()}).replaced == {"handle": "unsupported: object"}
    assert "ctypes" not in sys.modules


def test_an_array_does_not_import_numpy_into_the_controller() -> None:
    pytest.importorskip("orjson")
    pytest.importorskip("numpy")
    code = (
        "import ctypes, sys; from webots_mcp.bridge.encoding import encode; "
        "encode({'position': (ctypes.c_double * 3)()}); print('numpy' in sys.modules)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "False\n"
