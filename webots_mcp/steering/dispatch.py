"""Sending a command to a robot's controller, and waiting for its outcome; `run` is one of them."""

from __future__ import annotations

import json
import math
import sqlite3
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple, cast

import anyio
from anyio import to_thread

from webots_mcp.answers.budget import (
    RESULT_BUDGET_TOKENS,
    WHOLE,
    cut_text,
    detailed,
    figure,
    seconds,
    shorten,
    shown,
    table,
)
from webots_mcp.answers.event_tables import fitting_events, not_shown_of
from webots_mcp.answers.models import CommandAnswer, RunAnswer
from webots_mcp.answers.movement import movement
from webots_mcp.answers.trend_tables import MOST_SIGNALS, trend_tables
from webots_mcp.contract import (
    BUILT_IN_ACTIONS,
    CUSTOM_DATA,
    HEARTBEAT_LATE_S,
    LOOPING,
    MAX_RUN_S,
)
from webots_mcp.database.queue import Command, CommandQueue, fetch_command
from webots_mcp.errors import (
    CommandRefusedError,
    ConditionFailedError,
    InvalidInputError,
    NothingRecordedError,
    UnknownActionError,
    UnknownSignalError,
)
from webots_mcp.judging.detection.events import search_events
from webots_mcp.judging.detection.kinds import Event
from webots_mcp.judging.trends import trends
from webots_mcp.signals.conditions import Condition, parse_condition
from webots_mcp.signals.conditions.signal_values import SAME_TIME_S
from webots_mcp.signals.naming import flatten, misfit_of_parameters, perhaps_meant
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range, whole_run
from webots_mcp.store.reading.segment import Subject
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.requests import permit
from webots_mcp.store.robots import (
    PRESS_PLAY,
    BlockedLoop,
    SessionRecord,
    companions,
    fetch_session,
    find_block,
    find_holder,
    handler_at_work,
    list_robots,
    live_observer,
    may_return,
    robot_name,
    without_observers,
)
from webots_mcp.store.run_rows import StateRecord, state_at
from webots_mcp.store.runs import pace

Report = Callable[[float, float | None, str], Awaitable[None]]

# Reading one row by its key takes microseconds, no longer than PRAGMA data_version, which would
# miss commits of the same connection.
_POLL_INTERVAL_S: Final = 0.004
_REPORT_INTERVAL_S: Final = 1.0
# A loop that comes round claims a command at once. After this time it is asked, so often, whether
# something is known to keep the loop.
BLOCK_NOTICED_S: Final = 2.0
_BLOCK_SOUGHT_EVERY_S: Final = 0.25
# At the deadline the command is cancelled. Its own time to live only matters if this server dies
# while it waits: the command then expires soon after the deadline.
_OUTLIVES_WAITING_S: Final = 1.0
_ERROR_CHARACTERS: Final = 2_000
_WITHDRAWN: Final = "the command was withdrawn and will not run"
# Commands that set the mode of the simulation; a `run` sets what its `then` says.
_MODES: Final = {"pause": "pause", "step": "pause", "resume": "real_time", "fast": "fast"}
_LATER: Final = (
    "SELECT id, action, status, params, result FROM command WHERE id > :id AND status IN "
    "('pending', 'claimed', 'done') AND action IN ('pause', 'step', 'resume', 'fast', 'run') "
    "AND robot_id IN (SELECT o.robot_id FROM session o JOIN session s ON s.instance = o.instance "
    "WHERE s.id = :session AND o.ended_wall_time_s IS NULL) ORDER BY id DESC LIMIT 1"
)
ACTION: Final = "run"
_ROWS_AROUND: Final = 6
_STATE_TOKENS: Final = 400
_TRENDS_TOKENS: Final = 450
_EVENTS_TOKENS: Final = 400
_CELL_TOKENS: Final = 16  # of a row before the end
_SHOWN_SIGNALS: Final = 8
_SHOWN_EVENTS: Final = 12
_MOST_COLUMNS: Final = 8
_REMEMBERED_S: Final = 60.0  # how far back rows are read to see whether a condition holds already
_MOST_REMEMBERED_ROWS: Final = 4_000
_RUNS_SEARCHED: Final = 5
_OF_SESSION: Final = (
    "SELECT id, started_sim_time_s, last_sim_time_s, started_wall_time_s FROM run "
    "WHERE session_id = ? ORDER BY id DESC LIMIT 1"
)
_BEGUN_BY: Final = "SELECT max(id) FROM run WHERE session_id = ? AND started_wall_time_s <= ?"
_LAST_ROWS: Final = (
    "SELECT sim_time_s, data FROM state WHERE run_id = ? AND sim_time_s <= ? "
    "ORDER BY sim_time_s DESC, id DESC LIMIT ?"
)
_NEWEST_RUNS: Final = "SELECT id FROM run WHERE robot_id = ? ORDER BY id DESC LIMIT ?"
_SHOWN_ACTIONS: Final = 30
_MAKE_OBSERVER: Final = "'webots-mcp init --observer WORLD' adds one to a world"
_MAKE_ONE: Final = (
    "set the field 'supervisor' of its Robot node to TRUE and create it with Supervisor() instead "
    "of Robot()"
)


