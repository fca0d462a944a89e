"""Runs, sessions, resets and reloads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording
from webots_mcp import MCPBridge, MemoryDatabase
from webots_mcp.bridge import registration
from webots_mcp.standin import InProcessRobot, InProcessSimulation, InProcessSupervisor


def test_a_reset_by_the_controller_begins_a_new_run_and_ends_the_old_one(
    robot: InProcessSupervisor,
    bridge: MCPBridge,
    recording: Recording,
    drive: Callable[[int], None],
) -> None:
    drive(10)
    robot.simulationReset()
    drive(3)
    bridge.close()
    sql = "SELECT start_reason, end_reason, row_count, last_sim_time_s FROM run ORDER BY id"
    assert recording.rows(sql) == [
        ("start", "reset", 10, pytest.approx(0.16)),
        ("reset", "finished", 3, pytest.approx(0.048)),
    ]
    assert recording.rows("SELECT count(*) FROM state GROUP BY run_id") == [10, 3]


def test_what_the_first_state_of_a_run_holds_is_no_change_from_the_run_before(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    for mode in ("cruise", "turn"):
        for _ in range(2):
            robot.step(STEP_MS)
            bridge.publish({"mode": mode})
        robot.simulationReset()
    assert recording.rows("SELECT count(*) FROM event WHERE kind = 'change'") == [0]


@pytest.mark.parametrize("attached", [False, True])
def test_like_runs_are_recorded_at_like_times_whenever_the_reset_came(
    robot: InProcessSupervisor, recording: Recording, attached: bool
) -> None:
    database: MemoryDatabase = recording.database  # type: ignore[assignment]
    make = MCPBridge.attach if attached else MCPBridge
    with make(robot, database=database) as bridge:
        for rounds in (12, 11, 13):
            for number in range(rounds):
                robot.step(STEP_MS)
                if not attached:
                    bridge.publish({"number": number})
            robot.simulationReset()
    times = recording.rows("SELECT run_id, sim_time_s FROM state ORDER BY id")
    assert times == [(run, pytest.approx(n * 0.016)) for run in (1, 2, 3) for n in (5, 10)]


def test_a_reset_fires_callbacks_once_and_is_detected_once(
    robot: InProcessSupervisor, bridge: MCPBridge, drive: Callable[[int], None]
) -> None:
    calls: list[str] = []
    bridge.on_reload(lambda: calls.append("reset"))
    drive(3)
    assert not bridge.detect_reload()
    robot.simulationReset()
    drive(3)
    assert bridge.detect_reload()
    assert not bridge.detect_reload()
    assert calls == ["reset"]


def test_detect_reload_alone_notices_a_reset(robot: InProcessSupervisor, bridge: MCPBridge) -> None:
    for _ in range(3):
        robot.step(STEP_MS)
        assert not bridge.detect_reload()
    robot.simulationReset()
    robot.step(STEP_MS)
    assert bridge.detect_reload()


def test_a_callback_that_fails_does_not_stop_the_loop_or_the_next_callback(
    robot: InProcessSupervisor, database: MemoryDatabase, capfd: pytest.CaptureFixture[str]
) -> None:
    calls: list[str] = []

    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError("no text")

    def fail() -> None:
        raise RuntimeError("broken callback")

    def fail_without_text() -> None:
        raise MuteError

    with MCPBridge(robot, database=database) as bridge:
        bridge.on_reload(fail)
        bridge.on_reload(fail_without_text)
        bridge.on_reload(lambda: calls.append("second"))
        robot.step(STEP_MS)
        robot.step(STEP_MS)
        bridge.publish({})
        robot.simulationReset()
        robot.step(STEP_MS)
        bridge.publish({})
    assert calls == ["second"]
    said = capfd.readouterr().err
    assert "broken callback" in said
    assert "MuteError" in said


def test_a_successor_in_the_same_webots_is_a_reload(
    database: MemoryDatabase, recording: Recording
) -> None:
    MCPBridge(InProcessSupervisor("rover"), database=database).close()
    with MCPBridge(InProcessSupervisor("rover"), database=database) as bridge:
        calls: list[str] = []
        bridge.on_reload(lambda: calls.append("reload"))
        assert bridge.detect_reload()
        bridge.publish({}, force=True)
        assert not bridge.detect_reload()
        assert calls == ["reload"]
    assert recording.rows("SELECT start_reason FROM run ORDER BY id") == ["start", "reload"]


def test_a_robot_that_webots_starts_again_was_ended_by_the_reload(
    database: MemoryDatabase, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_INSTANCE_PATH", "first")
    monkeypatch.setenv("WEBOTS_ROBOT_NAME", "rover")
    for _ in range(2):
        with MCPBridge(InProcessRobot("rover"), database=database) as bridge:
            bridge.publish({}, force=True)
    for table in ("session", "run"):
        ends = recording.rows(f"SELECT end_reason FROM {table} ORDER BY id")
        assert ends == ["reload", "finished"]


def test_a_successor_in_another_webots_is_a_start(
    database: MemoryDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_INSTANCE_PATH", "first")
    MCPBridge(InProcessSupervisor("rover"), database=database).close()
    monkeypatch.setenv("WEBOTS_INSTANCE_PATH", "second")
    with MCPBridge(InProcessSupervisor("rover"), database=database) as bridge:
        assert not bridge.detect_reload()


def test_two_live_robots_of_one_name_get_names_of_their_own(
    database: MemoryDatabase, recording: Recording
) -> None:
    with (
        MCPBridge(InProcessSupervisor("rover"), database=database) as first,
        MCPBridge(InProcessSupervisor("rover"), database=database) as second,
    ):
        assert (first.robot_name, second.robot_name) == ("rover", "rover#2")
    assert recording.rows("SELECT name FROM robot ORDER BY id") == ["rover", "rover#2"]


def test_a_second_bridge_on_the_same_robot_takes_over(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    first = MCPBridge(robot, database=database)
    with MCPBridge(robot, database=database) as second:
        assert second.robot_name == first.robot_name
    sql = "SELECT end_reason FROM session ORDER BY id"
    assert recording.rows(sql) == ["superseded", "finished"]


def test_a_session_says_which_code_ran_where(bridge: MCPBridge, recording: Recording) -> None:
    sql = "SELECT pid > 0, length(host) > 0, supervisor, versions ->> 'webots_mcp' FROM session"
    assert recording.rows(sql) == [(1, 1, 1, "0.1.0")]
    assert bridge.robot_name == "rover"
    assert "Lidar" in recording.rows("SELECT devices FROM robot")[0]


def test_an_exception_that_leaves_the_block_ends_the_session_as_crashed(
    robot: InProcessSupervisor, database: MemoryDatabase, recording: Recording
) -> None:
    with pytest.raises(ZeroDivisionError), MCPBridge(robot, database=database):
        _ = 1 / 0
    assert recording.rows("SELECT end_reason FROM session") == ["crashed"]


class Environment(InProcessSupervisor):
    """A reinforcement learning environment: its step() means something else."""

    def step(self, action: str) -> tuple[float, bool]:  # type: ignore[override]
        return 0.5, super().step(STEP_MS) == -1  # type: ignore[misc]


class Plain(InProcessSupervisor):
    """Its step() calls that of a class by name, without a look at what the instance has."""

    def step(self, action: str) -> tuple[float, bool]:  # type: ignore[override]
        return 0.5, InProcessSupervisor.step(self, STEP_MS) == -1


class Halves(InProcessSupervisor):
    """Its step() asks for time to pass and computes meanwhile."""

    def step(self, action: str) -> tuple[float, bool]:  # type: ignore[override]
        self.stepBegin(STEP_MS)
        return 0.5, self.stepEnd() == -1


@pytest.mark.parametrize("kind", [Environment, Plain, Halves])
def test_a_quit_during_a_held_pause_reaches_the_loop_of_a_subclass_and_of_no_other_robot(
    database: MemoryDatabase, kind: type[Environment]
) -> None:
    simulation = InProcessSimulation()
    environment = kind("rover", world=simulation)
    with MCPBridge(environment, throttle_interval=1, database=database) as bridge:
        assert environment.step("forward") == (0.5, False)
        pause = Recording(database).send("pause")
        bridge.register_command("close_window", lambda _: simulation.quit())
        Recording(database).send("close_window")
        bridge.get_command()
        assert Recording(database).fate(pause)[0] == "done"
        assert environment.step("forward") == (0.5, True)
        assert environment.step("forward") == (0.5, True)
    assert kind("rover").step("forward") == (0.5, False)


def test_an_object_that_owns_the_robot_is_refused_with_the_way_to_its_robot(
    database: MemoryDatabase,
) -> None:
    class Owner:
        robot = InProcessSupervisor("rover")

    with pytest.raises(TypeError, match=r"MCPBridge\(x\.robot\)"):
        MCPBridge(Owner(), database=database)


class Wrapper:
    """As in reinforcement learning: it owns the robot and passes on all that it does not have."""

    def __init__(self, inner: InProcessSupervisor) -> None:
        self.inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


class PassingEnvironment(Wrapper):
    def step(self, action: str) -> tuple[float, bool]:
        return 0.5, self.inner.step(STEP_MS) == -1


@pytest.mark.parametrize("wrapper", [Wrapper, PassingEnvironment])
def test_an_object_that_passes_on_to_the_robot_is_refused_with_the_way_to_its_robot(
    robot: InProcessSupervisor, database: MemoryDatabase, wrapper: type[Wrapper]
) -> None:
    with pytest.raises(TypeError, match=r"MCPBridge\(x\.inner\)"):
        MCPBridge(wrapper(robot), database=database)


def test_a_git_head_that_is_no_text_costs_the_commit_only(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git" / "HEAD").write_bytes(b"\xff\xfe")
    assert registration._git_commit(tmp_path) is None  # pyright: ignore[reportPrivateUsage]


def test_a_path_whose_bytes_are_no_text_is_recorded_readably(
    robot: InProcessSupervisor,
    database: MemoryDatabase,
    recording: Recording,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registration, "controller_file", lambda: Path("/robots/\udcff/rover.py"))
    with MCPBridge(robot, database=database):
        pass
    assert recording.rows("SELECT controller FROM session") == [str(Path("/robots/?/rover.py"))]


def test_a_wrong_database_or_interval_is_refused(robot: InProcessSupervisor) -> None:
    with pytest.raises(TypeError, match="database=42 is a int"):
        MCPBridge(robot, database=42)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="throttle_interval must be 1 or more, got 0"):
        MCPBridge(robot, throttle_interval=0, database=":memory:")


def test_a_database_may_be_in_memory_and_the_stats_tell_what_it_has_taken(
    robot: InProcessSupervisor,
) -> None:
    with MCPBridge(robot, throttle_interval=1, database=":memory:") as bridge:
        before = bridge.stats()
        bridge.publish({"x": 1})
        stats = bridge.stats()
        assert Recording(bridge.database).states() == [{"x": 1}]
    assert (stats.rows_written, stats.rows_waiting) == (before.rows_written + 1, 0)
    assert 0 < stats.publish_mean_us <= stats.publish_max_us
    assert isinstance(bridge.database, MemoryDatabase)
    bridge.database.close()


def test_a_plain_robot_records_as_well(database: MemoryDatabase, recording: Recording) -> None:
    with MCPBridge(InProcessRobot("rover"), throttle_interval=1, database=database) as bridge:
        bridge.publish({"x": 1})
    assert recording.rows("SELECT kind FROM robot") == ["Robot"]
    assert recording.states() == [{"x": 1}]


def test_webots_ending_the_controller_ends_the_users_loop_and_the_session(
    database: MemoryDatabase, recording: Recording
) -> None:
    simulation = InProcessSimulation()
    robot = InProcessSupervisor("rover", world=simulation)
    bridge = MCPBridge(robot, throttle_interval=1, database=database)
    robot.step(STEP_MS)
    recording.send("pause")
    bridge.on_reload(lambda: None)
    bridge.register_command("leave", lambda _: simulation.quit())
    recording.send("leave")
    bridge.get_command()  # held, until the quit is seen
    assert robot.step(STEP_MS) == -1
    assert recording.rows("SELECT end_reason FROM session") == ["finished"]
