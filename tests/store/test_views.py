"""The views that a person meets in the `sqlite3` shell."""

from __future__ import annotations

import json
import math
import random
import sqlite3
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import Recorder, start_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import find_motion
from webots_mcp.signals.naming import USUAL_POSITIONS, find_position, flatten, metres_in
from webots_mcp.store.chunk_making import chunk_whole_run
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject
from webots_mcp.store.registered_signals import RegisteredSignal

POSES: list[tuple[dict[str, Any], tuple[Any, ...]]] = [
    ({"pose": [1, 2, 0.5], "mode": "cruise"}, (1, 2, 0.5, "cruise")),
    ({"pose": [1, 2, 9, 0.5]}, (1, 2, 0.5, None)),
    ({"pose": [1, 2, 9, 0, 0, 0.5]}, (1, 2, 0.5, None)),
    ({"pose": {"x": 1, "y": 2, "yaw": 0.5}, "state": "turn"}, (1, 2, 0.5, "turn")),
    ({"pose": {"x": 1, "y": 2, "theta": 0.5}, "mode": 3}, (1, 2, 0.5, 3)),
    ({"position": [1, 2, 9], "heading": 0.5}, (1, 2, 0.5, None)),
    ({"position": {"x": 1, "y": 2}, "state": {"deep": 1}}, (1, 2, None, None)),
    ({"gps": [1, 2, 9], "yaw": 0.5}, (1, 2, 0.5, None)),
    ({"x": 1, "y": 2}, (1, 2, None, None)),
    ({"pose": None, "mode": None}, (None, None, None, None)),
    ({"pose": "unknown"}, (None, None, None, None)),
    ({}, (None, None, None, None)),
]
VIEWS = {
    "robot_now", "robot_trajectory", "robot_run", "robot_command", "robot_event", "robot_log",
    "robot_period", "robot_statistics", "robot_parameter", "all_state", "robot_kept",
}  # fmt: skip


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    """A run that a test fills by SQL."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        yield recorder


def rows(connection: sqlite3.Connection, sql: str) -> list[Any]:
    return connection.execute(sql).fetchall()


@pytest.mark.parametrize(("state", "flat"), POSES, ids=[json.dumps(state) for state, _ in POSES])
def test_the_usual_ways_to_publish_a_pose_are_understood(
    recorder: Recorder, state: dict[str, Any], flat: tuple[Any, ...]
) -> None:
    recorder.publish(1.0, state)
    assert chunk_whole_run(recorder.connection, 1)
    for view in ("robot_trajectory", "robot_now"):
        assert rows(recorder.connection, f"SELECT x_m, y_m, yaw_rad, mode FROM {view}") == [flat]


def nested(name: str, value: Any) -> dict[str, Any]:
    """`arm.mode` as {"arm": {"mode": value}}."""
    outer, _, rest = name.partition(".")
    return {outer: nested(rest, value) if rest else value}


def placed(x_name: str, y_name: str) -> dict[str, Any]:
    """A state whose x is 1 and y is 2, at these names."""
    branch, _, key = x_name.rpartition(".")
    if key == "0":
        return {branch: [1, 2]}
    coordinates = {key: 1, y_name.rpartition(".")[2]: 2}
    return nested(branch, coordinates) if branch else coordinates


PLACES = [
    *(placed(*pair) for pair in USUAL_POSITIONS),
    {"robot_mm": {"truth": {"x": 1, "y": 2}}},
    {"robot": {"truth_cm": {"x": 1, "y": 2}, "comm": {"x": None}}},
    {"robot": {"truth": {"x": 1, "y": 2}}, "zone": {"x": 7, "y": 8}},
    {"corners": [{"x": 1, "y": 2}, {"x": 7, "y": 8}]},
    {"goal": {"x": 7, "y": 8}, "cmd_vel": {"linear": {"x": 7, "y": 8}}, "rover": {"x": 1, "y": 2}},
    {"base": {"x": 7, "y": 8}, "odometry": {"position": {"x": 1, "y": 2}}},
    {"gps": {"x": 1, "y": 2}, "x": 7, "y": 8},
    {"odom": [1, 2], "pos": {"x": 7}, "pose": {"x": "near", "y": "far"}},
    {"pose": [7], "position": {"y": 7}, "gps": [1, 2]},
    {"x": 7, "y": None, "a b": {"x": 1, "y": 2}, 'a"b': {"x": 7, "y": 8}},
    {"positionX": 1, "positionY": 2},
    {"odomX": 1, "odomY": 2, "goalX": 7, "goalY": 8},
    {"pos_x": 1, "pos_y": 2},
    {"currentPosX": 1, "currentPosY": 2, "targetPosX": 7, "targetPosY": 8},
    {"robot": {"robot_x": 1, "robot_y": 2}},
    {"goalPose": {"x": 7, "y": 8}, "myRover": {"x": 1, "y": 2}},
    {"aim": {"x": 7, "y": 8}, "currentPosition": {"x": 1, "y": 2}},
    {"robotPose": [1, 2]},
    {"nav": {"xMm": 1, "yMm": 2}},
    {"posXCm": 1, "posYCm": 2},
]
MODES = [
    *({name: "go"} for name in ("mode", "behaviour", "behavior", "action", "task", "phase")),
    *({name: "go"} for name in ("state", "status", "Mode", "STATE")),
    {"action": "go", "task": "wait", "state": "ready"},
    {"nav": {"mode": "go"}, "state": "ready", "gripper": {"action": "wait"}},
    {"nav": {"mode": "wait"}, "behaviour": "go"},
    {"arm": {"state": "go"}, "gripper": {"status": "wait"}},
    {"mode": 3, "task": None, "steps": [{"action": "go"}, {"action": "wait"}]},
    {"driveMode": "go", "lastMode": "wait"},
    {"nav": {"currentState": "go"}, "nextState": "wait"},
    {"name": "rover", "state_name": "go", "next_state_name": "wait"},
    {"nav": {"modeName": "go"}, "arm": {"state": "ready"}},
    {"STATE_STR": "go", "label": "x", "last_mode_label": "wait"},
]
CHOICES = [
    {"mode": 7},
    {"nav": {"driveMode": 7}, "speed": 3},
    {"phase": 1.5, "armState": 7},
    {"armMode": 8, "phase": 7},
    {"name": 3, "modeLabel": 7},
]


SPEEDS = [
    {"speed": 1.5, "arm": {"speed": 7}},
    {"cmd_vel": {"linear": {"x": 1.5}}, "arm": {"command": 7}},
    {"speed": 1, "commanded": 2, "wheels": {"left": 3, "right": 4}, "motor_left": {"cmd": 5}},
    {"pose": {"x": 1, "y": 2, "theta_deg": 90}, "heading": 0.5, "speed": "fast"},
    {"world": {"one": {"x_m": 1, "y_m": 2, "speed_mps": 3}}, "velocity": 0.5},
    {"odometry": [1, 2, 3, 0.5], "pose_mm": [7, 8, 9]},
]


WORDS = (
    "pose", "position", "gps", "odom", "x", "y", "X", "mm", "cm", "km", "m", "robot", "current",
    "goal", "target", "vel", "ball", "mode", "state", "status", "name", "str", "last", "next",
    "action", "arm", "GPS", "IMU", "nav", "task", "own", "0", "1", "speed", "solid", "world",
    "heading", "yaw", "deg", "theta", "cmd", "wheel", "motor", "left", "command", "z", "alt",
)  # fmt: skip


def some_key(numbers: random.Random) -> str:
    words = numbers.choices(WORDS, k=numbers.randint(1, 3))
    camel = words[0] + "".join(word.capitalize() for word in words[1:])
    return numbers.choice(("_".join(words), camel, camel[:1].upper() + camel[1:], camel.upper()))


def some_value(numbers: random.Random, depth: int = 0) -> Any:
    kind = numbers.random() + depth / 10
    if kind > 0.4:
        return numbers.choice((1, 2, 3.5, -7, 0.25, 100, "go", "wait", "", None, True))
    if kind > 0.25:
        return [some_value(numbers, depth + 1) for _ in range(numbers.randint(1, 6))]
    return {some_key(numbers): some_value(numbers, depth + 1) for _ in range(numbers.randint(1, 3))}


def some_state(numbers: random.Random) -> dict[str, Any]:
    """A state with a pair of coordinates in a branch, as a rule, and with anything else."""
    state = {some_key(numbers): some_value(numbers) for _ in range(numbers.randint(1, 4))}
    before, after = numbers.choice(("", "pos_", "robot_")), numbers.choice(("", "_mm", "_cm", "_m"))
    pair = {f"{before}x{after}": 1.5, f"{before}y{after}": 2}
    return state | ({some_key(numbers): pair} if numbers.random() < 0.7 else {})


def some_states(count: int) -> list[dict[str, Any]]:
    numbers = random.Random(11)
    return [some_state(numbers) for _ in range(count)]


def record_robots(connection: sqlite3.Connection, states: Sequence[dict[str, Any]]) -> None:
    """Each state by a robot of its own."""
    recorder = Recorder(connection)
    for number, state in enumerate(states):
        robot_id = recorder.robot(f"robot {number}")
        recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
        text = json.dumps(state, ensure_ascii=False).replace("Infinity", "1e400")
        recorder.insert("state", **recorder.at(1.0), data=text)


def seen_by_tools(connection: sqlite3.Connection, robot_id: int, state: Any) -> tuple[Any, ...]:
    """x, y, yaw, mode, speed and commanded speed of the only row of a robot."""
    subject = Subject(robot_id=robot_id, robot="", run_id=robot_id)
    motion = find_motion(catalogue(connection, subject), EventOptions())
    values = flatten(state)

    def number(signal: RegisteredSignal | None, factor: float = 1.0) -> Any:
        value = values[signal.name] if signal else None
        return value if value is None or isinstance(value, str) else value * factor

    place = [number(each, metres_in(each.name)) for each in motion.position or ()]
    x, y = (None, None) if None in place else place or (None, None)
    yaw = number(motion.heading, math.tau / ((motion.heading and motion.heading.turn) or math.tau))
    speeds = (None if motion.commanded else number(motion.speed), number(motion.commanded))
    return x, y, yaw, number(motion.mode), *speeds


@pytest.mark.slow
def test_the_views_and_the_tools_take_the_same_signals_for_the_same_roles() -> None:
    states: list[dict[str, Any]] = [*PLACES, *MODES, *CHOICES, *SPEEDS]
    states += [*(state for state, _ in POSES), *some_states(400)]
    with memory_connection() as connection:
        record_robots(connection, states)
        early = [seen_by_tools(connection, n + 1, state) for n, state in enumerate(states)]
        for run_id in range(1, len(states) + 1):
            assert chunk_whole_run(connection, run_id)
        for number, state in enumerate(states, start=1):
            wanted = seen_by_tools(connection, number, state)
            assert wanted == early[number - 1], state
            for view in ("robot_trajectory", "robot_now"):
                found = rows(
                    connection,
                    "SELECT x_m, y_m, yaw_rad, mode, iif(commanded_speed IS NULL, speed, NULL), "
                    f"commanded_speed FROM {view} WHERE run_id = {number}",
                )
                assert found == [pytest.approx(wanted)], state


@pytest.mark.parametrize("state", [*PLACES, *MODES, *CHOICES], ids=json.dumps)
def test_position_and_mode_are_found_however_they_are_called(
    recorder: Recorder, state: dict[str, Any]
) -> None:
    recorder.publish(1.0, state)
    x, y, _, mode, *_ = seen_by_tools(recorder.connection, 1, state)
    assert mode in (None, "go", 7)
    if mode is None:
        values = flatten(state)
        found = find_position([name for name, each in values.items() if type(each) is int])
        assert found is not None
        assert (values[found[0]], values[found[1]]) in ((1, 2), (150, -20.5))
        assert (x, y) == pytest.approx((metres_in(found[0]), 2 * metres_in(found[1])))


def test_what_takes_a_role_in_one_run_leaves_the_others_theirs(recorder: Recorder) -> None:
    for start_s, state in enumerate((
        {"pos": {"x": 1, "y": 2}, "state": "old"},
        {"pose": {"x": 3, "y": 4, "yaw": 0.5}, "mode": "new"},
        {"pose": {"x": None, "y": None}, "pos": {"x": 5, "y": 6}, "mode": None, "state": "both"},
    )):  # fmt: skip
        recorder.publish(float(start_s), state)
    assert chunk_whole_run(recorder.connection, 1)
    sql = "SELECT x_m, y_m, yaw_rad, mode FROM robot_trajectory"
    assert rows(recorder.connection, sql) == [
        (1, 2, None, "old"),
        (3, 4, 0.5, "new"),
        (5, 6, None, "both"),
    ]


@pytest.mark.parametrize("data", ["", "no JSON", '{"pose": NaN}', "[1, 2]", "3", "null", '{"a":'])
def test_a_row_whose_data_is_no_json_object_is_shown_without_values(
    recorder: Recorder, data: str
) -> None:
    recorder.publish(0.0, {"pose": [1, 2, 3]})
    recorder.insert("state", **recorder.at(1.0), data=data)
    assert chunk_whole_run(recorder.connection, 1)
    recorder.insert("event", **recorder.at(1.0), kind="change", name="mode", data=data)
    connection = recorder.connection
    flat = "SELECT sim_time_s, x_m, mode FROM"
    assert rows(connection, f"{flat} robot_trajectory") == [(0.0, 1, None), (1.0, None, None)]
    assert rows(connection, f"{flat} robot_now") == [(1.0, None, None)]
    assert rows(connection, "SELECT kind, from_value FROM robot_event") == [("change", None)]
    assert len(rows(connection, "SELECT * FROM robot_period")) == 2


def test_a_robot_that_never_recorded_a_state_is_shown_all_the_same(recorder: Recorder) -> None:
    recorder.robot("idle")
    sql = "SELECT robot, run_id, sim_time_s, age_s FROM robot_now ORDER BY robot"
    assert rows(recorder.connection, sql) == [
        ("idle", None, None, None),
        ("rover", 1, None, None),
    ]


def test_periods_cover_each_run_without_gap_or_overlap(reader: sqlite3.Connection) -> None:
    periods = rows(
        reader,
        "SELECT value, start_s, end_s, duration_s FROM robot_period "
        "WHERE run_id = 1 AND signal = 'mode' ORDER BY start_s",
    )
    assert [period[0] for period in periods] == ["cruise", "back_up", "turn", "cruise"]
    first = "SELECT min(sim_time_s) FROM state WHERE run_id = run.id"
    ends = rows(reader, f"SELECT ({first}), last_sim_time_s FROM run WHERE id = 1")[0]
    assert (periods[0][1], periods[-1][2]) == ends
    assert [period[1] for period in periods[1:]] == [period[2] for period in periods[:-1]]
    assert sum(period[3] for period in periods) == pytest.approx(ends[1] - ends[0], abs=0.01)


def test_the_first_period_begins_with_the_first_row_not_with_the_controller(
    recorder: Recorder,
) -> None:
    for time_s, mode in ((5.0, "a"), (8.0, "b"), (9.0, "b")):
        recorder.publish(time_s, {"mode": mode})
    change = {"kind": "change", "name": "mode", "data": '{"from": "a", "to": "b"}'}
    recorder.insert("event", **recorder.at(8.0), **change)
    recorder.end_run("finished")
    sql = "SELECT value, start_s, end_s FROM robot_period ORDER BY start_s"
    assert rows(recorder.connection, sql) == [("a", 5.0, 8.0), ("b", 8.0, 9.0)]


def test_runs_tell_durations_speed_and_rows(reader: sqlite3.Connection) -> None:
    sql = (
        "SELECT robot, duration_s, round(wall_duration_s * real_time_factor), row_count, "
        "purged_rows, "
        "start_reason, end_reason FROM robot_run ORDER BY run_id"
    )
    first, second = rows(reader, sql)
    assert first == ("rover", 19.984, 20, 530, 0, "start", "reset")
    assert second == ("rover", pytest.approx(11.968), 12, 327, 0, "reset", "finished")


def test_commands_tell_how_long_they_waited_and_ran(recorder: Recorder) -> None:
    connection, created_s = recorder.connection, recorder.wall_s
    base = {"robot_id": 1, "action": "a", "params": "{}", "created_wall_time_s": created_s}
    base["expires_wall_time_s"] = created_s + 10
    claimed = {"claimed_wall_time_s": created_s + 1, "claimed_sim_time_s": 4.0}
    done = {"finished_wall_time_s": created_s + 3, "finished_sim_time_s": 8.0}
    recorder.insert("command", **base, status="done", **claimed, **done)
    recorder.insert("command", **base, status="expired", finished_wall_time_s=created_s + 10)
    recorder.insert("command", **base, status="pending")
    sql = "SELECT status, waiting_s, running_s, running_sim_s FROM robot_command"
    finished, expired, pending = rows(connection, sql)
    assert finished == ("done", 1, 2, 4)
    assert expired == ("expired", 10, None, None)
    assert pending[1] > 1000  # it was made in 2023 and nobody claimed it
    assert pending[2:] == (None, None)


def test_log_lines_and_events_name_their_robot(reader: sqlite3.Connection) -> None:
    lines = rows(reader, "SELECT robot, run_id, level, message, logger FROM robot_log")
    assert lines[0] == ("rover", 1, "warning", "cruise -> back_up", None)
    changes = rows(
        reader,
        "SELECT robot, from_value, to_value FROM robot_event WHERE name = 'mode' AND run_id = 1",
    )
    assert changes[0] == ("rover", "cruise", "back_up")


@pytest.mark.parametrize(
    ("sql", "expected"),
    [
        ("SELECT * FROM robot_now", "SEARCH state USING COVERING INDEX"),
        ("SELECT * FROM robot_trajectory WHERE run_id = 1 AND sim_time_s > 9", "SEARCH state"),
        ("SELECT * FROM robot_event WHERE run_id = 1", "SEARCH event"),
        ("SELECT * FROM robot_log WHERE run_id = 1 AND sim_time_s > 9", "SEARCH l USING INDEX"),
        ("SELECT * FROM robot_period WHERE run_id = 1", "SEARCH e USING INDEX"),
    ],
)
def test_a_view_asked_about_one_run_uses_its_index(
    reader: sqlite3.Connection, sql: str, expected: str
) -> None:
    plan = [row[3] for row in rows(reader, f"EXPLAIN QUERY PLAN {sql}")]
    assert any(expected in line for line in plan)
    assert not any(line.startswith(("SCAN state", "SCAN e", "SCAN l")) for line in plan)


def test_the_newest_rows_are_found_without_sorting(reader: sqlite3.Connection) -> None:
    sql = "SELECT * FROM robot_trajectory ORDER BY state_id DESC LIMIT 5"
    plan = rows(reader, f"EXPLAIN QUERY PLAN {sql}")
    outermost = [detail for _, parent, _, detail in plan if parent == 0]
    assert not any("TEMP B-TREE" in line for line in outermost)


def test_the_shell_shows_what_each_view_is_for(reader: sqlite3.Connection) -> None:
    views = dict(rows(reader, "SELECT name, sql FROM sqlite_master WHERE type = 'view'"))
    assert set(views) == VIEWS
    assert all("\n/* " in sql for sql in views.values())
