"""The command queue: adds commands, lets a controller claim them, settles them, and reads them.

A client adds a command as `pending`. The robot's controller makes it `claimed`, in one statement
and before anything runs, and then `done` or `failed`. A command that is not claimed in time becomes
`expired`, one that its client cancels before that `cancelled`, and one whose controller ended
without an answer `lost`. So a command runs at most once, and its outcome is final: each statement
names the status that it expects, whatever other processes do.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from webots_mcp.contract import COMMAND_TIME_TO_LIVE_S, FINAL_STATUSES, new_uuid
from webots_mcp.database.transactions import repeat_while_busy
from webots_mcp.errors import InvalidInputError

MAX_PARAMS_BYTES: Final = 65_536

# -- the statements by which a controller claims and answers commands, and others settle them ------

# An indexed read takes no lock. An UPDATE takes the write lock even where it matches nothing, so
# it is made only after this has found a command. The texts are read as bytes: one that is not
# UTF-8 would fail the statement after it claimed the command.
PEEK: Final = (
    "SELECT 1 FROM command WHERE robot_id = ? AND status = 'pending' "
    "AND expires_wall_time_s > ? LIMIT 1"
)
# A session that was judged dead although it lives may have a successor: commands are for that one.
_SUCCESSOR: Final = (
    "FROM session s WHERE s.robot_id = :robot AND s.id > :session AND s.ended_wall_time_s IS NULL"
)
CLAIM: Final = (
    "UPDATE command SET status = 'claimed', session_id = :session, claimed_wall_time_s = :now, "
    "claimed_sim_time_s = :sim_time WHERE status = 'pending' AND id = (SELECT id FROM command "
    "WHERE robot_id = :robot AND status = 'pending' AND expires_wall_time_s > :now "
    f"ORDER BY id LIMIT 1) AND NOT EXISTS (SELECT 1 {_SUCCESSOR}) "
    "RETURNING id, CAST(action AS BLOB), CAST(params AS BLOB), CAST(requested_by AS BLOB)"
)
SUCCESSOR_PID: Final = f"SELECT s.pid {_SUCCESSOR} LIMIT 1"
# Commands are claimed in the order of their ids. One row always.
CLAIMED_SINCE: Final = (
    "SELECT (SELECT max(id) FROM command WHERE session_id = ? AND status = 'claimed' AND id > ?)"
)
_OF_CLAIMER: Final = "WHERE id = :command AND status = 'claimed' AND session_id = :session"
ISSUE: Final = f"UPDATE command SET issued_wall_time_s = :now {_OF_CLAIMER}"
FINISH: Final = (
    "UPDATE command SET status = :status, finished_wall_time_s = :now, "
    f"finished_sim_time_s = :sim_time, result = :result, error = :error {_OF_CLAIMER}"
)
# The process that requested the reload has ended; that this one runs proves that it worked.
CONFIRM_RELOAD: Final = (
    "UPDATE command SET status = 'done', finished_wall_time_s = :now, "
    "finished_sim_time_s = :sim_time, result = json_object('run_id', :run, 'mode', :mode, "
    "'why', 'a reload keeps the mode') "
    "WHERE robot_id = (SELECT robot_id FROM run WHERE id = :run) AND action = 'reload' "
    "AND status = 'claimed' AND issued_wall_time_s IS NOT NULL"
)
EXPIRE: Final = (
    "UPDATE command SET status = 'expired', finished_wall_time_s = :now, "
    "error = 'no controller claimed it in time; it will never run' "
    "WHERE status = 'pending' AND expires_wall_time_s <= :now"
)
CLAIMED_BY_ENDED: Final = (
    "SELECT c.id, c.issued_wall_time_s, s.extern, s.uuid FROM command c "
    "LEFT JOIN session s ON s.id = c.session_id "
    "WHERE c.status = 'claimed' AND (s.id IS NULL OR s.ended_wall_time_s IS NOT NULL)"
)
LOSE: Final = (
    "UPDATE command SET status = 'lost', finished_wall_time_s = :now, error = :why "
    "WHERE id = :id AND status = 'claimed'"
)


class QueuedCommand(NamedTuple):
    """A command and its outcome; `params` and `result` are JSON. Columns as in `store.models`."""

    id: int
    robot_id: int
    action: str
    params: str
    status: str
    requested_by: str | None
    created_wall_time_s: float
    expires_wall_time_s: float
    claimed_wall_time_s: float | None
    claimed_sim_time_s: float | None
    session_id: int | None
    issued_wall_time_s: float | None
    finished_wall_time_s: float | None
    finished_sim_time_s: float | None
    result: str | None
    error: str | None

    @property
    def is_final(self) -> bool:
        """Whether its fate is settled: a final status never changes again."""
        return self.status in FINAL_STATUSES

    def decoded_result(self) -> Any:
        """Return the controller's answer; None if there is none, or it is not JSON."""
        try:
            return json.loads(self.result) if self.result is not None else None
        except ValueError:
            return None


_COLUMNS: Final = ", ".join(QueuedCommand._fields)
_BY_KEY: Final = f"SELECT {_COLUMNS} FROM command WHERE idempotency_key = ?"


