"""Replays of controllers that fork, loop without end or are hostile: each ends and says how."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from tests.rerun.taping import AVOID, data_dir_of, recorded, rerun_of, taped_run
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.rerun.running import find_taped_run, rerun

pytestmark = pytest.mark.slow

LOOP = "while robot.step(step_ms) != -1:\n"
NEAR = "        turning = 20\n"


def replace(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_that_is_forked_in_the_loop_changes_nothing(tmp_path: Path) -> None:
    code = replace(AVOID, "from math", "import os\nfrom math")
    forks = "    if turning == 19 and not os.fork():\n        os._exit(0)\n"
    controller = recorded(tmp_path, replace(code, "    speeds =", forks + "    speeds ="), 8.0)
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "equal", answer.text
    assert answer.rounds == 501


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_that_goes_on_with_the_loop_ends_with_the_replay(tmp_path: Path) -> None:
    controller = recorded(tmp_path, AVOID, 2.0)
    code = replace(AVOID, "turning = 0\n", "import os\nos.fork()\nturning = 0\n")
    controller.write_text(code, "utf-8")
    began_s = time.monotonic()
    answer = rerun_of(tmp_path, controller, limit_s=60.0, stall_s=20.0)
    assert answer.outcome == "equal", answer.text
    assert time.monotonic() - began_s < 60


def test_each_of_two_robots_has_a_tape_of_its_own(tmp_path: Path) -> None:
    from tests.rerun.taping import EXAMPLES, record

    world = EXAMPLES / "tag" / "worlds" / "tag.wbt"
    record(world, data_dir_of(tmp_path), 3.0)
    data_dir = data_dir_of(tmp_path)
    taped = [find_taped_run(data_dir / DATABASE_NAME, data_dir, run) for run in (1, 2)]
    assert taped[0].tape.file != taped[1].tape.file
    assert taped[0].tape.head["session_uuid"] != taped[1].tape.head["session_uuid"]
    for each in taped:
        project = Path(each.tape.head["project"])
        answer = rerun(each, project / each.tape.head["controller"])
        assert answer.outcome == "equal", answer.text


ENDLESS = {
    "a loop without a step": "        while True:\n            pass\n",
    "a loop that catches everything": (
        "        while True:\n            try:\n                turning = turning + 1\n"
        "            except BaseException:\n                pass\n"
    ),
    "a wait that nothing ends": "        import threading\n        threading.Event().wait()\n",
    "a lock that is held": (
        "        import threading\n        lock = threading.Lock()\n"
        "        lock.acquire()\n        lock.acquire()\n"
    ),
    "a search in C": "        sum(__import__('itertools').repeat(0))\n",
}


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose controller has turned once."""
    folder = tmp_path_factory.mktemp("driven")
    recorded(folder, AVOID, 5.0)
    return folder


@pytest.mark.parametrize("loop", ENDLESS)
def test_new_code_that_never_steps_again_ends_at_its_deadline(driven: Path, loop: str) -> None:
    new = driven / "controllers" / "rover" / "endless.py"
    new.write_text(replace(AVOID, NEAR, ENDLESS[loop]), "utf-8")
    began_s = time.monotonic()
    answer = rerun_of(driven, new, limit_s=60.0, stall_s=3.0)
    assert answer.outcome == "timed out", answer.text
    assert time.monotonic() - began_s < 60
    line = new.read_text("utf-8").splitlines().index(ENDLESS[loop].splitlines()[0]) + 1
    assert "the time for the replay was over (controllers/rover/endless.py:" in answer.text
    place = int(answer.text.rpartition(":")[2].rstrip(")"))
    assert line <= place < line + 6


HOSTILE = {
    "it catches the end of the replay": (
        LOOP,
        "def steps():\n    while True:\n        try:\n            yield robot.step(step_ms)\n"
        "        except BaseException:\n            pass\n"
        "for answer in steps():\n    turning = turning + 1\n",
    ),
    "it ends the process": (NEAR, "        __import__('os')._exit(0)\n"),
    "it kills the process": (NEAR, "        import os; os.kill(os.getpid(), 9)\n"),
    "it replaces the trace": (NEAR, "        import sys; sys.settrace(None); turning = 5\n"),
    "it closes all files": (NEAR, "        import os; os.closerange(0, 200); turning = 5\n"),
    "it changes the folder": (NEAR, "        import os; os.chdir('/'); turning = 5\n"),
    "it recurses": (NEAR, "        (lambda f: f(f))(lambda f: f(f))\n"),
    "it removes modules": (NEAR, "        import sys; sys.modules.clear(); turning = 5\n"),
    "it prints much": (NEAR, "        print('x' * 5_000_000)\n        turning = 5\n"),
    "it exits": (NEAR, "        raise SystemExit(3)\n"),
    "it hides Webots' package": (
        "from controller", "import sys; sys.path[:] = []\nfrom controller"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_code_gets_an_answer_and_claims_no_equality(driven: Path, what: str) -> None:
    old, new = HOSTILE[what]
    file = driven / "controllers" / "rover" / "hostile.py"
    file.write_text(replace(AVOID, old, new), "utf-8")
    began_s = time.monotonic()
    try:
        answer = rerun_of(driven, file, limit_s=40.0, stall_s=5.0)
    except Exception as error:  # noqa: BLE001  (it must be one of ours, with a text)
        assert type(error).__module__ == "webots_mcp.errors", error
        assert "hostile.py" in str(error)
        return
    finally:
        assert time.monotonic() - began_s < 120
    assert answer.outcome != "equal", answer.text
    assert len(answer.text.splitlines()[0]) < 600


def test_a_tape_of_many_steps_is_replayed_to_its_end(tmp_path: Path) -> None:
    code = replace(AVOID, "attach(robot)", "attach(robot, throttle_interval=1000)")
    code = replace(code, LOOP, "for _ in range(6000):\n    robot.step(step_ms)\n")
    controller = recorded(tmp_path, code, 90.0)
    answer = rerun_of(tmp_path, controller)
    assert (answer.outcome, answer.of_rounds) == ("equal", answer.rounds)
    assert answer.rounds > 5000
    assert taped_run(tmp_path).tape.file.stat().st_size < 1_000_000
