"""Keeping a recording: its size on the disk, export, import, and purging beside a robot."""

from __future__ import annotations

import importlib.util
import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Final

from tests.benchmarks.measuring import Samples
from tests.benchmarks.processes import Program
from tests.benchmarks.recordings import record
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.table import Line, Target, duration
from webots_mcp.connection import connect, create_schema
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.store.export import FORMATS, export_file
from webots_mcp.store.json_folder import import_folder
from webots_mcp.store.purge import Purged, prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention import Limit, Retention

_ROWS: Final = 100_000
_ROBOT_STEPS: Final = 100  # of 8 ms, between two looks whether the purge is over
_SHORT_WAIT_MS: Final = 100
_SIZES: Final = (
    "SELECT name, sum(pgsize) FROM dbstat WHERE name NOT IN ('log', 'ix_log_run_id_sim_time_s') "
    "GROUP BY name"
)
_CHUNKS: Final = ("chunk", "ix_chunk_statistics", "ix_chunk_group_id", "row_group")
_TIME_INDEX: Final = "ix_state_run_id_sim_time_s"
_READ: Final = "SELECT run_id, id, sim_time_s, wall_time_s, data FROM state"
_INSERT_LINE: Final = (
    "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
    "VALUES (1, ?, ?, 'info', 'controller', ?)"
)


@benchmark("keeping", "keeping a recording: export, import, purging beside a robot, the disk")
def measure_keeping(bench: Bench) -> Iterable[Line]:
    rows = bench.count(_ROWS, least=300)
    bench.say(f"building {rows:,} rows")
    file = bench.folder / DATABASE_NAME
    record(file, rows)
    yield from _exports(bench, file, rows)
    yield from _import(bench, rows)
    disk = _sizes_of(file)
    yield from _purge(bench, file)
    yield from _disk(disk, rows)


def _exports(bench: Bench, file: Path, rows: int) -> Iterable[Line]:
    with closing(connect(file, "reader")) as db:
        whole = find_range(db, Scope())
        naive = _rate(rows, lambda: _copy_as_json_lines(db, bench.folder / "naive"))
        for form in FORMATS:
            if form == "parquet" and not importlib.util.find_spec("pyarrow"):
                continue
            bench.say(f"export, {form}")
            target = bench.folder / f"rows.{form}"
            ours = _rate(rows, lambda form=form, to=target: export_file(db, whole, form, to))
            size = f"{target.stat().st_size / rows:,.0f} bytes a row"
            beside = f"json.loads, json.dumps of each row {naive:,.0f}/s"
            what = f"export to {form}, {rows:,} rows, {size}"
            yield Line(what, f"{ours:,.0f}/s", beside, ours / naive)


def _copy_as_json_lines(db: sqlite3.Connection, target: Path) -> None:
    """What one writes who wants the rows out: nothing is flattened."""
    with target.open("w") as sink:
        for *stamp, data in db.execute(_READ):
            sink.write(json.dumps([*stamp, json.loads(data)]) + "\n")


def _import(bench: Bench, lines: int) -> Iterable[Line]:
    bench.say(f"import, {lines:,} lines")
    folder = bench.place("folder")
    _write_folder(folder, lines)
    with closing(connect(bench.place("imported") / DATABASE_NAME, "writer", create=True)) as db:
        create_schema(db)
        ours = _rate(lines, lambda: import_folder(db, folder, bench.folder / "imported"))
        naive = _rate(lines, lambda: _insert_lines(db, folder / "logs" / "controller.log"))
    beside = f"split, executemany {naive:,.0f}/s"
    yield Line(f"import of a folder, {lines:,} log lines", f"{ours:,.0f}/s", beside, ours / naive)


