"""The recording of a robot as a test sees it: signals, states, events and commands."""

from __future__ import annotations

import math
import sqlite3
import sys
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import Any, Final, Literal

from webots_mcp.contract import LOG_LEVELS
from webots_mcp.database.connection import Role, connect
from webots_mcp.database.location import Database
from webots_mcp.database.queue import CommandQueue, list_commands
from webots_mcp.database.schema import require_current, schema_version
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.checks.check_run import CHECKS, check_run
from webots_mcp.judging.detection.event import Event as FoundEvent
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.divergence import compare_repeats
from webots_mcp.signals.conditions.expectation import read_expectation
from webots_mcp.signals.parameter import Value as ParameterValue
from webots_mcp.store.export import StateTable
from webots_mcp.store.logs import LogFilter, LogLine, LogWindow, newest_lines
from webots_mcp.store.reading.catalogue import resolve_signals, signals_of_frame
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, find_range, find_subject, whole_run
from webots_mcp.store.reading.segment import Deadline, Subject
from webots_mcp.store.registered_signals import cleaned, registered
from webots_mcp.store.run_parameters import parameters_of
from webots_mcp.store.run_rows import EventRecord, StateRecord, newest_events, runs_of
from webots_mcp.testing.recorded_command import RecordedCommand
from webots_mcp.testing.recorded_signal import RecordedSignal

COMMAND_TIME_TO_LIVE_S: Final = 60.0  # Long enough for tests on a busy machine.
_NO_LIMIT: Final = -1


