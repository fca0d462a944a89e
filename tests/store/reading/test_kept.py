"""Answers about a kept stretch use each call, and means and counts around it are not skewed."""

from __future__ import annotations

import math
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rover import start_run
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.judging.detection.events import EventOptions, find_events
from webots_mcp.judging.trends import trends
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.ranges import Scope, TimeRange, find_range
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.run_rows import newest_state
from webots_mcp.store.signal_history import query_history, query_rows

STEP_MS = 16
CALLS = 2000
SPIKE = 1003  # between two rows that the throttle lets through
HIT = 1009  # in one of them
LAST = CALLS + 7  # published after the last such row


def value(number: int) -> float:
    """It grows faster in the stretch, so that equal weights of rows would show."""
    return 900.0 if number == SPIKE else 10.0 if 720 < number < 1130 else 1.0


@pytest.fixture(scope="module")
def recorded() -> Iterator[MemoryDatabase]:
    """Robot `throttled` with a kept stretch and one at its end; robot `every` has all rows."""
    database = MemoryDatabase()
    for name, interval in (("throttled", 10), ("every", 1)):
        robot = InProcessSupervisor(name)
        bridge = MCPBridge(robot, throttle_interval=interval, database=database)
        bridge.breakpoint(f"n == {HIT}", "keep")
        for number in range(CALLS + 8):
            robot.step(STEP_MS)
            mode = "bump" if number == SPIKE + 1 else "drive"
            bridge.publish({"n": number, "v": value(number), "mode": mode})
        bridge.log("the gear is gone", "error")
        bridge.close()
    yield database
    database.close()


@pytest.fixture(params=[False, True], ids=["rows", "chunks"])
def connection(
    recorded: MemoryDatabase, request: pytest.FixtureRequest
) -> Iterator[sqlite3.Connection]:
    with closing(connect(recorded, "writer")) as connection:
        if request.param:
            while not make_chunks(connection).done:
                pass
        yield connection


def stretch(connection: sqlite3.Connection, number: int = 0) -> tuple[float, float]:
    sql = (
        "SELECT k.start_sim_time_s, k.end_sim_time_s FROM kept_stretch k JOIN run u "
        "ON u.id = k.run_id JOIN robot r ON r.id = u.robot_id WHERE r.name = 'throttled' "
        "ORDER BY k.id LIMIT 1 OFFSET ?"
    )
    return connection.execute(sql, (number,)).fetchone()


def ranges(
    connection: sqlite3.Connection, start_s: float | None = None, end_s: float | None = None
) -> list[TimeRange]:
    """Of the throttled robot, and the same of the one with all rows."""
    return [
        find_range(connection, Scope(robot=robot, start_s=start_s, end_s=end_s))
        for robot in ("throttled", "every")
    ]


def inside(connection: sqlite3.Connection) -> list[TimeRange]:
    start_s, end_s = stretch(connection)
    return ranges(connection, start_s, math.nextafter(end_s, math.inf))


def test_a_range_inside_a_stretch_is_answered_as_if_each_call_were_recorded(
    connection: sqlite3.Connection,
) -> None:
    kept, every = (
        query_history(connection, each, ["*"], max_points=20).runs[0] for each in inside(connection)
    )
    assert kept.rows == every.rows
    assert kept.rows is not None and kept.rows > 400
    assert (kept.numbers, kept.sim_time_s, kept.step_s) == (
        every.numbers, every.sim_time_s, every.step_s,
    )  # fmt: skip
    ((kept_mode,), (every_mode,)) = kept.changes, every.changes
    assert kept_mode.points[1:] == every_mode.points[1:]  # the first lies before the range
    assert kept_mode.time_by_value_s == every_mode.time_by_value_s
    assert kept.interval_s == pytest.approx(STEP_MS / 1000)
    assert kept.gaps == ()
    found = [trends(connection, each, ["*"]).runs[0] for each in inside(connection)]
    assert found[0].numbers == found[1].numbers
    assert found[0].rows == found[1].rows


def test_its_rows_come_page_by_page_each_once(connection: sqlite3.Connection) -> None:
    found: list[float | None] = []
    cursor: int | None = 0
    while cursor is not None:
        page = query_rows(connection, inside(connection)[0], ["n"], limit=100, after_id=cursor)
        found += [None if n is None else float(n) for n in page.values["n"]]  # type: ignore[arg-type]
        cursor = page.cursor
    assert found == sorted(set(found), key=lambda n: n or 0)
    assert len(found) == len(query_rows(connection, inside(connection)[1], ["n"], limit=1000).ids)


