"""Makes a tape of a run that was recorded without one, where its rows say enough.

An attached bridge records with each step what the enabled sensors measured and what motors and LEDs
were set to. If each step has a row, and the controller hears nothing else, a replay can answer from
these. What the controller commands beyond motors and LEDs is not in the rows: it is noted while the
recorded code is replayed (`with_commands`), and compared with the new code afterwards.
"""

from __future__ import annotations

import ast
import json
import math
import re
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import webots_mcp
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.tapes.tape import NOTES, Tape, TapeWriter, open_tape
from webots_mcp.errors import NothingRecordedError
from webots_mcp.rerun.difference import HELD
from webots_mcp.rerun.recorded_source import find_source

_SURFACE: Final = Path(webots_mcp.__file__).parent / "standin/lib/controller/surface.txt"
_GETTERS: Final = {  # of sensors whose recorded value is what this method answered
    "Accelerometer": "getValues", "Altimeter": "getValue", "Compass": "getValues",
    "DistanceSensor": "getValue", "GPS": "getValues", "Gyro": "getValues",
    "InertialUnit": "getRollPitchYaw", "LightSensor": "getValue", "PositionSensor": "getValue",
    "TouchSensor": "getValue",
}  # fmt: skip
_SETTERS: Final = {
    "target_position_rad": "setPosition", "target_position_m": "setPosition",
    "target_velocity_rad_s": "setVelocity", "target_velocity_m_s": "setVelocity",
}  # fmt: skip
_NOT_FINITE: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_OF_BRIDGE: Final = frozenset(
    {"sensors", "motors", "actuators", "pose", "time", "battery_j", "watched"}
)
_HARMLESS: Final = (  # commands that change neither the controller nor its steps
    "screenshot", "take_frame", "arm_breakpoints", "keep", "inspect", "watch", "get_scene",
    "get_field", "pause", "resume", "fast",
)  # fmt: skip
_NUMBERED: Final = re.compile(r" ?#\d+$")  # by the bridge, where two robots have the same name
_ARGUMENTS: Final = frozenset({"argv", "orig_argv"})
_READ_ARGUMENTS: Final = frozenset(
    {"argparse", "optparse", "getopt", "docopt", "click", "typer", "fire", "absl"}
)
_RUN: Final = (
    "SELECT run.session_id, run.started_sim_time_s, run.steps, run.purged_rows, run.end_reason, "
    "run.start_reason, run.basic_time_step_ms, run.world, s.controller, s.controller_sha256, "
    "s.git_commit, s.host, "
    "s.started_wall_time_s, s.throttle_interval, robot.id AS robot_id, robot.name, robot.devices, "
    "(SELECT min(id) FROM run r WHERE r.session_id = run.session_id) AS first_run "
    "FROM run JOIN session s ON s.id = run.session_id JOIN robot ON robot.id = run.robot_id "
    "WHERE run.id = ?"
)
_ROWS: Final = (
    "SELECT sim_time_s, data, replaced FROM all_state WHERE run_id = ? ORDER BY sim_time_s"
)
_FIRST_COMMAND: Final = 1_000_000  # number of a call, above those of sensors


class RowTape(NamedTuple):
    """A tape made of rows.

    Attributes:
        tape: The tape.
        basis: What it rests on, in a sentence without its end.
    """

    tape: Tape
    basis: str


def make_tape(database: Database, data_dir: Path, run_id: int, folder: Path) -> RowTape:
    """Make a tape of the rows of a run.

    Args:
        database: With the run.
        data_dir: Its folder.
        run_id: The run, which exists.
        folder: Where the tape is written.

    Raises:
        NothingRecordedError: The rows do not suffice; the text names all that is missing.
    """
    with closing(connect(database, "reader")) as connection:
        connection.row_factory = sqlite3.Row
        run: dict[str, Any] = dict(connection.execute(_RUN, (run_id,)).fetchone())
        rows = _rows_of(connection, run_id, run["started_sim_time_s"])
        missing = [*_missing_of_run(connection, run_id, run), *_missing_rows(run, rows)]
        parameters = _start_parameters(connection, run_id)
        limits = _motor_limits(connection, run["robot_id"])
    source = find_source(
        run["controller"], run["controller_sha256"], run["git_commit"],
        run["started_wall_time_s"], data_dir, run["host"],
    )  # fmt: skip
    if source.why_not is not None:
        missing.append(source.why_not)
    missing += _missing_of_source(source.texts)
    devices: dict[str, str] = json.loads(run["devices"] or "{}")
    missing += _missing_classes(rows, devices)
    if missing:
        raise NothingRecordedError(
            f"Run {run_id} has no tape, and its rows do not suffice to run code on them. Missing: "
            f"{'; '.join(missing)}."
        )
    facts: dict[str, dict[str, Any]] = {
        "robot": {
            "getBasicTimeStep": run["basic_time_step_ms"],
            "getWorldPath": run["world"] or "",
        }
    }
    if not _NUMBERED.search(run["name"]):
        facts["robot"]["getName"] = run["name"]
    facts |= {f"device:{name}": {"getMaxVelocity": high} for name, high in limits.items()}
    head: dict[str, Any] = {
        "rests_on_rows": True, "began_s": run["started_sim_time_s"], "began_late": False,
        "images": False,
        "hash_seed": None,
        "recorded_as": run["name"],
        "throttle_interval": run["throttle_interval"] or 1,  # auto_publish() answers as it did
        "controller": source.controller, "project": str(source.root), "arguments": [],
        "executable": None, "parameters": parameters, "devices": devices, "facts": facts,
        "packages": {"controller": _surface(devices.values())},
    }  # fmt: skip
    file = folder / "rows.tape"
    writer = TapeWriter(file)
    writer.write([["head", head], *(["source", *each] for each in source.texts.items())])
    _write_rounds(writer, run, rows, devices)
    writer.close("rows")
    count = f"{len(rows):,} recorded rows, one for each step"
    basis = f"no tape: this rests on {count}, whose numbers are not rounded, and on {source.basis}"
    return RowTape(open_tape(file), basis)


