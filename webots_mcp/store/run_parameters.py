"""Read the parameters that a controller declares, and their values in its runs."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.parameter import Declaration, Value, require_known
from webots_mcp.store.run_rows import RunRecord

COLUMNS: Final = (
    "name", "value", "unit", "default", "low", "high", "choices", "next", "since_s", "set_by",
    "command_id", "doc",
)  # fmt: skip

# For a run `r` and the JSON object :parameters: whether it had all these values at some time.
HAD_VALUES: Final = (
    "NOT EXISTS (SELECT 1 FROM json_each(:parameters) wanted WHERE NOT EXISTS ("
    "SELECT 1 FROM parameter_value v WHERE v.run_id = r.id AND v.name = wanted.key AND "
    "CASE WHEN json_valid(v.value) THEN json_extract(v.value, '$') = wanted.value END))"
)


class Declared(NamedTuple):
    """A parameter of a controller.

    Attributes:
        next_value: The value that the next reset sets; None without one.
    """

    declaration: Declaration
    next_value: Value | None


class ParameterSetting(NamedTuple):
    """A value, from a simulation time of its run on.

    Attributes:
        set_by: `code`, `environment`, `command` or `trial`.
        command_id: The command that set it; None without a command.
    """

    sim_time_s: float
    value: Value
    is_default: bool
    set_by: str
    command_id: int | None


@dataclass(frozen=True)
class RunParameter:
    """A parameter in a run: its settings in order, each different from the one before."""

    settings: list[ParameterSetting] = field(default_factory=list[ParameterSetting])

    @property
    def value(self) -> Value:
        """The last value."""
        return self.settings[-1].value

    @property
    def values(self) -> tuple[Value, ...]:
        """All its values, in order."""
        return tuple(setting.value for setting in self.settings)

    @property
    def is_default(self) -> bool:
        """Whether it always had the value that the code declared."""
        return all(setting.is_default for setting in self.settings)

    @property
    def described(self) -> Value | str:
        """The value, with the times of changes if it changed in the middle of the run."""
        if len(self.settings) == 1:
            return self.value
        first, *changes = self.settings
        steps = [f"{_text(each.value)} from {each.sim_time_s:.3f} s on" for each in changes[-2:]]
        left_out = f"{len(changes) - 2} others, " if len(changes) > 2 else ""
        return f"{_text(first.value)}, then {left_out}{', '.join(steps)}"

    def add(self, setting: ParameterSetting) -> None:
        """Add the next row, unless it repeats the value."""
        last = self.settings[-1] if self.settings else None
        if last is None or (last.value, type(last.value)) != (setting.value, type(setting.value)):
            self.settings.append(setting)


RunParameters = Mapping[str, RunParameter]


def declared_by(connection: sqlite3.Connection, session_id: int) -> dict[str, Declared]:
    """Return the parameters that the controller of a session declares, in its order."""
    return {
        row[0]: _declared(row)
        for row in connection.execute(
            "SELECT name, kind, default_value, low, high, choices, doc, unit, next_value "
            "FROM parameter WHERE session_id = ? ORDER BY id",
            (session_id,),
        )
    }


def parameters_of(
    connection: sqlite3.Connection, run_ids: Iterable[int]
) -> dict[int, dict[str, RunParameter]]:
    """Return the parameters of each of these runs."""
    found: dict[int, dict[str, RunParameter]] = {run_id: {} for run_id in run_ids}
    for run_id, name, sim_time_s, value, *rest in connection.execute(
        "SELECT run_id, name, sim_time_s, value, is_default, set_by, command_id "
        "FROM parameter_value WHERE run_id IN (SELECT value FROM json_each(?)) ORDER BY id",
        (json.dumps(list(found)),),
    ):
        setting = ParameterSetting(sim_time_s, json.loads(value), bool(rest[0]), rest[1], rest[2])
        found[run_id].setdefault(name, RunParameter()).add(setting)
    return found


def described(connection: sqlite3.Connection, run: RunRecord) -> list[dict[str, Any]]:
    """Return each parameter of a run under `COLUMNS`: its last value and its current declaration.

    A parameter that is no longer declared, or only by a later controller, has only its values.
    """
    values = parameters_of(connection, [run.id])[run.id]
    declared = declared_by(connection, run.session_id)
    names = dict.fromkeys((*declared, *values))
    return [_described(name, values.get(name), declared.get(name)) for name in names]


def notable_parameters(
    connection: sqlite3.Connection, run_ids: Iterable[int]
) -> dict[int, dict[str, Value | str]]:
    """Return of each run the parameters that are not as declared, or differ between these runs.

    Those in which the runs differ come first. A value that changed within its run is a text with
    the time.
    """
    found = parameters_of(connection, run_ids)
    unlike = differing(list(found.values()))
    return {
        run_id: {name: had[name].described for name in _ordered(had, unlike)}
        for run_id, had in found.items()
    }


def differing(runs: Sequence[RunParameters]) -> list[str]:
    """Return the names whose values, at any time, differ between the runs that have them."""
    names = dict.fromkeys(name for run in runs for name in run)
    return [name for name in names if len({run[name].values for run in runs if name in run}) > 1]


def _ordered(had: RunParameters, unlike: Sequence[str]) -> list[str]:
    first = [name for name in unlike if name in had]
    return first + [name for name in had if not had[name].is_default and name not in first]


def kinds_of(connection: sqlite3.Connection) -> dict[str, str]:
    """Return the kinds of all parameters by name, as declared last."""
    return dict(connection.execute("SELECT name, kind FROM parameter ORDER BY id").fetchall())


def as_filter(connection: sqlite3.Connection, values: Mapping[str, Value]) -> str:
    """Return values by name as JSON, for a query for runs that had them.

    Raises:
        InvalidInputError: No controller ever declared one of the names, or a value is not finite.
    """
    if not values:
        return "{}"
    require_known(
        list(values),
        [
            name
            for (name,) in connection.execute("SELECT DISTINCT name FROM parameter ORDER BY name")
        ],
    )
    try:
        return json.dumps(dict(values), allow_nan=False)
    except ValueError as error:
        raise InvalidInputError(f"No run has such a value of a parameter: {error}.") from error


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
    *declared, next_value = row
    value = None if next_value is None else json.loads(next_value)
    return Declared(Declaration.of_row(*declared), value)


def _text(value: Value) -> str:
    return json.dumps(value, ensure_ascii=False) if isinstance(value, (bool, str)) else f"{value:g}"
