"""Small worlds with one fault each, and their healthy counterparts."""

from __future__ import annotations

from pathlib import Path

from webots_mcp.lint import lint_world
from webots_mcp.lint.world_faults import LintReport, WorldFault

FLOOR = 'Solid { name "floor" boundingObject Plane { size 10 10 } }'
DRIVE = (
    "from controller import Robot\n"
    "robot = Robot()\n"
    "motor = robot.getDevice('left')\n"
    "while robot.step(32) != -1:\n"
    "    pass\n"
)


def write_world(
    folder: Path, nodes: str, *, info: str = "", release: str = "R2023b", declared: str = ""
) -> Path:
    """Write worlds/w.wbt of a project; the file of each controller is written apart."""
    worlds = folder / "worlds"
    worlds.mkdir(exist_ok=True, parents=True)
    world = worlds / "w.wbt"
    world.write_text(
        f"#VRML_SIM {release} utf8\n{declared}\nWorldInfo {{ {info} }}\n{nodes}\n", "utf-8"
    )
    return world


def write_controller(folder: Path, source: str = DRIVE, name: str = "drive") -> None:
    """Write a controller in Python."""
    own = folder / "controllers" / name
    own.mkdir(exist_ok=True, parents=True)
    (own / f"{name}.py").write_text(source, "utf-8")


def write_proto(folder: Path, name: str, text: str) -> None:
    """Write a PROTO file of the project."""
    own = folder / "protos"
    own.mkdir(exist_ok=True)
    (own / f"{name}.proto").write_text(text, "utf-8")


def lint(folder: Path, nodes: str, *, info: str = "", release: str = "R2023b") -> LintReport:
    """Return what a lint says of a world with these nodes."""
    return lint_world(write_world(folder, nodes, info=info, release=release))


def faults_of(report: LintReport, rule: str) -> list[WorldFault]:
    """Return the faults of one rule."""
    return [fault for fault in report.faults if fault.rule == rule]
