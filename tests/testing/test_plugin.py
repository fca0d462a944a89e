"""The plugin in pytest runs of its own: the documentation, the example, no interference."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_documentations_examples_work_as_printed(pytester: pytest.Pytester) -> None:
    text = (ROOT / "docs" / "testing.md").read_text("utf-8")
    blocks = re.findall(r"```python\n(# (\S+\.py)\n.*?)```", text, re.DOTALL)
    assert len(blocks) == text.count("```python") == 4
    for code, name in blocks:
        file = pytester.path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(code)
    _copy_project(pytester.path)
    pytester.runpytest_subprocess("-Werror", "-p", "no:cacheprovider").assert_outcomes(passed=5)


@pytest.mark.slow
def test_the_documentations_failure_is_todays(pytester: pytest.Pytester) -> None:
    text = (ROOT / "docs" / "testing.md").read_text("utf-8")
    (code,) = re.findall(r"```python\n# test_rover.py\n(.*?)```", text, re.DOTALL)
    (shown,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    assert "below(0.1)" in code
    pytester.makepyfile(test_rover=code.replace("below(0.1)", "below(0.2)"))
    _copy_project(pytester.path)
    told = pytester.runpytest_subprocess("-Werror", "-p", "no:cacheprovider").stdout
    for line in shown.splitlines():
        begin, cut, end = line.partition("...")
        pattern = begin.replace("[", "[[]") + "*" * bool(cut) + end
        told.fnmatch_lines([f"*{pattern.strip('-')}*"])


def _copy_project(folder: Path) -> None:
    for name in ("worlds/arena.wbt", "controllers/rover/rover.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text((ROOT / "examples" / name).read_text("utf-8"))


@pytest.mark.slow
def test_the_example_passes() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "examples/tests"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout


STUCK = """
from controller import Robot
from webots_mcp import MCPBridge
robot = Robot()
bridge = MCPBridge(robot)
bridge.publish({"x": 1})
robot.step(16)
while True:
    pass
"""


@pytest.mark.slow
def test_a_failure_ends_at_the_users_own_line(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(failing="exit(3)", stuck=STUCK)
    pytester.makepyfile(
        """
        import pytest

        @pytest.fixture
        def driven(webots_robot, webots_bridge, webots_recording):
            webots_robot.step(16)
            webots_bridge.publish({"front_m": 0.05})
            return webots_recording

        def test_unknown_signal(driven):
            driven.signal("front")

        def test_limit(driven):
            driven.signal("front_m").assert_never_below(0.1)

        def test_never(driven):
            driven.signal("front_m").first_time_s(3.0)

        def test_not_looked_for(driven):
            driven.find_events("stuck")

        def test_condition(driven):
            driven.held("front_m <")

        def test_world(webots_simulation):
            webots_simulation("missing.wbt")

        def test_failing_controller(webots_simulation):
            webots_simulation(controllers={"rover": "failing.py"}).run_for(0.1)

        def test_hanging_controller(webots_simulation):
            webots_simulation(controllers={"rover": "stuck.py"}).run_for(1, timeout_s=2)
        """
    )
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(failed=8)
    said = result.stdout.str()
    assert re.findall(r"^\S*webots_mcp\S*\.py:\d+:", said, re.MULTILINE) == []
    assert len(re.findall(r"^test_\w+\.py:\d+: \w+", said, re.MULTILINE)) == 8
    result.stdout.fnmatch_lines(
        [
            '>*driven.signal("front_m").assert_never_below(0.1)',
            "E*front_m fell below 0.1 in 1 of 1 rows of run 1 of robot 'rover'",
            "E*first at 0.016 s: 0.05",
        ]
    )


@pytest.mark.slow
def test_an_error_that_the_package_does_not_explain_keeps_its_frames(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile(
        """
        def test_it(webots_bridge, webots_recording):
            webots_bridge.publish({"n": 1})
            webots_recording.signal(3)
        """
    )
    said = pytester.runpytest_subprocess("-p", "no:cacheprovider").stdout.str()
    assert "recording.py:" in said


@pytest.mark.slow
def test_a_marker_that_no_parameter_takes_fails_its_test(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.webots_parameters(kpp=3.0)
        def test_bridge(webots_bridge):
            webots_bridge.publish({"n": webots_bridge.parameter("kp", 2.0).value})

        @pytest.mark.webots_parameters(kpp=3.0)
        def test_simulation(webots_simulation):
            webots_simulation(controllers={"rover": "steps.py"}).run_for(0.1)

        @pytest.mark.webots_parameters({"kp": 3.0})
        def test_written_otherwise(webots_bridge):
            pass
        """
    )
    pytester.makepyfile(
        steps="""
        from controller import Supervisor
        from webots_mcp import MCPBridge

        robot = Supervisor()
        bridge = MCPBridge(robot)
        while robot.step(16) != -1:
            bridge.publish({"n": 1})
        """
    )
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(passed=2, errors=3)
    said = result.stdout.str()
    assert said.count("webots_parameters: no controller declared kpp") >= 2
    assert "webots_parameters takes names: webots_parameters(kp=3.0)" in said


