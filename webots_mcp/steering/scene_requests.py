"""Reading and changing the scene of a simulation, by any of its live Supervisors."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from anyio import to_thread

from webots_mcp.contract import OBSERVER
from webots_mcp.errors import AmbiguousRobotError, CommandRefusedError, InvalidInputError
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.steering.dispatch import Dispatcher, Report
from webots_mcp.store.recording import Recording, look
from webots_mcp.store.robots import Session, find_holder, list_robots

_WAIT_S: Final = 15.0  # of wall time
_NO_SUPERVISOR: Final = (
    "no live controller can read the scene of {}: set the field 'supervisor' of a Robot node to "
    "TRUE and create that robot with Supervisor(), or open the world with an observer in it, made "
    "by webots-mcp init --observer WORLD"
)


class _Supervisor(NamedTuple):
    name: str
    kind: str
    session: Session


async def ask_scene(
    recording: Recording,
    report: Report,
    action: str,
    params: Mapping[str, Any],
    *,
    robot: str | None = None,
) -> CommandAnswer:
    """Let a Supervisor of the simulation read its scene, or change it.

    Args:
        recording: Where its bridge records.
        report: Called with the time that it has waited.
        action: A built-in action, such as `get_field`.
        params: The parameters of the action; those that are None are left out.
        robot: A robot of the simulation; None where there is only one simulation.

    Raises:
        InvalidInputError: There is no such robot, several simulations are possible, or this server
            is read-only.
        CommandRefusedError: No live controller can read the scene.
        NothingRecordedError: No robot was ever recorded.
    """
    if recording.read_only:
        raise InvalidInputError(
            "reading the scene needs a command to a controller, and a --read-only server sends "
            "none; webots_get_world_info has what was recorded"
        )
    name = await to_thread.run_sync(_find_supervisor, recording, robot)
    given = {key: value for key, value in params.items() if value is not None}
    return await Dispatcher(recording, report).ask(name, action, _WAIT_S, given)


def _find_supervisor(recording: Recording, robot: str | None) -> str:
    with recording.reader() as connection:
        session = look(connection, robot).session if robot is not None else None
        found = _supervisors(connection, session)
        if not found:
            look(connection, robot)  # raises where nothing is recorded, and says how to record
            where = "this simulation" if robot is None else f"the simulation of robot {robot!r}"
            raise CommandRefusedError(_NO_SUPERVISOR.format(where))
        if len({each.session.instance for each in found}) > 1:
            listed = ", ".join(repr(each.name) for each in found)
            raise AmbiguousRobotError(
                f"Supervisors of several simulations are live: {listed}; choose a simulation with "
                "robot=..."
            )
        return _best(connection, found, robot).name


def _supervisors(connection: sqlite3.Connection, session: Session | None) -> list[_Supervisor]:
    """The live Supervisors of the session's simulation, or without a session of any."""
    robots = list_robots(connection, time.time())
    return [
        _Supervisor(each.name, each.kind, each.session)
        for each in robots
        if each.live and each.session is not None and each.session.supervisor
        if session is None or each.session.instance == session.instance
    ]


def _best(
    connection: sqlite3.Connection, found: list[_Supervisor], robot: str | None
) -> _Supervisor:
    """The Supervisor to ask: the one that has paused the simulation, as no other loop runs then.

    Else one with a fresh heartbeat, the named one, an observer (which has no other work), or the
    first, in this order.
    """
    now_s = time.time()
    holder = find_holder(connection, found[0].session, now_s)

    def rank(each: _Supervisor) -> tuple[bool, ...]:
        return (
            holder is None or each.session.id != holder.id,
            not each.session.heartbeat_is_fresh(now_s),
            each.name != robot,
            each.kind != OBSERVER,
        )

    return min(found, key=rank)
