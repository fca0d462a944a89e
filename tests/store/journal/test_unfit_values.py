"""Values that do not fit the database cost a journal no state that fits, and are counted."""

from __future__ import annotations

import fcntl
import json
import random
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.store.journal.test_conformance import SESSION, part, rows
from webots_mcp.cli import main
from webots_mcp.store.journal_intake import ingest_journals
from webots_mcp.store.recording import RecordingAccess

RUN = "11111111-2222-4333-8444-555555555555"
HEADER: dict[str, Any] = {
    "webots_mcp_waiting": 1,
    "robot": {"name": "rover"},
    "session": {"uuid": SESSION, "pid": 4711, "started_wall_time_s": 1000.0},
}
RUN_VALUES: dict[str, Any] = {
    "uuid": RUN, "world": "/w/arena.wbt", "step_ms": 32.0, "reason": "start",
    "wall_time": 1000.0, "sim_time": 0.0,
}  # fmt: skip
MISSING = object()
# As they stand in the file: what neither SQLite nor JSON knows, and what is of a wrong type.
UNFIT = {
    "NaN": "NaN", "infinity": "-Infinity", "beyond all doubles": "1e999", "2**70": str(2**70),
    "500 digits": "1" * 500, "5000 digits": "1" * 5000, "null": "null", "flag": "true",
    "text": '"seven"', "half a character": r'"\ud800"', "NUL": r'"\u0000"', "array": "[1]",
    "object": '{"a":1}', "nested": "[" * 300 + "]" * 300, "deeply nested": "[" * 5000 + "]" * 5000,
    "long text": '"' + "x" * 300_000 + '"', "negative": "-1", "missing": MISSING,
}  # fmt: skip

NAMES = ("text", "NUL", "long text")  # unfit as other values, and good as a name
READABLE = [name for name in UNFIT if name not in ("5000 digits", "deeply nested")]  # as JSON


def object_with(values: dict[str, Any], name: str, text: Any) -> str:
    """An object in which one value is that text, which need not be JSON."""
    kept = {key: json.dumps(value) for key, value in values.items() if key != name}
    if text is not MISSING:
        kept[name] = text
    return "{" + ",".join(f'"{key}":{value}' for key, value in kept.items()) + "}"


def state(number: int, run: str = RUN) -> str:
    return json.dumps([number, "state", run, [number / 10, 1000.0 + number / 10, {"n": number}]])


def ingest(folder: Path, *lines: str, start: bytes = b"") -> None:
    part(folder).write_bytes(start + "".join(f"{line}\n" for line in lines).encode())
    RecordingAccess(folder / "webots.db", folder).ingest()


def query(folder: Path, sql: str) -> list[Any]:
    with closing(sqlite3.connect(folder / "webots.db")) as connection:
        return connection.execute(sql).fetchall()


def numbers(folder: Path) -> list[int]:
    return [n for (n,) in query(folder, "SELECT json_extract(data, '$.n') FROM state ORDER BY id")]


def require_counted(folder: Path, count: int) -> None:
    assert rows(folder, "dropped") == [[count]]
    assert query(folder, "SELECT rows_dropped FROM session") == [(count,)]


@pytest.mark.parametrize(
    ("name", "unfit"),
    [(a, b) for a in RUN_VALUES for b in UNFIT if a != "uuid" or b not in NAMES],
)
def test_a_run_with_a_value_that_does_not_fit_keeps_its_states(
    name: str, unfit: str, tmp_path: Path
) -> None:
    run = object_with(RUN_VALUES, name, UNFIT[unfit])
    ingest(tmp_path, json.dumps(HEADER), f'[1,"run",null,{run}]', *map(state, range(2, 6)))
    ((uuid, world, step_ms),) = query(tmp_path, "SELECT uuid, world, basic_time_step_ms FROM run")
    assert numbers(tmp_path) == [2, 3, 4, 5] and uuid == RUN
    assert world == "/w/arena.wbt" or name == "world" or unfit in ("5000 digits", "deeply nested")
    assert step_ms in (32.0, None) or name == "step_ms"
    assert query(tmp_path, "SELECT row_count FROM run") == [(4,)]
    assert rows(tmp_path, "dropped")[0][0] <= 1
    assert not part(tmp_path).exists()


@pytest.mark.parametrize("line", [
    "no JSON", '[1,"run"', '[1,"run",null]', '[1,"run",null,{}]', '[1,"run",null,null]',
    "\x00", f'["1","run",null,{{"uuid":"{RUN}"}}]', f'[-1,"run",7,{{"uuid":"{RUN}"}}]',
    f'[{2**70},"run",null,{{"uuid":"{RUN}"}}]', f'[1,"run",null,{{"uuid":"{RUN}",',
])  # fmt: skip
def test_a_run_whose_line_cannot_be_read_is_made_from_its_first_row(
    line: str, tmp_path: Path
) -> None:
    ingest(tmp_path, json.dumps(HEADER), line, *map(state, range(2, 6)))
    assert numbers(tmp_path) == [2, 3, 4, 5]
    assert query(tmp_path, "SELECT uuid, started_sim_time_s, start_reason FROM run") == [
        (RUN, 0.2, "start")
    ]
    require_counted(tmp_path, 1)