class Dispatcher:
    """Sends commands, watches their rows, and reports to the client how long it has waited."""

    def __init__(self, recording: RecordingAccess, report: Report) -> None:
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

        A command that is not claimed soon because its loop is known to be blocked is withdrawn at
        once. One that is not claimed at the deadline is cancelled, so that it cannot run when its
        caller has stopped waiting; the same happens when the caller disconnects.

        Args:
            robot: Whose controller is asked; None where only one can be meant.
            action: A built-in or registered action.
            timeout_s: How long to wait for the outcome, in wall seconds.
            params: Its parameters, plain JSON.
            claiming_s: How long to wait for a controller to claim it, if less, in wall seconds.
            block_noticed_s: After which time it is asked whether its loop is blocked.

        Raises:
            NotAllowedError: A rule of the project forbids it.
            InvalidInputError: The robot, the action or its parameters are invalid.
            CommandRefusedError: No live controller could run it.
            NothingRecordedError: There is no robot to ask.
        """
        started_s = time.monotonic()
        claiming_s = min(claiming_s, timeout_s)
        sent = await self._send(robot, action, params or {}, claiming_s)
        until_s = started_s + timeout_s
        command = await self._outcome(sent, claiming_s, block_noticed_s, until_s)
        waited_s = round(time.monotonic() - started_s, 3)
        return await to_thread.run_sync(self._answer, command, waited_s)

    async def name_mode_afterwards(self, answer: CommandAnswer) -> None:
        """Correct the mode in an answer that is given some time after its command was done."""

        def correct(command_id: int) -> None:
            with self._recording.reader() as connection:
                command = fetch_command(connection, command_id)
                view = view_robot(connection, robot_name(connection, command.robot_id))
                _name_mode_afterwards(view, command, answer)

        if answer.command_id is not None:
            await to_thread.run_sync(correct, answer.command_id)

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

    async def _outcome(
        self, command: Command, claiming_s: float, block_noticed_s: float, until_s: float
    ) -> Command:
        try:
            command = await self._watch(command.id, claiming_s, block_noticed_s, withdraws=True)
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
        request_id = permit(self._recording, action, params)
        with self._recording.reader() as connection:
            view = find_target(connection, robot, action)
            _require_parameters(view, action, params)
        with self._recording.writer() as connection:
            return CommandQueue(connection).enqueue(
                view.robot.id,
                action,
                params,
                time_to_live_s=timeout_s + _OUTLIVES_WAITING_S,
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
    ) -> Command:
        started_s = time.monotonic()
        next_report_s, next_search_s = _REPORT_INTERVAL_S, block_noticed_s
        with self._recording.reader() as connection:
            while not (command := fetch_command(connection, command_id)).is_final:
                waited_s = time.monotonic() - started_s
                if waited_s >= timeout_s:
                    return command
                if waited_s >= next_search_s:
                    next_search_s = waited_s + _BLOCK_SOUGHT_EVERY_S
                    if command.status == "pending" and withdraws:
                        await to_thread.run_sync(withdraw_if_blocked, self._recording, command)
                    elif await to_thread.run_sync(is_held_up, self._recording, command):
                        return command
                if waited_s >= next_report_s:
                    next_report_s += _REPORT_INTERVAL_S
                    await to_thread.run_sync(self._recording.settle)
                    if command.action == ACTION:
                        await self._report(*progress_of(connection, command))
                    else:
                        await self._report(waited_s, timeout_s, _progress(command, waited_s))
                await anyio.sleep(_POLL_INTERVAL_S)
            return command

    def _at_the_deadline(self, command: Command) -> Command:
        if command.is_final:
            return command
        self._recording.settle()
        withdraw_if_blocked(self._recording, command)
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
            view = view_robot(connection, robot_name(connection, command.robot_id))
            facts: dict[str, Any] = {
                **view.header(),
                "command_id": command.id,
                "action": command.action,
                "outcome": command.status,
                "waited_s": waited_s,
                "error": _error(command),
                "hint": _hint(view, command),
            }
            if command.action == ACTION:
                return RunAnswer(**facts, **run_facts(view, command))
            answer = CommandAnswer(**facts, result=shown_result(command))
            _name_mode_afterwards(view, command, answer)
            return answer


def withdraw_if_blocked(recording: RecordingAccess, command: Command) -> bool:
    """Cancel a pending command where its loop is known to be blocked; True if it will never run.

    A controller that claims it in the meantime runs it, and the outcome is that of the controller.
    """
    block = _block_of(recording, command)
    if block is None:
        return False
    with recording.writer() as connection:
        return CommandQueue(connection).cancel(command.id, f"{block.why}; {_WITHDRAWN}")


def is_withdrawn(answer: CommandAnswer) -> bool:
    """Whether a command was withdrawn because its loop was known to be blocked."""
    return (answer.error or "").endswith(_WITHDRAWN)


def is_held_up(recording: RecordingAccess, command: Command) -> bool:
    """Whether a `step` or `run` that is under way cannot go on, since its loop is blocked."""
    if command.status != "claimed" or command.action not in LOOPING:
        return False
    return _block_of(recording, command) is not None


def _block_of(recording: RecordingAccess, command: Command) -> BlockedLoop | None:
    with recording.reader() as connection:
        name = robot_name(connection, command.robot_id)
    with recording.view(name) as view:
        return find_block(view.connection, view.session, view.run, view.now_s)


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


def _name_mode_afterwards(view: RobotView, command: Command, answer: CommandAnswer) -> None:
    """Correct the mode in the answer of a command that a later one has followed meanwhile."""
    if command.action not in _MODES or command.status not in ("done", "failed"):
        return
    values = {"id": command.id, "session": command.session_id}
    later = view.connection.execute(_LATER, values).fetchone()
    if later is None:
        return
    later_id, action, status, params, result = later
    known: dict[str, Any] = json.loads(result) if status == "done" and result else {}
    then = json.loads(params).get("then", "pause")
    mode = known.get("mode") or _MODES.get(action, "pause" if then == "pause" else None)
    if mode is None:
        return
    if command.status == "done" and answer.result:
        answer.result = cast("dict[str, Any]", answer.result) | {"mode": mode}
    when = "now" if status == "done" else "once that has been done"
    note = f"command {later_id} ({action}) came after it: the mode is {mode} {when}"
    if note not in (answer.hint or ""):
        answer.hint = "; ".join(filter(None, (answer.hint, note)))


def _error(command: Command) -> str | None:
    if command.status == "done" or command.error is None:
        return None
    return cut_text(command.error, _ERROR_CHARACTERS)


def _progress(command: Command, waited_s: float) -> str:
    doing = "waiting for the controller" if command.status == "pending" else "under way"
    return f"{command.action}: {doing} for {waited_s:.0f} s"


def _hint(view: RobotView, command: Command) -> str | None:
    """What to do next, where the outcome alone does not say it."""
    if command.status == "pending":
        return "no controller has claimed it yet"
    if command.status == "done":
        # The values of the result that had to be replaced, or what was not done as it was asked.
        return command.error or _result_of(command).get("warning")
    if command.status == "failed":
        return _instructions(view, command.action)
    if command.status == "claimed":
        block = find_block(view.connection, view.session, view.run, view.now_s)
        why = f"{block.why}: {block.fix}" if block else "the controller is still running it"
        return (
            f"{why}; keep waiting with "
            f'webots_list_commands(what="outcome", command_id={command.id}); do not send it again'
        )
    if command.status == "lost":
        return _after_loss(view)
    return _after_no_answer(view)


def _after_loss(view: RobotView) -> str:
    """What to do after a lost command, which may have run: first start and check, then resend."""
    check = "check the robot's state before you send it again"
    if view.robot.live:
        return check
    return f"start its controller (reload the world in Webots; an extern one by hand), then {check}"


def _instructions(view: RobotView, action: str) -> str | None:
    """Where to find the description of a custom action, which the controller provides."""
    described = view.session is not None and action in view.session.actions
    return "webots_list_commands has the action's description" if described else None


def _after_no_answer(view: RobotView) -> str:
    session = view.session
    if block := find_block(view.connection, session, view.run, view.now_s):
        return f"{block.fix}, then ask again"
    if session is None or not view.robot.live:
        return "start its controller, then ask again"
    if handler_at_work(view.connection, session, view.now_s):
        return "wait until that handler has returned, then ask again"
    if not session.heartbeat_is_fresh(view.now_s):
        return PRESS_PLAY
    if session.last_poll_wall_time_s is None:
        return "the controller's loop never calls bridge.get_command(): add that line to its loop"
    silent_s = session.age_s(session.last_poll_wall_time_s, view.now_s)
    if silent_s > HEARTBEAT_LATE_S:
        return f"its loop runs, but last called bridge.get_command() {silent_s:.0f} s ago"
    return "its loop runs but did not claim it in time: ask again with a longer timeout_wall_s"


# -- before it is sent ------------------------------------------------------------------------


def require_possible(
    recording: RecordingAccess,
    robot: str | None,
    until: str | None,
    for_s: float | None,
    *,
    reset: bool,
) -> None:
    """Refuse a run that could not end as requested, before anything is sent.

    Raises:
        InvalidInputError: Neither a condition nor a time is given, or the condition is invalid or
            reads signals that were never published.
        CommandRefusedError: No controller of the robot could run it, or the condition holds
            already.
    """
    if until is None and for_s is None:
        raise InvalidInputError(
            "give until=... (a condition), for_s=... (simulated seconds), or both"
        )
    if for_s is not None and not 0 < for_s <= MAX_RUN_S:
        raise InvalidInputError(
            f"for_s must be simulated seconds above 0 and at most {MAX_RUN_S:.0f}, not {for_s}"
        )
    condition = None if until is None else parse_condition(until)
    with recording.reader() as connection:
        view = find_target(connection, robot, ACTION)
        if condition is not None:
            _require_known(view, condition)
            if not reset:
                _require_open(view, condition)


def _require_known(view: RobotView, condition: Condition) -> None:
    """Refuse signals that were never published: most likely a name is misspelt."""
    known = known_names(view)  # empty before the first row, when nothing can be said
    if known and (unknown := condition.describe_unknown(known)):
        raise UnknownSignalError(
            "; ".join(unknown)
            + f": {'it was' if len(unknown) == 1 else 'they were'} never published by robot "
            f"{view.robot.name!r}, so the condition could never hold"
        )


def known_names(view: RobotView) -> set[str]:
    """The signals that a robot published in its newest runs; empty before the first row."""
    runs = view.connection.execute(_NEWEST_RUNS, (view.robot.id, _RUNS_SEARCHED)).fetchall()
    found = (whole_run(view.connection, run_id) for (run_id,) in runs)
    segments = tuple(segment for segment in found if segment is not None)
    if not segments:
        return set()
    asked = TimeRange(view.robot.id, view.robot.name, segments, "simulation")
    return set(known_signals(view.connection, asked))


def _require_open(view: RobotView, condition: Condition) -> None:
    """Refuse a condition that holds at the newest row: the run would be over at once.

    A condition with `changed` may hold: a change lasts one step, so the next one is awaited.
    """
    if view.run is None or "changed(" in condition.text:
        return
    since_s = holds_since(view.connection, view.run.id, condition)
    if since_s is None:
        return
    raise CommandRefusedError(
        f"{condition.text!r} already holds, at the newest row since {since_s:.3f} s of simulation "
        f"time: run until 'not ({condition.text})' first, give for_s alone, or give reset=true, so "
        "that it is evaluated after the reset"
    )


def holds_since(connection: sqlite3.Connection, run_id: int, condition: Condition) -> float | None:
    """Since when a condition holds in the last rows of a run; None where it does not.

    Raises:
        InvalidInputError: It cannot be evaluated on such values.
    """
    newest = connection.execute(_LAST_ROWS, (run_id, 1e300, _MOST_REMEMBERED_ROWS)).fetchall()
    rows = [row for row in newest if row[0] >= newest[0][0] - _REMEMBERED_S]
    evaluator, since_s = condition.evaluator(), None
    try:
        for sim_time_s, data in reversed(rows):
            if not evaluator.holds(json.loads(data), sim_time_s):
                since_s = None
            elif since_s is None:
                since_s = float(sim_time_s)
    except ConditionFailedError as error:
        raise InvalidInputError(f"{error} (in the values published so far)") from error
    return since_s


# -- while it is running ----------------------------------------------------------------------


class Progress(NamedTuple):
    """The progress of a `run` command.

    Attributes:
        run_id: The run in which it advances; None before the controller has claimed it.
        from_s: The simulation time at which it began, in seconds.
        to_s: The simulation time that it has reached, in seconds.
        factor: Simulated per wall seconds; None where it is unknown.
    """

    run_id: int | None
    from_s: float
    to_s: float
    factor: float | None

    @property
    def advanced_s(self) -> float:
        """Simulated seconds."""
        return max(self.to_s - self.from_s, 0.0)


def _progress_in(connection: sqlite3.Connection, command: Command) -> Progress:
    """The progress in the bridge's result; until there is one, as the heartbeat shows it."""
    if result := _result_of(command):
        run_id = result.get("run_id") or _run_of(connection, command)
        return Progress(run_id, result["from_s"], result["sim_time_s"], result.get("factor"))
    if command.session_id is None:
        return Progress(None, 0.0, 0.0, None)
    row = connection.execute(_OF_SESSION, (command.session_id,)).fetchone()
    session = fetch_session(connection, command.session_id)
    if row is None or session is None:
        return Progress(None, 0.0, 0.0, None)
    return _observed_progress(command, row, session.sim_time_s or 0.0)


