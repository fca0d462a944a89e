"""Rules about bodies: mass, inertia, bounding objects, physics, overlaps and the time step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, isfinite, sqrt
from typing import Final

import numpy as np

from webots_mcp.lint.bodies import Bodies, JointLine, PhysicsBody, SolidPart, inertia_matrix
from webots_mcp.lint.scene import LintDeadline, Scene, TreeNode
from webots_mcp.lint.shapes import Primitive, overlap_m
from webots_mcp.lint.world_faults import LintReport


@dataclass(frozen=True)
class PhysicsTolerances:
    """What counts as a fault.

    Attributes:
        mass_ratio: Ratio of two masses from which on a constraint between them is hard to solve.
        inertia: Share by which rounding may break the triangle inequality of an inertia.
        overlap_m: Overlap that rounding of coordinates explains.
        sag_share: Share of its size by which a body may sink into the ground at rest.
        pairs: Pairs of primitives that are compared; beyond it the rest is not searched.
    """

    mass_ratio: float = 1000.0
    inertia: float = 0.01
    overlap_m: float = 0.001
    sag_share: float = 0.1
    pairs: int = 20_000


_TOLERANCES: Final = PhysicsTolerances()
_CONTACTS: Final = 4
"""Points on which a body is assumed to rest; Webots makes up to ten, and fewer sink deeper."""


class PhysicsRules:
    """The rules about bodies, for one scene."""

    def __init__(
        self, scene: Scene, bodies: Bodies, report: LintReport, deadline: LintDeadline
    ) -> None:
        self._scene = scene
        self._bodies = bodies
        self._report = report
        self._deadline = deadline
        info = scene.info
        self._gravity = abs(info.vector("gravity", 1)[0]) if _is_single(info) else 9.81
        properties = [each for each in info.children("contactProperties") if not each.unread]
        self._erp = min([info.number("ERP"), *(each.number("softERP") for each in properties)])
        self._cfm = max([info.number("CFM"), *(each.number("softCFM") for each in properties)])

    def search(self) -> None:
        """Apply all rules."""
        for part in self._bodies.parts:
            self._deadline.check()
            self._bounding_object(part)
            self._physics_chain(part)
            self._inertia(part)
        self._joint_ratios()
        self._springs()
        self._sinking()
        self._pairs()

    # -- one Solid --

    def _bounding_object(self, part: SolidPart) -> None:
        physics = part.physics
        if physics is None:
            return
        self._report.judge("bounding object")
        if physics.unread:
            self._report.leave_out(
                ["bounding object", "inertia"], part.node.path, f"its physics: {physics.unread}"
            )
            return
        if part.bounding is not None or len(physics.numbers("inertiaMatrix")) == 6:
            self._falls(part)
            return
        mass = physics.number("mass")
        taken = "the identity as its inertia, 1 kg m² about each axis"
        if mass <= 0.0:
            taken = f"a mass of 1 kg and {taken}"
        self._report.blame(
            "bounding object", "warning", part.node, "boundingObject",
            f"{part.node.label} has physics but no boundingObject: Webots takes {taken}, and it "
            "collides with nothing",
            "Set boundingObject to a Box, Cylinder or Sphere of its size, or set physics to NULL "
            "if its weight does not matter.",
        )  # fmt: skip
        self._falls(part)

    def _falls(self, part: SolidPart) -> None:
        """Report an assembly of bodies that nothing can hold up."""
        number = self._bodies.body_of.get(part)
        if number is None or self._gravity == 0.0:
            return
        numbers = self._bodies.assembly_of(number)
        if number != min(numbers) or self._bodies.bodies[number].top is not part:
            return
        members = [self._bodies.bodies[each] for each in numbers]
        parts = [each for body in members for each in body.parts]
        held = any(body.is_fixed or body.is_on_static for body in members)
        below = [each for top in parts for each in (top, *top.descendants())]
        can_touch = any(each.bounding is not None for each in below)
        has_unread = part.is_in_unread or any(node.unread for node in _within(part.node))
        lifted = any(
            node.type_name in ("Propeller", "Connector", "VacuumCup", "VacuumGripper")
            for node in _within(part.node)
        ) or any(part.node.children("immersionProperties"))
        if held or can_touch or lifted:
            return
        if has_unread:
            self._report.leave_out(
                ["bounding object"], part.node.path, "a PROTO in it cannot be read"
            )
            return
        self._report.blame(
            "bounding object", "warning", part.node, "boundingObject",
            f"{part.node.label} has physics and no bounding object anywhere: it falls through the "
            "floor",
            "Set boundingObject to a Box, Cylinder or Sphere of its size, or set physics to NULL.",
        )  # fmt: skip

    def _physics_chain(self, part: SolidPart) -> None:
        self._report.judge("physics")
        if part.physics is None:
            above = next((each for each in part.ancestors() if each.physics), None)
            below = next((each for each in part.descendants() if each.physics), None)
            if above is not None and below is not None and not part.is_in_unread:
                self._report.blame(
                    "physics", "error", part.node, "physics",
                    f"{part.node.label} has no physics, but {above.node.label} around it and "
                    f"{below.node.label} in it have: the chain is broken",
                    f"Give {part.node.label} a Physics node, or remove that of "
                    f"{below.node.label}.",
                )  # fmt: skip
            self._pinned_vehicle(part)
            return
        number = self._bodies.body_of[part]
        body = self._bodies.bodies[number]
        if body.is_fixed and body.top is part and not part.is_in_unread:
            moving = part.node.type_name == "Robot" or body.joined
            self._report.blame(
                "physics", "note", part.node, "physics",
                f"{part.node.label} has physics, but no Solid around it has: Webots fixes it to "
                "the world and it does not move",
                "Give the Solid around it a Physics node"
                + ("." if moving else ", or set physics to NULL here."),
            )  # fmt: skip

    def _pinned_vehicle(self, part: SolidPart) -> None:
        """Report a robot without physics whose driven wheels have physics."""
        if part.node.type_name != "Robot" or part.parent is not None:
            return
        wheels = [
            child
            for child in part.descendants()
            if child.physics and child.parent is part and is_driven_wheel(child)
        ]
        if len(wheels) >= 2:
            self._report.blame(
                "physics", "error", part.node, "physics",
                f"{part.node.label} has no physics, but its wheels have: its base is fixed to the "
                "world and the wheels turn in place",
                f"Give {part.node.label} a Physics node and a boundingObject.",
            )  # fmt: skip

    def _inertia(self, part: SolidPart) -> None:
        physics = part.physics
        if physics is None or physics.unread:
            return
        self._report.judge("inertia")
        mass, density = physics.number("mass"), physics.number("density")
        if mass <= 0.0 and density <= 0.0:
            self._report.blame(
                "inertia", "error", physics, "mass",
                f"mass is {mass:g} and density is {density:g}: none of them is positive, so that "
                "the mass is not given",
                "Set mass to the mass in kg and density to -1, or density to that of the material, "
                "for example 1000.",
            )  # fmt: skip
            return
        values = physics.numbers("inertiaMatrix")
        if not values:
            return
        if len(values) != 6:
            self._report.blame(
                "inertia", "error", physics, "inertiaMatrix",
                f"inertiaMatrix has {len(values)} numbers instead of two vectors of three",
                "Give [I11 I22 I33, I12 I13 I23], or leave it out.",
            )  # fmt: skip
            return
        if physics.number("mass") <= 0.0:
            self._report.blame(
                "inertia", "error", physics, "mass",
                "inertiaMatrix is set, but mass is not: Webots needs both",
                "Set mass to the mass in kg and density to -1.",
            )  # fmt: skip
        if not all(map(isfinite, values)):
            return
        smallest, middle, largest = sorted(np.linalg.eigvalsh(inertia_matrix(values)).tolist())
        shown = f"{smallest:.3g}, {middle:.3g} and {largest:.3g} kg m²"
        if smallest <= 0.0:
            self._report.blame(
                "inertia", "error", physics, "inertiaMatrix",
                f"The principal moments of inertia are {shown}: they have to be positive",
                "Correct the matrix, or leave it out: Webots then computes it from boundingObject.",
            )  # fmt: skip
        elif smallest + middle < largest * (1.0 - _TOLERANCES.inertia):
            self._report.blame(
                "inertia", "warning", physics, "inertiaMatrix",
                f"The principal moments of inertia are {shown}: no mass distribution has one that "
                "is larger than the sum of the other two",
                "Correct the matrix, or leave it out: Webots then computes it from boundingObject.",
            )  # fmt: skip

    # -- joints --

    def _joint_ratios(self) -> None:
        for number, body in enumerate(self._bodies.bodies):
            for other_number in sorted(each for each in body.joined if each > number):
                other = self._bodies.bodies[other_number]
                self._ratio(body, other, "joined by a joint")

    def _ratio(self, a: PhysicsBody, b: PhysicsBody, how: str) -> None:
        masses = (a.mass_kg, b.mass_kg)
        unknown = next((body for body in (a, b) if body.mass_kg is None), None)
        if masses[0] is None or masses[1] is None:
            where = (unknown or a).top.node.path
            self._report.leave_out(["mass ratio"], where, "its mass depends on a mesh or a PROTO")
            return
        self._report.judge("mass ratio")
        light, heavy = sorted((a, b), key=lambda body: body.mass_kg or 0.0)
        small_kg, large_kg = (light.mass_kg or 0.0), (heavy.mass_kg or 0.0)
        if small_kg <= 0.0 or not isfinite(large_kg):
            return
        if large_kg <= _TOLERANCES.mass_ratio * small_kg:
            return
        node = light.top.physics or light.top.node
        self._report.blame(
            "mass ratio", "warning", node, "mass" if node.type_name == "Physics" else "",
            f"{light.top.node.label} ({small_kg:.3g} kg) and {heavy.top.node.label} "
            f"({large_kg:.3g} kg) are {how} at a ratio of 1:{large_kg / small_kg:,.0f}",
            f"Set the light one to at least {large_kg / _TOLERANCES.mass_ratio:.3g} kg, or merge "
            "the two: set its physics to NULL.",
        )  # fmt: skip

    def _springs(self) -> None:
        for part in self._bodies.parts:
            if part.joint is None or part.joint.type_name not in ("HingeJoint", "SliderJoint"):
                continue
            line = JointLine(part)
            parameters = line.parameters
            stiffness = parameters.number("springConstant") if parameters else 0.0
            if parameters is None or parameters.unread or stiffness <= 0.0 or not part.physics:
                continue
            load = self._load(part, line)
            if load is None or load <= 0.0 or not line.is_known:
                self._report.leave_out(
                    ["time step"], parameters.path, "the inertia that its spring moves is not known"
                )
                continue
            self._report.judge("time step")
            rate = sqrt(stiffness / load)
            step_s = self._scene.step_s
            if rate * step_s <= 2.0:
                continue
            unit = "N/m" if part.joint.type_name == "SliderJoint" else "N m/rad"
            moved = "kg" if part.joint.type_name == "SliderJoint" else "kg m²"
            best_ms = int(2000.0 / rate)
            shorter = f"WorldInfo.basicTimeStep to at most {best_ms} ms, or " if best_ms else ""
            softer = 4.0 * load / step_s**2
            self._report.blame(
                "time step", "warning", parameters, "springConstant",
                f"A spring of {stiffness:.3g} {unit} on {load:.3g} {moved} oscillates at "
                f"{rate:.3g} rad/s: basicTimeStep {1000.0 * step_s:g} ms is longer than 2/omega = "
                f"{2000.0 / rate:.3g} ms, so it acts as a rigid link",
                f"Set {shorter}springConstant to at most {softer:.2g} (4 m / step²).",
            )  # fmt: skip

    def _load(self, part: SolidPart, line: JointLine) -> float | None:
        """Return the mass or inertia that a joint moves: that of the whole branch behind it.

        The mobility of the parent is left out, which makes the oscillation slower: a fault is
        reported later rather than sooner.
        """
        branch = [part, *part.descendants()]
        assert part.joint is not None
        if any(node.unread for node in _within(part.node)):
            return None
        if part.joint.type_name == "SliderJoint":
            masses = [each.mass_kg if each.physics else 0.0 for each in branch]
        else:
            masses = [each.inertia_about(line.anchor, line.axis) for each in branch]
        known = [each for each in masses if each is not None]
        return sum(known) if len(known) == len(masses) else None

    # -- contacts --

    def _sinking(self) -> None:
        """Report bodies that sink into the ground by a large share of their size.

        A contact of ODE is a spring of k = ERP / (step CFM); at rest it yields by m g / k.
        """
        done: set[int] = set()
        for number in range(len(self._bodies.bodies)):
            numbers = self._bodies.assembly_of(number)
            if number in done:
                continue
            done |= numbers
            members = [self._bodies.bodies[each] for each in numbers]
            if any(body.is_fixed or body.is_on_static for body in members):
                continue
            masses = [body.mass_kg for body in members]
            parts = [part for body in members for part in body.parts]
            shapes = [part.shape for part in parts]
            top = members[0].top
            extents = [p.extent for shape in shapes for p in shape.primitives]
            if any(each is None for each in masses) or not extents or self._erp <= 0.0:
                if self._gravity > 0.0:
                    self._report.leave_out(["time step"], top.node.path, "its mass is not known")
                continue
            self._report.judge("time step")
            mass = sum(each or 0.0 for each in masses)
            smallest = 2.0 * float(np.min(np.max(np.array(extents), axis=0)))
            sag = mass * self._gravity * self._scene.step_s * self._cfm / (self._erp * _CONTACTS)
            if not isfinite(smallest) or sag <= _TOLERANCES.sag_share * smallest:
                continue
            wanted = self._cfm * _TOLERANCES.sag_share * smallest / sag
            named = any(self._scene.info.children("contactProperties"))
            self._report.blame(
                "time step", "warning", top.node, "physics",
                f"{top.node.label} weighs {mass:.3g} kg: with a step of "
                f"{1000.0 * self._scene.step_s:g} ms, CFM {self._cfm:g} and ERP {self._erp:g} it "
                f"sinks m g step CFM / (4 ERP) = {1000.0 * sag:.3g} mm into the ground, of its "
                f"{1000.0 * smallest:.3g} mm",
                f"Set {'ContactProperties.softCFM' if named else 'WorldInfo.CFM'} to {wanted:.1g}, "
                "or shorten WorldInfo.basicTimeStep.",
            )  # fmt: skip

    def _pairs(self) -> None:
        """Compare bounding objects that may touch at the start."""
        fall_m = max(self._gravity * self._scene.step_s**2 / 2.0, _TOLERANCES.overlap_m)
        compared = 0
        deepest: dict[tuple[SolidPart, SolidPart], float] = {}
        for a, b in self._candidates(fall_m):
            compared += 1
            if compared > _TOLERANCES.pairs:
                self._report.leave_out(
                    ["overlap", "mass ratio"], self._scene.world.name,
                    f"more than {_TOLERANCES.pairs:,} pairs of shapes are close to each other",
                )  # fmt: skip
                break
            if compared % 16 == 0:
                self._deadline.check()
            depth = overlap_m(a[1], b[1], enough_m=-fall_m)
            pair = (a[0], b[0])
            deepest[pair] = max(deepest.get(pair, -inf), depth)
        self._report.judge("overlap", max(compared, len(self._bodies.bodies)))
        for (one, other), depth in deepest.items():
            self._overlap(one, other, depth)
            bodies = [self._bodies.body_of.get(each) for each in (one, other)]
            if depth >= -fall_m and bodies[0] is not None and bodies[1] is not None:
                a_body, b_body = (self._bodies.bodies[each or 0] for each in bodies)
                self._ratio(a_body, b_body, "in contact")

    def _candidates(
        self, margin_m: float
    ) -> Iterator[tuple[tuple[SolidPart, Primitive], tuple[SolidPart, Primitive]]]:
        placed: list[tuple[SolidPart, Primitive]] = []
        for part in self._bodies.parts:
            if part.bounding is None:
                continue
            shape = part.shape
            if shape.incomplete or shape.is_mesh:
                why = shape.incomplete or "meshes and elevation grids are not compared"
                self._report.leave_out(["overlap"], part.node.path, why)
            if not shape.incomplete:
                placed += [(part, each) for each in shape.primitives]
        if len(placed) < 2:
            return
        planes = [each for each in placed if each[1].kind == "Plane"]
        solids = [each for each in placed if each[1].kind != "Plane"]
        for plane in planes:
            yield from ((plane, each) for each in solids if self._can_collide(plane[0], each[0]))
        if not solids:
            return
        centers = np.array([each[1].center for each in solids])
        halves = np.array([each[1].extent for each in solids]) + margin_m / 2.0
        low, high = centers - halves, centers + halves
        order = np.argsort(low[:, 0])
        for place, i in enumerate(order):
            self._deadline.check()
            rest = order[place + 1 :]
            rest = rest[: np.searchsorted(low[rest, 0], high[i, 0], side="right")]
            near = rest[((low[rest] <= high[i]) & (high[rest] >= low[i])).all(axis=1)]
            for j in sorted(near.tolist()):
                a, b = solids[min(int(i), j)], solids[max(int(i), j)]
                if self._can_collide(a[0], b[0]):
                    yield a, b

    def _can_collide(self, one: SolidPart, other: SolidPart) -> bool:
        """Return whether Webots makes contacts between two solids."""
        if one is other:
            return False
        numbers = [self._bodies.body_of.get(each) for each in (one, other)]
        bodies = [None if each is None else self._bodies.bodies[each] for each in numbers]
        static = [each is None or each.is_fixed for each in bodies]
        if all(static) or (numbers[0] is not None and numbers[0] == numbers[1]):
            return False
        for body, is_static in zip(bodies, reversed(static), strict=True):
            if is_static and body is not None and body.is_on_static:
                return False
        robot = one.robot
        if robot is not None and robot is other.robot and not robot.is_true("selfCollision"):
            return False
        if numbers[0] is not None and numbers[1] is not None:
            return numbers[1] not in self._bodies.joined_within(numbers[0], 2)
        return True

    def _overlap(self, one: SolidPart, other: SolidPart, depth: float) -> None:
        """Report an overlap that throws a body up.

        A contact moves bodies apart at ERP depth / step. What is slower than the speed that
        gravity adds in a step, g step, only holds the body up.
        """
        step_s = self._scene.step_s
        masses = [
            self._bodies.bodies[number].mass_kg or 0.0
            for number in (self._bodies.body_of.get(each) for each in (one, other))
            if number is not None
        ]
        rest = max(masses) * self._gravity * step_s * self._cfm / max(self._erp, 1e-9)
        lifted = self._gravity * step_s**2 / max(self._erp, 1e-9)
        if depth <= max(_TOLERANCES.overlap_m, rest, lifted):
            return
        speed = self._erp * depth / step_s
        mover = one if one in self._bodies.body_of else other
        still = other if mover is one else one
        self._report.blame(
            "overlap", "warning", mover.node, "translation",
            f"{mover.node.label} overlaps {still.node.label} by {1000.0 * depth:.3g} mm at the "
            f"start: they part at ERP depth / step = {speed:.2g} m/s",
            f"Move one of them by {1000.0 * depth:.3g} mm, or shrink a boundingObject.",
        )  # fmt: skip


def _is_single(info: TreeNode) -> bool:
    """Return whether gravity is one number; before R2020b it was a vector."""
    return len(info.fields.get("gravity", [0.0])) == 1


def _within(node: TreeNode) -> Iterator[TreeNode]:
    yield node
    for child in node.children():
        yield from _within(child)


def is_driven_wheel(part: SolidPart) -> bool:
    """Return whether a Solid is a round body that a motor turns without an end about its axis."""
    joint = part.joint
    if joint is None or joint.type_name not in ("HingeJoint", "Hinge2Joint"):
        return False
    motors: Sequence[TreeNode] = [
        each for each in joint.children("device", "device2") if each.type_name == "RotationalMotor"
    ]
    if not motors or any(
        motor.number("minPosition") != motor.number("maxPosition") for motor in motors
    ):
        return False
    kinds = {each.kind for each in part.shape.primitives}
    return bool(kinds) and kinds <= {"Cylinder", "Sphere"} and not part.shape.incomplete
