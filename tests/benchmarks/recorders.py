"""Ways to record a state in each step of one loop: what each costs, and what a kill leaves of it.

`python -m tests.benchmarks.recorders WAY FOLDER` records without end, and prints the rows so far.
"""

from __future__ import annotations

import json
import os
import random
import sqlite3
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

from tests.accuracy.page import table
from tests.benchmarks.core import Bench, Samples, alternate, duration, ratio
from tests.benchmarks.processes import environment
from tests.benchmarks.ways import ORJSON, BridgeWay, RawSqlite, Rover, State, make_states
from webots_mcp.bridge import encoding
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.waiting_file import adopt

_STEPS: Final = 125  # in a block: a second
_LIFE_S: Final = (1.0, 3.0)
_FILE: Final = "recorded"

Publish = Callable[[State], object]
Recording = tuple[Publish, Callable[[], object]]  # and what closes it


class Way(NamedTuple):
    """One way to record.

    Attributes:
        begin: Opens a recording in a folder.
        readable: How many states can be read there, by the reader of its library.
        answers: Whether a question can be asked of it while it is recorded, and how.
    """

    begin: Callable[[Path], Recording]
    readable: Callable[[Path], int]
    answers: str


def _bridge(folder: Path, *, orjson: bool, polls: bool = False) -> Recording:
    robot = Rover()
    way = BridgeWay(robot, folder)

    def publish(state: State) -> None:
        encoding.orjson = ORJSON if orjson else None
        robot.step(8)
        way.publish(state)
        if polls:
            way.get_command()

    return publish, way.close


def _count_bridge(folder: Path) -> int:
    with closing(connect(folder / DATABASE_NAME, "writer")) as connection:
        adopt(connection, folder / DATABASE_NAME)
        return connection.execute("SELECT count(*) FROM state").fetchone()[0]


def _raw(folder: Path) -> Recording:
    way = RawSqlite(folder)
    return way.publish, way.close


def _count_raw(folder: Path) -> int:
    with closing(sqlite3.connect(folder / "raw.db")) as connection:
        return connection.execute("SELECT count(*) FROM state").fetchone()[0]


def _json_lines(folder: Path) -> Recording:
    file = (folder / _FILE).open("w")

    def publish(state: State) -> None:
        file.write(json.dumps({"wall_time_s": time.time(), **state}) + "\n")
        file.flush()

    return publish, file.close


def _count_lines(folder: Path) -> int:
    with (folder / _FILE).open() as lines:
        return sum(line.endswith("\n") for line in lines)


def _json_file(folder: Path) -> Recording:
    """As a controller that shares its newest state by a file: it is written anew for each."""

    def publish(state: State) -> None:
        with (folder / _FILE).open("w") as file:
            json.dump(state, file, indent=2)

    return publish, lambda: None


def _count_file(folder: Path) -> int:
    with suppress(ValueError):
        json.loads((folder / _FILE).read_text())
        return 1
    return 0


def _mcap(folder: Path, *, chunks: bool) -> Recording:
    sink = (folder / _FILE).open("wb")
    writer = import_module("mcap.writer").Writer(sink, use_chunking=chunks)
    writer.start()
    schema = writer.register_schema("state", "jsonschema", b'{"type":"object"}')
    channel = writer.register_channel("/state", "json", schema)

    def publish(state: State) -> None:
        now = time.time_ns()
        writer.add_message(channel, now, json.dumps(state).encode(), now)
        if not chunks:
            sink.flush()

    return publish, lambda: (writer.finish(), sink.close())


def _count_mcap(folder: Path) -> int:
    """By the reader of streams: the other one wants the end that a killed writer did not write."""
    found = 0
    with (folder / _FILE).open("rb") as file, suppress(Exception):
        reader = import_module("mcap.reader").NonSeekingReader(file)
        for _ in reader.iter_messages(log_time_order=False):
            found += 1
    return found


