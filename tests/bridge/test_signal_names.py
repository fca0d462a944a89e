"""The bridge enters what it records into the register of signals: the views need no server."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, write_lock
from webots_mcp import MCPBridge
from webots_mcp.signals.register import ADDED_AT_ONCE, MAX_SIGNALS, Seen, SignalNames, places
from webots_mcp.standin import InProcessSupervisor

MOTION = "SELECT x_m, y_m, yaw_rad, mode, speed, commanded_speed FROM robot_now"
ROLES = "SELECT name, role FROM signal WHERE role IS NOT NULL"


def test_a_recording_that_no_server_has_opened_shows_how_the_robot_moves(
    robot: InProcessSupervisor, filed: Recording, file: Path
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=file) as bridge:
        for step in range(3):
            robot.step(STEP_MS)
            place = [math.nan, math.nan] if step == 0 else [100.0 * step, 250.0]
            bridge.publish({
                "gps_mm": place, "compass": {"heading_deg": 90.0}, "driveMode": "cruise",
                "velocity": 0.25, "motors": {"left": 3.0, "right": 3.5}, "cmd_vel": [0.2, 0.0],
                "command": 0.5,
            })  # fmt: skip
        moves = (0.2, 0.25, pytest.approx(math.pi / 2), "cruise", 0.25, 0.5)
        assert filed.rows(MOTION) == [moves]
    assert dict(filed.rows(ROLES))["motors.left"] == "wheel"
    units = filed.rows("SELECT kind, unit, path FROM signal WHERE name = 'gps_mm.0'")
    assert units == [("num", "mm", "$.gps_mm[0]")]
    assert filed.rows("SELECT min, max FROM signal WHERE name = 'velocity'") == [(None, None)]


def test_a_better_name_takes_the_role_when_it_comes(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.publish({"x": 1, "y": 2, "state": "driving"})
    assert dict(recording.rows(ROLES)) == {"x": "x", "y": "y", "state": "mode"}
    bridge.publish({"x": 1, "y": 2, "state": "driving", "pose": [3, 4, 0.5], "mode": "home"})
    assert recording.rows(MOTION)[0][:4] == (3, 4, 0.5, "home")
    bridge.publish({"x": 5, "y": 6, "state": "driving"})
    assert recording.rows(MOTION)[0][:4] == (5, 6, None, "driving")


def test_a_number_is_a_mode_while_it_is_whole(bridge: MCPBridge, recording: Recording) -> None:
    bridge.publish({"phase": 3})
    assert recording.rows("SELECT mode FROM robot_now") == [3]
    bridge.publish({"phase": 3.5})
    bridge.publish({"phase": 4, "other": 1})
    assert recording.rows("SELECT mode FROM robot_now") == [None]


@pytest.mark.slow
def test_many_names_are_entered_some_with_each_row_and_never_too_many(
    bridge: MCPBridge, recording: Recording
) -> None:
    count = "SELECT count(*) FROM signal"
    first, second = ({f"{word}{n}": n for n in range(1500)} for word in ("a", "b"))
    bridge.publish(first)
    assert recording.rows(count) == [ADDED_AT_ONCE]
    for _ in range(1500 // ADDED_AT_ONCE):
        bridge.publish(first)
    assert recording.rows(count) == [1500]
    for _ in range(1500 // ADDED_AT_ONCE):
        bridge.publish(second)
    assert recording.rows(count) == [MAX_SIGNALS]


def test_names_beyond_the_limit_cost_no_search_for_their_places() -> None:
    state = {f"name{n}": n for n in range(20 * MAX_SIGNALS)}
    text, names, calls = json.dumps(state), SignalNames(), 0

    def count(_frame: FrameType, event: str, _value: object) -> None:
        nonlocal calls
        calls += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        names.register(state, text, lambda _: True)
    finally:
        sys.setprofile(before)
    assert MAX_SIGNALS < calls < len(state)


def test_names_stand_where_the_last_value_of_that_name_does() -> None:
    state: dict[str, Any] = {
        "a": {"b": 1, "c.d": [1, 2], "": 3}, "a.b": 2, "a.c": {"d": {"0": 4}}, ".": 5, "": {"": 6},
        "long": [0.5] * 40, "long.mean": 7, "lo": 8, "e.f": {"g": {"h.i": None}},
    }  # fmt: skip
    entered = dict[str, Seen]()

    def enter(some: dict[str, Seen]) -> bool:
        entered.update(some)
        return True

    SignalNames().register(state, json.dumps(state), enter)
    assert {name: each[:2] for name, each in entered.items()} == places(state)


def test_names_wait_while_another_process_writes(robot: InProcessSupervisor, file: Path) -> None:
    state = {"pose": [1, 2, 0.5]}
    with MCPBridge(robot, throttle_interval=1, database=file) as bridge:
        with write_lock(file):
            bridge.publish(state)
        bridge.publish(state)
        bridge.publish(state)
    assert Recording(file).rows("SELECT x_m, y_m FROM robot_now") == [(1, 2)]


@pytest.mark.parametrize(
    "state",
    [
        {"a": float("nan"), 3: [[1], {"b": None}], 'q"uote': {"": 1}},
        {"x" * 300: 1},
        {},
        [1],
        "text",
    ],
)
def test_whatever_is_published_never_stops_the_loop(
    robot: InProcessSupervisor, recording: Recording, state: Any
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=recording.database) as bridge:
        bridge.publish(state)
        bridge.publish({"pose": [1, 2]})
    assert recording.rows("SELECT x_m, y_m FROM robot_now") == [(1, 2)]
