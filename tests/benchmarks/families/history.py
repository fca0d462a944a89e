"""Questions about the past, beside the same asked in plain SQL of the JSON rows."""

from __future__ import annotations

import importlib.util
import math
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from tests.benchmarks.measuring import Samples, time_calls
from tests.benchmarks.recordings import end_s, record
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target, duration
from tests.recordings.long import CYCLE_S
from webots_mcp.connection import connect
from webots_mcp.plotting import plot
from webots_mcp.questions.monitor import look_back
from webots_mcp.store.detection.events import find_events, timeline
from webots_mcp.store.detection.kinds import EventOptions
from webots_mcp.store.logs import LogFilter, Window, count_lines, newest_lines
from webots_mcp.store.questions.series import query_history
from webots_mcp.store.questions.trends import trends
from webots_mcp.store.reading.catalogue import list_signals
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import Recording

_SMALL: Final = 10_000  # rows
_LARGE: Final = 1_000_000
_TURNS: Final = 5
_ENOUGH_S: Final = 0.5  # a contender that took that long is not asked again
_MINUTE_S: Final = 60.0
_TEN_MINUTES_S: Final = 600.0
_HOUR_S: Final = 3600.0
_POINTS: Final = 50
_OVERVIEW: Final = "pose.0"
_TEN: Final = ("pose", "ds.0", "ds.1", "ds.2", "battery_v", "imu.roll", "imu.pitch", "accel.0")
_THIRTY: Final = (
    "pose", "wheels", "ds", "imu", "accel", "gyro", "encoders", "errors", "battery_v",
    "commanded_m_s",
)  # fmt: skip
_LAG: Final = "lag() over the mode alone"
_WHOLE: Final = Window(-math.inf, math.inf)
_NUMBERS: Final = (
    "SELECT name, path FROM signal WHERE kind IN ('num', 'angle') AND reduction IS NULL"
)
_CHANGES: Final = (
    "SELECT * FROM (SELECT sim_time_s, json_extract(data, '$.mode') AS mode, "
    "lag(json_extract(data, '$.mode')) OVER (ORDER BY sim_time_s) AS before "
    "FROM state WHERE run_id = 1) WHERE mode <> before"
)


@dataclass(frozen=True)
class Question:
    """Something to ask of a recording.

    Args:
        what: What is asked.
        ask: Our way.
        naive: The plain SQL that finds at most as much.
        beside: What that SQL does.
        at_most_s: What is aimed at, at any size.
        at_most: What is aimed at as a share of the naive query's time, from a million rows on.
    """

    what: str
    ask: Callable[[], object]
    naive: str
    beside: str = "json_extract of the rows"
    at_most_s: float | None = None
    at_most: float | None = None


@benchmark("history", "questions about the past, beside plain SQL over the JSON rows")
def measure_history(bench: Bench) -> Iterable[Line]:
    minutes: list[Samples] = []
    for rows in _sizes(bench):
        bench.say(f"building {rows:,} rows")
        file = bench.folder / f"{rows}.db"
        record(file, rows)
        with closing(connect(file, "reader")) as db:
            for question in (*_questions(db, rows), *_looks_back(db, file)):
                bench.say(f"{rows:,} rows, {question.what}")
                taken = _take_turns(db, question, min(_TURNS, bench.count(50)))
                minutes += [taken["ours"]] if question.what.startswith("last minute") else []
                yield from _lines(question, rows, taken)
            yield from _stuck(db, rows)
        file.unlink()
    yield from _growth(minutes)


def _sizes(bench: Bench) -> list[int]:
    """The small one always (less in the smallest of runs), the large one in full runs."""
    large = [bench.rows] if bench.rows else [_LARGE] if bench.effort >= 1 else []
    return [min(_SMALL, bench.count(10 * _SMALL, least=200)), *large]


