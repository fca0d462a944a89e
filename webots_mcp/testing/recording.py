"""What a controller has recorded, as a test sees it: signals, states, events and commands."""

from __future__ import annotations

import json
import math
import sqlite3
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, Literal

from webots_mcp.analysis.summary import LARGEST
from webots_mcp.contract import LOG_LEVELS
from webots_mcp.database.connection import Role, connect, require_current, schema_version
from webots_mcp.database.location import Database
from webots_mcp.database.queue import Command, CommandQueue, fetch_command, list_commands
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.checks import CHECKS, check_run
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.detection.kinds import Event as FoundEvent
from webots_mcp.judging.detection.kinds import EventOptions
from webots_mcp.judging.divergence import compare_repeats
from webots_mcp.signals.conditions.compiler import read_expectation
from webots_mcp.signals.naming import Value
from webots_mcp.signals.parameter import Value as ParameterValue
from webots_mcp.store.export import StateTable
from webots_mcp.store.logs import LogFilter, LogLine, LogWindow, newest_lines
from webots_mcp.store.parameters import parameters_of
from webots_mcp.store.reading.catalogue import resolve_signals, signals_of_frame
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import Scope, find_range, find_subject, whole_run
from webots_mcp.store.reading.segment import Deadline, Subject
from webots_mcp.store.run_rows import EventRecord, StateRecord, newest_events, runs_of
from webots_mcp.store.signals import cleaned, registered

if TYPE_CHECKING:
    pass


# A signal as a test sees it: every recorded value, and what it never may have been.


_SHOWN_STATE_CHARACTERS: Final = 500
COMMAND_TIME_TO_LIVE_S: Final = 60.0  # a test on a busy machine is slower than a person
_NO_LIMIT: Final = -1
_UNFINISHED: Final = {
    "pending": "no get_command() of its controller has come to it yet",
    "claimed": "its handler has not returned yet",
}


