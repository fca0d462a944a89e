"""Finds the tape of a controller where one is wanted; imports its recorder only then."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.tapes import tape_notes, tape_wanted
from webots_mcp.errors import warn

if TYPE_CHECKING:
    from webots_mcp.bridge.tape_recorder import TapeRecorder

_RECORDER: Final = "webots_mcp.bridge.tape_recorder"


def begin_if_wanted() -> None:
    """Record the calls of this process if the environment or the project's file asks for it."""
    how = tape_wanted.wanted(os.environ.get(tape_wanted.TAPE_VARIABLE), Path.cwd())
    if how is not None:
        from webots_mcp.bridge import tape_recorder  # only where a tape is wanted

        tape_recorder.begin(images=how == tape_wanted.IMAGES)


def find_tape(asked: bool | Literal["images"] | None, database: Database) -> TapeRecorder | None:
    """Return the recorder of this process' tape; None where no tape is wanted.

    Args:
        asked: As the controller says; None where the environment or the project decides.
        database: Next to which the tape will be.
    """
    if tape_notes.replayed is not None or asked is False:
        return None
    how = "images" if asked == "images" else "on" if asked else None
    if how is None and not _has_begun():
        how = tape_wanted.wanted(os.environ.get(tape_wanted.TAPE_VARIABLE), Path.cwd())
        if how is None:
            return None
    if isinstance(database, MemoryDatabase):
        warn("no tape is recorded: it lies next to a database file, and this one is in memory")
        return None
    from webots_mcp.bridge import tape_recorder  # only where a tape is wanted

    return tape_recorder.begin(images=how == tape_wanted.IMAGES)


def _has_begun() -> bool:
    return _RECORDER in sys.modules and sys.modules[_RECORDER].recorder() is not None