class CommandQueue:
    """Puts commands for one robot's controller into the database.

    Args:
        connection: A writer connection; the queue never closes it.
        clock: Unix time in seconds.
    """

    def __init__(
        self, connection: sqlite3.Connection, clock: Callable[[], float] = time.time
    ) -> None:
        self._connection = connection
        self._clock = clock

    def enqueue(
        self,
        robot_id: int,
        action: str,
        params: Mapping[str, Any] | None = None,
        *,
        time_to_live_s: float = COMMAND_TIME_TO_LIVE_S,
        requested_by: str | None = None,
        idempotency_key: str | None = None,
        request_id: int | None = None,
    ) -> QueuedCommand:
        """Queue a command; sending it again with the same key makes no second command.

        The insert is repeated while the database is busy. That is safe: every repetition carries
        the same unique key, so that an insert whose answer was lost is found instead of doubled.

        Args:
            robot_id: The robot whose controller is to run it.
            action: A built-in or registered action.
            params: Its parameters, plain JSON.
            time_to_live_s: Time after which an unclaimed command expires and never runs.
            requested_by: The caller, for the record.
            idempotency_key: A key of the caller's; None for a new one.
            request_id: The row of the request for which it is sent.

        Raises:
            InvalidInputError: If the parameters are not plain JSON or too long, or the key already
                belongs to another command.
            sqlite3.OperationalError: If the database stayed locked.
        """
        key = idempotency_key or new_uuid()
        now_s = self._clock()
        values = {
            "robot_id": robot_id,
            "action": action,
            "params": _encode_params(params or {}),
            "requested_by": requested_by,
            "key": key,
            "now": now_s,
            "expires": now_s + time_to_live_s,
            "request": request_id,
        }
        repeat_while_busy(
            lambda: self._connection.execute(
                "INSERT INTO command (robot_id, action, params, status, requested_by, "
                "idempotency_key, created_wall_time_s, expires_wall_time_s, request_id) VALUES "
                "(:robot_id, :action, :params, 'pending', :requested_by, :key, :now, :expires, "
                ":request) ON CONFLICT (idempotency_key) DO NOTHING",
                values,
            )
        )
        command = QueuedCommand(*self._connection.execute(_BY_KEY, (key,)).fetchone())
        if any(getattr(command, name) != values[name] for name in ("robot_id", "action", "params")):
            raise InvalidInputError(
                f"The idempotency key {key!r} already belongs to command {command.id} "
                f"({command.action!r}). Use another key."
            )
        return command

    def leave(self, command_id: int, why: str) -> bool:
        """Cancel a command whose caller has stopped waiting, or note that if it is already running.

        Returns:
            Whether it is running.
        """
        if self.cancel(command_id, why):
            return False
        values = {"id": command_id, "note": f"{why}; the command continues"}
        statement = "UPDATE command SET error = :note WHERE id = :id AND status = 'claimed'"
        return repeat_while_busy(lambda: self._connection.execute(statement, values)).rowcount == 1

    def cancel(self, command_id: int, why: str) -> bool:
        """Cancel a command that is not claimed yet; True if it will now never run."""
        values = {"id": command_id, "now": self._clock(), "why": why}
        statement = (
            "UPDATE command SET status = 'cancelled', finished_wall_time_s = :now, error = :why "
            "WHERE id = :id AND status = 'pending'"
        )
        return repeat_while_busy(lambda: self._connection.execute(statement, values)).rowcount == 1


def find_command(connection: sqlite3.Connection, idempotency_key: str) -> QueuedCommand | None:
    """Return the command that was sent with that key; None where none was."""
    row = connection.execute(_BY_KEY, (idempotency_key,)).fetchone()
    return QueuedCommand(*row) if row else None


def fetch_command(connection: sqlite3.Connection, command_id: int) -> QueuedCommand:
    """Return the command of that id.

    Raises:
        InvalidInputError: If there is none.
    """
    row = connection.execute(
        f"SELECT {_COLUMNS} FROM command WHERE id = ?", (command_id,)
    ).fetchone()
    if row is None:
        raise InvalidInputError(
            f"There is no command {command_id}. webots_list_commands lists the commands."
        )
    return QueuedCommand(*row)


def list_commands(
    connection: sqlite3.Connection,
    robot_id: int,
    *,
    limit: int,
    status: str | None = None,
    before_id: int | None = None,
) -> list[QueuedCommand]:
    """Return the robot's newest commands, newest first; with a limit of -1 all of them.

    `before_id` pages towards older ones.
    """
    values = {"robot_id": robot_id, "status": status, "limit": limit, "before_id": before_id}
    return [
        QueuedCommand(*row)
        for row in connection.execute(
            f"SELECT {_COLUMNS} FROM command WHERE robot_id = :robot_id "
            "AND (:before_id IS NULL OR id < :before_id) AND (:status IS NULL OR status = :status) "
            "ORDER BY id DESC LIMIT :limit",
            values,
        ).fetchall()
    ]


def any_unfinished(connection: sqlite3.Connection) -> bool:
    """Return whether `session_cleanup.reap` could have anything to say about commands."""
    # Two questions, so that each is answered by its partial index.
    return bool(
        connection.execute(
            "SELECT EXISTS (SELECT 1 FROM command WHERE status = 'pending') "
            "OR EXISTS (SELECT 1 FROM command WHERE status = 'claimed')"
        ).fetchone()[0]
    )


def _encode_params(params: Mapping[str, Any]) -> str:
    try:
        text = json.dumps(dict(params), allow_nan=False, ensure_ascii=False, sort_keys=True)
    except ValueError as error:
        raise InvalidInputError(
            f"params contain NaN or infinity, which JSON cannot hold: {params!r:.200}. Send finite "
            "numbers or null."
        ) from error
    except TypeError as error:
        raise InvalidInputError(
            f"params are not plain JSON: {error}. Send numbers, texts, lists and objects."
        ) from error
    if (size := len(text.encode())) > MAX_PARAMS_BYTES:
        raise InvalidInputError(
            f"params are {size:,} bytes of JSON; the limit is {MAX_PARAMS_BYTES:,}. Write the data "
            "to a file and send its path."
        )
    return text