def test_a_run_that_is_made_from_a_row_ends_the_run_before_it(tmp_path: Path) -> None:
    first = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    other = RUN.replace("1", "7")
    ingest(tmp_path, json.dumps(HEADER), first, state(2), "torn", state(3, other))
    assert query(tmp_path, "SELECT uuid, end_reason, row_count FROM run ORDER BY id") == [
        (RUN, "reset", 1),
        (other, None, 1),
    ]


@pytest.mark.parametrize("unfit", READABLE)
@pytest.mark.parametrize("name", [
    "pid", "started_wall_time_s", "host", "parent_pid", "environment", "controller", "versions",
    "throttle_interval",
])  # fmt: skip
def test_a_session_with_a_value_that_does_not_fit_is_recorded(
    name: str, unfit: str, tmp_path: Path
) -> None:
    session = object_with(HEADER["session"], name, UNFIT[unfit])
    header = f'{{"webots_mcp_waiting":1,"robot":{{"name":"rover"}},"session":{session}}}'
    run = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    ingest(tmp_path, header, run, *map(state, range(2, 6)))
    assert numbers(tmp_path) == [2, 3, 4, 5]
    assert rows(tmp_path, "dropped")[0][0] <= 1
    assert not part(tmp_path).exists()


def header_with(name: str, unfit: str) -> str:
    """The first line of a journal, one value of which does not fit."""
    branch, _, leaf = name.partition(".")
    if not leaf:
        return object_with(HEADER, branch, UNFIT[unfit])
    return object_with(HEADER, branch, object_with(HEADER[branch], leaf, UNFIT[unfit]))


