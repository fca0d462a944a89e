"""Recordings that code has made, each the same each time, which questions are asked of."""

from __future__ import annotations

import json
import math
import runpy
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from tests.recordings import bridge as rover_on_the_stand_in
from tests.recordings.long import build as build_long
from tests.recordings.rounds import record_rounds
from tests.recordings.rover import Recorder, record_rover
from webots_mcp import MCPBridge
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.standin import InProcessRobot, InProcessSupervisor
from webots_mcp.standin.in_process import InProcessSimulation
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

CHECKOUT: Final = Path(__file__).parents[2]
_EXAMPLES: Final = CHECKOUT / "examples"
CONTROLLER: Final = _EXAMPLES / "e_puck" / "controllers" / "e_puck_avoid" / "e_puck_avoid.py"
"""What bridges take for the program that they run in."""

_COMMANDS_TOOK: Final = (  # claimed before the pictures of its step, however slow the machine is
    "UPDATE command SET claimed_wall_time_s = created_wall_time_s + 0.000001, "
    "finished_wall_time_s = created_wall_time_s + 0.03"
)
_TRIED: Final = (  # speed, gait, score; without a score it fell over
    (2.0, "trot", 1.91), (2.0, "walk", 1.22), (4.0, "trot", 3.66), (4.0, "walk", 2.31),
    (8.0, "trot", None), (8.0, "walk", 4.17), (2.0, "trot", 1.94), (4.0, "trot", 3.71),
)  # fmt: skip


def draw_story(folder: Path) -> None:
    """Three runs of a rover, second by second as `tests.recordings.rover` tells."""
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        record_rover(connection)
        sum_up(connection)


def draw_rover(folder: Path) -> None:
    """What the bridge records of the demo's rover, with commands, pictures and a reset."""
    rover_on_the_stand_in.record(folder)
    with closing(connect(folder / "webots.db", "writer")) as connection:
        connection.execute(_COMMANDS_TOOK)
        sum_up(connection)


def draw_e_puck(folder: Path) -> None:
    """The e-puck of the examples, which avoids obstacles for 30 s."""
    robot = InProcessRobot(world=_EXAMPLES / "e_puck" / "worlds" / "e_puck.wbt")
    bridge = MCPBridge(robot, database=folder / "webots.db")
    e_puck = runpy.run_path(str(CONTROLLER))["EPuck"](robot, bridge)
    while robot.step(int(robot.getBasicTimeStep())) != -1 and robot.getTime() < 30.0:
        bridge.publish(e_puck.sense())
        e_puck.decide()
        e_puck.act()
    bridge.close()
    sum_up_file(folder)


def draw_tag(folder: Path) -> None:
    """Two robots that play tag for 20 s, and the referee who counts."""
    controllers = _EXAMPLES / "tag" / "controllers"
    player = runpy.run_path(str(controllers / "player" / "player.py"))["Player"]
    referee_of = runpy.run_path(str(controllers / "referee" / "referee.py"))["Referee"]
    simulation = InProcessSimulation(_EXAMPLES / "tag" / "worlds" / "tag.wbt")
    robots: list[Any] = [InProcessRobot(name, world=simulation) for name in ("hunter", "runner")]
    robots.append(InProcessSupervisor("referee", world=simulation))
    bridges = [MCPBridge(robot, database=folder / "webots.db") for robot in robots]
    players = [
        player(robot, bridge, robot.getName())
        for robot, bridge in zip(robots[:2], bridges, strict=False)
    ]
    referee = referee_of(robots[2])
    step_ms = int(robots[0].getBasicTimeStep())
    while all(robot.step(step_ms) != -1 for robot in robots) and robots[0].getTime() < 20.0:
        for each, bridge in zip(players, bridges, strict=False):
            bridge.publish(each.sense())
            each.act()
        bridges[2].publish(referee.watch())
        if (round_s := referee.caught()) is not None:
            bridges[2].log(f"caught after {round_s:.1f} s")
    for bridge in bridges:
        bridge.close()
    sum_up_file(folder)


def draw_trials(folder: Path) -> None:
    """Eight runs of a set of trials, of which one fell over, each with its parameters."""
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        recorder = Recorder(connection)
        robot_id = recorder.robot("rover")
        session_id = recorder.session(robot_id, "a" * 64)
        plan = json.dumps({"score": "max(pose.x)", "best": "highest", "for_s": 10.0})
        values = [{"speed": speed, "gait": gait} for speed, gait, _ in _TRIED]
        set_id = create_trial_set(connection, plan, values, robot_id=robot_id)
        trials = trials_of(connection, set_id)
        for trial, (speed, gait, score) in zip(trials, _TRIED, strict=True):
            run_id = _try(recorder, session_id, robot_id, speed, gait, score)
            failed = None if score is not None else "ValueError: it fell over"
            finish_trial(connection, trial, TrialResult(run_id, score, failed, "for_s", 10.0))
        connection.execute("UPDATE session SET ended_wall_time_s = 2e9, end_reason = 'finished'")
        sum_up(connection)


def _try(
    recorder: Recorder, session_id: int, robot_id: int, speed: float, gait: str, score: float | None
) -> int:
    run_id = recorder.run(session_id, robot_id, "reset")
    for name, value in (("speed", speed), ("gait", gait)):
        recorder.insert(
            "parameter_value", **recorder.at(0.0), name=name, value=json.dumps(value),
            is_default=0, set_by="trials",
        )  # fmt: skip
    end_s = 10.0 if score is not None else 4.0
    farthest_m = score if score is not None else 1.5
    for step in range(round(end_s / 0.1)):
        time_s = step * 0.1
        x = farthest_m * time_s / (end_s - 0.1)
        mode = "fallen" if score is None and time_s > 3.5 else "run"
        recorder.publish(time_s, {"pose": {"x": x, "y": 0.1 * math.sin(time_s)}, "mode": mode})
    recorder.at(end_s)
    recorder.end_run("reset")
    return run_id


def draw_long(folder: Path) -> None:
    """10,000 rows of 39 signals, five minutes."""
    build_long(folder / "webots.db", 10_000)
    sum_up_file(folder)


def draw_purged(folder: Path) -> None:
    """Rounds of 17 minutes, of which retention leaves at most 500 rows: the newest row group."""
    record_rounds(folder / "webots.db")
    rows = Limit(rows=500, spared_rows=0)
    others = (Limit(), Limit(), Limit(), Limit())
    with closing(connect(folder / "webots.db", "writer")) as connection:
        prune(connection, folder, Retention(rows, *others, outlive=0), now_s=1.7e9, rest=False)


def sum_up(connection: sqlite3.Connection) -> None:
    for table in ("session", "run"):
        for (key,) in connection.execute(f"SELECT id FROM {table} WHERE uuid IS NULL").fetchall():
            connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
    while not make_chunks(connection, 100_000).done:
        pass


def sum_up_file(folder: Path) -> None:
    with closing(connect(folder / "webots.db", "writer")) as connection:
        sum_up(connection)


DRAWN: Final[dict[str, Callable[[Path], None]]] = {
    "story": draw_story,
    "rover": draw_rover,
    "e_puck": draw_e_puck,
    "tag": draw_tag,
    "trials": draw_trials,
    "long": draw_long,
    "purged": draw_purged,
}
"""By name, what fills a folder with a recording; the database in it is `webots.db`."""
