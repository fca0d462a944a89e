"""Takes into the database what controllers write without it: the journals of docs/journal.md.

A controller in C, or any program, appends lines to a file of its session in the data folder, and
never opens the database. Servers and commands take the lines in while it does: exactly once, as
`session.last_adopted_entry` is written in the same transaction, and in order, as the parts of a
journal are read one after the other. How far this process has read is remembered, so that nothing
is read twice; whatever else reads the same journal meanwhile, or is killed at any place, only finds
entries that are in already.

The writer holds the lock of the part that it writes. A part without one is complete: it is deleted
once it is taken in. Bridges leave journals alone, which would cost their robots time.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, NoReturn, cast

from webots_mcp.connection import identify_files, in_transaction
from webots_mcp.contract import find_log_level, host_name, instance_of, is_extern
from webots_mcp.errors import warn
from webots_mcp.liveness import OpenSession, end_runs, free_name, is_living, process_identity, reap
from webots_mcp.naming import flatten
from webots_mcp.signal_register import (
    Seen,
    SignalNames,
    StateChanges,
    find_changes,
    write_changes,
)
from webots_mcp.waiting_file import (
    ENTRIES_AT_ONCE,
    STATEMENTS,
    Entry,
    Kind,
    Taken,
    enter_robot,
    enter_session,
    journal_parts,
    lock,
    read_header,
    report_strange,
    take_in,
)

BUDGET_S: Final = 5.0  # of a question; what is left waits for the next one, and is said
LONGEST_LINE_BYTES: Final = 4_000_000
_HEADERLESS_S: Final = 60.0  # its writer has not come to the header yet, or never will
_TAIL_BYTES: Final = 65_536

# Numbers, texts and objects that the values of an entry are; a capital letter: or null.
_FIELDS: Final[dict[Kind, tuple[str, ...]]] = {
    "run": ("s uuid", "S world", "N step_ms", "s reason", "n wall_time", "n sim_time"),
    "state": ("n sim_time", "n wall_time", "o data", "O replaced"),
    "event": ("n sim_time", "n wall_time", "s kind", "S name", "O data"),
    "log": ("n sim_time", "n wall_time", "s level", "S source", "s message", "S logger"),
    "run end": ("s reason", "n now", "n sim_time"),
    "session end": ("s reason", "n now", "N dropped", "S error"),
}
_NAMED: Final = ("run", "run end", "session end")  # whose values are an object, not an array
_OF_RUN: Final = ("state", "event", "log", "run end")
_TYPES: Final[dict[str, tuple[type, ...]]] = {"n": (int, float), "s": (str,), "o": (dict,)}
_UNGIVEN: Final = {"rows": None, "monotonic": None}  # of statements, which bridges alone know

_KNOWN: Final = (
    "SELECT id, robot_id, last_adopted_entry, (SELECT data FROM state WHERE run_id = "
    "(SELECT max(id) FROM run WHERE session_id = session.id) ORDER BY sim_time_s DESC, id DESC "
    "LIMIT 1) FROM session WHERE uuid = ?"
)
_SEEN_SESSION: Final = (
    "UPDATE session SET last_seen_wall_time_s = max(last_seen_wall_time_s, :wall), "
    "ended_wall_time_s = max(ended_wall_time_s, :wall) WHERE id = :session"
)
# Rows of a run that has ended came late: it was ended as its process was found gone.
_SEEN_RUN: Final = (
    "UPDATE run SET last_wall_time_s = max(last_wall_time_s, :wall), "
    "last_sim_time_s = max(last_sim_time_s, :sim), "
    "ended_wall_time_s = max(ended_wall_time_s, :wall), "
    "row_count = CASE WHEN ended_wall_time_s IS NULL THEN row_count + :rows ELSE "
    "purged_rows + (SELECT count(*) FROM state WHERE run_id = run.id) END WHERE uuid = :run"
)
_RUN_ID: Final = "SELECT id FROM run WHERE uuid = ?"


class _Place(NamedTuple):
    """How far this process has read a part of a journal.

    Attributes:
        file: Its device and inode, and those of the database.
        offset: The byte after the last entry that is in.
        number: Of that entry.
    """

    file: tuple[int, ...]
    offset: int
    number: int


class _Line(NamedTuple):
    """A complete line: the byte after it, its entry, the state in it; and what was wrong."""

    end: int
    entry: Entry | None
    state: dict[str, Any] | None = None
    fault: str = ""


_lock = threading.Lock()
_places: dict[Path, _Place] = {}
_looks: dict[str, tuple[StateChanges, SignalNames]] = {}  # at the states of each session


def has_news(database: Path) -> bool:
    """Whether a journal next to a database has bytes that this process has not taken in."""
    for parts in journal_parts(database).values():
        for path in parts:
            place = _places.get(path)
            with suppress(OSError):
                status = path.stat()
                known = place is not None and place.file == _identity(status, database)
                if not known or status.st_size != cast("_Place", place).offset:
                    return True
    return False


def _identity(status: os.stat_result, database: Path) -> tuple[int, ...]:
    return (status.st_dev, status.st_ino, *identify_files(database)[:2])


def take_in_journals(
    connection: sqlite3.Connection, database: Path, budget_s: float = math.inf
) -> None:
    """Take in what controllers have written up to now, as far as there is time.

    Args:
        connection: A writer in autocommit mode and in no transaction.
        database: Its file.
        budget_s: Of wall time.

    Raises:
        sqlite3.Error: The database is locked; what is in is in, the rest waits.
    """
    until_s = time.monotonic() + budget_s
    with _lock:
        journals = journal_parts(database)
        for path in _places.keys() - {path for parts in journals.values() for path in parts}:
            if path.parent == database.parent:
                del _places[path]
        for uuid, parts in journals.items():
            # A part is read after all of those before it: entries that are older than one which is
            # in are taken for taken in.
            all(_take_in_part(connection, database, uuid, path, until_s) for path in parts)


def _take_in_part(
    connection: sqlite3.Connection, database: Path, uuid: str, path: Path, until_s: float
) -> bool:
    """Take in a part, and delete it if it is complete; False where some of it is left."""
    try:
        with path.open("r+b") as file:
            if os.fstat(file.fileno()).st_nlink == 0:
                return True
            header = read_header(file)
            if header is None:
                is_late = time.time() - os.fstat(file.fileno()).st_mtime > _HEADERLESS_S
                if not (is_late and lock(file.fileno())):
                    return False
                is_complete = True
            else:
                # The lock first: what is written after the question would be deleted unread.
                is_complete = lock(file.fileno())
                reading = _Reading(connection, database, uuid, path, file, until_s)
                if not reading.take_in(header, is_living=not is_complete):
                    return False
            if is_complete and os.name != "nt":
                path.unlink()
        if is_complete and os.name == "nt":  # where an open file cannot be deleted
            path.unlink()
    except FileNotFoundError:  # another process has taken in all of it
        return True
    except Exception as error:  # noqa: BLE001  (raised again where it is not the file's)
        _looks.pop(uuid, None)
        report_strange(path, error)
        return False
    return True


class _Reading:
    """Reads one part of a journal into the database."""

    def __init__(
        self,
        connection: sqlite3.Connection,
        database: Path,
        uuid: str,
        path: Path,
        file: BinaryIO,
        until_s: float,
    ) -> None:
        self._connection = connection
        self._identity = _identity(os.fstat(file.fileno()), database)
        self._uuid = uuid
        self._path = path
        self._file = file
        self._until_s = until_s

    def take_in(self, header: dict[str, Any], *, is_living: bool) -> bool:
        """Take in all complete lines from where it was left; False where time is up."""
        start = self._file.tell()
        session_id, robot_id, number, newest = self._enter(header, is_living=is_living)
        place = _places.get(self._path)
        if place is None or place.file != self._identity or place.number > number:
            place = _Place(self._identity, _skip(self._file, start, number), number)
        if self._uuid not in _looks:
            changes, _ = _looks[self._uuid] = StateChanges(), SignalNames()
            changes.look(json.loads(newest or "{}"))
        faults: list[str] = []
        while lines := _read_lines(self._file, place.offset):
            entries = [each.entry for each in lines if each.entry]
            if not entries:  # counted with the next entry
                faults += [each.fault for each in lines if each.fault]
                place = place._replace(offset=lines[-1].end)
                continue
            finish = partial(self._finish, session_id, robot_id, lines, faults)
            taken = take_in(self._connection, session_id, entries, finish)
            place = _Place(self._identity, _until(lines, taken.number)[-1].end, taken.number)
            _places[self._path] = place
            faults.clear()
            if time.monotonic() > self._until_s:
                return False
        _places[self._path] = place
        if faults:
            warn(f"{len(faults)} lines at the end of {self._path} are no entries: {faults[0]}")
        return True

    def _enter(
        self, header: dict[str, Any], *, is_living: bool
    ) -> tuple[int, int, int, str | None]:
        """The ids of session and robot, the number of the last entry, the newest state."""
        connection, uuid = self._connection, self._uuid
        if (known := connection.execute(_KNOWN, (uuid,)).fetchone()) is not None:
            return known
        robot, session = _described(header, uuid, is_living=is_living)

        def act() -> int:
            if (found := connection.execute(_KNOWN, (uuid,)).fetchone()) is not None:
                return found[0]  # another process was faster
            reap(connection, time.time())
            name = free_name(connection, robot["name"], _lives)
            now_s = session["started_wall_time_s"]
            return enter_session(
                connection, enter_robot(connection, robot | {"name": name}, now_s), session
            )

        in_transaction(connection, act)
        return connection.execute(_KNOWN, (uuid,)).fetchone()

    def _finish(
        self,
        session_id: int,
        robot_id: int,
        lines: Sequence[_Line],
        faults: Sequence[str],
        taken: Taken,
    ) -> None:
        """Write what follows: names, changes, times, ends of runs, what was dropped."""
        written = {entry.number for entry in taken.written}
        faults = [*faults, *taken.unfit]
        changes, names = _looks[self._uuid]
        runs = dict[str, tuple[float, float, int]]()
        last: Entry | None = None
        for _, entry, state, fault in _until(lines, taken.number):
            if entry is None:
                faults += [fault] * bool(fault)
                continue
            if entry.kind == "run":
                changes.forget()
            is_new = entry.number in written
            changed = changes.look(state) if state is not None else ()
            if is_new and entry.kind == "run" and isinstance(entry.values, dict):
                end_runs(self._connection, session_id, "reset", entry.values["uuid"])
            if is_new and entry.kind == "session end" and isinstance(entry.values, dict):
                end_runs(self._connection, session_id, entry.values["reason"])
            if not is_new or isinstance(entry.values, dict):
                continue
            last = entry
            sim_time_s, wall_time_s, *_ = entry.values
            _, _, rows = runs.get(entry.run or "", (0.0, 0.0, 0))
            run = entry.run or ""
            runs[run] = sim_time_s, wall_time_s, rows + (entry.kind == "state")
            if state is not None:
                names.look(state, str(entry.values[2]), partial(self._enter_names, robot_id))
            for name, before, after in changed:
                data = json.dumps({"from": before, "to": after}, ensure_ascii=False)
                self._event(entry, "change", name[:200], data)
        for run, (sim, wall, rows) in runs.items():
            values = {"run": run, "sim": sim, "wall": wall, "rows": rows, "session": session_id}
            self._connection.execute(_SEEN_RUN, values)
            self._connection.execute(_SEEN_SESSION, values)
        if faults and last is not None:
            text = {"row_count": len(faults), "why": f"{self._path.name}: {faults[0]}"}
            self._event(last, "dropped", None, json.dumps(text))

    def _enter_names(self, robot_id: int, seen: Mapping[str, Seen]) -> bool:
        changes = find_changes(self._connection, robot_id, seen)
        write_changes(self._connection, robot_id, changes)
        return True

    def _event(self, entry: Entry, kind: str, name: str | None, data: str) -> None:
        (run_id,) = self._connection.execute(_RUN_ID, (entry.run,)).fetchone()
        values = (run_id, *cast("tuple[Any, ...]", entry.values)[:2], kind, name, data)
        self._connection.execute(STATEMENTS["event"], values)


def _lives(session: OpenSession) -> bool:
    return is_living(*session[1:], time.time())


def _described(
    header: Mapping[str, Any], uuid: str, *, is_living: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The values of robot and session, from the first line of a journal.

    Raises:
        ValueError: It lacks what a session needs.
    """
    robot, session = _object(header.get("robot")), _object(header.get("session"))
    name: Any = robot.get("name")
    pid: Any = session.get("pid")
    started_s: Any = session.get("started_wall_time_s")
    parent: Any = session.get("parent_pid")
    if not (name and _is("s", name) and session.get("uuid") == uuid):
        raise ValueError("its first line has no robot.name, or another session.uuid than its name")
    if not (_is("n", pid) and _is("n", started_s)):
        raise ValueError("its first line has no session.pid or no session.started_wall_time_s")
    texts = {key: value for key, value in session.items() if _is("s", value)}
    environment = {k: v for k, v in _object(session.get("environment")).items() if _is("s", v)}
    host = texts.get("host", host_name())
    is_here = host == host_name()
    file = texts.get("controller")
    values = {
        "uuid": uuid,
        "pid": int(pid),
        # Of a process that is gone it is not known any more.
        "process": process_identity(int(pid)) if is_here and is_living else None,
        "host": host,
        "instance": instance_of(environment, parent) if is_here else f"{host} process {parent}",
        "extern": int(is_extern(environment)),
        "controller": file,
        "controller_sha256": _sha256(file, started_s) if is_here and file else None,
        "versions": json.dumps(_object(session.get("versions"))),
        "supervisor": 0,
        "actions": "{}",
        "started_wall_time_s": float(started_s),
        "last_seen_wall_time_s": float(started_s),
        "throttle_interval": session.get("throttle_interval"),
    }
    return {"name": name, "kind": "Robot", "devices": "{}"}, values


