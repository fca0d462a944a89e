"""The plugin in pytest runs of its own: the documentation, the example, no interference."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]


def test_the_documentations_examples_work_as_printed(pytester: pytest.Pytester) -> None:
    text = (ROOT / "docs" / "testing.md").read_text("utf-8")
    blocks = re.findall(r"```python\n(# (\S+\.py)\n.*?)```", text, re.DOTALL)
    assert len(blocks) == text.count("```python") == 4
    for code, name in blocks:
        file = pytester.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(code)
    _copy_project(pytester.path)
    pytester.runpytest_subprocess("-Werror", "-p", "no:cacheprovider").assert_outcomes(passed=6)


def _copy_project(folder: Path) -> None:
    for name in ("worlds/arena.wbt", "controllers/rover/rover.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text((ROOT / "examples" / name).read_text("utf-8"))


def test_the_example_passes() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "examples/tests"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout


def test_a_failure_shows_the_users_line_and_the_reason(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def test_distance(webots_robot, webots_bridge, webots_recording):
            webots_robot.step(16)
            webots_bridge.publish({"front_m": 0.05})
            webots_recording.signal("front_m").assert_never_below(0.1)
        """
    )
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            '>*webots_recording.signal("front_m").assert_never_below(0.1)',
            "E*front_m fell below 0.1 in 1 of 1 rows of run 1 of robot 'rover'",
            "E*first at 0.016 s: 0.05",
        ]
    )
    result.stdout.no_fnmatch_line("*signals.py*")


def test_a_fixture_of_the_users_own_wins(pytester: pytest.Pytester) -> None:
    pytester.makeconftest(
        """
        import pytest

        @pytest.fixture
        def webots_recording():
            return "a gramophone record"

        @pytest.fixture
        def webots_robot(webots_robot_factory):
            return webots_robot_factory("spot")
        """
    )
    pytester.makepyfile(
        """
        def test_mine(webots_recording, webots_bridge):
            assert webots_recording == "a gramophone record"
            assert webots_bridge.robot_name == "spot"
        """
    )
    pytester.runpytest_inprocess().assert_outcomes(passed=1)


def test_no_fixture_takes_a_name_that_a_test_suite_may_use_itself(
    pytester: pytest.Pytester,
) -> None:
    text = pytester.runpytest_inprocess("--fixtures").stdout.str()
    names = re.findall(r"^(\w+) -- .*webots_mcp.pytest_plugin\.py:\d+$", text, re.MULTILINE)
    assert len(names) == 6
    assert all(name.startswith("webots_") for name in names)


def test_a_run_that_does_not_use_the_plugin_does_not_pay_for_it(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os
        import sys

        def test_nothing_is_loaded(pytestconfig):
            assert pytestconfig.pluginmanager.has_plugin("webots_mcp")
            loaded = [name for name in sys.modules if name.startswith("webots_mcp.")]
            assert loaded == ["webots_mcp.pytest_plugin"]
            assert "sqlite3" not in sys.modules
            assert "WEBOTS_MCP_STRICT" not in os.environ
            assert not any("standin" in folder for folder in sys.path)
        """
    )
    pytester.runpytest_subprocess("-Werror").assert_outcomes(passed=1)


def test_what_a_test_changes_is_put_back(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os
        from webots_mcp.bridge import control

        def test_first(webots_bridge):
            assert os.environ["WEBOTS_MCP_STRICT"] == "1"
            assert control.POLL_INTERVAL_S == 0

        def test_second():
            assert control.POLL_INTERVAL_S == 0.005
            assert "WEBOTS_MCP_STRICT" not in os.environ
        """
    )
    pytester.runpytest_inprocess("-Werror").assert_outcomes(passed=2)
