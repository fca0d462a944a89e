"""An observer records how each body is tilted and how high it is, and that it fell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing

import pytest

from tests.judging.asking import ask as ask_events
from tests.simulator.observer.conftest import Watching
from webots_mcp.database.connection import connect
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.simulator.observed_bodies import BodyPose, pose_of
from webots_mcp.store.meanings import meanings_of
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.segment import Subject

Vector = tuple[float, float, float]
ALONG, UP_Z, UP_Y = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def rotation(axis: Vector, angle: float) -> list[list[float]]:
    """The matrix that turns by an angle around a unit vector."""
    x, y, z = axis
    c, s, t = math.cos(angle), math.sin(angle), 1 - math.cos(angle)
    return [
        [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
        [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
        [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
    ]


def times(a: list[list[float]], b: list[list[float]]) -> list[list[float]]:
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def pose(turned: list[list[float]], place: Sequence[float], up_axis: int) -> BodyPose:
    rows = [[*row, at] for row, at in zip(turned, place, strict=True)] + [[0.0, 0.0, 0.0, 1.0]]
    return pose_of([value for row in rows for value in row], 0.0, up_axis)


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("roll", [0.0, 0.4, -2.9])
@pytest.mark.parametrize("pitch", [0.0, -0.3, 1.2])
def test_roll_pitch_and_heading_are_those_that_turned_it(
    heading: float, roll: float, pitch: float
) -> None:
    enu = times(
        times(rotation(UP_Z, heading), rotation((0.0, 1.0, 0.0), pitch)), rotation(ALONG, roll)
    )
    found = pose(enu, (1.0, 2.0, 3.0), 2)
    assert found[4:7] == pytest.approx((heading, roll, pitch))
    assert found.height_m == 3.0
    # In a world whose y axis is up, the left of its x axis is -z.
    nue = times(
        times(rotation(UP_Y, heading), rotation((0.0, 0.0, -1.0), pitch)), rotation(ALONG, roll)
    )
    found = pose(nue, (1.0, 2.0, 3.0), 1)
    assert found[4:7] == pytest.approx((heading, roll, pitch))
    assert found.height_m == 2.0


def test_each_body_has_attitude_and_height_and_they_say_what_they_mean(watching: Watching) -> None:
    watching.go_on(20)
    rider = watching.newest()["world"]["RIDER"]
    assert (rider["roll_rad"], rider["pitch_rad"], rider["height_m"]) == (0.0, 0.0, 0.2)
    with closing(connect(watching.database, "reader")) as connection:
        found = meanings_of(catalogue(connection, Subject(1, "mcp_observer", 1)))
    said = {name: found[f"world.RIDER.{name}"] for name in rider}
    assert {name: (each.quantity, each.unit) for name, each in said.items()} == {
        "x_m": ("x", "m"), "y_m": ("y", "m"), "z_m": ("height", "m"), "height_m": ("height", "m"),
        "heading_rad": ("heading", "rad"), "roll_rad": ("roll", "rad"),
        "pitch_rad": ("pitch", "rad"), "speed_mps": ("speed", "m/s"),
    }  # fmt: skip
    assert {(each.role, each.source, each.why) for each in said.values()} == {
        ("measured", "device", "pose of the body by the supervisor 'mcp_observer'")
    }


def tip_over(watching: Watching, monkeypatch: pytest.MonkeyPatch, starts_rad: float) -> None:
    """ROVER stands as it starts, tips over to its side at 4 s and stays down."""
    while "ROVER" not in watching.observer.world.bodies and watching.robot.getTime() < 3.0:
        watching.go_on()  # a busy machine finds it later
    node = watching.observer.world.bodies["ROVER"].scene.node
    plain = node.getPose()

    def tipped() -> list[float]:
        over = min(max(watching.robot.getTime() - 4.0, 0.0) / 0.5, 1.0) * math.pi / 2
        turned = rotation(ALONG, starts_rad + over)
        rows = [[*row, plain[4 * i + 3]] for i, row in enumerate(turned)]
        return [value for row in (*rows, [0.0, 0.0, 0.0, 1.0]) for value in row]

    monkeypatch.setattr(node, "getPose", tipped)


@pytest.mark.parametrize("starts", [0.0, math.pi / 2, -1.2, math.pi])
def test_a_robot_that_falls_is_named_however_it_was_turned_at_the_start(
    watching: Watching, monkeypatch: pytest.MonkeyPatch, starts: float
) -> None:
    watching.robot.simulationSetMode(watching.robot.SIMULATION_MODE_FAST)
    watching.go_on()
    tip_over(watching, monkeypatch, starts)
    while watching.robot.getTime() < 8.0:
        watching.go_on()
    with closing(connect(watching.database, "reader")) as connection:
        (fall,) = ask_events(connection, "fall").events
        checked = check_run(connection, 1)
    assert (fall.name, fall.details["got_up"]) == ("world.ROVER", False)
    assert fall.details["tilt_deg"] == pytest.approx(90.0, abs=0.1)
    assert fall.start_s == pytest.approx(4.0 + 0.5 / 3, abs=0.05)
    (upright,) = [each for each in checked.findings if each.name == "stays upright"]
    assert upright.outcome == "fail"
    assert "world.ROVER fell" in upright.evidence
