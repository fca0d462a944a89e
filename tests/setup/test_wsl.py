"""Over the border of WSL, whose two programs are played by scripts; not tried on a real Windows."""

from __future__ import annotations

import base64
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from webots_mcp.cli import main
from webots_mcp.setup.wsl import is_wsl

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the scripts are of a POSIX shell")

_WSLPATH = """#!/bin/sh
# WSL's own has /mnt/c for C:; here a folder of the test has that part.
case "$1" in
-w) case "$2" in
    {mnt}/c/*) printf '%s\\n' "C:${{2#{mnt}/c}}" | tr / '\\\\' ;;
    *) printf '%s\\n' '\\\\wsl.localhost\\Debian'"$2" | tr / '\\\\' ;;
    esac ;;
-u) printf '%s\\n' "{mnt}/c${{2#C:}}" | tr '\\\\' / ;;
esac
"""
_POWERSHELL = """#!/bin/sh
printf '%s' "$4" > {asked}
printf '\\357\\273\\277%s\\r\\n' '{answer}'
"""
_SERVER = "C:\\Users\\me\\webots-mcp.exe"
_BOTH = {"webots": "C:\\Program Files\\Webots", "server": [_SERVER], "version": "9.8.7"}


class Border:
    """A machine of WSL, with what PowerShell answers."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.mnt, self.bin, self.asked = folder / "mnt", folder / "bin", folder / "asked"
        self.bin.mkdir()
        self._program("wslpath", _WSLPATH.format(mnt=self.mnt))
        monkeypatch.setenv("WSL_DISTRO_NAME", "Debian")
        monkeypatch.setenv("PATH", f"{self.bin}{os.pathsep}{os.environ['PATH']}")
        for name in ("HOME", "XDG_CONFIG_HOME", "WEBOTS_HOME"):
            monkeypatch.setenv(name, str(folder / "home"))
        (self.mnt / "c/Users/me").mkdir(parents=True)
        (self.mnt / "c/Users/me/webots-mcp.exe").touch(0o755)

    def answer(self, answer: dict[str, Any]) -> None:
        text = _POWERSHELL.format(asked=self.asked, answer=json.dumps(answer))
        self._program("powershell.exe", text)

    def project(self, folder: str) -> Path:
        made = self.mnt.parent / folder
        for part in ("worlds", "controllers"):
            (made / part).mkdir(parents=True)
        return made

    def _program(self, name: str, text: str) -> None:
        (self.bin / name).write_text(text, "utf-8")
        (self.bin / name).chmod(0o755)


@pytest.fixture
def border(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Border:
    return Border(tmp_path, monkeypatch)


def entry_in(project: Path) -> dict[str, Any]:
    return json.loads((project / ".mcp.json").read_text("utf-8"))["mcpServers"]["webots"]


def verdicts(project: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, tuple[str, str]]:
    capsys.readouterr()
    main(["doctor", "--json", "--no-server", "--data-dir", str(project / "mcp_data")])
    checks = json.loads(capsys.readouterr().out)["checks"]
    return {each["check"]: (each["verdict"], each["seen"]) for each in checks}


@pytest.mark.parametrize(
    ("text", "it_is"),
    [
        ("Linux version 5.15.167.4-microsoft-standard-WSL2 (root@buildkit)", True),
        ("Linux version 4.4.0-19041-Microsoft (Microsoft@Microsoft.com)", True),
        ("Linux version 6.1.0-18-amd64 (debian-kernel@lists.debian.org)", False),
        (None, False),
    ],
)
def test_wsl_is_known_by_its_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, it_is: bool
) -> None:
    monkeypatch.delenv("WSL_DISTRO_NAME", raising=False)
    file = tmp_path / "version"
    if text is not None:
        file.write_text(text, "utf-8")
    assert is_wsl(file) is it_is


@pytest.mark.parametrize("module", [[], ["-m", "webots_mcp"]])
def test_a_project_on_a_drive_of_windows_gets_the_server_of_windows(
    border: Border, capsys: pytest.CaptureFixture[str], module: list[str]
) -> None:
    """It is started from WSL, knows its folder as Windows does, and doctor agrees."""
    border.answer(_BOTH | {"server": [_SERVER, *module]})
    project = border.project("mnt/c/mein Projekt")
    (project / "webots-mcp.toml").write_text("", "utf-8")
    assert main(["init", str(project)]) == 0
    said = capsys.readouterr().out
    assert "server of Windows (9.8.7), where Webots is at C:\\Program Files\\Webots" in said
    where = ["serve", "--data-dir", "C:\\mein Projekt\\mcp_data"]
    assert entry_in(project) == {
        "command": str(border.mnt / "c/Users/me/webots-mcp.exe"),
        "args": [*module, *where],
    }
    assert not list(project.glob("mcp_data/*.db*"))  # it is Windows' to make
    script = base64.b64decode(border.asked.read_bytes()).decode("utf-16-le")
    assert "ConvertTo-Json" in script
    assert main(["init", str(project)]) == 0
    found = verdicts(project, capsys)
    assert found["WSL"][0] == "ok"
    assert "on Windows: webots-mcp 9.8.7, Webots at C:\\Program Files\\Webots" in found["WSL"][1]
    assert "the project is on Windows (C:\\mein Projekt)" in found["WSL"][1]
    if not module:
        assert found["Clients"][0] == "ok", found["Clients"]


def test_without_a_server_on_windows_nothing_is_registered_and_the_ways_out_are_named(
    border: Border, capsys: pytest.CaptureFixture[str]
) -> None:
    border.answer(_BOTH | {"server": None})
    project = border.project("mnt/c/p")
    assert main(["init", str(project)]) == 2
    assert "install it there" in capsys.readouterr().err
    assert not (project / ".mcp.json").exists()
    found = verdicts(project, capsys)
    assert found["WSL"][0] == "warning"
    assert "on Windows: no webots-mcp" in found["WSL"][1]
    assert main(["init", str(project), "--http", "http://127.0.0.1:8000/mcp"]) == 0
    assert entry_in(project)["url"] == "http://127.0.0.1:8000/mcp"


def test_where_windows_cannot_be_asked_it_is_said_and_not_guessed(
    border: Border, capsys: pytest.CaptureFixture[str]
) -> None:
    project = border.project("mnt/c/p")
    assert main(["init", str(project)]) == 2
    assert "powershell.exe cannot be asked" in capsys.readouterr().err
    border.answer({"unexpected": 1})
    assert main(["init", str(project)]) == 2
    assert "powershell.exe answered" in capsys.readouterr().err
    assert verdicts(project, capsys)["WSL"][0] == "not checked"


def test_a_project_in_wsl_keeps_its_own_server_and_is_warned_of_a_webots_on_windows(
    border: Border, capsys: pytest.CaptureFixture[str]
) -> None:
    border.answer(_BOTH)
    project = border.project("home/p")
    assert main(["init", str(project)]) == 0
    assert "one on Windows cannot record into this project" in capsys.readouterr().out
    assert "C:" not in json.dumps(entry_in(project))
    verdict, seen = verdicts(project, capsys)["WSL"]
    assert verdict == "warning"
    assert f"the project is in WSL ({project})" in seen


def test_no_password_of_an_address_is_written_into_a_project(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "worlds").mkdir()
    for url in ("http://me:hidden@robots.lab/mcp", "http://", "http://robots lab"):
        assert main(["init", str(tmp_path), "--http", url]) == 2
        assert "is not a URL of a server without user and password" in capsys.readouterr().err
    assert not (tmp_path / ".mcp.json").exists()
