"""Rules about a world file: its fields, time step, PROTO nodes, equal names, cost of sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import takewhile
from math import pi
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.lint.bodies import Bodies, SolidPart
from webots_mcp.lint.scene import (
    DEVICES,
    EXTERNPROTO_SINCE,
    NODE_TYPES,
    Scene,
    TreeNode,
)
from webots_mcp.lint.world_faults import LintReport, Severity, WorldFault
from webots_mcp.worlds.vrml import FieldDefinition

_MOST_LINES: Final = 5
_SIMILAR: Final = 0.7  # least similarity of a suggestion for a name that is certainly wrong
_NO_FIELDS: Final[Mapping[str, FieldDefinition]] = {}
_TAKES: Final = {
    "Bool": "TRUE or FALSE", "String": "a text in quotes", "Node": "a node or NULL",
    **dict.fromkeys(("Float", "Int32"), "a number"),
    **dict.fromkeys(("Vec2f", "Vec3f", "Rotation", "Color"), "numbers"),
}  # fmt: skip


@dataclass(frozen=True)
class RenderingEstimate:
    """What an ordinary graphics card renders and copies; a rough estimate, not a measurement.

    Attributes:
        pixels_per_wall_s: Pixels or lidar points in a second of wall time.
    """

    pixels_per_wall_s: float = 100e6


_RENDERING: Final = RenderingEstimate()


class WorldRules:
    """The rules about the file, for one scene."""

    def __init__(self, scene: Scene, bodies: Bodies, report: LintReport) -> None:
        self._scene = scene
        self._bodies = bodies
        self._report = report

    def search(self) -> None:
        """Apply all rules."""
        self._report.judge("file")
        self._values()
        self._field_names()
        self._time_step()
        self._undeclared()
        self._names()
        self._rendering()

    def _values(self) -> None:
        """Report values of another kind than their field takes, such as a number in quotes."""
        for node in self._scene.nodes:
            types = NODE_TYPES.get("" if node.unread else node.type_name, _NO_FIELDS)
            for name in node.fields.keys() & types.keys():
                takes, value = _TAKES[types[name].type_name[2:]], node.fields[name]
                if not _is_of_kind(value, types[name].type_name):
                    self._report.blame(
                        "file", "error", node, name,
                        f"{node.type_name}.{name} takes {takes}, not {_as_written(value)}",
                        f"Write {takes} there.",
                    )  # fmt: skip
            if "axis" in types and not any(node.vector("axis", 3)):
                self._report.blame(
                    "file", "error", node, "axis",
                    f"{node.type_name}.axis is 0 0 0, which is no direction",
                    "Set axis to a direction, for example 0 1 0.",
                )  # fmt: skip

    def _field_names(self) -> None:
        """Report fields that no PROTO declares, and misspelt fields of Webots' own nodes.

        A field of a Webots node that resembles no known field is not reported: it may belong to
        another release.
        """
        for (file, line, name), (type_name, source) in self._scene.unknown_fields.items():
            near = _likely_meant(name, source.fields)
            has = f"; it has {near}" if near else ""
            self._report.faults.append(
                WorldFault(
                    "file", "warning", f"{type_name}.{name}", file, line,
                    f"{source.file.name} has no field {name}{has}: Webots ignores its value",
                    f"Write {near}." if near else f"Remove {name}, or add it to the PROTO.",
                )
            )  # fmt: skip
        seen: set[tuple[Path, int, str]] = set()  # a line of a PROTO is in each of its instances
        for node in self._scene.nodes:
            types = NODE_TYPES.get("" if node.unread else node.type_name, _NO_FIELDS)
            for name in (each for each in node.fields if each not in types):
                near = _misspelt(name, types)
                place = node.file, node.line_of(name), name
                if not near or place in seen:
                    continue
                seen.add(place)
                is_given = near in node.fields
                keeps = "which is given too" if is_given else "which keeps its default"
                self._report.blame(
                    "file", "warning", node, name,
                    f"{node.type_name} has no field {name}; it has {near}, {keeps}",
                    f"Remove {name}." if is_given else f"Write {near}.",
                )  # fmt: skip

    def _time_step(self) -> None:
        info = self._scene.info
        step_ms = info.number("basicTimeStep")
        if step_ms < 1.0:
            self._report.blame(
                "time step", "error", info, "basicTimeStep",
                f"basicTimeStep is {step_ms:g} ms; the shortest is 1 ms",
                "Set it to 1 or more, for example 16.",
            )  # fmt: skip

    # -- PROTO nodes --

    def _undeclared(self) -> None:
        seen: set[tuple[Path, str]] = set()
        for node in self._scene.nodes:
            name = node.written_type
            file = node.written_file or node.file
            if name in NODE_TYPES or (file, name) in seen:
                continue
            seen.add((file, name))
            release = self._scene.releases.get(file, self._scene.release)
            if release < EXTERNPROTO_SINCE:
                self._report.leave_out(
                    ["undeclared PROTO"], file.name,
                    f"it is a file of {release}, for which Webots finds PROTO nodes itself",
                )  # fmt: skip
                continue
            self._report.judge("undeclared PROTO")
            urls = self._scene.declared.get(file, {})
            line = node.written_line
            if name not in urls:
                self._missing_declaration(node, name, file, line)
            elif "://" not in urls[name] and not (file.parent / urls[name]).is_file():
                self._report.faults.append(
                    WorldFault(
                        "undeclared PROTO", "error", node.path, file, line,
                        f'EXTERNPROTO "{urls[name]}" names a file that is not there',
                        f"Correct the path; it is relative to {file.parent.name}/.",
                    )
                )  # fmt: skip
        if not seen:
            self._report.judge("undeclared PROTO")

    def _missing_declaration(self, node: TreeNode, name: str, file: Path, line: int) -> None:
        own = self._scene.project / "protos" / f"{name}.proto"
        url = f"../protos/{name}.proto" if own.is_file() else f".../{name}.proto"
        self._report.faults.append(
            WorldFault(
                "undeclared PROTO", "error", node.path, file, line,
                f"{file.name} uses {name}, which is no node of Webots, without EXTERNPROTO",
                f'Add EXTERNPROTO "{url}" at the top of {file.name}'
                + ("." if own.is_file() else ", with the address of the PROTO."),
            )
        )  # fmt: skip

    # -- names --

    def _names(self) -> None:
        families: dict[SolidPart | None, list[SolidPart]] = {}
        for part in self._bodies.parts:
            families.setdefault(part.parent, []).append(part)
        for siblings in families.values():
            nodes = [part.node for part in siblings if not part.is_in_unread]
            self._report_equal(nodes, "Solid")
        for robot in self._scene.of_type("Robot"):
            devices = [node for node in _inside(robot) if node.type_name in DEVICES]
            self._report_equal(devices, "device", robot)

    def _report_equal(
        self, nodes: Sequence[TreeNode], kind: str, robot: TreeNode | None = None
    ) -> None:
        self._report.judge("names", len(nodes))
        counts = Counter(node.text("name") for node in nodes)
        for name, count in counts.items():
            if count < 2:
                continue
            those = [node for node in nodes if node.text("name") == name]
            if kind == "Solid" and all(node.type_name in DEVICES for node in those):
                continue  # reported as devices of the robot
            lines = ", ".join(str(node.line_of("name")) for node in those[:_MOST_LINES])
            more = " and more" if count > _MOST_LINES else ""
            robots = [node for node in those if node.type_name == "Robot"]
            severity: Severity = "warning" if kind == "device" or len(robots) > 1 else "note"
            where = f"in {robot.label}" if robot else "next to each other"
            effect = {
                "device": "getDevice returns only one of them",
                "Solid": "Webots warns, and only one can be found by name",
            }[kind]
            self._report.blame(
                "names", severity, those[1], "name",
                f"{count} {kind}s {where} have the name {name!r} (lines {lines}{more}): {effect}",
                "Give each a name of its own.",
            )  # fmt: skip

    # -- what sensors cost --

    def _rendering(self) -> None:
        step_s = self._scene.step_s
        if step_s <= 0.0:
            return
        loads: list[tuple[float, TreeNode, str]] = []
        for node in self._scene.of_type("Camera", "RangeFinder"):
            width, height = node.number("width"), node.number("height")
            loads.append((width * height, node, f"{width:g} x {height:g} pixels"))
        loads += [self._lidar(node) for node in self._scene.of_type("Lidar")]
        self._report.judge("rendering load", len(loads) + 1)
        total = sum(load[0] for load in loads)
        factor = total / step_s / _RENDERING.pixels_per_wall_s
        if factor <= 1.0 or not loads:
            return
        _, node, what = max(loads, key=lambda load: load[0])
        field = "horizontalResolution" if node.type_name == "Lidar" else "width"
        others = f", with {len(loads) - 1} others" if len(loads) > 1 else ""
        self._report.blame(
            "rendering load", "warning", node, field,
            f"{node.label} renders {what}{others}: sampled at each step of {1000.0 * step_s:g} ms, "
            f"about {total / step_s / 1e6:.0f} million pixels per simulated second, an estimated "
            f"{factor:.1f} times what an ordinary graphics card does in real time",
            "Lower the resolution, or enable the sensor with a longer period.",
        )  # fmt: skip

    def _lidar(self, node: TreeNode) -> tuple[float, TreeNode, str]:
        columns, layers = node.number("horizontalResolution"), node.number("numberOfLayers")
        wide, high = node.number("fieldOfView"), node.number("verticalFieldOfView")
        self._report.judge("lidar layers")
        if node.text("type") == "rotating":
            wide = 2.0 * pi
        rows = columns * high / wide if wide > 0.0 else 0.0
        if layers > 1.0 and layers >= rows > 0.0:
            self._report.blame(
                "lidar layers", "warning", node, "numberOfLayers",
                f"{node.label} has {layers:g} layers, but its image has only {rows:.3g} rows: "
                "verticalFieldOfView * horizontalResolution / fieldOfView",
                f"Set horizontalResolution to more than {layers * wide / high:.0f}, or "
                f"numberOfLayers to less than {rows:.3g}.",
            )  # fmt: skip
        return columns * max(layers, rows), node, f"{columns:g} x {max(layers, rows):.0f} points"


def _inside(node: TreeNode) -> list[TreeNode]:
    found: list[TreeNode] = []
    for child in node.children():
        if child.type_name != "Robot":
            found += [child, *_inside(child)]
    return found


def _likely_meant(name: str, known: Iterable[str]) -> str:
    """Return the known field that is spelled most alike, ignoring case; "" if none is similar."""
    by_letters = {each.lower(): each for each in known}
    near = get_close_matches(name.lower(), by_letters, 1, _SIMILAR)
    return by_letters[near[0]] if near else ""


def _misspelt(name: str, known: Iterable[str]) -> str:
    """Return the known field from which a name differs by one slip of the keyboard; else ""."""
    return next((each for each in known if _is_one_slip(name.lower(), each.lower())), "")


def _is_one_slip(a: str, b: str) -> bool:
    """Return whether one letter is missing, too many or wrong, or two neighbours are swapped."""
    start = _length_alike(a, b)
    end = _length_alike(a[start:][::-1], b[start:][::-1])
    one, other = a[start : len(a) - end], b[start : len(b) - end]
    return max(len(one), len(other)) <= 1 or (len(one) == 2 and one == other[::-1])


def _length_alike(a: str, b: str) -> int:
    """Return how many letters at the start of two texts are the same."""
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(a, b, strict=False)))


def _is_of_kind(value: Any, type_name: str) -> bool:
    """Whether a value of the file fits a type, but for how many numbers it has."""
    kind = type_name[2:]
    expected = {"String": str, "Bool": bool, "Node": (TreeNode, type(None))}.get(kind, float)
    values = cast("list[Any]", value) if isinstance(value, list) else [value]
    return all(isinstance(each, expected) for each in values)


def _as_written(value: Any) -> str:
    if isinstance(value, list):
        value = cast("list[Any]", value)[0]
    if isinstance(value, TreeNode):
        return f"a {value.written_type} node"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, str):
        return f'"{value}"'
    return {True: "TRUE", False: "FALSE"}.get(value, "NULL")
