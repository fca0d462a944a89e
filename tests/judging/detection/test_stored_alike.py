"""What is told does not depend on how it is stored: as rows, in chunks, or in chunks alone."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.retention_limits import Limit, Retention

ROWS = 6000
NOISE = np.random.default_rng(1).normal(0, 0.01, (ROWS, 3)).tolist()
KINDS = {
    "standstill": 2,
    "stuck": 1,
    "condition": 1,
    "missing": 1,
    "flat": 3,
    "jump": 3,
    "oscillation": 1,
    "gap": 1,
    "change": 3,
}


def state(row: int) -> dict[str, Any]:
    """Drives, waits from 100 to 130 s, is held from 200 to 230 s and lifted at 450 s."""
    time_s = row * 0.1
    stands_s = min(30.0, max(0.0, time_s - 100)) + min(30.0, max(0.0, time_s - 200))
    waits = 100 <= time_s < 130
    swing = math.sin(math.tau * time_s / 2) if 300 <= time_s < 330 else 0.0
    noise = NOISE[row]
    return {
        "pose": [0.2 * (time_s - stands_s) + 3.0 * (time_s >= 450) + noise[0] / 10, noise[1] / 10],
        "commanded_m_s": 0.0 if waits else 0.2,
        "mode": "waits" if waits else "lifted" if time_s >= 450 else "drives",
        "front_m": None if 250 <= time_s < 260 else 0.0 if row == 4000 else 2.0 + noise[2],
        "side_m": 1.5 if 350 <= time_s < 380 else 1.5 + noise[0],
        "battery_v": 9.0 if 500 <= time_s < 520 else 12.0 + noise[1],
        "steering_rad": 0.4 * swing,
    }


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, dict[str, list[Event]]]]:
    """By how it is stored, what is told of each kind; from 540 to 548 s there is no row."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        for row in range(ROWS):
            if not 5400 <= row < 5480:
                recorder.publish(round(row * 0.1, 6), state(row))
        recorder.end_run("finished")
        found = {"rows": {kind: ask(connection, kind) for kind in KINDS}}
        make_chunks(connection, 100_000)
        found["chunks"] = {kind: ask(connection, kind) for kind in KINDS}
        purge(connection, tmp_path_factory.mktemp("pictures"))
        found["purged"] = {kind: ask(connection, kind) for kind in KINDS}
        yield found


def purge(connection: sqlite3.Connection, folder: Path) -> None:
    prune(connection, folder, Retention(state=Limit(rows=100)), rest=False)
    assert connection.execute("SELECT count(*) FROM state").fetchone()[0] < 1500


def ask(connection: sqlite3.Connection, kind: str) -> list[Event]:
    options = EventOptions(kinds=(kind,), where="battery_v < 10 and pose.0 > 1")
    found = find_events(
        connection, find_range(connection, Scope()), options, around=(), group=False
    )
    # The wall times of purged rows are those of an even clock.
    return [replace(event, wall_time_s=0.0) for event in found.events]


@pytest.mark.parametrize("stored", ["rows", "chunks", "purged"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_found_as_often_however_it_is_stored(
    told: dict[str, dict[str, list[Event]]], stored: str, kind: str
) -> None:
    assert len(told["rows"][kind]) == KINDS[kind]
    assert told[stored][kind] == told["rows"][kind]
