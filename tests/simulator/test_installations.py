"""Where Webots is found: homes of three systems, the PATH, and what is in them."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator import installations as module
from webots_mcp.simulator.installations import find_webots, installations
from webots_mcp.steering.trial_run import webots

LAYOUTS = {
    "linux": ("webots", "webots-controller", "lib/controller/python", "resources"),
    "darwin": ("Contents/MacOS/webots", "Contents/MacOS/webots-controller",
               "Contents/lib/controller/python", "Contents/Resources"),
    "win32": ("msys64/mingw64/bin/webots.exe", "msys64/mingw64/bin/webots-controller.exe",
              "lib/controller/python", "resources"),
}  # fmt: skip


def install(home: Path, platform: str, version: str) -> Path:
    """A home folder as an installer of that system leaves it; returns its program."""
    program, launcher, python_api, resources = LAYOUTS[platform]
    for name in (program, launcher):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text("#!/bin/sh\n")
        (home / name).chmod(0o755)
    (home / python_api).mkdir(parents=True)
    (home / resources).mkdir(parents=True, exist_ok=True)
    (home / resources / "version.txt").write_text(f"{version}\n")
    return home / program


@pytest.fixture(autouse=True)
def nothing_installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """What is installed on this machine does not count; returns where installers put it."""
    default = tmp_path / "default"
    for platform in LAYOUTS:
        monkeypatch.setitem(module._DEFAULT_HOMES, platform, (str(default),))
    monkeypatch.delenv("WEBOTS_HOME", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    return default


@pytest.mark.parametrize("platform", LAYOUTS)
def test_a_home_says_its_version_and_programs_in_the_layout_of_each_system(
    platform: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    program = install(home, platform, "R2025a")
    monkeypatch.setenv("WEBOTS_HOME", str(home))
    (found,) = installations(platform)
    assert (found.found_by, found.version, found.home) == ("WEBOTS_HOME", "R2025a", home)
    assert found.program == program
    assert found.launcher == home / LAYOUTS[platform][1]
    assert found.python_api == home / LAYOUTS[platform][2]


def test_a_link_on_the_path_leads_to_its_home(tmp_path: Path) -> None:
    program = install(tmp_path / "opt" / "webots", "linux", "R2023b")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "webots").symlink_to(program)
    (found,) = installations("linux")
    assert (found.found_by, found.version) == ("PATH", "R2023b")
    assert found.home == program.parent.resolve()


def test_a_program_without_a_home_is_still_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":99")  # or it would be started in a virtual display
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "webots"
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    found = find_webots()
    assert (found.home, found.version, found.program) == (None, None, script)
    assert webots("a.wbt").words[0] == str(script)


def test_of_several_webots_home_comes_first_and_each_is_there_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nothing_installed: Path
) -> None:
    install(tmp_path / "mine", "linux", "R2023b")
    program = install(nothing_installed, "linux", "R2025a")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "webots").symlink_to(program)
    monkeypatch.setenv("WEBOTS_HOME", str(tmp_path / "mine"))
    found = installations("linux")
    assert [(each.found_by, each.version) for each in found] == [
        ("WEBOTS_HOME", "R2023b"),
        ("PATH", "R2025a"),
    ]


def test_where_none_is_installed_the_places_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("WEBOTS_HOME", str(tmp_path / "gone"))
    with pytest.raises(CommandRefusedError, match=r"WEBOTS_HOME \(.*gone\), on the PATH or in"):
        find_webots()
    with pytest.raises(CommandRefusedError, match="--stand-in"):
        webots("a.wbt")
