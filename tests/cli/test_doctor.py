"""`webots-mcp doctor`, as a person or a script runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.older_recording import make_older
from webots_mcp.cli import main


@pytest.mark.slow
def test_what_is_well_ends_with_0_and_a_line_for_each_check(
    bridge_recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--database", str(bridge_recording)]) == 0
    out = capsys.readouterr().out
    assert "chosen by: --database\n" in out
    assert "Server           started over stdio" in out
    assert "wrong" not in out


def test_what_is_wrong_ends_with_1_and_what_mends_it_with_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_older(tmp_path / "webots.db")
    assert main(["doctor", "--no-server", "--data-dir", str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "move it aside" in out
    assert "(webots-mcp help troubleshooting schema)" in out.replace("\n", " ")
    assert "Server" not in out


def test_where_it_cannot_look_it_ends_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--data-dir", "~nobody-of-that-name/data"]) == 2
    assert "~nobody-of-that-name" in capsys.readouterr().err


def test_the_rule_that_chose_the_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def chosen_by() -> str:
        main(["doctor", "--no-server", "--json"])
        checks = json.loads(capsys.readouterr().out)["checks"]
        return next(each["seen"] for each in checks if each["check"] == "Data folder")

    monkeypatch.delenv("WEBOTS_MCP_DATA_DIR", raising=False)
    for name in ("worlds", "controllers/rover"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "controllers" / "rover")
    assert f"{tmp_path / 'mcp_data'}, chosen by: the Webots project {tmp_path}" in chosen_by()
    monkeypatch.setenv("WEBOTS_MCP_DATA_DIR", str(tmp_path / "elsewhere"))
    assert "chosen by: the environment variable WEBOTS_MCP_DATA_DIR" in chosen_by()


def test_what_a_controller_said_cannot_steer_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".mcp.json").write_text(
        '{"mcpServers": {"\\u001b[2J": {"command": "/x/webots-mcp", "args": ["serve"]}}}'
    )
    monkey = pytest.MonkeyPatch()
    with monkey.context() as here:
        here.chdir(tmp_path)
        main(["doctor", "--no-server", "--data-dir", str(tmp_path)])
    out = capsys.readouterr().out
    assert "no program '/x/webots-mcp'" in out
    assert "\x1b" not in out


def test_as_json_it_is_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_older(tmp_path / "webots.db")
    assert main(["doctor", "--no-server", "--json", "--data-dir", str(tmp_path)]) == 1
    checks = {each["check"]: each for each in json.loads(capsys.readouterr().out)["checks"]}
    assert checks["Schema"]["verdict"] == "wrong"
    assert checks["Schema"]["page"] == "webots-mcp help troubleshooting schema"
    assert checks["Python"].keys() == {"check", "verdict", "seen"}
