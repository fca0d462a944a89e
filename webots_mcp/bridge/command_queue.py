"""The controller's side of the command queue: claiming commands and writing their answers.

The SQL statements and their guarantees are in `webots_mcp.queue`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Generator, Mapping
from typing import Any, Final, cast

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.bridge.text import storable
from webots_mcp.queue import CLAIM, CLAIMED_SINCE, PEEK, SUCCESSOR_PID

Progress = Generator[None, None, object]
"""A running built-in action: it yields until its outcome is known, and returns the result."""

_MOST_NAMED: Final = 10

_INTERRUPTED: Final = "the controller was interrupted before the command began; it was not run"


class ClaimedCommand:
    """A claimed command."""

    __slots__ = ("action", "id", "params", "requested_by", "session_id")

    def __init__(
        self,
        id: int,  # noqa: A002
        action: str,
        params: dict[str, Any],
        session_id: int,
        requested_by: str | None = None,
    ) -> None:
        self.id = id
        self.action = action
        self.params = params
        self.session_id = session_id
        self.requested_by = requested_by

    def as_dict(self) -> dict[str, Any]:
        """What handlers receive; the parameters are keys too, except `id`, `action`, `params`."""
        return {**self.params, "id": self.id, "action": self.action, "params": self.params}


class ClaimedCommands:
    """Claims commands for this session and writes their outcome."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._last_begun = 0
        self._claiming = False

    def claim(self, sim_time_s: float) -> ClaimedCommand | None:
        """Claim the oldest pending command of this robot; None, without a lock, where none is.

        Call `begin` with it. Where an interrupt prevents that, the next call writes it as failed.
        """
        recorder, now = self._recorder, time.time()
        registration = recorder.session.registration
        if registration is not None and self._claiming:
            self._fail_interrupted(registration.session_id, sim_time_s)
        if registration is None or not recorder.fetch(PEEK, (registration.robot_id, now)):
            return None
        ids = {"session": registration.session_id, "robot": registration.robot_id}
        times = {"now": now, "sim_time": sim_time_s}
        self._claiming = True
        rows = recorder.fetch(CLAIM, {**ids, **times})
        if rows is None:  # the next call asks whether it was claimed
            return None
        command = self._read(rows[0], registration.session_id, sim_time_s) if rows else None
        if command is None:
            self._claiming = False
            self._look_for_successor(registration)
        return command

    def begin(self, command: ClaimedCommand) -> None:
        """The caller runs it from here on, and writes its outcome whatever happens."""
        self._last_begun = command.id
        self._claiming = False

    def _fail_interrupted(self, session_id: int, sim_time_s: float) -> None:
        found = self._recorder.fetch(CLAIMED_SINCE, (session_id, self._last_begun))
        if found is None:
            return
        ((command_id,),) = found
        if command_id is not None:
            self.fail(ClaimedCommand(command_id, "", {}, session_id), _INTERRUPTED, sim_time_s)
        self._claiming = False

    def _look_for_successor(self, registration: Registration) -> None:
        ids = {"robot": registration.robot_id, "session": registration.session_id}
        for (pid,) in self._recorder.fetch(SUCCESSOR_PID, ids) or ():
            self._recorder.errors.warn(
                "successor",
                f"commands for robot {registration.robot_name!r} go to process {pid}, which "
                "started later under the same name: end one of the two processes",
            )

    def _read(
        self,
        row: tuple[int, bytes, bytes | None, bytes | None],
        session_id: int,
        sim_time_s: float,
    ) -> ClaimedCommand | None:
        command_id, action, text, asker = row
        by = None if asker is None else asker.decode("utf-8", "replace")
        command = ClaimedCommand(command_id, action.decode("utf-8", "replace"), {}, session_id, by)
        try:
            params = json.loads(text or b"")
        except (ValueError, RecursionError):  # not JSON, not UTF-8, or nested too deeply
            params = None
        if isinstance(params, dict):
            command.params = cast("dict[str, Any]", params)
            return command
        got = (text or b"")[:100].decode("utf-8", "replace")
        self.fail(command, f"params must be a JSON object, got {got!r}", sim_time_s)
        return None

    def issue(self, command: ClaimedCommand) -> None:
        """Record that Webots is about to be asked for a reset or reload, which may end the process.

        This waits until it is in the database: the successor confirms only what it finds there.
        """
        values = {"now": time.time(), "command": command.id}
        self._recorder.record("command issued", None, values)
        deadline_s = time.monotonic() + 1  # a wait is acceptable: the world stops for a reload
        while not self._recorder.flush() and time.monotonic() < deadline_s:
            time.sleep(0.002)

    def succeed(self, command: ClaimedCommand, result: object, sim_time_s: float) -> str | None:
        """Write `done` with the result; returns (and writes) what had to be replaced in it."""
        encoded = encode(result)
        replaced = _name_replaced(encoded.replaced)
        self._finish(command, "done", encoded.text, replaced, sim_time_s)
        return replaced

    def fail(self, command: ClaimedCommand, error: str, sim_time_s: float) -> None:
        """Write `failed` with the reason."""
        self._finish(command, "failed", None, storable(error), sim_time_s)

    def _finish(
        self,
        command: ClaimedCommand,
        status: str,
        result: str | None,
        error: str | None,
        at_s: float,
    ) -> None:
        times = {"now": time.time(), "sim_time": at_s}
        outcome = {"command": command.id, "status": status, "result": result, "error": error}
        # No row changed: another process has declared this session dead meanwhile.
        if self._recorder.record("command finished", None, {**outcome, **times}) == 0:
            self._recorder.errors.warn(
                f"command {command.id}",
                f"command {command.id} ({command.action}) was declared lost before it was {status}",
            )


def _name_replaced(replaced: Mapping[str, str]) -> str | None:
    """The parts of a result that JSON cannot hold, by path and kind."""
    if not replaced:
        return None
    first = list(replaced.items())[:_MOST_NAMED]
    named = [f"{path or 'all of it'} ({kind})" for path, kind in first]
    more = f" and {len(replaced) - len(first)} more" if len(replaced) > len(first) else ""
    return f"values of the result that JSON cannot hold were replaced: {', '.join(named)}{more}"
