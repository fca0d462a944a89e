"""Worlds as students write them are run as far as they go; what is missing is said."""

from __future__ import annotations

from pathlib import Path

import pytest
from controller import Node
from controller.surface import NotInStandInError

from tests.standin.placing import drive
from webots_mcp.standin import InProcessSimulation, InProcessSupervisor, Simulation, WorldError

WORLDS = Path(__file__).parent / "worlds"
FOREIGN = "foreign_robot_r2023b.wbt, line 10: the stand-in has no Pioneer3dx"


def robot_in(world: str, name: str | None = None) -> InProcessSupervisor:
    return InProcessSupervisor(name, world=WORLDS / world)


def test_an_e_puck_drives_among_boxes_and_walls() -> None:
    robot = robot_in("e_puck_r2023b.wbt")
    assert (robot.getName(), robot.getModel()) == ("e-puck", "GCtronic e-puck")
    gps, front = robot.getDevice("gps"), robot.getDevice("ps7")
    gps.enable(32)
    front.enable(32)
    drive(robot, 6.28, 6.28, 130)
    # It heads south, stops at the wall (0.5 m away, itself 0.037 m) and its GPS stands off-centre.
    assert gps.getValues()[1] == pytest.approx(-0.5 + 0.037 + 0.0095, abs=0.002)
    assert front.getValue() > 1000.0
    truth = robot.simulation.robot("e-puck")
    assert truth.collisions == 1
    assert truth.position[1] == pytest.approx(-0.5 + 0.037, abs=0.001)


def test_an_e_puck_has_the_devices_of_webots() -> None:
    robot = robot_in("e_puck_r2023b.wbt")
    names = {f"{kind}{number}" for kind in ("ps", "ls") for number in range(8)}
    names |= {f"led{number}" for number in range(10)} | {"camera", "accelerometer", "gyro"}
    names |= {
        "emitter",
        "receiver",
        "left wheel motor",
        "right wheel motor",
        "left wheel sensor",
        "right wheel sensor",
    }
    assert names | {"gps", "compass", "emitter", "receiver"} == set(robot.devices)
    with pytest.raises(NotInStandInError, match="so robot 'e-puck' has no 'speaker'"):
        robot.getDevice("speaker")
    node = InProcessSupervisor(world=WORLDS / "e_puck_r2023b.wbt").getFromDef("EPUCK")
    assert node is None  # it has no supervisor's rights


def test_each_type_that_is_left_out_is_warned_of_once() -> None:
    console = InProcessSimulation(WORLDS / "e_puck_r2023b.wbt").console
    assert console == [
        f"WARNING: e_puck_r2023b.wbt, line {line}: the stand-in has no {name} nodes; "
        "this one is left out."
        for line, name in [
            *((26, "TexturedBackground"), (28, "TexturedBackgroundLight"), (34, "Parquetry")),
            *((50, "Speaker"), (62, "E-puckGroundSensors")),
        ]
    ]


def test_loose_boxes_are_pushed_and_fixed_ones_not() -> None:
    text = (WORLDS / "e_puck_r2023b.wbt").read_text(encoding="utf-8")
    assert "supervisor" not in text
    robot = robot_in("e_puck_r2023b.wbt")
    arena = robot.simulation.simulator.arena
    movable = {body.name: body.is_movable for body in arena.bodies if "box" in body.name}
    assert movable == {"wooden box": False, "wooden box(1)": True}


def test_four_wheels_with_textures_and_meshes_drive() -> None:
    robot = robot_in("four_wheels_r2025a.wbt")
    drive(robot, 5.0, 5.0, 20, ["wheel1", "wheel2", "wheel3", "wheel4"])
    assert robot.simulation.robot("robot").position[0] == pytest.approx(0.04 * 5.0 * 0.032 * 20)
    with pytest.raises(
        NotInStandInError,
        match=r"no Display nodes, so robot 'robot' has no 'display'; see 'webots-mcp help standin'",
    ):
        robot.getDevice("display")
    assert robot.getDevice("nothing") is None


def test_a_youbot_drives_turns_and_moves_its_arm_and_fingers(tmp_path: Path) -> None:
    world = tmp_path / "youbot.wbt"
    world.write_text(
        "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 16 }\n"
        'Youbot { controller "<extern>" bodySlot [ GPS { } ] }',
        encoding="utf-8",
    )
    robot = InProcessSupervisor(world=world)
    finger, finger_sensor = (robot.getDevice(f"finger::left{end}") for end in ("", "sensor"))
    joint, angle = robot.getDevice("arm3"), robot.getDevice("arm3sensor")
    for sensor in (finger_sensor, angle):
        sensor.enable(16)
    assert (finger.getType(), joint.getType()) == (finger.LINEAR, joint.ROTATIONAL)
    finger.setVelocity(0.03)
    finger.setPosition(0.1)  # it ends at 0.025 m
    joint.setPosition(-2.0)
    wheels = [f"wheel{number}" for number in range(1, 5)]
    drive(robot, 4.0, 4.0, 125, wheels)

    assert finger_sensor.getValue() == pytest.approx(0.025)
    assert angle.getValue() == pytest.approx(-2.0)
    assert robot.simulation.robot("youBot").position[0] == pytest.approx(4.0 * 0.05 * 2.0)

    drive(robot, 4.0, -4.0, 20, wheels)
    assert robot.simulation.robot("youBot").yaw_rad > 0.1


