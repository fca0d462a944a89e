"""Ways in which people publish a robot: the same one, held in place or driving well, each time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

HELD_S: Final = (15.0, 30.0)  # something holds it, or a joint of it, while it is commanded to move
ENDS_S: Final = 45.0
AIM_STEPS_S: Final = 20.0  # when the target of the joint steps while the joint is held
WAITS_S: Final = (33.0, 40.0)  # it is commanded to stand
_SPEED_M_S: Final = 0.3
_RADIUS_M: Final = 0.05
_TRACK_M: Final = 0.2
_NOISE_M: Final = 0.001

State = dict[str, Any]


@dataclass(frozen=True)
class Moment:
    """Everything about a robot at one time, of which a way to publish shows a part.

    Attributes:
        v: Its commanded speed in m/s; `v_is` how fast it is.
        w: Its commanded turn rate in rad/s; `w_is` how fast it turns.
        left: The commanded speed of its left wheels in rad/s; they turn so, held or not.
        left_is: How fast the left wheels turn where what holds the robot holds its wheels too.
        turned: The angles of its left and right wheels in rad.
        aim: The target of a joint in rad; `joint` where it is.
    """

    t: float
    x: float
    y: float
    yaw: float
    v: float
    w: float
    v_is: float
    w_is: float
    left: float
    right: float
    turned: tuple[float, float]
    left_is: float
    right_is: float
    aim: float
    joint: float


def moments(interval_s: float, *, is_held: bool) -> Iterator[Moment]:
    """The robot from row to row: it drives wide bends, waits once, and a joint swings slowly."""
    rng = np.random.default_rng(7)
    x = y = yaw = left_rad = right_rad = joint = 0.0
    for row in range(int(ENDS_S / interval_s)):
        t = row * interval_s
        waits = WAITS_S[0] <= t < WAITS_S[1]
        v = 0.0 if waits else _SPEED_M_S
        w = 0.0 if waits else 0.4 * (1 if int(t / 6) % 2 else -1)
        stops = is_held and HELD_S[0] <= t < HELD_S[1]
        v_is, w_is = (0.0, 0.0) if stops else (v, w)
        yaw += w_is * interval_s
        x += v_is * interval_s * math.cos(yaw)
        y += v_is * interval_s * math.sin(yaw)
        left, right = ((v + sign * w * _TRACK_M / 2) / _RADIUS_M for sign in (-1, 1))
        left_rad, right_rad = left_rad + left * interval_s, right_rad + right * interval_s
        aim = 1.0 if int(t / 10) % 2 else -0.5
        if not stops:
            joint += float(np.clip(aim - joint, -2 * interval_s, 2 * interval_s))
        off = rng.normal(0, _NOISE_M, 3)
        turns = [0.0 if stops else each + bool(v) * rng.normal(0, 0.01) for each in (left, right)]
        yield Moment(
            t, x + off[0], y + off[1], math.remainder(yaw, math.tau), v, w,
            v_is, w_is, left, right, (left_rad, right_rad), *turns, aim, joint + off[2],
        )  # fmt: skip


@dataclass(frozen=True)
class Publishing:
    """A way to publish.

    Attributes:
        publish: What is published of a moment.
        kind: The kind of event that tells that it is held.
        declared: What has to be declared before it can be searched, by signal.
    """

    name: str
    publish: Callable[[Moment], State]
    kind: str = "stuck"
    declared: dict[str, dict[str, Any]] | None = None

    @property
    def expected_s(self) -> tuple[float, float]:
        """When it is stuck; a joint is off its target 3 s after the target went on."""
        return HELD_S if self.kind == "stuck" else (AIM_STEPS_S + 3.0, HELD_S[1])


def _xy(m: Moment) -> State:
    return {"x": m.x, "y": m.y}


_X: Final = {"quantity": "x", "role": "measured"}
_Y: Final = {"quantity": "y", "role": "measured"}
_V: Final = {"quantity": "speed", "role": "commanded", "unit": "m/s"}
_W: Final = {"quantity": "wheel speed", "role": "commanded", "unit": "rad/s"}
_ON_LAND: Final[list[Publishing]] = [
    Publishing("gps and commanded_m_s", lambda m: {"gps": _xy(m), "commanded_m_s": m.v}),
    Publishing("pose list and cmd_vel", lambda m: {"pose": [m.x, m.y, m.yaw], "cmd_vel": m.v}),
    Publishing(
        "Twist",
        lambda m: {
            "pose": [m.x, m.y, m.yaw],
            "cmd_vel": {
                "linear": {"x": m.v, "y": 0.0, "z": 0.0},
                "angular": {"x": 0.0, "y": 0.0, "z": m.w},
            },
        },
    ),
    Publishing(
        "camelCase motors",
        lambda m: {"position": _xy(m), "leftMotorSpeed": m.left, "rightMotorSpeed": m.right},
    ),
    Publishing(
        "gps list and motors",
        lambda m: {"gps": [m.x, m.y, 0.0], "motors": {"left": m.left, "right": m.right}},
    ),
    Publishing(
        "cm and cm/s",
        lambda m: {"x_cm": 100 * m.x, "y_cm": 100 * m.y, "target_speed_cm_s": 100 * m.v},
    ),
    Publishing(
        "mm and mm/s",
        lambda m: {"x_mm": 1000 * m.x, "y_mm": 1000 * m.y, "speed_cmd_mm_s": 1000 * m.v},
    ),
    Publishing("km/h", lambda m: {"gps": _xy(m), "speed_command_km_h": 3.6 * m.v}),
    Publishing(
        "rpm",
        lambda m: {
            "gps": _xy(m),
            "left_wheel_rpm": m.left * 30 / math.pi,
            "right_wheel_rpm": m.right * 30 / math.pi,
        },
    ),
    Publishing(
        "rad/s",
        lambda m: {"gps": _xy(m), "wheel_left_rad_s": m.left, "wheel_right_rad_s": m.right},
    ),
    Publishing(
        "deg/s",
        lambda m: {
            "gps": _xy(m),
            "wheels_deg_s": {"left": math.degrees(m.left), "right": math.degrees(m.right)},
        },
    ),
    Publishing(
        "four wheels as a list",
        lambda m: {"gps": _xy(m), "wheel_velocities": [m.left, m.right, m.left, m.right]},
    ),
    Publishing(
        "deep dicts",
        lambda m: {"robot": {"state": {"pose": {"position": _xy(m)}}, "command": {"speed": m.v}}},
    ),
    Publishing(
        "sensors and actuators",
        lambda m: {
            "sensors": {"gps": {"x": m.x, "y": m.y}},
            "actuators": {"left_wheel": {"velocity": m.left}, "right_wheel": {"velocity": m.right}},
        },
    ),
    Publishing(
        "ROS odometry and cmd_vel",
        lambda m: {
            "odom": {
                "pose": {"pose": {"position": _xy(m)}},
                "twist": {"twist": {"linear": {"x": m.v_is}}},
            },
            "cmd_vel": {"linear": {"x": m.v}},
        },
    ),
    Publishing("spd_cmd and pos_x", lambda m: {"pos_x": m.x, "pos_y": m.y, "spd_cmd": m.v}),
    Publishing("vel_ref", lambda m: {"pos": [m.x, m.y], "vel_ref": m.v, "vel": m.v_is}),
    Publishing("speed_setpoint", lambda m: {"robot_x": m.x, "robot_y": m.y, "speed_setpoint": m.v}),
    Publishing("desired_velocity", lambda m: {"gps": [m.x, m.y], "desired_velocity": m.v}),
    Publishing("only the mode", lambda m: {"gps": _xy(m), "mode": "drive" if m.v else "wait"}),
    Publishing("a state number", lambda m: {"pose": [m.x, m.y, m.yaw], "state": int(m.v > 0)}),
    Publishing("only poses", lambda m: {"pose": [m.x, m.y, m.yaw]}),
    Publishing("x, y and theta", lambda m: {**_xy(m), "theta": m.yaw}),
    Publishing(
        "translation of a supervisor",
        lambda m: {"translation": [m.x, m.y, 0.05], "rotation": [0.0, 0.0, 1.0, m.yaw]},
    ),
    Publishing(
        "velocity of a supervisor",
        lambda m: {
            "velocity": [m.v_is * math.cos(m.yaw), m.v_is * math.sin(m.yaw), 0.0, 0.0, 0.0, m.w_is]
        },
    ),
    Publishing("only measured speed", lambda m: {"speed_m_s": m.v_is}),
    Publishing(
        "commanded and measured speed", lambda m: {"commanded_m_s": m.v, "speed_m_s": m.v_is}
    ),
    Publishing(
        "only encoders", lambda m: {"left_encoder": m.turned[0], "right_encoder": m.turned[1]}
    ),
    Publishing(
        "encoders and a command",
        lambda m: {"encoders": list(m.turned), "commanded_m_s": m.v},
    ),
    Publishing(
        "odometry of its wheels",
        lambda m: {
            "odom": {"x": _RADIUS_M * m.turned[0], "y": 0.01 * m.t},
            "wheels": {"left": m.left, "right": m.right},
        },
    ),
    Publishing("only a joystick", lambda m: {"joystick": {"x": 0.0, "y": 1.0 if m.v else 0.0}}),
    Publishing("joystick axes", lambda m: {"axes": [m.w, 1.0 if m.v else 0.0], "buttons": [0, 1]}),
    Publishing(
        "joystick and a command", lambda m: {"joystick": {"x": 0.5, "y": 0.5}, "commanded_m_s": m.v}
    ),
    Publishing("a goal and a command", lambda m: {"goal": {"x": 9.0, "y": 9.0}, "cmd_vel": m.v}),
    Publishing(
        "measured wheels that stall",
        lambda m: {"gps": _xy(m), "wheels": {"left": m.left_is, "right": m.right_is}},
    ),
    Publishing(
        "wheels measured, as named",
        lambda m: {
            "gps": _xy(m),
            "left_wheel_measured_rad_s": m.left * bool(m.v_is),
            "right_wheel_measured_rad_s": m.right * bool(m.v_is),
        },
    ),
    Publishing("gps and velocity", lambda m: {"gps": _xy(m), "velocity": m.v_is}),
    Publishing(
        "declared heading in degrees",
        lambda m: {"gps": _xy(m), "psi": math.degrees(m.yaw), "c": m.v},
        declared={"psi": {"quantity": "heading", "unit": "deg"}, "c": _V},
    ),
    Publishing("only keys", lambda m: {"key": "W" if m.v else "", "keys": [87 if m.v else -1]}),
    Publishing(
        "joystick and gps",
        lambda m: {"gps": _xy(m), "joystick": {"x": 0.0, "y": 1.0 * (m.v > 0)}},
    ),
    Publishing("keys and gps", lambda m: {"gps": _xy(m), "key": 87 if m.v else -1}),
    Publishing(
        "throttle and steering",
        lambda m: {"gps": [m.x, m.y, 0.0], "throttle": 2 * m.v, "steering": m.w / 2},
    ),
    Publishing(
        "throttle without a place", lambda m: {"throttle": 2 * m.v, "steering_angle": m.w / 2}
    ),
    Publishing(
        "tracks",
        lambda m: {"gps": _xy(m), "left_track_speed": m.left, "right_track_speed": m.right},
    ),
    Publishing("a waypoint", lambda m: {"pose": _xy(m), "goal": {"x": 9.0, "y": 9.0}}),
    Publishing("currents", lambda m: {"gps": _xy(m), "motor_current_a": 0.4 + m.v}),
    Publishing(
        "terse", lambda m: {"px": m.x, "py": m.y, "u": m.v}, declared={"px": _X, "py": _Y, "u": _V}
    ),
    Publishing(
        "Chinese",
        lambda m: {"位置": {"横": m.x, "纵": m.y}, "速度指令": m.v},
        declared={"位置.横": _X, "位置.纵": _Y, "速度指令": _V},
    ),
    Publishing(
        "Chinese wheels",
        lambda m: {"坐标": [m.x, m.y], "左轮": m.left, "右轮": m.right},
        declared={
            "坐标.0": _X,
            "坐标.1": _Y,
            "左轮": _W | {"side": "left"},
            "右轮": _W | {"side": "right"},
        },
    ),
    Publishing(
        "German",
        lambda m: {"lage": {"laengs": m.x, "quer": m.y}, "sollgeschwindigkeit": m.v},
        declared={"lage.laengs": _X, "lage.quer": _Y, "sollgeschwindigkeit": _V},
    ),
    Publishing(
        "Spanish",
        lambda m: {"posicion": [m.x, m.y], "velocidad_mando": m.v},
        declared={"posicion.0": _X, "posicion.1": _Y, "velocidad_mando": _V},
    ),
    Publishing(
        "declared cm and rpm",
        lambda m: {
            "a": 100 * m.x,
            "b": 100 * m.y,
            "l": m.left * 30 / math.pi,
            "r": m.right * 30 / math.pi,
        },
        declared={
            "a": _X | {"unit": "cm"},
            "b": _Y | {"unit": "cm"},
            "l": _W | {"unit": "rpm", "side": "left"},
            "r": _W | {"unit": "rpm", "side": "right"},
        },
    ),
]
_OTHERS: Final[list[Publishing]] = [
    Publishing(
        "drone with a velocity command",
        lambda m: {
            "x": m.x,
            "y": m.y,
            "altitude": 1.5,
            "vx_cmd": m.v,
            "motors": [68.5, -68.5, 68.5, -68.5],
        },
    ),
    Publishing(
        "drone with a target",
        lambda m: {
            "position": {"x": m.x, "y": m.y, "z": 1.5},
            "target": {"x": 9.0, "y": 9.0, "z": 1.5},
        },
    ),
    Publishing(
        "drone with propellers alone",
        lambda m: {
            "gps": [m.x, m.y, 1.5],
            "propellers": [68.5, -68.5, 68.5, -68.5],
            "roll": 0.0,
            "pitch": 0.1,
        },
    ),
    Publishing(
        "legged with a gait",
        lambda m: {
            "gps": [m.x, m.y, 0.3],
            "gait": "trot" if m.v else "stand",
            "hip_target": 0.3 * math.sin(9 * m.t) * (m.v > 0),
        },
    ),
    Publishing(
        "legged with a commanded velocity",
        lambda m: {"base_position": [m.x, m.y, 0.3], "command_velocity": m.v},
    ),
    Publishing(
        "boat with thrusters",
        lambda m: {"gps": [m.x, m.y, 0.0], "thrusters": {"left": m.left, "right": m.right}},
    ),
    Publishing(
        "boat with latitude",
        lambda m: {
            "latitude": 48 + m.x / 111_000,
            "longitude": 9 + m.y / 74_000,
            "thrust_n": 20 * m.v,
            "rudder_rad": m.w / 2,
        },
    ),
    Publishing(
        "arm with target and position",
        lambda m: {"elbow": {"target": m.aim, "position": m.joint}},
        "off_target",
    ),
    Publishing(
        "arm as lists",
        lambda m: {"joint_targets": [m.aim, 0.2], "joint_positions": [m.joint, 0.2]},
        "off_target",
    ),
    Publishing(
        "arm in degrees",
        lambda m: {"shoulder_cmd_deg": math.degrees(m.aim), "shoulder_deg": math.degrees(m.joint)},
        "off_target",
    ),
    Publishing(
        "arm with setpoints",
        lambda m: {"arm": {"joint1": {"setpoint": m.aim, "actual": m.joint}}},
        "off_target",
    ),
    Publishing("arm without targets", lambda m: {"joints": {"elbow": m.joint}}, "off_target"),
    Publishing(
        "terse arm",
        lambda m: {"q": m.joint, "qd": m.aim},
        "off_target",
        declared={
            "q": {"quantity": "joint position", "unit": "rad"},
            "qd": {"quantity": "joint position", "role": "target", "target_of": "q"},
        },
    ),
]
WAYS: Final = [*_ON_LAND, *_OTHERS]
