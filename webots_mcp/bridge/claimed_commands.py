"""Claims and answers the commands of this robot; holds its custom actions and reload callbacks.

The SQL statements and their guarantees are in `webots_mcp.database.queue`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, Final, cast

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.error_report import cut, storable
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.database.queue import CLAIM, CLAIMED_SINCE, PEEK, SUCCESSOR_PID
from webots_mcp.database.tapes import tape_notes
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.signals.naming import harmless_first

Progress = Generator[None, None, object]
"""A running built-in action: it yields until its outcome is known, and returns the result."""

_INTERRUPTED: Final = "the controller was interrupted before the command began; it was not run"
_MOST_NAME_CHARACTERS: Final = 100


def whole_number(params: dict[str, Any], name: str, least: int, most: int, *, default: int) -> int:
    """Return a parameter of a command, or the default if it is missing or null.

    Raises:
        InvalidInputError: If it is not a whole number from `least` to `most`.
    """
    value = default if params.get(name) is None else params[name]
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InvalidInputError(
            f"{name} must be a whole number from {least} to {most}, not {value!r}"
        )
    return value


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
        """Return the dict that handlers receive; the parameters are keys of it too."""
        return {**self.params, "id": self.id, "action": self.action, "params": self.params}


Action = Callable[[ClaimedCommand], Progress]
"""A built-in action: it begins a command, or raises where the command is refused."""


class ClaimedCommands:
    """Claims commands for this session and writes their outcome."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._last_begun = 0
        self._claiming = False

    def claim(self, sim_time_s: float) -> ClaimedCommand | None:
        """Claim the oldest pending command of this robot; None, without a lock, if none is pending.

        The caller passes the command to `begin`. If an interrupt prevents that, the next call of
        `claim` writes the command as failed.
        """
        recorder, now = self._recorder, time.time()
        registration = recorder.registration
        if registration is not None and self._claiming:
            self._fail_interrupted(registration.session_id, sim_time_s)
        if registration is None or not recorder.fetch(PEEK, (registration.robot_id, now)):
            return None
        ids = {"session": registration.session_id, "robot": registration.robot_id}
        times = {"now": now, "sim_time": sim_time_s}
        self._claiming = True
        rows = recorder.fetch(CLAIM, {**ids, **times})
        if rows is None:  # not known: the next call checks whether it was claimed
            return None
        command = self._read(rows[0], registration.session_id, sim_time_s) if rows else None
        if command is None:
            self._claiming = False
            self._check_successor(registration)
        return command

    def begin(self, command: ClaimedCommand) -> None:
        """Note that the caller runs the command now and will write its outcome in any case."""
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

    def _check_successor(self, registration: Registration) -> None:
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
            built_in = BUILT_IN_ACTIONS.get(command.action)
            if tape_notes.note is not None and (built_in is None or built_in.runs_user_code):
                tape_notes.note("command", [command.action, command.params])
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
        """Write `done` with the result; return (and write) what had to be replaced in it."""
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
    """Name the values of a result that JSON cannot hold, by path and kind."""
    if not replaced:
        return None
    first = list(replaced.items())[:10]
    named = [f"{path or 'all of it'} ({kind})" for path, kind in first]
    more = f" and {len(replaced) - len(first)} more" if len(replaced) > len(first) else ""
    return f"values of the result that JSON cannot hold were replaced: {', '.join(named)}{more}"


# -- custom actions --------------------------------------------------------------------------------


Handler = Callable[[dict[str, Any]], object]


