"""Events are found where the story of the recording has them, and nowhere else."""

from __future__ import annotations

import math
import re
import sqlite3
from collections import Counter
from itertools import count
from typing import Any

import numpy as np
import pytest

from tests.frames import frame_of
from tests.judging.asking import ask, spans
from tests.recordings.rover import WALL_START_S, Recorder, start_run
from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.judging.detection.event import Event, count_by_kind
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.detection.jump import find_jumps
from webots_mcp.judging.detection.search import Search, events_touching
from webots_mcp.judging.verdicts import SearchCoverage
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import Deadline


def test_a_robot_that_should_move_and_does_not_is_stuck(
    rover: sqlite3.Connection, looked_at: str
) -> None:
    (stuck,) = ask(rover, "stuck").events
    assert stuck.start_s == pytest.approx(40.0, abs=0.2)
    assert stuck.end_s == pytest.approx(52.0, abs=0.2)
    assert stuck.details["x_m"] == pytest.approx(8.0, abs=0.02)
    assert stuck.details["mode"] == "cruise" and stuck.details["commanded"] == 0.2
    assert stuck.around["mode"] == "cruise"
    assert stuck.wall_time_s == pytest.approx(WALL_START_S + 20.0, abs=0.5)


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        ("gap", {}, [(None, 89.9, 95.0)]),
        ("missing", {}, [("sensors.front", 100.0, 103.9)]),
        ("flat", {"signals": ("pose.0", "target"), "flat_s": 5.0}, [("pose.0", 40.0, 52.0)]),
        ("jump", {"signals": ("ir", "mode")}, [("ir", 70.0, 70.1), ("position", 110.0, 110.0)]),
        ("oscillation", {}, [("heading", 60.0, 89.9)]),
    ],
)
def test_what_happened_to_the_rover_is_found(
    rover: sqlite3.Connection, looked_at: str, kind: str, options: dict[str, Any], expected: Any
) -> None:
    found = [(each.name, each.start_s, each.end_s) for each in ask(rover, kind, **options).events]
    assert found == [
        (name, *(pytest.approx(each, abs=0.2) for each in ends)) for name, *ends in expected
    ]


def test_commands_logs_and_notices_are_on_the_same_clock(rover: sqlite3.Connection) -> None:
    (command,) = ask(rover, "command").events
    assert (command.name, command.start_s, command.end_s) == ("set_speed", 20.0, 20.1)
    assert command.details["status"] == "done" and command.details["result"] == 0.2
    logs = ask(rover, "log").events
    assert [(log.start_s, log.name) for log in logs] == [(45.0, "warning"), (104.0, "error")]
    (noticed,) = ask(rover, "bridge_event").events
    dropped = {"what": "dropped", "data": {"row_count": 3}}
    assert (noticed.start_s, noticed.details) == (61.0, dropped)
    (image,) = ask(rover, "image").events
    assert image.details["path"] == "camera/1.png"


def test_runs_begin_and_end_in_wall_time(rover: sqlite3.Connection) -> None:
    whole = {"since_wall_time": WALL_START_S - 1, "until_wall_time": WALL_START_S + 1000}
    events = ask(rover, "run", bounds=whole).events
    told = [(e.run_id, e.details["what"], e.details["reason"]) for e in events]
    assert told == [
        (1, "began", "start"), (1, "ended", "reset"), (2, "began", "reset"),
        (2, "ended", "crashed"), (3, "began", "start"), (3, "ended", "finished"),
    ]  # fmt: skip


def test_everything_at_once_is_in_order_and_counted(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope(run_id=1))
    events = find_events(rover, found, limit=200)
    walls = [event.wall_time_s for event in events.events]
    assert walls == sorted(walls)
    assert sum(events.verdicts.found.values()) == len(events.events)
    assert events.verdicts.found["change"] == 5


def test_a_limit_keeps_rare_kinds_and_says_what_is_left_out(rover: sqlite3.Connection) -> None:
    found = find_range(rover, Scope(run_id=1))
    events = find_events(rover, found, limit=12)
    assert len(events.events) <= 12
    kinds = {event.kind for event in events.events}
    assert {"stuck", "gap", "command", "run"} <= kinds
    told = Counter(event.kind for event in events.events)
    left_out = {kind: each.count for kind, each in events.left_out.items()}
    assert left_out and told + Counter(left_out) == events.verdicts.found


