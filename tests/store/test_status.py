"""What is said about a robot's time: running, paused, stopped or never seen."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp import MCPBridge
from webots_mcp.connection import connect
from webots_mcp.contract import UNSEEN
from webots_mcp.queue import CommandQueue
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.recording import look
from webots_mcp.store.robots import Status, judge, newest_session
from webots_mcp.store.run_rows import current_run
from webots_mcp.waiting_file import waiting_paths

NOW = 4_000_000_000.0  # later than this process, whose sessions these are


def status_of(robot: RecordedRobot, after_s: float = 0.0) -> Status:
    session = newest_session(robot.connection, robot.id)
    return judge(robot.connection, session, current_run(robot.connection, robot.id), NOW + after_s)


def dead_pid() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def test_a_robot_whose_time_moves_is_running(recorded: Recorded) -> None:
    assert status_of(recorded.robot(now=NOW), after_s=0.6) == ("running", None)


def test_a_loop_that_runs_and_publishes_nothing_says_so(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, sim_time_s=20.0)
    for i in range(4):
        robot.state(i * 0.5, {}, at=NOW - 20 + i * 0.5)
    status = status_of(robot, after_s=0.6)
    assert status.is_moving
    assert "for 18.5 s of simulation time it recorded no state" in (status.why or "")


def test_a_loop_that_publishes_now_and_then_publishes(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, sim_time_s=20.0)
    for i in range(4):
        robot.state(i * 5.0, {}, at=NOW - 20 + i * 5)
    assert status_of(robot, after_s=0.6) == ("running", None)


def test_a_running_robot_stays_running_between_two_heartbeats(recorded: Recorded) -> None:
    assert status_of(recorded.robot(now=NOW), after_s=1.4).is_moving


def test_a_slow_simulation_is_given_the_time_that_its_rows_take(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW)
    for i in range(4):
        robot.state(i * 0.016, {}, at=NOW - 3 * (3 - i))
    assert status_of(robot, after_s=8).text == "running"
    assert status_of(robot, after_s=12).text == "stopped 12 s ago"


def test_one_long_pause_among_the_last_rows_does_not_make_the_robot_look_slow(
    recorded: Recorded,
) -> None:
    robot = recorded.robot(now=NOW)
    for at in (NOW - 60.2, NOW - 60.1, NOW - 0.2, NOW - 0.1, NOW):
        robot.state(0.016, {}, at=at)
    assert status_of(robot, after_s=2).text == "stopped 2.0 s ago"


def test_a_held_loop_is_paused(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, pause_state="paused", moved_wall_time_s=NOW - 100)
    assert status_of(robot, after_s=0.5) == ("paused", None)


def test_a_loop_that_steps_under_command_is_running(recorded: Recorded) -> None:
    assert status_of(recorded.robot(now=NOW, pause_state="stepping")).text == "running"


def test_a_pause_counts_from_its_instant_not_from_the_next_heartbeat(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW - 0.2)
    robot.now = NOW
    robot.event(1.0, "pause", None, {"command_id": 1})
    assert status_of(robot).text == "paused"


def test_a_resume_counts_from_its_instant_not_from_the_next_heartbeat(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW - 0.2, pause_state="paused", moved_wall_time_s=NOW - 100)
    robot.now = NOW
    robot.event(1.0, "pause", None, {"command_id": 1})
    robot.event(1.0, "resume", None, {"command_id": 2})
    assert status_of(robot).text == "running"


def test_a_hold_whose_heartbeat_stopped_is_no_pause_any_more(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, pause_state="paused", moved_wall_time_s=NOW - 5)
    status = status_of(robot, after_s=30)
    assert status.text == "stopped 35 s ago"
    assert "loop is silent" in (status.why or "")


def test_a_robot_is_paused_while_another_holds_the_same_simulation(recorded: Recorded) -> None:
    robot = recorded.robot("rover", now=NOW, last_seen_wall_time_s=NOW - 60)
    recorded.robot("referee", now=NOW, pause_state="paused")
    assert status_of(robot).text == "paused"
    assert "'referee'" in (status_of(robot).why or "")


def test_a_hold_in_another_simulation_says_nothing_about_this_one(recorded: Recorded) -> None:
    robot = recorded.robot("rover", now=NOW)
    recorded.robot("referee", now=NOW, pause_state="paused", instance="webots-2")
    assert status_of(robot).text == "running"


def test_a_silent_loop_in_a_living_process_is_stopped_for_one_of_the_known_reasons(
    recorded: Recorded,
) -> None:
    status = status_of(recorded.robot(now=NOW), after_s=42)
    assert status.text == "stopped 42 s ago"
    for reason in ("paused by hand", "breakpoint", "another controller", "extern controller"):
        assert reason in (status.why or "")


def test_a_loop_that_lives_without_moving_time_says_so(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, moved_wall_time_s=NOW - 20)
    status = status_of(robot)
    assert status.text == "stopped 20 s ago"
    assert "stands still" in (status.why or "")


def test_a_controller_that_has_just_started_is_starting_and_soon_called_stopped(
    recorded: Recorded,
) -> None:
    robot = recorded.robot(now=NOW, moved_wall_time_s=None)
    assert status_of(robot, after_s=1) == ("starting", status_of(robot).why)
    assert "just started" in (status_of(robot).why or "")
    robot.beat(last_seen_wall_time_s=NOW + 5)
    assert status_of(robot, after_s=5).text == "stopped 5.0 s ago"
    assert "not moved since" in (status_of(robot, after_s=5).why or "")


def test_a_controller_of_which_no_step_was_ever_seen_is_not_said_to_have_stopped(
    recorded: Recorded,
) -> None:
    robot = recorded.robot(now=NOW, moved_wall_time_s=None, last_poll_wall_time_s=None)
    status = status_of(robot, after_s=42)
    assert status.text == "not seen moving for 42 s"
    for part in ("paused in Webots", "not reached its loop", "bridge.get_command()", "attach"):
        assert part in (status.why or "")


@pytest.mark.parametrize(("mode", "why"), [("fast", "does not see"), ("pause", "paused in Webots")])
def test_that_an_observer_sees_time_go_on_does_not_make_an_unseen_loop_hang(
    recorded: Recorded, mode: str, why: str
) -> None:
    instance = "webots 1"
    observer = recorded.robot("observer", now=NOW, instance=instance)
    observer.event(0.0, "mode", None, {"mode": mode})
    robot = recorded.robot(
        now=NOW, instance=instance, moved_wall_time_s=None, last_poll_wall_time_s=None
    )
    status = status_of(robot, after_s=1.9)
    assert why in (status.why or "") and "hangs" not in (status.why or "")


def test_a_loop_that_was_found_to_step_unseen_is_said_to(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, sim_time_s=20.0, last_error=f"{UNSEEN}; 1.0 s so far")
    robot.state(0.0, {}, at=NOW - 20)
    assert status_of(robot, after_s=0.6) == ("running", UNSEEN)
    robot.beat(ended_wall_time_s=NOW, end_reason="finished")
    assert status_of(robot).why == UNSEEN


def test_a_loop_that_fell_silent_when_its_time_stopped_is_not_said_to_be_alive(
    recorded: Recorded,
) -> None:
    status = status_of(recorded.robot(now=NOW), after_s=1.8)
    assert status.text == "stopped 1.8 s ago"
    assert "loop is silent" in (status.why or "")


def claimed(robot: RecordedRobot, action: str, at: float) -> int:
    command = CommandQueue(robot.connection).enqueue(robot.id, action)
    robot.connection.execute(
        "UPDATE command SET status = 'claimed', session_id = ?, claimed_wall_time_s = ?",
        (robot.session_id, at),
    )
    return command.id


def test_a_row_that_is_further_than_the_heartbeat_shows_that_time_moves_again(
    recorded: Recorded,
) -> None:
    robot = recorded.robot(now=NOW, moved_wall_time_s=NOW - 25, sim_time_s=36.7)
    robot.state(36.72, {"x": 1}, at=NOW + 0.1)
    assert status_of(robot, after_s=0.2).text == "running"
    assert status_of(robot, after_s=9).text == "stopped 8.9 s ago"


def test_a_row_that_was_written_while_time_stood_still_does_not_look_like_movement(
    recorded: Recorded,
) -> None:
    robot = recorded.robot(now=NOW, moved_wall_time_s=NOW - 25, sim_time_s=36.72)
    robot.state(36.72, {"x": 1}, at=NOW + 0.1)
    assert status_of(robot, after_s=0.2).text == "stopped 25 s ago"


def test_a_loop_that_is_inside_a_handler_says_in_which(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW)
    command_id = claimed(robot, "slow", NOW)
    status = status_of(robot, after_s=42)
    assert status.text == "stopped 42 s ago"
    assert status.why == f"its loop is inside the handler of command {command_id} (slow) for 42.0 s"


def test_a_built_in_action_that_is_under_way_is_no_reason_to_stand(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW)
    claimed(robot, "screenshot", NOW)
    assert "loop is silent" in (status_of(robot, after_s=42).why or "")


@pytest.mark.parametrize(
    ("end_reason", "said"),
    [("finished", "finished"), ("reload", "reloaded"), ("crashed", "killed or crashed")],
)
def test_an_ended_session_tells_how_it_ended(
    recorded: Recorded, end_reason: str, said: str
) -> None:
    robot = recorded.robot(now=NOW, ended_wall_time_s=NOW, end_reason=end_reason)
    status = status_of(robot, after_s=7)
    assert status.text == "stopped 7.0 s ago"
    assert said in (status.why or "")


@pytest.mark.parametrize("managed", [True, False])
def test_a_controller_that_an_exception_ended_names_it(tmp_path: Path, managed: bool) -> None:
    loop = "with bridge:\n    {}['speed']" if managed else "{}['speed']"
    program = (
        "import sys\n"
        "from webots_mcp import MCPBridge\n"
        "from webots_mcp.standin import InProcessSupervisor\n"
        "bridge = MCPBridge(InProcessSupervisor('rover'), database=sys.argv[1])\n"
        f"bridge.publish({{'n': 1}})\n{loop}\n"
    )
    file = tmp_path / "webots.db"
    command = [sys.executable, "-c", program, str(file)]
    subprocess.run(command, stderr=subprocess.DEVNULL, check=False)
    with closing(connect(file, "reader")) as connection:
        status = judge(connection, newest_session(connection, 1), None, time.time())
    assert "its controller ended by KeyError: 'speed'" in (status.why or "")


def test_where_the_database_takes_no_rows_it_says_in_which_file_they_wait_and_since_when(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "webots.db"
    with MCPBridge(InProcessSupervisor("rover"), database=file, throttle_interval=1) as bridge:
        writer = bridge._session.recorder.connection  # pyright: ignore[reportPrivateUsage]
        assert writer is not None
        (pages,) = writer.execute("PRAGMA page_count").fetchone()
        writer.execute(f"PRAGMA max_page_count={pages}")
        began_s = time.time()
        while not bridge.stats().rows_waiting:
            bridge.publish({"padding": "x" * 1000})
        (waiting,) = waiting_paths(file)
        os.utime(waiting, (began_s + 30, began_s + 30))
        with closing(connect(file, "writer")) as connection:
            connection.execute("UPDATE session SET last_seen_monotonic_s = NULL")
            session = newest_session(connection, 1)
            going, gone = (judge(connection, session, None, began_s + s) for s in (30.5, 60))
    assert going.text == "running"
    assert f"wait in {waiting.name} next to it, for 30 s now" in (going.why or "")
    assert gone.text == "stopped 30 s ago"
    assert waiting.name in (gone.why or "")
    assert "database or disk is full" in capfd.readouterr().err


def test_a_process_that_is_gone_is_not_running_even_with_a_fresh_heartbeat(
    recorded: Recorded,
) -> None:
    status = status_of(recorded.robot(now=NOW, pid=dead_pid()))
    assert status.text == "stopped 0.0 s ago"
    assert "gone" in (status.why or "")


def test_a_session_on_another_host_is_judged_by_its_heartbeat(recorded: Recorded) -> None:
    robot = recorded.robot(now=NOW, host="elsewhere", pid=1)
    assert status_of(robot).text == "running"
    assert "gone" in (status_of(robot, after_s=60).why or "")


def test_without_a_session_a_robot_was_never_seen(recorded: Recorded) -> None:
    assert judge(recorded.connection, None, None, NOW).text == "never seen"


def test_an_answer_tells_one_moment_whatever_is_recorded_while_it_is_put_together(
    recorded: Recorded,
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    view = look(recorded.connection, "rover")
    robot.state(2.0, {"x": 2})
    robot.event(2.0, "pause", None, {"command_id": 1})
    header = view.header()
    assert (header["sim_time_s"], header["status"]) == (1.0, "running")
