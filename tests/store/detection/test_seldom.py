"""Jumps of signals that change seldom, in runs that are too long to be read row by row."""

from __future__ import annotations

import random
import sqlite3
from itertools import count

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.extent import Detection
from webots_mcp.store.detection.registry import asked_kinds
from webots_mcp.store.detection.verdict import Ledger
from webots_mcp.store.questions.events import Events, find_events
from webots_mcp.store.reading import rows, views
from webots_mcp.store.reading.deadline import Deadline
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.rollup.rolling import roll
from webots_mcp.store.signals.catalogue import known_signals

STEP_S = 0.1
ROWS = 9000


def record(connection: sqlite3.Connection, values: list[float]) -> None:
    recorder = start_run(connection)
    for step, value in enumerate(values):
        recorder.publish(step * STEP_S, {"level": value, "pose": [step * 0.02, 0.0]})
    connection.execute("UPDATE run SET last_sim_time_s = ?", (len(values) * STEP_S,))
    while not roll(connection, 100_000).done:
        pass


def ask(connection: sqlite3.Connection) -> Events:
    options = EventOptions(kinds=("jump",))
    return find_events(connection, find_range(connection, Scope()), options, group=False)


def steps(connection: sqlite3.Connection) -> set[float]:
    """When a value jumped: away, or away and back."""
    return {time_s for each in ask(connection).events for time_s in (each.start_s, each.end_s)}


def seldom(seed: int) -> list[float]:
    """Steps of about 1 every 20 s or so, a few large ones, and values that are back at once."""
    draw = random.Random(seed)
    values: list[float] = []
    level = 10.0
    while len(values) < ROWS:
        values += [level] * draw.randint(20, 400)
        if draw.random() < 0.2:
            values += [level - draw.choice((0.4, 45.0))] * draw.randint(1, 5)
        else:
            level += draw.choice((1.0, -1.0)) * draw.choice((0.9, 1.0, 1.1, 1.0, 1.2, 30.0))
    return [round(value, 3) for value in values[:ROWS]]


@pytest.mark.parametrize("seed", range(6))
def test_rollups_rule_out_no_jump_that_the_rows_show(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with memory_connection() as connection:
        record(connection, seldom(seed))
        shown = steps(connection)
        monkeypatch.setattr(rows, "RAW_ROWS", 500)
        monkeypatch.setattr(views, "SAMPLE_ROWS", 15)
        assert shown
        assert shown <= steps(connection)


def test_what_only_steps_seldom_is_searched_without_its_rows(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(empty, [float(step // 150) for step in range(ROWS)])
    monkeypatch.setattr(rows, "RAW_ROWS", 500)
    monkeypatch.setattr(views, "JUMP_ROWS", 1000)
    monkeypatch.setattr(views, "SAMPLE_ROWS", 100)
    found = ask(empty)
    assert found.totals == {}
    assert "of level only" not in found.verdicts.not_searched.get("jump", "")


def test_the_rest_of_a_stretch_that_is_being_read_when_time_ends_is_named(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(empty, [step % 7 * 0.1 for step in range(ROWS)])
    monkeypatch.setattr(rows, "RAW_ROWS", 500)
    monkeypatch.setattr(rows, "_CHUNK_ROWS", 50)
    monkeypatch.setattr(views, "STRETCH_ROWS", 2000)
    asked = find_range(empty, Scope())
    options = EventOptions(kinds=("oscillation",), signals=("level",), oscillation_turns=8)
    kinds, cut = asked_kinds(options), set[str]()
    for limit in range(4, 120):
        ticks, ledger = count(), Ledger()
        deadline = Deadline(float(limit), lambda ticks=ticks: next(ticks))
        known = known_signals(empty, asked)
        Detection(empty, known, kinds, options, deadline, ledger).events_touching(asked.segments[0])
        why = ledger.verdicts(kinds, []).not_searched.get("oscillation", "")
        cut |= {why} if "s on: time limit reached, ask start_s=" in why else set()
    assert cut
