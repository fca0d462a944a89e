"""State rows as flat tables: what is exported reads back as the rows."""

from __future__ import annotations

import csv
import io
import json
import math
import sqlite3
import stat
import sys
import tracemalloc
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.bridge.encoding import encode
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.export import (
    FOR_VIEWERS,
    FORMATS,
    export,
    export_file,
    export_for_viewers,
    format_of,
)
from webots_mcp.store.reading.ranges import Scope, find_range

HEAD = ["run_id", "state_id", "sim_time_s", "wall_time_s"]


@contextmanager
def recorded_run() -> Generator[Recorder]:
    with memory_connection() as connection:
        recorder = start_run(connection)
        yield recorder


def publish(recorder: Recorder, time_s: float, state: dict[str, Any]) -> None:
    """As the bridge does, with whatever the state holds."""
    encoded = encode(state)
    recorder.insert(
        "state", **recorder.at(time_s), data=encoded.text, replaced=encoded.replaced_text
    )


def exported(connection: sqlite3.Connection, form: str, **wanted: Any) -> bytes:
    sink = io.BytesIO()
    export(connection, find_range(connection, Scope(**wanted)), form, sink)
    return sink.getvalue()


def json_lines(connection: sqlite3.Connection, **wanted: Any) -> list[dict[str, Any]]:
    return [json.loads(line) for line in exported(connection, "jsonl", **wanted).splitlines()]


def table(connection: sqlite3.Connection, **wanted: Any) -> list[dict[str, str]]:
    text = exported(connection, "csv", **wanted).decode()
    return list(csv.DictReader(io.StringIO(text, newline="")))


def parquet(connection: sqlite3.Connection) -> Any:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")
    return parquet.read_table(io.BytesIO(exported(connection, "parquet")))


# -- the law --------------------------------------------------------------------------------------

