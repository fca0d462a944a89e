"""Which Python a controller is started with, found by Webots' rules and tried for real."""

from __future__ import annotations

import os
import plistlib
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from webots_mcp.extras.requirements import checkout, quoted
from webots_mcp.setup.interpreter import chosen, probe_interpreter


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No preferences and no Webots of this machine."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for name in ("XDG_CONFIG_HOME", "WEBOTS_HOME"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "home"


@pytest.fixture
def controller(tmp_path: Path) -> Path:
    folder = tmp_path / "my röbot"
    folder.mkdir()
    (folder / "r.py").write_text("robot = 1\n")
    return folder / "r.py"


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python without webots-mcp, in a folder with a space."""
    folder = tmp_path_factory.mktemp("a bare one")
    venv.create(folder, with_pip=False)
    return folder / "bin" / "python"


def runtime(controller: Path, command: str) -> None:
    controller.with_name("runtime.ini").write_text(
        "; mine\n[environment variables]\nCOMMAND = no\n\n[python]\n"
        f'COMMAND = {command} \nOPTIONS = -O\n', "utf-8",
    )  # fmt: skip


def prefer(home: Path, version: str, command: str) -> None:
    folder = home / ".config" / "Cyberbotics"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"Webots-{version}.conf").write_text(
        f"[General]\npythonCommand=wrong\n\n[%General]\nfoo=1\npythonCommand={command}\n"
    )


def test_each_place_that_names_a_python_goes_before_the_one_before(
    controller: Path, home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [chosen(controller, system).command for system in ("linux", "darwin", "win32")] == [
        ("python3",), ("python3",), ("python",)
    ]  # fmt: skip
    prefer(home, "R2023b", "/old/python")
    prefer(home, "R2025a", "/new/python")
    assert chosen(controller, "linux") == (("/new/python",), "the preferences of Webots R2025a")
    installed = tmp_path / "webots"
    (installed / "resources").mkdir(parents=True)
    (installed / "resources" / "version.txt").write_text("R2023b\n")
    (installed / "webots").write_text("#!/bin/sh\n")
    monkeypatch.setenv("WEBOTS_HOME", str(installed))
    assert chosen(controller, "linux").command == ("/old/python",)
    runtime(controller, '"/my venv/bin/python"')
    assert chosen(controller, "linux").command == ("/my venv/bin/python",)
    controller.write_text("#!/usr/bin/env python3.12\n")
    assert chosen(controller, "linux").command == ("/usr/bin/env", "python3.12")
    assert chosen(controller, "win32").command == ("/my venv/bin/python",)


def test_macos_keeps_them_in_a_property_list(controller: Path, home: Path) -> None:
    folder = home / "Library" / "Preferences"
    folder.mkdir(parents=True)
    file = folder / "com.cyberbotics.Webots-R2025a.plist"
    file.write_bytes(plistlib.dumps({"General.pythonCommand": "/opt/python"}))
    assert chosen(controller, "darwin").command == ("/opt/python",)
    file.write_bytes(b"damaged")
    assert chosen(controller, "darwin").command == ("python3",)


def test_a_python_with_the_bridge_says_its_version(controller: Path) -> None:
    runtime(controller, sys.executable)
    found = probe_interpreter(controller)
    assert (found.error, found.fix) == (None, None)
    assert found.bridge
    assert found.executable == sys.executable
    left = {file.name for file in controller.parent.iterdir()}
    assert left == {"r.py", "runtime.ini"}, "nothing is left behind"


def test_one_without_it_gets_the_line_that_mends_it_quoted(controller: Path, bare: Path) -> None:
    runtime(controller, str(bare))
    found = probe_interpreter(controller)
    assert found.bridge is None
    assert "webots_mcp" in (found.error or "")
    line = (found.fix or "").partition("   (")[0]
    words = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert words[:4] == [str(bare), "-m", "pip", "install"]
    assert words[-2:] == ["--no-deps", checkout()]
    assert "ensurepip" in (found.fix or ""), "it has no pip"


def test_a_controllers_own_file_that_hides_the_package_is_seen(controller: Path) -> None:
    runtime(controller, sys.executable)
    controller.with_name("webots_mcp.py").write_text("raise RuntimeError('mine')\n")
    assert probe_interpreter(controller).error == "RuntimeError: mine"


ENDLESS = "exec sleep 600"
OLD = '{"executable": "/p", "python": "3.8.1", "error": "SyntaxError: x", "pip": true}'


@pytest.mark.parametrize(
    ("program", "error", "fix"),
    [
        ("echo broken >&2; exit 3", "exit code 3, broken", "start it in a terminal"),
        (ENDLESS, "within 0.2 s", "start it in a terminal"),
        (f"echo '{OLD}'", "SyntaxError: x", "3.8.1 is too old"),
        (None, "no program '/no/such/python'", "my röbot/runtime.ini"),
    ],
)
def test_what_is_no_python_that_works_is_named_with_what_mends_it(
    controller: Path, tmp_path: Path, program: str | None, error: str, fix: str
) -> None:
    file = tmp_path / "fake-python"
    file.write_text(f"#!/bin/sh\n{program}\n")
    file.chmod(0o755)
    runtime(controller, str(file) if program else "/no/such/python")
    found = probe_interpreter(controller, timeout_s=0.2 if program == ENDLESS else 60)
    assert error in (found.error or "")
    assert fix in (found.fix or "")


def test_the_environment_of_this_shell_does_not_count(
    controller: Path, bare: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = bare.parent / "python3"
    assert link.exists()
    monkeypatch.setenv("VIRTUAL_ENV", str(bare.parent.parent))
    monkeypatch.setenv("PATH", f"{bare.parent}{os.pathsep}{os.environ['PATH']}")
    assert probe_interpreter(controller).executable != str(link)


def test_lines_are_quoted_for_the_shell_of_the_system() -> None:
    command = [r"C:\Program Files\python.exe", "-m", "pip"]
    assert quoted(command, "win32").startswith(r'& "C:\Program Files\python.exe" -m pip')
    assert quoted(["python.exe", "-m"], "win32") == "python.exe -m"
    assert quoted(["/a b/python"], "linux") == "'/a b/python'"
