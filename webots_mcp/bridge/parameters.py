"""The parameters of a controller: declared in its code, set from outside between two rounds."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any, Final, Generic, NamedTuple, TypeVar, cast

from webots_mcp.bridge.claimed_commands import Handlers
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock
from webots_mcp.contract import PARAMETERS_VARIABLE, recorded_name
from webots_mcp.database.tapes import tape_notes
from webots_mcp.database.waiting_file import Kind, Values
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError
from webots_mcp.signals.parameter import MOST_PARAMETERS, Declaration, Value, require_known

MOST_CHANGES: Final = 10_000  # in one run; each is a row of the database

V = TypeVar("V", float, int, bool, str)
SETTERS: Final = ("command", "trial")  # the kinds that a command may name


class Parameter(Generic[V]):
    """A value that an assistant may set; created by `MCPBridge.parameter`.

    Attributes:
        name: Its name.
        value: The current value. Reading it is a plain attribute access. It changes only inside
            `get_command()` and when the world is reset, never within a round of the loop.
    """

    __slots__ = ("_set", "name", "value")

    name: str
    value: V

    def __init__(self, name: str, value: V, set_later: Callable[[str, object], None]) -> None:
        for attribute, held in (("name", name), ("value", value), ("_set", set_later)):
            object.__setattr__(self, attribute, held)

    def set(self, value: V) -> None:
        """Set it from the controller's own code, with effect from the next `get_command()`.

        In a handler of `register_command` it is set at once; there an invalid value raises, which
        becomes the command's error. Elsewhere an invalid value is warned of and ignored.
        """
        self._set(self.name, value)

    def __setattr__(self, attribute: str, value: object) -> None:
        raise AttributeError(
            f"{attribute} of parameter {self.name!r} cannot be assigned: call its set(), which "
            "takes effect with the next get_command()"
        )

    def __repr__(self) -> str:
        return f"<parameter {self.name} = {self.value!r}>"


class Setter(NamedTuple):
    """Who set a value: `code`, `environment`, `command` or `trial`, and by which command."""

    kind: str
    command_id: int | None = None


def setter_of(params: dict[str, Any], command_id: int) -> Setter:
    """Return who sets the parameters: the command itself, or the trial that sent it."""
    by = params.get("by")
    return Setter(by if by in SETTERS else "command", command_id)


class _Held:
    """A declared parameter, and who set its value."""

    __slots__ = ("declaration", "parameter", "setter")

    def __init__(self, declaration: Declaration, parameter: Any, setter: Setter) -> None:
        self.declaration = declaration
        self.parameter = parameter
        self.setter = setter

    @property
    def value(self) -> Value:
        return self.parameter.value

    def set(self, value: Value, setter: Setter) -> None:
        object.__setattr__(self.parameter, "value", value)
        self.setter = setter

    def row(self) -> tuple[object, ...]:
        """Return the row for the statement "parameter values"."""
        is_default = self.value == self.declaration.default
        value = json.dumps(self.value, ensure_ascii=False)
        return (self.declaration.name, value, int(is_default), *self.setter)


CODE: Final = Setter("code")
_ENVIRONMENT: Final = Setter("environment")
_REPLAYED: Final = Setter("command")


class Parameters:
    """Holds the declared parameters, changes their values, and records each change.

    Args:
        robot_name: The robot for which the environment may have values.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        handlers: Handlers,
        errors: ErrorReport,
        robot_name: str,
    ) -> None:
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._handlers = handlers
        self._errors = errors
        self._start_values = StartValues(robot_name, errors)
        self._held: dict[str, _Held] = {}
        self._wanted: dict[str, Value] = {}
        self._from_reset: dict[str, tuple[Value, Setter]] = {}
        self._changes = 0
        recorder.new_database_entries.append(self._entries_for_new_database)

    def declare(self, declaration: Declaration) -> Parameter[Any]:
        """Return the parameter of that name, created or updated to this declaration.

        Raises:
            ValueError: If there are 500 parameters already.
        """
        held = self._held.get(declaration.name)
        if held is None:
            held = self._enter(declaration)
        elif held.declaration != declaration:
            self._redeclare(held, declaration)
        else:
            return held.parameter
        self._recorder.record("parameter", None, {**declaration.as_row(), "now": time.time()})
        self._record_values([held])
        return held.parameter

    def set_now(
        self, values: Mapping[str, object], setter: Setter
    ) -> dict[str, tuple[Value, Value]]:
        """Set several, all or none; return the old and the new value of each.

        Raises:
            InvalidInputError: If a name is unknown or a value is invalid; then none is set.
            CommandRefusedError: If there were too many changes in this run.
        """
        checked = self._checked(values)
        before = {name: self._held[name].value for name in checked}
        changed = [name for name, value in checked.items() if value != before[name]]
        if self._changes + len(changed) > MOST_CHANGES:
            raise CommandRefusedError(
                f"at most {MOST_CHANGES} changes of parameters are recorded in one run: reset the "
                "world, which begins a new run"
            )
        self._changes += len(changed)
        for name in changed:
            self._held[name].set(checked[name], setter)
        self._record_values([self._held[name] for name in changed])
        return {name: (before[name], value) for name, value in checked.items()}

    def set_from_reset(
        self, values: Mapping[str, object], setter: Setter
    ) -> dict[str, tuple[Value, Value]]:
        """Set several at the next reset, all or none; return each value now and from then on.

        Raises:
            InvalidInputError: If a name is unknown or a value is invalid; then none is set.
        """
        checked = self._checked(values)
        self._from_reset |= {name: (value, setter) for name, value in checked.items()}
        self._record_next(checked)
        return {name: (self._held[name].value, value) for name, value in checked.items()}

    def _set_from_code(self, name: str, value: object) -> None:
        """Set a parameter from the controller's code: at once in a handler, else at the next call.

        Within a round of the loop values must not change, so it waits for `get_command()` there.
        """
        if self._handlers.running:
            self.set_now({name: value}, CODE)
            return
        try:
            self._wanted |= self._checked({name: value})
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("Parameter.set", error)

    def take_replayed(self, values: Mapping[str, object]) -> None:
        """Set what was set from outside in this round of the run that is replayed."""
        known = {name: value for name, value in values.items() if name in self._held}
        try:
            self.set_now(known, _REPLAYED)
        except WebotsMCPError as error:
            self._errors.failed("a replayed parameter", error)

    def take_wanted(self) -> None:
        """Apply what the controller's code has set since the last `get_command()`."""
        if self._held:
            self._start_values.warn_of_unknown(self._held)
        if self._wanted:
            wanted, self._wanted = self._wanted, {}
            try:
                self.set_now(wanted, CODE)
            except WebotsMCPError as error:
                self._errors.failed("Parameter.set", error)

    def begin_run(self) -> None:
        """Apply the values that waited for this reset of the world, and record all values."""
        self._changes = 0
        waiting, self._from_reset = self._from_reset, {}
        for name, (value, setter) in waiting.items():
            self._held[name].set(value, setter)
        self._record_values(list(self._held.values()))
        self._record_next(dict.fromkeys(waiting))

    def _entries_for_new_database(self) -> Iterable[tuple[Kind, bool, Values]]:
        """Yield the entries for a new database: kind, whether it belongs to the run, values."""
        held = tuple(self._held.values())  # a copy: the maintainer's thread may be the caller
        for each in held:
            yield "parameter", False, {**each.declaration.as_row(), "now": time.time()}
        if held:
            yield "parameter values", True, self._values_of(held)
        if waiting := dict(self._from_reset):
            yield "parameter next", False, _next({name: each[0] for name, each in waiting.items()})

    def _enter(self, declaration: Declaration) -> _Held:
        if len(self._held) >= MOST_PARAMETERS:
            raise ValueError(
                f"parameter {declaration.name!r} would be number {MOST_PARAMETERS + 1}, and a "
                f"controller may have {MOST_PARAMETERS}; store other data in a file"
            )
        value, setter = declaration.default, CODE
        given = self._start_values.take(declaration)
        if given is not None:
            value, setter = given, _ENVIRONMENT
        parameter = Parameter[Any](declaration.name, value, self._set_from_code)
        held = self._held[declaration.name] = _Held(declaration, parameter, setter)
        return held

    def _redeclare(self, held: _Held, declaration: Declaration) -> None:
        """Update a declaration; a value set from outside is retained where it is still valid."""
        is_default = held.setter is CODE and held.value == held.declaration.default
        self._journal.log("warning", "bridge", _declared_anew(held.declaration, declaration))
        held.declaration = declaration
        self._from_reset.pop(declaration.name, None)
        self._wanted.pop(declaration.name, None)
        if is_default:
            held.set(declaration.default, CODE)
            return
        try:
            held.set(declaration.checked(held.value), held.setter)
        except WebotsMCPError as error:
            why = f"{error}; the declaration was changed, so its default is used"
            held.set(declaration.default, CODE)
            self._recorder.errors.warn(f"parameter {declaration.name}", why)

    def _checked(self, values: Mapping[str, object]) -> dict[str, Value]:
        require_known(list(values), list(self._held))
        return {name: self._held[name].declaration.checked(each) for name, each in values.items()}

    def _record_values(self, held: list[_Held]) -> None:
        if held:
            self._recorder.record("parameter values", self._clock.run, self._values_of(held))
            if tape_notes.note is not None:  # what the code itself sets, a replay sets again
                given = {each.parameter.name: each.value for each in held if each.setter != CODE}
                tape_notes.note("parameters", given)

    def _values_of(self, held: Iterable[_Held]) -> dict[str, Any]:
        rows = json.dumps([each.row() for each in held], ensure_ascii=False)
        return {"sim_time": self._clock.sim_time_s, "now": time.time(), "rows": rows}

    def _record_next(self, values: Mapping[str, Value | None]) -> None:
        if values:
            self._recorder.record("parameter next", None, _next(values))


