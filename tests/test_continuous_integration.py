"""The workflows of a public host, as far as they can be checked here, and the file for users."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.lowest import lowest
from tests.simulator.conftest import CONTROLLER, webots, write_project

yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
__all__ = ["webots"]
CHECKOUT = Path(__file__).parents[1]
EXAMPLE = CHECKOUT / "examples/continuous_integration/webots.yml"
OURS = {file.stem: file for file in sorted((CHECKOUT / ".github/workflows").glob("*.yml"))}
posix = pytest.mark.skipif(os.name != "posix", reason="its steps are for a POSIX shell")
if not OURS:
    pytest.skip("workflows are in a checkout only", allow_module_level=True)


def read(file: Path) -> dict[str, Any]:
    return yaml.safe_load(file.read_text("utf-8"))


def steps(file: Path) -> Iterator[dict[str, Any]]:
    for job in read(file)["jobs"].values():
        yield from job.get("steps", ())


@pytest.mark.slow
def test_the_workflows_are_valid_by_the_schema_of_the_host() -> None:
    pytest.importorskip("check_jsonschema", reason="check-jsonschema is not installed")
    line = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.github-workflows"]
    done = subprocess.run(
        [*line, *OURS.values(), EXAMPLE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@posix
@pytest.mark.parametrize("file", [*OURS.values(), EXAMPLE], ids=lambda file: file.stem)
def test_each_step_is_a_line_that_a_shell_can_read_and_runs_a_job_that_there_is(file: Path) -> None:
    jobs = set(re.findall(r"(?m)^    (\w+)\)", (CHECKOUT / "run").read_text("utf-8")))
    for step in steps(file):
        line = re.sub(r"\$\{\{ matrix\.job \}\}", "lowest", str(step.get("run", "")))
        line = re.sub(r"\$\{\{.*?\}\}", "expression", line)
        if step.get("shell") != "cmd":
            subprocess.run(["sh", "-n", "-c", line], check=True)
        assert {*re.findall(r"\./run (\w+)", line)} <= jobs, line
        assert "secrets." not in str(step)


def test_all_systems_and_pythons_are_tested_and_the_wheel_that_they_tested_is_released() -> None:
    jobs = read(OURS["tests"])["jobs"]
    matrix = jobs["tests"]["strategy"]["matrix"]
    assert {each.partition("-")[0] for each in matrix["os"]} == {"ubuntu", "macos", "windows"}
    admitted = re.findall(r"Python :: (3\.\d+)", (CHECKOUT / "pyproject.toml").read_text("utf-8"))
    assert matrix["python"] == admitted
    assert {"lowest", "locked"} == {*jobs["dependencies"]["strategy"]["matrix"]["job"]}
    made = {each["with"]["name"] for each in jobs["wheel"]["steps"] if "upload" in str(each)}
    release = read(OURS["release"])["jobs"]
    assert release["tests"]["uses"] == "./.github/workflows/tests.yml"
    publish = release["publish"]
    assert publish["needs"] == "tests"
    assert publish["permissions"]["id-token"] == "write"
    taken = {each["with"]["name"] for each in publish["steps"] if "download" in str(each)}
    assert taken == made == {"dist", "sbom"}
    assert not any("build" in str(step.get("run")) for step in publish["steps"])


@posix
@pytest.mark.parametrize(
    "case", read(OURS["tests"])["jobs"]["header"]["strategy"]["matrix"]["include"]
)
def test_the_header_is_compiled_as_the_workflow_does(case: dict[str, str], tmp_path: Path) -> None:
    words = shlex.split(case["compile"])
    if shutil.which(words[0]) is None:
        pytest.skip(f"there is no {words[0]}")
    names = {"tests/store/journal/driver.c", "webots_mcp/webots_mcp.h"}
    assert all((CHECKOUT / name).is_file() for name in names)
    source = CHECKOUT / "tests/store/journal/driver.c"
    program = tmp_path / "driver"
    subprocess.run([*words, f"-I{CHECKOUT / 'webots_mcp'}", source, "-o", program], check=True)
    environment = os.environ | {"WEBOTS_MCP_DATA_DIR": str(tmp_path / "recorded")}
    subprocess.run([program], input=b"say\n", env=environment, check=True)


@pytest.mark.slow
@posix
def test_the_file_for_users_drives_checks_and_reports(
    webots: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shutil.which("timeout"), "of GNU, as in the container"
    driving = CONTROLLER.replace("robot.getTime()})", 'robot.getTime(), "front_m": 1.0})')
    ending = driving + "    if robot.getTime() > 2:\n        robot.simulationQuit(0)\n"
    project = write_project(tmp_path / "project", ending).parents[1]
    program = webots.parent / "webots-mcp"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m webots_mcp "$@"\n', "utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("DISPLAY", ":99")
    ((_, job),) = read(EXAMPLE)["jobs"].items()
    lines = [step["run"] for step in job["steps"] if "run" in step and "pip" not in step["run"]]
    assert len(lines) == 3
    for line in lines:
        environment = os.environ | job["env"]
        done = subprocess.run(
            ["sh", "-e", "-c", line], cwd=project, env=environment, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
    kept = next(step for step in job["steps"] if "upload" in str(step))["with"]["path"].split()
    assert all((project / each).exists() for each in kept), kept


def test_the_lowest_versions_are_those_that_pyproject_says_and_the_lock_names_no_place() -> None:
    assert "numpy==2.1" in [*lowest()]
    lock = (CHECKOUT / "requirements.lock").read_text("utf-8")
    assert "://" not in lock
    assert re.search(r"(?m)^mcp==[\d.]+ \\\n    --hash=sha256:", lock)
    locked = {*re.findall(r"(?m)^([\w.-]+?)==", lock)}
    assert {each.partition("==")[0].lower() for each in lowest()} <= locked
