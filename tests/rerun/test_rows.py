"""New code on a run that was recorded without a tape: what its rows suffice for, and what not."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

from tests.rerun.taping import (
    AVOID,
    WORLD,
    data_dir_of,
    project,
    record,
    recorded,
    rerun_of,
    taped_run,
)
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME, host_name
from webots_mcp.database.connection import connect
from webots_mcp.errors import NothingRecordedError
from webots_mcp.rerun.recorded_rows import make_tape
from webots_mcp.rerun.recorded_source import RecordedSource, find_source
from webots_mcp.rerun.replayed_tape import ReplayedTape, ReplayEndedError
from webots_mcp.rerun.running import Rerun, find_taped_run, rerun

pytestmark = pytest.mark.slow

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


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with a run of which each step has a row, and a tape."""
    folder = tmp_path_factory.mktemp("both")
    recorded(folder, EACH_STEP)
    return folder


@pytest.mark.parametrize(("old", "new"), EDITS)
def test_an_edit_differs_where_it_does_on_a_tape_of_the_same_run(
    old: str, new: str, both: Path
) -> None:
    edited = both / "controllers" / "rover" / "edited.py"
    edited.write_text(EACH_STEP.replace(old, new), "utf-8")
    by_tape = rerun_of(both, edited)
    tapes = data_dir_of(both) / "tapes"
    aside = tapes.rename(tapes.with_name("aside"))
    by_rows = rerun_rows(both, edited)
    aside.rename(tapes)
    assert by_tape.outcome == "differs"
    assert by_tape.basis is None
    assert (by_rows.outcome, by_rows.rounds) == ("differs", by_tape.rounds)
    assert by_rows.first_differences == by_tape.first_differences
    assert by_rows.deciding_line == by_tape.deciding_line


def test_a_command_that_no_row_has_is_compared_with_that_of_the_old_code(rows: Path) -> None:
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


def test_a_tape_is_used_where_there_is_one(both: Path) -> None:
    assert taped_run(both).basis is None
    controller = both / "controllers" / "rover" / "rover.py"
    assert rerun_of(both, controller, until_s=1.0).basis is None


COUNTED = EACH_STEP.replace("turning = 0\n", "turning = 0\nn = 0\n", 1).replace(
    "    for motor, speed", "    n += 1\n    speeds = (n % 5, n % 3)\n    for motor, speed"
)
"""Commands other velocities in each round."""


def outcome_of(folder: Path, code: str) -> Rerun:
    """Record a controller without a tape, and rerun it unchanged."""
    return rerun_rows(folder, recorded(folder, code, tape="", duration_s=1.0))


ROUNDED = "{'sensors': {'ds_left': round(left_m, 1), 'ds_right': round(right_m, 1)}}"


@pytest.mark.parametrize("attached", [True, False])
def test_values_that_the_code_publishes_as_sensors_are_not_what_it_heard(
    tmp_path: Path, *, attached: bool
) -> None:
    code = EACH_STEP.replace("    if turning", f"    bridge.publish({ROUNDED})\n    if turning")
    if not attached:
        code = code.replace("MCPBridge.attach(", "MCPBridge(")
    answer = outcome_of(tmp_path, code)
    assert (answer.outcome, answer.rounds) == ("not on the tape", 1)
    assert "the code itself publishes 'sensors'" in answer.text
    assert "a tape has these" in answer.text


def test_a_new_version_may_publish_what_it_likes(rows: Path) -> None:
    controller = rows / "controllers" / "rover" / "edited.py"
    controller.write_text(
        EACH_STEP.replace("    if turning", f"    bridge.publish({ROUNDED})\n    if turning"),
        "utf-8",
    )
    answer = rerun_rows(rows, controller)
    controller.unlink()
    assert (answer.outcome, answer.rounds) == ("equal", 500), answer.text


def test_a_step_before_the_bridge_is_named(tmp_path: Path) -> None:
    answer = outcome_of(tmp_path, EACH_STEP.replace("bridge = ", "robot.step(16)\nbridge = "))
    assert answer.outcome == "not on the tape"
    assert "the code makes 1 step before its MCPBridge, which no row has" in answer.text


@pytest.mark.parametrize("call", ["robot.step(10)", "robot.step(0)", "robot.stepBegin(16)"])
def test_a_step_that_rows_do_not_tell_is_named_and_no_lack_of_repetition(
    call: str, tmp_path: Path
) -> None:
    end = "; robot.stepEnd()" if "Begin" in call else ""
    answer = outcome_of(
        tmp_path, EACH_STEP.replace("    if turning", f"    {call}{end}\n    if turning")
    )
    assert answer.outcome == "not on the tape", answer.text
    assert f"{call} is not in the recorded rows, which have whole steps of 16 ms" in answer.text