class RecordedSignal:
    """One signal of one run, row by row.

    A row is what one `publish` recorded: with a `throttle_interval` above 1 there is none for the
    calls in between. A row without a value counts as None: the signal was not in it, was None, or
    could not be held (NaN, infinity).
    """

    def __init__(
        self,
        name: str,
        run: str,
        frame: Frame,
        values: Sequence[Value],
        state_of: Callable[[int], str],
    ) -> None:
        """Made by `Recording.signal`.

        Args:
            name: Dotted.
            run: How messages name the run.
            frame: The rows of the run.
            values: Those of this signal, one for each row.
            state_of: The JSON text of the state row with that id.
        """
        self.name = name
        self._run = run
        self._unread = "; ".join(map(str, frame.unread_of(name)))
        self._times: list[float] = frame.times.tolist()
        self._ids: list[int] = frame.ids.tolist()
        self._values = values
        self._state_of = state_of

    def __repr__(self) -> str:
        return f"<signal {self.name!r} of {self._run}: {len(self._values)} rows>"

    def values(self) -> list[Any]:
        """The value in each row, in order."""
        return list(self._values)

    def times_s(self) -> list[float]:
        """The simulation time of each row, in seconds."""
        return list(self._times)

    def changes(self) -> list[Any]:
        """The values without those that equal the one before: `["cruise", "turn", "cruise"]`."""
        later = [after for before, after in pairwise(self._values) if after != before]
        return [*self._values[:1], *later]

    @property
    def first(self) -> Any:
        """The value in the first row."""
        return self._values[0]

    @property
    def last(self) -> Any:
        """The value in the newest row."""
        return self._values[-1]

    def min(self) -> float:
        """The smallest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return min(self._numbers())

    def max(self) -> float:
        """The largest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return max(self._numbers())

    def at(self, time_s: float) -> Any:
        """The value in force at a simulation time: that of the newest row up to then.

        Raises:
            NothingRecordedError: The first row is younger.
        """
        row = sum(time <= time_s for time in self._times) - 1
        if row < 0:
            first_s = self._times[0]
            raise NothingRecordedError(
                f"{self._run} has no row up to {time_s:g} s: the first is at {first_s:g} s"
            )
        return self._values[row]

    def first_time_s(self, value: Value) -> float:
        """The simulation time of the first row with this value.

        Raises:
            NothingRecordedError: There is none; the text tells which values there are.
        """
        if value in self._values:
            return self._times[self._values.index(value)]
        seen = ", ".join(map(repr, list(dict.fromkeys(self._values))[:10]))
        raise NothingRecordedError(
            f"{self.name} was never {value!r} in the {len(self._values)} rows of {self._run}; "
            f"it was {seen}"
        )

    def duration_s(self, value: Value) -> float:
        """For how many simulated seconds it had this value; each row counts up to the next."""
        steps = pairwise(self._times)
        return sum(
            after_s - before_s
            for (before_s, after_s), held in zip(steps, self._values, strict=False)
            if held == value
        )

    def assert_never(self, value: Value) -> None:
        """Fail if a row holds this value.

        Raises:
            AssertionError: With when, how often, and the whole state at the first time.
        """
        bad = [row for row, held in enumerate(self._values) if held == value]
        self._fail_at(bad, f"was {value!r}", bad[0] if bad else 0)

    def assert_never_below(self, limit: float) -> None:
        """Fail if a row holds a number under the limit, or none holds a number.

        Raises:
            AssertionError: With when, how often, how far, and the whole state at the first time.
        """
        self._assert_each(lambda number: number < limit, f"fell below {limit:g}", min)

    def assert_never_above(self, limit: float) -> None:
        """Fail if a row holds a number over the limit, or none holds a number.

        Raises:
            AssertionError: With when, how often, how far, and the whole state at the first time.
        """
        self._assert_each(lambda number: number > limit, f"rose above {limit:g}", max)

    def _assert_each(
        self,
        is_bad: Callable[[float], bool],
        what: str,
        worst_of: Callable[[list[float]], float],
    ) -> None:
        numbers = self._usable
        if not numbers:
            raise AssertionError(f"{self._no_number()}, so nothing shows that it never {what}")
        bad = {row: number for row, number in numbers.items() if is_bad(number)}
        worst = worst_of(list(bad.values())) if bad else 0.0
        self._fail_at(list(bad), what, next((row for row in bad if bad[row] == worst), 0))

    def _fail_at(self, bad: Sequence[int], what: str, worst: int) -> None:
        if not bad and self._unread:
            raise AssertionError(
                f"{self.name} of {self._run} was {self._unread}: nothing shows that it never {what}"
            )
        if not bad:
            return
        times, values, first = self._times, self._values, bad[0]
        lines = [f"{self.name} {what} in {len(bad)} of {len(values)} rows of {self._run}"]
        lines += [f"first at {times[first]:g} s: {_shown(values[first])}"]
        if worst != first:
            lines += [f"furthest at {times[worst]:g} s: {_shown(values[worst])}"]
        state = self._state_of(self._ids[first])
        cut = " ..." if len(state) > _SHOWN_STATE_CHARACTERS else ""
        lines += [f"the state at {times[first]:g} s: {state[:_SHOWN_STATE_CHARACTERS]}{cut}"]
        raise AssertionError("\n  ".join(lines))

    def _numbers(self) -> Sequence[float]:
        numbers = self._usable
        if not numbers or self._unread:
            why = f"{self.name} of {self._run} was {self._unread}" if numbers else self._no_number()
            raise NothingRecordedError(why)
        return list(numbers.values())

    @property
    def _usable(self) -> dict[int, float]:
        """The numbers by their rows, flags as 0 and 1; not NaN, nor beyond 1e100."""
        return {
            row: float(value)
            for row, value in enumerate(self._values)
            if isinstance(value, int | float) and abs(value) <= LARGEST
        }

    def _no_number(self) -> str:
        why = f" ({self._unread})" if self._unread else ""
        rows = f"the {len(self._values)} rows of {self._run}"
        return f"{self.name} holds no number in {rows}{why}"


