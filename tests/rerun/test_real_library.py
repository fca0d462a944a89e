"""Webots' own controller library: what it answered is repeated to the last digit.

Needs `WEBOTS_HOME` with the library, and the module `fake_webots`, a simulator's peer, in
`PYTHONPATH`.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.rerun.taping import data_dir_of, rerun_of, taped_run, tapes

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("fake_webots") is None or "WEBOTS_HOME" not in os.environ,
    reason="needs WEBOTS_HOME and fake_webots",
)

LOOP = """\
from math import inf
{imports}
from controller import {robot}
{bridge_import}

robot = {robot}()
{bridge}
step_ms = int(robot.getBasicTimeStep())
motors = [robot.getDevice(f"{{side}} wheel motor") for side in ("left", "right")]
eyes = [robot.getDevice(f"ds_{{side}}") for side in ("left", "right")]
gps, imu, lidar = (robot.getDevice(name) for name in ("gps", "imu", "lidar"))
for sensor in (*eyes, gps, imu, lidar):
    sensor.enable(step_ms)
for motor in motors:
    motor.setPosition(inf)
before, total = 0.0, 0.0
for rounds in range(300):
    if robot.step(step_ms) == -1:
        break
    left_m, right_m = (eye.getValue() for eye in eyes)
    x_m, y_m, _ = gps.getValues()
    yaw = imu.getRollPitchYaw()[2]
{decide}
    for motor, speed in zip(motors, speeds):
        motor.setVelocity(speed)
"""
PID = """\
    error = left_m - right_m if left_m == left_m else 0.0
    total += error * step_ms / 1000
    turn = 2.0 * error + 0.3 * total + 0.05 * (error - before)
    before = error
    speeds = (max(-9.0, min(9.0, 4.0 - turn)), max(-9.0, min(9.0, 4.0 + turn)))"""
CONTROLLERS = {
    "pid": {"decide": PID},
    "seeded": {
        "imports": "import random\nrandom.seed(3)",
        "decide": "    speeds = (random.uniform(3, 5), random.uniform(3, 5))",
    },
    "numpy": {
        "imports": "import numpy as np\nrng = np.random.default_rng(5)",
        "decide": "    speeds = np.clip(np.array([4.0, 4.0]) + rng.normal(0, 1, 2), 0, 9).tolist()",
    },
    "lidar": {
        "decide": "    ranges = lidar.getRangeImage() if rounds > 4 else [1.0]\n"
        "    speeds = (4.0, 4.0 + min(ranges) % 1)",
    },
    "properties": {
        "decide": "    speeds = (4.0 + gps.value[0] % 1, motors[0].target_velocity + 0.001)",
    },
    "supervisor": {
        "robot": "Supervisor",
        "decide": "    node = robot.getSelf()\n    x, y, _ = node.getPosition()\n"
        "    field = node.getField('translation')\n"
        "    speeds = (4.0 + x % 1, 4.0 + field.getSFVec3f()[1] % 1)",
    },
}
NOT_REPEATABLE = {
    "random numbers without a seed": {
        "imports": "import random",
        "decide": "    speeds = (random.uniform(3, 5), 4.0)",
    },
    "the wall clock": {
        "imports": "import time",
        "decide": "    speeds = (3.0 + time.time() % 1, 4.0)",
    },
    "another thread": {
        "imports": "import threading, time\nbox = [0.0]\n"
        "def count():\n    while True:\n        box[0] += 1\n        time.sleep(0.0003)\n"
        "threading.Thread(target=count, daemon=True).start()",
        "decide": "    speeds = (3.0 + box[0] % 11 / 7, 4.0)",
    },
}


def record(folder: Path, parts: dict[str, str], *, attach: bool = True) -> Path:
    """Record a controller with the real library; return it."""
    from fake_webots import FakeWebots  # type: ignore[import-not-found]

    fake: Any = FakeWebots
    how = "MCPBridge.attach(robot)" if attach else "MCPBridge(robot)"
    filled = {
        "imports": "",
        "robot": "Robot",
        "bridge_import": "from webots_mcp import MCPBridge",
        "bridge": f"bridge = {how}",
        "decide": PID,
    } | parts
    controller = folder / "controllers" / "rover" / "rover.py"
    controller.parent.mkdir(parents=True)
    (folder / "worlds").mkdir()
    controller.write_text(LOOP.format(**filled), "utf-8")
    package = Path(os.environ["WEBOTS_HOME"]) / "lib" / "controller" / "python"
    with fake(mode="fast", supervisor=True) as simulation:
        environment: dict[str, str] = {
            **simulation.environment(),
            "WEBOTS_MCP_TAPE": "images",
            "WEBOTS_MCP_DATA_DIR": str(data_dir_of(folder)),
            "PYTHONPATH": os.pathsep.join([str(package), os.environ.get("PYTHONPATH", "")]),
        }
        subprocess.run([sys.executable, str(controller)], env=environment, check=True, timeout=120)
    return controller


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("attach", [True, False])
def test_it_repeats_to_the_last_digit(tmp_path: Path, name: str, attach: bool) -> None:
    controller = record(tmp_path, CONTROLLERS[name], attach=attach)
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "equal", answer.text
    assert answer.rounds == 300
    assert not taped_run(tmp_path).tape.head["began_late"]


@pytest.mark.parametrize("cause", NOT_REPEATABLE)
def test_what_cannot_repeat_says_why(tmp_path: Path, cause: str) -> None:
    answer = rerun_of(tmp_path, record(tmp_path, NOT_REPEATABLE[cause]))
    assert answer.outcome == "not repeatable"
    assert cause in answer.text


def test_an_edit_is_found_at_its_round(tmp_path: Path) -> None:
    controller = record(tmp_path, CONTROLLERS["pid"])
    code = controller.read_text("utf-8")
    controller.write_text(
        code.replace("9.0, 4.0 - turn", "9.0, 4.0 + (rounds > 99) - turn"), "utf-8"
    )
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "differs"
    assert answer.rounds >= 100
    assert len(list(tapes(tmp_path)[0].rounds())) == 301