def _object(value: object) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def _sha256(file: str, started_s: float) -> str | None:
    """Of the program, if it is still the one that was started."""
    with suppress(OSError, ValueError):
        if Path(file).stat().st_mtime <= started_s:
            return sha256(Path(file).read_bytes()).hexdigest()
    return None


# -- lines -----------------------------------------------------------------------------------------


def _until(lines: Sequence[_Line], number: int) -> Sequence[_Line]:
    """The lines up to the last entry of no higher number."""
    ends = [i for i, each in enumerate(lines, 1) if each.entry and each.entry.number <= number]
    return lines[: ends[-1]]


def _skip(file: BinaryIO, offset: int, number: int) -> int:
    """The byte after the last entry of no higher number, from that byte on."""
    file.seek(offset)
    at = offset
    while number and (line := file.readline(LONGEST_LINE_BYTES)).endswith(b"\n"):
        at += len(line)
        head = line[1 : line.find(b",")]
        if head.isdigit():
            if int(head) > number:
                break
            offset = at
    return offset


def _read_lines(file: BinaryIO, offset: int) -> list[_Line]:
    """The next complete lines from that byte on; the last one may not be, while it is written."""
    lines: list[_Line] = []
    file.seek(offset)
    while len(lines) < ENTRIES_AT_ONCE and (line := file.readline(LONGEST_LINE_BYTES)):
        offset += len(line)
        if line.endswith(b"\n"):
            lines.append(_line(line, offset))
            continue
        while (more := file.readline(LONGEST_LINE_BYTES)) and not more.endswith(b"\n"):
            offset += len(more)
        if not more:
            break
        offset += len(more)
        lines.append(_Line(offset, None, fault=f"longer than {LONGEST_LINE_BYTES} bytes"))
    return lines