def _shown(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


# What a robot recorded, as a test asks about it, and the commands that a test sends.


class RobotRecording:
    """A database of a test, read anew with each question.

    Questions are about the newest run of the only robot; `robot` and `runs` narrow that down.
    """

    def __init__(
        self, database: Database, *, robot: str | None = None, run_id: int | None = None
    ) -> None:
        """Nothing is opened yet: the robot may begin to record later.

        Args:
            database: A file, or a database in memory.
            robot: Whose recording; None for the only robot's.
            run_id: Which run; None for the newest at the time of the question.
        """
        self.database = database
        self._robot = robot
        self._run_id = run_id

    def robot(self, name: str) -> RobotRecording:
        """What the robot of that name recorded."""
        return RobotRecording(self.database, robot=name)

    def runs(self) -> list[RobotRecording]:
        """The recording of each run of the robot, oldest first: a reset begins the next one."""
        with self._subject() as (connection, subject):
            runs = runs_of(connection, subject.robot_id)
        return [RobotRecording(self.database, robot=subject.robot, run_id=run.id) for run in runs]

    # -- what was published --------------------------------------------------------------------

    def signal(self, name: str) -> RecordedSignal:
        """The signal with this dotted name: `mode`, `pose.0`, `sensors.front`.

        Raises:
            UnknownSignalError: It was never published; the text offers near names.
            InvalidInputError: The name means several signals.
            NoDatabaseError, NothingRecordedError: Nothing has been recorded yet.
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
        """The signals of the run whose names match, with `*` for any characters.

        Raises:
            UnknownSignalError: None matches.
            NoDatabaseError, NothingRecordedError: Nothing has been recorded yet.
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
        """What was published, row by row; "nan", "inf" and the like where JSON holds null.

        Rows that retention has deleted come from their chunks, without long arrays and texts.

        Raises:
            NothingRecordedError: Not all of them are there any more.
        """
        with self._subject() as (connection, subject):
            source = _source(connection, subject.run_id)
            states = [row.value() for row in _rows(source) if row.id > 0]
            run = f"run {subject.run_id} of robot {subject.robot!r}"
            _require_all(run, [unread for each in source.purged for unread in each.unread])
        return states

    # -- what happened -------------------------------------------------------------------------

    def events(self, kind: str | None = None) -> list[EventRecord]:
        """What the bridge noticed in the run, in order: all, or those of a kind (`pause`, ...)."""
        with self._subject() as (connection, subject):
            found = newest_events(connection, subject.run_id, _NO_LIMIT)
        return [event for event in found if kind in (None, event.kind)]

    def find_events(self, *kinds: str, **options: Any) -> list[FoundEvent]:
        """What the values of the run show: when it was stuck, where a signal jumped, and the like.

        Args:
            kinds: `standstill`, `stuck`, `jump`, `oscillation`, `missing`, `gap`, ...; none for all
                but pictures.
            options: More fields of `webots_mcp.judging.detection.kinds.EventOptions`.

        Raises:
            InvalidInputError: There is no such kind.
            NothingRecordedError: A named kind could not be looked for: without a position, say,
                nobody knows whether the robot was stuck, and an empty list would claim to. Or not
                all of the run could be read.
        """
        wanted = EventOptions(kinds=kinds, **options)
        with self._subject() as (connection, subject):
            whole = find_range(connection, Scope(), subject)
            found = find_events(
                connection, whole, wanted, limit=sys.maxsize, group=False, deadline_s=math.inf
            )
        for kind in kinds:
            if (why := found.verdicts.unlooked(kind)) is not None:
                raise NothingRecordedError(f"{kind} could not be looked for: {why}")
        unread = [each for kind in found.verdicts.reasons for each in found.verdicts.unread(kind)]
        _require_all(f"run {subject.run_id} of robot {subject.robot!r}", unread)
        return list(found.events)

    def held(self, condition: str) -> list[FoundEvent]:
        """The stretches of the run in which a condition held, as `front_m < 0.1 for 0.5`.

        Raises:
            InvalidInputError: The condition is not of the language in docs/conditions.md, or cannot
                be asked of the values.
            UnknownSignalError: It names a signal that was never published.
        """
        return self.find_events("condition", where=condition)

    def assert_well(self, *expect: str, allow: Sequence[str] = ()) -> None:
        """Fail if a check of the run fails, or could not look at all of the run.

        Args:
            expect: What shall hold besides what the controller expects, as
                `front_m > 0.1 during mode == 'drive'`.
            allow: Names of checks that may fail.

        Raises:
            AssertionError: With the evidence of each check that failed.
            InvalidInputError: An expectation is not of the language, or there is no such check.
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
        """The lines that were logged in the run, in order.

        Args:
            level: `debug`, `info`, `warning`, `error` or `critical`: this one and those above it.
            text: Part of the line.

        Raises:
            InvalidInputError: There is no such level.
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
        """Fail unless each run of the robot is the same as its first one, row by row.

        A reset begins the next run; so does another simulation with the same `data_dir`.

        Args:
            until_s: The last simulation time that is compared.
            within: So much may numbers differ, each in its own unit; texts and flags never.
            signals: Names, with `*`; those of no wall clock.

        Raises:
            AssertionError: With from when on they part, in which signal, and how far; or nothing
                shows it: there is one run, it ends before, or not all of it could be compared.
            UnknownSignalError: A name matches none.
            NoDatabaseError, NothingRecordedError: Nothing has been recorded yet.
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
        """The commands to the robot, oldest first: all, or those of an action."""
        with self._subject() as (connection, subject):
            found = list_commands(connection, subject.robot_id, limit=_NO_LIMIT)
        kept = [command for command in reversed(found) if action in (None, command.action)]
        return [RecordedCommand(self.database, command.id) for command in kept]

    def send(self, action: str, /, **params: Any) -> RecordedCommand:
        """Send the robot a command; it runs in the controller's next `get_command()`.

        Args:
            action: Built in (`pause`, `reset`, ...) or registered by the controller.
            params: Its parameters: plain JSON.

        Raises:
            NoDatabaseError, NothingRecordedError: The robot's bridge was not started yet.
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
        """The parameters of the run with their last values."""
        with self._subject() as (connection, subject):
            found = parameters_of(connection, [subject.run_id])[subject.run_id]
        return {name: parameter.value for name, parameter in found.items()}

    def set_parameters(
        self, values: Mapping[str, ParameterValue], *, when: Literal["now", "reset"] = "now"
    ) -> RecordedCommand:
        """Set parameters of the robot, all or none: in the controller's next `get_command()`.

        Args:
            values: By name.
            when: "reset" for the next reset of the world.
        """
        return self.send("set_parameters", values=dict(values), when=when)

    # -- inside --------------------------------------------------------------------------------

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
    """The rows of a run, in order; those that were deleted come from their chunks."""
    return (StateRecord(row.state_id, row.run_id, *row[2:]) for row in source.recorded())


class CommandStatus(str):
    """A command's status; wherever an assertion shows it, it says why it is not `done`."""

    reason: str

    def __new__(cls, status: str, reason: str) -> CommandStatus:
        """A text as any other, with the reason beside it."""
        made = super().__new__(cls, status)
        made.reason = reason
        return made

    def __repr__(self) -> str:
        return f"{str(self)!r} ({self.reason})" if self.reason else f"{str(self)!r}"


class RecordedCommand:
    """A command in the queue; `status`, `result` and `error` are read anew each time."""

    def __init__(self, database: Database, command_id: int) -> None:
        self._database = database
        self.id = command_id

    def __repr__(self) -> str:
        command = self._fetch()
        fate = command.error if command.result is None else command.result
        return f"<command {self.id}: {command.action} {command.params}, {command.status}, {fate}>"

    @property
    def action(self) -> str:
        """What was asked."""
        return self._fetch().action

    @property
    def params(self) -> dict[str, Any]:
        """With which parameters."""
        return json.loads(self._fetch().params)

    @property
    def status(self) -> CommandStatus:
        """`pending`, `claimed`, then `done`, `failed`, `expired`, `cancelled` or `lost`."""
        command = self._fetch()
        return CommandStatus(command.status, _why_not_done(command))

    @property
    def is_final(self) -> bool:
        """Whether its fate is settled."""
        return self._fetch().is_final

    @property
    def result(self) -> Any:
        """What the handler answered; None before that."""
        text = self._fetch().result
        return None if text is None else json.loads(text)

    @property
    def error(self) -> str | None:
        """Why it failed, or what of its result had to be replaced; else None."""
        return self._fetch().error

    def _fetch(self) -> Command:
        with closing(connect(self._database, "reader")) as connection:
            return fetch_command(connection, self.id)


def _why_not_done(command: Command) -> str:
    """What a person has to know of a command that is not done; empty for one that is."""
    if command.status == "done":
        return ""
    return command.error or _UNFINISHED.get(command.status, "")
