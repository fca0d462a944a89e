"""Which controllers of a project Webots would start."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp.database.location import require_world_of, resolve_data_dir
from webots_mcp.errors import InvalidInputError
from webots_mcp.simulator.project import controllers_of, project_of


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name in ("worlds", "controllers"):
        (tmp_path / "a project" / name).mkdir(parents=True)
    return tmp_path / "a project"


def test_it_is_found_from_anywhere_inside(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert project_of(str(project / "worlds")) == project
    monkeypatch.chdir(project / "controllers")
    assert project_of(None) == project


def test_outside_of_one_it_is_said_and_one_below_is_named(project: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"lies below: .*a project"):
        project_of(str(project.parent))
    with pytest.raises(InvalidInputError, match="is not a folder"):
        project_of(str(project / "gone"))


def test_the_first_file_that_is_there_is_started(project: Path) -> None:
    for name, files in {
        "python": ["python.py"],
        "compiled": ["compiled", "compiled.py"],
        "java": ["java.jar", "java.py"],
        "helpers": ["other.py"],
        "built": ["built", "built.c"],
        "walls": ["walls.cpp", "Makefile"],
        "arm": ["src/Arm.java"],
        "legs": ["legs.m"],
        "bridge": ["package.xml"],
    }.items():
        (project / "controllers" / name).mkdir()
        for file in files:
            (project / "controllers" / name / file).parent.mkdir(exist_ok=True)
            (project / "controllers" / name / file).touch()
    found = {each.name: each.language for each in controllers_of(project, "linux")}
    assert found == {
        "python": "Python", "compiled": "a program", "java": "Java", "built": "C", "walls": "C++",
        "arm": "Java", "legs": "MATLAB", "bridge": "ROS",
    }  # fmt: skip
    unbuilt = {each.name for each in controllers_of(project, "linux") if not each.is_built}
    assert unbuilt == {"walls", "arm"}
    on_windows = {each.name: each.language for each in controllers_of(project, "win32")}
    assert on_windows["compiled"] == "Python"


def test_worlds_alone_are_a_project_for_every_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ROS 2 package: its driver, a controller that Webots starts, the server, an extern one."""
    package = tmp_path / "package"
    for name in ("worlds", "my_package", "controllers/mcp_observer"):
        (package / name).mkdir(parents=True)
    (package / "worlds" / "arena.wbt").touch()
    monkeypatch.delenv("WEBOTS_MCP_DATA_DIR", raising=False)
    for folder in (".", "my_package", "worlds", "controllers/mcp_observer"):
        monkeypatch.chdir(package / folder)
        assert project_of(None) == package
        assert resolve_data_dir() == package / "mcp_data"
    (package / "controllers" / "mcp_observer").rmdir()
    (package / "controllers").rmdir()
    monkeypatch.chdir(package / "my_package")
    assert resolve_data_dir() == package / "mcp_data"
    assert controllers_of(package) == []
    assert require_world_of(None, package / "worlds" / "arena.wbt") == package


def test_a_folder_of_worlds_without_a_world_is_no_project(tmp_path: Path) -> None:
    (tmp_path / "worlds").mkdir()
    (tmp_path / "worlds" / "notes.txt").touch()
    with pytest.raises(InvalidInputError, match=r"holds worlds/ with a \.wbt file"):
        project_of(str(tmp_path))
    (tmp_path / "worlds" / "arena.wbt").touch()
    assert project_of(str(tmp_path)) == tmp_path
