"""Installed by `pip install --no-deps`, as for a controller's Python: what works, what is said."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

import webots_mcp
from tests.recordings.rows import Recorded

# -I -S: nothing that is installed for this Python is found.
PROGRAM = """
import json, sys
sys.path.insert(0, sys.argv[1])
from webots_mcp.cli import main
for arguments in json.loads(sys.argv[2]):
    print(arguments[0], main(arguments))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package and its metadata, without what it depends on."""
    folder = tmp_path_factory.mktemp("site")
    package = Path(webots_mcp.__file__).parent
    without_bytecode = shutil.ignore_patterns("__pycache__")
    shutil.copytree(package, folder / package.name, ignore=without_bytecode)
    told = metadata.distribution("webots-mcp").read_text("METADATA")
    assert told is not None
    (folder / "webots_mcp-0.dist-info").mkdir()
    (folder / "webots_mcp-0.dist-info" / "METADATA").write_text(told, "utf-8")
    return folder


@pytest.fixture
def database(tmp_path: Path) -> Path:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot(now=1_700_000_000.0)
    robot.state(0.5, {"x": 1})
    robot.end_run("finished")
    robot.begin_run("reset")
    robot.state(0.5, {"x": 2})
    recorded.close()
    return tmp_path / "webots.db"


def run(site: Path, commands: list[list[str]]) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-I", "-S", "-c", PROGRAM, str(site), json.dumps(commands)]
    return subprocess.run(
        line, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False, cwd=site
    )


@pytest.mark.parametrize(
    "command", ["status", "serve", "plot", "demo", "history", "export", "launch"]
)
def test_a_command_names_what_is_missing_and_the_line_that_installs_it(
    site: Path, database: Path, command: str
) -> None:
    more: dict[str, Any] = {
        "plot": ["x", "-o", "x.png"], "demo": ["--data-dir", "demo"], "compare": ["1", "2"],
        "history": ["x"], "launch": ["x.wbt"],
    }  # fmt: skip
    where = [] if command in ("demo", "launch") else ["--database", str(database)]
    ended = run(site, [[command, *where, *more.get(command, [])]])
    assert ended.stdout == f"{command} 1\n"
    assert "Traceback" not in ended.stderr
    (line,) = re.findall(r"pip install --python \S+ (.*)", ended.stderr)
    requires = map(Requirement, metadata.requires("webots-mcp") or ())
    wanted = [each for each in requires if not each.marker or each.marker.evaluate({"extra": ""})]
    assert re.findall(r"'([\w-]+)[^';]*'", line) == [each.name for each in wanted]
    assert f"missing: {', '.join(sorted(each.name for each in wanted)[:2])}, " in ended.stderr
    assert "optuna" not in ended.stderr  # only an extra needs it


def test_without_being_installed_at_all_it_says_how_to(site: Path, tmp_path: Path) -> None:
    shutil.copytree(site / "webots_mcp", tmp_path / "site" / "webots_mcp")
    ended = run(tmp_path / "site", [["serve", "--data-dir", "x"]])
    assert "'cyclopts' is missing" in ended.stderr
    assert "'CHECKOUT'" in ended.stderr