def _line(line: bytes, end: int) -> _Line:
    """What a line says: an entry, or why it is none."""
    text = line.decode("utf-8", "replace")
    if not text.strip():
        return _Line(end, None)
    try:
        number, kind, run, values = json.loads(text, parse_constant=_refuse)
        if not (type(number) is int and 0 < number < 1 << 63):
            raise ValueError("its number is none")
        if kind not in _FIELDS:
            raise ValueError(f"there is no kind {kind!r}")
        if not (_is("s", run) if kind in _OF_RUN else run is None):
            raise ValueError(f"its run is {run!r}")
        if "\\ud" in text.lower():  # half a character is none
            json.dumps(values, ensure_ascii=False).encode()
        given = _checked(kind, values)
        state = _state(given, text, line) if kind == "state" else None
        values = _bound(kind, given)
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        return _Line(end, None, fault=f"{text[:60]!r}: {error}")
    return _Line(end, Entry(number, kind, run, values), state)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


def _is(letter: str, value: object) -> bool:
    """Whether a value is of a type of `_FIELDS`, and if it is a number, one that is finite."""
    if isinstance(value, bool) or not isinstance(value, _TYPES[letter]):
        return False
    return letter != "n" or math.isfinite(cast("float", value))


def _checked(kind: Kind, values: Any) -> dict[str, Any]:
    """The values of an entry by their names; those that may be null may be left out.

    Raises:
        ValueError: One is missing, or of another type, or there are too many.
    """
    fields = [(field[0], field[2:]) for field in _FIELDS[kind]]
    if kind not in _NAMED:
        if not isinstance(values, list) or len(cast("list[Any]", values)) > len(fields):
            raise ValueError(f"its values are no array of at most {len(fields)}")
        values = dict(zip((name for _, name in fields), cast("list[Any]", values), strict=False))
    given = _object(values)
    for letter, name in fields:
        value = given.get(name)
        may_miss = value is None and letter.isupper()
        if not (may_miss or _is(letter.lower(), value)):
            raise ValueError(f"{name} is {value!r}")
    if kind == "log" and find_log_level(given["level"]) is None:
        raise ValueError(f"there is no level {given['level']!r}")
    return {name: given.get(name) for _, name in fields}


