"""Jumps of signals that change seldom, in runs that are too long to be read row by row."""

from __future__ import annotations

import sqlite3
from itertools import count

from tests.recordings.rover import start_run
from webots_mcp.store.chunks.making import make_chunks
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.extent import Detection
from webots_mcp.store.detection.registry import asked_kinds
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.signals.catalogue import known_signals

STEP_S = 0.1
ROWS = 9000


def record(connection: sqlite3.Connection, values: list[float]) -> None:
    recorder = start_run(connection)
    for step, value in enumerate(values):
        recorder.publish(step * STEP_S, {"level": value, "pose": [step * 0.02, 0.0]})
    connection.execute("UPDATE run SET last_sim_time_s = ?", (len(values) * STEP_S,))
    while not make_chunks(connection, 100_000).done:
        pass


def test_the_rest_of_a_stretch_that_is_being_read_when_time_ends_is_named(
    empty: sqlite3.Connection,
) -> None:
    record(empty, [step % 7 * 0.1 for step in range(ROWS)])
    asked = find_range(empty, Scope())
    options = EventOptions(kinds=("oscillation",), signals=("level",), min_half_periods=8)
    kinds, cut = asked_kinds(options), set[str]()
    for limit in range(4, 120):
        ticks, ledger = count(), Ledger()
        deadline = Deadline(float(limit), lambda ticks=ticks: next(ticks))
        known = known_signals(empty, asked)
        Detection(empty, known, kinds, options, deadline, ledger).events_touching(asked.segments[0])
        why = ledger.verdicts(kinds, []).not_searched.get("oscillation", "")
        cut |= {why} if "s on: time limit reached, ask start_s=" in why else set()
    assert cut
