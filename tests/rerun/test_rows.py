"""New code on a run that was recorded without a tape: what its rows suffice for, and what not."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from tests.rerun.taping import AVOID, data_dir_of, recorded, rerun_of, taped_run
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.errors import NothingRecordedError
from webots_mcp.rerun.running import Rerun, find_taped_run, rerun

EACH_STEP = AVOID.replace("attach(robot)", "attach(robot, throttle_interval=1)")
EDITS = (("NEAR_M = 0.35", "NEAR_M = 0.45"), ("turning = 20", "turning = 7"), ("5.0", "5.5"))


def rerun_rows(folder: Path, file: Path) -> Rerun:
    data_dir = data_dir_of(folder)
    return rerun(find_taped_run(data_dir / DATABASE_NAME, data_dir, 1), file)


def missing(folder: Path) -> str:
    with pytest.raises(NothingRecordedError) as caught:
        rerun_rows(folder, folder / "controllers" / "rover" / "rover.py")
    return str(caught.value)


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a run of which each step has a row, and no tape."""
    folder = tmp_path_factory.mktemp("rows")
    recorded(folder, EACH_STEP, tape="")
    return folder


def test_unchanged_code_repeats_and_the_answer_names_what_it_rests_on(rows: Path) -> None:
    answer = rerun_rows(rows, rows / "controllers" / "rover" / "rover.py")
    assert answer.outcome == "equal"
    assert answer.is_unchanged
    assert answer.rounds == 500
    assert "(no tape: this rests on 500 recorded rows, one for each step" in answer.text
    assert "not rounded" in answer.text
    assert "recorded hash" in answer.text


@pytest.mark.parametrize(("old", "new"), EDITS)
def test_an_edit_differs_where_it_does_on_a_tape_of_the_same_run(
    old: str, new: str, tmp_path: Path
) -> None:
    controller = recorded(tmp_path, EACH_STEP)
    edited = controller.with_name("edited.py")
    edited.write_text(EACH_STEP.replace(old, new), "utf-8")
    by_tape = rerun_of(tmp_path, edited)
    shutil.rmtree(data_dir_of(tmp_path) / "tapes")
    by_rows = rerun_rows(tmp_path, edited)
    assert by_tape.outcome == "differs"
    assert by_tape.basis is None
    assert (by_rows.outcome, by_rows.rounds) == ("differs", by_tape.rounds)
    assert by_rows.first_differences == by_tape.first_differences
    assert by_rows.deciding_line == by_tape.deciding_line


def test_a_command_that_no_row_has_is_compared_with_that_of_the_old_code(
    rows: Path, tmp_path: Path
) -> None:
    shutil.copytree(rows, tmp_path / "copy")
    controller = rows / "controllers" / "rover" / "edited.py"
    controller.write_text(
        EACH_STEP.replace("turning = 20", "turning = 20; robot.setCustomData('near')"), "utf-8"
    )
    answer = rerun_rows(rows, controller)
    controller.unlink()
    assert answer.outcome == "differs"
    assert "robot.setCustomData 'near' instead of nothing" in answer.text


def test_a_throttled_run_names_the_share_of_steps_that_have_a_row(tmp_path: Path) -> None:
    sets = "import os\nos.environ['WEBOTS_MCP_THROTTLE_INTERVAL'] = '5'\n"
    recorded(tmp_path, sets + AVOID, tape="", duration_s=2.0)
    said = missing(tmp_path)
    assert "of 125 steps have one; record with throttle_interval=1" in said
    assert "Record with a tape" in said


def test_what_the_rows_do_not_have_ends_the_replay_with_its_name(tmp_path: Path) -> None:
    code = EACH_STEP.replace(
        "robot = Robot()", "robot = Robot()\nlidar = robot.getDevice('lidar')\nlidar.enable(16)"
    ).replace("    if turning", "    ranges = lidar.getRangeImage()\n    if turning")
    answer = rerun_rows(tmp_path, recorded(tmp_path, code, tape="", duration_s=1.0))
    assert answer.outcome == "not on the tape"
    assert "lidar.getRangeImage() is not in the recorded rows" in answer.text


def test_code_that_draws_without_a_seed_does_not_repeat_the_rows(tmp_path: Path) -> None:
    code = EACH_STEP.replace("SPEED)\n    for", "SPEED - random.random())\n    for")
    code = code.replace("from math import inf", "import random\nfrom math import inf")
    answer = rerun_rows(tmp_path, recorded(tmp_path, code, tape="", duration_s=1.0))
    assert answer.outcome == "not repeatable"
    assert "random numbers without a seed" in answer.text


def test_rows_that_the_controller_publishes_itself_serve_too(tmp_path: Path) -> None:
    code = EACH_STEP.replace(
        "    for motor, speed", "    bridge.publish({'turning': turning})\n    for motor, speed"
    )
    answer = rerun_rows(tmp_path, recorded(tmp_path, code, tape="", duration_s=6.0))
    assert answer.outcome == "equal", answer.text
    assert answer.rounds > 370


