"""What is known of Webots from its sources alone, each as a check of a Webots that runs.

docs/webots.md names for each of its statements the check that would confirm it. A check returns
what it measured, or raises `OtherwiseError` with what it saw, or `NotTriedError`.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from PIL import Image

from webots_mcp.contract import CUSTOM_DATA, OBSERVER_NAME
from webots_mcp.errors import CommandRefusedError
from webots_mcp.plugins.prove.bench import (
    ROVER,
    SOON_S,
    SPEAKER,
    Bench,
    Moment,
    NotTriedError,
    OtherwiseError,
)
from webots_mcp.questions.answers import ShownPicture
from webots_mcp.questions.control_simulation import webots_run, webots_simulation_control
from webots_mcp.questions.edit_scene import (
    webots_add_node,
    webots_get_field,
    webots_get_scene,
    webots_remove_node,
    webots_set_field,
)
from webots_mcp.questions.send_command import (
    webots_breakpoint,
    webots_remove_breakpoint,
    webots_send_command,
)
from webots_mcp.questions.show_pictures import webots_get_camera, webots_take_screenshot
from webots_mcp.webots import PORTS_TRIED, find_webots
from webots_mcp.webots.orders import (
    ANSWER_S,
    OrderReply,
    begin_console,
    connected,
    console_lines,
    give_order,
    load_world,
)
from webots_mcp.webots.starting import CommandLine, KeptProgram, free_port

_STEP_S: Final = 0.016
_TIME_TOLERANCE_S: Final = 1e-6
_LONGEST_S: Final = 60.0  # of most checks, beside a start of Webots
_TRIALS_S: Final = 240.0
_LOAD_S: Final = 40.0  # until a world is there again
_STALL_S: Final = 6.0
_EXIT_STATUS: Final = 7
_MASS: Final = "BALL.physics.mass"
_BOX: Final = 'DEF PROVE_BOX Solid { translation 1 1 0.1 name "prove box" }'


@dataclass(frozen=True)
class Check:
    """Something that Webots' sources say.

    Attributes:
        name: As docs/webots.md names it.
        function: Tries it.
        expected: What the sources say.
        otherwise: What works still where that is not so.
        limit_s: In so much wall time, besides that of a start, it is over, or hangs.
    """

    name: str
    function: Callable[[Bench], str | None]
    expected: str
    otherwise: str
    limit_s: float


CHECKS: Final[list[Check]] = []
# What no program can try without a person, or without doing harm, and why.
NOT_TRIED: Final = {
    "keys": "keys reach a window only, and Webots was started without one",
    "preferences": "a project's runtime.ini decides here, so that any Webots starts this Python",
    "scene stream": "it would pause the simulation of whoever sends it, and is never sent",
}


def _check(
    name: str, expected: str, otherwise: str, limit_s: float = _LONGEST_S
) -> Callable[[Callable[[Bench], str | None]], Callable[[Bench], str | None]]:
    def declare(function: Callable[[Bench], str | None]) -> Callable[[Bench], str | None]:
        CHECKS.append(Check(name, function, expected, otherwise, limit_s))
        return function

    return declare


# -- starting it --


@_check("installed", "version.txt in its home names the release", "set WEBOTS_HOME to its folder")
def _installed(bench: Bench) -> str:
    found = find_webots()
    if found.version is None:
        raise OtherwiseError(f"no version next to the program that {found.found_by} names")
    return f"{found.version}, by {found.found_by}"


@_check("options", "an unknown option ends it with a word and an exit code", "launch shows it")
def _options(bench: Bench) -> str:
    command = [str(find_webots().program), "--batch", "--no-such-option"]
    program = KeptProgram(CommandLine(command, []), {}, subprocess.DEVNULL, subprocess.DEVNULL)
    try:
        program.start()
        code = bench.until(lambda: program.exit_code, "it did not end with a code")
    finally:
        program.end()
    return f"exit code {code}"


@_check("launch", "it takes our options, and its controllers record", "open the world by hand")
def _launch(bench: Bench) -> str:
    began_s = time.monotonic()
    bench.webots()
    mode = bench.rover().state["simulation_mode"]
    if mode != "real_time":
        raise OtherwiseError(f"--mode=realtime began in {mode}")
    return f"all controllers recorded after {time.monotonic() - began_s:.1f} s"


@_check("display", "xvfb-run gives it a display where there is none", "set DISPLAY")
def _display(bench: Bench) -> str:
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        raise NotTriedError("there is a display here, or none is needed")
    bench.webots()
    return "by xvfb-run"


@_check("process", "its program has a known name, and listens at --port", "recording needs neither")
def _process(bench: Bench) -> str:
    webots = bench.webots()
    bench.until(lambda: webots.address_now(), "no Webots was seen to listen among its processes")
    assert webots.instance is not None
    return f"program seen, {'port shown' if webots.instance.is_listening else 'port not shown'}"


@_check("python", "COMMAND of runtime.ini starts controllers", "doctor says which Python ran")
def _python(bench: Bench) -> None:
    bench.webots()
    used = Path(bench.rover().state["python"])
    if used.resolve() != Path(sys.executable).resolve():
        raise OtherwiseError(f"the controller ran in {used}")


@_check("output", "--stdout and --stderr show what controllers print", "the console has it as well")
def _output(bench: Bench) -> None:
    bench.running()
    webots = bench.webots()
    _say(bench, "printed for prove")
    streams = bench.until(
        lambda: [line.stream for line in webots.lines if line.text == "printed for prove"],
        "the line of a controller did not come whole",
    )
    bench.until(lambda: len(streams) > 1 or len(_printed(bench)) > 1, "only one of two lines came")


def _printed(bench: Bench) -> list[str]:
    return [line.stream for line in bench.webots().lines if line.text == "printed for prove"]


def _say(bench: Bench, text: str) -> None:
    bench.ask(webots_send_command, action="say", params={"text": text}, robot=ROVER)


# -- the WebSocket without --stream --


@_check("console", "its console is sent to who asks, also without --stream", "start with --stream")
def _console(bench: Bench) -> str:
    bench.running()
    seen = list[str]()
    with connected(bench.address(), ANSWER_S) as stream:
        begin_console(stream)
        _say(bench, "heard by prove")
        until_s = time.monotonic() + SOON_S
        while time.monotonic() < until_s and sum("heard by prove" in each for each in seen) < 2:
            message = stream.receive(time.monotonic() + ANSWER_S)
            lines = console_lines(message.text) if message else ()
            seen += [f"{line.stream}:{line.text}" for line in lines]
    whole = [line.partition(":")[0] for line in seen if line.endswith(":heard by prove")]
    if len(whole) < 2:
        raise OtherwiseError(f"of two lines came {whole}: {seen[-5:]}")
    starts = [line for line in seen if line.startswith("stdout:INFO: rover: Starting controller: ")]
    if not starts:
        raise OtherwiseError(f"no line says that a controller was started: {seen[:5]}")
    return f"{len(seen)} lines, without the name of who printed them; two by {' and '.join(whole)}"


@_check("no orders", "without --stream only a ping is answered", "orders are not obeyed, as said")
def _no_orders(bench: Bench) -> None:
    bench.running()
    reply = give_order(bench.address(), "pause")
    if reply.text is not None or not reply.is_alive:
        raise OtherwiseError(f"answer {reply.text!r}, ping answered: {reply.is_alive}")
    bench.goes_on("an order was sent that Webots is not to obey")


# -- steering by a Supervisor --


@_check("pause", "a Supervisor pauses, and resumes, with step(0)", "press play in Webots")
def _pause(bench: Bench) -> None:
    bench.running()
    _pause_rover(bench)
    bench.ask(webots_simulation_control, command="resume", robot=ROVER)
    bench.goes_on("resume was done")


def _pause_rover(bench: Bench) -> Moment:
    bench.ask(webots_simulation_control, command="pause", robot=ROVER)
    bench.stands("pause was done")
    return bench.rover()


@_check("steps", "as many rounds as were asked for, then a pause again", "the answer says how many")
def _steps(bench: Bench) -> None:
    bench.running()
    before = _pause_rover(bench)
    bench.ask(webots_simulation_control, command="step", steps=3, robot=ROVER)
    bench.stands("3 steps were done")
    _require_rounds(before, bench.rover(), 3)


def _require_rounds(before: Moment, now: Moment, rounds: int) -> None:
    made, went_s = now.state["rounds"] - before.state["rounds"], now.sim_time_s - before.sim_time_s
    if made != rounds or abs(went_s - rounds * _STEP_S) > _TIME_TOLERANCE_S:
        raise OtherwiseError(f"{made} rounds in {went_s:g} s, not {rounds}")


@_check("fast", "fast mode is faster than real time", "time goes on in the old mode")
def _fast(bench: Bench) -> str:
    bench.running()
    bench.ask(webots_simulation_control, command="fast", robot=ROVER)
    bench.until(
        lambda: bench.rover().state["simulation_mode"] == "fast", "the mode is not seen as fast"
    )
    before, began_s = bench.rover(), time.monotonic()
    bench.until(lambda: bench.rover().sim_time_s > before.sim_time_s + 2, "2 s did not pass")
    factor = (bench.rover().sim_time_s - before.sim_time_s) / (time.monotonic() - began_s)
    bench.ask(webots_simulation_control, command="resume", robot=ROVER)
    return f"{factor:.1f} times real time"


@_check("run", "a run stops at the very step of its condition or time", "it pauses a step later")
def _run(bench: Bench) -> None:
    bench.running()
    before = _pause_rover(bench)
    bench.ask(webots_run, for_s=20 * _STEP_S, robot=ROVER)
    _require_rounds(before, bench.rover(), 20)
    goal = before.state["rounds"] + 50
    bench.ask(webots_run, until=f"rounds >= {goal}", for_s=20.0, robot=ROVER)
    bench.stands("the run was done")
    _require_rounds(before, bench.rover(), 50)


@_check("breakpoint", "a hit pauses at the very step", "it pauses a step later")
def _breakpoint(bench: Bench) -> None:
    before = bench.running()
    goal = before.state["rounds"] + 100
    set_up = bench.ask(webots_breakpoint, condition=f"rounds >= {goal}", robot=ROVER)
    try:
        bench.until(lambda: bench.rover().state["rounds"] >= goal, "its step never came")
        bench.stands("a breakpoint was hit")
        _require_rounds(before, bench.rover(), 100)
    finally:
        number = set_up["breakpoint_id"]
        bench.ask(webots_remove_breakpoint, breakpoint_id=number, robot=ROVER)


@_check("screenshot", "exportImage writes the main view, also headless", "ask cameras instead")
def _screenshot(bench: Bench) -> str:
    bench.running()
    return _size_of(bench.ask(webots_take_screenshot, robot=ROVER, timeout_wall_s=30.0))


@_check("camera", "cameras see with --no-rendering", "start it with its window")
def _camera(bench: Bench) -> str:
    bench.running()
    return _size_of(bench.ask(webots_get_camera, camera="camera", fresh=True, robot=ROVER))


def _size_of(shown: list[str | ShownPicture]) -> str:
    (data,) = (each.data for each in shown if isinstance(each, ShownPicture))
    with Image.open(BytesIO(data)) as image:
        darkest, brightest = image.convert("L").getextrema()
        if darkest == brightest:
            raise OtherwiseError(f"a picture of {image.width} x {image.height} in a single colour")
        return f"{image.width} x {image.height} pixels"


# -- the scene --


@_check("field", "a field is set with the next step, also in a pause", "the answer reads it back")
def _field(bench: Bench) -> None:
    bench.running()
    _pause_rover(bench)
    wanted = [-0.3, 0.5, 0.06]
    bench.ask(webots_set_field, path="CRATE.translation", value=wanted, robot=ROVER)
    bench.ask(webots_simulation_control, command="step", steps=2, robot=ROVER)
    held = _value_of(bench, "CRATE.translation")
    if any(abs(a - b) > 0.01 for a, b in zip(held, wanted, strict=True)):
        raise OtherwiseError(f"two steps later it holds {held}, not {wanted}")


def _value_of(bench: Bench, path: str) -> Any:
    return bench.ask(webots_get_field, path=path, robot=ROVER)["result"]["value"]


@_check("nodes", "a node is added and removed at once; bad text adds none", "entries are counted")
def _nodes(bench: Bench) -> None:
    bench.running()
    bench.ask(webots_add_node, vrml=_BOX, robot=ROVER)
    if not _has_box(bench):
        raise OtherwiseError("a node that was added is not in the scene")
    bench.ask(webots_remove_node, path="PROVE_BOX", robot=ROVER)
    if _has_box(bench):
        raise OtherwiseError("a node that was removed is in the scene")
    with contextlib.suppress(OtherwiseError):
        bench.ask(webots_add_node, vrml="DEF PROVE_BOX Solidd { }", robot=ROVER)
        raise AssertionError("a node of an unknown type was added")
    bench.goes_on("a bad node was refused")


def _has_box(bench: Bench) -> bool:
    found = bench.ask(webots_get_scene, names=["PROVE_BOX"], robot=ROVER)
    return "prove box" in json.dumps(found["result"])


@_check("reset", "time goes back to 0 in the same process, poses come back", "a new run, or a hint")
def _reset(bench: Bench) -> None:
    before = bench.running()
    bench.ask(webots_add_node, vrml=_BOX, robot=ROVER)
    bench.ask(webots_set_field, path="CRATE.translation", value=[1, -1.5, 0.06], robot=ROVER)
    now = _reset_rover(bench)
    if (now.pid, now.start_reason) != (before.pid, "reset"):
        raise OtherwiseError(f"another process, or a run that began by {now.start_reason!r}")
    if _has_box(bench):
        raise OtherwiseError("a node that was added is there after a reset")
    place = _value_of(bench, "CRATE.translation")
    if abs(place[0] + 0.3) > 0.05:
        raise OtherwiseError(f"the crate is at {place} after a reset")


def _reset_rover(bench: Bench) -> Moment:
    before = bench.rover()
    bench.ask(webots_simulation_control, command="reset", robot=ROVER)
    bench.until(lambda: bench.rover().run_id > before.run_id, "no new run began after a reset")
    return bench.rover()


@_check("put back", "a reset leaves a field that was set; the bridge sets it back", "reload")
def _put_back(bench: Bench) -> str:
    bench.running()
    mass = _value_of(bench, _MASS)
    bench.ask(webots_set_field, path=_MASS, value=2 * mass, robot=ROVER)
    bench.goes_on("a mass was set")
    if abs(_value_of(bench, _MASS) - 2 * mass) > _TIME_TOLERANCE_S:
        raise OtherwiseError("a mass that was set is not held")
    run = _reset_rover(bench).run_id
    bench.goes_on("a reset was done")
    if abs(_value_of(bench, _MASS) - mass) > _TIME_TOLERANCE_S:
        raise OtherwiseError("the mass is not set back after a reset")
    by_bridge = bench.rows("SELECT 1 FROM event WHERE kind = 'put_back' AND run_id = ?", run)
    if not by_bridge:
        raise OtherwiseError("Webots' reset has set the mass back by itself")
    return "by the bridge"


@_check("motors", "wheels turn on after a reset, as the bridge asks for it", "on_reload callbacks")
def _motors(bench: Bench) -> None:
    bench.running()
    _reset_rover(bench)
    before = bench.rover()
    bench.until(
        lambda: abs(bench.rover().state["wheel_rad"] - (before.state["wheel_rad"] or 0)) > 0.05,
        "the wheel stands still after a reset",
    )


@_check("proto", "the inside of a PROTO can be read and not be set", "it is said to be not there")
def _proto(bench: Bench) -> None:
    bench.running()
    path = "SIGN.children[0].geometry.size"
    if [round(each, 3) for each in _value_of(bench, path)] != [0.1, 0.2, 0.3]:
        raise OtherwiseError("the size of the box in it is not that of its file")
    with contextlib.suppress(OtherwiseError):
        bench.ask(webots_set_field, path=path, value=[1, 1, 1], robot=ROVER)
        raise AssertionError("the inside of a PROTO was set")


# -- the observer --


@_check("observer", "poses come with its steps, of robots in PROTO nodes too", "each is asked for")
def _observer(bench: Bench) -> str:
    bench.running()
    bench.since_start(OBSERVER_NAME)

    def robots() -> set[str]:
        return set(bench.since_start(OBSERVER_NAME).state.get("world", {}))

    bench.until(lambda: {"ROVER", "inner"} <= robots(), f"of the robots it sees {robots()}")
    seen = bench.since_start(OBSERVER_NAME)
    rows = bench.rows(
        "SELECT json_extract(data, '$.x_m') FROM state WHERE run_id = ? "
        "ORDER BY abs(sim_time_s - ?) LIMIT 1",
        bench.rover().run_id,
        seen.sim_time_s,
    )
    apart_m = abs(rows[0][0] - seen.state["world"]["ROVER"]["x_m"])
    if apart_m > 0.02:
        raise OtherwiseError(f"its x of the rover is {apart_m:.3f} m beside the rover's own")
    return f"{apart_m * 1000:.1f} mm from the rover's own position"


@_check("observer time", "answers to step(0) have the time and the poses", "it makes steps instead")
def _observer_time(bench: Bench) -> str:
    bench.running()
    before = bench.since_start(OBSERVER_NAME)
    wanted = before.sim_time_s + 2

    def later() -> Moment | None:
        now = bench.newest(OBSERVER_NAME)
        return now if now and now.sim_time_s >= wanted else None

    bench.until(later, "it recorded no 2 s")
    times = bench.rows(
        "SELECT sim_time_s FROM state WHERE run_id = ? AND sim_time_s >= ? ORDER BY id",
        before.run_id,
        before.sim_time_s,
    )
    longest_s = max(b[0] - a[0] for a, b in pairwise(times))
    if longest_s > 1.0:
        raise OtherwiseError(f"its rows are up to {longest_s:.2f} s apart, not 0.1")
    return f"rows at most {longest_s:.3f} s apart"


@_check("customData", "an observer reads it of a robot without a bridge", "attach a bridge")
def _custom_data(bench: Bench) -> str:
    bench.running()
    before = bench.since_start(SPEAKER)
    kinds = bench.rows("SELECT kind FROM robot WHERE name = ?", SPEAKER)
    if kinds != [(CUSTOM_DATA,)]:
        raise OtherwiseError(f"the robot is of the kind {kinds}")
    bench.until(
        lambda: (now := bench.newest(SPEAKER)) and now.state["seq"] > before.state["seq"] + 20,
        "its messages do not go on",
    )
    now = bench.since_start(SPEAKER)
    if now.state["twice"] != 2 * now.state["seq"]:
        raise OtherwiseError(f"a text was read in parts: {now.state}")
    return f"{now.state.get('seq_missed', 0)} of {now.state['seq']} messages missed"


@_check("hang", "a loop that hangs is told with its place, and goes on", "status says silent")
def _hang(bench: Bench) -> str:
    bench.running()
    bench.ask(
        webots_send_command, may_be_under_way=True, action="stall", robot=ROVER,
        params={"seconds": _STALL_S}, timeout_wall_s=1.0,
    )  # fmt: skip

    def place() -> str | None:
        with bench.recording.view(ROVER) as view:
            why = view.header().get("why") or ""
        return why if "stall" in why and "rover.py" in why else None

    said = bench.until(place, "its place was not told") or ""
    bench.until(lambda: bench.moves(1.0), "it does not go on after a hang", 3 * _STALL_S)
    return said


# -- reloading and ending --


@_check("reload", "controllers are started anew, with the code as it is now", "start them by hand")
def _reload(bench: Bench) -> None:
    before = bench.running()
    bench.ask(webots_simulation_control, command="reload", robot=ROVER, timeout_wall_s=_LOAD_S)
    _wait_for_session_after(bench, before)
    ended = bench.rows("SELECT end_reason FROM session WHERE id = ?", before.session_id)
    if ended != [("reload",)]:
        raise OtherwiseError(f"the session before ended as {ended}")


def _wait_for_session_after(bench: Bench, before: Moment) -> Moment:
    bench.until(
        lambda: bench.rover().session_id > before.session_id, "no controller began anew", _LOAD_S
    )
    return bench.rover()


@_check("quit", "simulationQuit ends it with its status; step() is -1", "launch has another code")
def _quit(bench: Bench) -> None:
    before, webots = bench.running(), bench.webots()
    bench.ask(
        webots_send_command, may_be_under_way=True, action="leave", robot=ROVER,
        params={"status": _EXIT_STATUS}, timeout_wall_s=5.0,
    )  # fmt: skip
    bench.until(lambda: webots.is_over, "it did not end", 2 * _LONGEST_S / 3)
    if webots.exit_code != _EXIT_STATUS:
        raise OtherwiseError(f"it ended with {webots.exit_code}, not {_EXIT_STATUS}")
    _require_finished(bench, before)


def _require_finished(bench: Bench, last: Moment) -> None:
    """Its loop saw -1, and the bridge closed; a process that was killed is found as crashed."""
    ended = bench.rows("SELECT end_reason FROM session WHERE id = ?", last.session_id)
    if ended != [("finished",)]:
        raise OtherwiseError(f"step() did not return -1 in time: the session ended as {ended}")


@_check("terminate", "a signal, or closing it, lets it quit: step() is -1", "it is killed")
def _terminate(bench: Bench) -> None:
    before = bench.running()
    bench.end()
    _require_finished(bench, before)


@_check("layout", "headless it leaves the layout of its window alone", "a .wbproj has changed")
def _layout(bench: Bench) -> None:
    bench.end()
    written = [file.name for file in bench.world.parent.glob(".*.wbproj")]
    if written:
        raise OtherwiseError(f"it wrote {', '.join(written)}")


# -- the WebSocket with --stream, and pauses by hand --


@_check("port taken", "where --port is taken it takes one of the next ten", "it says so and ends")
def _port_taken(bench: Bench) -> str:
    port = free_port()
    with socket.create_server(("", port)):
        bench.webots(stream=True, port=port)
        taken = bench.address().port
    if not port < taken < port + PORTS_TRIED:
        raise OtherwiseError(f"it listens {taken - port} ports further")
    return f"{taken - port} further"


@_check("orders", "with --stream each order is obeyed and answered in words", "use a Supervisor")
def _orders(bench: Bench) -> str:
    bench.running(stream=True)
    words = [_obeyed("pause", give_order(bench.address(), "pause"))]
    bench.stands("the order pause was answered")
    before = bench.rover()
    words.append(_obeyed("step", give_order(bench.address(), "step")))
    bench.until(lambda: bench.rover().sim_time_s > before.sim_time_s, "a step changed nothing")
    words.append(_obeyed("fast", give_order(bench.address(), "fast")))
    bench.goes_on("the order fast was answered")
    words.append(_obeyed("resume", give_order(bench.address(), "resume")))
    bench.goes_on("the order real-time was answered")
    return ", ".join(words)


def _obeyed(order: str, reply: OrderReply) -> str:
    if reply.text is None:
        raise OtherwiseError(f"{order}: no word, but {reply.other!r}; ping: {reply.is_alive}")
    return reply.text


@_check("order reset", "a reset by hand starts controllers anew", "seen by time that goes back")
def _order_reset(bench: Bench) -> str:
    before = bench.running(stream=True)
    reply = give_order(bench.address(), "reset", 10 * ANSWER_S)
    bench.until(lambda: bench.rover().run_id > before.run_id, "no new run began", _LOAD_S)
    if bench.rover().pid == before.pid:
        raise OtherwiseError("the controller went on in its old process")
    return f"answer {reply.text!r}"


@_check("order reload", "the order reload starts controllers anew", "a Supervisor reloads")
def _order_reload(bench: Bench) -> str:
    before = bench.running(stream=True)
    reply = give_order(bench.address(), "reload", 10 * ANSWER_S)
    _wait_for_session_after(bench, before)
    return f"answer {reply.text!r}"


@_check("order load", "the order load opens a world of the same folder", "quit and launch it")
def _order_load(bench: Bench) -> None:
    before = bench.running(stream=True)
    for name in ("second.wbt", bench.world.name):
        load_world(bench.address(), name, 10 * ANSWER_S)
        before = _wait_for_session_after(bench, before)
        if Path(before.world).name != name:
            raise OtherwiseError(f"the world is {Path(before.world).name}, not {name}")


@_check("by hand", "a pause by hand is not told; the observer can end it", "press play in Webots")
def _by_hand(bench: Bench) -> str:
    bench.running(stream=True)
    _obeyed("pause", give_order(bench.address(), "pause"))
    bench.stands("it was paused by hand")
    answer = bench.ask(webots_simulation_control, command="resume", robot=OBSERVER_NAME)
    bench.goes_on("the observer was told to resume")
    return f"by {answer.get('route')}"


@_check(
    "begins paused", "--mode=pause starts controllers with the first step", "they begin at once"
)
def _begins_paused(bench: Bench) -> str:
    bench.end()
    before = bench.newest(ROVER)
    webots = bench.webots(stream=True, mode="pause")
    bench.until(lambda: webots.address_now(), "it does not listen", _LOAD_S)
    began_s = time.monotonic()
    reply = None
    while reply is None or reply.text is None:  # it may still load the world
        if bench.newest(ROVER) != before:
            raise OtherwiseError("a controller has recorded before the first step")
        if time.monotonic() > began_s + _LOAD_S:
            raise OtherwiseError("no order is answered while it is paused")
        with contextlib.suppress(CommandRefusedError):
            reply = give_order(bench.address(), "resume")
    bench.until(lambda: bench.newest(ROVER) != before, "no controller began", _LOAD_S)
    return "after the order real-time"


@_check("trials", "each in a Webots of its own, with its parameters", "use webots_run", _TRIALS_S)
def _trials(bench: Bench) -> str:
    bench.end()
    plan = bench.world.parent.parent / "trials.toml"
    plan.write_text(
        f'world = "worlds/{bench.world.name}"\nrobot = "{ROVER}"\nscore = "last(speed)"\n'
        "for_s = 0.5\n[grid]\nspeed = [1.0, 2.0]\n",
        "utf-8",
    )
    command = [sys.executable, "-m", "webots_mcp", "trials", str(plan), "--json"]
    with subprocess.Popen(
        [*command, *bench.where.typed()], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            out, said = process.communicate(timeout=_TRIALS_S)
        except subprocess.TimeoutExpired as error:
            process.send_signal(signal.SIGTERM)
            raise OtherwiseError(f"not over within {_TRIALS_S:g} s") from error
        finally:
            process.kill()
    if process.returncode:
        raise OtherwiseError(said[-500:])
    sets = json.loads(out)["sets"]
    scores = {each["parameters"]["speed"]: each["scores"] for each in sets}
    if scores != {1.0: [1.0], 2.0: [2.0]}:
        raise OtherwiseError(f"scores {scores}, {[each['failures'] for each in sets]}")
    return "2 trials"