def test_calls_of_one_step_come_each_once_wherever_a_page_ends() -> None:
    with closing(MemoryDatabase()) as database:
        robot = InProcessSupervisor("rover")
        with MCPBridge(robot, throttle_interval=4, database=database) as bridge:
            for number in range(60):
                if number % 3 == 0:
                    robot.step(STEP_MS)
                bridge.publish({"n": number})
            bridge.keep("a look")
        with closing(connect(database, "writer")) as connection:
            for limit in range(1, 8):
                found, cursor = list[object](), 0
                while cursor is not None:
                    whole = find_range(connection, Scope())
                    page = query_rows(connection, whole, ["n"], limit=limit, after_id=cursor)
                    found += page.values["n"]
                    cursor = page.cursor
                assert found == list(range(60))


_KILLED = """
import os, signal, sys
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

robots = [InProcessSupervisor(name) for name in ("left", "right")]
bridges = [MCPBridge(robot, data_dir=sys.argv[1], throttle_interval=10) for robot in robots]
for number in range(501):
    for robot, bridge in zip(robots, bridges):
        robot.step(16)
        if number == 500:
            bridge.keep("a look")
        bridge.publish({"n": number})
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGKILL")
def test_what_was_not_written_of_a_stretch_before_a_kill_is_not_told_as_kept(
    tmp_path: Path,
) -> None:
    line = [sys.executable, "-c", _KILLED, str(tmp_path)]
    assert subprocess.run(line, check=False).returncode == -signal.SIGKILL
    with closing(connect(tmp_path / DATABASE_NAME, "writer")) as connection:
        for robot in ("left", "right"):
            whole = find_range(connection, Scope(robot=robot))
            (note,) = [note for note in whole.notes if "full rate" in note]
            (run_id,) = [segment.run_id for segment in whole.segments]
            sql = (
                "SELECT min(sim_time_s), max(sim_time_s), count(*) FROM kept_state WHERE run_id = ?"
            )
            first_s, last_s, rows = connection.execute(sql, (run_id,)).fetchone()
            assert 0 < rows < 300
            assert f"-{last_s:.3f} s" in note
            assert f"rows after {last_s:.3f} s are not written" in note
            written = find_range(connection, Scope(robot=robot, start_s=first_s, end_s=last_s))
            numbers = query_rows(connection, written, ["n"], limit=1000).values["n"]
            assert numbers == list(range(int(numbers[0] or 0), int(numbers[-1] or 0) + 1))
            rest = find_range(connection, Scope(robot=robot, start_s=last_s + STEP_MS / 1000))
            assert not rest.segments[0].full_rate


def test_means_and_counts_of_a_longer_range_are_not_those_of_the_stretch(
    connection: sqlite3.Connection,
) -> None:
    kept, every = (
        query_history(connection, each, ["v"], max_points=1).runs[0].numbers[0].whole
        for each in ranges(connection)
    )
    truth = sum(value(n) for n in range(CALLS) if n != SPIKE) / (CALLS - 1)
    assert kept.present == pytest.approx(every.present / 10, abs=2)
    assert kept.mean == pytest.approx(truth, rel=0.02)
    assert (kept.max, kept.min) == (every.max, every.min)
    assert kept.max_sim_time_s == every.max_sim_time_s


def test_the_extreme_between_two_rows_is_in_its_bucket_and_in_the_trend(
    connection: sqlite3.Connection,
) -> None:
    whole = ranges(connection)[0]
    (run,) = query_history(connection, whole, ["v"], max_points=40).runs
    (signal,) = run.numbers
    (place,) = [i for i, most in enumerate(signal.max) if most == 900.0]
    assert run.step_s is not None
    spike_s = signal.whole.max_sim_time_s
    assert spike_s == pytest.approx((SPIKE + 1) * STEP_MS / 1000, abs=0.02)
    assert spike_s is not None
    assert run.sim_time_s[place] <= spike_s < run.sim_time_s[place] + run.step_s
    (trend,) = trends(connection, whole, ["v"]).runs[0].numbers
    assert trend.summary.max == 900.0


def test_a_change_between_two_rows_is_told_to_the_step(connection: sqlite3.Connection) -> None:
    for asked in (ranges(connection), inside(connection)):
        kept, every = (
            query_history(connection, each, ["mode"]).runs[0].changes[0].points for each in asked
        )
        assert kept[1:] == every[1:]
        assert [point.value for point in kept] == ["drive", "bump", "drive"]


@pytest.mark.parametrize("where", ["v > 100", "changed(mode)", "v > 5 for 3"])
def test_where_a_condition_held_is_found_between_rows(
    connection: sqlite3.Connection, where: str
) -> None:
    options = EventOptions(kinds=("condition",), where=where)
    kept, every = (
        find_events(connection, each, options, limit=10).events for each in inside(connection)
    )
    assert [(each.start_s, each.end_s) for each in kept] == [
        (each.start_s, each.end_s) for each in every
    ]
    assert len(kept) > 0


def test_the_newest_state_and_the_end_of_a_crashed_run_are_those_of_its_last_call(
    connection: sqlite3.Connection,
) -> None:
    whole = ranges(connection)[0]
    (segment,) = whole.segments
    state = newest_state(connection, segment.run_id)
    assert state is not None
    assert state.value()["n"] == LAST
    assert segment.end_s > state.sim_time_s
    last = stretch(connection, 1)
    page = query_rows(
        connection,
        find_range(connection, Scope(robot="throttled", start_s=last[0])),
        ["n"],
        limit=1000,
    )
    assert page.values["n"][-1] == LAST
    assert page.values["n"] == list(range(LAST + 1 - len(page.ids), LAST + 1))


@pytest.mark.parametrize(
    ("interval", "every", "leans"), [(10, 7, True), (10, 2500, False), (1, 7, False)]
)
def test_a_mean_that_leans_towards_the_hits_of_a_breakpoint_is_told(
    interval: int, every: int, leans: bool
) -> None:
    with closing(MemoryDatabase()) as database:
        robot = InProcessSupervisor("rover")
        with MCPBridge(robot, throttle_interval=interval, database=database) as bridge:
            bridge.breakpoint("v > 5", "log")
            for number in range(2000):
                robot.step(STEP_MS)
                bridge.publish({"v": 1.0 if number % every else 10.0})
        with closing(connect(database, "writer")) as connection:
            whole = find_range(connection, Scope())
            mean = (
                query_history(connection, whole, ["v"], max_points=1).runs[0].numbers[0].whole.mean
            )
    truth = 1 + 9 / every
    assert mean is not None
    assert (abs(mean - truth) > 0.1 * truth) is leans
    rows = len({n for n in range(2000) if (n + 1) % interval == 0 or n % every == 0})
    text = f"up to 286 of {rows} rows of run 1 were recorded because a breakpoint was hit"
    assert [text in note for note in whole.notes] == [True] * leans


def test_a_kept_call_before_the_row_of_the_same_step_comes_first(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(1.0, {"x": 2})
    recorder.insert("kept_state", **recorder.at(1.0) | {"wall_time_s": 0.0}, data='{"x": 1}')
    frame = read_frame(empty, Segment(1, 0.0, 2.0, full_rate=True), Deadline(60))
    assert frame.values("x") == [1, 2]


@pytest.mark.parametrize("deleted", [False, True])
def test_a_range_that_is_wider_than_a_stretch_is_not_at_full_rate_though_its_rows_were_deleted(
    empty: sqlite3.Connection, *, deleted: bool
) -> None:
    recorder = start_run(empty)
    for step in range(100):
        recorder.publish(float(step), {"x": step})
    for time_s in (40.2, 40.4, 40.6):
        recorder.insert("kept_state", **recorder.at(time_s), data='{"x": 1}')
    span = {"start_sim_time_s": 40.2, "end_sim_time_s": 40.6}
    recorder.insert("kept_stretch", uuid="k", run_id=1, **span, reason="a look", wall_time_s=0.0)
    if deleted:
        assert chunk_whole_run(empty, 1)
        empty.execute("DELETE FROM state")
        empty.execute("UPDATE run SET purged_rows = 100")
    for start_s, is_kept in ((40.1, True), (39.0, False)):
        (segment,) = find_range(empty, Scope(run_id=1, start_s=start_s, end_s=40.9)).segments
        assert segment.full_rate is is_kept
