"""Rules about joints: wheels that turn about another axis than their own, and motors."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import asin, degrees
from typing import Final

import numpy as np

from webots_mcp.lint.bodies import Bodies, JointLine, SolidPart
from webots_mcp.lint.physics_rules import is_driven_wheel
from webots_mcp.lint.scene import MOTORS, Scene, TreeNode
from webots_mcp.lint.shapes import Array
from webots_mcp.lint.world_faults import LintReport, Severity


@dataclass(frozen=True)
class JointTolerances:
    """What counts as a fault.

    Attributes:
        wobble: Share of its radius by which the rim or the centre of a wheel may move to and fro.
    """

    wobble: float = 0.1


_TOLERANCES: Final = JointTolerances()
_WHEEL: Final = re.compile(r"(?i)(?:^|[^a-z]|[a-z](?=Wheel))wheels?(?:[^a-z]|$)|Wheel(?![a-z])")


class JointRules:
    """The rules about joints, for one scene."""

    def __init__(self, scene: Scene, bodies: Bodies, report: LintReport) -> None:
        self._scene = scene
        self._bodies = bodies
        self._report = report

    def search(self) -> None:
        """Apply all rules."""
        endless: dict[TreeNode, list[TreeNode]] = {}
        for part in self._bodies.parts:
            if part.joint is None:
                continue
            self._wheel(part)
            for parameters, motor in _axes(part.joint):
                if motor.unread or (parameters is not None and parameters.unread):
                    self._report.leave_out(["motor limits"], motor.path, motor.unread or "a PROTO")
                    continue
                self._report.judge("motor limits")
                self._gain(motor)
                if self._limits(part, parameters, motor) and not _may_turn(part, motor):
                    endless.setdefault(part.robot or motor, []).append(motor)
        for robot, motors in endless.items():
            self._without_limits(robot, motors)

    # -- wheels --

    def _wheel(self, part: SolidPart) -> None:
        joint = part.joint
        if joint is None or joint.type_name != "HingeJoint" or not is_driven_wheel(part):
            return
        shapes = part.shape.primitives
        if len(shapes) != 1 or shapes[0].kind != "Cylinder" or part.frame is None:
            return
        line = JointLine(part)
        if not line.is_known:
            self._report.leave_out(["wheel axis"], joint.path, "its jointParameters are a PROTO")
            return
        self._report.judge("wheel axis")
        wheel, radius = shapes[0], float(shapes[0].half[0])
        apart = wheel.center - line.anchor
        off = float(np.linalg.norm(apart - line.axis * (apart @ line.axis)))
        sine = float(np.linalg.norm(np.cross(wheel.axes[:, 2], line.axis)))
        is_named = any(_WHEEL.search(name) for name in _names(part))
        is_disc = wheel.half[2] < radius
        node = line.parameters or joint
        field = "axis" if line.parameters else ""
        if sine > _TOLERANCES.wobble and (is_named or (is_disc and off < radius / 10.0)):
            angle = degrees(asin(min(sine, 1.0)))
            fix = _axis_in_joint(part, wheel.axes[:, 2])
            self._report.blame(
                "wheel axis", "error", node, field,
                f"{part.node.label} turns about an axis {angle:.0f}° off its cylinder's axis",
                f"Set axis to {fix}, or turn the cylinder in the boundingObject.",
            )  # fmt: skip
        elif off > _TOLERANCES.wobble * radius and is_named:
            fix = _point_in_joint(part, wheel.center)
            self._report.blame(
                "wheel axis", "error", node, "anchor" if line.parameters else "",
                f"The centre of {part.node.label} is {1000.0 * off:.3g} mm off the axis that it "
                f"turns about; its radius is {1000.0 * radius:.3g} mm",
                f"Set anchor to {fix}, the centre of the wheel.",
            )  # fmt: skip

    # -- motors --

    def _gain(self, motor: TreeNode) -> None:
        """Report a P-controller that overshoots: it multiplies the error by 1 - P step."""
        self._report.judge("time step")
        gain = motor.vector("controlPID", 3)[0]
        step_s = self._scene.step_s
        if gain * step_s < 2.0:
            return
        self._report.blame(
            "time step", "warning", motor, "controlPID",
            f"P = {gain:g} with a step of {1000.0 * step_s:g} ms: each step multiplies the error "
            f"of position by 1 - P step = {1.0 - gain * step_s:.3g}, so the motor oscillates",
            f"Set P of controlPID to at most {1.0 / step_s:.3g} (1 / step).",
        )  # fmt: skip

    def _limits(self, part: SolidPart, parameters: TreeNode | None, motor: TreeNode) -> bool:
        """Check the limits of a motor; return whether it has none at all."""
        low, high = motor.number("minPosition"), motor.number("maxPosition")
        position = parameters.number("position") if parameters else 0.0
        stops = (0.0, 0.0)
        if parameters is not None:
            stops = (parameters.number("minStop"), parameters.number("maxStop"))
        slack = 1e-6 * max(1.0, abs(low), abs(high), *map(abs, stops))
        has_soft, has_hard = low != high, stops[0] != stops[1]
        if has_soft and has_hard and (stops[0] > low + slack or stops[1] < high - slack):
            self._report.blame(
                "motor limits", "warning", motor, "maxPosition",
                f"The limits of {motor.label}, {low:g} to {high:g}, exceed the stops of its joint, "
                f"{stops[0]:g} to {stops[1]:g}",
                f"Set minPosition to at least {stops[0]:g} and maxPosition to at most "
                f"{stops[1]:g}.",
            )  # fmt: skip
        if has_soft and not low - slack <= position <= high + slack:
            self._report.blame(
                "motor limits", "warning", motor, "minPosition",
                f"{motor.label} starts at {position:g}, outside its limits {low:g} to {high:g}",
                f"Let minPosition and maxPosition include {position:g}, or change position and "
                "the pose of the endPoint.",
            )  # fmt: skip
        if has_hard and parameters is not None and position in stops and part.physics is not None:
            self._report.blame(
                "motor limits", "note", parameters, "position",
                f"The joint of {motor.label} starts exactly at its stop {position:g}: Webots warns "
                "that this may be unstable",
                "Move the stop a little beyond the start position.",
            )  # fmt: skip
        return not has_soft and not has_hard

    def _without_limits(self, robot: TreeNode, motors: list[TreeNode]) -> None:
        sliding = [motor for motor in motors if motor.type_name == "LinearMotor"]
        turning = [motor for motor in motors if motor.type_name != "LinearMotor"]
        self._without_end(robot, sliding, "warning", "slide")
        self._without_end(robot, turning, "note", "turn")

    def _without_end(
        self, robot: TreeNode, motors: list[TreeNode], severity: Severity, verb: str
    ) -> None:
        if not motors:
            return
        names = ", ".join(motor.text("name") for motor in motors[:4])
        more = f" and {len(motors) - 4} more" if len(motors) > 4 else ""
        self._report.blame(
            "motor limits", severity, motors[0], "maxPosition",
            f"Motors of {robot.label} have neither limits nor stops ({names}{more}): they {verb} "
            "without an end, and wrong targets are not clipped",
            "Set minPosition and maxPosition to the range of the real motor.",
        )  # fmt: skip


def _axes(joint: TreeNode) -> Iterator[tuple[TreeNode | None, TreeNode]]:
    """Yield the motors of a joint with the parameters of their axes."""
    for number in ("", "2", "3"):
        parameters = joint.child(f"jointParameters{number}")
        for device in joint.children(f"device{number}"):
            if device.type_name in MOTORS:
                yield parameters, device


def _may_turn(part: SolidPart, motor: TreeNode) -> bool:
    """Return whether a motor is meant to turn without an end: of a wheel, or of a part that may be.

    A part that carries no other joint and is round, or whose name is that of a wheel, may turn; so
    may any part whose shape is not known.
    """
    if motor.type_name == "LinearMotor":
        return False
    names = " ".join(_names(part))
    if _WHEEL.search(names) or _SPINS.search(names):
        return True
    if part.shape.incomplete or part.shape.is_mesh or part.bounding is None:
        return True
    kinds = {each.kind for each in part.shape.primitives}
    return not _has_joint(part.node) and bool(kinds & {"Cylinder", "Sphere", "Capsule"})


_SPINS: Final = re.compile(
    r"(?i)wheel|rotor|propell|blade|spin|turret|drum|fan|roller|crank|caster|tyre|tire|brush|track"
)


def _has_joint(node: TreeNode) -> bool:
    inside = node.children("children")
    return any(each.type_name.endswith("Joint") or _has_joint(each) for each in inside)


def _names(part: SolidPart) -> Iterator[str]:
    yield part.node.def_name
    yield part.node.text("name")
    if part.joint is not None:
        yield part.joint.def_name
        for device in part.joint.children("device"):
            yield device.text("name")


def _axis_in_joint(part: SolidPart, axis: Array) -> str:
    assert part.joint_frame is not None
    local = part.joint_frame.direction(axis.tolist())
    sign = -1.0 if max(local, key=abs) < 0.0 else 1.0  # either way is the same axis
    return _shown([sign * each for each in local])


def _point_in_joint(part: SolidPart, point: Array) -> str:
    assert part.joint_frame is not None
    return _shown(part.joint_frame.inverse().point(point.tolist()))


def _shown(values: Sequence[float]) -> str:
    return " ".join(f"{round(each, 4) + 0.0:g}" for each in values)
