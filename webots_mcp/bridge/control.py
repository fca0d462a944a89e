"""Serving the command queue from inside the user's loop."""

from __future__ import annotations

import time
from typing import Final

from webots_mcp.bridge import actions
from webots_mcp.bridge.command_queue import ClaimedCommand, Progress
from webots_mcp.bridge.context import Context
from webots_mcp.bridge.handlers import Handlers
from webots_mcp.bridge.pause import PUMP_INTERVAL_S
from webots_mcp.bridge.text import describe
from webots_mcp.contract import BUILT_IN_ACTIONS, ENDING, LOOPING
from webots_mcp.errors import (
    CommandRefusedError,
    ControllerEndedError,
    InterruptedCommandError,
)
from webots_mcp.liveness import EXTERN

POLL_INTERVAL_S: Final = 0.005


class Control:
    """Claims commands, runs them, and keeps the loop while the simulation is paused.

    Attributes:
        handlers: The controller's own actions.
        why_ended: The error of commands that are still running when the process ends.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self.handlers = Handlers(context.recorder, context.journal, context.pause)
        self.why_ended = "the controller ended"
        self._running: dict[ClaimedCommand, Progress] = {}
        self._reported = False
        self._next_poll_s = 0.0
        context.pause.serve = self._serve_pause

    def report_end(self, *, extern: bool) -> None:
        """The process is about to end: answer the commands that no successor will answer."""
        for running in [c for c in self._running if c.action in (*LOOPING, *ENDING)]:
            self._end(running, ControllerEndedError(self.why_ended))
        command = self._context.reloads.requested_by
        if command is not None and extern and not self._reported:
            self._reported = True
            self._running.pop(command, None)
            self._succeed(command, {"controller": f"it has ended; {EXTERN}"})

    def serve(self) -> ClaimedCommand | None:
        """One round: advance running actions, begin one new command, and stay in a pause.

        Returns:
            The command that was handled last in this call, if any.
        """
        now, handled = time.monotonic(), None
        due = now >= self._next_poll_s
        if not (due or self._running or self._context.pause.active):
            return None
        self._advance_all()
        if due:
            handled = self._serve_one()
            # Commands often come in groups: after one, the next round looks for another.
            self._next_poll_s = now + POLL_INTERVAL_S if handled is None else now
        return self._serve_pause() or handled

    def _serve_pause(self) -> ClaimedCommand | None:
        """Serve commands for as long as the pause lasts."""
        handled, pause = None, self._context.pause
        while pause.active:
            self._context.heartbeat.poll()
            pause.pump()
            self._advance_all()
            handled = self._serve_one() or handled
            time.sleep(PUMP_INTERVAL_S if pause.active else 0)
        return handled

    def _serve_one(self) -> ClaimedCommand | None:
        if self._context.simulation.over:
            return None
        command = self._context.queue.claim(self._context.clock.sim_time_s)
        if command is not None:
            self._start(command)
        return command

    def _start(self, command: ClaimedCommand) -> None:
        built_in = BUILT_IN_ACTIONS.get(command.action)
        try:
            self._context.queue.begin(command)
            if built_in is None or self.handlers.knows(command.action):
                self._succeed(command, self.handlers.run(command))
            else:
                progress = actions.begin(self._context, command)
                if built_in.ends_steps:
                    self._interrupt(f"interrupted by command {command.id} ({command.action})")
                self._running[command] = progress
        except BaseException as error:
            self._fail(command, error)  # whatever a handler raises is the answer
            if not isinstance(error, Exception):
                raise  # Ctrl-C and SystemExit still end the loop, but the command is answered first
        self._advance(command)

    def _advance_all(self) -> None:
        for command in tuple(self._running):  # a copy: an advanced action leaves or changes it
            if self._context.simulation.over:
                self._abandon(command)
            else:
                self._advance(command)

    def _abandon(self, command: ClaimedCommand) -> None:
        """Drop an action after Webots said quit; a reload is left for the successor to confirm."""
        if command.action == "reload":
            del self._running[command]
        else:
            self._end(command, ControllerEndedError("Webots ended the controller"))

    def _advance(self, command: ClaimedCommand) -> None:
        """Advance a built-in action by one round.

        It is taken out meanwhile: a callback of the user may call `get_command()` and so come back
        to here, and a generator cannot be entered twice.
        """
        progress = self._running.pop(command, None)
        if progress is None:
            return
        try:
            next(progress)
            self._running[command] = progress
        except StopIteration as end:
            self._succeed(command, end.value)
        except BaseException as error:
            self._fail(command, error)  # whatever the action raises is the answer
            if not isinstance(error, Exception):
                raise

    def _interrupt(self, why: str) -> None:
        """Another command controls the loop from now on: end the ones that let it run."""
        for command in [c for c in self._running if c.action in LOOPING]:
            self._end(command, InterruptedCommandError(why))

    def _end(self, command: ClaimedCommand, interruption: InterruptedCommandError) -> None:
        """End a running built-in action, which may answer how far it got."""
        progress = self._running.pop(command)
        try:
            progress.throw(interruption)
        except StopIteration as end:
            self._succeed(command, end.value)
        except CommandRefusedError as reason:
            self._fail(command, reason)

    def _succeed(self, command: ClaimedCommand, result: object) -> None:
        context = self._context
        replaced = context.queue.succeed(command, result, context.clock.sim_time_s)
        if replaced is not None:
            text = f"command {command.id} ({command.action}): {replaced}"
            context.journal.log("warning", "bridge", text)

    def _fail(self, command: ClaimedCommand, error: BaseException) -> None:
        self._context.queue.fail(command, describe(error), self._context.clock.sim_time_s)
