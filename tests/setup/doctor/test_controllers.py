"""What doctor says of the controllers of a project, and of robots that no Supervisor moves."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp.contract import DATABASE_NAME, OBSERVER, OBSERVER_NAME
from webots_mcp.setup.doctor import Diagnosis, all_checks, diagnose, subject_of
from webots_mcp.store.recording import RecordingAccess

PLAIN = "from controller import Robot\nrobot = Robot()\n"
STEERS = "from controller import Supervisor\nrobot = Supervisor()\n"
RECORDS = "from webots_mcp import MCPBridge\n"

Ask = Callable[..., Diagnosis]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name in ("worlds", "mcp_data"):
        (tmp_path / name).mkdir()
    (tmp_path / "worlds" / "arena.wbt").touch()
    return tmp_path


@pytest.fixture
def recorded(project: Path) -> Recorded:
    return Recorded(project / "mcp_data" / DATABASE_NAME)


@pytest.fixture
def ask(project: Path) -> Ask:
    def one(check: str, *, probes_python: bool = False) -> Diagnosis:
        (asked,) = [each for each in all_checks() if each.name == check]
        folder = project / "mcp_data"
        subject = subject_of(RecordingAccess(folder / DATABASE_NAME, folder), "the test")
        ((_, finding),) = diagnose(replace(subject, probes_python=probes_python), (asked,))
        return finding

    return one


def write(project: Path, name: str, text: str) -> Path:
    file = project / "controllers" / Path(name).stem / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, "utf-8")
    return file


def test_which_record_and_which_lack_the_lines_is_said_together(project: Path, ask: Ask) -> None:
    write(project, "records.py", RECORDS + STEERS)
    write(project, "lacks.py", STEERS)
    write(project, "walker.c", "int main() {}")
    write(project, "writer.c", '#include "webots_mcp.h"')
    finding = ask("Controllers")
    assert finding.verdict == "warning"
    assert "records.py has the bridge" in finding.seen
    assert "lacks.py does not record" in finding.seen
    assert "walker.c (C) does not record" in finding.seen
    assert "writer.c (C) is recorded" in finding.seen
    assert finding.fix is not None
    assert "webots-mcp init --patch controllers/lacks/lacks.py" in finding.fix
    assert "webots_mcp.h" in finding.fix


def test_the_python_of_a_controller_is_started_for_a_person_alone(project: Path, ask: Ask) -> None:
    program = project / "no python"
    program.write_text("#!/bin/sh\ntouch started\n", "utf-8")
    program.chmod(0o755)
    file = write(project, "records.py", RECORDS + STEERS)
    (file.parent / "runtime.ini").write_text(f"[python]\nCOMMAND = {program}\n", "utf-8")
    assert ask("Controllers").verdict == "ok"
    assert not (file.parent / "started").exists()
    finding = ask("Controllers", probes_python=True)
    assert finding.verdict in ("warning", "wrong")
    assert "where the bridge cannot be used: it is no Python that works" in finding.seen
    assert (file.parent / "started").exists()


def test_a_controller_that_records_now_has_all_that_it_needs(
    project: Path, ask: Ask, recorded: Recorded
) -> None:
    file = write(project, "records.py", "#!/no/such/python\n" + RECORDS + STEERS)
    recorded.robot(controller=str(file))
    finding = ask("Controllers", probes_python=True)
    assert (finding.verdict, finding.seen) == ("ok", "controllers/records/records.py records now")


def test_a_project_of_extern_controllers_alone_is_well(ask: Ask) -> None:
    assert ask("Controllers").verdict == "ok"


@pytest.mark.parametrize(
    ("field", "verdict"),
    [("", "warning"), ("supervisor FALSE", "warning"), ("supervisor TRUE", "ok")],
)
def test_without_code_the_worlds_show_whether_a_robot_is_a_supervisor(
    project: Path, ask: Ask, field: str, verdict: str
) -> None:
    world = project / "worlds" / "arena.wbt"
    world.write_text(f'#VRML_SIM R2025a utf8\nRobot {{ controller "<extern>" {field} }}\n')
    finding = ask("Supervisor")
    assert finding.verdict == verdict
    assert (finding.fix is not None) == (verdict == "warning")


def test_outside_of_a_project_controllers_are_not_checked(project: Path, ask: Ask) -> None:
    shutil.rmtree(project / "worlds")
    for name in ("Controllers", "Supervisor"):
        assert ask(name).verdict == "not checked"
        assert "in no Webots project" in ask(name).seen


@pytest.mark.parametrize(
    ("code", "is_plain"),
    [
        (PLAIN, True),
        (STEERS, False),
        ("import controller as c\nrobot = c.Robot()\n", True),
        ("from controller import *\nclass Mine(Robot):\n    pass\nrobot = Mine()\n", True),
        ("from controller import Robot, Supervisor\nrobot = Supervisor()\n", False),
        ("import helper\n", False),
    ],
)
def test_a_plain_robot_is_told_by_its_class_before_it_ever_ran(
    project: Path, ask: Ask, code: str, *, is_plain: bool
) -> None:
    write(project, "rover.py", code)
    write(project, "rover.py", code).with_name("helper.py").write_text(STEERS, "utf-8")
    finding = ask("Supervisor")
    assert (finding.verdict == "warning") == is_plain
    assert ("pause, step, reset" in finding.seen) == is_plain
    if is_plain:
        assert finding.fix is not None
        assert "webots-mcp init --observer worlds/arena.wbt" in finding.fix


def test_a_plain_robot_that_records_is_told_what_it_lacks(ask: Ask, recorded: Recorded) -> None:
    robot = recorded.robot(supervisor=0)
    finding = ask("Supervisor")
    assert finding.verdict == "warning"
    assert "rover is a plain Robot" in finding.seen
    assert "stuck, distances and paths are not known" in finding.seen
    for name in ("pose.0", "pose.1"):
        recorded.connection.execute(
            "INSERT INTO signal (robot_id, name, kind, path, first_seen_wall_time_s) "
            "VALUES (?, ?, 'num', '$', 0)",
            (robot.id, name),
        )
    assert "stuck" not in ask("Supervisor").seen


def test_with_an_observer_nothing_is_lacking(ask: Ask, recorded: Recorded) -> None:
    recorded.robot(supervisor=0)
    observer: RecordedRobot = recorded.robot(OBSERVER_NAME)
    recorded.connection.execute("UPDATE robot SET kind = ? WHERE id = ?", (OBSERVER, observer.id))
    finding = ask("Supervisor")
    assert finding.verdict == "ok"
    assert "mcp_observer steers, and sees where it is" in finding.seen
