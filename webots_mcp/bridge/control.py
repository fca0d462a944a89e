"""Serving the command queue from inside the user's loop."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from typing import Any, Final

from webots_mcp.bridge.actions import Actions, CallBack, Progress
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.commands import Command, CommandQueue, describe
from webots_mcp.bridge.heart import Heart
from webots_mcp.bridge.hold import PUMP_INTERVAL_S, Hold
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pictures import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.bridge.text import cut, storable
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.connection import is_busy
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.errors import CommandRefusedError
from webots_mcp.settlement import EXTERN

Handler = Callable[[dict[str, Any]], object]

POLL_INTERVAL_S: Final = 0.005
_MOST_NAME_CHARACTERS: Final = 100
_MOST_DOC_CHARACTERS: Final = 4000
_ENDS_STEPPING: Final = ("pause", "resume", "fast", "step", "reset", "reload")


class Control:
    """Claims commands, runs them, and holds the loop while the simulation is paused."""

    def __init__(
        self,
        simulation: Simulation,
        recorder: Recorder,
        clock: Clock,
        journal: Journal,
        album: Album,
        call_back: CallBack,
        heart: Heart,
        throttle: Throttle,
        look: Callable[[], object],
    ) -> None:
        self._simulation = simulation
        self._recorder = recorder
        self._clock = clock
        self._heart = heart
        self._journal = journal
        self._queue = CommandQueue(recorder)
        self._hold = Hold(simulation, journal, heart, self._stay, look)
        self.actions = Actions(
            simulation, self._queue, self._hold, clock, album, call_back, throttle
        )
        self._handlers: dict[str, Handler] = {}
        self._under_way: dict[Command, Progress] = {}
        self._reported = False
        self._next_poll_s = 0.0

    def register(self, action: str, handler: Handler) -> None:
        """Make an action of the user's own known.

        Raises:
            ValueError: The name is built in, empty, too long, or no text that can be sent.
            TypeError: The name is no text, or the handler is not a plain function.
        """
        _require_name(action)
        import inspect  # only here: it would be a fifth of the bridge's import time

        if not callable(handler) or inspect.iscoroutinefunction(handler):
            raise TypeError(f"the handler of {action!r} must be a plain function, not {handler!r}")
        written = getattr(handler, "__doc__", None)
        doc = inspect.cleandoc(written) if isinstance(written, str) else ""
        self._handlers[action] = handler
        self._recorder.actions[action] = storable(cut(doc, _MOST_DOC_CHARACTERS))
        self._recorder.update_actions()

    def take_over(self, mode_before: str) -> None:
        """Hold the loop from its next step on, as the session before this one held it."""
        self._hold.take_over(mode_before)

    def report_end(self, *, extern: bool) -> None:
        """The process is about to end: say what no successor will say of a reload."""
        command = self.actions.reloading
        if command is not None and extern and not self._reported:
            self._reported = True
            self._under_way.pop(command, None)
            self._succeed(command, {"controller": f"it has ended; {EXTERN}"})

    def let_go(self) -> None:
        """No command will be served any more."""
        self._hold.let_go()

    def serve(self) -> Command | None:
        """One round: what is under way, one new command, and the hold if there is one.

        Returns:
            The command that was handled last in this call, if any.
        """
        now = time.monotonic()
        if now < self._next_poll_s and not self._under_way:
            return None
        self._next_poll_s = now + POLL_INTERVAL_S
        self._advance_all()
        handled = self._serve_one()
        return self._stay() or handled

    def _stay(self) -> Command | None:
        """Serve commands for as long as the loop is held."""
        handled = None
        while self._hold.held:
            self._heart.poll()
            self._hold.pump()
            self._advance_all()
            handled = self._serve_one() or handled
            time.sleep(PUMP_INTERVAL_S if self._hold.held else 0)
        return handled

    def _serve_one(self) -> Command | None:
        if self._simulation.over:
            return None
        try:
            command = self._queue.claim(self._clock.sim_time_s)
        except sqlite3.Error as error:
            if not is_busy(error):
                self._recorder.complain("claim", f"commands cannot be read: {error}")
            return None
        if command is not None:
            self._start(command)
        return command

    def _start(self, command: Command) -> None:
        try:
            self._queue.begin(command)
            if command.action in _ENDS_STEPPING:
                self._interrupt_steps(command)
            if command.action in BUILT_IN_ACTIONS:
                self._under_way[command] = self.actions.begin(command)
            else:
                self._succeed(command, self._run_handler(command))
        except BaseException as error:
            self._fail(command, error)  # whatever a handler raises is the answer
            if not isinstance(error, Exception):
                raise
        self._advance(command)

    def _run_handler(self, command: Command) -> object:
        handler = self._handlers.get(command.action)
        if handler is not None:
            with self._hold.users_code():
                return handler(command.as_dict())
        if self._handlers:
            known = ", ".join((*self._handlers, *BUILT_IN_ACTIONS))
            raise CommandRefusedError(f"no action {command.action!r}; this robot knows {known}")
        # A loop without registered actions may look at what get_command() returns by itself.
        return {"returned_by_get_command": True}

    def _advance_all(self) -> None:
        for command in tuple(self._under_way):
            if self._simulation.over:
                self._abandon(command)
            else:
                self._advance(command)

    def _abandon(self, command: Command) -> None:
        """Webots is not asked for anything any more; the successor confirms a reload."""
        del self._under_way[command]
        if command.action != "reload":
            self._fail(
                command, CommandRefusedError("Webots ended the controller before it was done")
            )

    def _advance(self, command: Command) -> None:
        """Go on with a built-in action; a callback of the user's in it may come back to here."""
        progress = self._under_way.pop(command, None)
        if progress is None:
            return
        try:
            next(progress)
            self._under_way[command] = progress
        except StopIteration as end:
            self._succeed(command, end.value)
        except BaseException as error:
            self._fail(command, error)  # whatever went wrong is the answer
            if not isinstance(error, Exception):
                raise

    def _interrupt_steps(self, by: Command) -> None:
        for command in [c for c in self._under_way if c.action == "step"]:
            progress = self._under_way.pop(command)
            try:
                progress.throw(CommandRefusedError(f"interrupted by command {by.id} ({by.action})"))
            except CommandRefusedError as reason:
                self._fail(command, reason)

    def _succeed(self, command: Command, result: object) -> None:
        replaced = self._queue.succeed(command, result, self._clock.sim_time_s)
        if replaced is not None:
            text = f"command {command.id} ({command.action}): {replaced}"
            self._journal.log("warning", "bridge", text)

    def _fail(self, command: Command, error: BaseException) -> None:
        self._queue.fail(command, describe(error), self._clock.sim_time_s)


def _require_name(action: object) -> None:
    if not isinstance(action, str):
        raise TypeError(f"the name of an action is a text, not {type(action).__name__} {action!r}")
    if not action or action in BUILT_IN_ACTIONS:
        raise ValueError(
            f"action {action!r} cannot be registered: choose a name that is not empty and "
            f"not built in ({', '.join(BUILT_IN_ACTIONS)})"
        )
    if len(action) > _MOST_NAME_CHARACTERS or not action.isprintable():
        raise ValueError(
            f"action {action[:_MOST_NAME_CHARACTERS]!r} cannot be registered: choose a name of "
            f"printable characters, at most {_MOST_NAME_CHARACTERS}"
        )
