"""A command as a test sees it: what was asked, and what has become of it by now."""

from __future__ import annotations

import json
from contextlib import closing
from typing import Any, Final

from webots_mcp.connection import connect
from webots_mcp.contract import Database
from webots_mcp.queue import Command, fetch_command

_UNFINISHED: Final = {
    "pending": "no get_command() of its controller has come to it yet",
    "claimed": "its handler has not returned yet",
}


class Status(str):
    """A command's status; wherever an assertion shows it, it says why it is not `done`."""

    reason: str

    def __new__(cls, status: str, reason: str) -> Status:
        """A text as any other, with the reason beside it."""
        made = super().__new__(cls, status)
        made.reason = reason
        return made

    def __repr__(self) -> str:
        return f"{str(self)!r} ({self.reason})" if self.reason else f"{str(self)!r}"


class RecordedCommand:
    """A command in the queue; `status`, `result` and `error` are read anew each time."""

    def __init__(self, database: Database, command_id: int) -> None:
        self._database = database
        self.id = command_id

    def __repr__(self) -> str:
        command = self._fetch()
        fate = command.error if command.result is None else command.result
        return f"<command {self.id}: {command.action} {command.params}, {command.status}, {fate}>"

    @property
    def action(self) -> str:
        """What was asked."""
        return self._fetch().action

    @property
    def params(self) -> dict[str, Any]:
        """With which parameters."""
        return json.loads(self._fetch().params)

    @property
    def status(self) -> Status:
        """`pending`, `claimed`, then `done`, `failed`, `expired`, `cancelled` or `lost`."""
        command = self._fetch()
        return Status(command.status, _why_not_done(command))

    @property
    def is_final(self) -> bool:
        """Whether its fate is settled."""
        return self._fetch().is_final

    @property
    def result(self) -> Any:
        """What the handler answered; None before that."""
        text = self._fetch().result
        return None if text is None else json.loads(text)

    @property
    def error(self) -> str | None:
        """Why it failed, or what of its result had to be replaced; else None."""
        return self._fetch().error

    def _fetch(self) -> Command:
        with closing(connect(self._database, "reader")) as connection:
            return fetch_command(connection, self.id)


def _why_not_done(command: Command) -> str:
    """What a person has to know of a command that is not done; empty for one that is."""
    if command.status == "done":
        return ""
    return command.error or _UNFINISHED.get(command.status, "")
