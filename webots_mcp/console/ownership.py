"""Which of the Webots that run here belong to a recording, and whether their consoles are followed.

No other is followed or steered unasked. A Webots belongs to a recording where a living session of
the recording runs in it; or where it was started with a world of the recording's project, or with
one that was recorded here before, unless its controllers record elsewhere.
"""

from __future__ import annotations

import sqlite3
import time
from typing import Final

from webots_mcp.console.following import job_of
from webots_mcp.contract import find_project, full_path
from webots_mcp.errors import CommandRefusedError, NoDatabaseError
from webots_mcp.store.leases import holder_of
from webots_mcp.store.recording import Recording
from webots_mcp.store.robots import list_robots
from webots_mcp.webots.instances import Instance, instances
from webots_mcp.webots.stream import ANSWER_S, connected

_WORLD: Final = "SELECT EXISTS (SELECT 1 FROM run WHERE world = ?)"
_NOBODY: Final = "no Webots of this recording runs on this machine, so no console is followed"
_UNSURE: Final = "; it was started without --stream: if nothing comes of it, start it with that"


def own_webots(recording: Recording) -> list[Instance]:
    """Those that run on this machine.

    Raises:
        DatabaseError: The recording cannot be read.
    """
    running = instances()
    return [each for each in running if belongs(each, recording)] if running else []


def belongs(instance: Instance, recording: Recording) -> bool:
    """Whether a Webots is of a recording.

    Raises:
        DatabaseError: The recording cannot be read.
    """
    into = instance.data_dir  # that of a trial has one of its own
    is_elsewhere = into is not None and full_path(into) != full_path(recording.data_dir)
    if not is_elsewhere and _is_in_project(instance, recording):
        return True
    try:
        with recording.reader() as connection:
            is_known = not is_elsewhere and _has_known_world(instance, connection)
            return is_known or _has_live_session(instance, connection)
    except NoDatabaseError:
        return False


def _is_in_project(instance: Instance, recording: Recording) -> bool:
    project = find_project(full_path(recording.data_dir))
    if project is None or instance.world is None:
        return False
    return instance.world.resolve().is_relative_to(project)


def _has_known_world(instance: Instance, connection: sqlite3.Connection) -> bool:
    if instance.world is None:
        return False
    return bool(connection.execute(_WORLD, (str(instance.world.resolve()),)).fetchone()[0])


def _has_live_session(instance: Instance, connection: sqlite3.Connection) -> bool:
    live = (robot.session for robot in list_robots(connection, time.time()) if robot.live)
    return any(session is not None and session.instance == instance.name for session in live)


def console_state(recording: Recording, connection: sqlite3.Connection) -> str:
    """In a sentence, of all Webots of a recording.

    Args:
        recording: Which is asked about.
        connection: To it.
    """
    running = own_webots(recording)
    return "; ".join(_state(each, recording, connection) for each in running) or _NOBODY


def _state(instance: Instance, recording: Recording, connection: sqlite3.Connection) -> str:
    console = f"the console of Webots at port {instance.port}"
    if holder_of(connection, job_of(instance)) is not None:
        unsure = "" if instance.streams else _UNSURE
        return f"{console} is followed{unsure}"
    try:
        with connected(instance.address, ANSWER_S):
            pass
    except CommandRefusedError as error:
        return f"{console} is not followed: {error}"
    if recording.read_only:
        return f"{console} is not followed: a server with --read-only does not, one without does"
    return f"{console} is not followed yet: a server looks for it every few seconds"