def _declared_anew(before: Declaration, now: Declaration) -> str:
    """Return the log line of a changed declaration: two parameters may share a name by mistake."""
    pairs = zip(before._asdict().items(), now._asdict().values(), strict=True)
    changed = [f"{name} {new!r}, not {old!r}" for (name, old), new in pairs if new != old]
    return (
        f"parameter {now.name!r} is declared again, with {', '.join(changed)}: the last "
        "declaration is used for both"
    )


def _next(values: Mapping[str, Value | None]) -> dict[str, Any]:
    """Return the values of the statement "parameter next"."""
    rows = [
        (name, None if value is None else json.dumps(value, ensure_ascii=False))
        for name, value in values.items()
    ]
    return {"rows": json.dumps(rows, ensure_ascii=False)}


class StartValues:
    """The value of `WEBOTS_MCP_PARAMETERS`: a JSON object of values by the names of parameters.

    An object under the name of a robot holds values for that robot alone:
    `{"kp": 3.0, "rover": {"kp": 4.0}}`. For a value that cannot be used a warning is printed, and
    the code's value is used.

    Args:
        robot: The name of this robot.
        errors: Receives a warning for each value that cannot be used.
    """

    def __init__(self, robot: str, errors: ErrorReport) -> None:
        self._text = text = os.environ.get(PARAMETERS_VARIABLE)
        self._robot = robot
        self._errors = errors
        self._values: dict[str, Any] | None = None
        self._unknown_reported = not text

    def take(self, declaration: Declaration) -> Value | None:
        """Return the first value of a parameter; None for the one in the code."""
        values = self._read()
        if declaration.name not in values:
            return None
        try:
            return declaration.checked(values[declaration.name])
        except InvalidInputError as error:
            self._warn(declaration.name, f"{error}; it begins with {declaration.default!r}")
            return None

    def warn_of_unknown(self, declared: Container[str]) -> None:
        """Warn once of names that the controller has not declared before its first command call."""
        if self._unknown_reported:
            return
        self._unknown_reported = True
        unknown = [  # an object by another name may be for another robot
            name
            for name, value in self._read().items()
            if name not in declared and not isinstance(value, dict)
        ]
        if unknown:
            named = ", ".join(f"{name!r:.80}" for name in unknown[:5])
            self._warn("unknown", f"the controller declares no parameter {named}")

    def _read(self) -> dict[str, Any]:
        if self._values is None:
            self._values = self._parsed() if self._text else {}
        return self._values

    def _parsed(self) -> dict[str, Any]:
        try:
            found = json.loads(self._text or "")
        except (ValueError, RecursionError) as error:
            found, why = None, f"it is not JSON ({error})"
        else:
            why = f"it is a {type(found).__name__}"
        if not isinstance(found, dict):
            example = 'not an object such as {"kp": 3.0}'
            self._warn("", f"{why}, {example}; the code's values are used")
            return {}
        values = cast("dict[str, Any]", found)
        own = next((values[name] for name in values if recorded_name(name) == self._robot), None)
        return {**values, **cast("dict[str, Any]", own)} if isinstance(own, dict) else values

    def _warn(self, kind: str, why: str) -> None:
        self._errors.warn(f"{PARAMETERS_VARIABLE} {kind}", f"{PARAMETERS_VARIABLE}: {why}")
