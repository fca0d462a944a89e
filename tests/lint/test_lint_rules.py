"""Each rule finds its fault in a small world, and is silent on the healthy counterpart."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.lint.worlds import (
    FLOOR,
    faults_of,
    lint,
    write_controller,
    write_proto,
    write_world,
)
from webots_mcp.lint import RULES, lint_world

BOX = "boundingObject Box { size 0.1 0.1 0.1 } physics Physics { density -1 mass %s }"


def hinge(
    *, child: str, axis: str = "0 1 0", device: str = "", parameters: str = "", joint: str = ""
) -> str:
    return (
        f"HingeJoint {{ {joint} jointParameters HingeJointParameters {{ axis {axis} {parameters} }}"
        f" device [ {device} ] endPoint Solid {{ {child} }} }}"
    )


def robot(*children: str, mass: str = "1", more: str = "") -> str:
    return (
        f'Robot {{ name "rover" controller "void" translation 0 0 1 children [ {" ".join(children)}'
        f" ] {BOX % mass} {more} }}"
    )


def wheel(*, axis: str = "0 1 0", anchor: str = "0 0 0", turn: str = "1 0 0 1.5708") -> str:
    return hinge(
        axis=axis,
        parameters=f"anchor {anchor}",
        device='RotationalMotor { name "left" }',
        child=f'rotation {turn} name "left wheel" '
        "boundingObject Cylinder { radius 0.05 height 0.02 } "
        "physics Physics { density -1 mass 0.1 }",
    )


MOTOR = 'RotationalMotor { name "arm" %s }'
ARM = 'name "arm" boundingObject Box { size 0.1 0.02 0.02 } physics Physics { density -1 mass 0.1 }'
LIDAR = (
    'Robot { name "rover" controller "void" children [ Lidar { numberOfLayers %s '
    "horizontalResolution 512 fieldOfView 3.14 verticalFieldOfView 0.2 } ] }"
)
CAMERA = 'Robot { name "rover" controller "void" children [ Camera { width %s height %s } ] }'
FREE = 'Solid { translation 0 0 %s name "box" %s }'

# rule, faulty, healthy, a word of the message
CASES = {
    "a number in quotes": (
        "file",
        'DirectionalLight {} WorldInfo { basicTimeStep "16" }',
        "DirectionalLight {} WorldInfo { basicTimeStep 16 }",
        'takes a number, not "16"',
    ),
    "a text without quotes": (
        "file", "Solid { name 5 }", 'Solid { name "5" }', "takes a text in quotes, not 5",
    ),
    "a node where numbers belong": (
        "file", "Solid { translation Box {} }", "Solid { translation 0 0 1 }", "not a Box node",
    ),
    "a field that is misspelt": (
        "file",
        "DirectionalLight {} WorldInfo { basicTimestep 16 }",
        "DirectionalLight {} WorldInfo { basicTimeStep 16 lineScale 0.1 FPS 60 }",
        "has no field basicTimestep; it has basicTimeStep",
    ),
    "a letter that is missing": (
        "file",
        robot(hinge(child=ARM, device=MOTOR % "maxVelocty 3 maxPosition 1 minPosition -1")),
        robot(hinge(child=ARM, device=MOTOR % "maxVelocity 3 maxPosition 1 minPosition -1")),
        "it has maxVelocity",
    ),
    "parameters of a second axis that a hinge does not have": (
        "file",
        robot(hinge(child=ARM, joint="jointParameters2 JointParameters {}")),
        robot(hinge(child=ARM)),
        "HingeJoint has no field jointParameters2",
    ),
    "an axis without a direction": (
        "file",
        robot(hinge(child=ARM, axis="0 0 0", device=MOTOR % "maxPosition 1 minPosition -1")),
        robot(hinge(child=ARM, axis="0 1 0", device=MOTOR % "maxPosition 1 minPosition -1")),
        "no direction",
    ),
    "neither mass nor density": (
        "inertia", FREE % (1, BOX % "-1"), FREE % (1, BOX % "1"), "none of them is positive",
    ),
    "mass ratio at a joint": (
        "mass ratio", robot(hinge(child=ARM, device=MOTOR % "maxPosition 1"), mass="200"),
        robot(hinge(child=ARM, device=MOTOR % "maxPosition 1"), mass="90"), "1:2,000",
    ),
    "mass ratio in contact": (
        "mass ratio",
        FREE % ("1", BOX % "50") + 'Solid { translation 0 0 1.1 name "lid" ' + BOX % "0.01" + " }",
        FREE % ("1", BOX % "50") + 'Solid { translation 0 0 1.3 name "lid" ' + BOX % "0.01" + " }",
        "in contact",
    ),
    "physics without a bounding object": (
        "bounding object", FREE % ("1", "physics Physics { density -1 mass 1 }"),
        FREE % ("1", BOX % "1"), "falls through",
    ),
    "a part without a bounding object": (
        "bounding object",
        robot(hinge(child='name "hand" physics Physics { density -1 mass 1 }')),
        robot(hinge(child='name "hand"')), "1 kg m²",
    ),
    "a chain of physics that is broken": (
        "physics", robot(hinge(child='name "a" children [ ' + hinge(child=ARM) + " ]")),
        robot(hinge(child=ARM.replace('name "arm"', 'name "a" children [ ' + hinge(child=ARM)
                                      + " ]"))), "chain",
    ),
    "a vehicle whose base is pinned": (
        "physics",
        'Robot { name "rover" controller "void" children [ ' + wheel() + wheel() + " ] }",
        robot(wheel(), wheel()), "turn in place",
    ),
    "a part that is fixed to the world": (
        "physics", 'Solid { name "table" children [ Solid { name "cup" ' + BOX % "1" + " } ] }",
        'Solid { name "table" children [ Solid { name "cup" } ] }', "does not move",
    ),
    "an inertia that is not positive": (
        "inertia", FREE % ("1", "boundingObject Box { } physics Physics { density -1 mass 1 "
                           "inertiaMatrix [ 1 1 1 0 0 1.5 ] }"),
        FREE % ("1", "boundingObject Box { } physics Physics { density -1 mass 1 "
                "inertiaMatrix [ 1 1 1 0 0 0.3 ] }"), "positive",
    ),
    "an inertia that breaks the triangle inequality": (
        "inertia", FREE % ("1", "boundingObject Box { } physics Physics { density -1 mass 1 "
                           "inertiaMatrix [ 1 1 3 0 0 0 ] }"),
        FREE % ("1", "boundingObject Box { } physics Physics { density -1 mass 1 "
                "inertiaMatrix [ 1 1 2 0 0 0 ] }"), "larger than the sum",
    ),
    "an inertia without a mass": (
        "inertia", FREE % ("1", "boundingObject Box { } physics Physics { "
                           "inertiaMatrix [ 1 1 1 0 0 0 ] }"),
        FREE % ("1", "boundingObject Box { } physics Physics { mass 1 "
                "inertiaMatrix [ 1 1 1 0 0 0 ] }"), "mass is not",
    ),
    "a box in the floor": (
        "overlap", FLOOR + FREE % ("-0.1", BOX % "1"), FLOOR + FREE % ("0.05", BOX % "1"), "150 mm",
    ),
    "two boxes in each other": (
        "overlap",
        FREE % ("1", BOX % "1") + 'Solid { translation 0.02 0 1 name "b" ' + BOX % "1" + " }",
        FREE % ("1", BOX % "1") + 'Solid { translation 0.12 0 1 name "b" ' + BOX % "1" + " }",
        "80 mm",
    ),
    "a wheel that turns about a diameter": (
        "wheel axis", robot(wheel(axis="1 0 0")), robot(wheel()), "90°",
    ),
    "a wheel beside its hinge": (
        "wheel axis", robot(wheel(anchor="0.1 0 0")), robot(wheel(anchor="0 0.3 0")), "100 mm",
    ),
    "a slider without an end": (
        "motor limits",
        robot("SliderJoint { device LinearMotor { } endPoint Solid { " + ARM + " } }"),
        robot("SliderJoint { device LinearMotor { maxPosition 1 } endPoint Solid { " + ARM + "} }"),
        "slide without",
    ),
    "an arm without limits": (
        "motor limits", robot(hinge(child=ARM, device=MOTOR % "")),
        robot(hinge(child=ARM, device=MOTOR % "minPosition -1 maxPosition 1")), "turn without",
    ),
    "limits beyond the stops": (
        "motor limits",
        robot(hinge(child=ARM, device=MOTOR % "minPosition -2 maxPosition 2",
                    parameters="minStop -1 maxStop 1")),
        robot(hinge(child=ARM, device=MOTOR % "minPosition -1 maxPosition 1",
                    parameters="minStop -1 maxStop 1")), "exceed the stops",
    ),
    "a start outside the limits": (
        "motor limits",
        robot(hinge(child=ARM, device=MOTOR % "minPosition 1 maxPosition 2")),
        robot(hinge(child=ARM, device=MOTOR % "minPosition 0 maxPosition 2")), "starts at 0",
    ),
    "a spring that the step does not resolve": (
        "time step", robot(hinge(child=ARM, parameters="springConstant 50")),
        robot(hinge(child=ARM, parameters="springConstant 0.05")), "2/omega",
    ),
    "a gain that the step does not resolve": (
        "time step", robot(hinge(child=ARM, device=MOTOR % "maxPosition 1 controlPID 100 0 0")),
        robot(hinge(child=ARM, device=MOTOR % "maxPosition 1 controlPID 30 0 0")), "oscillates",
    ),
    "a controller that does not exist": (
        "controller", 'Robot { name "rover" controller "drvie" }',
        'Robot { name "rover" controller "drive" }', "Set it to 'drive'",
    ),
    "siblings of one name": (
        "names", 'Solid { name "a" } Solid { name "a" }',
        'Solid { name "a" } Solid { name "b" children [ Solid { name "a" } ] }', "2 Solids",
    ),
    "devices of one name": (
        "names",
        robot("Group { children [ LED { } ] }", 'Pose { children [ Solid { children LED { } } ] }'),
        robot("LED { }", 'LED { name "b" }'), "getDevice",
    ),
    "a camera above real time": (
        "rendering load", CAMERA % (3840, 2160), CAMERA % (640, 480), "an estimated",
    ),
    "more layers than rows": ("lidar layers", LIDAR % 64, LIDAR % 16, "rows"),
    "a node that is not declared": (
        "undeclared PROTO", "Hologram { }", "Group { }", "EXTERNPROTO",
    ),
    "a step below the shortest": ("time step", "", FLOOR, "shortest"),
}  # fmt: skip
INFOS = {"a step below the shortest": ("basicTimeStep 0.5", "basicTimeStep 1")}


@pytest.mark.parametrize("release", ["R2023b", "R2025a"])
@pytest.mark.parametrize("case", CASES)
def test_a_rule_finds_its_fault_and_is_silent_on_the_healthy_world(
    tmp_path: Path, case: str, release: str
) -> None:
    rule, faulty, healthy, word = CASES[case]
    infos = INFOS.get(case, ("", ""))
    write_controller(tmp_path)
    found = faults_of(lint(tmp_path, faulty, info=infos[0], release=release), rule)
    assert any(word in f"{fault.what} {fault.fix}" for fault in found), found
    well = lint(tmp_path, healthy, info=infos[1], release=release)
    assert faults_of(well, rule) == []
    assert well.verdicts()[rule] == "not found"


def test_every_rule_has_a_case_or_a_test_of_its_own() -> None:
    own = {"file", "sampling period", "devices", "synchronization"}
    assert {rule for rule, *_ in CASES.values()} | own == set(RULES)


def test_a_fault_says_where_it_is_why_it_matters_and_what_to_set(tmp_path: Path) -> None:
    world = write_world(
        tmp_path, 'DEF BALL Solid {\n  physics Physics {\n    mass 1\n    inertiaMatrix [\n'
        "      1 1 9 0 0 0\n    ]\n  }\n}"
    )  # fmt: skip
    (fault,) = faults_of(lint_world(world), "inertia")
    assert (fault.path, fault.file, fault.line) == ("BALL.physics.inertiaMatrix", world, 7)
    assert fault.severity == "warning"
    assert fault.page == "https://cyberbotics.com/doc/reference/physics"
    assert "leave it out" in fault.fix
    assert "1, 1 and 9 kg m²" in fault.what


def test_a_fault_in_a_proto_names_its_file_and_line(tmp_path: Path) -> None:
    write_proto(
        tmp_path, "Ball",
        "#VRML_SIM R2023b utf8\nPROTO Ball [\n  field SFFloat heavy 1\n]\n{\n  Solid {\n"
        "    physics Physics {\n      mass IS heavy\n      inertiaMatrix [ 1 1 9, 0 0 0 ]\n"
        "    }\n  }\n}\n",
    )  # fmt: skip
    world = write_world(
        tmp_path, "DEF ONE Ball { heavy 2 }", declared='EXTERNPROTO "../protos/Ball.proto"'
    )
    (fault,) = faults_of(lint_world(world), "inertia")
    assert fault.file == tmp_path / "protos" / "Ball.proto"
    assert (fault.path, fault.line) == ("ONE.physics.inertiaMatrix", 9)


def test_a_field_that_its_proto_does_not_declare_is_reported_once_where_it_is_written(
    tmp_path: Path,
) -> None:
    write_proto(
        tmp_path, "Ball",
        "#VRML_SIM R2023b utf8\nPROTO Ball [\n  field SFFloat heavy 1\n"
        "  hiddenField SFFloat secret 1\n]\n{\n  Solid { }\n}\n",
    )  # fmt: skip
    world = write_world(
        tmp_path,
        "Ball {\n haevy 2\n secret 2\n}\nBall {\n colour 1 0 0\n}",
        declared='EXTERNPROTO "../protos/Ball.proto"',
    )
    misspelt, unknown = faults_of(lint_world(world), "file")
    assert "Ball.proto has no field haevy; it has heavy" in misspelt.what
    assert unknown.what.startswith("Ball.proto has no field colour:")
    assert misspelt.file == unknown.file == world
    lines = world.read_text("utf-8").splitlines()
    assert [lines[each.line - 1].split()[0] for each in (misspelt, unknown)] == ["haevy", "colour"]


@pytest.mark.parametrize(
    ("slip", "meant"),
    [
        ("Sphere { raduis 1 }", "radius"),
        ("Physics { mas 3 }", "mass"),
        ("Cylinder { heigth 1 }", "height"),
        ("Camera { widht 64 }", "width"),
        ("Robot { supervisr TRUE }", "supervisor"),
        ("Robot { synchronisation TRUE }", "synchronization"),
        ("Solid { boundingobject NULL }", "boundingObject"),
    ],
)
def test_one_slip_of_the_keyboard_in_a_field_is_reported(
    tmp_path: Path, slip: str, meant: str
) -> None:
    (fault,) = faults_of(lint(tmp_path, slip), "file")
    assert f"it has {meant}, which keeps its default" in fault.what
    assert fault.fix == f"Write {meant}."


@pytest.mark.parametrize(
    "legal",
    [
        "Capsule { side TRUE }",
        'Robot { controllerArgs [] customData "" battery [] window "" }',
        'WorldInfo { lineScale 1 FPS 60 info [] title "" }',
        "Solid { translationStep 1 rotationStep 1 locked TRUE }",
        "Camera { near 1 far 2 spherical TRUE }",
        "HingeJointParameters { dampingConstant 1 staticFriction 1 }",
    ],
)
def test_a_legal_field_that_no_rule_reads_is_no_slip(tmp_path: Path, legal: str) -> None:
    assert not faults_of(lint(tmp_path, legal), "file")


def test_faults_of_one_line_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    fields = ("controler", "supervisr", "selfColision", "boundingobject", "nam")
    text = "Robot { " + " ".join(f"{each} 1" for each in fields) + " }"
    found = [fault.path.rpartition(".")[2] for fault in faults_of(lint(tmp_path, text), "file")]
    assert found == [*fields]


def test_a_misspelt_field_beside_the_right_one_is_to_be_removed(tmp_path: Path) -> None:
    (fault,) = faults_of(lint(tmp_path, 'Robot { controller "void" controler "x" }'), "file")
    assert "it has controller, which is given too" in fault.what
    assert fault.fix == "Remove controler."


def test_a_line_of_a_proto_is_reported_once_for_all_its_instances(tmp_path: Path) -> None:
    text = "#VRML_SIM R2023b utf8\nPROTO Ball [ ]\n{\n  Solid { boundingobject NULL }\n}\n"
    write_proto(tmp_path, "Ball", text)
    declared = 'EXTERNPROTO "../protos/Ball.proto"'
    world = write_world(tmp_path, "Ball { } Ball { } Ball { }", declared=declared)
    assert len(faults_of(lint_world(world), "file")) == 1


def test_a_proto_that_is_declared_by_url_is_not_the_one_of_that_name_in_the_project(
    tmp_path: Path,
) -> None:
    write_proto(tmp_path, "Ball", "#VRML_SIM R2023b utf8\nPROTO Ball [ ]\n{\n  Solid { }\n}\n")
    declared = 'EXTERNPROTO "https://example.org/other/Ball.proto"'
    report = lint_world(write_world(tmp_path, "Ball { weight 3 }", declared=declared))
    assert not faults_of(report, "file")
    assert any("not on this machine" in each.reason for each in report.not_searched)


def test_a_heavy_body_that_sinks_into_soft_contacts_is_reported(tmp_path: Path) -> None:
    body = FREE % ("1", BOX % "100")
    soft = "contactProperties ContactProperties { softCFM 0.001 }"
    (fault,) = faults_of(lint(tmp_path, FLOOR + body, info=soft), "time step")
    assert "softCFM" in fault.fix  # 100 kg * 9.81 * 0.032 s * 0.001 / (4 * 0.2) = 39.2 mm
    assert "39.2 mm" in fault.what
    assert not faults_of(lint(tmp_path, FLOOR + body), "time step")


def test_before_2022_cylinders_stand_along_y(tmp_path: Path) -> None:
    old = wheel(turn="0 0 1 0")
    assert not faults_of(lint(tmp_path, robot(old), release="R2021b"), "wheel axis")
    assert faults_of(lint(tmp_path, robot(old)), "wheel axis")


def test_parts_of_one_robot_and_joined_bodies_may_overlap(tmp_path: Path) -> None:
    inside = hinge(child=ARM, device=MOTOR % "maxPosition 1")
    for more in ("", "selfCollision TRUE"):
        assert not faults_of(lint(tmp_path, robot(inside, more=more)), "overlap")


def test_a_proto_without_source_is_not_searched_and_never_passes(tmp_path: Path) -> None:
    url = "https://raw.githubusercontent.com/cyberbotics/webots/R2023b/projects/x/Rover.proto"
    world = write_world(tmp_path, "Rover { }", declared=f'EXTERNPROTO "{url}"')
    report = lint_world(world)
    verdicts = report.verdicts()
    assert report.faults == []
    for rule in ("mass ratio", "overlap", "wheel axis", "names", "devices", "rendering load"):
        assert verdicts[rule] == "not searched"
    assert any("not on this machine" in each.reason for each in report.not_searched)
    assert verdicts["undeclared PROTO"] == "not found"


def test_a_template_is_not_searched(tmp_path: Path) -> None:
    write_proto(
        tmp_path, "Ball",
        "#VRML_SIM R2023b utf8\n# template language: javascript\nPROTO Ball [ ]\n{\n"
        "  %< let a = 1; >%\n  Solid { }\n}\n",
    )  # fmt: skip
    world = write_world(tmp_path, "Ball { }", declared='EXTERNPROTO "../protos/Ball.proto"')
    report = lint_world(world)
    assert report.verdicts()["physics"] == "not searched"
    assert any("template" in each.reason for each in report.not_searched)


def test_a_proto_of_the_project_that_is_not_declared_gets_its_line(tmp_path: Path) -> None:
    write_proto(tmp_path, "Ball", "#VRML_SIM R2023b utf8\nPROTO Ball [ ]\n{\n  Solid { }\n}\n")
    (fault,) = faults_of(lint(tmp_path, "Ball { }"), "undeclared PROTO")
    assert fault.severity == "error"
    assert 'EXTERNPROTO "../protos/Ball.proto"' in fault.fix
    old = lint(tmp_path, "Ball { }", release="R2022a")
    assert not faults_of(old, "undeclared PROTO")
    assert old.verdicts()["undeclared PROTO"] == "not searched"
