"""Which of the Webots that run here are of a recording: no other is followed or steered unasked.

Of one that a living session names, and of one that has a world of the recording's project open, or
one that was recorded here before.
"""

from __future__ import annotations

import sqlite3
import time
from pathlib import Path
from typing import Final

from webots_mcp.contract import find_project, full_path
from webots_mcp.errors import NoDatabaseError
from webots_mcp.store.recording import Recording
from webots_mcp.store.robots import list_robots
from webots_mcp.webots.instances import Instance, instances

_WORLD: Final = "SELECT EXISTS (SELECT 1 FROM run WHERE world = ?)"


def webots_of(recording: Recording) -> list[Instance]:
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
    if instance.world is not None and _is_in_project(instance.world, recording):
        return True
    try:
        with recording.reader() as connection:
            return _is_recorded(instance, connection)
    except NoDatabaseError:
        return False


def _is_in_project(world: Path, recording: Recording) -> bool:
    project = find_project(full_path(recording.data_dir))
    return project is not None and world.resolve().is_relative_to(project)


def _is_recorded(instance: Instance, connection: sqlite3.Connection) -> bool:
    if instance.world is not None:
        (is_known,) = connection.execute(_WORLD, (str(instance.world.resolve()),)).fetchone()
        if is_known:
            return True
    live = (robot.session for robot in list_robots(connection, time.time()) if robot.live)
    return any(session is not None and session.instance == instance.name for session in live)