def _run_of(connection: sqlite3.Connection, command: Command) -> int | None:
    """The run in which it ended, where the bridge did not know its id: its row was waiting."""
    times = (command.session_id, command.finished_wall_time_s)
    return connection.execute(_BEGUN_BY, times).fetchone()[0]


def _observed_progress(
    command: Command, run: tuple[int, float, float, float], beat_s: float
) -> Progress:
    run_id, _, last_s, began_wall_s = run
    claimed_wall_s, to_s = command.claimed_wall_time_s or 0.0, max(last_s, beat_s)
    has_reset = began_wall_s >= claimed_wall_s
    from_s = 0.0 if has_reset else command.claimed_sim_time_s or 0.0
    wall_s = (command.finished_wall_time_s or time.time()) - max(claimed_wall_s, began_wall_s)
    if _params_of(command).get("reset") and not has_reset:
        to_s = from_s
    return Progress(run_id, from_s, to_s, pace(to_s - from_s, wall_s))


def progress_of(
    connection: sqlite3.Connection, command: Command
) -> tuple[float, float | None, str]:
    """Simulated seconds so far, the wanted ones (None without a limit), and a text."""
    progress = _progress_in(connection, command)
    until, for_s = (_params_of(command).get(name) for name in ("until", "for_s"))
    if progress.run_id is None:
        return 0.0, for_s, "waiting for the controller"
    of = f" of {for_s:g}" if for_s else ""
    word = f"{progress.advanced_s:.1f}{of} s simulated" + (f", until {until}" if until else "")
    return progress.advanced_s, for_s, word


