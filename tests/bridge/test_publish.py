"""What publish() records, and what it does with what JSON cannot hold."""

from __future__ import annotations

import collections
import copy
import dataclasses
import enum
import json
import math
import uuid
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.standin import InProcessSupervisor


class Mode(enum.Enum):
    CRUISE = "cruise"


class Gear(enum.IntEnum):
    FIRST = 1


@dataclasses.dataclass
class Pose:
    x: float
    y: float


def test_every_nth_call_is_recorded_and_force_records_now(
    robot: InProcessSupervisor, recording: Recording
) -> None:
    with MCPBridge(robot, database=recording.database) as bridge:  # type: ignore[arg-type]
        for number in range(1, 12):
            bridge.publish({"number": number})
        bridge.publish({"number": 99}, force=True)
        assert bridge.stats().publish_throttled == 9
    assert [state["number"] for state in recording.states()] == [5, 10, 99]


def test_the_environment_decides_how_many_calls_are_recorded(
    robot: InProcessSupervisor, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_THROTTLE_INTERVAL", "1")
    with MCPBridge(robot, throttle_interval=100, database=recording.database) as bridge:
        for number in range(3):
            bridge.publish({"number": number})
    assert [state["number"] for state in recording.states()] == [0, 1, 2]


def test_whatever_is_recorded_has_its_times_and_its_run(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    camera = robot.getDevice("camera")
    camera.enable(STEP_MS)
    for mode in ("cruise", "turn"):
        robot.step(STEP_MS)
        bridge.publish({"mode": mode})
    bridge.log("text")
    assert bridge.save_camera_frame(camera)
    of_now = (pytest.approx(0.032), 1, bridge.run_id)
    for table in ("state", "event", "log", "image"):
        times = f"SELECT sim_time_s, wall_time_s > 1.7e9, run_id FROM {table}"
        assert recording.rows(f"{times} ORDER BY id DESC LIMIT 1") == [of_now], table


def test_extras_that_are_no_dict_do_not_stop_the_loop(
    robot: InProcessSupervisor, database: MemoryDatabase, capfd: pytest.CaptureFixture[str]
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        bridge.auto_publish(extra=[1])  # type: ignore[arg-type]
        assert bridge.stats().failures == 1
    assert "auto_publish failed: TypeError" in capfd.readouterr().err


@pytest.mark.usefixtures("encoder")
def test_what_controllers_have_is_stored_as_plain_json(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.publish(
        {
            "pose": (1.5, 2.5),
            "scalar": np.float32(0.5),
            "array": np.arange(3),
            "flags": np.array([True, False]),
            "mode": Mode.CRUISE,
            "gear": Gear.FIRST,
            "data": Pose(1.0, 2.0),
            "path": Path("worlds") / "arena.wbt",
            "set": {7},
            3: "three",
            None: "none",
        }
    )
    assert recording.states() == [
        {
            "pose": [1.5, 2.5],
            "scalar": 0.5,
            "array": [0, 1, 2],
            "flags": [True, False],
            "mode": "cruise",
            "gear": 1,
            "data": {"x": 1.0, "y": 2.0},
            "path": str(Path("worlds") / "arena.wbt"),
            "set": [7],
            "3": "three",
            "null": "none",
        }
    ]
    assert recording.rows("SELECT replaced FROM state") == [None]


@pytest.mark.usefixtures("encoder")
def test_nan_and_infinity_come_back_recognisable_and_do_not_break_sqlite(
    bridge: MCPBridge, recording: Recording
) -> None:
    scan = [0.5, math.inf, math.inf]
    bridge.publish({"gap": math.nan, "far": -math.inf, "scan": scan, "mixed": [math.nan, None]})
    sql = "SELECT data ->> '$.scan[0]', data ->> '$.gap', json_valid(data) FROM state"
    assert recording.rows(sql) == [(0.5, None, 1)]
    (replaced,) = recording.rows("SELECT replaced FROM state")
    assert json.loads(replaced) == {"gap": "nan", "far": "-inf", "scan.*": "inf", "mixed.0": "nan"}


@pytest.mark.usefixtures("encoder")
def test_a_value_that_cannot_be_stored_costs_that_value_and_is_logged_once(
    bridge: MCPBridge, recording: Recording
) -> None:
    for _ in range(3):
        bridge.publish({"x": 1, "handle": object(), "raw": b"abc", (1, 2): "tuple"})
    state = recording.states()[0]
    assert state == {"x": 1, "handle": None, "raw": "YWJj", "(1, 2)": "tuple"}
    assert bridge.stats().values_replaced == 6
    logged = recording.rows("SELECT message FROM log WHERE source = 'bridge'")
    assert logged == ["handle could not be stored: unsupported: object"]
    (replaced, *_) = recording.rows("SELECT replaced FROM state")
    assert json.loads(replaced) == {"handle": "unsupported: object", "raw": "unsupported: bytes"}


@pytest.mark.usefixtures("encoder")
def test_a_huge_array_costs_itself_and_not_the_row(bridge: MCPBridge, recording: Recording) -> None:
    bridge.publish({"x": 1, "image": np.zeros((640, 480, 3)), "list": [0.25] * 400_000})
    assert recording.states() == [{"x": 1, "image": None, "list": None}]
    (replaced,) = recording.rows("SELECT replaced FROM state")
    assert json.loads(replaced) == {"image": "too large", "list": "too large"}


def test_the_callers_dict_is_never_changed(bridge: MCPBridge) -> None:
    state = {"pose": [1.0, math.nan], "nested": {"raw": b"x", 1: (2, 3)}}
    before = copy.deepcopy(state)
    bridge.publish(state)
    bridge.auto_publish(extra=state)
    assert repr(state) == repr(before)


class Broken:
    def tolist(self) -> list[int]:
        raise RuntimeError("no data")


class Unconnected:
    def __getattr__(self, name: str) -> object:
        raise RuntimeError("not connected")


class Picture:
    size = (640, 480)


class MuteError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


class Sullen:
    def tolist(self) -> list[int]:
        raise MuteError


BROKEN = (Broken(), Unconnected(), Picture(), Sullen(), 10**5000, Mode)


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("value", BROKEN, ids=lambda value: type(value).__name__)
def test_whatever_an_object_does_it_costs_itself_and_is_counted(
    bridge: MCPBridge, recording: Recording, value: object
) -> None:
    bridge.publish({"x": 1, "value": value})
    bridge.publish({"x": 2, "values": [value]})
    assert recording.states() == [{"x": 1, "value": None}, {"x": 2, "values": [None]}]
    assert bridge.stats().values_replaced == 2
    assert recording.rows("SELECT count(*) FROM log WHERE source = 'bridge'") == [2]


@pytest.mark.usefixtures("encoder")
def test_both_encoders_store_the_same(bridge: MCPBridge, recording: Recording) -> None:
    @dataclasses.dataclass
    class Arm:
        angle_rad: float
        _offset_rad: float
        joints: ClassVar[int] = 6

    bridge.publish(
        {
            "arm": Arm(0.5, 0.25),
            "id": uuid.UUID(int=3),
            "last": collections.deque([1, 2]),
            "range": range(3),
        }
    )
    assert recording.states() == [
        {
            "arm": {"angle_rad": 0.5, "_offset_rad": 0.25},
            "id": "00000000-0000-0000-0000-000000000003",
            "last": [1, 2],
            "range": [0, 1, 2],
        }
    ]
    assert recording.rows("SELECT replaced FROM state") == [None]


def test_a_dataclass_may_be_the_whole_state(bridge: MCPBridge, recording: Recording) -> None:
    bridge.publish(Pose(1.0, 2.0))  # type: ignore[arg-type]
    assert recording.states() == [{"x": 1.0, "y": 2.0}]


def test_a_state_that_is_no_dict_is_counted_and_does_not_stop_the_loop(
    robot: InProcessSupervisor, database: MemoryDatabase, capfd: pytest.CaptureFixture[str]
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=database) as bridge:
        bridge.publish([1, 2])  # type: ignore[arg-type]
        assert bridge.stats().failures == 1
        assert "publish() takes a dict, got list" in (bridge.stats().last_error or "")
    assert capfd.readouterr().err.count("publish() takes a dict") == 1


def test_changes_of_texts_and_flags_become_events(bridge: MCPBridge, recording: Recording) -> None:
    for mode, stuck in (("cruise", False), ("cruise", False), ("turn", False), ("turn", True)):
        bridge.publish({"mode": mode, "stuck": stuck})
    sql = "SELECT name, data FROM event WHERE kind = 'change' ORDER BY id"
    assert recording.rows(sql) == [
        ("mode", '{"from":"cruise","to":"turn"}'),
        ("stuck", '{"from":false,"to":true}'),
    ]


def test_auto_publish_reads_enabled_devices_only(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for name in ("ds_left", "gps", "inertial unit", "lidar"):
        robot.getDevice(name).enable(STEP_MS)
    robot.step(STEP_MS)
    robot.step(STEP_MS)
    bridge.auto_publish(extra={"note": "hello"})
    (state,) = recording.states()
    assert set(state) == {"pose", "sensors", "motors", "time", "note"}
    assert set(state["sensors"]) == {"ds_left", "gps", "inertial unit", "lidar"}
    assert state["pose"][:2] == pytest.approx([-1.2, 0.0], abs=0.01)
    assert state["sensors"]["lidar"]["count"] == 180
    assert len(state["sensors"]["lidar"]["sector_min_m"]) == 8
    assert state["time"] == pytest.approx(0.032)


def test_auto_publish_answers_with_the_state_and_its_time_in_throttled_calls_too(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    robot.getDevice("ds_left").enable(STEP_MS)
    with MCPBridge(robot, throttle_interval=2, keep_last_s=0, database=database) as bridge:
        robot.step(STEP_MS)
        robot.step(STEP_MS)
        throttled = bridge.auto_publish({"mode": "rest"})
        read = bridge.auto_publish({"mode": "search"})
        untimed = bridge.auto_publish({"mode": "rest"}, include_time=False)
    (recorded,) = recording.states()
    assert throttled == {"mode": "rest", "time": robot.getTime()}
    assert "sensors" in read and read == recorded
    assert untimed == {"mode": "rest"}


def test_motors_are_recorded_in_the_unit_of_their_kind(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lift = robot.getDevice("left wheel motor")
    monkeypatch.setattr(lift, "getType", lambda: lift.LINEAR)
    lift.setVelocity(0.5)
    bridge.auto_publish()
    motors = recording.states()[0]["motors"]
    assert set(motors["right wheel motor"]) == {"target_position_rad", "target_velocity_rad_s"}
    assert set(motors["left wheel motor"]) == {"target_position_m", "target_velocity_m_s"}
    assert motors["left wheel motor"]["target_velocity_m_s"] == 0.5
