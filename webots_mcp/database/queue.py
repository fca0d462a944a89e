"""The command queue as a client uses it: adds commands, cancels them, and reads their outcome.

A client adds a command as `pending`. The robot's controller makes it `claimed`, in one statement
and before anything runs, and then `done` or `failed`. A command that is not claimed in time becomes
`expired`, one that its client cancels before that `cancelled`, and one whose controller ended
without an answer `lost`. So a command runs at most once, and its outcome is final: each statement
names the status that it expects (`queue_statements`), whatever other processes do.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple, TypeVar

from webots_mcp.contract import COMMAND_TIME_TO_LIVE_S, FINAL_STATUSES, new_uuid
from webots_mcp.database.connection import is_busy
from webots_mcp.errors import InvalidInputError

MAX_PARAMS_BYTES: Final = 65_536
# A writer connection waits 5 s for the lock by itself; then the statement is sent again.
_ATTEMPTS: Final = 3
# Two questions, so that each is answered by its partial index.
_UNFINISHED: Final = (
    "SELECT EXISTS (SELECT 1 FROM command WHERE status = 'pending') "
    "OR EXISTS (SELECT 1 FROM command WHERE status = 'claimed')"
)
_ENQUEUE: Final = (
    "INSERT INTO command (robot_id, action, params, status, requested_by, idempotency_key, "
    "created_wall_time_s, expires_wall_time_s, request_id) VALUES "
    "(:robot_id, :action, :params, 'pending', :requested_by, :key, :now, :expires, :request) "
    "ON CONFLICT (idempotency_key) DO NOTHING"
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
_BY_ID: Final = f"SELECT {_COLUMNS} FROM command WHERE id = ?"
_NEWEST: Final = (
    f"SELECT {_COLUMNS} FROM command WHERE robot_id = :robot_id "
    "AND (:before_id IS NULL OR id < :before_id) AND (:status IS NULL OR status = :status) "
    "ORDER BY id DESC LIMIT :limit"
)


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
        _while_busy(lambda: self._connection.execute(_ENQUEUE, values))
        command = QueuedCommand(*self._connection.execute(_BY_KEY, (key,)).fetchone())
        if any(getattr(command, name) != values[name] for name in ("robot_id", "action", "params")):
            raise InvalidInputError(
                f"idempotency key {key!r} already belongs to command {command.id} "
                f"({command.action!r}); use another key"
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
        return _while_busy(lambda: self._connection.execute(statement, values)).rowcount == 1

    def cancel(self, command_id: int, why: str) -> bool:
        """Cancel a command that is not claimed yet; True if it will now never run."""
        values = {"id": command_id, "now": self._clock(), "why": why}
        statement = (
            "UPDATE command SET status = 'cancelled', finished_wall_time_s = :now, error = :why "
            "WHERE id = :id AND status = 'pending'"
        )
        return _while_busy(lambda: self._connection.execute(statement, values)).rowcount == 1


def find_command(connection: sqlite3.Connection, idempotency_key: str) -> QueuedCommand | None:
    """Return the command that was sent with that key; None where none was."""
    row = connection.execute(_BY_KEY, (idempotency_key,)).fetchone()
    return QueuedCommand(*row) if row else None


def fetch_command(connection: sqlite3.Connection, command_id: int) -> QueuedCommand:
    """Return the command of that id.

    Raises:
        InvalidInputError: If there is none.
    """
    row = connection.execute(_BY_ID, (command_id,)).fetchone()
    if row is None:
        raise InvalidInputError(f"no command {command_id}; webots_list_commands lists them")
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
    return [QueuedCommand(*row) for row in connection.execute(_NEWEST, values).fetchall()]


def any_unfinished(connection: sqlite3.Connection) -> bool:
    """Return whether `dead_sessions.reap` could have anything to say about commands."""
    return bool(connection.execute(_UNFINISHED).fetchone()[0])


def _encode_params(params: Mapping[str, Any]) -> str:
    try:
        text = json.dumps(dict(params), allow_nan=False, ensure_ascii=False, sort_keys=True)
    except ValueError as error:
        raise InvalidInputError(
            f"params hold NaN or an infinity ({params!r:.200}), which are no numbers of JSON: give "
            "finite numbers, or null"
        ) from error
    except TypeError as error:
        raise InvalidInputError(f"params are not plain JSON: {error}") from error
    if (size := len(text.encode())) > MAX_PARAMS_BYTES:
        raise InvalidInputError(
            f"params are {size} bytes of JSON, at most {MAX_PARAMS_BYTES} are taken; "
            "write a file and pass its path"
        )
    return text


_T = TypeVar("_T")


def _while_busy(execute: Callable[[], _T], attempts: int = _ATTEMPTS) -> _T:
    """Repeat a statement that is safe to repeat while another process holds the write lock."""
    try:
        return execute()
    except sqlite3.OperationalError as error:
        if not is_busy(error) or attempts == 1:
            raise
    return _while_busy(execute, attempts - 1)
