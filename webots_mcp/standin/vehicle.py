"""Motors turn joints, joints turn wheels, and wheels move a robot on the floor."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import cos, isinf, sin
from typing import Any

from webots_mcp.standin.arena import Arena, Body
from webots_mcp.worlds.vrml import WorldNode, descendants_of


@dataclass
class Joint:
    """A hinge with its motor and position. Of a slider, all radians are metres."""

    node: WorldNode
    max_velocity_radps: float
    acceleration_radps2: float
    min_position_rad: float
    max_position_rad: float
    start_rad: float
    target_rad: float = 0.0
    """Target of the motor; inf for velocity control with `target_radps`."""
    target_radps: float = 0.0
    position_rad: float = 0.0
    velocity_radps: float = 0.0

    @staticmethod
    def of(node: WorldNode) -> Joint:
        """Return the joint that a node describes. Without a motor it never moves."""
        motors = [
            n for n in node.fields["device"] if n.type_name in ("RotationalMotor", "LinearMotor")
        ]
        fields: dict[str, Any] = motors[0].fields if motors else {}
        parameters = node.fields["jointParameters"]
        joint = Joint(
            node,
            fields.get("maxVelocity", 0.0),
            fields.get("acceleration", -1.0),
            fields.get("minPosition", 0.0),
            fields.get("maxPosition", 0.0),
            parameters.fields["position"] if parameters else 0.0,
        )
        joint.reset()
        return joint

    def reset(self) -> None:
        """Return to the start. The motor rests until its next command."""
        self.position_rad, self.velocity_radps = self.start_rad, 0.0
        self.hold()

    def hold(self) -> None:
        """Make the motor hold the present position."""
        self.target_rad, self.target_radps = self.position_rad, self.max_velocity_radps

    def turn(self, seconds: float) -> float:
        """Turn for one time step; return the angle in radians."""
        wanted = self._wanted_radps(seconds)
        if self.acceleration_radps2 > 0.0:
            change = self.acceleration_radps2 * seconds
            wanted = min(max(wanted, self.velocity_radps - change), self.velocity_radps + change)
        self.velocity_radps = wanted
        turned = wanted * seconds
        self.position_rad += turned
        return turned

    def _wanted_radps(self, seconds: float) -> float:
        limit = self.max_velocity_radps
        if isinf(self.target_rad):
            wanted = self.target_radps if self.target_rad > 0.0 else -self.target_radps
            return min(max(wanted, -limit), limit)
        target = self.target_rad
        if self.min_position_rad != self.max_position_rad:
            target = min(max(target, self.min_position_rad), self.max_position_rad)
        limit = min(limit, abs(self.target_radps))
        return min(max((target - self.position_rad) / seconds, -limit), limit)


@dataclass
class Wheel:
    """A joint about the robot's left-right axis that carries something round, which rolls."""

    joint: Joint
    radius_m: float
    """Radius; negative if a positive rotation drives backwards."""
    left_m: float


@dataclass
class Vehicle:
    """A robot's body and the joints that move it. A robot without wheels stays in its place."""

    body: Body
    joints: list[Joint]
    touching: bool = False
    collisions: int = 0
    """How often the robot began to touch something that cannot be pushed away."""
    wheels: list[Wheel] = field(init=False)

    def __post_init__(self) -> None:
        self.wheels = [wheel for joint in self.joints if (wheel := _wheel_of(joint))]
        left = [wheel for wheel in self.wheels if wheel.left_m > 0.0]
        right = [wheel for wheel in self.wheels if wheel.left_m < 0.0]
        self._sides = (left, right) if left and right else None

    def reset(self) -> None:
        """Return all joints to their start. The simulator moves the body itself."""
        for joint in self.joints:
            joint.reset()
        self.touching, self.collisions = False, 0

    def stop(self) -> None:
        """Set all velocities to 0."""
        for joint in self.joints:
            joint.velocity_radps = 0.0
        self.body.stop()

    def drive(self, arena: Arena, seconds: float) -> None:
        """Move the robot for one time step.

        Wheels turn as their motors demand even if the robot is blocked: against a wall they spin,
        so that wheel sensors and GPS disagree as in reality.
        """
        rolled = {id(joint): joint.turn(seconds) for joint in self.joints}
        if self._sides is None:
            return
        left, right = (
            sum(rolled[id(wheel.joint)] * wheel.radius_m for wheel in side) / len(side)
            for side in self._sides
        )
        track = self._sides[0][0].left_m - self._sides[1][0].left_m
        self._roll((left + right) / 2.0, (right - left) / track, arena, seconds)

    def _roll(self, ahead_m: float, turn_rad: float, arena: Arena, seconds: float) -> None:
        body = self.body
        x, y, yaw = body.x, body.y, body.yaw_rad
        if ahead_m or turn_rad:
            middle = yaw + turn_rad / 2.0  # Chord of the arc, exact to second order.
            body.move(x + ahead_m * cos(middle), y + ahead_m * sin(middle), yaw + turn_rad)
            self._notice(arena.settle(body))
        else:
            body.touched.clear()
        body.velocity_mps = ((body.x - x) / seconds, (body.y - y) / seconds)
        body.yaw_rate_radps = (body.yaw_rad - yaw) / seconds

    def _notice(self, touching: bool) -> None:
        self.collisions += touching and not self.touching
        self.touching = touching


def joints_in(robot: WorldNode) -> list[Joint]:
    """Return all joints of a robot, in the order of the scene tree."""
    return [
        Joint.of(node)
        for node in descendants_of(robot)
        if node.type_name in ("HingeJoint", "SliderJoint")
    ]


def _wheel_of(joint: Joint) -> Wheel | None:
    parameters, end = joint.node.fields["jointParameters"], joint.node.fields["endPoint"]
    if parameters is None or end is None or joint.max_velocity_radps == 0.0:
        return None
    if joint.node.type_name != "HingeJoint":
        return None
    axis, anchor = parameters.fields["axis"], parameters.fields["anchor"]
    middle = end.fields.get("translation", anchor)  # Of the wheel, along the axis.
    left_m: float = middle[1] or anchor[1]
    radius_m = _radius_m(end.fields.get("boundingObject")) or _radius_m(end)
    if not radius_m or abs(axis[1]) < 0.9 or left_m == 0.0:
        return None
    return Wheel(joint, radius_m if axis[1] > 0.0 else -radius_m, left_m)


def _radius_m(shape: WorldNode | None) -> float:
    nodes = (shape, *descendants_of(shape)) if shape else ()
    return next((node.fields["radius"] for node in nodes if "radius" in node.fields), 0.0)
