"""Rows become chunks once, whoever makes them and whenever he is stopped."""

from __future__ import annotations

import random
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from tests.recordings.rover import Recorder, start_run
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.signals.register import MAX_SIGNALS
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import GROUP_ROWS, chunk_whole_run, make_chunks
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import whole_run
from webots_mcp.store.reading.segment import Deadline

ROWS = 2500


def state_at(step: int) -> dict[str, Any]:
    state: dict[str, Any] = {"x": step * 0.25, "mode": "go" if step % 900 < 700 else "turn"}
    if step % 3:
        state["lamp"] = step % 7 == 1
    if step > 1500:
        state["late_comer"] = None if step % 5 == 0 else step
    return state


def record(
    connection: sqlite3.Connection, steps: range, recorder: Recorder | None = None
) -> Recorder:
    recorder = recorder or start_run(connection)
    connection.execute("BEGIN")
    for step in steps:
        recorder.publish(step * 0.1, state_at(step), {"x": "nan"} if step == 77 else None)
    connection.execute("COMMIT")
    return recorder


def framed(connection: sqlite3.Connection, run_id: int = 1) -> Frame:
    segment = whole_run(connection, run_id)
    assert segment is not None
    return read_frame(connection, segment, Deadline(60))


def contents(connection: sqlite3.Connection) -> dict[str, list[Any]]:
    frame = framed(connection)
    names = ("x", "mode", "lamp", "late_comer", "nowhere")
    return {
        "times": frame.times.tolist(),
        "walls": frame.wall_times.tolist(),
        "ids": frame.ids.tolist(),
        **{name: frame.values(name) for name in names},
    }


def groups(connection: sqlite3.Connection) -> list[int]:
    rows = connection.execute("SELECT row_count FROM row_group WHERE is_complete ORDER BY id")
    return [count for (count,) in rows]


def test_full_groups_are_chunked_and_what_is_left_of_a_run_when_it_has_ended(
    empty: sqlite3.Connection,
) -> None:
    recorder = record(empty, range(ROWS))
    before = contents(empty)
    assert make_chunks(empty, 100_000).done
    assert groups(empty) == [GROUP_ROWS, GROUP_ROWS]  # the newest rows wait
    assert make_chunks(empty, 100_000) == (0, True)
    recorder.end_run("finished")
    assert make_chunks(empty, 100_000).done
    assert groups(empty) == [GROUP_ROWS, GROUP_ROWS, ROWS - 2 * GROUP_ROWS]
    assert contents(empty) == before


def test_a_short_end_is_chunked_before_its_rows_go_and_answers_stay(
    empty: sqlite3.Connection,
) -> None:
    record(empty, range(GROUP_ROWS + 50))
    before = contents(empty)
    assert chunk_whole_run(empty, 1)
    empty.execute("DELETE FROM state")
    empty.execute(
        "UPDATE run SET purged_rows = row_count, last_sim_time_s = ?", (before["times"][-1],)
    )
    frame = read_frame(empty, making_segment(before["times"]), Deadline(60))
    assert frame.values("x") == before["x"]
    assert frame.values("mode") == before["mode"]


def making_segment(times: list[float]) -> Any:
    from webots_mcp.store.reading.segment import Segment, just_after

    return Segment(1, times[0], just_after(times[-1]))


def test_rows_that_come_late_are_in_their_place(empty: sqlite3.Connection) -> None:
    order = list(range(ROWS))
    late = sorted(random.Random(1).sample(range(1, 2000), 40))
    recorder = start_run(empty)
    record_steps(empty, recorder, [step for step in order if step not in late])
    make_chunks(empty, 100_000)
    record_steps(empty, recorder, late)
    before = contents(empty)
    assert before["times"] == sorted(before["times"])
    assert before["x"] == [step * 0.25 for step in order]
    make_chunks(empty, 100_000)
    assert sum(groups(empty)) == 2 * GROUP_ROWS + len(late)
    assert contents(empty) == before


def record_steps(connection: sqlite3.Connection, recorder: Recorder, steps: list[int]) -> None:
    connection.execute("BEGIN")
    for step in steps:
        recorder.publish(step * 0.1, state_at(step))
    connection.execute("COMMIT")