class RobotRecording:
    """The recording of a robot in a database, read anew with each call.

    Calls refer to the newest run of the only robot; `robot` and `runs` select others.
    """

    def __init__(
        self, database: Database, *, robot: str | None = None, run_id: int | None = None
    ) -> None:
        """Open nothing yet: the robot may begin to record later.

        Args:
            database: A file, or a database in memory.
            robot: Name of the robot; None for the only robot.
            run_id: Id of the run; None for the newest at the time of each call.
        """
        self.database = database
        self._robot = robot
        self._run_id = run_id

    def robot(self, name: str) -> RobotRecording:
        """Return the recording of the robot with this name."""
        return RobotRecording(self.database, robot=name)

    def runs(self) -> list[RobotRecording]:
        """Return the recording of each run of the robot, oldest first. A reset begins a new run."""
        with self._subject() as (connection, subject):
            runs = runs_of(connection, subject.robot_id)
        return [RobotRecording(self.database, robot=subject.robot, run_id=run.id) for run in runs]

    # -- what was published --------------------------------------------------------------------

    def signal(self, name: str) -> RecordedSignal:
        """Return the signal with this dotted name: `mode`, `pose.0`, `sensors.front`.

        Raises:
            UnknownSignalError: It was never published. The text offers similar names.
            InvalidInputError: The name matches several signals.
            NoDatabaseError: Nothing was recorded yet.
            NothingRecordedError: Nothing was recorded yet.
        """
        found = self.signals(name)
        if len(found) > 1:
            names = ", ".join(signal.name for signal in found[:10])
            raise InvalidInputError(
                f"{name!r} means {len(found)} signals: {names}; name one, or loop over "
                f"signals({name!r})"
            )
        return found[0]

    def signals(self, pattern: str = "*") -> list[RecordedSignal]:
        """Return the signals of the run whose names match, with `*` for any characters.

        Raises:
            UnknownSignalError: None matches.
            NoDatabaseError: Nothing was recorded yet.
            NothingRecordedError: Nothing was recorded yet.
        """
        with self._subject() as (connection, subject):
            run = f"run {subject.run_id} of robot {subject.robot!r}"
            segment = whole_run(connection, subject.run_id)
            if segment is None:
                resolve_signals(registered(connection, subject.robot_id), [pattern])
                raise NothingRecordedError(f"{run} has no state row: was publish() called?")
            frame = read_frame(connection, segment, Deadline(math.inf))
            meant = resolve_signals(signals_of_frame(connection, subject, frame), [pattern])
            state_of = partial(self._state, subject.run_id)
            return [
                RecordedSignal(
                    each.name, run, frame, cleaned(each, frame.values(each.name)), state_of
                )
                for each in meant
            ]

    def states(self) -> list[dict[str, Any]]:
        """Return what was published, row by row, with "nan", "inf" etc. where JSON holds null.

        Rows that retention has deleted come from chunks, without long arrays and texts.

        Raises:
            NothingRecordedError: Some of the rows no longer exist.
        """
        with self._subject() as (connection, subject):
            source = _source(connection, subject.run_id)
            states = [row.value() for row in _rows(source) if row.id > 0]
            run = f"run {subject.run_id} of robot {subject.robot!r}"
            _require_all(run, [unread for each in source.purged for unread in each.unread])
        return states

    # -- what happened -------------------------------------------------------------------------

    def events(self, kind: str | None = None) -> list[EventRecord]:
        """Return the events that the bridge stored in the run, all or of a kind (`pause`, ...)."""
        with self._subject() as (connection, subject):
            found = newest_events(connection, subject.run_id, _NO_LIMIT)
        return [event for event in found if kind in (None, event.kind)]

    def find_events(self, *kinds: str, **options: Any) -> list[FoundEvent]:
        """Search the values of the run: when it was stuck, where a signal jumped, and more.

        Args:
            kinds: `standstill`, `stuck`, `jump`, `oscillation`, `missing`, `gap`, ...; without any,
                all kinds except pictures.
            options: Other fields of `webots_mcp.judging.detection.event_options.EventOptions`.

        Raises:
            InvalidInputError: A kind is unknown.
            NothingRecordedError: A given kind could not be searched, for example `stuck` without a
                position, where an empty list would be wrong. Or not all of the run could be read.
        """
        wanted = EventOptions(kinds=kinds, **options)
        with self._subject() as (connection, subject):
            whole = find_range(connection, Scope(), subject)
            found = find_events(
                connection, whole, wanted, limit=sys.maxsize, group=False, deadline_s=math.inf
            )
        for kind in kinds:
            if (why := found.verdicts.why_unsearched(kind)) is not None:
                raise NothingRecordedError(f"{kind} could not be looked for: {why}")
        unread = [each for kind in found.verdicts.reasons for each in found.verdicts.unread(kind)]
        _require_all(f"run {subject.run_id} of robot {subject.robot!r}", unread)
        return list(found.events)

    def held(self, condition: str) -> list[FoundEvent]:
        """Return the segments of the run in which a condition held: `front_m < 0.1 for 0.5`.

        Raises:
            InvalidInputError: The condition is not in the language of
                'webots-mcp help conditions', or cannot be applied to the values.
            UnknownSignalError: It names a signal that was never published.
        """
        return self.find_events("condition", where=condition)

    def assert_well(self, *expect: str, allow: Sequence[str] = ()) -> None:
        """Fail if a check of the run fails, or could not read all of the run.

        Args:
            expect: Expectations in addition to those of the controller, such as
                `front_m > 0.1 during mode == 'drive'`.
            allow: Names of checks that may fail.

        Raises:
            AssertionError: A check failed. The text has its evidence.
            InvalidInputError: An expectation is invalid, or a check is unknown.
            UnknownSignalError: An expectation names a signal that was never published.
        """
        names = [check.name for check in CHECKS]
        for name in allow:
            if name not in names:
                raise InvalidInputError(f"no check {name!r}; there is {', '.join(names)}")
        expected = [read_expectation(each) for each in expect]
        with self._subject() as (connection, subject):
            checked = check_run(connection, subject.run_id, expect=expected, deadline_s=math.inf)
        bad = [each for each in checked.of("fail", "not looked at") if each.name not in allow]
        if bad:
            lines = [f"{each.name}: {each.evidence}" for each in bad]
            run = f"run {subject.run_id} of robot {subject.robot!r} is not well"
            raise AssertionError("\n  ".join([run, *lines]))

    def logs(self, level: str = "debug", text: str = "") -> list[LogLine]:
        """Return the log lines of the run, in order.

        Args:
            level: Minimum level: `debug`, `info`, `warning`, `error` or `critical`.
            text: Text that the line contains.

        Raises:
            InvalidInputError: The level is unknown.
        """
        if level not in LOG_LEVELS:
            raise InvalidInputError(f"no log level {level!r}; there is {', '.join(LOG_LEVELS)}")
        with self._subject() as (connection, subject):
            window = LogWindow(-math.inf, math.inf)
            asked = LogFilter(subject.run_id, window, text, lowest_level=level)
            return newest_lines(connection, asked, _NO_LIMIT)

    def assert_repeats(
        self, *, until_s: float = math.inf, within: float = 0.0, signals: Sequence[str] = ("*",)
    ) -> None:
        """Fail unless each run of the robot equals its first run, row by row.

        A reset begins a new run; so does another simulation with the same `data_dir`.

        Args:
            until_s: Simulation time up to which runs are compared.
            within: Tolerance of numbers, each in its own unit. Texts and flags must be equal.
            signals: Names of signals to compare, with `*`. Leave out those of a wall clock.

        Raises:
            AssertionError: Runs diverge. The text has the time, the signal and the difference. Or
                they cannot be compared: there is one run, or one ends before `until_s`.
            UnknownSignalError: A name matches no signal.
            NoDatabaseError: Nothing was recorded yet.
            NothingRecordedError: Nothing was recorded yet.
        """
        with self._subject() as (connection, subject):
            run_ids = [run.id for run in runs_of(connection, subject.robot_id)]
            if len(run_ids) < 2:
                raise AssertionError(f"run {run_ids[0]} is the only one: reset() begins another")
            options = {"within": within, "names": signals, "deadline_s": math.inf}
            found = compare_repeats(connection, run_ids, until_s=until_s, **options)
        for each in found:
            if not each.is_whole or any(one.beyond_s is not None for one in each.parted):
                why = "run {1} does not repeat run {0}: ".format(*each.run_ids) + each.verdict
                raise AssertionError("\n  ".join([why, *each.notes]))

    # -- commands ------------------------------------------------------------------------------

    def commands(self, action: str | None = None) -> list[RecordedCommand]:
        """Return the commands to the robot, oldest first: all, or those of an action."""
        with self._subject() as (connection, subject):
            found = list_commands(connection, subject.robot_id, limit=_NO_LIMIT)
        kept = [command for command in reversed(found) if action in (None, command.action)]
        return [RecordedCommand(self.database, command.id) for command in kept]

    def send(self, action: str, /, **params: Any) -> RecordedCommand:
        """Send the robot a command, which runs in the controller's next `get_command()`.

        Args:
            action: A built-in action (`pause`, `reset`, ...) or one that the controller registered.
            params: Parameters of the action: JSON values.

        Raises:
            NoDatabaseError: The robot's bridge was not started yet.
            NothingRecordedError: The robot's bridge was not started yet.
        """
        with self._subject("writer") as (connection, subject):
            command = CommandQueue(connection).enqueue(
                subject.robot_id,
                action,
                params,
                time_to_live_s=COMMAND_TIME_TO_LIVE_S,
                requested_by="test",
            )
        return RecordedCommand(self.database, command.id)

    # -- parameters ----------------------------------------------------------------------------

    def parameters(self) -> dict[str, ParameterValue]:
        """Return the parameters of the run with their last values."""
        with self._subject() as (connection, subject):
            found = parameters_of(connection, [subject.run_id])[subject.run_id]
        return {name: parameter.value for name, parameter in found.items()}

    def set_parameters(
        self, values: Mapping[str, ParameterValue], *, when: Literal["now", "reset"] = "now"
    ) -> RecordedCommand:
        """Set parameters of the robot, all or none, in the controller's next `get_command()`.

        Args:
            values: Values by name.
            when: "now", or "reset" for the next reset of the world.
        """
        return self.send("set_parameters", values=dict(values), when=when)

    # -- details -------------------------------------------------------------------------------

    @contextmanager
    def _subject(self, role: Role = "reader") -> Generator[tuple[sqlite3.Connection, Subject]]:
        with closing(self._connect(role)) as connection:
            yield connection, find_subject(connection, self._robot, self._run_id)

    def _connect(self, role: Role) -> sqlite3.Connection:
        connection = connect(self.database, role)
        if schema_version(connection) == 0:
            connection.close()
            raise NothingRecordedError(
                "no bridge has opened this database yet: make an MCPBridge on it, or let the "
                "simulation run first"
            )
        require_current(connection)
        return connection

    def _state(self, run_id: int, state_id: int) -> str:
        with closing(self._connect("reader")) as connection:
            rows = _rows(_source(connection, run_id))
            return next((row.data for row in rows if row.id == state_id), "deleted since")


def _require_all(run: str, unread: Iterable[object]) -> None:
    if missing := "; ".join(dict.fromkeys(map(str, unread))):
        raise NothingRecordedError(f"of {run} not all is there: {missing}")


def _source(connection: sqlite3.Connection, run_id: int) -> StateTable:
    segment = whole_run(connection, run_id)
    return StateTable.of(connection, [segment] if segment else [], 1, None)


def _rows(source: StateTable) -> Iterator[StateRecord]:
    """Return the rows of a run, in order; deleted ones come from their chunks."""
    return (StateRecord(row.state_id, row.run_id, *row[2:]) for row in source.recorded())