def record_a_busy_run(connection: sqlite3.Connection) -> Recorder:
    """100 s in which a flag changes each second, with 3 warnings, and 2 pictures a second."""
    recorder = start_run(connection)
    picture = {"kind": "camera", "width": 1, "height": 1, "size_bytes": 1}
    for step in range(1000):
        recorder.publish(step * 0.1, {"lit": step // 10 % 2 == 0, "mode": "ab"[step // 20 % 2]})
        if step % 5 == 0:
            recorder.insert("image", **recorder.at(step * 0.1), path=f"{step}.png", **picture)
        if step in (100, 101, 700):
            line = {"level": "warning", "source": "controller", "message": str(step)}
            recorder.insert("log", **recorder.at(step * 0.1), **line)
    return recorder


@pytest.mark.parametrize("limit", [1, 7, 60])
def test_cursors_lead_through_all_that_was_left_out_while_more_is_recorded(
    empty: sqlite3.Connection, limit: int
) -> None:
    recorder = record_a_busy_run(empty)
    whole = find_events(empty, find_range(empty, Scope()), limit=1000).events
    found: list[Event] = []
    page = find_events(empty, find_range(empty, Scope()), limit=limit)
    while True:
        assert 0 < len(page.events) <= limit
        found += page.events
        if page.cursor is None:
            break
        time_s = 100.0 + len(found)
        recorder.publish(time_s, {"lit": None, "mode": "c"})
        line = {"level": "error", "source": "controller", "message": "later"}
        recorder.insert("log", **recorder.at(time_s), **line)
        page = find_events(empty, find_range(empty, Scope()), limit=limit, after=page.cursor)

    def subject(event: Event) -> tuple[object, ...]:
        return event.kind, event.name, event.start_s

    early = [subject(event) for event in found if event.start_s < 100.0]
    assert sorted(early, key=str) == sorted(map(subject, whole), key=str)


def test_what_happens_all_the_time_crowds_nothing_out_and_is_named_by_time(
    empty: sqlite3.Connection,
) -> None:
    record_a_busy_run(empty)
    events = find_events(empty, find_range(empty, Scope()), limit=6, group=False)
    told = [(event.kind, event.name) for event in events.events]
    assert told.count(("log", "warning")) == 3 and told.count(("run", None)) == 1
    changes = events.left_out["change"]
    assert changes.count == events.verdicts.found["change"] - 2
    assert (changes.first.start_s, changes.last.start_s) == pytest.approx((1.0, 98.0), abs=0.01)


def test_pictures_are_told_only_where_they_are_asked_for(empty: sqlite3.Connection) -> None:
    record_a_busy_run(empty)
    assert "image" not in find_events(empty, find_range(empty, Scope())).verdicts.found
    assert ask(empty, "image").verdicts.found == {"image": 200}


def test_a_cursor_of_find_events_that_is_none_is_refused(rover: sqlite3.Connection) -> None:
    for wrong in ("x", "[]", "5", '{"log": 3}', '{"log": [1, 2]}', "null"):
        with pytest.raises(InvalidInputError, match="not a cursor"):
            find_events(rover, find_range(rover, Scope()), after=wrong)


def test_what_there_was_no_time_for_is_named(rover: sqlite3.Connection, looked_at: str) -> None:
    found = find_range(rover, Scope(run_id=1))
    told = find_events(rover, found, deadline_s=0.0)
    assert not told.events and not told.verdicts.not_found and not told.verdicts.found
    for kind in asked_kinds(EventOptions()):
        assert "alone, or a shorter range" in told.verdicts.not_searched[kind.name]


def test_between_two_signals_the_time_is_looked_at(
    rover: sqlite3.Connection,
) -> None:
    time_range = find_range(rover, Scope(run_id=1))
    options = EventOptions(kinds=("jump",))
    kinds, known = asked_kinds(options), known_signals(rover, time_range)
    told: list[str] = []
    for limit in range(4, 14):
        ticks, coverage = count(), SearchCoverage()
        deadline = Deadline(limit, lambda ticks=ticks: next(ticks))
        search = Search(rover, time_range.segments[0], known, kinds, options, deadline, coverage)
        found = events_touching(search)
        told += coverage.verdicts(
            [kind.name for kind in kinds], count_by_kind(found)
        ).not_searched.values()
    assert any(re.search(r"time limit reached, \d+ signals left: ask for", each) for each in told)


def test_options_without_sense_are_refused(rover: sqlite3.Connection) -> None:
    with pytest.raises(InvalidInputError, match="kind"):
        ask(rover, "stcuk")
    with pytest.raises(InvalidInputError, match="stuck_s"):
        EventOptions(stuck_s=0)
    with pytest.raises(UnknownSignalError):
        ask(rover, "stuck", mode="moood")
    with pytest.raises(InvalidInputError, match="matches 2 signals"):
        ask(rover, "stuck", position=("pose", "pose.1"))


@pytest.mark.parametrize("seed", range(10))
def test_noise_neither_jumps_nor_swings(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(size=2000)
    jumps, largest, least = find_jumps(frame_of(np.arange(2000.0), {"x": noise}), "x", 12.0)
    assert not jumps and largest < least < math.inf


def test_a_wall_range_over_several_runs_knows_the_signals_of_each(
    empty: sqlite3.Connection,
) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    session_id = recorder.session(robot_id, "a" * 64)
    for run, name in enumerate(("alt_m", "depth_m", "temp_c")):
        recorder.run(session_id, robot_id, "reset" if run else "start")
        for step in range(30):
            recorder.publish(step * 0.1, {name: float(step >= 20)})
    names = ("alt_m", "depth_m", "temp_c")
    where = " or ".join(f"{name} > 0.5" for name in names)
    found = ask(empty, "condition", bounds={"since_wall_time": WALL_START_S}, where=where)
    assert [(e.run_id, e.start_s) for e in found.events] == [(1, 2.0), (2, 2.0), (3, 2.0)]


def test_a_gap_is_an_event_also_where_the_range_lies_within_it(
    rover: sqlite3.Connection, looked_at: str
) -> None:
    for start_s, end_s in ((91.0, 93.0), (88.0, 92.0), (94.0, 99.0)):
        asked = {"run_id": 1, "start_s": start_s, "end_s": end_s}
        assert spans(ask(rover, "gap", bounds=asked)) == [(89.9, 95.0)]
    for start_s, end_s in ((80.0, 89.9), (95.0, 99.0)):
        asked = {"run_id": 1, "start_s": start_s, "end_s": end_s}
        assert spans(ask(rover, "gap", bounds=asked)) == []
