"""Where rows lie decides no answer: what is left of them in chunks says the same of a moment."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.judging.asking import ask
from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store import chunk_making
from webots_mcp.store.purge import prune
from webots_mcp.store.reading.ranges import Scope, find_range, recorded_bounds
from webots_mcp.store.retention_limits import Limit, Retention


def around_a_purge(
    connection: sqlite3.Connection, folder: Path, left: int, asked: Callable[[], Any]
) -> tuple[Any, Any]:
    """The answer before rows are deleted, and after a limit of rows was applied."""
    before = asked()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(chunk_making, "GROUP_ROWS", 10)
        patched.setattr(chunk_making, "MIN_ROWS_AT_END", 1)
        prune(connection, folder, Retention(state=Limit(rows=left), outlive=0), rest=False)
        rows = connection.execute("SELECT count(*) FROM state").fetchone()[0]
        assert left - 10 < rows <= left
        return before, asked()


@pytest.fixture
def paused(empty: sqlite3.Connection) -> Recorder:
    """From 5 s on a row each 10 s; wall time stands still for an hour after 1,000 s."""
    recorder = start_run(empty)
    for step in range(300):
        time_s = 5.0 + 10.0 * step
        recorder.publish(time_s, {"mode": "ab"[step // 60 % 2], "x": step})
    sql = "UPDATE state SET wall_time_s = wall_time_s + 3600 WHERE sim_time_s > 1000"
    empty.execute(sql)
    recorder.end_run("finished")
    empty.execute("UPDATE run SET last_wall_time_s = last_wall_time_s + 3600")
    return recorder


def span_in_the_pause(recorder: Recorder) -> tuple[float, float]:
    since = recorder.run_start_s + 1000.0
    scope = Scope(run_id=1, since_wall_time=since, until_wall_time=since + 3600)
    (segment,) = find_range(recorder.connection, scope).segments
    return segment.start_s, segment.end_s


def notes_on(recorder: Recorder, **bounds: float) -> tuple[str, ...]:
    return find_range(recorder.connection, Scope(run_id=1, **bounds)).notes  # pyright: ignore[reportArgumentType]


def begins_of(recorder: Recorder, kind: str, **asked: Any) -> list[float]:
    return [event.start_s for event in ask(recorder.connection, kind, **asked).events]


def hit_twice(recorder: Recorder) -> None:
    recorder.connection.execute("UPDATE session SET throttle_interval = 5")
    for time_s in (505.0, 515.0):
        recorder.insert("event", **recorder.at(time_s), kind="breakpoint", name="x > 3", data="{}")


def grasp_unclaimed(recorder: Recorder) -> None:
    recorder.insert(
        "command", robot_id=1, action="grasp", params="{}", status="expired",
        created_wall_time_s=recorder.run_start_s + 250,
        expires_wall_time_s=recorder.run_start_s + 260,
    )  # fmt: skip


def nothing(recorder: Recorder) -> None:
    pass


# What is recorded besides, what is asked, and the answer; None where it only has to stay the same.
QUESTIONS: dict[str, tuple[Callable[[Recorder], object], Callable[[Recorder], Any], Any]] = {
    "wall times of events": (
        nothing, lambda r: [e.wall_time_s for e in ask(r.connection, "change").events], None,
    ),
    "a range in wall time": (nothing, span_in_the_pause, None),
    "the ends of a run": (nothing, lambda r: recorded_bounds(r.connection, 1), (5.0, 2995.0)),
    "a range between two rows": (
        nothing, lambda r: notes_on(r, start_s=506, end_s=514),
        ("no row: nothing was recorded between 505 and 515 s of run 1",),
    ),
    "a change in the first row of a range": (
        lambda r: r.connection.execute("DELETE FROM state WHERE sim_time_s = 595"),
        lambda r: begins_of(
            r, "condition", bounds={"run_id": 1, "start_s": 605.0, "end_s": 700.0},
            where="changed(mode)",
        ),
        [605.0],
    ),
    "rows that hits have added": (
        hit_twice, lambda r: "up to 2 of 100 rows of run 1" in notes_on(r, end_s=1000)[-1], True,
    ),
    "a command that nobody claimed": (
        grasp_unclaimed, lambda r: begins_of(r, "command"), [495.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("left", [40, 0])
@pytest.mark.parametrize(("besides", "asked", "expected"), QUESTIONS.values(), ids=QUESTIONS)
def test_the_answer_is_the_same_before_and_after_a_purge(
    paused: Recorder, tmp_path: Path, left: int,
    besides: Callable[[Recorder], object], asked: Callable[[Recorder], Any], expected: Any,
) -> None:  # fmt: skip
    besides(paused)
    before, after = around_a_purge(paused.connection, tmp_path, left, lambda: asked(paused))
    assert after == before
    assert expected is None or before == expected


def test_rows_that_came_late_and_outlived_newer_ones_stand_for_none_of_these(
    empty: sqlite3.Connection, tmp_path: Path
) -> None:
    recorder = start_run(empty)
    for step in [*range(100), *range(140, 400), *range(100, 140)]:
        recorder.publish(step * 1.0, {"mode": "ab"[step // 60 % 2], "x": step, "y": 0})
    recorder.end_run("finished")
    empty.execute("UPDATE run SET last_sim_time_s = 399")

    def asked() -> tuple[Any, ...]:
        found = find_range(empty, Scope(run_id=1, start_s=150.2, end_s=150.8))
        events = find_events(empty, find_range(empty, Scope(run_id=1))).events
        return found.notes, [(e.wall_time_s, e.around) for e in events if e.kind == "change"]

    before, after = around_a_purge(empty, tmp_path, 40, asked)
    assert after == before
    assert before[0] == ("no row: nothing was recorded between 150 and 151 s of run 1",)
