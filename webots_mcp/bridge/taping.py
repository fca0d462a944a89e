"""Begins the tape of a controller where one is wanted; imports its recorder only then."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from webots_mcp.contract import PROJECT_FILE
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.errors import warn
from webots_mcp.rerun import tape_notes

if TYPE_CHECKING:
    from webots_mcp.rerun.tape_recorder import TapeRecorder

_RECORDER: Final = "webots_mcp.rerun.tape_recorder"
_VARIABLE: Final = "WEBOTS_MCP_TAPE"


def find_tape(wanted: bool | Literal["images"] | None, database: Database) -> TapeRecorder | None:
    """Return the recorder of this process' tape; None where no tape is wanted.

    Args:
        wanted: As the controller says; None where the environment or the project decides.
        database: Next to which the tape will be.
    """
    if tape_notes.replayed is not None:
        return None
    begun = _RECORDER in sys.modules and sys.modules[_RECORDER].recorder() is not None
    if wanted is False or not (begun or wanted or _may_be_wanted()):
        return None
    from webots_mcp.rerun import tape_recorder  # only where it may be needed

    if not begun and not wanted:
        tape_recorder.begin_if_wanted()
        if tape_recorder.recorder() is None:
            return None
    if isinstance(database, MemoryDatabase):
        warn("no tape is recorded: it lies next to a database file, and this one is in memory")
        return None
    return tape_recorder.begin(images=wanted == tape_recorder.IMAGES)


def _may_be_wanted() -> bool:
    """Return whether the environment asks for it, or a project may: a file is looked for once."""
    folder = Path.cwd()
    return _VARIABLE in os.environ or any(
        (each / PROJECT_FILE).is_file() for each in (folder, *folder.parents)
    )