class Handlers:
    """The registered functions by the name of their action.

    Attributes:
        running: Whether a function is being called now.
        loop_polls: Whether the loop itself calls `get_command()`, and may handle what it returns.
    """

    def __init__(self, recorder: Recorder, journal: Journal, pause: Pause) -> None:
        self._recorder = recorder
        self._journal = journal
        self._pause = pause
        self._handlers: dict[str, Handler] = {}
        self._refused: set[str] = set()
        self.running = False
        self.loop_polls = True

    def register(self, action: str, handler: Handler) -> None:
        """Register a custom action, in this process and in the session's row.

        A built-in action cannot be replaced, except for `reset_state`, which calls functions of the
        controller anyway.

        Raises:
            ValueError: If the name is empty, too long, or not printable.
            TypeError: If the name is not a text, or the handler is not a plain function.
        """
        _require_name(action)
        built_in = BUILT_IN_ACTIONS.get(action)
        if built_in is not None and not built_in.runs_user_code:
            self._refuse(action)
            return
        import inspect  # only here: it would be a fifth of the bridge's import time

        if not callable(handler) or inspect.iscoroutinefunction(handler):
            raise TypeError(f"the handler of {action!r} must be a plain function, not {handler!r}")
        docstring = getattr(handler, "__doc__", None)
        doc = inspect.cleandoc(docstring) if isinstance(docstring, str) else ""
        if built_in is not None and action not in self._handlers:
            why = "this function is called instead of the callbacks of on_reload()"
            self._journal.log("info", "bridge", f"the controller has registered {action!r}: {why}")
        self._handlers[action] = handler
        self._recorder.actions[action] = storable(cut(doc, 4_000))
        self._recorder.update_actions()

    def knows(self, action: str) -> bool:
        """Return whether the controller has registered a function for the action."""
        return action in self._handlers

    def run(self, command: ClaimedCommand) -> object:
        """Call the function of the command's action.

        Raises:
            CommandRefusedError: If no function is registered for this action.
            Exception: Whatever the function raises.
        """
        handler = self._handlers.get(command.action)
        if handler is None:
            raise CommandRefusedError(self._unknown(command.action))
        return self._call(handler, command)

    def _refuse(self, action: str) -> None:
        """Warn once that the function is never called; a loop may register it in every round."""
        if action in self._refused:
            return
        self._refused.add(action)
        why = (
            f"action {action!r} is built in and cannot be replaced: the function registered for it "
            f"is never called; choose another name, such as {'my_' + action!r}"
        )
        self._journal.log("warning", "bridge", why)
        self._recorder.errors.failed(f"register_command({action!r})", ValueError(why))

    def _unknown(self, action: str) -> str:
        """Return the error of a command whose action is neither built in nor registered."""
        known = harmless_first(action, (*self._handlers, *BUILT_IN_ACTIONS))
        text = f"no action {action!r}; this robot has {', '.join(known)}"
        if self._handlers:
            return text
        text += ": its controller has registered none (bridge.register_command)"
        if not self.loop_polls:
            return text
        return (
            f"{text}. get_command() returned the command to the loop; the bridge does not know "
            "whether the loop handled it"
        )

    def _call(self, handler: Handler, command: ClaimedCommand) -> object:
        outer, self.running = self.running, True
        try:
            with self._pause.user_code():
                return handler(command.as_dict())
        finally:
            self.running = outer


def _require_name(action: object) -> None:
    if not isinstance(action, str):
        kind = type(action).__name__
        raise TypeError(f"the name of an action must be a text, not {kind} {action!r}")
    if not 0 < len(action) <= _MOST_NAME_CHARACTERS or not action.isprintable():
        raise ValueError(
            f"action {action[:_MOST_NAME_CHARACTERS]!r} cannot be registered: choose a name of 1 "
            f"to {_MOST_NAME_CHARACTERS} printable characters"
        )


# -- callbacks of reloads and resets ---------------------------------------------------------------


Callback = Callable[[], object]


class Reloads:
    """The callbacks of `on_reload`, and the reload that `detect_reload` has not returned yet.

    Args:
        failed: Receives the error of a callback that raised; the next one still runs.

    Attributes:
        requested_by: The command that asked Webots for a reload, until it happens.
    """

    def __init__(self, failed: Callable[[str, Exception], None]) -> None:
        self._failed = failed
        self._callbacks: list[Callback] = []
        self.requested_by: ClaimedCommand | None = None
        self._undetected = False
        self._unfired = False

    def add(self, callback: Callback) -> None:
        """Add a callback; one for a reload that happened before the first callback is still due."""
        self._callbacks.append(callback)

    def happened(self) -> None:
        """Note that the world was reloaded or reset."""
        self._undetected = self._unfired = True

    def detect(self) -> bool:
        """Return whether a reload or reset happened since the last call."""
        detected, self._undetected = self._undetected, False
        return detected

    def fire(self) -> None:
        """Run the callbacks if a reload or reset happened and they have not run since."""
        if self._unfired and self._callbacks:
            self._unfired = False
            self.call_back()

    def call_back(self) -> list[Exception | None]:
        """Run all callbacks; returns the exception of each, or None."""
        return [self._outcome(callback) for callback in tuple(self._callbacks)]

    def _outcome(self, callback: Callback) -> Exception | None:
        try:
            callback()
        except Exception as error:  # noqa: BLE001  (the next one still has to run)
            self._failed("on_reload callback", error)
            return error
        return None
