"""Determine which Webots of this machine belong to a recording; no other is steered unasked.

A Webots belongs to a recording if a living session of the recording runs in it. It also belongs to
one if it was started with a world of the recording's project, or with a world that was recorded
here before, unless its controllers record elsewhere.
"""

from __future__ import annotations

import sqlite3
import time

from webots_mcp.database.files import full_path
from webots_mcp.database.location import find_project
from webots_mcp.errors import (
    NoDatabaseError,
)
from webots_mcp.simulator.instances import Instance, instances
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.robots import list_robots


def own_webots(recording: RecordingAccess) -> list[Instance]:
    """Return the Webots of a recording that run on this machine.

    Raises:
        DatabaseError: If the recording cannot be read.
    """
    running = instances()
    return [each for each in running if belongs(each, recording)] if running else []


def belongs(instance: Instance, recording: RecordingAccess) -> bool:
    """Return whether a Webots belongs to a recording.

    Raises:
        DatabaseError: If the recording cannot be read.
    """
    into = instance.data_dir  # the Webots of a trial has a data folder of its own
    is_elsewhere = into is not None and full_path(into) != full_path(recording.data_dir)
    if not is_elsewhere and _is_in_project(instance, recording):
        return True
    try:
        with recording.reader() as connection:
            is_known = not is_elsewhere and _has_known_world(instance, connection)
            return is_known or _has_live_session(instance, connection)
    except NoDatabaseError:
        return False


def _is_in_project(instance: Instance, recording: RecordingAccess) -> bool:
    project = find_project(full_path(recording.data_dir))
    if project is None or instance.world is None:
        return False
    return instance.world.resolve().is_relative_to(project)


def _has_known_world(instance: Instance, connection: sqlite3.Connection) -> bool:
    if instance.world is None:
        return False
    return bool(
        connection.execute(
            "SELECT EXISTS (SELECT 1 FROM run WHERE world = ?)", (str(instance.world.resolve()),)
        ).fetchone()[0]
    )


def _has_live_session(instance: Instance, connection: sqlite3.Connection) -> bool:
    live = (robot.session for robot in list_robots(connection, time.time()) if robot.live)
    return any(session is not None and session.instance == instance.name for session in live)
