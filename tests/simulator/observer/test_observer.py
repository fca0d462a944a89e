"""An observer records where all robots are, and what there is, without their help."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.simulator.observer.conftest import OBSERVER, STEP_MS, Watching
from webots_mcp import MemoryDatabase
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.simulator.observer import Observer
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.standin.in_process import DEFAULT_WORLD


def test_all_robots_are_recorded_by_their_def_or_their_name(watching: Watching) -> None:
    watching.go_on(20)
    seen = watching.newest()["world"]
    assert set(seen) == {"ROVER", "RIDER", "_2nd_robot", "e_puck", "turret", "REFEREE"}
    rover = seen["ROVER"]
    assert (rover["x_m"], rover["y_m"], rover["heading_rad"]) == (1.0, 2.0, 0.5)
    assert (rover["speed_mps"], seen["RIDER"]["z_m"]) == (0.0, 0.2)


def test_what_there_is_is_told_once_as_an_event(watching: Watching) -> None:
    watching.go_on(30)
    (world,) = watching.worlds()
    assert (world["title"], world["basic_time_step_ms"]) == ("A crowd", 16.0)
    assert world["file"].endswith("crowd.wbt")
    robots = {robot["key"]: robot for robot in world["robots"]}
    assert robots["e_puck"] == {
        "key": "e_puck", "type": "E-puck", "name": "e-puck", "controller": "<none>"
    }  # fmt: skip
    assert (robots["RIDER"]["on_robot"], robots["turret"]["on_robot"]) == ("rover", "e-puck")
    solids = {solid["key"]: solid for solid in world["solids"]}
    assert set(solids) == {"FLOOR", "CRATE", "PILLAR"}
    assert (solids["PILLAR"]["x_m"], solids["PILLAR"]["y_m"]) == (3.0, 3.0)


def test_a_solid_is_recorded_from_when_it_moves(watching: Watching) -> None:
    watching.go_on(20)
    assert "solid" not in watching.newest()
    crate = watching.robot.getFromDef("CRATE")
    assert crate is not None
    crate.setVelocity([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    watching.go_on(4)
    seen = watching.newest()["solid"]
    assert seen["CRATE"]["x_m"] > 0.01
    assert seen["CRATE"]["speed_mps"] > 0.1
    assert "PILLAR" not in seen


def test_a_robot_that_moves_is_noticed_although_no_time_passes(watching: Watching) -> None:
    watching.go_on(20)
    world = watching.observer.world
    assert not world.moves()  # nothing to compare with
    assert not world.moves()
    rider = watching.robot.getFromDef("RIDER")
    assert rider is not None
    place = rider.getField("translation")
    assert place is not None
    place.setSFVec3f([3.0, 3.0, 0.0])
    assert watching.robot.step(0) != -1
    assert world.moves()
    assert not world.moves()


def test_a_row_costs_no_request(watching: Watching, monkeypatch: pytest.MonkeyPatch) -> None:
    watching.go_on(20)
    requests: list[Any] = []
    session: Any = watching.robot._session  # pyright: ignore[reportPrivateUsage]
    real = session._ask

    def ask(*of: Any) -> Any:
        requests.append(of[0])
        return real(*of)

    monkeypatch.setattr(session, "_ask", ask)
    before = len(watching.rows("SELECT id FROM state"))
    watching.go_on(10)
    assert len(watching.rows("SELECT id FROM state")) == before + 10
    assert [request for request in requests if request != "node_get_field"] == []


def test_a_reset_begins_a_run_without_a_leap(watching: Watching) -> None:
    watching.go_on(20)
    crate = watching.robot.getFromDef("CRATE")
    assert crate is not None
    crate.setVelocity([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    watching.go_on(10)
    watching.robot.simulationReset()
    watching.go_on(10)
    assert [reason for (reason,) in watching.rows("SELECT start_reason FROM run")] == [
        "start",
        "reset",
    ]
    assert "solid" not in watching.newest()
    assert len(watching.worlds()) == 2


def test_a_node_that_is_gone_is_told_no_more(
    watching: Watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    watching.go_on(20)
    rider = watching.observer.world.bodies["RIDER"].scene.node
    monkeypatch.setattr(rider, "getId", lambda: -1)  # as of a node that Webots has removed
    watching.go_on()
    assert "RIDER" not in watching.newest()["world"]
    watching.go_on(20)  # here it is still there, and so found again, by the same name
    assert "RIDER" in watching.newest()["world"]


def test_what_is_added_is_found_at_once_and_what_is_removed_is_followed_no_more(
    watching: Watching, capfd: pytest.CaptureFixture[str]
) -> None:
    watching.go_on(20)
    top = watching.robot.getRoot().getField("children")
    assert top is not None
    ball = 'DEF BALL Solid { translation 0 -1 0.1 name "ball" physics Physics { } '
    ball += "boundingObject Sphere { radius 0.1 } }"
    top.importMFNodeFromString(-1, ball)
    watching.go_on(5)
    assert "BALL" in {solid["key"] for solid in watching.worlds()[-1]["solids"]}
    node = watching.robot.getFromDef("BALL")
    assert node is not None
    node.setVelocity([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    watching.go_on(5)
    assert watching.newest()["solid"]["BALL"]["speed_mps"] > 0.1
    node.remove()
    watching.go_on(5)
    assert "solid" not in watching.newest()
    assert "BALL" not in {solid["key"] for solid in watching.worlds()[-1]["solids"]}
    assert len(watching.worlds()) == 3
    assert capfd.readouterr().err == ""


def test_what_is_removed_and_put_back_keeps_its_name_in_signals(watching: Watching) -> None:
    watching.go_on(20)
    top = watching.robot.getRoot().getField("children")
    assert top is not None
    for _ in range(2):
        top.importMFNodeFromString(-1, 'DEF BARREL Solid { name "barrel" }')
        watching.go_on(5)
        assert "BARREL" in watching.observer.world.bodies
        barrel = watching.robot.getFromDef("BARREL")
        assert barrel is not None
        barrel.remove()
        watching.go_on(5)
    assert "BARREL" not in watching.observer.world.bodies


def test_where_tracked_poses_do_not_come_they_are_asked_for(
    watching: Watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    watching.go_on(20)
    session: Any = watching.robot._session  # pyright: ignore[reportPrivateUsage]
    stale = dict(session._values)
    monkeypatch.setattr(session, "tracked", stale.get)
    crate = watching.robot.getFromDef("CRATE")
    assert crate is not None
    for _ in range(3):
        crate.setVelocity([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        watching.observer.world.begin_run()
        watching.go_on(10)
    monkeypatch.undo()
    watching.go_on(5)
    assert watching.newest()["solid"]["CRATE"]["x_m"] > 0.01
    logs = watching.rows("SELECT message FROM log WHERE level = 'warning'")
    assert [text for (text,) in logs] == [
        "Webots does not send the poses that are tracked: each is asked for from now on"
    ]


def test_a_robot_without_rights_is_refused_with_what_to_do(
    tmp_path: Path, database: MemoryDatabase
) -> None:
    world = tmp_path / "plain.wbt"
    world.write_text(
        DEFAULT_WORLD.read_text("utf-8") + OBSERVER.replace("supervisor TRUE", ""), "utf-8"
    )
    robot = InProcessSupervisor("mcp_observer", world=world)
    with pytest.raises(CommandRefusedError, match="supervisor TRUE"):
        Observer(robot, database=database)


def test_it_looks_at_one_body_on_request(watching: Watching) -> None:
    watching.go_on(20)
    look_at = watching.observer.look_at
    told = look_at({"params": {"of": "rover"}})
    assert (told["key"], told["position_m"]) == ("ROVER", [1.0, 2.0, 0.0])
    assert "contact points" in told["not_told"]
    with pytest.raises(InvalidInputError, match=r"one of .*ROVER"):
        look_at({"params": {"of": "nobody"}})


class Touching:
    """What Webots tells of a Solid that touches the floor."""

    def __init__(self, node: Any) -> None:
        self.getVelocity, self.getPosition = node.getVelocity, node.getPosition

    def getContactPoints(self, _: bool) -> list[Touching]:
        return [self]

    def getPoint(self) -> list[float]:
        return [0.1, 0.2, 0.0]

    def getNodeId(self) -> int:
        return 3

    def getCenterOfMass(self) -> list[float]:
        return [0.1, 0.2, 0.05]

    def getStaticBalance(self) -> bool:
        return True


def test_contact_points_and_balance_are_told_where_webots_tells_them(
    watching: Watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    watching.go_on(20)

    def find_floor(_: int) -> Any:
        return floor

    crate, floor = watching.observer.world.bodies["CRATE"], watching.robot.getFromDef("FLOOR")
    crate.scene = crate.scene._replace(node=Touching(crate.scene.node))
    monkeypatch.setattr(watching.robot, "getFromId", find_floor)
    told = watching.observer.look_at({"params": {"of": "CRATE"}})
    assert told["contacts"] == [[0.1, 0.2, 0.0, "FLOOR"]]
    assert "No event or check judges contacts" in told["contacts_note"]
    assert (told["center_of_mass_m"], told["is_balanced"]) == ([0.1, 0.2, 0.05], True)


def test_the_world_does_not_wait_for_it(watching: Watching) -> None:
    watching.simulation.resume()
    watching.robot.step(0)  # which hears of it
    other = InProcessSupervisor("referee", world=watching.simulation)
    watching.go_on(20)
    assert other.getTime() == 0.0 == watching.simulation.time_s
    for _ in range(10):
        assert other.step(STEP_MS) == 0
        watching.go_on()
    times = [time for (time,) in watching.rows("SELECT sim_time_s FROM state ORDER BY id")]
    assert times[-1] == pytest.approx(10 * STEP_MS / 1000)
