"""Each part of a bridge works with the few parts that it is given, without a session."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import send
from webots_mcp import MemoryDatabase
from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.claimed_commands import ClaimedCommand, ClaimedCommands, Handlers, Reloads
from webots_mcp.bridge.control import Control
from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.devices import DeviceReader
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.full_rate import FullRateRecorder
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.log_handler import LogHandler
from webots_mcp.bridge.output_channel import OutputChannel
from webots_mcp.bridge.parameters import Parameters
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.picture_files import PictureFiles
from webots_mcp.bridge.printed_lines import PrintedLines
from webots_mcp.bridge.publishing import Publisher
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.redirection import Redirection
from webots_mcp.bridge.registration import identify
from webots_mcp.bridge.run_goal import Watch, read_goal
from webots_mcp.bridge.running_actions import RunningActions
from webots_mcp.bridge.scene_actions import SceneActions
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.bridge.watchdog import Watchdog
from webots_mcp.bridge.world_actions import WorldActions
from webots_mcp.contract import VERSION
from webots_mcp.database.pause_states import Cause
from webots_mcp.errors import CommandRefusedError
from webots_mcp.signals.parameter import declare
from webots_mcp.standin import InProcessSupervisor

STEP_MS = 16


class Base:
    """What most parts rest on: the simulation, its clock, and a recorder in memory."""

    def __init__(self, robot: InProcessSupervisor, folder: Path) -> None:
        self.folder = folder
        self.errors = ErrorReport(strict=True)
        self.simulation = Simulation(robot)
        self.clock = Clock(self.simulation)
        identity = identify(robot, self.simulation.supervisor, VERSION, 1, None)
        self.database = MemoryDatabase()
        self.recorder = Recorder(self.database, identity, self.clock, self.errors)
        self.journal = Journal(self.recorder, self.clock)
        self.heartbeat = Heartbeat(self.recorder, self.clock)
        self.variables = ControllerVariables(self.clock, self.journal, self.errors, folder)

    def rows(self, sql: str) -> list[tuple[Any, ...]]:
        connection = self.recorder.connection
        assert connection is not None
        return connection.execute(sql).fetchall()

    def pause(self) -> Pause:
        return Pause(self.simulation, self.journal, self.heartbeat, lambda: None, lambda: None)

    def full_rate(self, throttle: Throttle, last_s: float = 1.0) -> FullRateRecorder:
        files = PictureFiles(self.recorder, self.clock, self.folder)
        return FullRateRecorder(self.clock, self.recorder, self.journal, files, throttle, last_s)

    def parameters(self, pause: Pause) -> Parameters:
        handlers = Handlers(self.recorder, self.journal, pause)
        parts = (self.clock, self.recorder, self.journal)
        return Parameters(*parts, handlers, self.errors, "rover")

    def breakpoints(self, pause: Pause, full_rate: FullRateRecorder) -> Breakpoints:
        parts = (self.simulation, self.clock, self.recorder, self.journal)
        return Breakpoints(*parts, pause, full_rate, self.variables)


@pytest.fixture
def base(robot: InProcessSupervisor, tmp_path: Path) -> Base:
    return Base(robot, tmp_path)


def test_a_throttle_admits_each_nth_call_and_a_wanted_one() -> None:
    throttle = Throttle(3)
    assert [throttle.admits(force=False) for _ in range(6)] == [False, False, True] * 2
    throttle.want()
    assert throttle.admits(force=False)


def test_a_keeper_writes_the_throttled_calls_before_a_moment(base: Base) -> None:
    throttle = Throttle(5)
    full_rate = base.full_rate(throttle)
    for n in range(3):
        assert not throttle.admits(force=False)  # it also numbers the calls
        full_rate.add({"n": n})
    full_rate.keep("a crash")
    full_rate.write_all()
    assert len(base.rows("SELECT data FROM kept_state")) == 3
    full_rate.close()


def test_a_pause_stops_the_simulation_and_its_end_lets_it_run(base: Base) -> None:
    pause = base.pause()
    pause.begin(Cause(7))
    assert base.simulation.mode_name == "pause"
    pause.end(8, "fast")
    assert base.simulation.mode_name == "fast"
    assert [kind for (kind,) in base.rows("SELECT kind FROM event ORDER BY id")] == [
        "pause",
        "resume",
    ]


def test_parameters_are_declared_and_set(base: Base) -> None:
    parameters = base.parameters(base.pause())
    speed = parameters.declare(declare("speed", 1.0))
    parameters.take_wanted()
    assert speed.value == 1.0


def test_breakpoints_hit_on_the_state_where_their_condition_begins_to_hold(base: Base) -> None:
    breakpoints = base.breakpoints(base.pause(), base.full_rate(Throttle(1)))
    breakpoints.begin()
    breakpoints.set("n > 1", "log", 1)
    hits = [len(breakpoints.evaluate({"n": n})) for n in (1, 2, 3)]
    assert hits == [0, 1, 0]


def test_a_publisher_records_what_its_throttle_admits(base: Base) -> None:
    throttle = Throttle(2)
    full_rate, pause = base.full_rate(throttle), base.pause()
    publisher = Publisher(
        base.clock,
        base.recorder,
        base.journal,
        base.heartbeat,
        throttle,
        base.breakpoints(pause, full_rate),
        Watch(base.clock, 0.0),
        full_rate,
        DeviceReader(base.simulation, base.journal, base.errors, lambda: None),
        Reloads(base.errors.failed),
        base.variables,
        begin_run=lambda: None,
    )
    for n in range(4):
        publisher.publish({"n": n}, force=False)
    assert base.rows("SELECT data FROM state") == [('{"n":1}',), ('{"n":3}',)]


def test_control_claims_a_command_runs_its_handler_and_writes_the_answer(base: Base) -> None:
    pause = base.pause()
    handlers = Handlers(base.recorder, base.journal, pause)
    handlers.register("double", lambda command: 2 * command["params"]["n"])
    parts = (base.simulation, base.clock, base.journal, base.heartbeat)
    queue, reloads = ClaimedCommands(base.recorder), Reloads(base.errors.failed)
    control = Control(*parts, queue, pause, reloads, handlers, {})
    connection = base.recorder.connection
    assert connection is not None
    send(connection, "double", {"n": 4})
    assert control.serve() is not None
    assert base.rows("SELECT status, result FROM command") == [("done", "8")]


def test_the_actions_that_run_the_simulation_need_no_session(base: Base) -> None:
    pause, throttle = base.pause(), Throttle(1)
    queue, reloads = ClaimedCommands(base.recorder), Reloads(base.errors.failed)
    world = WorldActions(base.simulation, base.clock, pause, queue, reloads, lambda _: None)
    running = RunningActions(
        base.simulation,
        base.clock,
        pause,
        throttle,
        Watch(base.clock, 0.0),
        base.breakpoints(pause, base.full_rate(throttle)),
        base.parameters(pause),
        world.reset_world,
        check_clock=lambda: None,
    )
    with pytest.raises(StopIteration) as answer:
        next(running.by_name()["fast"](ClaimedCommand(1, "fast", {}, 1)))
    assert answer.value.value == {"mode": "fast", "sim_time_s": 0.0}


def test_the_goal_of_a_run_is_watched_without_a_session(
    base: Base, robot: InProcessSupervisor
) -> None:
    ended = list[str]()
    watch = Watch(base.clock, 0.0)
    watch.begin(1, read_goal({"until": "n > 1"}), lambda: ended.append("ended"))
    with pytest.raises(CommandRefusedError):
        watch.require_free()
    for n in range(3):
        robot.step(STEP_MS)
        base.clock.update()
        watch.evaluate({"n": n})
    assert watch.over() and ended == ["ended"]


def test_the_actions_on_the_scene_need_no_session(base: Base) -> None:
    scene = SceneActions(base.simulation, base.clock, base.journal, base.errors)
    with pytest.raises(StopIteration) as answer:
        progress = scene.by_name()["get_scene"](ClaimedCommand(1, "get_scene", {}, 1))
        for _ in range(1000):
            next(progress)
    assert answer.value.value["rows"]


def test_a_watchdog_writes_its_file_next_to_the_database(base: Base) -> None:
    file = base.folder / "webots.db"
    parts = (base.simulation, base.clock, base.recorder, base.journal, base.variables)
    watchdog = Watchdog(*parts, file, limit_s=5.0)
    watchdog.begin()
    assert [each.name for each in base.folder.iterdir() if base.recorder.uuid in each.name]
    watchdog.close()
    assert not [each.name for each in base.folder.iterdir() if base.recorder.uuid in each.name]


def test_printed_lines_are_whole_and_the_rest_becomes_one_at_the_end() -> None:
    lines = PrintedLines()
    lines.take(b"one\n\ntwo\nth")
    assert lines.remove() == ["one", "two"]
    lines.take(b"ree")
    lines.end()
    assert lines.remove() == ["three"]


def test_a_redirected_descriptor_is_read_until_it_is_restored(tmp_path: Path) -> None:
    with (tmp_path / "output").open("w+b", buffering=0) as file:
        redirection = Redirection(file.fileno(), blocking=True)
        file.write(b"into the pipe")
        redirection.restore()
        file.write(b"into the file")
        assert os.read(redirection.read_end, 100) == b"into the pipe"
        redirection.close()
        assert (tmp_path / "output").read_bytes() == b"into the file"


def test_an_output_channel_forwards_and_records(tmp_path: Path) -> None:
    recorded = list[tuple[str, str]]()
    with (tmp_path / "output").open("w+b", buffering=0) as file:
        channel = OutputChannel(
            "stdout",
            Redirection(file.fileno(), blocking=os.name != "posix"),
            PrintedLines(),
            lambda name, lines: recorded.extend((name, line) for line in lines),
            writes_to_descriptor=False,
        )
        print("of Python")
        file.write(b"of C code\n")
        channel.close()
    assert sorted(recorded) == [("stdout", "of C code"), ("stdout", "of Python")]
    assert (tmp_path / "output").read_bytes() == b"of C code\n"


def test_a_log_handler_records_level_and_logger_and_ignores_lines_of_the_recording() -> None:
    logger, recorded = logging.Logger("wheels"), list[object]()

    def record(text: object, level: object, name: str | None) -> None:
        recorded.append((text, level, name))
        logger.error("written while recording")

    logger.addHandler(LogHandler(record, "info"))
    logger.debug("too low")
    logger.warning("slip %s", "left")
    assert recorded == [("slip left", logging.WARNING, "wheels")]