def test_the_wall_of_a_circle_arena_is_round(tmp_path: Path) -> None:
    world = tmp_path / "circle.wbt"
    world.write_text(
        "#VRML_SIM R2025a utf8\nWorldInfo { }\nCircleArena { radius 0.5 }\n"
        'E-puck { controller "<extern>" turretSlot [ Lidar { fieldOfView 6.28 maxRange 2 } ] }',
        encoding="utf-8",
    )
    robot = InProcessSupervisor(world=world)
    lidar = robot.getDevice("lidar")
    lidar.enable(32)
    drive(robot, 0.0, 0.0, 1)
    ranges = lidar.getLayerRangeImage(0)  # its slot is 9.5 mm behind the middle
    assert min(ranges) == pytest.approx(0.5 - 0.0095, abs=0.002)
    assert max(ranges) == pytest.approx(0.5 + 0.0095, abs=0.002)
    drive(robot, 6.28, 6.28, 140)
    assert robot.simulation.robot("e-puck").position[0] == pytest.approx(0.5 - 0.037, abs=0.001)


def test_solids_inside_solids_are_obstacles() -> None:
    simulation = InProcessSimulation(WORLDS / "rooms_r2025a.wbt")
    arena = simulation.simulator.arena
    obstacles = {body.name: body for body in arena.bodies if body.is_obstacle}
    assert set(obstacles) == {"wall", "table"}
    leg, top = sorted(obstacles["table"].solid_shapes, key=lambda shape: shape.top_m)
    assert (leg.x, leg.y, leg.top_m) == pytest.approx((0.4, 0.8, 0.7))
    assert top.bottom_m == pytest.approx(0.675)
    (wall,) = obstacles["wall"].solid_shapes
    assert (wall.bottom_m, wall.top_m) == pytest.approx((0.0, 2.4))


def test_a_supervisor_sees_a_proto_node_with_its_own_fields() -> None:
    robot = robot_in("rooms_r2025a.wbt", "supervisor")
    children = robot.getRoot().getField("children")
    assert children is not None
    (wall,) = [
        node
        for i in range(children.getCount())
        if (node := children.getMFNode(i)) and node.getTypeName() == "Wall"
    ]
    assert (wall.getBaseTypeName(), wall.isProto()) == ("Solid", True)
    assert wall.getType() == Node.SOLID
    size = wall.getField("size")
    assert size is not None and size.getSFVec3f() == [0.2, 6.0, 2.4]
    assert wall.getField("boundingObject") is None
    place, table = wall.getField("translation"), robot.getFromDef("TABLE")
    assert place is not None and table is not None
    place.setSFVec3f([1.0, 0.0, 0.0])
    robot.step()
    assert wall.getPosition() == [1.0, 0.0, 0.0]
    assert not any("Wall" in line for line in robot.simulation.console)
    size.setSFVec3f([9.0, 9.0, 9.0])
    robot.step()
    assert "WARNING: Wall.size was set" in robot.simulation.console[-1]


def test_another_robot_of_a_world_is_an_error_only_where_it_is_asked_for(tmp_path: Path) -> None:
    world = WORLDS / "rooms_r2025a.wbt"
    simulation = InProcessSimulation(world)
    assert "line 68: the stand-in has no Nao nodes" in "\n".join(simulation.console)
    with pytest.raises(WorldError, match=r"line 68: the stand-in has no Nao nodes.*Convert Root"):
        InProcessSupervisor("nao", world=simulation)
    with pytest.raises(WorldError, match=r"line 68: .* no Nao nodes"):
        Simulation(world, controllers={"nobody": tmp_path / "x.py"})


def test_a_world_whose_only_robot_is_unknown_is_refused_with_what_to_do(
    tmp_path: Path,
) -> None:
    with pytest.raises(WorldError, match=r"no robot 'puck' in e_puck_\w+\.wbt; it has 'e-puck'"):
        Simulation(WORLDS / "e_puck_r2023b.wbt", controllers={"puck": tmp_path / "x.py"})
    with pytest.raises(WorldError) as caught:
        Simulation(WORLDS / "foreign_robot_r2023b.wbt")
    assert str(caught.value).partition(" nodes")[0] == FOREIGN
    assert "choose 'Convert Root to Base Node(s)' and save the world" in str(caught.value)
    world = tmp_path / "own.wbt"
    world.write_text(
        '#VRML_SIM R2025a utf8\nWorldInfo { }\nOven { }\nNao { supervisor FALSE controller "x" }'
    )
    with pytest.raises(WorldError, match="line 4: the stand-in has no Nao nodes"):
        InProcessSimulation(world)
