"""A replay never claims that commands are equal, or differ, where the tape does not show it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.rerun.taping import AVOID, recorded, rerun_of
from webots_mcp.database.tapes.package_surface import caller_frame
from webots_mcp.database.tapes.tape import Tape, TapedCall, TapedRound
from webots_mcp.rerun.difference import Commanded, GivenCommand, differences
from webots_mcp.rerun.replayed_tape import ReplayedTape, ReplayEndedError

pytestmark = pytest.mark.slow

KEYS = TapedCall("Keyboard#1", "Keyboard", "getKey", [], "question")
LENGTH = TapedCall("device:radio", "Receiver", "getQueueLength", [], "question")
NEXT = TapedCall("device:radio", "Receiver", "nextPacket", [], "command")


class RoundOnTape(Tape):
    """A tape with one round, of given events."""

    def __init__(self, events: list[Any]) -> None:
        head: dict[str, Any] = {"devices": {}, "facts": {}, "packages": {}, "began_late": False}
        super().__init__(Path("none.tape"), head, {1: KEYS, 2: LENGTH, 3: NEXT})
        self._events = events

    def rounds(self) -> Any:
        return iter([TapedRound(0, 0.032, ("step", [32], 0), self._events)])


def replay(*events: Any) -> ReplayedTape:
    return ReplayedTape(RoundOnTape(list(events)))


def ask(tape: ReplayedTape, call: TapedCall) -> Any:
    return tape.ask(call.path, call.owner, call.name, (), is_own=False)


def test_a_key_is_answered_once_and_an_empty_keyboard_stays_empty() -> None:
    pressed = replay(1, 65)
    assert ask(pressed, KEYS) == 65
    with pytest.raises(ReplayEndedError):
        ask(pressed, KEYS)
    empty = replay(1, 65, 1, -1)
    assert [ask(empty, KEYS) for _ in range(4)] == [65, -1, -1, -1]


def test_a_receiver_answers_about_the_packet_that_is_first_in_its_queue() -> None:
    tape = replay(2, 2, 3, [[], None], 2, 1, 3, [[], None], 2, 0)
    assert [ask(tape, LENGTH), ask(tape, LENGTH)] == [2, 2]
    tape.command(NEXT.path, NEXT.owner, NEXT.name, (), caller_frame(0))
    assert [ask(tape, LENGTH), ask(tape, LENGTH)] == [1, 1]


def commanded(*names: tuple[str, list[Any]]) -> Commanded:
    made = Commanded()
    for name, arguments in names:
        made.add(GivenCommand("device:emitter", "Emitter", name, arguments, None))
    return made


def test_a_packet_before_its_channel_is_a_difference() -> None:
    old = commanded(("setChannel", [1]), ("send", ["a"]))
    new = commanded(("send", ["a"]), ("setChannel", [1]))
    (found,) = differences(old, new)
    assert str(found) == (
        "emitter in this order: 'send', 'setChannel' instead of 'setChannel', 'send'"
    )
    assert differences(old, old) == []


LOOP = "while robot.step(step_ms) != -1:\n"
SENSOR = AVOID.replace("eyes = [", "gps = robot.getDevice('gps')\neyes = [", 1)


def test_a_controller_that_does_not_end_any_more_is_told(tmp_path: Path) -> None:
    ends = AVOID.replace(LOOP, LOOP + "    if robot.getTime() > 1.0:\n        break\n")
    controller = recorded(tmp_path, ends, 0.5)
    unchanged = rerun_of(tmp_path, controller)
    assert unchanged.outcome == "equal"
    assert "goes on" not in unchanged.text
    recorded(tmp_path / "ending", ends.replace("> 1.0", "> 0.4"), 0.8)
    edited = tmp_path / "ending" / "controllers" / "rover" / "rover.py"
    assert rerun_of(tmp_path / "ending", edited).text.endswith("to the last digit")
    edited.write_text(AVOID, "utf-8")
    assert "goes on, where the recorded code ended" in rerun_of(tmp_path / "ending", edited).text


def test_the_order_of_a_set_is_the_same_for_both_versions(tmp_path: Path) -> None:
    code = AVOID.replace(
        LOOP, 'first = next(iter({"a", "b", "c", "d"}))\n' + LOOP + "    level = first == 'a'\n"
    ).replace("if turning else (SPEED, SPEED)", "if turning else (SPEED, SPEED + 0 * level)")
    controller = recorded(tmp_path, code, 0.5)
    controller.write_text(code.replace("0 * level", "0.5 * level"), "utf-8")
    found = [rerun_of(tmp_path, controller) for _ in range(3)]
    assert len({(each.outcome, each.rounds) for each in found}) == 1


def test_chance_that_an_edit_brings_in_is_not_taken_for_its_effect(tmp_path: Path) -> None:
    controller = recorded(tmp_path, AVOID, 1.0)
    chance = AVOID.replace("import inf\n", "import inf\nimport random\n").replace(
        "    speeds = ", "    SPEED = 5.0 + random.random()\n    speeds = "
    )
    controller.write_text(chance, "utf-8")
    found = rerun_of(tmp_path, controller)
    assert found.outcome == "not repeatable"
    assert found.text.startswith("The new code does not repeat itself from")
    assert "random numbers without a seed (random.random at controllers/rover/rover.py:" in (
        found.text
    )


def test_a_sensor_that_is_enabled_besides_is_no_difference(tmp_path: Path) -> None:
    controller = recorded(tmp_path, AVOID, 0.5)
    more = AVOID.replace(
        "turning = 0\n", "gps = robot.getDevice('gps')\ngps.enable(step_ms)\nturning = 0\n", 1
    )
    controller.write_text(more, "utf-8")
    assert rerun_of(tmp_path, controller).outcome == "equal"


@pytest.mark.parametrize("bridge", ["MCPBridge(robot)", "MCPBridge.attach(robot)"])
def test_a_sensor_that_is_not_enabled_any_more_is_not_answered(tmp_path: Path, bridge: str) -> None:
    plain = AVOID.replace("MCPBridge.attach(robot)", bridge)
    controller = recorded(tmp_path, plain, 0.5)
    controller.write_text(plain.replace("    eye.enable(step_ms)\n", "    pass\n"), "utf-8")
    found = rerun_of(tmp_path, controller)
    assert found.outcome == "not on the tape"
    assert "is not enabled any more" in found.text


def test_another_step_is_named_by_both_lengths(tmp_path: Path) -> None:
    controller = recorded(tmp_path, AVOID, 0.5)
    controller.write_text(AVOID.replace("robot.step(step_ms)", "robot.step(2 * step_ms)"), "utf-8")
    assert "; then robot.step 32 instead of 16" in rerun_of(tmp_path, controller).text
    controller.write_text(AVOID.replace("robot.step(step_ms)", "robot.step()"), "utf-8")
    assert rerun_of(tmp_path, controller).outcome == "equal"


def test_code_that_fails_today_says_how(tmp_path: Path) -> None:
    code = AVOID.replace(
        "SPEED = 5.0", "import os\nSPEED = float(os.environ.get('SPEED_FOR_TEST', '5'))"
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("SPEED_FOR_TEST", "4")
        controller = recorded(tmp_path, code, 0.5)
    found = rerun_of(tmp_path, controller)
    assert found.outcome == "not repeatable"
    assert "an environment variable (os.environ at controllers/rover/rover.py:" in found.text


def test_a_wrong_syntax_is_named_at_its_own_line_in_one_line(tmp_path: Path) -> None:
    controller = recorded(tmp_path, AVOID, 0.5)
    helper = controller.with_name("helper.py")
    helper.write_text("x = 1\ndef f(:\n    pass\n", "utf-8")
    controller.write_text("import helper\n" + AVOID, "utf-8")
    found = rerun_of(tmp_path, controller)
    assert found.outcome == "ended early"
    assert found.text == (
        "equal for 0 rounds until 0.000 s; then the new code ended by SyntaxError: invalid syntax "
        "(controllers/rover/helper.py:2), while the old one went on"
    )
