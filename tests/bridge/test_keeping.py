"""The seconds around a moment are kept at full rate, whatever the throttle drops."""

from __future__ import annotations

import json
import math
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bridge.conftest import STEP_MS, Recording, catch_up, eager
from tests.bridge.monsters import MONSTERS, EndlessDict
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import cleaning, encoding
from webots_mcp.bridge.encoding import copy_or_encode, encode, encode_copy
from webots_mcp.bridge.ring import Ring, RingRow
from webots_mcp.connection import connect
from webots_mcp.contract import KEEP_AFTER_S, KEEP_LAST_S
from webots_mcp.standin import InProcessSupervisor

STEP_S = STEP_MS / 1000
State = dict[str, Any]
Make = Callable[..., MCPBridge]

EVERY = "SELECT sim_time_s, data, odd FROM every_state WHERE run_id = ? ORDER BY sim_time_s"
STRETCHES = "SELECT run_id, start_sim_time_s, end_sim_time_s, reason FROM kept_stretch ORDER BY id"


@pytest.fixture
def make(
    robot: InProcessSupervisor, database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Make]:
    """Bridges that record one call in ten; strict, so that a test sees what went wrong."""
    monkeypatch.setenv("WEBOTS_MCP_STRICT", "1")
    made: list[MCPBridge] = []

    def new(of: Any = robot, **options: Any) -> MCPBridge:
        bridge = MCPBridge(of, **dict[str, Any](throttle_interval=10, database=database) | options)
        made.append(bridge)
        return bridge

    yield new
    for bridge in made:
        bridge.close()


@pytest.fixture
def bridge(make: Make) -> MCPBridge:
    return make()


def drive(robot: Any, bridge: MCPBridge, numbers: range) -> None:
    for number in numbers:
        assert robot.step(STEP_MS) != -1
        bridge.publish(state_of(number))
        eager(bridge)


def state_of(number: int) -> State:
    lidar = math.nan if number % 7 == 0 else number / 3
    return {"n": number, "mode": "drive", "lidar": [lidar, 2.5]}


def kept_numbers(recording: Recording) -> list[list[int]]:
    """The `n` of all that each kept stretch has, in order of time."""
    sql = (
        "SELECT json_extract(data, '$.n') FROM every_state "
        "WHERE run_id = ? AND sim_time_s BETWEEN ? AND ? ORDER BY sim_time_s"
    )
    return [recording.rows(sql, *where) for *where, _ in recording.rows(STRETCHES)]


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


def test_robots_of_one_database_keep_what_is_theirs(
    make: Make, database: MemoryDatabase, recording: Recording
) -> None:
    robots = [InProcessSupervisor(name) for name in ("left", "right")]
    bridges = [make(robot) for robot in robots]
    bridges[1].breakpoint("n == 300", "keep")
    for number in range(500):
        for robot, bridge in zip(robots, bridges, strict=True):
            robot.step(STEP_MS)
            bridge.publish({"n": number})

    ((run_id, *_),) = recording.rows(STRETCHES)
    assert recording.rows("SELECT DISTINCT run_id FROM kept_state") == [run_id]
    assert recording.rows("SELECT robot, states FROM robot_kept") == [
        ("right", len(kept_numbers(recording)[0]))
    ]
    (kept,) = kept_numbers(recording)
    assert kept == list(range(kept[0], kept[-1] + 1))


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


@pytest.mark.parametrize("sent", [("pause", {}), ("run", {"until": "n >= 405"})])
def test_what_is_kept_is_there_while_a_command_pauses(
    robot: Any, make: Make, recording: Recording, sent: tuple[str, State]
) -> None:
    bridge, seen = make(throttle_interval=1000), list[list[list[int]]]()
    set_mode = robot.simulationSetMode

    def noticed(mode: int) -> None:
        set_mode(mode)
        if mode == robot.SIMULATION_MODE_PAUSE:
            seen.append(kept_numbers(recording))
            recording.send("resume")

    vars(robot)["simulationSetMode"] = noticed
    drive(robot, bridge, range(404))
    recording.send(sent[0], **sent[1])
    for number in (404, 405, 406):
        robot.step(STEP_MS)
        bridge.publish({"n": number})
        bridge.log("the gear is gone", "error")
        eager(bridge)

    ((kept,),) = seen
    assert kept == list(range(kept[0], kept[-1] + 1))
    assert kept[-1] == 405
    assert kept[-1] - kept[0] > 300


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


