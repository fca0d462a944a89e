"""Finding the robot whose controller is to run a command, or refusing it where none could."""

from __future__ import annotations

import difflib
import sqlite3
import time
from typing import Final

from webots_mcp.contract import BUILT_IN_ACTIONS, ISSUED_TIME_TO_LIVE_S
from webots_mcp.errors import CommandRefusedError, UnknownActionError
from webots_mcp.naming import same_in_meaning
from webots_mcp.store.recording import View, look
from webots_mcp.store.robots import (
    Session,
    companions,
    find_holder,
    list_robots,
    robot_name,
    without_observers,
)

_SHOWN_ACTIONS: Final = 30
_MAKE_ONE: Final = (
    "set the field 'supervisor' of its Robot node to TRUE and create it with Supervisor() instead "
    "of Robot()"
)


def find_target(connection: sqlite3.Connection, robot: str | None, action: str) -> View:
    """The robot that is to run an action.

    Without a name it is the only live robot; for what steers the simulation, the only live
    Supervisor.

    Raises:
        InvalidInputError: There is no such robot or action, or several robots are possible.
        CommandRefusedError: It cannot run it: it has no live controller, it is not a Supervisor, or
            another robot's bridge has paused the simulation.
        NothingRecordedError: No robot was ever recorded.
    """
    if robot is None and _needs_supervisor(action):
        robot = _only_supervisor(connection)
    view = look(connection, robot)
    _require_action(view, action)
    session = _require_live(view)
    if _needs_supervisor(action) and not session.supervisor:
        raise CommandRefusedError(_who_may(view, session, action))
    _require_free(view, session, action)
    return view


def _needs_supervisor(action: str) -> bool:
    built_in = BUILT_IN_ACTIONS.get(action)
    return built_in is not None and built_in.needs_supervisor


def _only_supervisor(connection: sqlite3.Connection) -> str | None:
    robots = [robot for robot in list_robots(connection, time.time()) if robot.live]
    supervisors = [robot for robot in robots if robot.session and robot.session.supervisor]
    names = [robot.name for robot in without_observers(supervisors)]
    return names[0] if len(names) == 1 else None


def _require_action(view: View, action: str) -> None:
    """Refuse an action that the controller does not know.

    Without registered actions nothing is refused: the loop may handle what get_command() returns.
    """
    known = list(view.session.actions) if view.session else []
    if not known or action in known or action in BUILT_IN_ACTIONS:
        return
    possible = [*known, *BUILT_IN_ACTIONS]
    near = same_in_meaning(action, possible)
    near = near or difflib.get_close_matches(action, possible, n=3, cutoff=0.5)
    offer = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    raise UnknownActionError(
        f"robot {view.robot.name!r} has registered no action {action!r}; {offer}its own actions "
        f"are {known[:_SHOWN_ACTIONS]}, the built-in ones {list(BUILT_IN_ACTIONS)}"
    )


def _require_live(view: View) -> Session:
    """The robot's session; during a reload the old one, since its successor runs the command."""
    session = view.session
    if session is not None and (view.robot.live or _is_reloading(session, view.now_s)):
        return session
    raise CommandRefusedError(
        f"robot {view.robot.name!r} has no live controller: "
        f"{view.status.why or 'it was never seen'}; start it, then ask again"
    )


def _is_reloading(session: Session, now_s: float) -> bool:
    ended_s = session.ended_wall_time_s or session.last_seen_wall_time_s
    if session.extern:
        return False
    return session.end_reason == "reload" and now_s - ended_s < ISSUED_TIME_TO_LIVE_S


def _who_may(view: View, session: Session, action: str) -> str:
    others = [s for s in companions(view.connection, session, view.now_s) if s.supervisor]
    next_step = _MAKE_ONE
    if ended := _ended_supervisors(view, session):
        next_step = (
            f"robot {ended[0]!r} is a Supervisor of this simulation, but its controller has ended: "
            "start it again, or reload the world in Webots"
        )
    if others:
        name = robot_name(view.connection, others[0].robot_id)
        next_step = f"robot {name!r} is a Supervisor of this simulation: ask it (robot={name!r})"
        if action == "run":
            next_step += f"; for conditions and parameters of {view.robot.name!r}, {_MAKE_ONE}"
    return f"{action} needs a Supervisor and robot {view.robot.name!r} is not one: {next_step}"


def _ended_supervisors(view: View, session: Session) -> list[str]:
    """Former Supervisors of the same simulation whose controller has ended."""
    robots = [each for each in list_robots(view.connection, view.now_s) if not each.live]
    seen = [(each.name, each.session) for each in robots if each.session is not None]
    return [name for name, it in seen if it.supervisor and it.instance == session.instance]


def _require_free(view: View, session: Session, action: str) -> None:
    """Refuse while another robot's bridge has paused the simulation: this loop cannot run then."""
    holder = find_holder(view.connection, session, view.now_s)
    if holder is None or holder.id == session.id:
        return
    name = robot_name(view.connection, holder.robot_id)
    raise CommandRefusedError(
        f"robot {view.robot.name!r} cannot run {action!r} now: the bridge of robot {name!r} has "
        f"paused their simulation; resume or step it there first (robot={name!r})"
    )