def _state(given: dict[str, Any], text: str, line: bytes) -> dict[str, Any]:
    """The state, with objects for dotted names; texts that were no UTF-8 are named as replaced."""
    state = given["data"] = _nested(given["data"])
    if "\ufffd" in text and line.decode("utf-8", "ignore") != text:
        named = {
            name: "not UTF-8"
            for name, value in flatten(state).items()
            if isinstance(value, str) and "\ufffd" in value
        }
        given["replaced"] = (given["replaced"] or {}) | named
    return state


def _nested(state: dict[str, Any]) -> dict[str, Any]:
    """`{"front.m": 1}` as `{"front": {"m": 1}}`; a name stays whole where its parts are taken."""
    if not any("." in name for name in state):
        return state
    nested: dict[str, Any] = {}
    for name, value in state.items():
        *branches, leaf = name.split(".")
        at: Any = nested if leaf and all(branches) else None
        for branch in branches:
            at = cast("Any", at).setdefault(branch, {}) if type(at) is dict else None
        if type(at) is dict:
            at[leaf] = value
        else:
            nested[name] = value
    return nested


def _bound(kind: Kind, given: dict[str, Any]) -> tuple[Any, ...] | dict[str, Any]:
    """The values as the statement of that kind takes them."""
    if kind in _NAMED:
        return _UNGIVEN | given | ({"dropped": given["dropped"] or 0} if "dropped" in given else {})
    if kind == "log":
        given |= {"level": find_log_level(given["level"]), "source": "controller"}
    return tuple(
        _text(cast("Any", value)) if type(value) is dict else value for value in given.values()
    )