def _result_of(command: Command) -> dict[str, Any]:
    """The bridge's result of a finished run; empty where there is none."""
    result = command.decoded_result()
    return cast("dict[str, Any]", result) if isinstance(result, dict) else {}


def _params_of(command: Command) -> Mapping[str, Any]:
    """The parameters of a command."""
    return json.loads(command.params)


# -- when it is over --------------------------------------------------------------------------


def run_facts(view: RobotView, command: Command) -> dict[str, Any]:
    """The facts of an answer about a `run` command: why it stopped, its progress, its events."""
    progress, result = _progress_in(view.connection, command), _result_of(command)
    stopped, why = _stop_reason(command, result)
    facts: dict[str, Any] = {"stopped": stopped, "stop_reason": why}
    if progress.run_id is None or stopped is None:
        return facts
    facts |= {
        "ran": {
            "run_id": progress.run_id,
            "from_s": seconds(progress.from_s),
            "to_s": seconds(progress.to_s),
            "advanced_s": seconds(progress.advanced_s),
            "factor": figure(progress.factor),
        },
        "values": shown(result.get("values")) if result.get("values") else None,
        "mode": result.get("mode"),
    }
    return facts | _what_happened(view, command, progress) if command.is_final else facts


def _stop_reason(command: Command, result: Mapping[str, Any]) -> tuple[str | None, str | None]:
    if command.status == "claimed":
        return "wall time limit reached", "it continues, and ends as requested"
    if command.status == "lost":
        return "run ended", command.error
    return result.get("ended"), result.get("why")