@pytest.mark.parametrize(
    "code",
    [
        EACH_STEP.replace("while robot", "bridge.publish({'a': 1})\nwhile robot"),
        COUNTED + "    if n % 2:\n        bridge.publish({'a': 1})\n",
        COUNTED + "    bridge.publish({'pose': [1, 2, 3]})\n    bridge.publish({})\n",
        EACH_STEP + "    motors[0].setVelocity(float('nan'))\n",
    ],
    ids=["before the first step", "each second round", "names of the bridge", "refused by Webots"],
)
def test_code_that_repeats_itself_is_not_said_to_differ(code: str, tmp_path: Path) -> None:
    answer = outcome_of(tmp_path, code)
    assert answer.outcome == "equal", answer.text
    assert answer.rounds > 55


@pytest.mark.parametrize(
    "reads", ["import sys\nprint(sys.argv)", "from sys import argv", "import argparse"]
)
def test_code_that_reads_its_arguments_needs_them(reads: str, tmp_path: Path) -> None:
    recorded(tmp_path, f"{reads}\n{EACH_STEP}", tape="", duration_s=0.5)
    said = missing(tmp_path)
    assert "the arguments that the controller was started with, which controllers/rover" in said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("UPDATE run SET start_reason = 'reset'", "goes on from an earlier run in the same"),
        ("UPDATE robot SET devices = '{}'", "the classes of the devices ds_left, ds_right, left"),
        (
            "INSERT INTO parameter_value (run_id, name, sim_time_s, wall_time_s, value, is_default,"
            " set_by) VALUES (1, 'near_m', 1, 1, '0.4', 0, 'trial')",
            "the parameters near_m were set by a command",
        ),
    ],
)
def test_what_the_run_heard_elsewhere_is_missing(
    change: str, said: str, rows: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(rows, folder)
    with closing(connect(data_dir_of(folder) / DATABASE_NAME, "writer")) as connection:
        connection.execute(change)
    assert said in missing(folder)


def test_a_number_that_the_bridge_gave_a_robot_is_not_its_name(rows: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(rows, folder)
    controller = folder / "controllers" / "rover" / "named.py"
    controller.write_text(EACH_STEP.replace("turning = 0\n", "robot.getName(); turning = 0\n", 1))
    assert rerun_rows(folder, controller).outcome == "equal"
    with closing(connect(data_dir_of(folder) / DATABASE_NAME, "writer")) as connection:
        connection.execute("UPDATE robot SET name = 'rover #2'")
    assert "robot.getName() is not in the recorded rows" in rerun_rows(folder, controller).text


def git_in(folder: Path, *words: str) -> str:
    """Run git in a folder; return what it prints."""
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    command = ["git", "-C", str(folder), *identity, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def source_of(folder: Path, commit: str | None, began_s: float) -> RecordedSource:
    """Find the source of a controller that is as it was when it ran."""
    file = folder / "controllers" / "rover" / "rover.py"
    digest = hashlib.sha256(b"import limits\n").hexdigest()
    return find_source(str(file), digest, commit, began_s, folder / "mcp_data", host_name())


@pytest.fixture
def committed(tmp_path: Path) -> tuple[Path, Path, str]:
    """A project with a committed controller and module: folder, module, commit."""
    controller = project(tmp_path, "import limits\n")
    module = controller.with_name("limits.py")
    module.write_text("NEAR_M = 0.35\n", "utf-8")
    git_in(tmp_path, "init", "-q")
    git_in(tmp_path, "add", "controllers")
    git_in(tmp_path, "commit", "-q", "-m", "A rover")
    return tmp_path, module, git_in(tmp_path, "rev-parse", "HEAD")


def test_a_module_that_ran_with_uncommitted_changes_is_that_of_the_disk(
    committed: tuple[Path, Path, str],
) -> None:
    folder, module, commit = committed
    module.write_text("NEAR_M = 0.45\n", "utf-8")
    began_s = module.stat().st_ctime
    module.with_name("rover.py").write_text("print('a later edit')\n", "utf-8")
    found = source_of(folder, commit, began_s)
    assert found.texts["controllers/rover/limits.py"] == "NEAR_M = 0.45\n"
    assert "uncommitted" not in found.basis


def test_a_module_of_the_commit_may_have_been_changed_and_the_answer_says_so(
    committed: tuple[Path, Path, str],
) -> None:
    folder, module, commit = committed
    found = source_of(folder, commit, module.stat().st_mtime - 10.0)
    assert found.why_not is None
    assert found.basis.endswith(
        "with controllers/rover/limits.py as committed: wrong if they had uncommitted changes then"
    )


@pytest.mark.skipif(os.name != "posix", reason="Windows keeps no time of a file's status")
def test_a_module_that_was_moved_into_its_place_counts_as_changed(
    committed: tuple[Path, Path, str],
) -> None:
    folder, module, _ = committed
    began_s = module.stat().st_ctime
    other = folder / "limits.py"
    other.write_text("NEAR_M = 0.45\n", "utf-8")
    os.utime(other, (began_s - 1000.0, began_s - 1000.0))
    other.replace(module)
    assert module.stat().st_mtime < began_s
    why_not = source_of(folder, None, began_s).why_not or ""
    assert "limits.py, changed since the run began" in why_not


def test_what_the_bridge_answered_it_answers_again(tmp_path: Path) -> None:
    code = EACH_STEP.replace(
        "    left_m, right_m = (eye.getValue() for eye in eyes)\n",
        "    left_m, right_m = bridge.auto_publish()['sensors'].values()\n",
    )
    controller = recorded(tmp_path, code, tape="", duration_s=5.0)
    assert rerun_rows(tmp_path, controller).outcome == "equal"
    controller.with_name("edited.py").write_text(code.replace("0.35", "0.6"), "utf-8")
    assert rerun_rows(tmp_path, controller.with_name("edited.py")).outcome == "differs"


BY_PATH = "import sys\nsys.path.insert(0, '../lib')\nfrom limits import NEAR_M"
BY_NAME = """\
from importlib import import_module
try:
    NEAR_M = import_module('limits').NEAR_M
except ImportError:
    NEAR_M = 0.1
"""


@pytest.mark.parametrize(("how", "place"), [(BY_PATH, "lib"), (BY_NAME, "rover")])
def test_a_module_that_is_imported_in_another_way_is_that_of_the_run(
    how: str, place: str, tmp_path: Path
) -> None:
    controller = project(tmp_path, EACH_STEP.replace("NEAR_M = 0.35", how))
    module = tmp_path / "controllers" / place / "limits.py"
    module.parent.mkdir(exist_ok=True)
    module.write_text("NEAR_M = 0.35\n", "utf-8")
    record(tmp_path / "worlds" / WORLD.name, data_dir_of(tmp_path), 6.0, tape="")
    assert rerun_rows(tmp_path, controller).outcome == "equal"
    module.write_text("NEAR_M = 0.45\n", "utf-8")
    if place == "lib":
        assert "controllers/lib/limits.py, changed since the run began" in missing(tmp_path)
    else:  # its text of then is gone, and the rows show that another value was used
        assert rerun_rows(tmp_path, controller).outcome == "not repeatable"


def changed_copy(rows: Path, tmp_path: Path, sql: str) -> tuple[Path, Path]:
    """A copy of the recording after a statement: its folder, and its database."""
    folder = tmp_path / "copy"
    shutil.copytree(rows, folder)
    database = data_dir_of(folder) / DATABASE_NAME
    with closing(connect(database, "writer")) as connection:
        connection.execute(sql)
    return folder, database


def test_a_controller_that_began_late_hears_the_time_at_which_it_began(
    rows: Path, tmp_path: Path
) -> None:
    folder, database = changed_copy(
        rows, tmp_path, "UPDATE run SET started_sim_time_s = 0.016, steps = steps - 1"
    )
    made = make_tape(database, data_dir_of(folder), 1, tmp_path)
    replayed = ReplayedTape(made.tape)
    assert replayed.ask("robot", "Robot", "getTime", [], is_own=False) == 0.016


def test_a_velocity_that_nobody_set_is_unknown_where_the_limit_is(
    rows: Path, tmp_path: Path
) -> None:
    folder, database = changed_copy(
        rows, tmp_path, "DELETE FROM meaning WHERE name LIKE 'motors.left%'"
    )
    replayed = ReplayedTape(make_tape(database, data_dir_of(folder), 1, tmp_path).tape)
    nothing: list[float] = []
    asked = ("Motor", "getVelocity", nothing)
    assert replayed.ask("device:right wheel motor", *asked, is_own=False) > 0.0
    with pytest.raises(ReplayEndedError):
        replayed.ask("device:left wheel motor", *asked, is_own=False)
    assert "left wheel motor.getVelocity() is not in the recorded rows" in (
        replayed.unrecorded or ""
    )
