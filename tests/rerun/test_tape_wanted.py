"""Where a tape is asked for, and that asking costs a controller nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from webots_mcp.database.tapes.tape_wanted import wanted


@pytest.mark.parametrize(
    ("environment", "line", "how"),
    [
        (None, "tape = true\n[allow]\n", "on"),
        (None, "# tape = true\n", None),
        (None, '  tape="images" # all of it\n', "images"),
        (None, "[signals]\ntape = true\n", None),
        (None, "tape = false\n", None),
        (None, "", None),
        ("0", "tape = true\n", None),
        ("1", "", "on"),
        ("images", "tape = true\n", "images"),
        ("off", "", None),
    ],
)
def test_the_environment_decides_before_the_projects_file(
    tmp_path: Path, environment: str | None, line: str, how: str | None
) -> None:
    (tmp_path / "worlds").mkdir()
    (tmp_path / "controllers" / "rover").mkdir(parents=True)
    (tmp_path / "webots-mcp.toml").write_text(line, "utf-8")
    assert wanted(environment, tmp_path / "controllers" / "rover") == how


def test_without_a_tape_a_controller_does_not_import_the_recorder(tmp_path: Path) -> None:
    code = "import sys, webots_mcp; print([m for m in sys.modules if 'tape_recorder' in m])"
    environment = {"WEBOTS_INSTANCE_PATH": "/tmp/webots/ada/1234/", "PATH": ""}
    said = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout == "[]\n"