@pytest.mark.slow
def test_a_controller_that_hangs_is_named_and_the_recordings_file_too(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile(stuck=STUCK)
    pytester.makepyfile(
        """
        def test_it(webots_simulation):
            simulation = webots_simulation(controllers={"rover": "stuck.py"})
            simulation.run_for(1, timeout_s=3)
        """
    )
    result = pytester.runpytest_inprocess()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            ">*simulation.run_for(1, timeout_s=3)",
            f"E*the controller of 'rover' ({pytester.path / 'stuck.py'}, process *) "
            "does not come to its next step(); simulated time stands at 0.016 s",
            "E*not the case after 3 s; the console says:",
            "*Captured recording call*",
            "*mcp_data_1*webots.db",
        ]
    )
    result.stdout.no_fnmatch_line("*simulation.py:*: TimeoutError")


def test_a_command_that_is_not_done_says_why_in_the_failure(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def honk(command):
            raise RuntimeError("the horn of the small grey robot is gone since Tuesday")

        def test_failed(webots_robot, webots_bridge, webots_recording):
            webots_bridge.register_command("honk", honk)
            sent = webots_recording.send("honk")
            webots_robot.step(32)
            webots_bridge.get_command()
            assert sent.status == "done"

        def test_pending(webots_bridge, webots_recording):
            sent = webots_recording.send("honk")
            assert (sent.status, sent.result) == ("done", None)
        """
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(
        [
            "E*assert 'failed' (RuntimeError: the horn of the small grey robot is gone since "
            "Tuesday*) == 'done'",
            "E*'pending' (no get_command() of its controller has come to it yet) != 'done'",
        ]
    )


def test_paths_are_those_in_the_rootdir_wherever_pytest_is_started(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytester.makeini("[pytest]")
    _copy_project(pytester.path)
    pytester.path.joinpath("tests").mkdir()
    pytester.path.joinpath("tests", "test_paths.py").write_text(
        "RELATIVE = 'worlds/arena.wbt'\n"
        "def test_world(webots_simulation):\n"
        "    webots_simulation(RELATIVE, controllers={'rover': 'controllers/rover/rover.py'})\n"
        "def test_robot(webots_robot_factory):\n"
        "    assert webots_robot_factory(world=RELATIVE).getName() == 'rover'\n"
        "def test_absolute(webots_simulation, pytestconfig):\n"
        "    webots_simulation(pytestconfig.rootpath / RELATIVE)\n"
    )
    monkeypatch.chdir(pytester.path / "tests")
    pytester.runpytest_inprocess("-p", "no:cacheprovider").assert_outcomes(passed=3)


def test_no_fixture_takes_a_name_that_a_test_suite_may_use_itself(
    pytester: pytest.Pytester,
) -> None:
    text = pytester.runpytest_inprocess("--fixtures").stdout.str()
    names = re.findall(r"^(\w+) -- .*webots_mcp.testing.pytest_plugin\.py:\d+$", text, re.MULTILINE)
    assert len(names) == 7
    assert all(name.startswith("webots_") for name in names)


@pytest.mark.slow
def test_a_run_that_does_not_use_the_plugin_does_not_pay_for_it(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os
        import sys

        def test_nothing_is_loaded(pytestconfig):
            assert pytestconfig.pluginmanager.has_plugin("webots_mcp")
            loaded = [name for name in sys.modules if name.startswith("webots_mcp.")]
            assert loaded == ["webots_mcp.testing", "webots_mcp.testing.pytest_plugin"]
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
