"""Parameters: what a controller declares, and the values that they had in its runs."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from webots_mcp.parameter import Declaration, Value
from webots_mcp.store.runs import Run

COLUMNS: Final = (
    "name", "value", "unit", "default", "low", "high", "choices", "next", "since_s", "set_by",
    "command_id", "doc",
)  # fmt: skip

_DECLARED: Final = (
    "SELECT name, kind, default_value, low, high, choices, doc, unit, next_value FROM parameter "
    "WHERE session_id = ? ORDER BY id"
)
_NAMES: Final = "SELECT DISTINCT name FROM parameter_value ORDER BY name"
_VALUES: Final = (
    "SELECT run_id, name, sim_time_s, value, is_default, set_by, command_id FROM parameter_value "
    "WHERE run_id IN (SELECT value FROM json_each(?)) ORDER BY id"
)


class Declared(NamedTuple):
    """A parameter of a controller.

    Attributes:
        next_value: Which it takes with the next reset; None without one.
    """

    declaration: Declaration
    next_value: Value | None


class Setting(NamedTuple):
    """A value, from a simulation time of its run on.

    Attributes:
        set_by: `code`, `environment`, `command` or `trial`.
        command_id: By which command; None where it was none.
    """

    sim_time_s: float
    value: Value
    is_default: bool
    set_by: str
    command_id: int | None


@dataclass(frozen=True)
class RunParameter:
    """What a parameter was in a run: its settings in order, each unlike the one before."""

    settings: list[Setting] = field(default_factory=list[Setting])

    @property
    def value(self) -> Value:
        """The last value."""
        return self.settings[-1].value

    @property
    def is_default(self) -> bool:
        """Whether it was never another than the code declared."""
        return all(setting.is_default for setting in self.settings)

    @property
    def described(self) -> Value | str:
        """The value; one that changed in the middle of the run with the times of its changes."""
        if len(self.settings) == 1:
            return self.value
        first, *changes = self.settings
        steps = [f"{_text(each.value)} from {each.sim_time_s:.3f} s on" for each in changes[-2:]]
        left_out = f"{len(changes) - 2} others, " if len(changes) > 2 else ""
        return f"{_text(first.value)}, then {left_out}{', '.join(steps)}"

    def add(self, setting: Setting) -> None:
        """The next row; one that repeats the value says nothing new."""
        last = self.settings[-1] if self.settings else None
        if last is None or (last.value, type(last.value)) != (setting.value, type(setting.value)):
            self.settings.append(setting)


RunParameters = Mapping[str, RunParameter]


def declared_by(connection: sqlite3.Connection, session_id: int) -> dict[str, Declared]:
    """The parameters that the controller of a session declares, in its order."""
    return {row[0]: _declared(row) for row in connection.execute(_DECLARED, (session_id,))}


def parameters_of(
    connection: sqlite3.Connection, run_ids: Iterable[int]
) -> dict[int, dict[str, RunParameter]]:
    """What the parameters were in each of these runs."""
    found: dict[int, dict[str, RunParameter]] = {run_id: {} for run_id in run_ids}
    for run_id, name, sim_time_s, value, *rest in connection.execute(
        _VALUES, (json.dumps(list(found)),)
    ):
        setting = Setting(sim_time_s, json.loads(value), bool(rest[0]), rest[1], rest[2])
        found[run_id].setdefault(name, RunParameter()).add(setting)
    return found


def described(connection: sqlite3.Connection, run: Run) -> list[dict[str, Any]]:
    """Each parameter of a run, under `COLUMNS`: its last value, and how it is declared now.

    What a controller does not declare any more, or a later one declared, has only its values.
    """
    values = parameters_of(connection, [run.id])[run.id]
    declared = declared_by(connection, run.session_id)
    names = dict.fromkeys((*declared, *values))
    return [_described(name, values.get(name), declared.get(name)) for name in names]


def recorded_names(connection: sqlite3.Connection) -> list[str]:
    """The names of all parameters that any run had."""
    return [name for (name,) in connection.execute(_NAMES)]


def differing(runs: Sequence[RunParameters]) -> list[str]:
    """The names of which not all of these runs had the same values; the first seen comes first."""
    names = dict.fromkeys(name for run in runs for name in run)
    return [name for name in names if len({_values_of(run.get(name)) for run in runs}) > 1]


def _values_of(parameter: RunParameter | None) -> tuple[Value, ...] | None:
    return None if parameter is None else tuple(each.value for each in parameter.settings)


def _described(name: str, values: RunParameter | None, declared: Declared | None) -> dict[str, Any]:
    found: dict[str, Any] = dict.fromkeys(COLUMNS) | {"name": name}
    if declared is not None:
        declaration = declared.declaration._asdict()
        found |= {column: declaration[column] for column in COLUMNS if column in declaration}
        found |= {"next": declared.next_value, "doc": declaration["doc"] or None}
    if values is not None:
        last = values.settings[-1]
        found |= {"value": last.value, "since_s": last.sim_time_s}
        found |= {"set_by": last.set_by, "command_id": last.command_id}
    return found


def _declared(row: tuple[Any, ...]) -> Declared:
    name, kind, default, low, high, choices, doc, unit, next_value = row
    listed = None if choices is None else tuple(json.loads(choices))
    declaration = Declaration(name, kind, json.loads(default), low, high, listed, doc, unit)
    return Declared(declaration, None if next_value is None else json.loads(next_value))


def _text(value: Value) -> str:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, (bool, str)) else f"{value:g}"
