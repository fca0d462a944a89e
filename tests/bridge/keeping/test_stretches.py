"""The seconds around a moment are kept at full rate, whatever the throttle drops."""

from __future__ import annotations

import json
import math
import sys
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, catch_up, eager
from tests.bridge.keeping.conftest import STRETCHES, Make, State, kept_numbers
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.contract import KEEP_AFTER_S, KEEP_LAST_S
from webots_mcp.database.connection import connect
from webots_mcp.standin import InProcessSupervisor

STEP_S = STEP_MS / 1000
EVERY = "SELECT sim_time_s, data, replaced FROM all_state WHERE run_id = ? ORDER BY sim_time_s"


def drive(robot: Any, bridge: MCPBridge, numbers: range) -> None:
    for number in numbers:
        assert robot.step(STEP_MS) != -1
        bridge.publish(state_of(number))
        eager(bridge)


def state_of(number: int) -> State:
    lidar = math.nan if number % 7 == 0 else number / 3
    return {"n": number, "mode": "drive", "lidar": [lidar, 2.5]}


def test_a_hit_keeps_each_call_of_the_seconds_before_and_after_it(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.breakpoint("n == 500", "keep")

    drive(robot, bridge, range(900))

    ((_, start_s, end_s, reason),) = recording.rows(STRETCHES)
    hit_s = robot.getTime() - 399 * STEP_S
    assert start_s == pytest.approx(hit_s - KEEP_LAST_S, abs=2 * STEP_S)
    assert end_s == pytest.approx(hit_s + KEEP_AFTER_S)
    assert "n == 500" in reason
    first, last = round(500 - KEEP_LAST_S / STEP_S), math.floor(500 + KEEP_AFTER_S / STEP_S)
    (kept,) = kept_numbers(recording)
    assert kept == list(range(kept[0], last + 1))
    assert abs(kept[0] - first) <= 2


@pytest.mark.parametrize("orjson", [True, False])
def test_recorded_and_kept_rows_are_those_of_a_recording_of_every_call(
    make: Make, database: MemoryDatabase, recording: Recording, request: Any, orjson: bool
) -> None:
    if not orjson:
        request.getfixturevalue("monkeypatch").setattr("webots_mcp.bridge.encoding.orjson", None)
    throttled, every = InProcessSupervisor("throttled"), InProcessSupervisor("every")
    bridges = [make(throttled), make(every, throttle_interval=1)]
    bridges[0].breakpoint("n == 500", "keep")
    for number in range(900):
        for robot, bridge in zip((throttled, every), bridges, strict=True):
            assert robot.step(STEP_MS) != -1
            bridge.publish(state_of(number))
    for bridge in bridges:
        bridge.close()

    kept, full = recording.rows(EVERY, 1), recording.rows(EVERY, 2)
    ((_, start_s, end_s, _),) = recording.rows(STRETCHES)
    assert len(full) == 900
    assert [row for row in kept if start_s <= row[0] <= end_s] == [
        row for row in full if start_s <= row[0] <= end_s
    ]
    assert {row[0] for row in kept} <= {row[0] for row in full}
    assert len(kept) == len({row[0] for row in kept})


def test_hits_whose_seconds_overlap_are_one_stretch(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for number in (400, 450, 700, 1500):  # 700: after the end, within the seconds before it
        bridge.breakpoint(f"n == {number}", "keep")

    drive(robot, bridge, range(2000))

    first, second = recording.rows(STRETCHES)
    assert [condition in first[3] for condition in ("400", "450", "700", "1500")] == [
        True, True, True, False,
    ]  # fmt: skip
    assert "1500" in second[3]
    for kept in kept_numbers(recording):
        assert kept == list(range(kept[0], kept[-1] + 1))
    assert kept_numbers(recording)[0][-1] == 700 + math.floor(KEEP_AFTER_S / STEP_S)


def test_a_reset_ends_the_stretch_and_the_new_run_has_none_of_the_old_one(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.breakpoint("n == 480", "keep")
    drive(robot, bridge, range(500))
    ended_s = robot.getTime()
    robot.simulationReset()
    drive(robot, bridge, range(1000, 1030))
    bridge.keep("a look")
    drive(robot, bridge, range(1030, 1060))

    (old, new) = recording.rows(STRETCHES)
    assert old[2] == pytest.approx(ended_s)
    assert (old[0], new[0], new[3]) == (1, 2, "a look")
    old_kept, new_kept = kept_numbers(recording)
    assert old_kept == list(range(old_kept[0], 500))
    assert new_kept == list(range(1000, 1060))


def test_an_error_right_before_a_reset_keeps_the_seconds_before_it_in_its_own_run(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    drive(robot, bridge, range(100))
    bridge.log("the gear is gone", "error")
    robot.simulationReset()
    drive(robot, bridge, range(1000, 1010))

    ((run_id, start_s, end_s, reason),) = recording.rows(STRETCHES)
    assert (run_id, reason) == (1, "error: the gear is gone")
    assert (start_s, end_s) == (0, pytest.approx(100 * STEP_S))
    assert kept_numbers(recording) == [list(range(100))]


@pytest.mark.parametrize(("action", "keeps"), [("pause", True), ("keep", True), ("log", False)])
def test_who_pauses_or_keeps_has_the_seconds_before_at_once(
    robot: InProcessSupervisor, make: Make, recording: Recording, action: Any, keeps: bool
) -> None:
    bridge = make(throttle_interval=100)
    bridge.breakpoint("n == 450", action)
    drive(robot, bridge, range(450))
    robot.step(STEP_MS)
    bridge.publish({"n": 450})

    if keeps and action == "pause":  # the loop stands still: all of it is there
        (kept,) = kept_numbers(recording)
        assert kept == list(range(kept[0], 451))
    assert len(recording.rows(STRETCHES)) == keeps
    recording.send("resume")
    eager(bridge)


def test_an_error_that_any_thread_logs_keeps_and_a_warning_does_not(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    drive(robot, bridge, range(100))
    bridge.log("low battery", "warning")
    drive(robot, bridge, range(100, 110))
    assert recording.rows(STRETCHES) == []
    thread = threading.Thread(target=bridge.log, args=("the gear is gone", "error"))
    thread.start()
    thread.join()
    drive(robot, bridge, range(110, 112))
    ((*_, reason),) = recording.rows(STRETCHES)
    assert reason == "error: the gear is gone"


def test_threads_may_publish_while_others_keep(robot: InProcessSupervisor, make: Make) -> None:
    bridge, before_s = make(), sys.getswitchinterval()

    def publish(thread: int) -> None:
        for number in range(1500):
            bridge.publish({"n": number, "thread": thread})
            if number % 25 == 0:
                bridge.keep("again")

    threads = [threading.Thread(target=publish, args=(number,)) for number in range(3)]
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            robot.step(STEP_MS)
            bridge.get_command()
    finally:
        sys.setswitchinterval(before_s)
    assert (bridge.stats().failures, bridge.stats().last_error) == (0, None)


def test_an_exception_that_leaves_the_with_block_keeps_the_last_call(
    robot: InProcessSupervisor, make: Make, recording: Recording
) -> None:
    with pytest.raises(KeyError), make() as bridge:
        drive(robot, bridge, range(58))
        raise KeyError("speed")
    assert kept_numbers(recording) == [list(range(58))]
    ((*_, end_s, reason),) = recording.rows(STRETCHES)
    assert end_s == pytest.approx(robot.getTime())
    assert "KeyError" in reason


def test_0_seconds_hold_and_keep_nothing_and_a_hit_says_so(
    robot: InProcessSupervisor, make: Make, recording: Recording
) -> None:
    bridge = make(keep_last_s=0)
    bridge.breakpoint("n == 50", "keep")
    bridge.log("an error", "error")
    drive(robot, bridge, range(99))
    bridge.keep("a look")
    assert recording.rows(STRETCHES) == recording.rows("SELECT id FROM kept_state") == []
    (data,) = recording.rows("SELECT data FROM event WHERE kind = 'breakpoint'")
    assert "keep_last_s" in json.loads(data)["not_kept"]


def test_the_environment_decides_how_many_seconds_are_held(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_KEEP_LAST_S", "0.5")
    bridge = make(keep_last_s=60)
    drive(robot, bridge, range(200))
    bridge.keep("a look")
    drive(robot, bridge, range(200, 201))
    bridge.close()  # writes what a slow machine has not written in that call
    (kept,) = kept_numbers(recording)
    assert kept == list(range(kept[0], 201))
    assert len(kept) == pytest.approx(0.5 / STEP_S, abs=3)


@pytest.mark.parametrize("seconds", [-1, math.nan, 1e9])
def test_seconds_that_cannot_be_held_are_refused(make: Make, seconds: float) -> None:
    with pytest.raises(ValueError, match="keep_last_s"):
        make(keep_last_s=seconds)


def test_where_each_call_is_recorded_a_stretch_is_marked_and_no_row_comes_twice(
    robot: InProcessSupervisor, make: Make, recording: Recording
) -> None:
    bridge = make(throttle_interval=1)
    drive(robot, bridge, range(700))
    bridge.keep("a look")
    drive(robot, bridge, range(700, 701))
    assert recording.rows("SELECT id FROM kept_state") == []
    ((_, start_s, _, _),) = recording.rows(STRETCHES)
    assert start_s == pytest.approx(robot.getTime() - STEP_S - KEEP_LAST_S)


def test_what_is_kept_while_the_database_is_locked_comes_once_and_in_order(
    robot: InProcessSupervisor, file: Path, filed: Recording
) -> None:
    with MCPBridge(robot, data_dir=file.parent, throttle_interval=10) as bridge:
        drive(robot, bridge, range(300))
        with closing(connect(file, "writer")) as other:
            other.execute("BEGIN IMMEDIATE")
            bridge.keep("a look")
            drive(robot, bridge, range(300, 330))
        drive(robot, bridge, range(330, 340))
        catch_up(bridge)
    (kept,) = kept_numbers(filed)
    assert kept == list(range(kept[0], 340))
    calls = filed.rows("SELECT call FROM kept_state ORDER BY id")
    assert calls == sorted(set(calls))


def test_a_condition_that_flickers_does_not_keep_a_whole_run(
    robot: InProcessSupervisor, make: Make, recording: Recording
) -> None:
    bridge = make(keep_last_s=100)
    for number in range(40):
        robot.step(20_000)
        bridge.publish({"n": number})
        bridge.keep(f"look {number}")
    total = sum(end_s - start_s for _, start_s, end_s, _ in recording.rows(STRETCHES))
    assert 600 <= total <= 600 + 102
    (line,) = recording.rows("SELECT message FROM log WHERE level = 'warning'")
    assert "600 s of this run" in line