def _what_happened(view: RobotView, command: Command, progress: Progress) -> dict[str, Any]:
    """The state at the end, trends and events in between, and the rows before the end."""
    assert progress.run_id is not None
    subject = Subject(view.robot.id, view.robot.name, progress.run_id)
    end_s = progress.to_s + SAME_TIME_S
    facts: dict[str, Any] = {"rows": _last_rows(view, command, progress, end_s)}
    if state := state_at(view.connection, progress.run_id, end_s):
        facts |= _as_shown(state)
    scope = Scope(start_s=progress.from_s, end_s=max(progress.to_s, progress.from_s) + 0.001)
    try:
        asked = find_range(view.connection, scope, subject)
    except NothingRecordedError:
        return facts
    return facts | _in_between(view, command, asked)


def _as_shown(state: StateRecord) -> dict[str, Any]:
    short = shorten(state.value(), _STATE_TOKENS)
    return {"state": short.value, "state_at_s": seconds(state.sim_time_s), "shortened": short.rule}


def _in_between(view: RobotView, command: Command, asked: TimeRange) -> dict[str, Any]:
    (of_run,) = trends(view.connection, asked, limit=MOST_SIGNALS).runs
    found = search_events(view.connection, asked)
    of_others = found.only([each for each in found.events if not _is_own(each, command)])
    shown_events, events = fitting_events(of_others, _SHOWN_EVENTS, _EVENTS_TOKENS, view)
    return {
        "movement": movement(view, asked),
        "trends": trend_tables(of_run, _SHOWN_SIGNALS, _TRENDS_TOKENS)
        if of_run.rows or of_run.cut_at_s is not None
        else None,
        "events": events,
        "not_shown": not_shown_of(shown_events),
    }