def with_commands(tape: Tape, given: Iterable[Sequence[Any]]) -> Tape:
    """Return a copy of a tape of rows that also has the commands of a replay of the recorded code.

    Args:
        tape: Of rows.
        given: Of each command: round, path, class, name, arguments and the place in the code.
    """
    rounds: dict[int, list[Sequence[Any]]] = {}
    for each in given:
        rounds.setdefault(each[0], []).append(each)
    file = tape.file.with_name("commanded.tape")
    writer = TapeWriter(file)
    sources = [["source", *each] for each in tape.sources().items()]
    writer.write([["head", tape.head | {"rests_on_rows": "with commands"}], *sources])
    asked = 0  # calls of the tape that are copied
    calls: dict[tuple[str, str, str], int] = {}
    places: dict[tuple[str, int], int] = {}
    for one in tape.rounds():
        lines: list[list[Any]] = [
            ["call", number, *call] for number, call in tape.calls.items() if number > asked
        ]
        asked = len(tape.calls)
        events = [*one.events]
        for _, path, owner, name, arguments, place in rounds.get(one.number, []):
            call, where = (path, owner, name), (str(place[0]), int(place[1]))
            if call not in calls:
                calls[call] = _FIRST_COMMAND + len(calls)
                lines.append(["call", calls[call], *call, [], "command"])
            if where not in places:
                places[where] = len(places) + 1
                lines.append(["place", places[where], *where])
            events += [calls[call], [arguments, places[where]]]
        writer.write([*lines, ["round", one.number, one.end_s, *one.step, events]])
    writer.close("rows")
    return open_tape(file)


# -- what is missing -------------------------------------------------------------------------------


class _Row(NamedTuple):
    time_s: float
    state: dict[str, Any]
    is_published: bool
    """Perhaps by the controller, or after it: with commands between the step's end and this row."""


def _rows_of(connection: sqlite3.Connection, run_id: int, began_s: float) -> list[_Row]:
    """Return the newest row of each step that has values of devices."""
    rows: dict[float, _Row] = {}
    published: set[float] = set()
    for time_s, data, replaced in connection.execute(_ROWS, (run_id,)):
        try:
            state: Any = json.loads(data)
            lost: Any = json.loads(replaced or "{}")
        except ValueError:
            continue
        if not isinstance(state, dict) or not isinstance(lost, dict):
            continue
        found = cast("dict[str, Any]", state)
        if "sensors" in found or "motors" in found:
            for path, kind in cast("dict[str, Any]", lost).items():
                _put_back(found, path, kind)
            if time_s in rows or found.keys() - _OF_BRIDGE:
                published.add(time_s)
            rows[time_s] = _Row(time_s, found, is_published=False)
    # After a round in which the controller published, the bridge waits for it up to the next step.
    before = (began_s, *rows)
    return [
        row._replace(is_published=row.time_s in published or each in published)
        for each, row in zip(before, rows.values(), strict=False)
        if row.time_s > began_s
    ]


