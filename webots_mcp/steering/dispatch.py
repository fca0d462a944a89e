"""Sending a command to a robot's controller, and waiting for the truth about it."""

from __future__ import annotations

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
from webots_mcp.questions.shortening import RESULT_BUDGET, WHOLE, cut_text, shorten
from webots_mcp.queue import Command, CommandQueue, fetch_command
from webots_mcp.steering.running import ACTION as RUN
from webots_mcp.steering.running import progress_of, told_of_run
from webots_mcp.steering.target import find_target
from webots_mcp.store.recording import Recording, View, look
from webots_mcp.store.robots import robot_name
from webots_mcp.store.status import handler_at_work

Report = Callable[[float, float | None, str], Awaitable[None]]

# A look at one row by its key costs microseconds, as little as PRAGMA data_version, and is right
# for commits of the same connection as well.
_POLL_INTERVAL_S: Final = 0.004
_REPORT_INTERVAL_S: Final = 1.0
# The deadline decides, by taking the command back. Only if this server dies while it waits does
# the command's own time to live end it, soon after anybody could still be waiting for it.
_OUTLIVES_WAITING_S: Final = 1.0
_ERROR_CHARACTERS: Final = 2_000


class Dispatcher:
    """Sends commands, watches their rows and reports to the client how long it has waited."""

    def __init__(self, recording: Recording, report: Report) -> None:
        self._recording = recording
        self._report = report

    async def ask(
        self,
        robot: str | None,
        action: str,
        timeout_s: float,
        params: Mapping[str, Any] | None = None,
    ) -> CommandAnswer:
        """Send a command, wait until its fate is settled or time is up, and say what happened.

        At the deadline a command that nobody has claimed is taken back, so that it cannot run when
        nobody waits for it any more; the same happens when the caller goes away.

        Raises:
            InvalidInputError: The robot, the action or its parameters are wrong.
            CommandRefusedError: Nobody alive could run it.
            NothingRecordedError: There is no robot to ask.
        """
        started_s = time.monotonic()
        sent = await self._send(robot, action, params or {}, timeout_s)
        command = await self._outcome(sent, timeout_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def wait(self, command_id: int, timeout_s: float) -> CommandAnswer:
        """Go on waiting for a command that was sent before; nothing is taken back at the deadline.

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

    async def _outcome(self, command: Command, timeout_s: float) -> Command:
        try:
            command = await self._watch(command.id, timeout_s)
            return await to_thread.run_sync(self._at_the_deadline, command)
        except (anyio.get_cancelled_exc_class(), KeyboardInterrupt):
            # A signal's interrupt is raised wherever the main thread is: also in this very task.
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
        return self._take_back(command.id, "nobody claimed it in time; it will not run")

    def _leave(self, command: Command) -> None:
        """Nobody waits any more; a run that has begun ends now, as its `then` says, or a step."""
        with self._recording.writer() as connection:
            queue = CommandQueue(connection)
            goes_on = queue.leave(command.id, "the client disconnected")
            if goes_on and command.action in LOOPING:
                params, asker = {"command_id": command.id}, self._recording.asker
                queue.enqueue(command.robot_id, "cancel_run", params, requested_by=asker)

    def _take_back(self, command_id: int, why: str) -> Command:
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
                return RunAnswer(**facts, **told_of_run(view, command))
            return CommandAnswer(**facts, result=shown_result(command))


class _Sending:
    """Sends a command in a thread, which goes on when Ctrl-C ends the task that waits for it."""

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
        """From now on nothing is sent; what was."""
        with self._lock:
            self._stopped = True
            return self._sent


def shown_result(command: Command, budget: int = RESULT_BUDGET) -> Any:
    """The result of a command; its numbers are exact, what is long is shortened."""
    if command.result is None:
        return None
    return shorten(command.decoded_result(), budget, WHOLE).value


def _error(command: Command) -> str | None:
    if command.status == "done" or command.error is None:
        return None
    return cut_text(command.error, _ERROR_CHARACTERS)


def _progress(command: Command, waited_s: float) -> str:
    doing = "waiting for the controller" if command.status == "pending" else "under way"
    return f"{command.action}: {doing} for {waited_s:.0f} s"


def _hint(view: View, command: Command) -> str | None:
    """What to do next where an outcome does not speak for itself."""
    if command.status == "pending":
        return "no controller has claimed it yet"
    if command.status == "done":
        return command.error  # what of the result had to be replaced
    if command.status == "failed":
        return _instructions(view, command.action)
    if command.status == "claimed":
        return (
            "the controller is still busy with it: keep waiting with "
            f'webots_list_commands(what="outcome", command_id={command.id}); do not send it again'
        )
    if command.status == "lost":
        return _after_loss(view)
    return _after_no_answer(view)


def _after_loss(view: View) -> str:
    """A command may be sent again only to a controller that runs, and to a robot one has seen."""
    look = "look at the robot before you send it again"
    if view.robot.live:
        return look
    return f"start its controller (reload the world in Webots; an extern one by hand), then {look}"


def _instructions(view: View, action: str) -> str | None:
    """Where the description of a custom action stands: it is the controller's text, not ours."""
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
            "press play in Webots if it is paused there: only a person can, while the controller "
            "is inside step(); else see what its loop waits for"
        )
    if session.last_poll_wall_time_s is None:
        return "the controller's loop never calls bridge.get_command(): add that line to its loop"
    silent_s = session.age_s(session.last_poll_wall_time_s, view.now_s)
    if silent_s > HEARTBEAT_LATE_S:
        return f"its loop runs, but last called bridge.get_command() {silent_s:.0f} s ago"
    return "its loop runs but did not take it in time: ask again with a longer timeout_s"