def test_a_sensor_that_answers_nan_at_first_is_as_it_was(tmp_path: Path) -> None:
    code = EACH_STEP.replace("eye.enable(step_ms)", "eye.enable(4 * step_ms)").replace(
        "    if turning > 0", "    if left_m != left_m:\n        turning = 3\n    if turning > 0"
    )
    answer = rerun_rows(tmp_path, recorded(tmp_path, code, tape="", duration_s=2.0))
    assert answer.outcome == "equal", answer.text


def test_a_motor_that_the_code_never_sets_is_no_difference(tmp_path: Path) -> None:
    code = EACH_STEP.replace('for side in ("left", "right")]\neyes', 'for side in ("left",)]\neyes')
    answer = rerun_rows(tmp_path, recorded(tmp_path, code, tape="", duration_s=2.0))
    assert answer.outcome == "equal", answer.text
    assert answer.rounds == 125


def test_code_that_does_not_set_what_the_rows_have_does_not_repeat_them(
    rows: Path, tmp_path: Path
) -> None:
    """As where the rows are those of another source: the hash of the session is changed."""
    folder = tmp_path / "copy"
    shutil.copytree(rows, folder)
    controller = folder / "controllers" / "rover" / "rover.py"
    controller.write_text(EACH_STEP.replace("(-3.0, 3.0)", "(-3.5, 3.0)"), "utf-8")
    digest = hashlib.sha256(controller.read_bytes()).hexdigest()
    with closing(connect(data_dir_of(folder) / DATABASE_NAME, "writer")) as connection:
        connection.execute(
            "UPDATE session SET controller = ?, controller_sha256 = ?", (str(controller), digest)
        )
    answer = rerun_rows(folder, controller)
    assert answer.outcome == "not repeatable"
    assert "it sets left wheel motor.setVelocity -3.5 instead of -3.0" in answer.text


def test_parameters_that_it_began_with_are_given_again(tmp_path: Path) -> None:
    code = EACH_STEP.replace(
        "throttle_interval=1)", "throttle_interval=1)\nnear = bridge.parameter('near_m', 0.2)"
    ).replace("< NEAR_M", "< near.value")
    controller = recorded(tmp_path, code, tape="", parameters={"near_m": 0.5})
    answer = rerun_rows(tmp_path, controller)
    assert answer.outcome == "equal", answer.text
    assert "Missing" not in answer.text


def test_parameters_set_by_a_command_are_missing_by_name(rows: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(rows, folder)
    with closing(connect(data_dir_of(folder) / DATABASE_NAME, "writer")) as connection:
        connection.execute(
            "INSERT INTO parameter_value (run_id, name, sim_time_s, wall_time_s, value, "
            "is_default, set_by) VALUES (1, 'near_m', 1, 1, '0.4', 0, 'command')"
        )
    assert "the parameters near_m were set by a command" in missing(folder)


def test_a_source_that_was_changed_is_taken_from_the_commit_or_named(tmp_path: Path) -> None:
    def git(*words: str) -> None:
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *words], check=True)

    git("init", "-q")
    helper = tmp_path / "controllers" / "rover" / "limits.py"
    helper.parent.mkdir(parents=True)
    helper.write_text("NEAR_M = 0.35\n", "utf-8")
    code = EACH_STEP.replace("NEAR_M = 0.35", "from limits import NEAR_M")
    shutil.rmtree(helper.parents[1])
    controller = recorded_with(tmp_path, code, helper, "NEAR_M = 0.35\n", git)
    assert rerun_rows(tmp_path, controller).outcome == "equal"
    helper.write_text("NEAR_M = 0.45\n", "utf-8")
    os.utime(helper)
    answer = rerun_rows(tmp_path, controller)
    assert answer.outcome == "differs"
    assert "the controller as in the commit" in answer.text
    with closing(connect(data_dir_of(tmp_path) / DATABASE_NAME, "writer")) as connection:
        connection.execute("UPDATE session SET git_commit = NULL")
    assert "controllers/rover/limits.py, changed since the run began" in missing(tmp_path)
    controller.write_text(AVOID, "utf-8")
    assert "rover.py was changed since or is gone" in missing(tmp_path)


def recorded_with(folder: Path, code: str, helper: Path, text: str, git: object) -> Path:
    """Record a controller with a module next to it, both committed."""
    from tests.rerun.taping import WORLD, project, record

    controller = project(folder, code)
    helper.write_text(text, "utf-8")
    assert callable(git)
    git("add", "controllers")
    git("commit", "-q", "-m", "A rover")
    record(folder / "worlds" / WORLD.name, data_dir_of(folder), 6.0, tape="")
    return controller


def test_the_command_takes_the_newest_run_where_none_has_a_tape(
    rows: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rerun", "--data-dir", str(data_dir_of(rows))]) in (0, None)
    assert "no tape: this rests on" in " ".join(capsys.readouterr().out.split())


def test_a_tape_is_used_where_there_is_one(tmp_path: Path) -> None:
    controller = recorded(tmp_path, EACH_STEP, duration_s=1.0)
    assert taped_run(tmp_path).basis is None
    assert rerun_of(tmp_path, controller).basis is None
