"""The robot whose controller is to run a command.

A command is refused here, before it is queued, where no controller could run it; the text says
what to do instead.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping
from typing import Any

from webots_mcp.contract import BUILT_IN_ACTIONS, CUSTOM_DATA
from webots_mcp.errors import CommandRefusedError, InvalidInputError, UnknownActionError
from webots_mcp.signals.naming import misfit_of_parameters, perhaps_meant
from webots_mcp.store.loop_evidence import find_holder
from webots_mcp.store.recording import RobotView, view_robot
from webots_mcp.store.robot_status import may_return
from webots_mcp.store.robots import list_robots, live_observer, robot_name, without_observers
from webots_mcp.store.sessions import SessionRecord, companions


def find_target(connection: sqlite3.Connection, robot: str | None, action: str) -> RobotView:
    """Find the robot that is to run an action.

    Without a name it is the only live robot; for an action that steers the simulation, the only
    live Supervisor.

    Raises:
        InvalidInputError: There is no such robot or action, or several robots are possible.
        CommandRefusedError: It cannot run it: it has no live controller, it is not a Supervisor, or
            another robot's bridge has paused the simulation.
        NothingRecordedError: No robot was ever recorded.
    """
    if robot is None and _needs_supervisor(action):
        robot = _only_supervisor(connection)
    view = view_robot(connection, robot)
    _require_action(view, action)
    session = _require_live(view)
    if _needs_supervisor(action) and not session.supervisor:
        raise CommandRefusedError(_no_supervisor_text(view, session, action))
    _require_not_paused_elsewhere(view, session, action)
    return view


def require_parameters(view: RobotView, action: str, params: Mapping[str, Any]) -> None:
    """Refuse parameters that do not fit a built-in action; the bridge would refuse them too.

    Raises:
        InvalidInputError: One is unknown, missing or of another type.
    """
    built_in = BUILT_IN_ACTIONS.get(action)
    if built_in is None or (view.session and action in view.session.actions):
        return
    misfit = misfit_of_parameters(params, built_in.parameters, built_in.required, action)
    if misfit is not None:
        raise InvalidInputError(misfit)


def _needs_supervisor(action: str) -> bool:
    built_in = BUILT_IN_ACTIONS.get(action)
    return built_in is not None and built_in.needs_supervisor


def _only_supervisor(connection: sqlite3.Connection) -> str | None:
    """Return the name of the only live Supervisor; None if there is none, or several."""
    robots = [robot for robot in list_robots(connection, time.time()) if robot.live]
    supervisors = [robot for robot in robots if robot.session and robot.session.supervisor]
    names = [robot.name for robot in without_observers(supervisors)]
    return names[0] if len(names) == 1 else None


def _require_action(view: RobotView, action: str) -> None:
    """Refuse an action that the controller does not know.

    Without registered actions nothing is refused: the loop may handle what get_command() returns.
    """
    known = list(view.session.actions) if view.session else []
    if not known or action in known or action in BUILT_IN_ACTIONS:
        return
    near = perhaps_meant(action, [*known, *BUILT_IN_ACTIONS])
    offer = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    listed = known[:30]
    raise UnknownActionError(
        f"Robot {view.robot.name!r} has no action {action!r}. {offer}Its own actions are {listed}; "
        f"the built-in ones are {list(BUILT_IN_ACTIONS)}."
    )


def _require_live(view: RobotView) -> SessionRecord:
    """Return the robot's session; during a reload the old one: its successor runs the command."""
    session = view.session
    if session is not None and not session.has_bridge:
        raise CommandRefusedError(_no_bridge_text(view, session))
    if session is not None and (view.robot.live or may_return(session, view.now_s)):
        return session
    raise CommandRefusedError(
        f"Robot {view.robot.name!r} has no live controller: "
        f"{view.status.why or 'it was never seen'}. Start its simulation (webots_launch_world, or "
        "by hand), then call again"
    )


def _no_bridge_text(view: RobotView, session: SessionRecord) -> str:
    observer = live_observer(view.connection, session, view.now_s)
    is_observed = view.robot.kind == CUSTOM_DATA
    how = "the observer records it from its customData" if is_observed else "it writes a journal"
    by = (
        f"robot={observer.name!r}"
        if observer
        else "'webots-mcp init --observer WORLD' adds one to a world"
    )
    return (
        f"Robot {view.robot.name!r} takes no commands: it has no bridge, {how}. In Python give its "
        f"controller MCPBridge.attach(robot). To steer the simulation, use an observer ({by})"
    )


def _no_supervisor_text(view: RobotView, session: SessionRecord, action: str) -> str:
    make_one = (
        "set the field 'supervisor' of its Robot node to TRUE and create it with Supervisor() "
        "instead of Robot()"
    )
    others = [
        other for other in companions(view.connection, session, view.now_s) if other.supervisor
    ]
    next_step = make_one
    if others:
        name = robot_name(view.connection, others[0].robot_id)
        next_step = f"robot {name!r} is a Supervisor of this simulation: give robot={name!r}"
        if action == "run":
            next_step += f"; for conditions and parameters of {view.robot.name!r}, {make_one}"
    return f"{action} needs a Supervisor and robot {view.robot.name!r} is not one: {next_step}"


def _require_not_paused_elsewhere(view: RobotView, session: SessionRecord, action: str) -> None:
    """Refuse while another robot's bridge has paused the simulation: this loop cannot run then."""
    holder = find_holder(view.connection, session, view.now_s)
    if holder is None or holder.id == session.id:
        return
    name = robot_name(view.connection, holder.robot_id)
    raise CommandRefusedError(
        f"Robot {view.robot.name!r} cannot run {action!r} now: the bridge of robot {name!r} has "
        f"paused their simulation. Resume it first: "
        f"webots_simulation_control(command='resume', robot={name!r})"
    )
