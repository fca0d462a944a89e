"""Sending a command to a robot's controller, and waiting for its outcome.

A command that cannot run any more is withdrawn or cancelled, so that it never runs after its
caller has stopped waiting.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import anyio
from anyio import to_thread

from webots_mcp.contract import LOOPING
from webots_mcp.database.queue import CommandQueue, QueuedCommand, fetch_command
from webots_mcp.steering.run_command import ACTION, describe_progress
from webots_mcp.steering.target_robot import find_target, require_parameters
from webots_mcp.store.recording import RecordingAccess, view_robot
from webots_mcp.store.requests import permit
from webots_mcp.store.robot_status import BlockedLoop, find_block
from webots_mcp.store.robots import robot_name

if TYPE_CHECKING:
    from webots_mcp.answers.answer_models import CommandAnswer

# Receives how much is done, how much there is to do (None if unknown), and a text.
ProgressReport = Callable[[float, float | None, str], Awaitable[None]]
# A running loop claims a command at once. After this time, it is checked what blocks the loop.
BLOCK_NOTICED_S: Final = 2.0
_WITHDRAWN: Final = "the command was withdrawn and will not run"


@dataclass(frozen=True)
class WaitingTimes:
    """Times of waiting for a command, in wall seconds.

    Attributes:
        poll_s: Between two reads of its row. PRAGMA data_version is no faster, and misses commits
            of the same connection.
        soon_poll_s: The same during the first `soon_s`: a loop that runs answers within a few
            steps.
        soon_s: See `soon_poll_s`.
        report_s: Between two reports of progress.
        block_search_s: Between two searches for what blocks the loop.
        expiry_margin_s: How long an unclaimed command stays valid after the time limit. Usually the
            server cancels it at that limit; if the server dies first, the command expires then.
    """

    poll_s: float = 0.004
    soon_poll_s: float = 0.001
    soon_s: float = 0.1
    report_s: float = 1.0
    block_search_s: float = 0.25
    expiry_margin_s: float = 1.0


_TIMES: Final = WaitingTimes()


class Dispatcher:
    """Sends commands, watches their rows, and reports to the client how long it has waited.

    Args:
        recording: The recording in which commands are queued.
        report: Called once a second while a command is under way.
    """

    def __init__(self, recording: RecordingAccess, report: ProgressReport) -> None:
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
        block_noticed_s: float = BLOCK_NOTICED_S,
    ) -> CommandAnswer:
        """Send a command, wait until it is final or the time is up, and report its outcome.

        A command never runs after its caller has stopped waiting. It is cancelled if no controller
        has claimed it within `claiming_s`, or if the caller disconnects. If the loop is known to be
        blocked, the command is withdrawn at once.

        Args:
            robot: The robot whose controller is asked; None if only one is possible.
            action: A built-in or registered action.
            timeout_s: How long to wait for the outcome, in wall seconds.
            params: Its parameters, plain JSON.
            claiming_s: How long to wait for a controller to claim it, in wall seconds; at most
                `timeout_s`.
            block_noticed_s: Time after which to check whether its loop is blocked, in wall seconds.

        Raises:
            NotAllowedError: If a rule of the project forbids it.
            InvalidInputError: If the robot, the action or its parameters are invalid.
            CommandRefusedError: If no live controller could run it.
            NothingRecordedError: If there is no robot to ask.
        """
        started_s = time.monotonic()
        claiming_s = min(claiming_s, timeout_s)
        sent = await self._send(robot, action, params or {}, claiming_s)
        until_s = started_s + timeout_s
        command = await self._outcome(sent, claiming_s, block_noticed_s, until_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def refresh_mode(self, answer: CommandAnswer) -> None:
        """Correct the mode in an answer, since a later command may have changed it."""

        def correct(command_id: int) -> None:
            from webots_mcp.steering.command_answer import correct_mode

            with self._recording.reader() as connection:
                command = fetch_command(connection, command_id)
                view = view_robot(connection, robot_name(connection, command.robot_id))
                correct_mode(view, command, answer)

        if answer.command_id is not None:
            await to_thread.run_sync(correct, answer.command_id)

    async def wait(self, command_id: int, timeout_s: float) -> CommandAnswer:
        """Continue to wait for a command that was sent before, without cancelling it at the end.

        Raises:
            InvalidInputError: If there is no such command.
        """
        started_s = time.monotonic()
        await to_thread.run_sync(self._recording.settle)
        command = await self._watch(command_id, timeout_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def _send(
        self, robot: str | None, action: str, params: Mapping[str, Any], timeout_s: float
    ) -> QueuedCommand:
        sending = _Sending(partial(self._enqueue, robot, action, params, timeout_s))
        try:
            sent = await to_thread.run_sync(sending.send)
            assert sent is not None, "only `stop` below prevents sending"
            return sent
        except (anyio.get_cancelled_exc_class(), KeyboardInterrupt):
            with anyio.CancelScope(shield=True):
                if (sent := await to_thread.run_sync(sending.stop)) is not None:
                    await to_thread.run_sync(self._abandon, sent)
            raise

    async def _outcome(
        self, command: QueuedCommand, claiming_s: float, block_noticed_s: float, until_s: float
    ) -> QueuedCommand:
        try:
            command = await self._watch(command.id, claiming_s, block_noticed_s, withdraws=True)
            if command.is_final:
                return command
            command = await to_thread.run_sync(self._cancel_unclaimed, command)
            if command.is_final:
                return command
            return await self._watch(command.id, until_s - time.monotonic())
        except (anyio.get_cancelled_exc_class(), KeyboardInterrupt):
            # A KeyboardInterrupt is raised wherever the main thread is, which may be in this task.
            with anyio.CancelScope(shield=True):
                await to_thread.run_sync(self._abandon, command)
            raise

    def _enqueue(
        self, robot: str | None, action: str, params: Mapping[str, Any], timeout_s: float
    ) -> QueuedCommand:
        request_id = permit(self._recording, action, params)
        with self._recording.reader() as connection:
            view = find_target(connection, robot, action)
            require_parameters(view, action, params)
        with self._recording.brief_writer() as connection:
            return CommandQueue(connection).enqueue(
                view.robot.id,
                action,
                params,
                time_to_live_s=timeout_s + _TIMES.expiry_margin_s,
                requested_by=self._recording.asker,
                request_id=request_id,
            )

    async def _watch(
        self,
        command_id: int,
        timeout_s: float,
        block_noticed_s: float = BLOCK_NOTICED_S,
        *,
        withdraws: bool = False,
    ) -> QueuedCommand:
        started_s = time.monotonic()
        next_report_s, next_search_s = _TIMES.report_s, block_noticed_s
        with self._recording.reader() as connection:
            while not (command := fetch_command(connection, command_id)).is_final:
                waited_s = time.monotonic() - started_s
                if waited_s >= timeout_s:
                    return command
                if waited_s >= next_search_s:
                    next_search_s = waited_s + _TIMES.block_search_s
                    if command.status == "pending" and withdraws:
                        await to_thread.run_sync(withdraw_if_blocked, self._recording, command)
                    elif await to_thread.run_sync(is_held_up, self._recording, command):
                        return command
                if waited_s >= next_report_s:
                    next_report_s += _TIMES.report_s
                    await to_thread.run_sync(self._recording.settle)
                    if command.action == ACTION:
                        await self._report(*describe_progress(connection, command))
                    else:
                        is_pending = command.status == "pending"
                        doing = "waiting for the controller" if is_pending else "under way"
                        text = f"{command.action}: {doing} for {waited_s:.0f} s"
                        await self._report(waited_s, timeout_s, text)
                is_soon = waited_s < _TIMES.soon_s
                await anyio.sleep(_TIMES.soon_poll_s if is_soon else _TIMES.poll_s)
            return command

    def _cancel_unclaimed(self, command: QueuedCommand) -> QueuedCommand:
        self._recording.settle()
        withdraw_if_blocked(self._recording, command)
        return self._cancel(command.id, "no controller claimed it in time; it will not run")

    def _abandon(self, command: QueuedCommand) -> None:
        """Cancel a command whose caller has left; a `run` or `step` that has begun ends now."""
        with self._recording.brief_writer() as connection:
            queue = CommandQueue(connection)
            is_running = queue.leave(command.id, "the client disconnected")
            if is_running and command.action in LOOPING:
                params, asker = {"command_id": command.id}, self._recording.asker
                queue.enqueue(command.robot_id, "cancel_run", params, requested_by=asker)

    def _cancel(self, command_id: int, why: str) -> QueuedCommand:
        with self._recording.brief_writer() as connection:
            CommandQueue(connection).cancel(command_id, why)
            return fetch_command(connection, command_id)

    def _answer(self, command: QueuedCommand, waited_s: float) -> CommandAnswer:
        # Imported with the first command: a server that starts needs none of it.
        from webots_mcp.steering.command_answer import command_answer

        with self._recording.reader() as connection:
            view = view_robot(connection, robot_name(connection, command.robot_id))
            return command_answer(view, command, waited_s)


def withdraw_if_blocked(recording: RecordingAccess, command: QueuedCommand) -> bool:
    """Cancel a pending command where its loop is known to be blocked; True if it will never run.

    A controller that claims it in the meantime runs it, and the outcome is that of the controller.
    """
    block = _block_of(recording, command)
    if block is None:
        return False
    with recording.brief_writer() as connection:
        return CommandQueue(connection).cancel(command.id, f"{block.why}; {_WITHDRAWN}")


def is_withdrawn(answer: CommandAnswer) -> bool:
    """Return whether a command was withdrawn because its loop was known to be blocked."""
    return (answer.error or "").endswith(_WITHDRAWN)


def is_held_up(recording: RecordingAccess, command: QueuedCommand) -> bool:
    """Return whether a running `step` or `run` cannot continue, since its loop is blocked."""
    if command.status != "claimed" or command.action not in LOOPING:
        return False
    return _block_of(recording, command) is not None


def _block_of(recording: RecordingAccess, command: QueuedCommand) -> BlockedLoop | None:
    with recording.reader() as connection:
        name = robot_name(connection, command.robot_id)
    with recording.view(name) as view:
        return find_block(view.connection, view.session, view.run, view.now_s)


class _Sending:
    """Sends a command in a thread; Ctrl-C ends the task that waits for it, not the thread."""

    def __init__(self, enqueue: Callable[[], QueuedCommand]) -> None:
        self._enqueue = enqueue
        self._lock = threading.Lock()
        self._sent: QueuedCommand | None = None
        self._stopped = False

    def send(self) -> QueuedCommand | None:
        with self._lock:
            if not self._stopped:
                self._sent = self._enqueue()
            return self._sent

    def stop(self) -> QueuedCommand | None:
        """Prevent sending from now on; returns the command if it was already sent."""
        with self._lock:
            self._stopped = True
            return self._sent