@pytest.mark.parametrize(
    ("name", "unfit"),
    [
        (name, unfit)
        for name in ("robot", "robot.name", "session", "session.uuid")
        for unfit in UNFIT
        if name != "robot.name" or unfit not in NAMES
    ],
)
def test_a_file_that_names_no_robot_or_session_is_kept_and_named_by_status(
    name: str, unfit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = header_with(name, unfit)
    ingest(tmp_path, header, f'[1,"run",null,{json.dumps(RUN_VALUES)}]', state(2))
    assert part(tmp_path).exists()
    capsys.readouterr()
    main(["status", "--data-dir", str(tmp_path)])
    said = "".join(capsys.readouterr())
    assert f"{part(tmp_path).name} could not be read and was left as it is" in said


@pytest.mark.slow
def test_doctor_names_a_file_that_could_not_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ingest(tmp_path, header_with("session.uuid", "missing"), state(2))
    main(["doctor", "--data-dir", str(tmp_path)])
    said = "".join(capsys.readouterr())
    assert f"{part(tmp_path).name} could not be read and was left as it is" in said


def test_a_part_of_which_nothing_fits_is_kept_and_those_after_it_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    part(tmp_path, 1).write_text(f"{json.dumps(HEADER)}\nno JSON\n[1,2]\n")
    run = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    part(tmp_path, 2).write_text(f"{json.dumps(HEADER)}\n{run}\n{state(2)}\n")
    for _ in range(2):
        RecordingAccess(tmp_path / "webots.db", tmp_path).ingest()
    assert numbers(tmp_path) == [2]
    assert part(tmp_path, 1).exists() and not part(tmp_path, 2).exists()
    main(["status", "--data-dir", str(tmp_path)])
    assert "none of its 2 lines fits: 'no JSON" in capsys.readouterr().out
    part(tmp_path, 1).unlink()
    main(["status", "--data-dir", str(tmp_path)])
    assert "none of its" not in capsys.readouterr().out


def test_what_was_dropped_after_the_last_entry_is_counted(tmp_path: Path) -> None:
    run = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    end = '[3,"session end",null,{"reason":"finished","now":1001.0,"dropped":5}]'
    ingest(tmp_path, json.dumps(HEADER), run, "torn", state(2), "torn", end, "torn")
    assert query(tmp_path, "SELECT rows_dropped, end_reason FROM session") == [(8, "finished")]
    assert rows(tmp_path, "dropped") == [[3]]


@pytest.mark.parametrize("unfit", READABLE)
@pytest.mark.parametrize("kind, name", [
    ("run end", "reason"), ("run end", "now"), ("run end", "sim_time"),
    ("session end", "reason"), ("session end", "now"), ("session end", "dropped"),
    ("session end", "error"),
])  # fmt: skip
def test_an_end_with_a_value_that_does_not_fit_ends_the_run_all_the_same(
    kind: str, name: str, unfit: str, tmp_path: Path
) -> None:
    values = {"reason": "finished", "now": 1001.0, "sim_time": 0.3}
    values |= {"dropped": 0, "error": None} if kind == "session end" else {}
    run = json.dumps(RUN) if kind == "run end" else "null"
    end = f'[4,"{kind}",{run},{object_with(values, name, UNFIT[unfit])}]'
    first = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    ingest(tmp_path, json.dumps(HEADER), first, state(2), state(3), end)
    assert numbers(tmp_path) == [2, 3]
    ((reason, ended_s),) = query(tmp_path, "SELECT end_reason, ended_wall_time_s FROM run")
    assert reason and ended_s is not None


def test_a_byte_order_mark_at_the_start_of_a_file_or_a_line_is_no_fault(tmp_path: Path) -> None:
    run = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    ingest(tmp_path, json.dumps(HEADER), f"\ufeff{run}", state(2), start=b"\xef\xbb\xbf")
    assert numbers(tmp_path) == [2]
    require_counted(tmp_path, 0)


@pytest.mark.parametrize("seed", range(40))
def test_no_state_that_fits_is_lost_among_lines_that_do_not(seed: int, tmp_path: Path) -> None:
    """Lines of all kinds with values of all kinds at any place, read at once or in pieces."""
    draw = random.Random(seed)
    names = [name for name in UNFIT if name not in ("long text",)]
    unfit = [text for text in map(UNFIT.get, names) if isinstance(text, str)]
    lines, fitting, number, run = [json.dumps(HEADER)], list[int](), 0, ""
    for index in range(draw.randrange(20, 60)):
        number += draw.choice([1, 1, 1, 5])
        if index % 15 == 0:
            run = f"{index:08}-2222-4333-8444-555555555555"
            name = draw.choice([*RUN_VALUES, "none"])
            value = draw.choice([*unfit, MISSING])
            values = object_with(RUN_VALUES | {"uuid": run}, name, value)
            end = draw.choice(["]", "]", "]", "", "]]"])
            lines.append(f'[{number},"run",null,{values}{end}')
            continue
        if draw.random() < 0.5:
            lines.append(state(number, run))
            fitting.append(number)
            continue
        kind = draw.choice(["state", "event", "log", "run end", "command finished", "image"])
        values = [draw.choice([*unfit, "1.0", '"info"', "{}"]) for _ in range(draw.randrange(7))]
        fields = [str(number), f'"{kind}"', json.dumps(run), "[" + ",".join(values) + "]"]
        if draw.random() < 0.5:
            fields[draw.randrange(4)] = draw.choice(unfit)
        line = "[" + ",".join(fields) + "]"
        lines.append(line[: draw.randrange(len(line))] if draw.random() < 0.2 else line)
    data = "".join(f"{line}\n" for line in lines).encode()
    recording, pieces = RecordingAccess(tmp_path / "webots.db", tmp_path), draw.choice([1, 3, 40])
    with part(tmp_path).open("ab", buffering=0) as journal:
        fcntl.flock(journal, fcntl.LOCK_EX)
        for start in range(0, len(data), len(data) // pieces + 1):
            journal.write(data[start : start + len(data) // pieces + 1])
            recording.ingest()
    with recording.writer() as connection:  # its writer is gone
        ingest_journals(connection, tmp_path / "webots.db")
    found = numbers(tmp_path)
    assert [n for n in found if n in set(fitting)] == fitting
    assert not part(tmp_path).exists()
    ((dropped,),) = rows(tmp_path, "dropped")
    require_counted(tmp_path, dropped)
    with recording.view() as view:
        assert view.header()["robot"] == "rover"
    stored = sum(
        query(tmp_path, f"SELECT count(*) FROM {table} {where}")[0][0]
        for table, where in (
            ("state", ""),
            ("log", ""),
            ("event", "WHERE kind NOT IN ('dropped', 'change')"),
        )
    )
    written = len(lines) - 1 - sum(not line.strip() for line in lines)
    runs = sum('"run",null' in line for line in lines)
    assert written - runs <= stored + dropped <= written + runs


def test_the_database_stays_readable_by_name_of_a_state_with_many_levels(tmp_path: Path) -> None:
    run = f'[1,"run",null,{json.dumps(RUN_VALUES)}]'
    lines = [
        json.dumps([number, "state", RUN, [number, number, {name: 1}]])
        for number, name in ((2, ".".join("a" * 90)), (3, ".".join("a" * 200)), (4, "a." * 5000))
    ]
    ingest(tmp_path, json.dumps(HEADER), run, *lines)
    (found,) = query(tmp_path, "SELECT count(*) FROM state")
    assert found == (2,)  # the last name ends in a dot, and stays whole
    require_counted(tmp_path, 1)
    assert main(["state", "--data-dir", str(tmp_path), "--json"]) in (0, 2)


def test_a_journal_without_a_process_belongs_to_none_and_names_its_controller(
    tmp_path: Path,
) -> None:
    controller = tmp_path / "rover.c"
    controller.write_text("int main() {}")
    session = HEADER["session"] | {"pid": None, "controller": str(controller)}
    header = HEADER | {"session": session}
    ingest(tmp_path, json.dumps(header), f'[1,"run",null,{json.dumps(RUN_VALUES)}]', state(2))
    found = query(tmp_path, "SELECT pid, controller, extern FROM session")
    assert found == [(0, str(controller), 0)]
    assert numbers(tmp_path) == [2]
