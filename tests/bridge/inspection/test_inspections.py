"""What a bridge records of its controller's variables, and answers when it is asked for them."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import math
import os
import subprocess
import sys
import threading
from collections import OrderedDict, UserDict, defaultdict, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.bridge.conftest import STEP_MS, Recording, eager
from webots_mcp import MCPBridge
from webots_mcp.bridge.inspection.inspector import MOST_INSPECTIONS
from webots_mcp.bridge.inspection.watches import MOST_WATCHED
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.secret_names import LEFT_OUT
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.inspections import inspection_at

HERE = Path(__file__).name


class Pid:
    def __init__(self) -> None:
        self.integral = 0.0
        self.api_key = "s3cr3t"


class Navigator:
    """A controller of the usual form: a class with a loop."""

    def __init__(self, robot: InProcessSupervisor, bridge: MCPBridge) -> None:
        self.robot = robot
        self.bridge = bridge
        self.pid = Pid()

    def rounds(self, count: int, then: Callable[[], object] = lambda: None) -> None:
        for turn in range(count):
            assert self.robot.step(STEP_MS) != -1
            self.pid.integral += 0.5
            self.bridge.publish({"turn": turn})
            eager(self.bridge)
            then()


@pytest.fixture
def navigator(robot: InProcessSupervisor, bridge: MCPBridge) -> Navigator:
    return Navigator(robot, bridge)


def inspections(recording: Recording) -> list[tuple[str, dict[str, Any]]]:
    """Name and data of each, in order."""
    rows = recording.rows("SELECT name, data FROM event WHERE kind = 'inspection' ORDER BY id")
    return [(name, json.loads(data)) for name, data in rows]


def frame_of(data: dict[str, Any], function: str) -> dict[str, Any]:
    return next(each for each in data["frames"] if each["function"] == function)


def test_a_hit_records_the_variables_of_each_function_and_its_source(
    navigator: Navigator, recording: Recording
) -> None:
    navigator.bridge.breakpoint("turn == 3", action="log")
    mark = "here"
    navigator.rounds(5)
    ((name, data),) = inspections(recording)
    assert (name, data["cause"]) == ("turn == 3", "breakpoint")
    inner, outer = data["frames"][:2]
    assert (inner["function"], outer["function"]) == ("rounds", mark and outer["function"])
    assert inner["at"].startswith(f"{HERE}:")
    assert inner["source"][1].strip() == 'self.bridge.publish({"turn": turn})'
    assert inner["variables"]["turn"] == 3
    assert inner["variables"]["self"]["pid"]["integral"] == 2.0
    assert inner["variables"]["self"]["pid"]["api_key"] == LEFT_OUT
    assert outer["variables"]["mark"] == "here"
    assert outer["variables"]["navigator"] == "(the same as self)"
    assert not any("pytest" in each["at"] for each in data["frames"])


def test_a_violation_records_them_too(navigator: Navigator, recording: Recording) -> None:
    navigator.bridge.expect("turn < 2", name="turns little")
    navigator.rounds(4)
    ((name, data),) = inspections(recording)
    assert (name, data["cause"]) == ("turns little", "violation")


def test_an_inspection_of_many_frames_stays_short(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    def descend(depth: int) -> None:
        words = [f"word {number}" for number in range(40)]
        if depth:
            descend(depth - 1)
        else:
            bridge.log(f"bad: {words[0]}", "error")

    descend(20)
    ((_, data),) = inspections(recording)
    assert len(data["frames"]) == 8
    assert data["frames"][0]["variables"]["words"][0] == "word 0"
    assert len(json.dumps(data)) < 3500


def test_an_object_under_the_same_name_in_two_functions_is_shown_once(
    navigator: Navigator, recording: Recording
) -> None:
    navigator.bridge.breakpoint("turn == 0", action="log")

    def outer(self: Navigator) -> None:
        self.rounds(1)

    outer(navigator)
    ((_, data),) = inspections(recording)
    assert frame_of(data, "outer")["variables"]["self"] == "(the same as above)"


def test_arming_a_breakpoint_loads_what_its_first_hit_needs(bridge: MCPBridge) -> None:
    variables = bridge._session.variables  # pyright: ignore[reportPrivateUsage]
    assert variables._inspector is None  # pyright: ignore[reportPrivateUsage]
    bridge.breakpoint("turn == 3", action="log")
    assert variables._inspector is not None  # pyright: ignore[reportPrivateUsage]


def test_of_a_breakpoint_that_flickers_the_first_hits_of_a_run_are_recorded(
    navigator: Navigator, recording: Recording
) -> None:
    navigator.bridge.breakpoint("turn == 0", action="log")
    for _ in range(MOST_INSPECTIONS + 5):
        navigator.rounds(2)
    assert len(inspections(recording)) == MOST_INSPECTIONS
    navigator.robot.simulationReset()
    navigator.rounds(3)
    assert len(inspections(recording)) == MOST_INSPECTIONS + 1


def test_of_two_breakpoints_that_are_hit_at_once_each_has_its_own_inspection(
    navigator: Navigator, recording: Recording
) -> None:
    navigator.bridge.breakpoint("turn == 0", action="log")
    navigator.bridge.breakpoint("turn <= 0", action="log", after_hits=MOST_INSPECTIONS + 1)
    for _ in range(MOST_INSPECTIONS + 1):
        navigator.rounds(2)
    rows = recording.rows("SELECT id, name FROM event WHERE kind = 'breakpoint' ORDER BY id")
    with contextlib.closing(connect(recording.database, "reader")) as connection:
        found = {number: inspection_at(connection, number) for number, _ in rows}
    assert len(rows) == MOST_INSPECTIONS + 2
    beyond = rows[-2][0]  # of the first breakpoint, at the time of the second one's only hit
    assert found.pop(beyond) is None
    assert [each and each.name for each in found.values()] == [
        name for number, name in rows if number != beyond
    ]


def test_an_error_that_is_logged_records_where_it_was_raised(
    navigator: Navigator, recording: Recording
) -> None:
    logger = logging.getLogger("navigator")
    logger.addHandler(handler := navigator.bridge.log_handler())

    def divide(by: int) -> float:
        return 1 / by

    try:
        divide(0)
    except ZeroDivisionError:
        logger.exception("no way")
    finally:
        logger.removeHandler(handler)
    ((name, data),) = inspections(recording)
    assert name.startswith("no way")
    assert data["cause"] == "error"
    assert frame_of(data, "divide")["variables"] == {"by": 0}
    assert data["frames"][0]["source"][1].strip() == "return 1 / by"


def test_an_exception_that_ends_the_controller_records_where_it_was_raised(tmp_path: Path) -> None:
    program = tmp_path / "nav.py"
    program.write_text(
        "from webots_mcp import MCPBridge\n"
        "from webots_mcp.standin import InProcessSupervisor\n"
        "bridge = MCPBridge(InProcessSupervisor('rover'), data_dir='data')\n"
        "def turn(left, token):\n"
        "    return left / 0\n"
        "turn(4, 'abc')\n",
        "utf-8",
    )
    ended = subprocess.run(
        [sys.executable, str(program)], cwd=tmp_path, check=False, capture_output=True, text=True
    )
    assert "ZeroDivisionError" in ended.stderr
    ((name, data),) = inspections(Recording(tmp_path / "data" / "webots.db"))
    assert name == "the controller ended by ZeroDivisionError: division by zero (nav.py, line 5)"
    assert data["frames"][0]["at"] == "nav.py:5"
    assert data["frames"][0]["variables"] == {"left": 4, "token": LEFT_OUT}


def test_an_attached_loop_is_seen_from_its_step(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    MCPBridge.attach(robot)
    bridge.breakpoint("time > 0.03", action="log")
    for speed in range(4):
        assert robot.step(STEP_MS) != -1, speed
    ((_, data),) = inspections(recording)
    inner = data["frames"][0]
    assert inner["source"][1].strip().startswith("assert robot.step(STEP_MS)")
    assert inner["variables"]["speed"] == 1


def test_without_code_of_its_own_nothing_is_recorded(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge._session.variables.inspector.record("hang", "somewhere", "hang", None)  # pyright: ignore[reportPrivateUsage]
    assert inspections(recording) == []


def test_source_that_was_changed_since_the_start_is_not_shown(
    bridge: MCPBridge, recording: Recording, tmp_path: Path
) -> None:
    file = tmp_path / "edited.py"
    file.write_text("def say(bridge):\n    bridge.log('bad', 'error')\n", "utf-8")
    code: dict[str, Any] = {}
    exec(compile(file.read_text("utf-8"), str(file), "exec"), code)
    later_s = file.stat().st_mtime + 3600
    os.utime(file, (later_s, later_s))
    code["say"](bridge)
    ((_, data),) = inspections(recording)
    assert data["frames"][0]["at"] == "edited.py:2"
    assert "source" not in data["frames"][0]


def test_source_lines_are_those_of_python_and_only_of_files(
    bridge: MCPBridge, recording: Recording, tmp_path: Path
) -> None:
    text = "\ufeff# a\fb\ndef say(bridge):\n    bridge.log('bad', 'error')\n"
    pipe, file = tmp_path / "pipe.py", tmp_path / "feed.py"
    os.mkfifo(pipe)  # reading it would block for ever
    file.write_text(text, "utf-8")
    for each in (file, pipe):
        os.utime(each, (1, 1))  # long before the controller started
        code: dict[str, Any] = {}
        exec(compile(text.removeprefix("\ufeff"), str(each), "exec"), code)
        code["say"](bridge)
    (_, of_file), (_, of_pipe) = inspections(recording)
    assert of_file["frames"][0]["source"] == [
        "def say(bridge):", "    bridge.log('bad', 'error')", ""
    ]  # fmt: skip
    assert "source" not in of_pipe["frames"][0]


def test_a_line_of_source_that_holds_a_secret_is_left_out(
    bridge: MCPBridge, recording: Recording, tmp_path: Path
) -> None:
    file = tmp_path / "door.py"
    file.write_text(
        "def say(bridge):\n"
        "    token = 's3cr3t'\n"
        "    bridge.log('bad', 'error')\n"
        "    token = bridge.token\n",
        "utf-8",
    )
    os.utime(file, (1, 1))  # long before the controller started
    code: dict[str, Any] = {}
    exec(compile(file.read_text("utf-8"), str(file), "exec"), code)
    with pytest.raises(AttributeError):
        code["say"](bridge)
    ((_, data),) = inspections(recording)
    assert "s3cr3t" not in json.dumps(data)
    assert data["frames"][0]["source"][0].startswith("(left out: it names a secret")
    assert data["frames"][0]["source"][2] == "    token = bridge.token"


def test_an_error_whose_traceback_is_a_property_is_recorded(
    bridge: MCPBridge, recording: Recording
) -> None:
    calls: list[str] = []

    class StrangeError(Exception):
        @property
        def __traceback__(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
            calls.append("traceback")

    def fail() -> None:
        raise StrangeError

    try:
        fail()
    except StrangeError:
        bridge.log("bad", "error")
    ((_, data),) = inspections(recording)
    assert data["frames"][0]["function"] == "fail"
    assert calls == []


def test_a_hit_where_the_stack_is_almost_full_costs_no_row(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    recording.send("watch", path="depth")
    bridge.breakpoint("spare >= 0", action="log")
    robot.step(STEP_MS)
    published: list[int] = []

    def publish(depth: int, spare: int) -> None:
        if depth:
            publish(depth - 1, spare)
        else:
            bridge.publish({"spare": spare})
            published.append(spare)

    publish(0, 1000)
    eager(bridge)
    depth = 0
    frame: Any = sys._getframe()  # pyright: ignore[reportPrivateUsage]
    while frame is not None:
        depth, frame = depth + 1, frame.f_back
    for spare in range(200, 5, -3):
        with contextlib.suppress(RecursionError):
            publish(sys.getrecursionlimit() - depth - spare, spare)
    assert len(published) > 50
    assert [state["spare"] for state in recording.states()] == published


# -- asked for -------------------------------------------------------------------------------------


def test_inspect_answers_with_the_frames_of_the_loop(
    navigator: Navigator, recording: Recording
) -> None:
    command = recording.send("inspect")
    navigator.rounds(1)
    status, result, _ = recording.fate(command)
    assert status == "done"
    loop = frame_of(result, "rounds")
    assert loop["source"][1].strip() == "eager(self.bridge)"
    assert loop["variables"]["turn"] == 0


def test_inspect_follows_a_path_while_the_loop_is_paused(
    navigator: Navigator, recording: Recording
) -> None:
    recording.send("pause")
    shown, resume = recording.send("inspect", path="self.pid"), recording.send("resume")
    navigator.rounds(1)
    _, result, _ = recording.fate(shown)
    assert result["path"] == "self.pid"
    assert result["value"] == {"<class>": "Pid", "integral": 0.5, "api_key": LEFT_OUT}
    assert recording.fate(resume)[0] == "done"


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("self.pid.integrall", "Pid has no 'integrall'; it has integral, api_key"),
        ("nobody", "there is no variable 'nobody'; "),
        ("self.pid.api_key", "'api_key' looks secret"),
        ("self..pid", "is no path from its character 5 on"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused_with_the_reason(
    navigator: Navigator, recording: Recording, path: str, why: str
) -> None:
    command = recording.send("inspect", path=path)
    navigator.rounds(1)
    status, _, error = recording.fate(command)
    assert status == "failed"
    assert error is not None and why in error


def test_another_thread_that_changes_what_is_shown_costs_no_row(
    navigator: Navigator, recording: Recording
) -> None:
    ended, busy = threading.Event(), dict[int, int]()

    def churn() -> None:
        number = 0
        while not ended.is_set():
            busy[number] = number
            busy.pop(number - 5, None)
            number += 1

    thread = threading.Thread(target=churn)
    thread.start()
    try:
        navigator.pid.integral = 0.0
        setattr(navigator, "busy", busy)  # noqa: B010
        navigator.bridge.breakpoint("turn >= 0", action="log")
        navigator.rounds(30)
    finally:
        ended.set()
        thread.join()
    assert len(recording.states()) == 30


# -- watching --------------------------------------------------------------------------------------


def test_a_watched_path_is_a_signal_until_it_is_stopped(
    navigator: Navigator, recording: Recording
) -> None:
    watch = recording.send("watch", path="self.pid.integral")
    navigator.rounds(3)
    assert recording.fate(watch)[1] == {
        "signal": "watched.self.pid.integral",
        "value": 0.5,
        "watched": ["watched.self.pid.integral"],
    }
    recording.send("watch", path="self.pid.integral", stop=True)
    navigator.rounds(2)
    watched = [state.get("watched") for state in recording.states()]
    name = "self.pid.integral"
    assert watched == [None, {name: 1.0}, {name: 1.5}, {name: 2.0}, None]


def test_conditions_see_watched_signals_and_intervals_hold(
    navigator: Navigator, recording: Recording
) -> None:
    recording.send("watch", path="self.pid.integral", every=2)
    navigator.rounds(1)
    navigator.bridge.breakpoint("watched.self.pid.integral > 2.4", action="log")
    navigator.rounds(6)
    watched = [state["watched"]["self.pid.integral"] for state in recording.states() if
               "watched" in state]  # fmt: skip
    assert watched == [1.5, 2.5, 3.5]
    assert {name for name, _ in inspections(recording)} == {"watched.self.pid.integral > 2.4"}


@pytest.mark.parametrize("path", ["self.table['x']", 'self . table["x"]', "self.rows[1]"])
@pytest.mark.parametrize("spelling", ["as the path", "as the signal"])
def test_conditions_name_items_and_keys_as_the_path_or_the_signal_does(
    navigator: Navigator, recording: Recording, path: str, spelling: str
) -> None:
    setattr(navigator, "table", {"x": 2})  # noqa: B010
    setattr(navigator, "rows", [1, 2])  # noqa: B010
    watch = recording.send("watch", path=path)
    navigator.rounds(1)
    signal = recording.fate(watch)[1]["signal"]
    name = signal if spelling == "as the signal" else f"watched.{path.replace(' ', '')}"
    navigator.bridge.breakpoint(f"{name} == 2", action="log")
    navigator.rounds(1)
    assert len(inspections(recording)) == 1
    stop = recording.send("watch", path=path, stop=True)
    navigator.rounds(2)
    assert recording.fate(stop)[1] == {"stopped": signal, "watched": []}
    assert "watched" not in recording.states()[-1]


def test_an_attached_robot_has_them_in_its_own_rows(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    MCPBridge.attach(robot)
    speed = {"left": 0}
    recording.send("watch", path="speed['left']")
    for turn in range(4):
        speed["left"] = turn
        bridge._session.control._next_poll_s = 0.0  # pyright: ignore[reportPrivateUsage]
        assert robot.step(STEP_MS) != -1
    watched = [state["watched"] for state in recording.states() if "watched" in state]
    assert watched == [{"speed.left": turn} for turn in range(4)]


def test_a_path_that_vanishes_is_null_and_named_once(
    navigator: Navigator, recording: Recording
) -> None:
    recording.send("watch", path="self.pid.integral")
    navigator.rounds(1)
    pid = navigator.pid

    def lose() -> None:
        navigator.pid = pid if navigator.bridge.stats().publish_calls % 4 == 3 else Pid()
        if navigator.pid is not pid:
            del navigator.pid.integral

    with pytest.raises(AttributeError):  # the controller itself fails on it, outside of the bridge
        navigator.rounds(3, lose)
    navigator.robot.step(STEP_MS)

    def bare_rounds(self: Navigator) -> None:
        for _ in range(3):
            self.bridge.publish({"turn": 0})

    bare_rounds(navigator)
    last = recording.states()[-3:]
    assert [state["watched"] for state in last] == [{"self.pid.integral": None}] * 3
    lines = recording.rows("SELECT message FROM log WHERE message LIKE 'watch %'")
    assert len(lines) == 1
    assert "Pid has no 'integral'" in lines[0]


def test_a_state_of_the_controller_under_that_name_stays_as_it_is(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    state: dict[str, Any] = {"watched": "by me"}
    recording.send("watch", path="state")
    for _ in range(2):
        robot.step(STEP_MS)
        bridge.publish(state)
        eager(bridge)
    assert recording.states()[-1] == {"watched": "by me"}
    assert state == {"watched": "by me"}


def test_states_of_python_s_own_kinds_of_dict_have_them_and_others_are_named_once(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    speed = 2
    recording.send("watch", path="speed")
    eager(bridge)
    states: list[Any] = [OrderedDict(a=speed), defaultdict(int, a=2), UserDict(a=3), UserDict(a=4)]
    for state in states:
        robot.step(STEP_MS)
        bridge.publish(state)
    assert [state.get("watched") for state in recording.states()] == [
        {"speed": 2}, {"speed": 2}, None, None
    ]  # fmt: skip
    lines = recording.rows("SELECT message FROM log WHERE message LIKE 'watched%'")
    assert lines == ["watched values are not recorded: a UserDict is published, not a dict"]


@pytest.mark.parametrize(
    ("path", "value"),
    [("self.pid", "<Pid>"), ("self.history", [1.0, 2.0]), ("self.table", "<dict>")],
)
def test_the_answer_to_a_watch_has_what_is_recorded(
    navigator: Navigator, recording: Recording, path: str, value: object
) -> None:
    setattr(navigator, "history", deque([1.0, 2.0]))  # noqa: B010
    setattr(navigator, "table", {"x": 1})  # noqa: B010
    watch = recording.send("watch", path=path)
    navigator.rounds(2)
    answer = recording.fate(watch)[1]
    assert answer["value"] == value
    assert ("note" in answer) == isinstance(value, str)
    assert recording.states()[-1]["watched"] == {path: value}


@pytest.mark.parametrize("every", [2, 3, 5, 7])
def test_an_interval_that_never_meets_a_recorded_state_is_recorded_with_the_next(
    robot: InProcessSupervisor, tmp_path: Path, every: int
) -> None:
    with MCPBridge(robot, data_dir=tmp_path, throttle_interval=3) as bridge:
        recording = Recording(tmp_path / DATABASE_NAME)
        recording.send("watch", path="turn", every=every)
        for turn in range(1, 60):
            robot.step(STEP_MS)
            bridge.publish({"turn": turn})
            eager(bridge)
    watched = [state["watched"]["turn"] for state in recording.states() if "watched" in state]
    gaps = {after - before for before, after in itertools.pairwise(watched)}
    assert gaps == {3 * math.ceil(every / 3)}


def test_a_list_that_another_thread_shortens_ends_no_watch(
    navigator: Navigator, recording: Recording
) -> None:
    ended, busy, table = threading.Event(), deque[int](), dict[str, int]()

    def churn() -> None:
        while not ended.is_set():
            busy.append(1)
            table["x"] = 1
            busy.pop()
            del table["x"]

    setattr(navigator, "busy", busy)  # noqa: B010
    setattr(navigator, "table", table)  # noqa: B010
    busy.append(0)
    table["x"] = 0
    for path in ("self.busy[0]", "self.table['x']", "self.busy[-1]", "self.pid.integral"):
        recording.send("watch", path=path)
    navigator.rounds(4)
    busy.clear()
    thread = threading.Thread(target=churn)
    thread.start()
    try:
        navigator.rounds(300)
    finally:
        ended.set()
        thread.join()
    watched = [state["watched"] for state in recording.states()[4:]]
    assert len(watched) == 300
    assert all(values["self.pid.integral"] is not None for values in watched)


@pytest.mark.parametrize(
    ("params", "why"),
    [
        ({}, "path"),
        ({"path": "self.nothing"}, "Navigator has no 'nothing'"),
        ({"path": "self", "every": 0}, "every must be a whole number"),
        ({"path": "self", "every": 1.5}, "every must be a whole number"),
        ({"path": "self", "stop": "yes"}, "stop must be true or false"),
        ({"path": "self", "stop": True}, "'self' is not watched; watched: none"),
    ],
)
def test_what_cannot_be_watched_is_refused(
    navigator: Navigator, recording: Recording, params: dict[str, Any], why: str
) -> None:
    command = recording.send("watch", **params)
    navigator.rounds(1)
    status, _, error = recording.fate(command)
    assert status == "failed"
    assert error is not None and why in error


def test_so_many_paths_are_watched_and_no_more(navigator: Navigator, recording: Recording) -> None:
    setattr(navigator, "many", list(range(MOST_WATCHED + 1)))  # noqa: B010
    commands = [recording.send("watch", path=f"self.many[{i}]") for i in range(MOST_WATCHED + 1)]
    navigator.rounds(MOST_WATCHED + 2)
    statuses = [recording.fate(each)[0] for each in commands]
    assert statuses == ["done"] * MOST_WATCHED + ["failed"]


# -- switched off ----------------------------------------------------------------------------------


def test_a_variable_of_the_environment_switches_all_of_it_off(
    navigator: Navigator, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEBOTS_MCP_INSPECT", "0")
    navigator.bridge.breakpoint("turn == 0", action="log")
    commands = recording.send("inspect"), recording.send("watch", path="self")
    navigator.rounds(2)
    assert inspections(recording) == []
    for each in commands:
        status, _, error = recording.fate(each)
        assert status == "failed"
        assert error is not None and "switched off by WEBOTS_MCP_INSPECT=0" in error


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[inspect]\nenabled = false\n", "switched off by"),
        ("[inspect]\nsecret = 'pid'\n", "secret must be a list of texts"),
        ("[inspect]\nhide = ['pid']\n", "holds secret and enabled, not 'hide'"),
        ("[inspect\n", "cannot be read"),
    ],
)
def test_a_project_switches_it_off_and_a_table_that_cannot_be_read_does_too(
    robot: InProcessSupervisor, tmp_path: Path, text: str, why: str
) -> None:
    (tmp_path / "webots-mcp.toml").write_text(text, "utf-8")
    with MCPBridge(robot, data_dir=tmp_path) as bridge:
        recording = Recording(tmp_path / "webots.db")
        command = recording.send("inspect")
        robot.step(STEP_MS)
        eager(bridge)
        _, _, error = recording.fate(command)
    assert error is not None and why in error


def test_a_project_names_its_own_secrets(robot: InProcessSupervisor, tmp_path: Path) -> None:
    (tmp_path / "webots-mcp.toml").write_text('[inspect]\nsecret = ["door_*"]\n', "utf-8")
    with MCPBridge(robot, data_dir=tmp_path) as bridge:
        door_code = 1234
        bridge.log("bad", "error")
    ((_, data),) = inspections(Recording(tmp_path / "webots.db"))
    assert data["frames"][0]["variables"]["door_code"] == LEFT_OUT, door_code