def _write_folder(folder: Path, lines: int) -> None:
    (folder / "logs").mkdir()
    clocks = (time.strftime("%H:%M:%S", time.gmtime(number // 10)) for number in range(lines))
    text = "".join(f"[{clock}] waypoint reached, turning to the next\n" for clock in clocks)
    (folder / "logs" / "controller.log").write_text(text)


def _insert_lines(db: sqlite3.Connection, log: Path) -> None:
    def row(line: str) -> tuple[float, float, str]:
        clock, _, message = line.rstrip("\n").partition(" ")
        hours, minutes, seconds = map(int, clock.strip("[]").split(":"))
        time_s = 3600.0 * hours + 60 * minutes + seconds
        return time_s, time_s, message

    with log.open() as source:
        db.execute("BEGIN IMMEDIATE")
        db.executemany(_INSERT_LINE, map(row, source))
        db.execute("COMMIT")


def _purge(bench: Bench, file: Path) -> Iterable[Line]:
    """Half of the rows go, in a process beside the robot's."""
    bench.say("purge beside a robot")
    with Program("crowd_robot", bench.folder, 1) as robot:
        robot.hear()
        purge = _Purge(file)
        purge.start()
        beside_purge = _drive_while(robot, purge.is_alive)
        blocks = iter(range(len(beside_purge)))
        alone = _drive_while(robot, lambda: next(blocks, None) is not None)
    ours, undisturbed = Samples(beside_purge), Samples(alone)
    what = "publish() of a robot beside it"
    beside = f"with no purge {duration(undisturbed.worst)}"
    yield Line(f"worst {what}", duration(ours.worst), beside, ours.worst * 1e3, "ms", Target(5))
    beside = f"with no purge {duration(undisturbed.p50)}"
    yield Line(f"p50 {what}", duration(ours.p50), beside, ours.p50 / undisturbed.p50)
    rows = purge.purged.rows["state"]
    freed = f"{purge.purged.freed_bytes / 1e6:.1f} MB freed"
    yield Line(f"purge of {rows:,} rows", duration(purge.took_s), freed, rows / purge.took_s, "/s")


class _Purge(threading.Thread):
    """Deletes the older half of the rows, with the pauses that it makes for others."""

    def __init__(self, file: Path) -> None:
        super().__init__(name="purge")
        self._file = file
        self.purged = Purged()
        self.took_s = 0.0

    def run(self) -> None:
        with closing(connect(self._file, "writer")) as db:
            db.execute(f"PRAGMA busy_timeout={_SHORT_WAIT_MS}")
            left = db.execute("SELECT count(*) FROM state").fetchone()[0] // 2
            retention = Retention(state=Limit(rows=left, spared_rows=0))
            started = time.perf_counter()
            self.purged = prune(db, self._file.parent, retention)
            self.took_s = time.perf_counter() - started


def _drive_while(robot: Program, goes_on: Callable[[], bool]) -> list[list[float]]:
    """Durations of publish() in seconds, in blocks; one block at least."""
    blocks: list[list[float]] = []
    while goes_on() or not blocks:
        blocks.append(robot.ask(f"bridge {_ROBOT_STEPS}")["durations"])
    return blocks


def _sizes_of(file: Path) -> dict[str, int] | None:
    """Bytes by table and index, but for log lines, where SQLite was built to tell."""
    with closing(connect(file, "reader")) as db:
        try:
            return dict(db.execute(_SIZES).fetchall())
        except sqlite3.OperationalError as error:
            if "dbstat" not in str(error):
                raise
            return None


def _disk(sizes: dict[str, int] | None, rows: int) -> Iterable[Line]:
    if sizes is None:
        raise NotMeasurableError("this SQLite cannot tell the size of a table (no dbstat)")
    raw = sizes["state"] + sizes[_TIME_INDEX]
    beside = f"JSON rows and their time index {raw / rows:,.0f} bytes a row"
    total = sum(sizes.values())
    ours = f"{total / rows:,.0f} bytes a row"
    yield Line(f"disk, {rows:,} rows", ours, beside, total / raw, target=Target(1.05))
    chunks = sum(sizes[name] for name in _CHUNKS)
    for what, part in (("chunks", chunks), ("time index", sizes[_TIME_INDEX])):
        yield Line(f"of it {what}", f"{part / rows:.1f} bytes a row", "", 100 * part / total, "%")


def _rate(items: int, work: Callable[[], object]) -> float:
    """Items a second."""
    started = time.perf_counter()
    work()
    return items / (time.perf_counter() - started)