def _questions(db: sqlite3.Connection, rows: int) -> Iterator[Question]:
    whole, minute, ten = (
        find_range(db, Scope(last_s=last_s)) for last_s in (None, _MINUTE_S, _TEN_MINUTES_S)
    )
    numbers: dict[str, str] = dict(db.execute(_NUMBERS))
    length_s = end_s(rows)
    ten_paths = [numbers[name] for signal in _TEN for name in _of_signal(numbers, signal)]
    scan = partial(_scan, length_s=length_s)
    yield Question(
        "last minute of 10 signals",
        lambda: query_history(db, minute, _TEN),
        scan(ten_paths, _MINUTE_S),
        at_most_s=0.025,
    )
    yield Question(
        "whole run, 1 signal",
        lambda: query_history(db, whole, [_OVERVIEW]),
        scan([numbers[_OVERVIEW]], length_s),
        at_most_s=0.050,
        at_most=0.01,
    )
    yield Question(
        "list_signals",
        lambda: list_signals(db),
        "SELECT count(*) FROM state",
        "count(*)",
        at_most_s=0.020,
    )
    yield Question(
        "trends of all signals, whole run",
        lambda: trends(db, whole),
        scan(list(numbers.values()), length_s),
    )
    thirty_paths = [numbers[name] for signal in _THIRTY for name in _of_signal(numbers, signal)]
    yield Question(
        "trends of 30 signals, 10 minutes",
        lambda: trends(db, ten, _THIRTY),
        scan(thirty_paths, _TEN_MINUTES_S),
        at_most_s=0.4,
    )
    yield Question(
        "find_events of all kinds, whole run",
        lambda: find_events(db, whole),
        _CHANGES,
        _LAG,
        at_most_s=1.0,
    )
    yield Question("timeline", lambda: timeline(db, whole), _CHANGES, _LAG, at_most_s=0.050)
    asked = LogFilter(1, _WHOLE, text="SLIP")
    yield Question(
        f"log search, {int(length_s):,} lines",
        lambda: (newest_lines(db, asked, 50), count_lines(db, asked)),
        "SELECT * FROM log WHERE run_id = 1 AND message LIKE '%slip%' ORDER BY sim_time_s",
        "LIKE",
    )
    if importlib.util.find_spec("resvg_py"):
        path = numbers[_OVERVIEW]
        yield Question(
            "plot, whole run, 1 signal",
            lambda: plot(db, "signals", [_OVERVIEW]),
            f"SELECT sim_time_s, json_extract(data, '{path}') FROM state WHERE run_id = 1",
            "every point read, none drawn",
            at_most_s=1.2,
        )
        yield Question(
            "plot, way of the robot",
            lambda: plot(db, "trajectory"),
            f"SELECT sim_time_s, json_extract(data, '{path}') FROM state WHERE run_id = 1",
            "one coordinate read, none drawn",
            at_most_s=1.2,
        )


def _looks_back(db: sqlite3.Connection, file: Path) -> Iterator[Question]:
    """What the monitor answers at once, of as much as there is."""
    yield Question(
        "monitor, an hour back",
        lambda: look_back(Recording(file, file.parent), None, _HOUR_S),
        _scan(["$.pose[0]"], _HOUR_S, length_s=end_s(_rows_in(db))),
        at_most_s=1.0,
    )


def _rows_in(db: sqlite3.Connection) -> int:
    return db.execute("SELECT row_count FROM run").fetchone()[0]


def _of_signal(numbers: Mapping[str, str], signal: str) -> list[str]:
    return [name for name in numbers if name == signal or name.startswith(f"{signal}.")]


def _scan(paths: list[str], last_s: float, *, length_s: float) -> str:
    """Extremes and means in as many buckets as an answer has, by the index on time."""
    found = ", ".join(
        f"{reduce}(json_extract(data, '{path}'))"
        for path in paths
        for reduce in ("min", "max", "avg")
    )
    bucket = f"CAST(sim_time_s * {_POINTS} / {min(last_s, length_s)} AS INTEGER)"
    where = f"run_id = 1 AND sim_time_s >= {length_s - last_s}"
    return f"SELECT {bucket}, {found} FROM state WHERE {where} GROUP BY 1"


def _take_turns(db: sqlite3.Connection, question: Question, turns: int) -> dict[str, Samples]:
    """Up to so many times each in turn, seconds; what takes long is asked less often."""
    contenders: dict[str, Callable[[int], object]] = {
        "ours": lambda _: question.ask(),
        "naive": lambda _: db.execute(question.naive).fetchall(),
    }
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(turns):
        for name, call in contenders.items():
            if sum(spent[name]) < _ENOUGH_S:
                spent[name] += time_calls(call, 1)
    return {name: Samples.of(singles) for name, singles in spent.items()}


def _lines(question: Question, rows: int, taken: dict[str, Samples]) -> Iterable[Line]:
    ours, naive = taken["ours"].p50, taken["naive"].p50
    what = f"{question.what}, {rows:,} rows"
    texts = what, duration(ours), f"{question.beside} {duration(naive)}"
    aimed = question.at_most is not None and rows >= _LARGE
    yield Line(*texts, ours / naive, target=Target(question.at_most or 0) if aimed else None)
    if question.at_most_s is not None:
        yield Line(*texts, 1e3 * ours, "ms", Target(1e3 * question.at_most_s))


def _stuck(db: sqlite3.Connection, rows: int) -> Iterable[Line]:
    """Of a long run the statistics of chunks tell where to look: nothing may be missed."""
    expected = max(0, math.ceil((end_s(rows) - 46) / CYCLE_S))  # each ends 46 s into its cycle
    stuck = find_events(db, find_range(db, Scope()), EventOptions(kinds=("stuck",)))
    found = stuck.verdicts.found.get("stuck", 0)
    what, beside = f"stuck places, {rows:,} rows", f"in the recording {expected:,}"
    yield Line(what, f"found {found:,}", beside, abs(expected - found), "off", Target(0))


def _growth(minutes: list[Samples]) -> Iterable[Line]:
    if len(minutes) == 2:
        small, large = (taken.p50 for taken in minutes)
        what = "last minute, the long recording beside the short"
        yield Line(what, duration(large), duration(small), large / small, target=Target(2))
