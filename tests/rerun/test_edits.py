"""What an edit changes on the old run is what it changes first in a new simulation."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.rerun.taping import AVOID, recorded, rerun_of, tapes
from webots_mcp.database.tapes.tape import Tape
from webots_mcp.rerun.running import Rerun

pytestmark = pytest.mark.slow

STATEFUL = AVOID.replace(
    "turning = 0\n",
    "turning = 0\nrounds = 0\nsmooth_m = 1.0\nphase = 0\n",
    1,
).replace(
    "    if turning > 0:\n",
    "    rounds += 1\n"
    "    near_m = min(left_m, right_m)\n"
    "    smooth_m += 0.2 * (near_m - smooth_m) if near_m == near_m else 0.0\n"
    "    if turning > 0:\n",
    1,
)
# Ten edits: a threshold, a speed, a duration, a sign, a filter, a new branch, a removed line, a
# command that is not given any more, one that is new, and one that is given later.
EDITS = {
    "threshold": ("NEAR_M = 0.35", "NEAR_M = 0.45"),
    "speed": ("(-3.0, 3.0)", "(-2.5, 2.5)"),
    "duration": ("turning = 20", "turning = 19"),
    "sign": ("(-3.0, 3.0)", "(3.0, -3.0)"),
    "filter": ("min(left_m, right_m) < NEAR_M", "smooth_m < NEAR_M + 0.1"),
    "branch": (
        "    speeds = ",
        "    if rounds > 150:\n        SPEED = 4.0\n    speeds = ",
    ),
    "removed": ("        turning -= 1\n", "        turning -= 2\n"),
    "not given": (
        "        motor.setVelocity(speed)",
        "        if rounds != 111 and (rounds < 200 or motor is not motors[1]):\n"
        "            motor.setVelocity(speed)",
    ),
    "new": (
        "    speeds = ",
        "    if rounds == 90:\n        motors[0].setAcceleration(1.0)\n    speeds = ",
    ),
    "later": ("turning = 20", "turning = 20 if rounds < 120 else 30"),
}


def first_difference(old: Tape, new: Tape) -> tuple[int, float] | None:
    """Return the first round in which two runs command otherwise, and the time before it."""
    before_s = 0.0
    for number, (a, b) in enumerate(zip(held_commands(old), held_commands(new), strict=False)):
        if a[1] != b[1]:
            return number, before_s
        before_s = a[0]
    return None


def held_commands(tape: Tape) -> list[tuple[float, dict[str, object]]]:
    held: dict[str, object] = {}
    found: list[tuple[float, dict[str, object]]] = []
    for each in tape.rounds():
        for number, value in zip(each.events[::2], each.events[1::2], strict=True):
            call = tape.calls.get(number)
            if call is not None and call.kind == "command":
                held[f"{call.path}.{call.name}"] = value[0]
        found.append((each.end_s, dict(held)))
    return found


@pytest.fixture(scope="module")
def stateful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of a recorded controller that holds a state; not to be changed."""
    folder = tmp_path_factory.mktemp("stateful")
    recorded(folder, STATEFUL)
    return folder


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project of a recorded controller; not to be changed."""
    folder = tmp_path_factory.mktemp("driven")
    recorded(folder)
    return folder


def rerun_code(folder: Path, code: str, **options: float) -> Rerun:
    """Run code on the tape of a project, from a file next to the controller."""
    edited = folder / "controllers" / "rover" / "edited.py"
    edited.write_text(code, "utf-8")
    try:
        return rerun_of(folder, edited, **options)
    finally:
        edited.unlink()


@pytest.mark.parametrize("name", EDITS)
def test_the_first_difference_is_that_of_a_new_simulation(
    stateful: Path, tmp_path: Path, name: str
) -> None:
    assert EDITS[name][0] in STATEFUL
    code = STATEFUL.replace(*EDITS[name])
    answer = rerun_code(stateful, code)
    recorded(tmp_path, code)
    found = first_difference(tapes(stateful)[0], tapes(tmp_path)[0])
    assert found is not None
    assert answer.outcome == "differs", answer.text
    assert (answer.rounds, answer.until_s) == found


@pytest.mark.parametrize(
    ("edit", "line", "values"),
    [
        (("NEAR_M = 0.35", "NEAR_M = 0.45"), "elif min(left_m, right_m) < NEAR_M:", "NEAR_M"),
        (("(-3.0, 3.0)", "(-2.5, 2.5)"), "speeds = (-2.5, 2.5) if turning else", "turning"),
        (("turning = 20", "turning = 19"), "if turning > 0:", "turning"),
        (
            ("    speeds = ", "    if turning == 7:\n        turning = 0\n    speeds = "),
            "turning = 0",
            "turning",
        ),
    ],
)
def test_the_line_that_decides_is_named_with_its_values_in_both(
    driven: Path, edit: tuple[str, str], line: str, values: str
) -> None:
    answer = rerun_code(driven, AVOID.replace(*edit))
    assert answer.deciding_line is not None
    assert answer.deciding_line["text"].startswith(line)
    assert values in answer.deciding_line["new_values"]
    assert f"decided at {answer.deciding_line['place']}" in answer.text


def test_setting_a_motor_only_when_it_changes_is_no_difference(driven: Path) -> None:
    code = AVOID.replace("turning = 0\n", "turning = 0\nlast = {}\n", 1).replace(
        "        motor.setVelocity(speed)",
        "        if last.get(motor) != speed:\n            motor.setVelocity(speed)\n"
        "        last[motor] = speed",
    )
    answer = rerun_code(driven, code)
    assert answer.outcome == "equal"
    assert not answer.is_unchanged


def test_what_the_old_run_never_asked_ends_the_replay_with_its_name(driven: Path) -> None:
    code = AVOID.replace(
        "    if turning > 0:", "    robot.getDevice('gps').getSpeed()\n    if turning:"
    )
    answer = rerun_code(driven, code)
    assert answer.outcome == "not on the tape"
    assert "gps.getSpeed() was not asked in this round of the old run" in answer.text
    assert "edited.py:" in answer.text


def test_a_sensor_that_only_the_bridge_read_can_be_asked(tmp_path: Path) -> None:
    code = AVOID.replace(
        "turning = 0\n", "robot.getDevice('gps').enable(step_ms)\nturning = 0\n", 1
    )
    controller = recorded(tmp_path, code)
    controller.write_text(
        code.replace(
            "    if turning > 0:",
            "    x_m = robot.getDevice('gps').getValues()[0]\n    if turning > 0:",
        ),
        "utf-8",
    )
    assert rerun_of(tmp_path, controller).outcome == "equal"


def test_an_exception_of_the_new_code_is_the_answer(driven: Path) -> None:
    answer = rerun_code(driven, AVOID.replace("turning = 20", "turning = 20 / 0"))
    assert answer.outcome == "ended early"
    assert "ZeroDivisionError" in answer.text
    assert "edited.py:" in answer.text


def test_a_loop_without_a_step_is_ended_in_time(driven: Path) -> None:
    answer = rerun_code(
        driven, AVOID.replace("turning = 20", "\n        while True: pass"), stall_s=5.0
    )
    assert answer.outcome == "timed out"
    assert "edited.py:" in answer.text


def test_until_a_time_no_later_difference_is_found(driven: Path) -> None:
    code = AVOID.replace("NEAR_M = 0.35", "NEAR_M = 0.45")
    whole = rerun_code(driven, code)
    part = rerun_code(driven, code, until_s=whole.until_s / 2)
    assert (whole.outcome, part.outcome) == ("differs", "equal")
    assert part.until_s == pytest.approx(whole.until_s / 2, abs=0.02)
