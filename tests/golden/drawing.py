"""The recordings of which every question is asked, each made by a program, the same each time.

What was recorded by the real bridge has the clock of the machine in it; what was written row by
row has a clock of its own, whose times are part of the answers.
"""

from __future__ import annotations

import json
import math
import runpy
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple

from tests.recordings import bridge as rover_on_the_stand_in
from tests.recordings.long import build as build_long
from tests.recordings.rounds import record_rounds
from tests.recordings.rover import Recorder, record_rover
from webots_mcp import MCPBridge
from webots_mcp.contract import new_uuid
from webots_mcp.database.connection import connect, create_schema
from webots_mcp.standin import InProcessRobot, InProcessSupervisor
from webots_mcp.standin.in_process import InProcessSimulation
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.parameters import TrialResult, create_trial_set, finish_trial, trials_of
from webots_mcp.store.purge import prune
from webots_mcp.store.retention import Limit, Retention

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


class Kind(NamedTuple):
    """One recording.

    Attributes:
        draw: Fills a folder; the database in it is `webots.db`.
        clock: Whether wall times are drawn too, and the same each time.
        part: Start and end of a stretch to ask about, simulated seconds.
        robot: Whose.
        run_id: The run to ask about; None for the newest of the robot.
        x: The signal of its position to ask a condition of.
    """

    draw: Callable[[Path], None]
    clock: bool
    part: tuple[float, float]
    robot: str = "rover"
    x: str = "pose.x"
    run_id: int | None = None


def draw_story(folder: Path) -> None:
    """Three runs of a rover, second by second as `tests.recordings.rover` tells."""
    with closing(connect(folder / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)
        record_rover(connection)
        _sum_up(connection)


def draw_rover(folder: Path) -> None:
    """What the bridge records of the demo's rover, with commands, pictures and a reset."""
    rover_on_the_stand_in.record(folder)
    with closing(connect(folder / "webots.db", "writer")) as connection:
        connection.execute(_COMMANDS_TOOK)
        _sum_up(connection)


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
    _sum_up_file(folder)


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
    _sum_up_file(folder)


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
        _sum_up(connection)


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
    _sum_up_file(folder)


def draw_purged(folder: Path) -> None:
    """Rounds of 17 minutes, of which only the newest 500 rows are kept."""
    record_rounds(folder / "webots.db")
    rows = Limit(rows=500, spared_rows=0)
    others = (Limit(), Limit(), Limit(), Limit())
    with closing(connect(folder / "webots.db", "writer")) as connection:
        prune(connection, folder, Retention(rows, *others, outlive=0), now_s=1.7e9, rest=False)


def draw_hostile(folder: Path) -> None:
    """Values and names that a bridge has to bear: what is not in JSON, what changes its kind."""
    robot = InProcessSupervisor("rover")
    bridge = MCPBridge(robot, throttle_interval=1, database=folder / "webots.db")
    for step in range(400):
        robot.step(16)
        bridge.publish(_hostile_state(step))
        if step % 100 == 0:
            bridge.log(
                "a line\nwith \x1b[31mcolour\x1b[0m, \u202etext backwards and \x00", "warning"
            )
    bridge.close()
    _sum_up_file(folder)


def _hostile_state(step: int) -> dict[str, Any]:
    return {
        "pose": {"x": step * 0.01, "y": 0.0},
        "front": (math.nan, math.inf, -math.inf, 1.5)[step // 100],
        "large": 10 ** (step % 400),
        "beyond": 2**63 + step,
        "kind": (1, "one", True, None)[step // 50 % 4],
        "mode": "a\u202eb" if step < 200 else "\U0001f916" * 3,
        "text": "x" * (step * 10),
        "a.b": {"c.d": step, "": step % 2 == 0, "wheels.left.is": 1.0},
        "list": [step, None, [math.nan, 0, 0]],
        "bytes": b"\xff\x00",
        "tiny": 5e-324,
        "minus_zero": -0.0,
        **({"rare": 1.0} if step % 97 == 0 else {}),
    }


def draw_kept(folder: Path) -> None:
    """One call in ten recorded, and two stretches of which each call is a row."""
    robot = InProcessSupervisor("rover")
    bridge = MCPBridge(robot, throttle_interval=10, database=folder / "webots.db")
    for step in range(1500):
        robot.step(16)
        spike = 5.0 if step in (403, 904) else 0.0
        mode = "turn" if 400 <= step < 407 else "cruise"
        bridge.publish({"pose": {"x": step * 0.002, "y": 0.0}, "ir": spike, "mode": mode})
        if step in (410, 910):
            bridge.keep(f"the spike at step {step}")
    bridge.close()
    _sum_up_file(folder)


def _sum_up(connection: sqlite3.Connection) -> None:
    for table in ("session", "run"):
        for (key,) in connection.execute(f"SELECT id FROM {table} WHERE uuid IS NULL").fetchall():
            connection.execute(f"UPDATE {table} SET uuid = ? WHERE id = ?", (new_uuid(), key))
    while not make_chunks(connection, 100_000).done:
        pass


def _sum_up_file(folder: Path) -> None:
    with closing(connect(folder / "webots.db", "writer")) as connection:
        _sum_up(connection)


KINDS: Final[dict[str, Kind]] = {
    "story": Kind(draw_story, clock=True, part=(45.0, 65.0), x="pose.0", run_id=1),
    "rover": Kind(draw_rover, clock=False, part=(5.0, 9.0), x="pose.0", run_id=1),
    "e_puck": Kind(draw_e_puck, clock=False, part=(5.0, 15.0), robot="e-puck", x="odom.x_m"),
    "tag": Kind(draw_tag, clock=False, part=(5.0, 15.0), robot="hunter"),
    "trials": Kind(draw_trials, clock=False, part=(2.0, 6.0)),
    "long": Kind(draw_long, clock=True, part=(150.0, 175.0), x="pose.0"),
    "purged": Kind(draw_purged, clock=True, part=(480.0, 720.0), x="pose.0"),
    "hostile": Kind(draw_hostile, clock=False, part=(1.0, 4.0)),
    "kept": Kind(draw_kept, clock=False, part=(6.0, 8.0)),
}