NAMES = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="."), min_size=1, max_size=6
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=25,
)
STATES = st.lists(st.dictionaries(NAMES, VALUES, max_size=5), min_size=1, max_size=5)


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of a state as they were published, long arrays whole."""
    if isinstance(value, dict):
        for key, item in value.items():  # pyright: ignore[reportUnknownVariableType]
            yield from flat(item, f"{name}.{key}" if name else f"{key}")
    elif isinstance(value, list) and len(value) <= 16:  # pyright: ignore[reportUnknownArgumentType]
        for index, item in enumerate(value):  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
            yield from flat(item, f"{name}.{index}")
    else:
        yield name, value


def expected(state: dict[str, Any]) -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for name, value in flat(state):
        leaves.setdefault(name, with_64_bits(value))
    return {f"state.{n}" if n in {*HEAD, "replaced"} else n: v for n, v in leaves.items()}


def with_64_bits(value: Any) -> Any:
    """Integers beyond them are recorded as the nearest float."""
    if isinstance(value, list):
        return [with_64_bits(item) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, dict):
        return {key: with_64_bits(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return float(value)
    return value


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, float) and math.isnan(wanted):
        return isinstance(found, float) and math.isnan(found)
    if isinstance(wanted, list):
        items: list[Any] = wanted
        return len(found) == len(items) and all(map(same, found, items))
    if isinstance(wanted, dict):
        return found.keys() == wanted.keys() and all(same(found[k], wanted[k]) for k in wanted)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    return found == wanted and isinstance(found, bool) == isinstance(wanted, bool)


def without_odd(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [without_odd(item) for item in value]  # pyright: ignore[reportUnknownVariableType]
    if isinstance(value, dict):
        return {key: without_odd(item) for key, item in value.items()}  # pyright: ignore[reportUnknownVariableType]
    return value


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(STATES)
def test_json_lines_read_back_as_the_rows(states: list[dict[str, Any]]) -> None:
    with recorded_run() as recorder:
        for i, state in enumerate(states):
            publish(recorder, float(i), state)
        lines = json_lines(recorder.connection)
        for i, (line, state) in enumerate(zip(lines, states, strict=True)):
            head = [line.pop(name) for name in HEAD]
            assert head == [1, i + 1, float(i), recorder.run_start_s + i * 0.5]
            replaced = recorder.connection.execute(
                "SELECT replaced FROM state WHERE id = ?", (i + 1,)
            ).fetchone()[0]
            assert line.pop("replaced", None) == (json.loads(replaced) if replaced else None)
            assert same(line, without_odd(expected(state)))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(STATES)
def test_csv_reads_back_as_the_rows(states: list[dict[str, Any]]) -> None:
    with recorded_run() as recorder:
        for i, state in enumerate(states):
            publish(recorder, float(i), state)
        rows = table(recorder.connection)
        names = list(dict.fromkeys(name for state in states for name in expected(state)))
        for row, state in zip(rows, states, strict=True):
            leaves = expected(state)
            assert list(row) == [*HEAD, *map(spelled, names)]
            for name in names:
                value = leaves.get(name)
                value = spelled(value) if isinstance(value, str) else value
                assert_cell(row[spelled(name)], value)


def spelled(text: str) -> str:
    """As CSV holds it: no NUL."""
    return text.replace("\0", "\\0")


def assert_cell(cell: str, value: Any) -> None:
    if value is None or isinstance(value, str):
        assert cell == (value or "")
    elif isinstance(value, bool):
        assert cell == str(value).lower()
    elif isinstance(value, float):
        assert same(float(cell), value)
    else:
        assert same(json.loads(cell), value)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(STATES)
def test_parquet_reads_back_as_the_rows(states: list[dict[str, Any]]) -> None:
    with recorded_run() as recorder:
        for i, state in enumerate(states):
            publish(recorder, float(i), state)
        rows = parquet(recorder.connection).to_pylist()
        for row, state in zip(rows, states, strict=True):
            leaves = expected(state)
            for name in row.keys() - HEAD:
                found, value = row[name], leaves.get(name)
                if isinstance(found, str) or value is None:
                    assert_cell(found or "", value)
                elif isinstance(found, list):
                    assert found == pytest.approx(value, nan_ok=True)
                else:
                    assert found == pytest.approx(value, nan_ok=True)


# -- what a person sees ---------------------------------------------------------------------------


def test_a_column_has_the_kind_of_its_first_value_that_is_there(recorder: Recorder) -> None:
    for number, x in enumerate((None, 1.5, 2)):
        recorder.publish(float(number), {"x": x})
    assert parquet(recorder.connection).to_pydict()["x"] == [None, 1.5, 2.0]


def test_cells_that_a_spreadsheet_would_run_are_made_harmless_on_request(
    recorder: Recorder,
) -> None:
    recorder.publish(0.0, {"=name": "=1+1", "a": "@x", "b": "+x", "c": "-x", "n": -1.5, "t": "x=1"})
    wanted = find_range(recorder.connection, Scope(run_id=1))
    found: list[list[str]] = []
    for safe in (False, True):
        sink = io.BytesIO()
        export(recorder.connection, wanted, "csv", sink, safe_cells=safe)
        found += [row[len(HEAD) :] for row in csv.reader(io.StringIO(sink.getvalue().decode()))]
    assert found == [
        ["=name", "a", "b", "c", "n", "t"], ["=1+1", "@x", "+x", "-x", "-1.5", "x=1"],
        ["'=name", "a", "b", "c", "n", "t"], ["'=1+1", "'@x", "'+x", "'-x", "-1.5", "x=1"],
    ]  # fmt: skip


def test_a_signal_that_is_called_like_our_columns_gets_another_name(recorder: Recorder) -> None:
    publish(recorder, 3.0, {"sim_time_s": 99, "replaced": True})
    line = json_lines(recorder.connection)[0]
    assert (line["sim_time_s"], line["state.sim_time_s"], line["state.replaced"]) == (3.0, 99, True)


@pytest.mark.parametrize("data", ["", "no JSON", "[1]", "NaN", '{"a": NaN}'])
def test_a_row_whose_data_is_no_json_object_is_a_row_all_the_same(
    recorder: Recorder, data: str
) -> None:
    recorder.insert("state", **recorder.at(1.0), data=data)
    assert len(json_lines(recorder.connection)) == 1
    assert len(table(recorder.connection)) == 1


def test_a_range_holds_its_start_and_not_its_end(reader: sqlite3.Connection) -> None:
    times = [line["sim_time_s"] for line in json_lines(reader, run_id=1, start_s=1.6, end_s=3.2)]
    assert (len(times), times[0]) == (50, 1.6)
    assert times[-1] < 3.2


def test_a_range_in_wall_time_goes_through_several_runs(reader: sqlite3.Connection) -> None:
    lines = json_lines(reader, since_wall_time=0)
    assert {line["run_id"] for line in lines} == {1, 2}
    assert len(lines) == 857


def test_rows_of_a_paused_simulation_share_their_time_and_all_come(recorder: Recorder) -> None:
    for i in range(5000):
        recorder.publish(float(i // 4000), {"x": i})
    assert [line["x"] for line in json_lines(recorder.connection)] == list(range(5000))


def test_rows_that_come_during_the_export_are_left_for_the_next(recorder: Recorder) -> None:
    for i in range(3000):
        recorder.publish(float(i), {"x": i})
    wanted = find_range(recorder.connection, Scope(start_s=0, end_s=1e9))

    def robot_goes_on(done: int, of: int) -> None:
        recorder.publish(5000.0 + done, {"late": done})

    sink = io.BytesIO()
    assert export(recorder.connection, wanted, "csv", sink, robot_goes_on) == 3000
    assert len(sink.getvalue().splitlines()) == 3001
    assert b"late" not in sink.getvalue()


@pytest.mark.parametrize("form", FORMATS)
def test_progress_reaches_its_end(recorder: Recorder, form: str) -> None:
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="the extra 'parquet' is not installed")
    for i in range(5000):
        recorder.publish(float(i), {"x": i})
    told: list[tuple[int, int]] = []
    wanted = find_range(recorder.connection, Scope())
    export(
        recorder.connection, wanted, form, io.BytesIO(), lambda done, of: told.append((done, of))
    )
    assert told[-1][0] == told[-1][1]
    assert [done for done, _ in told] == sorted(done for done, _ in told)


@pytest.mark.parametrize("form", ["csv", "jsonl"])
def test_memory_does_not_grow_with_the_recording(
    recorder: Recorder, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.store.export.CHUNK_ROWS", 100)
    peaks: list[int] = []
    for rows in (300, 300, 1200):
        for i in range(rows):
            recorder.publish(float(i), {"text": "t" * 500})
        wanted = find_range(recorder.connection, Scope())
        tracemalloc.start()
        with Path("/dev/null").open("wb") as sink:
            export(recorder.connection, wanted, form, sink)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[-1] < 2 * peaks[0]  # six times as many rows; what else runs allocates too


# -- files and bad input --------------------------------------------------------------------------


def test_a_file_appears_when_it_is_complete(reader: sqlite3.Connection, tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    seen: list[bool] = []
    wanted = find_range(reader, Scope(run_id=1))
    rows = export_file(reader, wanted, "csv", file, lambda done, of: seen.append(file.exists()))
    assert rows == 530
    assert not any(seen)
    assert len(file.read_text().splitlines()) == 531
    assert list(tmp_path.iterdir()) == [file]
    if sys.platform != "win32":
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize("form", ["csv", *FOR_VIEWERS])
def test_an_export_that_fails_leaves_the_old_file_and_no_half_of_a_new_one(
    reader: sqlite3.Connection, tmp_path: Path, form: str
) -> None:
    pytest.importorskip({"rrd": "rerun", "mcap": "mcap"}.get(form, "csv"))
    file = tmp_path / f"run.{form}"
    file.write_text("old")

    def fail(*_: int) -> None:
        raise OSError("disk full")

    wanted = find_range(reader, Scope())
    with pytest.raises(InvalidInputError, match="disk full"):
        if form == "csv":
            export_file(reader, wanted, form, file, fail)
        else:
            export_for_viewers(reader, tmp_path, wanted, form, file, fail)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_files_name_tells_its_format_and_what_is_none_is_told_what_there_is(
    reader: sqlite3.Connection,
) -> None:
    names = ("a.csv", "a.JSONL", "a.json", "a.parquet")
    assert [format_of(Path(each)) for each in names] == ["csv", "jsonl", "jsonl", "parquet"]
    with pytest.raises(InvalidInputError, match=r"\.parquet, \.mcap, \.rrd or \.zip"):
        format_of(Path("run"))
    with pytest.raises(InvalidInputError, match="csv, jsonl, parquet"):
        export(reader, find_range(reader, Scope()), "xlsx", io.BytesIO())


@pytest.mark.parametrize("name", ["file/x.csv", f"{'k' * 300}.csv", "none/x.csv"])
def test_a_file_that_cannot_be_made_is_said_to_be_none(
    recorder: Recorder, tmp_path: Path, name: str
) -> None:
    publish(recorder, 0.0, {"x": 1})
    (tmp_path / "file").touch()
    wanted = find_range(recorder.connection, Scope(run_id=1))
    with pytest.raises(InvalidInputError, match="cannot be written"):
        export_file(recorder.connection, wanted, "csv", tmp_path / name)
