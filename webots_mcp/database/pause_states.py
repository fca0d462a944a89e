"""Pauses of a simulation: who paused it, since when, how that ends, and how it is reported.

Webots has one simulation mode `pause`. What is known of a pause depends on who set it:

- A command (`pause`, the end of a `step`, that of a `run` whose `then` is "pause") or a breakpoint:
  the bridge stays in the loop and serves commands there. The event `pause` has the cause and the
  moment, the heartbeat has `PAUSED` in `session.pause_state` with the mode to go back to. A session
  that comes after a reload continues the pause of the one before. It ends with a command that lets
  the simulation continue, with a person who presses play, or with the bridge: the event `resume`
  says which.
- A person in Webots, another controller, or the controller's own code: its bridge is not asked and
  may not get to run. Only an observer sees it (the event `mode`); press play, or ask the observer.

While a `step` command lets the loop make its steps, `session.pause_state` has `STEPPING`. An
observer, for which the world does not wait otherwise, makes it wait for these steps by the field
`synchronization`: then it has `STEPPING_WORLD`, by which a later session sees that the field has to
be set back.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import math
import sqlite3
from typing import Final, NamedTuple

PAUSED: Final = "paused"  # values of session.pause_state
STEPPING: Final = "stepping"
STEPPING_WORLD: Final = "stepping the world"  # which waits for this robot meanwhile
PAUSE: Final = "pause"  # the kinds of the events
RESUME: Final = "resume"

IN_WEBOTS: Final = "a person or another controller, in Webots"
SESSION_BEFORE: Final = "the controller's session before this one"
BRIDGE_CLOSED: Final = "the bridge, which was closed"
SET_FREE: Final = (
    "the field 'synchronization' of this robot was set back to FALSE: its controller's session "
    "before this one ended in the middle of a step command, while the world waited for its steps"
)

# Texts with which a status says who paused the simulation.
SEEN_PAUSED: Final = "paused in Webots, as robot"
SEEN_RUNNING: Final = "not paused, as robot"
SEEN_PAUSED_BY: Final = f"{SEEN_PAUSED} {{!r}} sees; webots_simulation_control('resume') resumes it"
SEEN_RUNNING_BY: Final = (
    f"{SEEN_RUNNING} {{!r}} sees, but simulation time stands still: a controller hangs, or an "
    "extern one has not been started"
)
HELD_ELSEWHERE: Final = "robot {!r} has paused the simulation: resume it there"
LEFT_PAUSED: Final = (
    "robot {0!r} paused the simulation, and its controller has ended since: press play in Webots, "
    "or start that controller again and resume it there"
)


class Cause(NamedTuple):
    """Why a pause began or ended; fields that do not apply are None.

    Attributes:
        command_id: The command that did it.
        breakpoint_id: The breakpoint that was hit; None also if it is not stored.
        condition: The condition of that breakpoint.
        by: Who else did it, in words.
    """

    command_id: int | None = None
    breakpoint_id: int | None = None
    condition: str | None = None
    by: str | None = None

    @property
    def data(self) -> dict[str, object]:
        """Return the `data` of the event."""
        if self.condition is not None:
            return {"breakpoint_id": self.breakpoint_id, "condition": self.condition}
        return {"command_id": self.command_id} if self.by is None else {"by": self.by}

    def __str__(self) -> str:
        if self.condition is not None:
            number = "" if self.breakpoint_id is None else f" {self.breakpoint_id}"
            return f"breakpoint{number}: {self.condition}"
        return self.by or f"command {self.command_id}"


def change_since(
    connection: sqlite3.Connection, session_id: int, sim_time_s: float, wall_time_s: float
) -> str | None:
    """Return `PAUSE` or `RESUME`, whichever happened last since a heartbeat; None for neither.

    Args:
        connection: A connection to the recording.
        session_id: The session.
        sim_time_s: The simulation time of its heartbeat.
        wall_time_s: The wall time of its heartbeat.
    """
    values = {"session_id": session_id, "sim_time_s": sim_time_s, "wall_time_s": wall_time_s}
    # A pause is recorded as an event at once, but the heartbeat shows it only at its next beat.
    # Events after that beat have at least its simulation time, which limits the search to the
    # index.
    row = connection.execute(
        "SELECT e.kind FROM run r JOIN event e ON e.run_id = r.id "
        "AND e.sim_time_s >= :sim_time_s WHERE r.session_id = :session_id "
        f"AND e.wall_time_s > :wall_time_s AND e.kind IN ('{PAUSE}', '{RESUME}') "
        "ORDER BY e.id DESC LIMIT 1",
        values,
    ).fetchone()
    return row[0] if row else None


def breakpoint_at(connection: sqlite3.Connection, session_id: int) -> str | None:
    """Describe the breakpoint that began the newest pause of a session; None if a command did."""
    found = connection.execute(
        "SELECT CASE WHEN json_valid(data) THEN json_extract(data, '$.condition') END, "
        "sim_time_s FROM event WHERE run_id = (SELECT max(id) FROM run WHERE session_id = ?) AND "
        f"kind = '{PAUSE}' ORDER BY sim_time_s DESC, id DESC LIMIT 1",
        (session_id,),
    ).fetchone()
    if found is None or found[0] is None:
        return None
    return f"breakpoint at {found[1]:.3f} s: {found[0]}"


def paused_s(connection: sqlite3.Connection, run_id: int, end_wall_s: float) -> float:
    """Return for how many seconds of wall time its bridge kept a run paused, up to its end."""
    total_s, since_s = 0.0, math.inf
    for kind, wall_s in (
        *connection.execute(
            "SELECT kind, wall_time_s FROM event WHERE run_id = ? "
            f"AND kind IN ('{PAUSE}', '{RESUME}') ORDER BY id",
            (run_id,),
        ),
        (RESUME, end_wall_s),
    ):
        if kind == PAUSE:
            since_s = min(since_s, wall_s)
        else:
            total_s += max(0.0, wall_s - since_s)
            since_s = math.inf
    return total_s
