"""Files that are huge, deep, broken or endless end in a report, and in time."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from tests.lint.worlds import faults_of, write_proto, write_world
from webots_mcp.lint import lint_world, scene

HEAD = "#VRML_SIM R2023b utf8\n"
PROCESSOR_S = 40.0  # a limit for a hang, not a measurement

BROKEN = {
    "empty": "",
    "no header": "Solid { }",
    "binary": "\x00\x01\x02",
    "open brace": HEAD + "Solid {",
    "open string": HEAD + 'Solid { name "a }',
    "close first": HEAD + "} Solid {",
    "use before def": HEAD + "USE NOTHING",
    "a value too few": HEAD + "Solid { name }",
    "brackets": HEAD + "Solid { children [ [ [ ] ] }",
    "deep nodes": HEAD + "Group { children " * 5_000,
    "deep lists": HEAD + "Solid { children " + "[ " * 50_000,
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_an_error_and_nothing_else_passes(tmp_path: Path, case: str) -> None:
    world = tmp_path / "w.wbt"
    world.write_text(BROKEN[case], "utf-8")
    report = lint_world(world)
    (fault,) = report.faults
    assert (fault.rule, fault.severity) == ("file", "error")
    verdicts = report.verdicts()
    assert {verdict for rule, verdict in verdicts.items() if rule != "file"} == {"not searched"}


@pytest.mark.parametrize("name", ["w.wbt", "../w.txt", "folder.wbt"])
def test_a_missing_file_a_folder_and_another_file_are_errors(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.wbt").mkdir()
    assert [fault.rule for fault in lint_world(tmp_path / name).faults] == ["file"]


def test_text_that_is_not_utf_8_is_an_error(tmp_path: Path) -> None:
    world = tmp_path / "w.wbt"
    world.write_bytes(HEAD.encode() + b"\xff\xfe\xff")
    assert "UTF-8" in lint_world(world).faults[0].what


PROTOS = {
    "itself as its base": "PROTO A [ ]\n{\n  A { }\n}\n",
    "itself as a child": "PROTO A [ ]\n{\n  Group { children [ A { } ] }\n}\n",
    "itself twice": "PROTO A [ ]\n{\n  Group { children [ A { } A { } ] }\n}\n",
    "an unknown field": "PROTO A [ ]\n{\n  Group { children IS nothing }\n}\n",
    "two nodes": "PROTO A [ ]\n{\n  Group { }\n  Group { }\n}\n",
    "no body": "PROTO A [ ]\n",
    "deep": "PROTO A [ field SFNode a " + "Group { children " * 5_000,
}


@pytest.mark.parametrize("case", PROTOS)
def test_a_proto_without_an_end_is_not_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    monkeypatch.setattr(scene, "LIMITS", replace(scene.LIMITS, nodes=2_000))
    write_proto(tmp_path, "A", HEAD + 'EXTERNPROTO "A.proto"\n' + PROTOS[case])
    world = write_world(tmp_path, "A { }", declared='EXTERNPROTO "../protos/A.proto"')
    began = time.thread_time()
    report = lint_world(world)
    assert time.thread_time() - began < PROCESSOR_S
    assert report.faults == []
    assert report.verdicts()["overlap"] == "not searched"


def test_two_protos_that_hold_each_other_are_not_searched(tmp_path: Path) -> None:
    for name, other in ("AB", "BA"):
        body = f'EXTERNPROTO "{other}.proto"\nPROTO {name} [ ]\n{{\n  {other} {{ }}\n}}\n'
        write_proto(tmp_path, name, HEAD + body)
    world = write_world(tmp_path, "A { }", declared='EXTERNPROTO "../protos/A.proto"')
    assert lint_world(world).verdicts()["physics"] == "not searched"


@pytest.mark.slow
def test_a_use_of_a_use_does_not_grow_without_an_end(tmp_path: Path) -> None:
    lines = ["DEF G0 Group { }"]
    lines += [f"DEF G{i} Group {{ children [ USE G{i - 1} USE G{i - 1} ] }}" for i in range(1, 60)]
    began = time.thread_time()
    report = lint_world(write_world(tmp_path, "\n".join(lines)))
    assert time.thread_time() - began < PROCESSOR_S
    assert report.verdicts()["names"] == "not searched"


def test_time_that_is_over_is_said(tmp_path: Path) -> None:
    solids = "\n".join(
        f'Solid {{ name "s{i}" boundingObject Box {{ }} physics Physics {{ }} }}'
        for i in range(600)
    )
    report = lint_world(write_world(tmp_path, solids), processor_s=0.0)
    assert report.verdicts()["overlap"] == "not searched"
    assert any("not finished" in each.reason for each in report.not_searched)


@pytest.mark.slow
def test_a_crowd_in_one_place_ends(tmp_path: Path) -> None:
    solids = "\n".join(
        f'Solid {{ name "s{i}" boundingObject Box {{ }} physics Physics {{ }} }}'
        for i in range(400)
    )
    began = time.thread_time()
    report = lint_world(write_world(tmp_path, solids), processor_s=1.0)
    assert time.thread_time() - began < 10 * 1.0  # each look at the clock comes soon
    assert faults_of(report, "overlap") or report.verdicts()["overlap"] == "not searched"


@pytest.mark.parametrize("value", ["1e999", "-1e999", "0", "-1", "1e-300"])
def test_numbers_beyond_reason_raise_nothing(tmp_path: Path, value: str) -> None:
    nodes = (
        f"Robot {{ children [ HingeJoint {{ jointParameters HingeJointParameters {{ "
        f"axis {value} 0 0 springConstant {value} minStop {value} }} "
        f"device RotationalMotor {{ maxPosition {value} controlPID {value} 0 0 }} "
        f'endPoint Solid {{ name "wheel" boundingObject Cylinder {{ radius {value} }} '
        f"physics Physics {{ mass {value} inertiaMatrix [ {value} 1 1 0 0 0 ] }} }} }} "
        f"Lidar {{ fieldOfView {value} verticalFieldOfView {value} numberOfLayers {value} }} "
        f"Camera {{ width {value} }} ] boundingObject Box {{ size {value} 1 1 }} "
        f"physics Physics {{ mass {value} }} }} Solid {{ boundingObject Box {{ }} "
        f"translation {value} 0 0 physics Physics {{ density {value} }} }}"
    )
    for info in ("", f"basicTimeStep {value} gravity {value} CFM {value} ERP {value}"):
        lint_world(write_world(tmp_path, nodes, info=info))


@pytest.mark.parametrize(
    "nodes",
    [
        "Solid { translation 1 rotation TRUE name 5 physics Box { } boundingObject Physics { } }",
        "Robot { controller Box { } children Box { } name NULL supervisor 3 }",
        'HingeJoint { endPoint NULL device "a" jointParameters Box { } }',
        'WorldInfo { basicTimeStep "x" gravity 0 -9.81 0 contactProperties TRUE }',
        "Robot { children [ HingeJoint { endPoint SolidReference { solidName 4 } } ] }",
    ],
)
def test_values_of_wrong_types_raise_nothing(tmp_path: Path, nodes: str) -> None:
    lint_world(write_world(tmp_path, nodes))


def test_a_world_reads_no_files_but_protos(tmp_path: Path) -> None:
    secret = tmp_path / "A"
    secret.write_text("top secret words", "utf-8")
    world = write_world(tmp_path, "A { }", declared='EXTERNPROTO "../A"')
    report = lint_world(world)
    assert "secret" not in str([each.reason for each in report.not_searched] + report.faults)
