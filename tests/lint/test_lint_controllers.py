"""What a lint says of controllers: devices, periods, learning, and what it cannot know."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.lint.worlds import faults_of, write_controller, write_world
from webots_mcp.lint import lint_world
from webots_mcp.lint.world_faults import LintReport

ROBOT = (
    'Robot { name "rover" controller "drive" %s children [ DistanceSensor { name "ps0" } '
    'DistanceSensor { name "ps1" } GPS { name "gps" } ] }'
)


def linted(folder: Path, source: str, *, more: str = "", info: str = "") -> LintReport:
    write_controller(folder, source)
    return lint_world(write_world(folder, ROBOT % more, info=info))


def asked(body: str) -> str:
    return f"from controller import Robot\nrobot = Robot()\n{body}\n"


@pytest.mark.parametrize(
    "body",
    [
        "robot.getDevice('ps0'); robot.getDevice('ps1'); robot.getGPS('gps')",
        "for i in range(2):\n    robot.getDevice('ps' + str(i))\nrobot.getDevice('gps')",
        "for i in range(2):\n    robot.getDevice(f'ps{i}')\nrobot.getDevice('gps')",
        "names = ['ps0', 'ps1', 'gps']\nall = [robot.getDevice(name) for name in names]",
        "for name in ('ps%d' % 0, 'ps1', 'gps'):\n    robot.getDevice(name)",
    ],
)
def test_devices_that_the_robot_has_are_no_fault(tmp_path: Path, body: str) -> None:
    report = linted(tmp_path, asked(body))
    assert faults_of(report, "devices") == []
    assert report.verdicts()["devices"] == "not found"


def test_a_device_that_the_robot_lacks_is_an_error_at_its_line(tmp_path: Path) -> None:
    body = "robot.getDevice('ps0'); robot.getDevice('ps1')\nrobot.getDevice('gsp')"
    missing, idle = faults_of(linted(tmp_path, asked(body)), "devices")
    assert (missing.severity, missing.line) == ("error", 4)
    assert "Ask for 'gps'" in missing.fix
    assert (idle.severity, "'gps'" in idle.what) == ("note", True)


def test_a_device_that_is_asked_for_under_a_condition_is_a_warning(tmp_path: Path) -> None:
    body = "if robot.getName() == 'other':\n    robot.getDevice('arm')"
    assert faults_of(linted(tmp_path, asked(body)), "devices")[0].severity == "warning"


def test_names_that_are_computed_are_not_searched(tmp_path: Path) -> None:
    report = linted(tmp_path, asked("import sys\nrobot.getDevice(sys.argv[1])"))
    assert faults_of(report, "devices") == []
    assert report.verdicts()["devices"] == "not searched"


def test_a_c_controller_is_read_without_its_comments(tmp_path: Path) -> None:
    folder = tmp_path / "controllers" / "drive"
    folder.mkdir(parents=True)
    (folder / "drive.c").write_text(
        '#define TIME_STEP 50\n// wb_robot_get_device("old");\n'
        '/* wb_robot_get_device("older"); */\n'
        'int main() { WbDeviceTag a = wb_robot_get_device("ps0"), b = wb_robot_get_device("arm");\n'
        '  wb_robot_get_device("ps1"); wb_robot_get_device("gps");\n'
        "  while (wb_robot_step(TIME_STEP) != -1); }\n",
        "utf-8",
    )
    report = lint_world(write_world(tmp_path, ROBOT % ""))
    (missing,) = faults_of(report, "devices")
    assert ("'arm'" in missing.what, missing.line) == (True, 4)
    (period,) = faults_of(report, "sampling period")
    assert ("50" in period.what, period.line) == (True, 6)


@pytest.mark.parametrize(
    ("body", "is_fault"),
    [
        ("robot.step(32)", False),
        ("robot.step(64)", False),
        ("robot.step(50)", True),
        ("robot.step(16)", True),
        ("step = int(robot.getBasicTimeStep())\nrobot.step(2 * step)", False),
        ("TIME_STEP = 48\nrobot.step(TIME_STEP)", True),
    ],
)
def test_a_step_has_to_be_a_multiple_of_the_basic_step(
    tmp_path: Path, body: str, *, is_fault: bool
) -> None:
    report = linted(tmp_path, asked(body))
    assert bool(faults_of(report, "sampling period")) == is_fault
    assert report.verdicts()["sampling period"] == ("found" if is_fault else "not found")


def test_a_period_that_is_computed_is_not_searched(tmp_path: Path) -> None:
    report = linted(tmp_path, asked("import sys\nrobot.step(int(sys.argv[1]))"))
    assert report.verdicts()["sampling period"] == "not searched"


@pytest.mark.parametrize(
    ("source", "more", "is_fault"),
    [
        ("import gymnasium\n", "synchronization FALSE", True),
        ("import torch\nloss.backward()\n", "synchronization FALSE", True),
        ("import torch\n", "synchronization FALSE", False),
        ("import gymnasium\n", "", False),
    ],
)
def test_learning_needs_synchronization(
    tmp_path: Path, source: str, more: str, *, is_fault: bool
) -> None:
    report = linted(tmp_path, source, more=more)
    assert bool(faults_of(report, "synchronization")) == is_fault


def test_an_extern_controller_and_a_placeholder_are_not_searched(tmp_path: Path) -> None:
    for name in ("<extern>", "{{CONTROLLER}}"):
        report = lint_world(write_world(tmp_path, f'Robot {{ controller "{name}" }}'))
        assert report.faults == []
        assert report.verdicts()["devices"] == "not searched"


def test_robots_with_one_program_may_have_different_devices(tmp_path: Path) -> None:
    write_controller(tmp_path, asked("robot.getDevice('ps0'); robot.getDevice('lidar')"))
    second = (
        'Robot { name "b" controller "drive" children [ Lidar { } DistanceSensor { name "ps0"} ] }'
    )
    report = lint_world(write_world(tmp_path, ROBOT % "" + second))
    assert [fault for fault in faults_of(report, "devices") if fault.severity == "error"] == []


def test_a_source_that_cannot_be_parsed_is_not_searched(tmp_path: Path) -> None:
    verdicts = linted(tmp_path, asked("robot.step(33")).verdicts()
    assert (verdicts["devices"], verdicts["sampling period"]) == ("not searched", "not searched")
