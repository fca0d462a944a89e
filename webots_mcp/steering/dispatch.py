"""Sending a command to a robot's controller, and waiting for its outcome."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, Final

import anyio
from anyio import to_thread

from webots_mcp.contract import HEARTBEAT_LATE_S, LOOPING
from webots_mcp.questions.answers import CommandAnswer
from webots_mcp.questions.history_answers import RunAnswer
from webots_mcp.questions.shortening import RESULT_BUDGET_TOKENS, WHOLE, cut_text, shorten
from webots_mcp.queue import Command, CommandQueue, fetch_command
from webots_mcp.steering.running import ACTION as RUN
from webots_mcp.steering.running import progress_of, run_facts
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import Recording, View, look
from webots_mcp.store.robots import handler_at_work, robot_name

Report = Callable[[float, float | None, str], Awaitable[None]]

# Reading one row by its key takes microseconds, no longer than PRAGMA data_version, which would
# miss commits of the same connection.
_POLL_INTERVAL_S: Final = 0.004
_REPORT_INTERVAL_S: Final = 1.0
# At the deadline the command is cancelled. Its own time to live only matters if this server dies
# while it waits: the command then expires soon after the deadline.
_OUTLIVES_WAITING_S: Final = 1.0
_ERROR_CHARACTERS: Final = 2_000


class Dispatcher:
    """Sends commands, watches their rows, and reports to the client how long it has waited."""

    def __init__(self, recording: Recording, report: Report) -> None:
        self._recording = recording
        self._report = report

    async def ask(
        self,
        robot: str | None,
        action: str,
        timeout_s: float,
        params: Mapping[str, Any] | None = None,
        *,
        claiming_s: float = math.inf,
    ) -> CommandAnswer:
        """Send a command, wait until it is final or the time is up, and report its outcome.

        A command that is not claimed at the deadline is cancelled, so that it cannot run when its
        caller has stopped waiting; the same happens when the caller disconnects.

        Args:
            robot: Whose controller is asked; None where only one can be meant.
            action: A built-in or registered action.
            timeout_s: How long to wait for the outcome, in wall seconds.
            params: Its parameters, plain JSON.
            claiming_s: How long to wait for a controller to claim it, if less, in wall seconds.

        Raises:
            InvalidInputError: The robot, the action or its parameters are invalid.
            CommandRefusedError: No live controller could run it.
            NothingRecordedError: There is no robot to ask.
        """
        started_s = time.monotonic()
        claiming_s = min(claiming_s, timeout_s)
        sent = await self._send(robot, action, params or {}, claiming_s)
        command = await self._outcome(sent, claiming_s, started_s + timeout_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def wait(self, command_id: int, timeout_s: float) -> CommandAnswer:
        """Continue to wait for a command that was sent before; it is not cancelled at the deadline.

        Raises:
            InvalidInputError: There is no such command.
        """
        started_s = time.monotonic()
        await to_thread.run_sync(self._recording.settle)
        command = await self._watch(command_id, timeout_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def _send(
        self, robot: str | None, action: str, params: Mapping[str, Any], timeout_s: float
    ) -> Command:
        sending = _Sending(partial(self._enqueue, robot, action, params, timeout_s))
        try:
            sent = await to_thread.run_sync(sending.send)
            assert sent is not None, "stopped below only"
            return sent
        except (anyio.get_cancelled_exc_class(), KeyboardInterrupt):
            with anyio.CancelScope(shield=True):
                if (sent := await to_thread.run_sync(sending.stop)) is not None:
                    await to_thread.run_sync(self._leave, sent)
            raise

    async def _outcome(self, command: Command, claiming_s: float, until_s: float) -> Command:
        try:
            command = await self._watch(command.id, claiming_s)
            command = await to_thread.run_sync(self._at_the_deadline, command)
            if command.is_final:
                return command
            return await self._watch(command.id, until_s - time.monotonic())
        except (anyio.get_cancelled_exc_class(), KeyboardInterrupt):
            # A KeyboardInterrupt is raised wherever the main thread is, which may be in this task.
            with anyio.CancelScope(shield=True):
                await to_thread.run_sync(self._leave, command)
            raise

    def _enqueue(
        self, robot: str | None, action: str, params: Mapping[str, Any], timeout_s: float
    ) -> Command:
        with self._recording.reader() as connection:
            view = find_target(connection, robot, action)
        with self._recording.writer() as connection:
            return CommandQueue(connection).enqueue(
                view.robot.id,
                action,
                params,
                time_to_live_s=timeout_s + _OUTLIVES_WAITING_S,
                requested_by=self._recording.asker,
            )

    async def _watch(self, command_id: int, timeout_s: float) -> Command:
        started_s = time.monotonic()
        next_report_s = _REPORT_INTERVAL_S
        with self._recording.reader() as connection:
            while not (command := fetch_command(connection, command_id)).is_final:
                waited_s = time.monotonic() - started_s
                if waited_s >= timeout_s:
                    return command
                if waited_s >= next_report_s:
                    next_report_s += _REPORT_INTERVAL_S
                    await to_thread.run_sync(self._recording.settle)
                    if command.action == RUN:
                        await self._report(*progress_of(connection, command))
                    else:
                        await self._report(waited_s, timeout_s, _progress(command, waited_s))
                await anyio.sleep(_POLL_INTERVAL_S)
            return command

    def _at_the_deadline(self, command: Command) -> Command:
        if command.is_final:
            return command
        self._recording.settle()
        return self._cancel(command.id, "no controller claimed it in time; it will not run")

    def _leave(self, command: Command) -> None:
        """The caller has left: cancel the command; a begun `run` or `step` ends now."""
        with self._recording.writer() as connection:
            queue = CommandQueue(connection)
            is_running = queue.leave(command.id, "the client disconnected")
            if is_running and command.action in LOOPING:
                params, asker = {"command_id": command.id}, self._recording.asker
                queue.enqueue(command.robot_id, "cancel_run", params, requested_by=asker)

    def _cancel(self, command_id: int, why: str) -> Command:
        with self._recording.writer() as connection:
            CommandQueue(connection).cancel(command_id, why)
            return fetch_command(connection, command_id)

    def _answer(self, command: Command, waited_s: float) -> CommandAnswer:
        with self._recording.reader() as connection:
            view = look(connection, robot_name(connection, command.robot_id))
            facts: dict[str, Any] = {
                **view.header(),
                "command_id": command.id,
                "action": command.action,
                "outcome": command.status,
                "waited_s": waited_s,
                "error": _error(command),
                "hint": _hint(view, command),
            }
            if command.action == RUN:
                return RunAnswer(**facts, **run_facts(view, command))
            return CommandAnswer(**facts, result=shown_result(command))


class _Sending:
    """Sends a command in a thread, which Ctrl-C does not end with the task that waits for it."""

    def __init__(self, enqueue: Callable[[], Command]) -> None:
        self._enqueue = enqueue
        self._lock = threading.Lock()
        self._sent: Command | None = None
        self._stopped = False

    def send(self) -> Command | None:
        with self._lock:
            if not self._stopped:
                self._sent = self._enqueue()
            return self._sent

    def stop(self) -> Command | None:
        """Prevent sending from now on; returns the command if it was already sent."""
        with self._lock:
            self._stopped = True
            return self._sent


def shown_result(command: Command, budget_tokens: int = RESULT_BUDGET_TOKENS) -> Any:
    """The result of a command; its numbers are exact, long values are shortened."""
    if command.result is None:
        return None
    return shorten(command.decoded_result(), budget_tokens, WHOLE).value


def _error(command: Command) -> str | None:
    if command.status == "done" or command.error is None:
        return None
    return cut_text(command.error, _ERROR_CHARACTERS)


def _progress(command: Command, waited_s: float) -> str:
    doing = "waiting for the controller" if command.status == "pending" else "under way"
    return f"{command.action}: {doing} for {waited_s:.0f} s"


def _hint(view: View, command: Command) -> str | None:
    """What to do next, where the outcome alone does not say it."""
    if command.status == "pending":
        return "no controller has claimed it yet"
    if command.status == "done":
        return command.error  # the values of the result that had to be replaced
    if command.status == "failed":
        return _instructions(view, command.action)
    if command.status == "claimed":
        return (
            "the controller is still running it: keep waiting with "
            f'webots_list_commands(what="outcome", command_id={command.id}); do not send it again'
        )
    if command.status == "lost":
        return _after_loss(view)
    return _after_no_answer(view)


def _after_loss(view: View) -> str:
    """What to do after a lost command, which may have run: first start and check, then resend."""
    look = "check the robot's state before you send it again"
    if view.robot.live:
        return look
    return f"start its controller (reload the world in Webots; an extern one by hand), then {look}"


def _instructions(view: View, action: str) -> str | None:
    """Where to find the description of a custom action, which the controller provides."""
    described = view.session is not None and action in view.session.actions
    return "webots_list_commands has the action's description" if described else None


def _after_no_answer(view: View) -> str:
    session = view.session
    if session is None or not view.robot.live:
        return "start its controller, then ask again"
    if handler_at_work(view.connection, session, view.now_s):
        return "wait until that handler has returned, then ask again"
    if not session.heartbeat_is_fresh(view.now_s):
        return (
            "press play in Webots if it is paused there: only a person can resume it while the "
            "controller is inside step(); else check what its loop is waiting for"
        )
    if session.last_poll_wall_time_s is None:
        return "the controller's loop never calls bridge.get_command(): add that line to its loop"
    silent_s = session.age_s(session.last_poll_wall_time_s, view.now_s)
    if silent_s > HEARTBEAT_LATE_S:
        return f"its loop runs, but last called bridge.get_command() {silent_s:.0f} s ago"
    return "its loop runs but did not claim it in time: ask again with a longer timeout_wall_s"
