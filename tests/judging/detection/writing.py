"""Labelled recordings as real ones: the current schema, and rows as a bridge writes them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from tests.judging.detection.labelled import LabelledRun
from tests.recordings.rover import WALL_PER_SIM, Recorder
from webots_mcp.bridge.encoding import encode
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention

_INSERT: Final = (
    "INSERT INTO state (run_id, sim_time_s, wall_time_s, data, replaced) VALUES (?, ?, ?, ?, ?)"
)
_PAUSE_S: Final = 1.0  # of wall time, between two runs


class Writer:
    """Writes runs of one robot into a database.

    Attributes:
        runs: How many were written in this session.
    """

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._recorder = Recorder(connection)
        self._robot_id = self._recorder.robot("rover")
        self._session_id = 0
        self.runs = 0

    def begin_session(self, code: str = "a") -> None:
        """What follows was recorded by a controller of that code."""
        self._session_id = self._recorder.session(self._robot_id, code * 64)
        self.runs = 0

    def write(self, run: LabelledRun) -> int:
        """Write a run and end it; its id. The first of a session starts it, the others reset it."""
        if not self._session_id:
            self.begin_session()
        reason = "reset" if self.runs else "start"
        run_id = self._recorder.run(self._session_id, self._robot_id, reason)
        self._connection.execute("BEGIN IMMEDIATE")
        start_s = self._recorder.run_start_s
        self._connection.executemany(_INSERT, _rows(run, run_id, start_s))
        self._recorder.at(float(run.times[-1]))
        self._recorder.end_run("reset")
        self._connection.execute("COMMIT")
        self._recorder.wall_s += _PAUSE_S
        self.runs += 1
        return run_id


def write_all(connection: sqlite3.Connection, runs: Sequence[LabelledRun]) -> list[int]:
    """Write runs of one session; their ids."""
    writer = Writer(connection)
    return [writer.write(run) for run in runs]


def put_in_chunks(connection: sqlite3.Connection) -> None:
    """Put all rows of runs that are over into chunks, as the maintainer does."""
    while not make_chunks(connection, 100_000).done:
        pass


def purge(connection: sqlite3.Connection, folder: Path, kept_rows: int) -> None:
    """Let retention delete all but the newest rows; their chunks stay."""
    limits = Retention(state=Limit(rows=kept_rows))
    prune(connection, folder, limits, rest=False)


def _rows(run: LabelledRun, run_id: int, wall_start_s: float) -> Iterator[tuple[Any, ...]]:
    names = list(run.columns)
    for time_s, *values in zip(run.times.tolist(), *run.columns.values(), strict=True):
        state = dict(zip(names, values, strict=True))
        encoded = encode(state)
        wall_s = wall_start_s + time_s * WALL_PER_SIM
        yield run_id, time_s, wall_s, encoded.text, encoded.replaced_text
