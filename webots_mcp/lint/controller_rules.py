"""Rules about robots and their controllers."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final

from webots_mcp.contract import CONTROLLER_FOLDER
from webots_mcp.lint.controller_source import ControllerSource, read_source
from webots_mcp.lint.scene import DEVICES, LintDeadline, Scene, TreeNode
from webots_mcp.lint.world_faults import LintReport, WorldFault
from webots_mcp.simulator.project import ProjectController, controllers_of

_WITHOUT_PROCESS: Final = frozenset({"", "void", "<none>", "<generic>", "<extern>"})
_OF_WEBOTS: Final = frozenset({"braitenberg", "ros", "void"})
"""Controllers in Webots' folder projects/default/controllers."""
_RULES_OF_SOURCE: Final = ("devices", "sampling period", "synchronization")
_MOST_NAMED: Final = 6


class ControllerRules:
    """The rules about robots, for one scene."""

    def __init__(self, scene: Scene, report: LintReport, deadline: LintDeadline) -> None:
        self._scene = scene
        self._report = report
        self._deadline = deadline
        self._sources: dict[Path, ControllerSource] = {}

    def search(self) -> None:
        """Apply all rules."""
        for node in self._scene.unread:
            if "controller" in node.fields:
                self._unread_robot(node)
        robots = [*self._scene.of_type("Robot")]
        running: dict[Path, list[TreeNode]] = {}
        for robot in robots:
            self._deadline.check()
            controller = self._controller(robot)
            if controller is not None:
                running.setdefault(controller.file, []).append(robot)
                self._source_of(controller)
        for file, those in running.items():
            source = self._sources[file]
            self._periods(source, those)
            for robot in those:
                self._devices(robot, source, those)
                self._synchronization(robot, source)

    def _source_of(self, controller: ProjectController) -> ControllerSource:
        if controller.file not in self._sources:
            self._sources[controller.file] = read_source(controller)
        return self._sources[controller.file]

    # -- controllers --

    @cached_property
    def _controllers(self) -> dict[str, ProjectController]:
        return {each.name: each for each in controllers_of(self._scene.project)}

    def _unread_robot(self, node: TreeNode) -> None:
        """Check the controller of a robot whose PROTO cannot be read, as far as possible."""
        name = node.text("controller") or str(node.fields.get("controller"))
        why = f"{node.written_type}: {node.unread}"
        if name not in _WITHOUT_PROCESS and name not in self._controllers:
            self._report.leave_out(
                ["controller"], f"{node.path}.controller",
                f"{name!r} is not in this project, and may be next to the PROTO. {why}",
            )  # fmt: skip
        else:
            self._report.judge("controller")
        controller = self._controllers.get(name)
        if controller is not None:
            source = self._source_of(controller)
            self._periods(source, [node])
            if node.fields.get("synchronization") is False:
                self._synchronization(node, source)

    def _controller(self, robot: TreeNode) -> ProjectController | None:
        name = robot.text("controller")
        if name in _WITHOUT_PROCESS:
            self._report.judge("controller")
            if name == "<extern>":
                self._report.leave_out(
                    _RULES_OF_SOURCE, robot.path,
                    "its controller is <extern>: which program that is, the world does not say",
                )  # fmt: skip
            return None
        if re.search(r"[{}$<>%]", name):
            reason = f"{name!r} looks like a placeholder that a program replaces"
            self._report.leave_out(["controller", *_RULES_OF_SOURCE], robot.path, reason)
            return None
        found = self._controllers.get(name) or self._next_to_proto(robot, name)
        if found is not None:
            self._report.judge("controller")
            return found
        if self._is_of_webots(name):
            self._report.leave_out(
                _RULES_OF_SOURCE, robot.path, f"the controller {name!r} is part of Webots"
            )
            return None
        folder = self._scene.project / CONTROLLER_FOLDER / name
        if folder.is_dir():
            reason = f"{folder.name} has no file that is known here to be a controller"
            self._report.leave_out(["controller", *_RULES_OF_SOURCE], robot.path, reason)
            return None
        if self._scene.home is None and (len(robot.proto_files) or not self._has_folder()):
            why = "there is no folder 'controllers' next to the world's"
            if robot.proto_files:
                why = f"{name!r} may be a controller of Webots; set WEBOTS_HOME to find out"
            self._report.leave_out(["controller", *_RULES_OF_SOURCE], robot.path, why)
            return None
        self._report.judge("controller")
        close = difflib.get_close_matches(name, self._controllers, 1)
        meant = f"Set it to {close[0]!r}" if close else "Set it to the name of a folder in there"
        self._report.blame(
            "controller", "error", robot, "controller",
            f"{robot.label} has the controller {name!r}, and there is no controllers/{name}",
            f"{meant}, or add controllers/{name}/{name}.py.",
        )  # fmt: skip
        return None

    def _has_folder(self) -> bool:
        return (self._scene.project / CONTROLLER_FOLDER).is_dir()

    def _next_to_proto(self, robot: TreeNode, name: str) -> ProjectController | None:
        projects = dict.fromkeys(file.parent.parent for file in robot.proto_files)
        for project in projects:
            found = {each.name: each for each in controllers_of(project)}
            if name in found:
                return found[name]
        return None

    def _is_of_webots(self, name: str) -> bool:
        if name in _OF_WEBOTS:
            return True
        home = self._scene.home
        if home is None or "/" in name or "*" in name or "?" in name or "[" in name:
            return False
        return any((home / "projects").glob(f"**/controllers/{name}"))

    # -- devices --

    def _devices(
        self, robot: TreeNode, source: ControllerSource, those: Sequence[TreeNode]
    ) -> None:
        unread = next((node for node in _inside(robot) if node.unread), None)
        if unread is not None or self._scene.cut:
            why = self._scene.cut or (f"{unread.written_type}: {unread.unread}" if unread else "")
            self._report.leave_out(["devices"], robot.path, why)
            return
        own = {node.text("name") for node in _devices_of(robot)}
        shared = {node.text("name") for other in those for node in _devices_of(other)}
        missing: dict[str, list[int]] = {}
        for use in source.devices:
            self._report.judge("devices")
            if use.name in own or not use.name:
                continue
            if len(those) > 1 and use.name in shared:
                continue  # one program for several robots
            lines = missing.setdefault(use.name, [])
            lines.append(use.line)
            if len(lines) > 1:
                continue
            close = difflib.get_close_matches(use.name, own, 1)
            fix = f"Ask for {close[0]!r}" if close else "Ask for a device that the robot has"
            self._report.faults.append(
                WorldFault(
                    "devices", "warning" if use.is_guarded else "error", f"{robot.path}.children",
                    use.file, use.line,
                    f"The controller of {robot.label} asks for the device {use.name!r}, which the "
                    "robot does not have",
                    f"{fix}, or name one of its devices {use.name!r}.",
                )
            )  # fmt: skip
        if source.unread:
            self._report.leave_out(
                ["devices"], robot.path, f"other devices than those by name: {source.unread}"
            )
            return
        self._unused(robot, source)

    def _unused(self, robot: TreeNode, source: ControllerSource) -> None:
        used = {use.name for use in source.devices}
        self._report.judge("devices")
        idle = [
            node
            for node in _devices_of(robot)
            if node.text("name") not in used and node.type_name not in ("Track", "Skin")
        ]
        if not idle:
            return
        names = ", ".join(repr(node.text("name")) for node in idle[:_MOST_NAMED])
        more = f" and {len(idle) - _MOST_NAMED} more" if len(idle) > _MOST_NAMED else ""
        self._report.blame(
            "devices", "note", idle[0], "name",
            f"The controller of {robot.label} never asks for {names}{more}",
            "Use them in the controller, or remove them from the robot.",
        )  # fmt: skip

    # -- periods and learning --

    def _periods(self, source: ControllerSource, robots: Sequence[TreeNode]) -> None:
        step_ms = self._scene.info.number("basicTimeStep")
        if step_ms <= 0.0:
            return
        if source.unread_period:
            self._report.leave_out(["sampling period"], robots[0].path, source.unread_period)
        for use in source.periods:
            self._report.judge("sampling period")
            steps = use.period_ms / step_ms
            if abs(steps - round(steps)) < 1e-6 * max(1.0, steps) and steps >= 0.5:
                continue
            best = max(1, round(steps)) * step_ms
            what = "robot.step" if use.call == "step" else "enable"
            effect = (
                "Webots warns, and the loop runs at another rate than it asks for"
                if use.call == "step"
                else "Webots measures at steps only, so at another rate than asked for"
            )
            self._report.faults.append(
                WorldFault(
                    "sampling period", "warning" if use.call == "step" else "note",
                    f"{self._scene.info.path}.basicTimeStep", use.file, use.line,
                    f"{what}({use.period_ms:g}) in the controller of {robots[0].label} is no "
                    f"multiple of basicTimeStep {step_ms:g} ms: {effect}",
                    f"Use {best:g}, or int(robot.getBasicTimeStep()) times a whole number.",
                )
            )  # fmt: skip

    def _synchronization(self, robot: TreeNode, source: ControllerSource) -> None:
        is_synchronous = robot.fields.get("synchronization") is not False
        if not is_synchronous and source.unread and not source.learns_with:
            self._report.leave_out(["synchronization"], robot.path, source.unread)
        self._report.judge("synchronization")
        if is_synchronous or not source.learns_with:
            return
        self._report.blame(
            "synchronization", "error", robot, "synchronization",
            f"{robot.label} has synchronization FALSE, and its controller learns with "
            f"{source.learns_with}: what an action does depends on the load of the computer",
            "Set synchronization to TRUE.",
        )  # fmt: skip


def _inside(node: TreeNode) -> Iterator[TreeNode]:
    """Yield the nodes in a robot, without those of robots in it."""
    for child in node.children():
        if child.type_name != "Robot":
            yield child
            yield from _inside(child)


def _devices_of(robot: TreeNode) -> Iterator[TreeNode]:
    return (node for node in _inside(robot) if node.type_name in DEVICES)