def _rerun(folder: Path, *, arrays: bool) -> Recording:
    rerun: Any = import_module("rerun")
    stream = rerun.RecordingStream("benchmark")
    stream.save(str(folder / _FILE))

    def publish(state: State) -> None:
        stream.set_time("wall_time", timestamp=time.time())
        numbers = dict(_numbers(state, "state"))
        if arrays:
            numbers = {"state": [each for value in numbers.values() for each in value]}
        for name, values in numbers.items():
            stream.log(name, rerun.Scalars(values))

    return publish, stream.disconnect


def _numbers(value: Any, name: str) -> Iterator[tuple[str, list[float]]]:
    """Numbers and lists of numbers by the path at which they stand; texts are left out."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _numbers(each, f"{name}/{key}")
    elif not isinstance(value, str):
        yield name, value if isinstance(value, list) else [float(value)]


def _count_rerun(folder: Path, *, entity: str) -> int:
    found = 0
    with warnings.catch_warnings(), suppress(Exception):
        warnings.simplefilter("ignore")  # a file that was not closed is said to have no end
        reader: Any = import_module("rerun.chunk").RrdReader(str(folder / _FILE))
        for chunk in reader.stream():
            found += chunk.to_record_batch().num_rows if chunk.entity_path == entity else 0
    return found


_SQL: Final = "SQL, by any process"
_STREAM: Final = "what is complete, by a program of your own"
WAYS: Final[dict[str, Way]] = {
    "raw sqlite3": Way(_raw, _count_raw, _SQL),
    "bridge": Way(partial(_bridge, orjson=True), _count_bridge, f"{_SQL}; tools"),
    "bridge and get_command": Way(
        partial(_bridge, orjson=True, polls=True), _count_bridge, f"{_SQL}; tools; steering"
    ),
    "bridge without orjson": Way(partial(_bridge, orjson=False), _count_bridge, f"{_SQL}; tools"),
    "JSON lines, flushed": Way(_json_lines, _count_lines, _STREAM),
    "JSON file, anew each step": Way(_json_file, _count_file, "the newest state alone"),
    "MCAP, as by default": Way(partial(_mcap, chunks=True), _count_mcap, _STREAM),
    "MCAP, no chunks, flushed": Way(partial(_mcap, chunks=False), _count_mcap, _STREAM),
    "Rerun, an entity per signal": Way(
        partial(_rerun, arrays=False),
        partial(_count_rerun, entity="/state/battery_j"),
        "its viewer",
    ),
    "Rerun, one array": Way(
        partial(_rerun, arrays=True), partial(_count_rerun, entity="/state"), "its viewer"
    ),
}


def loop(bench: Bench) -> Iterator[str]:
    """What a call costs between steps of 8 ms in which the process sleeps."""
    steps, rounds = min(_STEPS, bench.count(5 * _STEPS, least=5)), bench.count(20)
    states = make_states(steps * (rounds + 1))  # no two alike: some ways compress
    opened = {name: way.begin(bench.place(name)) for name, way in WAYS.items()}
    opened["nothing"] = (lambda state: None, lambda: None)

    numbers = {name: count() for name in opened}

    def block(name: str) -> tuple[list[float], float]:
        publish, number = opened[name][0], numbers[name]
        robot, durations, used_s = Rover(), list[float](), time.process_time()
        for _ in range(steps):
            robot.pace()
            state = states[next(number)]
            started_s = time.perf_counter()
            publish(state)
            durations.append(time.perf_counter() - started_s)
        return durations, (time.process_time() - used_s) / steps

    bench.say("a loop of 8 ms steps")
    taken = alternate({name: partial(block, name) for name in opened}, rounds)
    encoding.orjson = ORJSON
    for _, close in opened.values():
        close()
    calls = {name: Samples([each for each, _ in found]) for name, found in taken.items()}
    used_s = {name: median(each for _, each in found) for name, found in taken.items()}
    raw, rows = calls["raw sqlite3"], list[list[str]]()
    for name, way in WAYS.items():
        here = bench.folder / name
        kept = sum(file.stat().st_size for file in here.rglob("*") if file.is_file())
        states_kept = max(1, way.readable(here))
        rows.append([name, duration(calls[name].p50), f"{ratio(calls[name], raw):.2f}",
                     duration(calls[name].above(0.99)), duration(used_s[name] - used_s["nothing"]),
                     f"{kept / states_kept:.0f}", way.answers])  # fmt: skip
    ours, both = calls["bridge"], calls["bridge and get_command"]
    yield (
        f"A recorded `publish()` of 39 values takes {duration(ours.p50)} of an 8 ms step, "
        f"{ratio(ours, raw):.2f} times a raw `sqlite3` insert. With `get_command()` it takes "
        f"{ratio(both, raw):.2f} times as long as the insert."
    )
    yield _LOOP.format(blocks=rounds, steps=steps)
    heads = ("call, median", "x raw sqlite3", "1 in 100 longer than", "processor, a step")
    yield table(("recorder", *heads, "bytes a state", "readable while it records"), rows)


_LOOP: Final = """\
In each step of 8 ms, one process sleeps and then records a state of 39 values (740 bytes of
JSON). The recorders take turns in {blocks} blocks of {steps} steps; the ratio is the median of
the ratios of neighbouring blocks. "Processor" is the time of the whole process with its threads,
minus that of a loop that records nothing. The bridge encodes with orjson, which is installed with
it; in a Python without orjson it uses `json`. The recorders do different work: the bridge also
stores runs, changes, signals and commands. Rerun writes in its own threads and leaves out texts
here. MCAP compresses 1 MB in the call that fills a chunk. None calls `fsync` in the loop, so a
power cut may cost the newest states; this was not tried."""


def survival(bench: Bench) -> Iterator[str]:
    """Kill a process that records, at a moment by chance, and read what it left."""
    kills, rows = bench.count(10), list[list[str]]()
    for name in WAYS:
        lost, written, unread = list[int](), 0, 0
        for life in range(kills):
            bench.say(f"{name}: {life} of {kills} kills")
            folder = bench.place(f"{name} {life}")
            life_s = random.Random(life).uniform(*_LIFE_S) * min(1.0, 10 * bench.effort)
            said = _killed(name, folder, life_s)
            there = WAYS[name].readable(folder)
            written += said
            lost.append(max(0, said - there))
            unread += not there
        total = sum(lost)
        rows.append([name, f"{written:,}", f"{total:,}", f"{median(lost):,.0f}",
                     f"{max(lost):,}", f"{unread} of {kills}"])  # fmt: skip
    ours, mcap = (rows[list(WAYS).index(each)] for each in ("bridge", "MCAP, as by default"))
    yield (
        f"In {kills} kills the bridge lost {ours[2]} of {ours[1]} recorded states, and MCAP with "
        f"its defaults {mcap[2]} of {mcap[1]}."
    )
    yield _KILLED.format(kills=kills)
    yield table(
        ("recorder", "states written", "lost", "by a kill, median", "most", "nothing readable"),
        rows,
    )


_KILLED: Final = """\
The same recorders, each in a process of its own, record without a pause and are killed (SIGKILL)
{kills} times after 1 to 3 s. A state is lost if the process reported it as written, but the
library's reader does not find it. For MCAP, the stream reader is used, because the other one
needs a closed file. A recorder that keeps a chunk or batch in memory loses it, and is faster for
that."""


def _killed(name: str, folder: Path, life_s: float) -> int:
    """Let a process record, kill it, and give how many states it had written by its own account."""
    line = [sys.executable, "-m", "tests.benchmarks.recorders", name, str(folder)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=environment()) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(life_s)
        process.kill()
        rest = process.stdout.read()
    whole = [each for each in (first + rest).splitlines(keepends=True) if each.endswith("\n")]
    return int(whole[-1])


def main(name: str, folder: str) -> None:
    """Record in loops of half a millisecond, and say after each call how many states that makes."""
    publish, _ = WAYS[name].begin(Path(folder))
    states, number = make_states(), 0
    while True:
        publish(states[number % len(states)])
        number += 1
        os.write(1, b"%d\n" % number)
        time.sleep(0.0005)


if __name__ == "__main__":
    main(*sys.argv[1:])