def test_a_handler_keeps(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    bridge.register_command("look", lambda command: bridge.keep("asked for"))
    drive(robot, bridge, range(50))
    command = recording.send("look")
    drive(robot, bridge, range(50, 60))
    assert recording.fate(command)[0] == "done"
    assert kept_numbers(recording) == [list(range(60))]


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


def test_auto_publish_holds_each_call(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for number in range(45):
        robot.step(STEP_MS)
        bridge.auto_publish({"n": number})
    bridge.keep("a look")
    for number in range(45, 60):
        robot.step(STEP_MS)
        bridge.auto_publish({"n": number})
    assert kept_numbers(recording) == [list(range(60))]


class SlowDevices:
    """The clock by which reading is measured goes on by so much with each reading of the GPS."""

    def __init__(self, robot: Any, patch: pytest.MonkeyPatch) -> None:
        self.cost_us, self.readings, now_s = 0.0, 0, time.perf_counter()
        gps = robot.getDevice("gps")
        gps.enable(STEP_MS)
        values = gps.getValues

        def read() -> Any:
            nonlocal now_s
            now_s += self.cost_us / 1e6
            self.readings += 1
            return values()

        patch.setattr(gps, "getValues", read)
        patch.setattr(time, "perf_counter", lambda: now_s)

    def drive(self, robot: Any, bridge: MCPBridge, numbers: range) -> int:
        """How often the devices were read."""
        before = self.readings
        for number in numbers:
            robot.step(STEP_MS)
            bridge.auto_publish({"n": number})
        return self.readings - before


def test_slow_devices_are_read_for_the_ring_no_more_than_100_us_per_call(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make(throttle_interval=1000)
    slow.cost_us = 390
    assert slow.drive(robot, bridge, range(200)) == 51  # the first, and one in four
    assert bridge.stats().ring_interval == 4
    bridge.keep("a look")
    assert slow.drive(robot, bridge, range(200, 260)) == 15
    ((*_, reason),) = recording.rows(STRETCHES)
    why = "one call of auto_publish() in 4, because reading the devices takes 390 us"
    assert reason == f"a look; {why}"
    assert recording.rows("SELECT level, message FROM log") == [("info", f"ring buffer: {why}")]
    (kept,) = kept_numbers(recording)
    assert kept == [0, *range(3, 260, 4)]

    slow.cost_us = 40
    slow.drive(robot, bridge, range(260, 300))
    assert slow.drive(robot, bridge, range(300, 700)) == 400
    bridge.keep("another look")
    slow.drive(robot, bridge, range(700, 701))
    assert recording.rows(STRETCHES)[-1][3] == "another look"


def test_one_slow_reading_among_fast_ones_slows_nothing(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make()
    slow.cost_us = 40
    slow.drive(robot, bridge, range(20))
    slow.cost_us = 20_000
    slow.drive(robot, bridge, range(20, 21))
    slow.cost_us = 40
    assert slow.drive(robot, bridge, range(21, 60)) == 39
    assert recording.rows("SELECT message FROM log") == []


def test_slow_devices_are_read_in_every_call_where_a_breakpoint_is_armed(
    robot: InProcessSupervisor,
    make: Make,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow, bridge = SlowDevices(robot, monkeypatch), make()
    slow.cost_us = 5000
    bridge.breakpoint("n == 50", "keep")
    assert slow.drive(robot, bridge, range(60)) == 60
    ((*_, reason),) = recording.rows(STRETCHES)
    assert "one call in" not in reason
    assert kept_numbers(recording) == [list(range(60))]


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


class Measured(float):
    """A float to whoever adds it up."""


class Hailed(bytearray):
    """Holds bytes, and adds up to a float."""

    def __radd__(self, other: float) -> float:
        return other


def long_array(last: object) -> list[Any]:
    return [*[0.5] * 17, last, 1.5]


KEYS = st.one_of(
    st.text(max_size=3),
    st.sampled_from([1, 1.0, True, None, np.int64(1), np.float64(1), np.str_("a"), "a", "\ud800"]),
)
LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(st.characters(codec=None), max_size=4),
    st.sampled_from([np.float64(2.5), np.float32(0.1), np.str_("b"), Measured(3.5), b"\0\1"]),
    st.sampled_from([Measured(1), np.float64(7.5), Hailed(b"abc"), None, 2, "x"]).map(long_array),
    st.builds(np.array, st.lists(st.floats(width=32), max_size=3)),
)
STATES = st.dictionaries(
    KEYS,
    st.recursive(
        LEAVES,
        lambda inside: (
            st.lists(inside, max_size=4)
            | st.tuples(inside, inside)
            | st.frozensets(st.text(max_size=2), max_size=3)
            | st.dictionaries(KEYS, inside, max_size=4)
        ),
        max_leaves=12,
    ),
    max_size=6,
)


@given(state=STATES)
@pytest.mark.usefixtures("encoder")
def test_any_state_that_is_held_is_kept_as_it_would_be_recorded(state: State) -> None:
    expected = encode(state)
    held = copy_or_encode(state)
    state.clear()
    assert (encode_copy(held) if isinstance(held, bytes) else held) == expected


@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_a_monster_that_is_held_is_kept_as_it_would_be_recorded(
    make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (encoding, cleaning):  # a busy machine changes nothing
        monkeypatch.setattr(module, "LONGEST_S", math.inf)
    EndlessDict.asked = 0
    held = copy_or_encode({"monster": make()})
    kept = encode_copy(held) if isinstance(held, bytes) else held
    EndlessDict.asked = 0
    assert kept == encode({"monster": make()})


def test_what_the_controller_changes_after_its_call_does_not_change_what_is_kept(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    state: State = {"n": 0, "pose": [0, {"x_m": 0.0}]}
    for number in range(9):
        robot.step(STEP_MS)
        state["n"] = state["pose"][0] = state["pose"][1]["x_m"] = number
        bridge.publish(state)
    bridge.keep("a look")
    bridge.close()
    kept = map(json.loads, recording.rows("SELECT data FROM kept_state ORDER BY sim_time_s"))
    assert [*kept] == [{"n": n, "pose": [n, {"x_m": n}]} for n in range(9)]


rows = st.lists(
    st.tuples(
        st.floats(0.001, 3.0),
        st.one_of(
            st.text(max_size=40),
            st.binary(max_size=40),
            st.integers(0, 6000).map("x".__mul__),
            st.just("\U0001f916" * 900),
        ),
    ),
    max_size=60,
)


@given(rows=rows, most_bytes=st.integers(0, 20_000), last_s=st.floats(0.1, 10))
def test_a_ring_never_takes_more_memory_or_time_than_it_may_and_holds_the_newest(
    rows: list[tuple[float, str | bytes]], most_bytes: int, last_s: float
) -> None:
    ring, now_s, given_rows = Ring(last_s, most_bytes), 0.0, list[RingRow]()
    for call, (step_s, text) in enumerate(rows):
        now_s += step_s
        given_rows.append(RingRow(call, now_s, 0.0, text, None))
        ring.add(given_rows[-1])
        assert ring.size_bytes <= most_bytes
    held = ring.take()
    assert held == given_rows[len(given_rows) - len(held) :]
    assert all(row.sim_time_s >= now_s - last_s for row in held)
    fits = list[RingRow]()
    for row in reversed(given_rows):
        if row.sim_time_s < now_s - last_s:
            break
        if sum(each.size_bytes for each in [row, *fits]) > most_bytes:
            break
        fits.insert(0, row)
    assert held == fits
    assert ring.size_bytes == 0


STATES_TO_HOLD: dict[str, Callable[[int], State]] = {
    "numbers": lambda n: {"lidar": [number / 7 for number in range(n, n + 200)]},
    "one number": lambda n: {"n": n},
    "texts": lambda n: {"said": "\U0001f916" * (n % 100), "more": [None] * (n % 50)},
    "arrays of numpy": lambda n: {"lidar": np.arange(n, n + 50) / 7},
}


@pytest.mark.parametrize("make_state", STATES_TO_HOLD.values(), ids=STATES_TO_HOLD)
def test_what_a_ring_holds_takes_no_more_memory_than_it_says(
    make_state: Callable[[int], State],
) -> None:
    ring = Ring(1000, 300_000)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for number in range(1200):
            held, odd = copy_or_encode(make_state(number)), None
            if not isinstance(held, bytes):
                held, odd = held.text, held.odd_text
            ring.add(RingRow(number, number / 100, number + 0.5, held, odd))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(ring) > 50
    assert taken - before <= 300_000
