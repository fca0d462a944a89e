"""What is wrong with a world: faults that make a simulation shake, drift, explode or stand still.

It reads the world file, the PROTO files that are here and the sources of the controllers, and
starts nothing. Questions and commands import it. It imports `worlds`, the project in
`simulator`, and what stands below.
"""

from __future__ import annotations

from pathlib import Path

from webots_mcp.lint.world_faults import IN_THE_SCENE, RULES, LintReport, WorldFault

__all__ = ["RULES", "LintReport", "lint_world"]


def lint_world(world: Path, processor_s: float | None = None) -> LintReport:
    """Search a world file for faults.

    A file that cannot be parsed is a fault itself, and then no other rule is searched.

    Args:
        world: A .wbt file.
        processor_s: Processor time in seconds after which the rest is not searched. Default: as
            `ReadingLimits` says.
    """
    # The rules and numpy, which a server that only lists its tools does without.
    from webots_mcp.lint.bodies import Bodies
    from webots_mcp.lint.controller_rules import ControllerRules
    from webots_mcp.lint.joint_rules import JointRules
    from webots_mcp.lint.physics_rules import PhysicsRules
    from webots_mcp.lint.scene import LIMITS, LintDeadline, OutOfTimeError, Scene
    from webots_mcp.lint.world_rules import WorldRules
    from webots_mcp.worlds.world_errors import WorldFileError

    world = world.resolve()
    report = LintReport(world)
    if processor_s is None:
        processor_s = LIMITS.processor_s
    deadline = LintDeadline(processor_s)
    others = [name for name in RULES if name != "file"]
    try:
        scene = Scene(world, deadline)
        if scene.cut:
            report.leave_out(RULES, world.name, scene.cut)
        for node in scene.unread:
            if scene.may_hold_solids(node):
                reason = f"{node.written_type}: {node.unread}"
                report.leave_out(IN_THE_SCENE, node.path, reason)
        bodies = Bodies(scene)
        WorldRules(scene, bodies, report).search()
        ControllerRules(scene, report, deadline).search()
        JointRules(scene, bodies, report).search()
        PhysicsRules(scene, bodies, report, deadline).search()
    except WorldFileError as error:
        line = error.line or 1
        report.judge("file")
        report.faults.append(
            WorldFault(
                "file", "error", world.name, world, line, f"{world.name}: {error}",
                f"Correct line {line}, or open the world in Webots and save it.",
            )
        )  # fmt: skip
        report.leave_out(others, world.name, "the file cannot be read")
    except OutOfTimeError:
        report.leave_out(
            RULES, world.name, f"not finished after {processor_s:g} s of processor time"
        )
    except RecursionError:
        report.leave_out(RULES, world.name, "its nodes are too deep within each other")
    return report.finish()
