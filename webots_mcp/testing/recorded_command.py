"""A command as a test sees it: its status, and the reason why it is not done."""

from __future__ import annotations

import json
from contextlib import closing
from typing import Any, Final

from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.queue import QueuedCommand, fetch_command

_UNFINISHED: Final = {
    "pending": "no get_command() of its controller has come to it yet",
    "claimed": "its handler has not returned yet",
}


class CommandStatus(str):
    """The status of a command. Assertions show it with the reason why it is not `done`."""

    reason: str

    def __new__(cls, status: str, reason: str) -> CommandStatus:
        """Make a text that also has a reason."""
        made = super().__new__(cls, status)
        made.reason = reason
        return made

    def __repr__(self) -> str:
        return f"{str(self)!r} ({self.reason})" if self.reason else f"{str(self)!r}"


class RecordedCommand:
    """A command in the queue. `status`, `result` and `error` are read anew each time."""

    def __init__(self, database: Database, command_id: int) -> None:
        self._database = database
        self.id = command_id

    def __repr__(self) -> str:
        command = self._fetch()
        fate = command.error if command.result is None else command.result
        return f"<command {self.id}: {command.action} {command.params}, {command.status}, {fate}>"

    @property
    def action(self) -> str:
        """Return the action."""
        return self._fetch().action

    @property
    def params(self) -> dict[str, Any]:
        """Return the parameters."""
        return json.loads(self._fetch().params)

    @property
    def status(self) -> CommandStatus:
        """Return `pending`, `claimed`, then `done`, `failed`, `expired`, `cancelled` or `lost`."""
        command = self._fetch()
        return CommandStatus(command.status, _why_not_done(command))

    @property
    def is_final(self) -> bool:
        """Return whether its status is final."""
        return self._fetch().is_final

    @property
    def result(self) -> Any:
        """Return the answer of the handler; None before that."""
        text = self._fetch().result
        return None if text is None else json.loads(text)

    @property
    def error(self) -> str | None:
        """Return why it failed, or what in its result had to be replaced; else None."""
        return self._fetch().error

    def _fetch(self) -> QueuedCommand:
        with closing(connect(self._database, "reader")) as connection:
            return fetch_command(connection, self.id)


def _why_not_done(command: QueuedCommand) -> str:
    """Return why a command is not done; an empty text if it is."""
    if command.status == "done":
        return ""
    return command.error or _UNFINISHED.get(command.status, "")
