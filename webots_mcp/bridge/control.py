"""Serves the command queue: claims commands, runs their actions, and writes the outcomes.

Each built-in action (`contract.BUILT_IN_ACTIONS`) is a function that returns a generator. In each
round of the controller's loop, or of a pause, the generator is advanced once. It yields while the
command is running. In the end it returns the command's result or raises the command's error.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

from webots_mcp.bridge.claimed_commands import (
    Action,
    ClaimedCommand,
    ClaimedCommands,
    Handlers,
    Progress,
    Reloads,
)
from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.pause_loop import PUMP_INTERVAL_S, Pause
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.contract import BUILT_IN_ACTIONS, ENDING, LOOPING
from webots_mcp.database.session_cleanup import EXTERN
from webots_mcp.database.tapes import tape_notes
from webots_mcp.errors import (
    CommandRefusedError,
    ControllerEndedError,
    InterruptedCommandError,
    InvalidInputError,
)
from webots_mcp.signals.naming import misfit_of_parameters

POLL_INTERVAL_S: Final = 0.005


class Control:
    """Claims commands, runs them, and keeps serving while the simulation is paused.

    Args:
        actions: The built-in actions, by name.

    Attributes:
        handlers: The functions that the controller registered for its own actions.
        why_ended: The error written to commands that still run when the process ends.
    """

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        journal: Journal,
        heartbeat: Heartbeat,
        queue: ClaimedCommands,
        pause: Pause,
        reloads: Reloads,
        handlers: Handlers,
        actions: Mapping[str, Action],
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._heartbeat = heartbeat
        self._queue = queue
        self._pause = pause
        self._reloads = reloads
        self._actions = actions
        self.handlers = handlers
        self.why_ended = "the controller ended"
        self._running: dict[ClaimedCommand, Progress] = {}
        self._reported = False
        self._next_poll_s = 0.0
        pause.serve = self._serve_pause

    def report_end(self, *, extern: bool) -> None:
        """Before the process ends, answer the commands that no later session will answer.

        Args:
            extern: Whether Webots does not start this controller, and so not its successor.
        """
        for running in [c for c in self._running if c.action in (*LOOPING, *ENDING)]:
            self._end(running, ControllerEndedError(self.why_ended))
        command = self._reloads.requested_by
        if command is not None and extern and not self._reported:
            self._reported = True
            self._running.pop(command, None)
            self._succeed(command, {"controller": f"it has ended; {EXTERN}"})

    def serve(self) -> ClaimedCommand | None:
        """Advance the running actions, begin one new command, and stay as long as a pause lasts.

        Returns:
            The command that was handled last in this call, if any.
        """
        if tape_notes.replayed is not None:
            return self._serve_replayed(tape_notes.replayed)
        now, handled = time.monotonic(), None
        due = now >= self._next_poll_s
        if not (due or self._running or self._pause.active):
            return None
        self._advance_all()
        if due:
            handled = self._serve_one()
            # Commands often come in groups: after one, the next round polls at once.
            self._next_poll_s = now + POLL_INTERVAL_S if handled is None else now
        return self._serve_pause() or handled

    def _serve_replayed(self, tape: tape_notes.ReplayedNotes) -> ClaimedCommand | None:
        """Serve the commands that the old run got in this round, of which no database knows."""
        handled = None
        while (due := tape.command_due()) is not None:
            handled = ClaimedCommand(0, *due, 0)
            self._start(handled)
        return handled

    def _serve_pause(self) -> ClaimedCommand | None:
        """Serve commands for as long as the pause lasts."""
        handled, pause = None, self._pause
        while pause.active:
            self._heartbeat.poll()
            pause.pump()
            self._advance_all()
            handled = self._serve_one() or handled
            time.sleep(PUMP_INTERVAL_S if pause.active else 0)
        return handled

    def _serve_one(self) -> ClaimedCommand | None:
        if self._simulation.over:
            return None
        command = self._queue.claim(self._clock.sim_time_s)
        if command is not None:
            self._start(command)
        return command

    def _start(self, command: ClaimedCommand) -> None:
        built_in = BUILT_IN_ACTIONS.get(command.action)
        try:
            self._queue.begin(command)
            if built_in is None or self.handlers.knows(command.action):
                self._succeed(command, self.handlers.run(command))
            else:
                progress = self._begin(command)
                if built_in.ends_steps:
                    self._interrupt(f"interrupted by command {command.id} ({command.action})")
                self._running[command] = progress
        except BaseException as error:
            self._fail(command, error)  # whatever a handler raises is the answer
            if not isinstance(error, Exception):
                raise  # Ctrl-C and SystemExit still end the loop, but the command is answered first
        self._advance(command)

    def _begin(self, command: ClaimedCommand) -> Progress:
        """Return the generator of a built-in action.

        Raises:
            CommandRefusedError: If it needs a Supervisor and this robot is not one.
            InvalidInputError: If a parameter is unknown or missing.
        """
        action = BUILT_IN_ACTIONS[command.action]
        if action.needs_supervisor:
            self._simulation.require_supervisor(command.action)
        misfit = misfit_of_parameters(
            command.params, action.parameters, action.required, command.action
        )
        if misfit is not None:
            raise InvalidInputError(misfit)
        return self._actions[command.action](command)

    def _advance_all(self) -> None:
        for command in tuple(self._running):  # a copy: an advanced action leaves or changes it
            if self._simulation.over:
                self._abandon(command)
            else:
                self._advance(command)

    def _abandon(self, command: ClaimedCommand) -> None:
        """End an action after Webots has ended the controller.

        A `reload` stays claimed: the next session confirms it.
        """
        if command.action == "reload":
            del self._running[command]
        else:
            self._end(command, ControllerEndedError("Webots ended the controller"))

    def _advance(self, command: ClaimedCommand) -> None:
        """Advance a built-in action by one round.

        It is not among the running actions meanwhile: a callback of the user may call
        `get_command()`, which advances those, and a generator cannot be entered twice.
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
        """End the commands that let the loop run, since another command controls it now."""
        for command in [c for c in self._running if c.action in LOOPING]:
            self._end(command, InterruptedCommandError(why))

    def _end(self, command: ClaimedCommand, interruption: InterruptedCommandError) -> None:
        """Interrupt a running action, which may answer with what it has done so far."""
        progress = self._running.pop(command)
        try:
            progress.throw(interruption)
        except StopIteration as end:
            self._succeed(command, end.value)
        except CommandRefusedError as reason:
            self._fail(command, reason)

    def _succeed(self, command: ClaimedCommand, result: object) -> None:
        replaced = self._queue.succeed(command, result, self._clock.sim_time_s)
        if replaced is not None:
            text = f"command {command.id} ({command.action}): {replaced}"
            self._journal.log("warning", "bridge", text)

    def _fail(self, command: ClaimedCommand, error: BaseException) -> None:
        self._queue.fail(command, describe(error), self._clock.sim_time_s)
