"""Real processes: controllers that do not know the package, and an observer in their world."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from webots_mcp.setup.observer_edits import CONTROLLER, with_observer
from webots_mcp.standin import Simulation

pytestmark = pytest.mark.slow

WORLD = "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 16 }\n" + "".join(
    f'Robot {{ name "{name}" controller "{name}" supervisor TRUE translation {at} 0 0 }}\n'
    for at, name in enumerate(("plain", "bridged", "late", "large"))
)
WRITES = """
import json
from controller import Supervisor

robot, seq = Supervisor(), 0
while robot.step(16) != -1:
    seq += 1
    robot.setCustomData(json.dumps({"seq": seq, "at_s": robot.getTime(), "mode": "drive"}))
"""
ATTACH = "    from webots_mcp import MCPBridge; MCPBridge.attach(robot)\n"
CONTROLLERS = {
    "plain": WRITES + "    if robot.getTime() > 1 and seq < 70: robot.simulationReset()\n",
    "bridged": WRITES.replace("while", "if True:\n" + ATTACH + "while"),
    "late": WRITES + "    if seq == 100:\n    " + ATTACH,
    "large": WRITES.replace("json.dumps(", "seq % 10 * 'garbage' or '\\x01' * 60_000 or ("),
}


class Project:
    """A world that runs, and what is recorded of it."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "mcp_data" / "webots.db"
        for name, source in (CONTROLLERS | {"mcp_observer": CONTROLLER.decode()}).items():
            controller = folder / "controllers" / name / f"{name}.py"
            controller.parent.mkdir(parents=True)
            controller.write_text(source, "utf-8")
        self.world = folder / "worlds" / "w.wbt"
        self.world.parent.mkdir()
        self.world.write_bytes(with_observer(WORLD.encode()))

    def rows(self, sql: str) -> list[Any]:
        if not self.file.exists():
            return []
        with closing(sqlite3.connect(self.file)) as connection:
            try:
                return connection.execute(sql).fetchall()
            except sqlite3.OperationalError:  # it is being made
                return []

    def sessions(self) -> dict[str, list[tuple[bool, str | None]]]:
        """By robot: whether a bridge recorded, and how it ended."""
        found: dict[str, list[tuple[bool, str | None]]] = {}
        for name, *rest in self.rows(
            "SELECT r.name, s.versions LIKE '%python%', s.end_reason FROM session s "
            "JOIN robot r ON r.id = s.robot_id ORDER BY s.id"
        ):
            found.setdefault(name, []).append((bool(rest[0]), rest[1]))
        return found

    def states(self, robot: str) -> list[tuple[int, float, dict[str, Any]]]:
        rows = self.rows(
            "SELECT s.run_id, s.sim_time_s, s.data FROM state s JOIN run ON run.id = s.run_id "
            f"JOIN robot r ON r.id = run.robot_id WHERE r.name = '{robot}' ORDER BY s.id"
        )
        return [(run_id, time_s, json.loads(data)) for run_id, time_s, data in rows]


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    yield Project(tmp_path)


def test_each_robot_is_recorded_once_by_its_bridge_or_by_the_observer(project: Project) -> None:
    with Simulation(project.world) as simulation:

        def until(is_so: Callable[[], object]) -> None:
            simulation.wait_for(lambda: bool(is_so()), 60)

        until(lambda: len({run for run, _, _ in project.states("plain")}) > 1)
        until(lambda: (True, None) in project.sessions().get("late", ()))
        until(lambda: project.sessions()["late"][0] == (False, "superseded"))
        until(lambda: len(project.states("large")) > 3)
        simulation.quit()
    assert [line for line in simulation.console if "rror" in line] == []
    sessions = project.sessions()
    assert sessions["plain"] == [(False, "finished")]
    assert sessions["bridged"] == [(True, "finished")]
    assert sessions["late"] == [(False, "superseded"), (True, "finished")]
    first, *_, last = project.states("plain")
    assert (first[2]["mode"], first[2]["x_m"]) == ("drive", 0.0)
    assert last[0] > first[0]
    reasons = project.rows(
        "SELECT start_reason FROM run JOIN robot r ON r.id = run.robot_id WHERE r.name = 'plain'"
    )
    assert [reason for (reason,) in reasons] == ["start", "reset"]
    late = [
        time_s - state["at_s"] for _, time_s, state in project.states("plain") if "at_s" in state
    ]
    assert min(late) >= 0.0
    assert all("front" not in state for _, _, state in project.states("bridged"))