def _put_back(state: dict[str, Any], path: str, kind: Any) -> None:
    """Put NaN and infinity back where a row has null; leave out what else was replaced."""
    holder: Any = state
    rest = path
    while isinstance(holder, (dict, list)):
        if isinstance(holder, list):
            items = cast("list[Any]", holder)
            name, _, rest = rest.partition(".")
            key: Any = int(name) if name.isdigit() and int(name) < len(items) else None
        else:
            names = cast("dict[str, Any]", holder)  # a device may have a dot in its name
            found = [each for each in names if rest == each or rest.startswith(f"{each}.")]
            key = max(found, key=len, default=None)
            rest = rest[len(key) + 1 :] if key is not None else ""
        if key is None:
            return
        if not rest:
            holder[key] = _NOT_FINITE.get(kind, {"$type": f"it was recorded as {kind}"})
            return
        holder = cast("Any", holder[key])


def _missing_of_run(
    connection: sqlite3.Connection, run_id: int, run: dict[str, Any]
) -> Iterable[str]:
    if run["first_run"] != run_id or run["start_reason"] == "reset":
        before = "an earlier run" if run["first_run"] == run_id else f"run {run['first_run']}"
        yield (
            f"the code's state at its beginning, because it goes on from {before} in the same "
            "process"
        )
    if run["purged_rows"]:
        yield f"{run['purged_rows']:,} rows that retention has deleted"
    set_later = connection.execute(
        "SELECT DISTINCT name FROM parameter_value WHERE run_id = ? "
        "AND set_by IN ('command', 'trial')",
        (run_id,),
    ).fetchall()
    if set_later:
        named = ", ".join(str(each[0]) for each in set_later[:8])
        yield f"the step at which the parameters {named} were set by a command"
    marks = ", ".join("?" * len(_HARMLESS))
    served = connection.execute(
        f"SELECT DISTINCT action FROM command WHERE session_id = ? AND action NOT IN ({marks}) "
        "AND action != 'set_parameters' AND claimed_wall_time_s IS NOT NULL",
        (run["session_id"], *_HARMLESS),
    ).fetchall()
    if served:
        named = ", ".join(str(each[0]) for each in served[:8])
        yield f"the step at which the controller got the commands {named}"


def _missing_rows(run: dict[str, Any], rows: Sequence[_Row]) -> Iterable[str]:
    fix = "record with throttle_interval=1 (WEBOTS_MCP_THROTTLE_INTERVAL=1)"
    if not rows:
        yield "rows with the values of the devices, which MCPBridge.attach(robot) records"
        return
    steps = run["steps"]
    if steps is None:
        throttle = run["throttle_interval"]
        if throttle != 1:
            yield f"a row for each step, since one call in {throttle or 'several'} made one: {fix}"
    elif len(rows) < steps:
        yield f"a row for each step: {len(rows):,} of {steps:,} steps have one; {fix}"
    basic_s = (run["basic_time_step_ms"] or 0.0) / 1000
    times = [run["started_sim_time_s"], *(each.time_s for each in rows)]
    if steps is not None and basic_s and (times[-1] - times[0]) / basic_s < steps - 0.5:
        yield "the times of some steps: the times of the rows span fewer steps than there were"


def _missing_of_source(texts: dict[str, str]) -> Iterable[str]:
    """Yield what the code was started with, if it asks for it."""
    for name, text in texts.items():
        try:
            tree = ast.parse(text)
        except (SyntaxError, ValueError, RecursionError):
            continue
        for node in ast.walk(tree):
            asked: set[str] = set()
            if isinstance(node, ast.Attribute):
                asked = {node.attr} & _ARGUMENTS
            elif isinstance(node, ast.Import):
                asked = {each.name.partition(".")[0] for each in node.names} & _READ_ARGUMENTS
            elif isinstance(node, ast.ImportFrom) and not node.level:
                asked = {(node.module or "").partition(".")[0]} & _READ_ARGUMENTS
                asked |= {each.name for each in node.names if node.module == "sys"} & _ARGUMENTS
            if asked:
                yield (
                    f"the arguments that the controller was started with, which {name} reads "
                    f"({asked.pop()}, line {getattr(node, 'lineno', 1)})"
                )
                return


def _missing_classes(rows: Sequence[_Row], devices: dict[str, str]) -> Iterable[str]:
    """Yield the devices of the rows that the robot does not have any more, since a later run."""
    groups = ("sensors", "motors", "actuators")
    named = {name for row in rows for group in groups for name, _ in _entries(row.state, group)}
    if gone := sorted(named - devices.keys()):
        listed = ", ".join(gone[:8])
        yield f"the classes of the devices {listed}, which the robot's newest recording has not"


# -- what the rows say -----------------------------------------------------------------------------


def _start_parameters(connection: sqlite3.Connection, run_id: int) -> str | None:
    """Return the value of `WEBOTS_MCP_PARAMETERS` that gives the parameters the run began with."""
    rows = connection.execute(
        "SELECT name, value FROM parameter_value WHERE run_id = ? AND is_default = 0 "
        "AND set_by NOT IN ('command', 'trial') ORDER BY id DESC",
        (run_id,),
    ).fetchall()
    return json.dumps({str(name): json.loads(value) for name, value in rows}) if rows else None


