"""Robots without a bridge, recorded from what they write into `customData`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.simulator.observer.conftest import OBSERVER, STEP_MS, Watching
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge.custom_data import LONGEST_TEXT, signals_of
from webots_mcp.errors import CommandRefusedError
from webots_mcp.questions.list_robots import webots_get_world_info
from webots_mcp.setup.doctor import all_checks, diagnose, subject_of
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.recording import RecordingAccess

WORLD = """#VRML_SIM R2025a utf8
WorldInfo { basicTimeStep 16 }
Robot { name "rover" controller "rover_c" translation 1 2 0 supervisor TRUE }
E-puck { name "e-puck" controller "walls" translation 0 1 0 }
Robot { name "quiet" controller "quiet" }
"""


class Robots:
    """An observer, and the controllers of the other robots, which know nothing of it."""

    def __init__(self, world: Path, database: MemoryDatabase) -> None:
        self.watching = Watching(world, database)
        simulation = self.watching.simulation
        self.rover = InProcessSupervisor("rover", world=simulation)
        self.e_puck = InProcessSupervisor("e-puck", world=simulation)
        self.recording = RecordingAccess(database, database.data_dir)
        self.database = database

    def go_on(self, steps: int = 1, **texts: str) -> None:
        """Let time pass; `rover=...` is what that robot writes before the first step."""
        for _ in range(steps):
            for name, text in texts.items():
                robot = getattr(self, name)
                is_long = len(text.encode()) > 65_534  # which a supervisor alone can set
                field = robot.getSelf().getField("customData") if is_long else None
                (field.setSFString if field else robot.setCustomData)(text)
            texts = {}
            for robot in (self.rover, self.e_puck):
                assert robot.step(STEP_MS) == 0
            self.watching.go_on()

    def states(self, robot: str = "rover") -> list[tuple[float, dict[str, Any]]]:
        rows = self.watching.rows(
            "SELECT s.sim_time_s, s.data FROM state s JOIN run ON run.id = s.run_id "
            f"JOIN robot r ON r.id = run.robot_id WHERE r.name = '{robot}' ORDER BY s.id"
        )
        return [(time_s, json.loads(data)) for time_s, data in rows]

    def newest(self, robot: str = "rover") -> dict[str, Any]:
        return self.states(robot)[-1][1]

    def sessions(self) -> list[tuple[str, str, str | None]]:
        return self.watching.rows(
            "SELECT r.name, iif(s.versions LIKE '%python%', 'a bridge', s.controller), "
            "s.end_reason FROM session s JOIN robot r ON r.id = s.robot_id "
            "WHERE r.kind <> 'Observer' ORDER BY s.id"
        )

    def reader(self, robot: str) -> Any:
        readers = self.watching.observer.custom_data._robots.values()  # pyright: ignore[reportPrivateUsage]
        return next(each for each in readers if each.body.name == robot)

    def look_for_bridges(self) -> None:
        """As after half a second."""
        self.watching.observer.custom_data._check_sessions_s = 0.0  # pyright: ignore[reportPrivateUsage]

    def let_time_pass(self) -> None:
        """As if seconds had passed since a bridge was seen."""
        seen = self.watching.observer.custom_data._taken_at_s  # pyright: ignore[reportPrivateUsage]
        seen.update({name: at_s - 60 for name, at_s in seen.items()})


@pytest.fixture
def robots(tmp_path: Path, database: MemoryDatabase) -> Any:
    world = tmp_path / "plain.wbt"
    world.write_text(WORLD + OBSERVER, "utf-8")
    robots = Robots(world, database)
    robots.go_on(20)
    yield robots
    robots.watching.observer.custom_data.close()
    robots.watching.observer.bridge.close()


def test_each_text_is_a_state_of_that_robot_with_its_pose(robots: Robots) -> None:
    robots.go_on(2, rover='{"front_m": 0.31, "mode": "search"}', e_puck="looking for walls")
    robots.go_on(5, rover='{"front_m": 0.25, "mode": "turn"}')
    assert robots.newest() == {
        "front_m": 0.25, "mode": "turn", "x_m": 1.0, "y_m": 2.0, "z_m": 0.0, "heading_rad": 0.0,
        "roll_rad": 0.0, "pitch_rad": 0.0, "height_m": 0.0,
    }  # fmt: skip
    assert robots.newest("e-puck")["custom_data"] == "looking for walls"
    assert robots.sessions() == [
        ("rover", "rover_c", None), ("e-puck", "walls", None)
    ]  # fmt: skip
    changes = robots.watching.rows("SELECT name, data FROM event WHERE kind = 'change'")
    assert changes == [("mode", '{"from":"search","to":"turn"}')]
    roles = dict(
        robots.watching.rows(
            "SELECT s.name, s.role FROM signal s JOIN robot r ON r.id = s.robot_id "
            "WHERE r.name = 'rover' AND role IS NOT NULL"
        )
    )
    assert roles == {"x_m": "x", "y_m": "y", "z_m": "z", "heading_rad": "yaw", "mode": "mode"}


def test_a_robot_that_publishes_a_pose_itself_keeps_it_and_the_seen_one_stands_beside(
    robots: Robots,
) -> None:
    robots.go_on(3, rover='{"x_m": 7.0}')
    assert robots.newest()["x_m"] == 7.0
    assert robots.newest()["seen"]["x_m"] == 1.0
    robots.go_on(3, rover='{"height_m": 0.4}')
    assert (robots.newest()["x_m"], robots.newest()["height_m"]) == (1.0, 0.4)
    assert robots.newest()["seen"] == {"height_m": 0.0}


@pytest.mark.parametrize(
    ("text", "signals"),
    [
        ('{"a": nan, "b": [-inf, inf, -nan(ind)], "c": "nan, inf"}',
         '{"a":null,"b":[null,null,null],"c":"nan, inf"}'),
        ('{"a": NaN}', '{"a":null}'),
        ("0.5", '{"custom_data":0.5}'),
        ('{"a": 1,}', '{"custom_data":"{\\"a\\": 1,}"}'),
        ('{"a": "' + 'x\\"' * 20_000, None),  # was cut off
        ("[" * 50_000, None),
        ("1" * 50_000, None),
        ('{"a":' * 20_000, None),
        ("x" * 1_000_000, None),
        ("\x01\x7f\ufffd\ud800", None),
    ],
)  # fmt: skip
def test_whatever_is_written_becomes_a_row_of_bounded_size(
    robots: Robots, text: str, signals: str | None
) -> None:
    if "\ud800" not in text:  # which no socket carries
        robots.go_on(3, rover=text, e_puck='{"n": 1}')
        stored = robots.newest()
        assert len(json.dumps(stored)) < 2_000
        assert robots.newest("e-puck")["n"] == 1
        assert stored["x_m"] == 1.0
        if signals is not None:
            assert json.loads(signals).items() <= stored.items()
    assert len(str(signals_of(text))) < 2_000


def test_a_long_text_is_read_once_a_second_and_a_short_one_with_each_step_again(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.go_on(3, rover="y" * (LONGEST_TEXT + 1))
    rover = robots.reader("rover")
    monkeypatch.setattr(rover._field, "getSFString", None)  # nothing calls it
    robots.go_on(10, rover='{"n": 1}')
    assert "n" not in robots.newest()
    monkeypatch.undo()
    rover._read_again_s = 0.0  # as after a second
    robots.go_on(2)
    assert robots.newest()["n"] == 1
    robots.go_on(2, rover='{"n": 2}')
    assert robots.newest()["n"] == 2


def test_bytes_that_are_no_text_are_recorded_as_far_as_they_are(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.go_on(2, rover='{"n": 1}')
    field = robots.reader("rover")._field

    def as_webots_answers() -> str:
        return b'{"n": "\xff\xfe"}'.decode()

    monkeypatch.setattr(field, "getSFString", as_webots_answers)
    robots.go_on(3)
    assert robots.newest()["n"] == "\ufffd\ufffd"


def test_what_seq_leaves_out_is_counted_and_said(robots: Robots) -> None:
    for seq in (1, 2, 5, 6, 6, 9, 9.0, 3, 4):
        robots.go_on(1, rover=json.dumps({"seq": seq, "v": seq}))
    robots.go_on(2)
    assert robots.newest()["seq_missed"] == 4
    events = robots.watching.rows("SELECT data FROM event WHERE kind = 'missed'")
    assert [json.loads(data) for (data,) in events] == [
        {"messages": 2, "of": 5}, {"messages": 4, "of": 9}
    ]  # fmt: skip
    with robots.recording.view("rover") as view:
        assert view.session is not None
        assert "overwrote 4 of 9 messages" in (view.session.last_error or "")
    checked = {each.check.name: each.finding for each in diagnosed(robots)}
    assert checked["Rows"].verdict == "warning"
    assert "overwrote 4 of 9" in checked["Rows"].seen


def diagnosed(robots: Robots) -> Any:
    robots.go_on(1)
    return diagnose(subject_of(robots.recording, "it was named"), all_checks())


def test_a_reset_begins_a_run_in_which_the_old_text_is_not_believed(robots: Robots) -> None:
    robots.go_on(3, rover='{"seq": 8, "front_m": 0.1}')
    robots.rover.simulationReset()
    robots.go_on(5)
    runs = robots.watching.rows(
        "SELECT start_reason, end_reason, row_count > 0 FROM run JOIN robot r "
        "ON r.id = run.robot_id WHERE r.name = 'rover'"
    )
    assert [run[:2] for run in runs] == [("start", "reset"), ("reset", None)]
    assert "front_m" not in robots.newest()
    robots.go_on(2, rover='{"seq": 1, "front_m": 0.9}')
    assert (robots.newest()["front_m"], robots.newest()["seq_missed"]) == (0.9, 0)
    assert robots.states()[-1][0] < 0.3


def test_a_text_that_was_on_its_way_at_a_reset_is_not_believed_in_the_new_run(
    robots: Robots,
) -> None:
    robots.go_on(3, rover='{"seq": 8, "at_s": 0.3}')
    robots.rover.simulationReset()
    robots.go_on(1, rover='{"seq": 9, "at_s": 0.4}')
    robots.go_on(2)
    began = [time_s for time_s, _ in robots.states()]
    since = max(number for number in range(1, len(began)) if began[number] < began[number - 1])
    assert all("at_s" not in state for _, state in robots.states()[since:])
    robots.go_on(2, rover='{"seq": 10, "at_s": 0.05}')
    assert (robots.newest()["at_s"], robots.newest()["seq_missed"]) == (0.05, 0)


def test_a_robot_that_is_gone_ends_its_session_and_one_put_back_begins_another(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots.go_on(3, rover='{"n": 1}')
    body = robots.watching.observer.world.bodies["rover"]
    monkeypatch.setattr(body.scene.node, "getId", lambda: -1)  # as of a node that is removed
    robots.go_on(1)
    assert robots.sessions() == [("rover", "rover_c", "finished")]
    robots.go_on(20)
    assert robots.sessions()[1:] == [("rover", "rover_c", None)]


def test_robots_with_a_bridge_are_left_alone_and_one_that_comes_later_takes_its_name(
    robots: Robots,
) -> None:
    early = MCPBridge.attach(robots.e_puck, database=robots.database, throttle_interval=1)
    robots.look_for_bridges()
    robots.go_on(5, rover='{"n": 1}', e_puck='{"n": 2}')
    assert [name for name, *_ in robots.sessions()] == ["e-puck", "rover"]
    late = MCPBridge.attach(robots.rover, database=robots.database, throttle_interval=1)
    assert late.robot_name == "rover"
    robots.look_for_bridges()
    robots.go_on(5, rover='{"n": 3}')
    assert robots.sessions() == [
        ("e-puck", "a bridge", None), ("rover", "rover_c", "superseded"),
        ("rover", "a bridge", None),
    ]  # fmt: skip
    late.close()
    robots.look_for_bridges()
    robots.go_on(5)
    assert len(robots.sessions()) == 3  # what stands there is of the bridge's time
    robots.let_time_pass()
    robots.look_for_bridges()
    robots.go_on(5, rover='{"n": 4}')
    assert robots.sessions()[3] == ("rover", "rover_c", None)
    reasons = robots.watching.rows("SELECT DISTINCT start_reason FROM run")
    assert reasons == [("start",)]
    early.close()


def test_commands_are_refused_and_nothing_is_said_of_get_command(robots: Robots) -> None:
    robots.go_on(5, rover='{"n": 1}')
    for action in ("pause", "dance"):
        with (
            robots.recording.reader() as connection,
            pytest.raises(CommandRefusedError, match=r"no bridge.*robot='mcp_observer'"),
        ):
            find_target(connection, "rover", action)
    said = " ".join(f"{each.finding.seen} {each.finding.fix}" for each in diagnosed(robots))
    assert "rover has no bridge, and takes no commands" in said
    assert "never called get_command" not in said
    told = webots_get_world_info.function(robots.recording, "rover").controller or {}
    assert "pid" not in told and "the observer" in told["recorded_by"]
    robots.watching.observer.custom_data.close()
    with robots.recording.view("rover") as view:
        assert "recorded by the observer" in (view.status.why or "")


def test_whose_time_a_step_takes_is_said_of_the_observer_alone(robots: Robots) -> None:
    robots.go_on(5, rover='{"n": 1}')
    robots.watching.observer.bridge.close()
    robots.watching.observer.custom_data.close()
    joined = "FROM run JOIN robot r ON r.id = run.robot_id"
    rows = robots.watching.rows(f"SELECT r.name, own_wall_s, steps {joined}")
    assert {name for name, _, steps in rows if steps} == {"mcp_observer"}
    assert ("rover", None, None) in rows


def test_what_a_car_keeps_there_for_the_vehicle_library_is_no_message(robots: Robots) -> None:
    of_car = "2.94 1.72 1.72 0.36 -1 500 2e-05 C 250 50000 1000 4500 150 0.1 0 0.25 1 6 2 4 -12 10 "
    robots.go_on(5, rover=of_car, e_puck="1 2 3 C")
    assert [name for name, *_ in robots.sessions()] == ["e-puck"]
    robots.go_on(5, rover='{"seq": 1}')
    assert robots.newest()["seq"] == 1


def test_robots_that_wrote_nothing_have_no_session_and_a_hidden_field_is_said_once(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert robots.sessions() == []

    def find_none(*_: object) -> None:
        return None

    monkeypatch.setattr("webots_mcp.bridge.custom_data.find_field", find_none)
    robots.watching.observer.custom_data.close()
    robots.go_on(10, rover='{"n": 1}')
    logs = robots.watching.rows("SELECT message FROM log WHERE message LIKE '%customData%'")
    assert len(logs) == 3
    assert robots.sessions() == []