def _is_own(event: Event, command: Command) -> bool:
    """Whether it is the command itself, or the pause that it began or ended."""
    if event.kind == "command":
        return event.details.get("id") == command.id
    data: dict[str, Any] = event.details.get("data") or {}
    return event.kind == "bridge_event" and data.get("command_id") == command.id


def _last_rows(view: RobotView, command: Command, progress: Progress, end_s: float) -> Any:
    """The last rows, of the condition's signals."""
    until = _params_of(command).get("until")
    rows = view.connection.execute(_LAST_ROWS, (progress.run_id, end_s, _ROWS_AROUND)).fetchall()
    if until is None or not rows:
        return None
    condition = parse_condition(until)
    names = condition.signals[:_MOST_COLUMNS]
    lines: list[list[Any]] = []
    for sim_time_s, data in reversed(rows):
        values = flatten(json.loads(data))
        lines.append(
            [seconds(sim_time_s), *(detailed(values.get(name), _CELL_TOKENS) for name in names)]
        )
    return table(("sim_time_s", *names), lines)


# -- the robot whose controller is to run a command --


def find_target(connection: sqlite3.Connection, robot: str | None, action: str) -> RobotView:
    """The robot that is to run an action.

    Without a name it is the only live robot; for what steers the simulation, the only live
    Supervisor.

    Raises:
        InvalidInputError: There is no such robot or action, or several robots are possible.
        CommandRefusedError: It cannot run it: it has no live controller, it is not a Supervisor, or
            another robot's bridge has paused the simulation.
        NothingRecordedError: No robot was ever recorded.
    """
    if robot is None and _needs_supervisor(action):
        robot = _only_supervisor(connection)
    view = view_robot(connection, robot)
    _require_action(view, action)
    session = _require_live(view)
    if _needs_supervisor(action) and not session.supervisor:
        raise CommandRefusedError(_who_may(view, session, action))
    _require_free(view, session, action)
    return view