def _motor_limits(connection: sqlite3.Connection, robot_id: int) -> dict[str, float]:
    rows = connection.execute(
        "SELECT name, high FROM meaning WHERE robot_id = ? AND source = 'device' AND high > 0 "
        "AND name LIKE 'motors.%.target_velocity%'",
        (robot_id,),
    )
    return {str(n).split(".", 1)[1].rpartition(".")[0]: float(high) for n, high in rows}


def _surface(kinds: Iterable[str]) -> dict[str, Any]:
    """Return the classes of Webots' package from their table, as `describe_package` does."""
    classes: dict[str, Any] = {}
    facts: dict[str, Any] = {}
    for line in _SURFACE.read_text("utf-8").splitlines():
        if line.startswith("#"):
            continue
        if not line.startswith("  "):
            name, _, bases = line.partition("[")[0].strip().partition(":")
            facts = classes[name] = _new_class(bases.split())
            continue
        member, _, kind = line.strip().replace("(", " (", 1).partition(" ")
        if kind.startswith("static"):
            facts["static"].append(member)
        elif kind.startswith("("):
            facts["methods"].append(member)
        elif kind.startswith("property"):
            facts["properties"][member] = "write" in kind
        elif kind.startswith("= "):
            facts["constants"][member] = int(kind[2:].split()[0])
        else:
            facts["constants"][member] = ""
    for kind in kinds:
        classes.setdefault(kind, _new_class(["Device"]))
    for found in classes.values():
        bases = found["bases"]
        inherited = {base for each in bases if each in classes for base in classes[each]["bases"]}
        found["bases"] = [each for each in bases if each not in inherited]
    return classes


def _new_class(bases: list[str]) -> dict[str, Any]:
    return {"bases": bases, "methods": [], "static": [], "properties": {}, "constants": {}}


def _write_rounds(
    writer: TapeWriter, run: dict[str, Any], rows: Sequence[_Row], devices: dict[str, str]
) -> None:
    numbers: dict[tuple[str, str], int] = {}
    before_s = float(run["started_sim_time_s"])
    events: list[Any] = []
    for number, row in enumerate(rows):
        step = ["step", [round(1000 * (row.time_s - before_s))], 0]
        held = [NOTES, [HELD, [_held(row.state), row.is_published]]]
        if not row.is_published:
            events += held
        lines: list[list[Any]] = [["round", number, row.time_s, *step, events]]
        before_s, events = row.time_s, held if row.is_published else []
        defined: list[list[Any]] = []
        for path, owner, name, value in _sensed(row.state, devices):
            call = numbers.get((path, name))
            if call is None:
                call = numbers[path, name] = len(numbers) + 1
                defined.append(["call", call, path, owner, name, [], "seen"])
            events += [call, value]
        writer.write([*lines, *defined])


def _sensed(state: dict[str, Any], devices: dict[str, str]) -> Iterable[tuple[str, str, str, Any]]:
    """Yield path, class, getter and answer of each sensor in a row."""
    for name, value in _entries(state, "sensors"):
        owner = devices.get(name, "")
        getter = _GETTERS.get(owner)
        if owner == "TouchSensor" and isinstance(value, list):
            getter = "getValues"
        if getter is not None and value is not None:
            yield f"device:{name}", owner, getter, _floats(value)
    if isinstance(state.get("battery_j"), (int, float)):
        yield "robot", "Robot", "batterySensorGetValue", float(state["battery_j"])
    for name, held in _entries(state, "motors"):
        for key, getter in (
            ("torque_feedback_nm", "getTorqueFeedback"),
            ("force_feedback_n", "getForceFeedback"),
        ):
            if isinstance(held, dict) and key in held:
                yield f"device:{name}", "Motor", getter, cast("dict[str, Any]", held)[key]


def _floats(value: Any) -> Any:
    if isinstance(value, list):
        return [_floats(each) for each in cast("list[Any]", value)]
    return float(value) if type(value) is int else value


def _held(state: dict[str, Any]) -> list[list[Any]]:
    """Return path, setter and value of each motor and LED of a row."""
    held: list[list[Any]] = []
    for name, values in _entries(state, "motors"):
        if isinstance(values, dict):
            pairs = cast("dict[str, Any]", values).items()
            held += [[f"device:{name}", _SETTERS[key], v] for key, v in pairs if key in _SETTERS]
    for name, value in _entries(state, "actuators"):
        if type(value) in (int, float):
            held.append([f"device:{name}", "set", value])
    return held


def _entries(state: dict[str, Any], group: str) -> Iterable[tuple[str, Any]]:
    values = state.get(group)
    return cast("dict[str, Any]", values).items() if isinstance(values, dict) else ()
