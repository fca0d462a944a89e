"""A size is met, and known."""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from tests.recordings.runs import Recorded, states
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import Upkeep
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.retention_plan import plan

pytestmark = pytest.mark.slow

NO_LIMIT = Retention(Limit(), Limit(), Limit(), Limit(), Limit(), outlive=0)


def bytes_by_name(connection: sqlite3.Connection) -> dict[str, int]:
    try:
        sizes = connection.execute("SELECT name, sum(pgsize) FROM dbstat GROUP BY name").fetchall()
    except sqlite3.OperationalError as error:
        pytest.skip(f"this SQLite does not tell the size of a table: {error}")
    return dict(sizes)


def mixed(low: int, high: int) -> list[int]:
    return [low + number * 7919 % (high - low) for number in range(97)]


def shown(value: list[int] | int) -> str:
    return f"{min(value)} to {max(value)} bytes" if isinstance(value, list) else f"{value} runs"


@pytest.mark.parametrize(
    ("lengths", "runs"),
    [
        *(([length], 1) for length in (100, 1000, 1300, 2000, 3000, 4050, 8000, 20_000)),
        ([1300, 2500, 2500], 6),
        ([100] * 20 + [20_000], 6),
        (mixed(200, 3000), 6),
        (mixed(1300, 9000), 1),
    ],
    ids=shown,
)
def test_what_states_take_is_known_within_a_twentieth_of_what_sqlite_says(
    tmp_path: Path, lengths: list[int], runs: int
) -> None:
    with closing(connect(tmp_path / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        run_ids = [recorded.add_run(0) for _ in range(runs)]
        for i in range(2200):
            recorded.run_id = run_ids[i // 7 % runs]
            text = "t" * (lengths[i % len(lengths)] - len('{"text": ""}'))
            recorded.publish(i * 0.016, {"text": text})
        connection.execute("COMMIT")
        make_chunks(connection, 100_000)
        sizes = bytes_by_name(connection)
        on_disk = sizes["state"] + sizes["ix_state_run_id_sim_time_s"]
        held = plan(connection, NO_LIMIT).held_bytes["state"]
    assert held == pytest.approx(on_disk, rel=0.05)


@pytest.mark.parametrize("length", [1300, 1500, 2500, 3000, 6000])
def test_the_file_of_long_rows_shrinks_to_the_limit(
    tmp_path: Path, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 16)
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        connection.execute("BEGIN")
        run_ids = [recorded.add_run(0) for _ in range(6)]
        for i in range(2400):
            recorded.run_id = run_ids[i % 6]
            recorded.publish(i // 6 * 0.016, {"text": "t" * length})
        connection.execute("COMMIT")
        states_bytes = 2_000_000
        recorded.prune(states(size_bytes=states_bytes))
        rest_bytes = sum(
            size for name, size in bytes_by_name(connection).items()
            if name not in ("state", "ix_state_run_id_sim_time_s")
        )  # fmt: skip
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert file.stat().st_size - rest_bytes == pytest.approx(states_bytes, rel=0.05)


def test_the_file_of_a_recording_that_goes_on_stays_within_a_twentieth_of_its_limits(
    tmp_path: Path,
) -> None:
    file, noise = tmp_path / "webots.db", random.Random(5)
    sizes_of = {"state": 2_000_000, "chunk": 1_200_000, "log": 600_000}
    of_states, of_chunks, of_logs = (Limit(size_bytes=each) for each in sizes_of.values())
    limits = replace(Retention(), state=of_states, chunk=of_chunks, log=of_logs)
    upkeep = Upkeep(tmp_path, lambda _: limits, interval_s=0, budget_s=60)
    sizes: list[int] = []
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorded = Recorded(connection, tmp_path)
        for number in range(25_000):
            if number % 4000 == 0:
                recorded.add_run(0, end="reset")
            if number % 1000 == 0:
                make_chunks(connection, 10_000)
                upkeep(connection)
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                sizes.append(file.stat().st_size)
            time_s = number * 0.016
            recorded.publish(time_s, {f"s{i}": noise.gauss(i, 0.1) for i in range(10)})
            line = {"level": "info", "source": "controller", "message": "m" * 60}
            recorded.insert("log", **recorded.at(time_s), **line)
    empty_bytes, limit_bytes = sizes[0], sum(sizes_of.values())
    assert max(sizes) - empty_bytes <= 1.05 * limit_bytes
    assert min(sizes[-5:]) - empty_bytes >= 0.95 * limit_bytes
