"""What the past costs as chunks: bytes, making them, reading them, beside JSON rows and arrays."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from tests.benchmarks.measuring import Samples, time_calls
from tests.benchmarks.recordings import record
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.connection import connect
from webots_mcp.questions.monitor import look_back
from webots_mcp.store.analysis.arrays import Array
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.questions.events import find_events
from webots_mcp.store.questions.series import query_history
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, find_range, whole_run
from webots_mcp.store.recording import Recording

_SMALL: Final = 10_000  # rows
_LARGE: Final = 1_000_000
_TURNS: Final = 5
_SIGNAL: Final = "pose.0"
_THIRTY: Final = (
    "pose", "wheels", "ds", "imu", "accel", "gyro", "encoders", "errors", "battery_v",
    "commanded_m_s",
)  # fmt: skip
_JSON_BYTES: Final = (
    "SELECT sum(pgsize) FROM dbstat WHERE name IN ('state', 'ix_state_run_id_sim_time_s')"
)
_CHUNK_BYTES: Final = (
    "SELECT sum(pgsize) FROM dbstat WHERE name LIKE '%chunk%' OR name LIKE '%row_group%'"
)
_ROWS: Final = "SELECT id, data FROM state ORDER BY id LIMIT 100000"


@benchmark("chunks", "the past in chunks, beside JSON rows and arrays in memory")
def measure_chunks(bench: Bench) -> Iterable[Line]:
    rows = bench.rows or (_LARGE if bench.effort >= 1 else bench.count(10 * _SMALL, least=2000))
    bench.say(f"building {rows:,} rows")
    file = bench.folder / "webots.db"
    record(file, rows)
    with closing(connect(file, "reader")) as db:
        yield _size(db, "rounded")
        yield from _reading(db)
        for what, ask, limit_s in _questions(db, file):
            bench.say(what)
            taken = Samples.of(time_calls(lambda _, ask=ask: ask(), _TURNS)).p50
            yield Line(f"{what}, {rows:,} rows", duration(taken), "", 1e3 * taken, "ms",
                       Target(1e3 * limit_s) if rows == _LARGE else None)  # fmt: skip
    bench.say("full mantissas")
    full = bench.place("full mantissas") / "webots.db"
    record(full, min(rows, 5 * _SMALL))
    with closing(connect(full, "writer")) as db:
        _unround(db)
        with closing(connect(full, "reader")) as reader:
            yield _size(reader, "full mantissas")


def _size(db: sqlite3.Connection, what: str) -> Line:
    (rows,), (chunks,) = db.execute(_JSON_BYTES).fetchone(), db.execute(_CHUNK_BYTES).fetchone()
    target = Target(0.2 if what == "rounded" else 0.5)
    beside = f"JSON rows and their index {rows / 1e6:,.1f} MB"
    return Line(f"chunks, {what}", f"{chunks / 1e6:,.1f} MB", beside, chunks / rows, target=target)


def _unround(db: sqlite3.Connection) -> None:
    """Give every number all its digits, and make the chunks anew."""
    noise = np.random.default_rng(1)

    def unrounded(value: Any) -> Any:
        if isinstance(value, float):
            return value * (1 + 1e-9 * float(noise.standard_normal()))
        if isinstance(value, list):
            return [unrounded(each) for each in value]
        if isinstance(value, dict):
            return {key: unrounded(each) for key, each in value.items()}
        return value

    db.execute("BEGIN")
    for row_id, data in db.execute(_ROWS).fetchall():
        text = json.dumps(unrounded(json.loads(data)), separators=(",", ":"))
        db.execute("UPDATE state SET data = ? WHERE id = ?", (text, row_id))
    for table in ("chunk", "row_group", "watermark"):
        db.execute(f"DELETE FROM {table}")
    db.execute("UPDATE run SET is_chunked = 0")
    db.execute("COMMIT")
    make_chunks(db, 2**62)
    db.execute("VACUUM")


def _reading(db: sqlite3.Connection) -> Iterator[Line]:
    """Values and statistics of one signal, beside the same of an array in memory."""
    segment = whole_run(db, 1)
    assert segment is not None

    def values(_: int) -> object:
        return read_frame(db, segment, Deadline(60)).numbers(_SIGNAL)

    array: Array = np.array(read_frame(db, segment, Deadline(60)).numbers(_SIGNAL))
    taken = Samples.of(time_calls(values, _TURNS)).p50
    copied = Samples.of(time_calls(lambda _: np.array(array), _TURNS)).p50
    what = f"every value of one signal, {len(array):,} rows"
    beside = f"numpy, a copy {duration(copied)}"
    limit = Target(30) if len(array) == _LARGE else None
    yield Line(what, duration(taken), beside, 1e3 * taken, "ms", limit)
    zones = Samples.of(
        time_calls(lambda _: read_frame(db, segment, Deadline(60)).zones(_SIGNAL), _TURNS)
    ).p50
    reduced = Samples.of(time_calls(lambda _: (array.min(), array.max(), array.mean()), _TURNS)).p50
    beside = f"numpy, min, max and mean {duration(reduced)}"
    yield Line("statistics of its chunks", duration(zones), beside, zones / reduced)


def _questions(
    db: sqlite3.Connection, file: Path
) -> Iterator[tuple[str, Callable[[], object], float]]:
    """What is asked, how, and what is aimed at for a million rows, in seconds."""
    whole, hour = find_range(db, Scope()), 3600.0
    rare = EventOptions(kinds=("condition",), where="battery_v < 1 and pose.0 > 1000")
    yield "find_events of all kinds", lambda: find_events(db, whole), 1.2
    yield "a condition that never held", lambda: find_events(db, whole, rare), 0.3
    yield "trends of 30 signals", lambda: trends(db, whole, _THIRTY), 0.3
    yield "overview of one signal", lambda: query_history(db, whole, [_SIGNAL]), 0.05
    recording = Recording(file, file.parent)
    yield "monitor, an hour back", lambda: look_back(recording, None, hour), 0.4
