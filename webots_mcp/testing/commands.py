"""A command as a test sees it: what was asked, and what has become of it by now."""

from __future__ import annotations

import json
from contextlib import closing
from typing import Any

from webots_mcp.connection import connect
from webots_mcp.contract import Database
from webots_mcp.store.queue import Command, fetch_command


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
    def status(self) -> str:
        """`pending`, `claimed`, then `done`, `failed`, `expired`, `cancelled` or `lost`."""
        return self._fetch().status

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
