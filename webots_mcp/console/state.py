"""Whether the console of Webots is followed, and why it is not."""

from __future__ import annotations

import sqlite3
from typing import Final

from webots_mcp.belonging import webots_of
from webots_mcp.console.following import job_of
from webots_mcp.errors import CommandRefusedError
from webots_mcp.store.leases import holder_of
from webots_mcp.store.recording import Recording
from webots_mcp.webots.instances import Instance
from webots_mcp.webots.stream import ANSWER_S, connected

_NOBODY: Final = "no Webots of this recording runs on this machine, so no console is followed"
_UNSURE: Final = "; it was started without --stream: if nothing comes of it, start it with that"


def console_state(recording: Recording, connection: sqlite3.Connection) -> str:
    """In a sentence, of all Webots of a recording.

    Args:
        recording: Which is asked about.
        connection: To it.
    """
    running = webots_of(recording)
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
