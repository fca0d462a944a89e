"""NaN and infinities at paths where earlier rows had them are replaced without the slow path."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from webots_mcp.bridge import encoding

WHEELS = {
    name: {"target_position_rad": math.inf, "target_velocity_rad_s": 2.5}
    for name in ("left wheel", "right wheel")
}


def without_slow_path(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(state: object) -> Any:
        raise AssertionError(f"{state} took the slow path")

    monkeypatch.setattr(encoding, "_clean_and_encode", refuse)


@pytest.mark.usefixtures("encoder")
def test_wheels_without_a_target_position_take_the_fast_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state = {"motors": WHEELS, "ranges_m": [0.5, math.inf, math.inf], "front_m": math.nan}
    first = encoding.encode(state)
    without_slow_path(monkeypatch)
    assert encoding.encode(state) == first
    assert first.replaced == {
        "front_m": "nan",
        "ranges_m.*": "inf",
        "motors.left wheel.target_position_rad": "inf",
        "motors.right wheel.target_position_rad": "inf",
    }


@pytest.mark.usefixtures("encoder")
def test_two_robots_in_one_process_do_not_forget_each_others_paths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    states: list[dict[str, Any]] = [{"motors": WHEELS}, {"motors": math.nan}, {"scan": [math.inf]}]
    first = [encoding.encode(state) for state in states]
    without_slow_path(monkeypatch)
    assert [encoding.encode(state) for state in states] == first


@pytest.mark.usefixtures("encoder")
def test_more_paths_than_are_remembered_are_still_named() -> None:
    for count in (10, 60, 200, 10):
        state = {f"wheel{i}": math.inf for i in range(count)}
        encoded = encoding.encode(state)
        assert encoded.replaced == dict.fromkeys(state, "inf")
        assert json.loads(encoded.text) == dict.fromkeys(state)


@pytest.mark.usefixtures("encoder")
def test_of_two_places_with_one_path_one_is_named_and_the_other_counted() -> None:
    states: list[dict[str, Any]] = [
        {"a.b": math.nan},
        {"a": {"b": math.inf}},
        {"a.0": math.nan},
        {"a": [math.inf, math.nan]},
    ]
    for state in states:  # whose paths are remembered from here on
        assert encoding.encode(state).unnamed == 0
    for first, second in (states[:2], states[2:]):
        encoded = encoding.encode(first | second)
        (path,) = first
        assert (encoded.replaced[path], encoded.unnamed) == ("nan", 1)


def test_a_state_with_none_takes_the_fast_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("orjson")
    monkeypatch.setattr(encoding, "_encode_with_json", pytest.fail)
    state = {"seen": None, "arm": {"goal": [1.5, None], "pair": (None, "a")}}
    text = encoding.encode(state).text
    assert text == '{"seen":null,"arm":{"goal":[1.5,null],"pair":[null,"a"]}}'


def test_nan_beside_none_is_named_and_never_becomes_a_silent_null() -> None:
    encoded = encoding.encode({"seen": None, "deep": {"new_path": [None, math.nan]}})
    assert encoded.replaced == {"deep.new_path.1": "nan"}
    assert encoded.text == '{"seen":null,"deep":{"new_path":[null,null]}}'