def test_rows_of_one_time_are_each_read_once(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    empty.execute("BEGIN")
    for step in range(ROWS):
        recorder.publish(100.0 if step > 1000 else step * 0.1, {"n": step})
    empty.execute("COMMIT")
    make_chunks(empty, 100_000)
    assert framed(empty).values("n") == list(range(ROWS))


def test_one_who_is_stopped_leaves_nothing_half_done(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(empty, range(ROWS))
    before = contents(empty)

    class StoppedError(Exception):
        pass

    def stop(*_: object) -> bool:
        raise StoppedError

    with monkeypatch.context() as patched:
        patched.setattr(chunk_making._COMPLETE, "run", stop)  # type: ignore[attr-defined]
        with pytest.raises(StoppedError):
            make_chunks(empty, 100_000)
    assert groups(empty) == []
    assert contents(empty) == before
    assert make_chunks(empty, 100_000).done
    assert groups(empty) == [GROUP_ROWS, GROUP_ROWS]
    left = "SELECT count(*) FROM chunk WHERE group_id NOT IN (SELECT id FROM row_group)"
    assert empty.execute(left).fetchone() == (0,)
    assert contents(empty) == before


def test_of_two_that_make_the_same_chunk_one_stores(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as one:
        create_schema(one)
        record(one, range(ROWS))
        before = contents(one)
        with closing(connect(file, "writer")) as other:
            store = chunk_making._RunChunks._store  # type: ignore[attr-defined]
            seen = False

            def overtaken(self: Any, columns: Any, at: Any) -> bool:
                nonlocal seen
                if not seen:
                    seen = True
                    make_chunks(other, 100_000)
                return store(self, columns, at)

            chunk_making._RunChunks._store = overtaken  # type: ignore[attr-defined,method-assign]
            try:
                make_chunks(one, 100_000)
            finally:
                chunk_making._RunChunks._store = store  # type: ignore[attr-defined,method-assign]
        make_chunks(one, 100_000)
        assert groups(one) == [GROUP_ROWS, GROUP_ROWS]
        assert contents(one) == before


def test_a_signal_is_what_all_rows_tell_though_its_name_was_entered_before(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"pose": [None, None], "heading": 0.5, "mode": 3})
    recorder.end_run("finished")
    chunk_whole_run(empty, 1)
    kinds = "SELECT name, kind, role FROM signal ORDER BY name"
    assert empty.execute(kinds).fetchall() == [
        ("heading", "angle", "yaw"),
        ("mode", "num", "mode"),
        ("pose.0", "null", "x"),
        ("pose.1", "null", "y"),
    ]
    recorder.run(1, 1)
    recorder.publish(0.0, {"pose": [1.5, 2], "heading": 90, "mode": 3.5})
    recorder.end_run("finished")
    chunk_whole_run(empty, 2)
    assert empty.execute(kinds).fetchall() == [
        ("heading", "num", None),
        ("mode", "num", None),
        ("pose.0", "num", "x"),
        ("pose.1", "num", "y"),
    ]


def test_late_rows_that_come_in_several_stretches_are_all_in_chunks(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    late = [*range(2500, 4000), *range(1000, 2500)]
    record_steps(empty, recorder, [step for step in range(6000) if step not in late])
    make_chunks(empty, 100_000)
    record_steps(empty, recorder, late)
    before = contents(empty)
    make_chunks(empty, 100_000)
    assert contents(empty) == before
    assert before["x"] == [step * 0.25 for step in range(6000)]


class Overtaken(sqlite3.Connection):
    """Lets another process go on right after this one has looked for a statement's rows."""

    looks_for = ""

    def go_on(self) -> None: ...

    def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
        cursor = super().execute(sql, *values)
        if sql == self.looks_for:
            self.go_on()
        return cursor


def test_a_group_that_is_completed_while_another_clears_up_keeps_its_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as one:
        create_schema(one)
        record(one, range(ROWS))
        before = contents(one)
        complete = chunk_making._COMPLETE.run  # type: ignore[attr-defined]

        def beside_another(*values: Any) -> bool:
            completed = list[bool]()
            with closing(sqlite3.connect(file, factory=Overtaken, isolation_level=None)) as other:
                other.looks_for = chunk_making._LEFT_BEHIND  # type: ignore[attr-defined]
                other.go_on = lambda: completed.append(complete(*values))
                chunk_making._delete_left_behind(other, 0.0)  # type: ignore[attr-defined]
            return completed[0]

        monkeypatch.setattr(chunk_making._COMPLETE, "run", beside_another)  # type: ignore[attr-defined]
        make_chunks(one, 100_000)
        assert groups(one) == [GROUP_ROWS, GROUP_ROWS]
        assert contents(one) == before


def test_one_whose_group_another_clears_up_goes_on_with_the_next(tmp_path: Path) -> None:
    file = tmp_path / "webots.db"
    with closing(sqlite3.connect(file, factory=Overtaken, isolation_level=None)) as one:
        create_schema(one)
        one.execute("PRAGMA foreign_keys=ON")
        record(one, range(ROWS))
        before = contents(one)
        one.looks_for = chunk_making._BEGIN_GROUP  # type: ignore[attr-defined]
        one.go_on = lambda: chunk_making._delete_left_behind(one, 0.0)  # type: ignore[attr-defined]
        assert not make_chunks(one, 100_000).done
        one.looks_for = ""
        assert make_chunks(one, 100_000).done
        assert groups(one) == [GROUP_ROWS, GROUP_ROWS]
        assert contents(one) == before


def test_the_range_of_a_signal_is_known_whenever_its_maker_is_stopped(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = record(empty, range(GROUP_ROWS))
    recorder.end_run("finished")
    complete = chunk_making._COMPLETE.run  # type: ignore[attr-defined]

    def and_stop(*values: Any) -> bool:
        complete(*values)
        raise KeyboardInterrupt

    monkeypatch.setattr(chunk_making._COMPLETE, "run", and_stop)  # type: ignore[attr-defined]
    with pytest.raises(KeyboardInterrupt):
        make_chunks(empty, 100_000)
    make_chunks(empty, 100_000)
    found = empty.execute("SELECT min, max FROM signal WHERE name = 'x'").fetchone()
    assert found == (0, (GROUP_ROWS - 1) * 0.25)


def test_a_late_row_at_the_time_between_two_groups_stays_behind_those_before_it(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(2 * GROUP_ROWS):
        recorder.publish((step + 1) // 2 * 0.1, {"x": step})
    make_chunks(empty, 10_000)
    recorder.publish(GROUP_ROWS // 2 * 0.1, {"x": -1})
    before = framed(empty).values("x")
    chunk_whole_run(empty, 1)
    assert before[GROUP_ROWS : GROUP_ROWS + 2] == [GROUP_ROWS, -1]
    assert framed(empty).values("x") == before


@pytest.mark.slow
def test_the_chunks_of_a_run_cost_the_same_however_many_rows_others_have(
    empty: sqlite3.Connection,
) -> None:
    """A new run is not searched for in the rows of all others: each row is read a few times."""
    recorder = record(empty, range(300))
    recorder.end_run("reset")

    def steps_of_a_new_run() -> int:
        steps = 0

        def count() -> None:
            nonlocal steps
            steps += 1

        recorder.run(1, 1, "reset")
        record(empty, range(300), recorder)
        recorder.end_run("reset")
        empty.set_progress_handler(count, 1000)  # of SQLite's virtual machine
        try:
            assert make_chunks(empty, 100_000).done
        finally:
            empty.set_progress_handler(None, 0)
        return steps

    assert make_chunks(empty, 100_000).done
    among_few = steps_of_a_new_run()
    recorder.run(1, 1, "reset")
    record(empty, range(20_000), recorder)
    recorder.end_run("reset")
    assert make_chunks(empty, 100_000).done
    assert steps_of_a_new_run() < 1.5 * among_few


@pytest.mark.slow
def test_names_beyond_the_limit_are_not_looked_at(empty: sqlite3.Connection) -> None:
    recorder, calls = start_run(empty), 0
    state = {f"name{n}": n for n in range(20 * MAX_SIGNALS)}
    recorder.publish(0.1, {"name7": None, "mode": "go"})
    recorder.publish(0.2, state)
    recorder.end_run("finished")

    def count(_frame: FrameType, event: str, _value: object) -> None:
        nonlocal calls
        calls += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        assert make_chunks(empty).done
    finally:
        sys.setprofile(before)
    names = [name for (name,) in empty.execute("SELECT name FROM signal")]
    assert len(names) == MAX_SIGNALS
    assert {"mode", *list(state)[: MAX_SIGNALS - 1]} == set(names)
    assert calls < 20 * len(state)  # to read them, and for names that there is room for


@pytest.mark.slow
def test_many_new_runs_are_each_looked_at_once(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    runs = 60

    def record_runs(count: int) -> int:
        for _ in range(count):
            recorder.run(1, 1, "reset")
            record(empty, range(300), recorder)
            recorder.end_run("reset")
        steps = 0

        def step() -> None:
            nonlocal steps
            steps += 1

        empty.set_progress_handler(step, 1000)
        try:
            assert make_chunks(empty, 10**9).done
        finally:
            empty.set_progress_handler(None, 0)
        return steps

    few, many = record_runs(runs // 4), record_runs(runs)
    assert many < 1.3 * 4 * few
    assert sum(groups(empty)) == 300 * (runs + runs // 4)


@pytest.mark.parametrize("seed", range(8))
def test_late_rows_of_several_runs_at_once_come_into_their_chunks(
    empty: sqlite3.Connection, seed: int
) -> None:
    """Whatever is written between two calls, and however little a call may do."""
    choice = random.Random(seed)
    recorder = start_run(empty)
    recorder.run(1, 1, "reset")
    steps: dict[int, list[int]] = {1: list(range(ROWS)), 2: list(range(ROWS))}
    for left in steps.values():
        for place in choice.sample(range(ROWS - 200), 60):  # some come later than they should
            step = left[place]
            left[place] = left[place + 150]
            left[place + 150] = step
    while any(steps.values()):
        run_id = choice.choice([run_id for run_id, left in steps.items() if left])
        some = choice.choice([1, 40, 700])
        recorder.run_id = run_id
        record_steps(empty, recorder, steps[run_id][:some])
        del steps[run_id][:some]
        if choice.random() < 0.5:
            make_chunks(empty, choice.choice([1, 500, 100_000]))
    for run_id in (1, 2):
        recorder.run_id = run_id
        recorder.end_run("finished")
    while not make_chunks(empty, 500).done:
        pass
    for run_id in (1, 2):
        frame = framed(empty, run_id)
        assert frame.values("x") == [step * 0.25 for step in range(ROWS)]
        assert len(set(frame.ids.tolist())) == ROWS
        waiting = len(frame.new_rows)
        assert waiting < chunk_making.MIN_ROWS_AT_END
