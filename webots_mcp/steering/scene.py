"""Asking about the scene of a simulation, which any of its live Supervisors can see and change."""

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
from webots_mcp.store.robots import list_robots
from webots_mcp.store.sessions import Session
from webots_mcp.store.status import find_holder

_WAIT_S: Final = 15.0  # of wall time
_NOBODY: Final = (
    "no live controller may look at the scene of {}: set the field 'supervisor' of a Robot node to "
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
    """Have a Supervisor of the simulation look at its scene, or change it.

    Args:
        recording: Where its bridge records.
        report: Is told how long it has waited.
        action: Built in, such as `get_field`.
        params: Of the action; None is left out.
        robot: In whose simulation; None where there is just one.

    Raises:
        InvalidInputError: There is no such robot, several simulations are possible, or this server
            sends nothing.
        CommandRefusedError: Nobody alive may see the scene.
        NothingRecordedError: No robot was ever seen.
    """
    if recording.read_only:
        raise InvalidInputError(
            "the scene is asked of a controller, and a server that is --read-only asks for "
            "nothing; webots_get_world_info has what was recorded"
        )
    name = await to_thread.run_sync(_find_supervisor, recording, robot)
    given = {key: value for key, value in params.items() if value is not None}
    return await Dispatcher(recording, report).ask(name, action, _WAIT_S, given)


def _find_supervisor(recording: Recording, robot: str | None) -> str:
    with recording.reader() as connection:
        session = look(connection, robot).session if robot is not None else None
        found = _supervisors(connection, session)
        if not found:
            look(connection, robot)  # which says how to record, where nothing was
            where = "this simulation" if robot is None else f"the simulation of robot {robot!r}"
            raise CommandRefusedError(_NOBODY.format(where))
        if len({each.session.instance for each in found}) > 1:
            listed = ", ".join(repr(each.name) for each in found)
            raise AmbiguousRobotError(
                f"Supervisors of several simulations are live: {listed}; say in whose simulation, "
                "with robot=..."
            )
        return _best(connection, found, robot).name


def _supervisors(connection: sqlite3.Connection, session: Session | None) -> list[_Supervisor]:
    """Those that live, of one simulation or (without a session) of any."""
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
    """Who holds the simulation, as no other loop turns then; else the one that is named; and so on.

    The others are an observer, which nothing else keeps busy, and the one that came first.
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