def _needs_supervisor(action: str) -> bool:
    built_in = BUILT_IN_ACTIONS.get(action)
    return built_in is not None and built_in.needs_supervisor


def _only_supervisor(connection: sqlite3.Connection) -> str | None:
    robots = [robot for robot in list_robots(connection, time.time()) if robot.live]
    supervisors = [robot for robot in robots if robot.session and robot.session.supervisor]
    names = [robot.name for robot in without_observers(supervisors)]
    return names[0] if len(names) == 1 else None


def _require_action(view: RobotView, action: str) -> None:
    """Refuse an action that the controller does not know.

    Without registered actions nothing is refused: the loop may handle what get_command() returns.
    """
    known = list(view.session.actions) if view.session else []
    if not known or action in known or action in BUILT_IN_ACTIONS:
        return
    possible = [*known, *BUILT_IN_ACTIONS]
    near = perhaps_meant(action, possible)
    offer = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    raise UnknownActionError(
        f"robot {view.robot.name!r} has registered no action {action!r}; {offer}its own actions "
        f"are {known[:_SHOWN_ACTIONS]}, the built-in ones {list(BUILT_IN_ACTIONS)}"
    )


def _require_parameters(view: RobotView, action: str, params: Mapping[str, Any]) -> None:
    """Refuse parameters that do not fit a built-in action; the bridge would refuse them too."""
    built_in = BUILT_IN_ACTIONS.get(action)
    if built_in is None or (view.session and action in view.session.actions):
        return
    misfit = misfit_of_parameters(params, built_in.parameters, built_in.required, action)
    if misfit is not None:
        raise InvalidInputError(misfit)


def _require_live(view: RobotView) -> SessionRecord:
    """The robot's session; during a reload the old one, since its successor runs the command."""
    session = view.session
    if session is not None and not session.has_bridge:
        name, observer = view.robot.name, live_observer(view.connection, session, view.now_s)
        is_seen = view.robot.kind == CUSTOM_DATA
        how = "the observer records it from its customData" if is_seen else "it writes a journal"
        raise CommandRefusedError(
            f"robot {name!r} takes no commands: it has no bridge, {how}. In Python give its "
            "controller MCPBridge.attach(robot); the simulation is steered by an observer "
            f"({f'robot={observer.name!r}' if observer else _MAKE_OBSERVER})"
        )
    if session is not None and (view.robot.live or may_return(session, view.now_s)):
        return session
    raise CommandRefusedError(
        f"robot {view.robot.name!r} has no live controller: "
        f"{view.status.why or 'it was never seen'}; start it, then ask again"
    )


def _who_may(view: RobotView, session: SessionRecord, action: str) -> str:
    others = [s for s in companions(view.connection, session, view.now_s) if s.supervisor]
    next_step = _MAKE_ONE
    if others:
        name = robot_name(view.connection, others[0].robot_id)
        next_step = f"robot {name!r} is a Supervisor of this simulation: ask it (robot={name!r})"
        if action == "run":
            next_step += f"; for conditions and parameters of {view.robot.name!r}, {_MAKE_ONE}"
    return f"{action} needs a Supervisor and robot {view.robot.name!r} is not one: {next_step}"


def _require_free(view: RobotView, session: SessionRecord, action: str) -> None:
    """Refuse while another robot's bridge has paused the simulation: this loop cannot run then."""
    holder = find_holder(view.connection, session, view.now_s)
    if holder is None or holder.id == session.id:
        return
    name = robot_name(view.connection, holder.robot_id)
    raise CommandRefusedError(
        f"robot {view.robot.name!r} cannot run {action!r} now: the bridge of robot {name!r} has "
        f"paused their simulation; resume or step it there first (robot={name!r})"
    )