_text: Final[Callable[[object], str]] = json.JSONEncoder(
    ensure_ascii=False, allow_nan=False, separators=(",", ":")
).encode


# -- what waits ------------------------------------------------------------------------------------

_LAG_S: Final = 2.0  # a row that came since the question began is no delay
_ADOPTED: Final = "SELECT last_adopted_entry, last_seen_wall_time_s FROM session WHERE uuid = ?"


def journals_behind(connection: sqlite3.Connection, database: Path) -> list[str]:
    """The journals of which rows are not in the database, although there was time."""
    behind: list[str] = []
    for uuid, parts in journal_parts(database).items():
        adopted, seen_s = connection.execute(_ADOPTED, (uuid,)).fetchone() or (0, 0.0)
        newest = _newest(parts[-1])
        if (
            newest is not None
            and newest.number > adopted
            and _wall_time_s(newest) > seen_s + _LAG_S
        ):
            behind.append(parts[-1].name)
    return behind


def _newest(path: Path) -> Entry | None:
    """The last entry of a part."""
    with suppress(OSError), path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        for tail in (_TAIL_BYTES, LONGEST_LINE_BYTES):
            file.seek(max(size - tail, 0))
            found = [_line(line + b"\n", 0).entry for line in file.read().split(b"\n")[-3:-1]]
            if entries := [entry for entry in found if entry]:
                return entries[-1]
    return None


def _wall_time_s(entry: Entry) -> float:
    values = entry.values
    return float(values[1] if isinstance(values, tuple) else values.get("now", math.inf))
