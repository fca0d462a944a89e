"""Checks of a running Webots, one for each fact that is known from its sources only.

The docstring of a check is printed, and listed by the documentation: what the sources say, and
after "otherwise" what still works if that is wrong. A check returns what it measured, or fails with
what it observed. `running_NAME` is called with Webots in real time, after the rover has recorded
`bench.before`; `streaming_NAME` the same with --stream. `check_NAME` starts Webots itself.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from PIL import Image

from webots_mcp.answers.answer_models import ShownPicture
from webots_mcp.contract import OBSERVER_NAME
from webots_mcp.errors import CommandRefusedError
from webots_mcp.plugins.prove.bench import REAL_TIME, SOON_S, SPEAKER, Bench, RobotRow, require
from webots_mcp.questions import (
    branch_run,
    control_simulation,
    edit_scene,
    record_scene,
    set_breakpoints,
    show_pictures,
)
from webots_mcp.simulator import orders
from webots_mcp.simulator.installations import find_webots
from webots_mcp.simulator.instances import PORTS_TRIED
from webots_mcp.simulator.starting import CommandLine, KeptProgram, Start, free_port

NOT_TRIED: Final = {
    "keys": "keys reach a window only, and Webots was started without one",
    "preferences": "runtime.ini decides here, so that any Webots starts the Python of prove",
    "customData of a PROTO": "the PROTO nodes of prove have no controller that writes it",
    "slots": "the PROTO nodes of prove have none",
    "scene stream": "a request for it would pause the simulation, so it is never made",
}
_STEP_S: Final = 0.016
_SAME: Final = 1e-6
_LOAD_S: Final = 40.0  # Until a world is loaded again.
_STALL_S: Final = 6.0
_BRANCHES_S: Final = 200.0  # Of three branches, each with a start of Webots.
_ONE_STEP_APART: Final = 0.02  # In m and rad, more than the rover moves in a step.
_STATUS: Final = 7
_MASS: Final = "BALL.physics.mass"
_PLACE: Final = "CRATE.translation"
_BOX: Final = 'DEF PROVE_BOX Solid { translation 1 1 0.1 name "prove box" }'


# -- starting it --


def check_installed(bench: Bench) -> str:
    """Its folder has a version.txt that names the release; otherwise set WEBOTS_HOME to it."""
    found = find_webots()
    require(found.version, f"no version next to the program that {found.found_by} names")
    return f"{found.version}, by {found.found_by}"


def check_launch(bench: Bench) -> str:
    """It takes our options, starts as asked and listens at --port; otherwise start it by hand."""
    began_s = time.monotonic()
    webots = bench.webots()
    took_s, mode = time.monotonic() - began_s, bench.row().state["mode"]
    require(mode == REAL_TIME, f"--mode=realtime began in the mode {mode}")
    bench.until(webots.address_now, "no Webots that listens was found among its processes")
    by = "a display that was there" if os.environ.get("DISPLAY") else "xvfb-run or none"
    return f"first row after {took_s:.1f} s, with {by}"


def running_options(bench: Bench) -> str:
    """An unknown option ends it with an exit code; otherwise launch says that nobody records."""
    words, display = Start(bench.world, None, True, False, free_port()).command_line()
    command = CommandLine([*words, "--no-such-option"], display)
    program = KeptProgram(command, {}, subprocess.DEVNULL, subprocess.DEVNULL)
    try:
        program.start()
        bench.until(lambda: program.is_over, "it does not end")
        require(program.exit_code, "it ended with exit code 0")
        return f"exit code {program.exit_code}"
    finally:
        program.end()


def running_python(bench: Bench) -> None:
    """COMMAND of runtime.ini starts controllers; otherwise doctor shows which Python it was."""
    used = Path(bench.before.state["python"])
    require(used.resolve() == Path(sys.executable).resolve(), f"the controller ran in {used}")


# -- its console, and the WebSocket without --stream --


def running_output(bench: Bench) -> str:
    """--stdout and --stderr show what controllers print; otherwise read Webots' console."""
    bench.send("say", text="printed for prove")

    def streams() -> list[str]:
        lines = bench.webots().lines
        return [line.stream for line in lines if line.text == "printed for prove"]

    bench.until(lambda: len(streams()) > 1, "of two lines, on stdout and stderr, not both came")
    return " and ".join(streams())


def running_console(bench: Bench) -> str:
    """It sends its console lines, also without --stream; otherwise start it with --stream."""
    with orders.connected(bench.address(), orders.ANSWER_S) as stream:
        orders.begin_console(stream)
        bench.send("say", text="heard by prove")
        seen, until_s = list[str](), time.monotonic() + SOON_S
        while time.monotonic() < until_s and sum("heard by" in each for each in seen) < 2:
            message = stream.receive(time.monotonic() + orders.ANSWER_S)
            lines = orders.console_lines(message.text) if message else ()
            seen += [f"{line.stream}:{line.text}" for line in lines]
    whole = [line.partition(":")[0] for line in seen if line.endswith(":heard by prove")]
    require(len(whole) == 2, f"of two lines came {whole}; the newest: {seen[-5:]}")
    starts = any(line.startswith("stdout:INFO: rover: Starting controller: ") for line in seen)
    require(starts, f"no line says that a controller is started; the first: {seen[:5]}")
    return f"{len(seen)} lines; of a controller by {' and '.join(whole)}"


def running_no_orders(bench: Bench) -> None:
    """Without --stream it answers a ping and obeys no order; otherwise the answer says so."""
    reply = orders.give_order(bench.address(), "pause")
    require(reply.text is None, f"it answered {reply.text!r}")
    require(reply.is_alive, "a ping was not answered")
    bench.goes_on("an order was sent that is not to be obeyed")


# -- steering by a Supervisor --


def running_pause(bench: Bench) -> None:
    """A Supervisor pauses it and, by step(0), resumes it; otherwise press play in Webots."""
    _paused(bench)
    bench.control("resume")
    bench.goes_on("resume was done")


def _paused(bench: Bench) -> RobotRow:
    bench.control("pause")
    bench.stands("pause was done")
    return bench.row()


def running_steps(bench: Bench) -> None:
    """It makes the requested steps, then pauses; otherwise the answer has the number made."""
    before = _paused(bench)
    bench.control("step", steps=3)
    _require_rounds(bench, before, 3)


def _require_rounds(bench: Bench, before: RobotRow, rounds: int) -> None:
    bench.stands(f"{rounds} rounds were to be made")
    now = bench.row()
    made, went_s = now.state["rounds"] - before.state["rounds"], now.sim_time_s - before.sim_time_s
    is_exact = made == rounds and abs(went_s - rounds * _STEP_S) < _SAME
    require(is_exact, f"{made} rounds in {went_s:g} s, not {rounds}")


def running_fast(bench: Bench) -> str:
    """Fast mode is faster than real time; otherwise the answer names the actual mode."""
    bench.control("fast")
    bench.until(lambda: bench.row().state["mode"] == 2, "the mode is not fast")
    before, began_s = bench.row(), time.monotonic()
    bench.until(lambda: bench.row().sim_time_s > before.sim_time_s + 2, "2 s did not pass")
    factor = (bench.row().sim_time_s - before.sim_time_s) / (time.monotonic() - began_s)
    return f"{factor:.1f} times real time"


def running_run(bench: Bench) -> None:
    """A run stops at the exact step of its time or condition; otherwise one step later."""
    before = _paused(bench)
    bench.ask(control_simulation.webots_run, for_s=20 * _STEP_S)
    _require_rounds(bench, before, 20)
    until = f"rounds >= {before.state['rounds'] + 50}"
    bench.ask(control_simulation.webots_run, until=until, for_s=20.0)
    _require_rounds(bench, before, 50)


def running_breakpoint(bench: Bench) -> None:
    """A hit pauses at the exact step; otherwise one step later."""
    goal = bench.before.state["rounds"] + 100
    made = bench.ask(set_breakpoints.webots_breakpoint, condition=f"rounds >= {goal}")
    bench.until(lambda: bench.row().state["rounds"] >= goal, "its step never came")
    _require_rounds(bench, bench.before, 100)
    bench.ask(set_breakpoints.webots_remove_breakpoint, breakpoint_id=made["breakpoint_id"])


def running_screenshot(bench: Bench) -> str:
    """It writes its main view, also without a window; otherwise use the robots' cameras."""
    return _size_of(bench.ask(show_pictures.webots_take_screenshot))


def running_movie(bench: Bench) -> str:
    """A movie is ready once it is encoded, also headless; otherwise the answer says it failed."""
    _record(bench, "start", kind="movie", width_px=320, height_px=240)
    is_refused = bench.refuses(record_scene.webots_record_scene, action="start", kind="animation")
    require(is_refused, "a second recording was begun at once")
    bench.goes_on("a movie is recorded")
    return _record(bench, "stop", timeout_wall_s=_LOAD_S)


def running_animation(bench: Bench) -> str:
    """An animation's page and data are written at its end; otherwise the answer says it failed."""
    _record(bench, "start", kind="animation")
    bench.goes_on("an animation is recorded")
    return _record(bench, "stop")


def _record(bench: Bench, action: str, **given: Any) -> str:
    answer = bench.ask(record_scene.webots_record_scene, action=action, **given)
    require(answer["outcome"] == "done", f"{action} is {answer['outcome']}")
    result = answer["result"]
    also = f", also {', '.join(result['also'])}" if "also" in result else ""
    return f"{result.get('size_bytes', 0):,} bytes{also}"


def running_branch(bench: Bench) -> str:
    """A saved world keeps poses, joints and velocities; otherwise branch 0 parts at once."""
    answer = bench.ask(
        branch_run.webots_branch_run,
        parameters={"speed": [2.0]},
        score="last(wheel_rad)",
        for_s=1.0,
        timeout_wall_s=_BRANCHES_S,
    )
    require(answer["state"] == "done", f"the branches are {answer['state']}")
    query = (
        "SELECT s.data, o.data FROM trial t JOIN trial_set p ON p.id = t.trial_set_id "
        "JOIN state s ON s.run_id = t.run_id "
        "JOIN run r ON r.uuid = json_extract(p.plan, '$.moment.run') JOIN state o "
        "ON o.run_id = r.id AND abs(o.sim_time_s - s.sim_time_s - "
        "json_extract(p.plan, '$.moment.sim_time_s')) < 1e-4 "
        "WHERE p.id = ? AND t.number = 1 ORDER BY s.id LIMIT 1"
    )
    found = bench.rows(query, answer["trial_set"])
    require(found, "no row of branch 0 has one of the rover at the same time")
    branch, own = (json.loads(text) for text in found[0])
    apart = {name: abs(branch[name] - own[name]) for name in ("x_m", "wheel_rad", "rounds")}
    lost = {name: by for name, by in apart.items() if by > _ONE_STEP_APART}
    require(not lost, f"the first row of branch 0 is apart by {lost}")
    return str(answer["notes"][0])


def running_camera(bench: Bench) -> str:
    """Cameras work with --no-rendering; otherwise start it with its window."""
    return _size_of(bench.ask(show_pictures.webots_get_camera, camera="camera", fresh=True))


def _size_of(shown: list[str | ShownPicture]) -> str:
    (data,) = (each.data for each in shown if isinstance(each, ShownPicture))
    image: Any = Image.open(BytesIO(data))
    darkest, brightest = image.convert("L").getextrema()
    size = f"{image.width} x {image.height} pixels"
    require(darkest < brightest, f"{size} of a single colour")
    return size


# -- the scene --


def running_field(bench: Bench) -> None:
    """A field is set with the next step, also while paused; otherwise the answer has its value."""
    _paused(bench)
    _set(bench, _PLACE, [-0.3, 0.5, 0.06])
    bench.control("step", steps=2)
    held = _value(bench, _PLACE)
    require(abs(held[1] - 0.5) < 0.01, f"two steps after y was set to 0.5 it holds {held}")


def _set(bench: Bench, path: str, value: object) -> None:
    bench.ask(edit_scene.webots_set_field, path=path, value=value)


def _value(bench: Bench, path: str) -> Any:
    return bench.ask(edit_scene.webots_get_field, path=path)["result"]["value"]


def running_nodes(bench: Bench) -> None:
    """Nodes are added and removed at once, and faulty text adds none; otherwise reload."""
    bench.ask(edit_scene.webots_add_node, vrml=_BOX)
    require(_has_box(bench), "a node that was added is not there")
    bench.ask(edit_scene.webots_remove_node, path="PROVE_BOX")
    require(not _has_box(bench), "a node that was removed is there")
    is_refused = bench.refuses(edit_scene.webots_add_node, vrml=_BOX.replace("Solid", "Nothing"))
    require(is_refused, "a node of an unknown type was added")
    bench.goes_on("a node of an unknown type was refused")


def _has_box(bench: Bench) -> bool:
    return not bench.refuses(edit_scene.webots_get_field, path="PROVE_BOX.translation")


def running_reset(bench: Bench) -> None:
    """A reset restores poses and removes added nodes, in the same process; otherwise reload."""
    bench.ask(edit_scene.webots_add_node, vrml=_BOX)
    _set(bench, _PLACE, [1, -1.5, 0.06])
    now = _after_reset(bench)
    require(now.pid == bench.before.pid, "the controller was started anew")
    require(not _has_box(bench), "a node that was added is there")
    place = _value(bench, _PLACE)
    require(abs(place[0] + 0.3) < 0.05, f"the crate, which began at x = -0.3 m, is at {place}")


def _after_reset(bench: Bench) -> RobotRow:
    before = bench.row()
    bench.control("reset")
    bench.until(lambda: bench.row().run_id > before.run_id, "no new run began")
    bench.goes_on("a reset was done")
    return bench.row()


def running_put_back(bench: Bench) -> None:
    """A reset leaves other fields as set, and the bridge restores them; otherwise reload."""
    mass = _value(bench, _MASS)
    _set(bench, _MASS, 2 * mass)
    bench.goes_on("a mass was set")
    require(abs(_value(bench, _MASS) - 2 * mass) < _SAME, "a mass that was set is not held")
    run = _after_reset(bench).run_id
    require(abs(_value(bench, _MASS) - mass) < _SAME, "the mass is not set back")
    events = bench.rows("SELECT 1 FROM event WHERE kind = 'put_back' AND run_id = ?", run)
    require(events, "Webots has set the mass back by itself")


def running_motors(bench: Bench) -> None:
    """A reset stops wheels, and the bridge starts them again; otherwise use on_reload."""
    begin_rad = _after_reset(bench).state["wheel_rad"]
    bench.until(lambda: bench.row().state["wheel_rad"] != begin_rad, "a wheel stands still")


def running_proto(bench: Bench) -> None:
    """The inside of a PROTO can be read but not set; otherwise it is reported as missing."""
    path = "SIGN.children[0].geometry.size"
    for then in ("before", "after"):
        size = [round(each, 3) for each in _value(bench, path)]
        require(size == [0.1, 0.2, 0.3], f"{then} it was to be set the size is {size}")
        is_refused = bench.refuses(edit_scene.webots_set_field, path=path, value=[1, 1, 1])
        require(is_refused, "its inside was set")


# -- the observer, and a loop that hangs --


def running_observer(bench: Bench) -> str:
    """Steps of an observer carry all poses, also in a PROTO; otherwise each is requested."""

    def places() -> dict[str, Any]:
        return bench.row(OBSERVER_NAME).state.get("world", {})

    bench.until(lambda: {"ROVER", "inner"} <= set(places()), "of ROVER and inner it sees not both")
    seen = bench.row(OBSERVER_NAME)
    query = "SELECT data FROM state WHERE run_id = ? ORDER BY abs(sim_time_s - ?) LIMIT 1"
    ((own,),) = bench.rows(query, bench.row().run_id, seen.sim_time_s)
    apart_m = abs(json.loads(own)["x_m"] - seen.state["world"]["ROVER"]["x_m"])
    require(apart_m < 0.02, f"{apart_m:.3f} m from where the rover itself is")
    return f"{apart_m * 1000:.1f} mm from where the rover itself is"


def running_observer_time(bench: Bench) -> str:
    """step(0) of an observer reports the time; otherwise it makes steps of its own."""
    begin = bench.row(OBSERVER_NAME)
    end_s = begin.sim_time_s + 2
    bench.until(lambda: bench.row(OBSERVER_NAME).sim_time_s > end_s, "it recorded no 2 s")
    gaps = "SELECT sim_time_s - lag(sim_time_s) OVER (ORDER BY id) AS gap_s FROM state"
    query = f"SELECT max(gap_s) FROM ({gaps} WHERE run_id = ? AND sim_time_s >= ?)"
    ((longest_s,),) = bench.rows(query, begin.run_id, begin.sim_time_s)
    require(longest_s < 1, f"rows up to {longest_s:.2f} s apart, not 0.1")
    return f"rows at most {longest_s:.3f} s apart"


def running_customData(bench: Bench) -> str:  # noqa: N802 - as Webots writes it
    """An observer records the customData of other robots; otherwise attach a bridge."""
    goal = bench.row(SPEAKER).state["seq"] + 20
    bench.until(lambda: bench.row(SPEAKER).state["seq"] > goal, "its messages end")
    state = bench.row(SPEAKER).state
    require(state["twice"] == 2 * state["seq"], f"parts of two messages: {state}")
    return f"{state.get('seq_missed', 0)} of {state['seq']} messages missed"


def running_hang(bench: Bench) -> str:
    """The threads of a hanging controller go on, so its line is known; otherwise it is silent."""
    bench.send("stall", waits_s=1.0, seconds=_STALL_S)

    def place() -> str | None:
        with bench.recording.view("rover") as view:
            why = view.header().get("why") or ""
        return why if "rover.py" in why and "stall" in why else None

    said = bench.until(place, "its place is not told")
    bench.until(lambda: bench.moves(1.0), "it does not go on", 3 * _STALL_S)
    return str(said)


# -- reloading and ending --


def running_reload(bench: Bench) -> None:
    """A reload restarts controllers; otherwise start them by hand."""
    bench.control("reload", timeout_wall_s=_LOAD_S)
    _began_after(bench, bench.before)
    _require_ended(bench, "reload")


def _began_after(bench: Bench, before: RobotRow) -> RobotRow:
    id_before = before.session_id
    bench.until(lambda: bench.row().session_id > id_before, "no controller began anew", _LOAD_S)
    return bench.row()


def _require_ended(bench: Bench, reason: str) -> None:
    """A process that was killed before step() returned -1 is found as crashed."""
    query = "SELECT end_reason FROM session WHERE id = ?"
    ((ended,),) = bench.rows(query, bench.before.session_id)
    require(ended == reason, f"the session ended as {ended}, not as {reason}")


def running_quit(bench: Bench) -> None:
    """It exits with the status of simulationQuit, after step() was -1; otherwise with another."""
    webots = bench.webots()
    bench.send("leave", waits_s=3.0, status=_STATUS)
    bench.until(lambda: webots.is_over, "it did not end", _LOAD_S)
    require(webots.exit_code == _STATUS, f"exit code {webots.exit_code}, not {_STATUS}")
    _require_ended(bench, "finished")


def running_terminate(bench: Bench) -> None:
    """SIGTERM, or closing its window, makes step() return -1; otherwise it is killed."""
    bench.end()
    _require_ended(bench, "finished")


def running_layout(bench: Bench) -> None:
    """With --headless it saves no window layout; otherwise a .wbproj has changed."""
    bench.end()
    written = [file.name for file in bench.world.parent.glob(".*.wbproj")]
    require(not written, f"it wrote {', '.join(written)}")


# -- the WebSocket with --stream --


def check_port_taken(bench: Bench) -> str:
    """If --port is taken, it takes one of the next ten; otherwise it ends with a message."""
    port = free_port()
    with socket.create_server(("", port)):
        bench.webots(stream=True, port=port)
        further = bench.address().port - port
    require(0 < further < PORTS_TRIED, f"it listens {further} ports further")
    return f"{further} further"


def streaming_orders(bench: Bench) -> str:
    """With --stream it obeys and acknowledges each order; otherwise a Supervisor has to."""
    words = [_obeyed(bench, "pause")]
    bench.stands("the order pause was answered")
    before = bench.row()
    words.append(_obeyed(bench, "step"))
    bench.until(lambda: bench.row().sim_time_s > before.sim_time_s, "no step was made")
    for order in ("fast", "resume"):
        words.append(_obeyed(bench, order))
        bench.goes_on(f"the order {order} was answered")
    return ", ".join(words)


def _obeyed(bench: Bench, order: orders.Order) -> str:
    reply = orders.give_order(bench.address(), order)
    require(reply.text, f"{order}: no word; other: {reply.other!r}; ping: {reply.is_alive}")
    return str(reply.text)


def streaming_order_reset(bench: Bench) -> str:
    """A reset by hand restarts controllers; otherwise time goes back, which shows it."""
    return _ordered_anew(bench, "reset")


def _ordered_anew(bench: Bench, order: orders.Order) -> str:
    reply = orders.give_order(bench.address(), order, SOON_S)
    _began_after(bench, bench.before)
    return f"answer: {reply.text}"


def streaming_order_reload(bench: Bench) -> str:
    """The order reload restarts controllers; otherwise a Supervisor reloads."""
    return _ordered_anew(bench, "reload")


def streaming_order_load(bench: Bench) -> None:
    """The order load opens a world of the same folder; otherwise quit, and launch it."""
    before = bench.before
    for name in ("second.wbt", bench.world.name):
        orders.load_world(bench.address(), name, SOON_S)
        before = _began_after(bench, before)
        require(Path(before.world).name == name, f"its world is {Path(before.world).name}")


def streaming_by_hand(bench: Bench) -> None:
    """An observer notices and ends a pause by hand; otherwise press play."""
    _obeyed(bench, "pause")
    bench.stands("it was paused from outside")
    bench.control("resume", robot=OBSERVER_NAME)
    bench.goes_on("the observer was told to resume")


def check_begins_paused(bench: Bench) -> None:
    """With --mode=pause, controllers start at the first step; otherwise at once."""
    bench.end()
    webots = bench.webots(stream=True, mode="pause")
    bench.until(webots.address_now, "it does not listen", bench.patience_s)

    def plays() -> bool:  # as soon as the world is loaded
        require(not bench.newest(), "a controller recorded before the first step")
        with suppress(CommandRefusedError):
            return orders.give_order(bench.address(), "resume").text is not None
        return False

    bench.until(plays, "no order is answered while it is paused", bench.patience_s)
    bench.until(bench.newest, "no controller began", _LOAD_S)


def check_trials(bench: Bench) -> None:
    """Each trial has a Webots of its own, with its parameters; otherwise use webots_run."""
    bench.end()
    plan = str(bench.world.with_name("trials.toml"))
    command = [sys.executable, "-m", "webots_mcp", "trials", plan, "--json", *bench.where.typed()]
    done = subprocess.run(command, capture_output=True, check=False, text=True, timeout=240)
    require(done.returncode == 0, done.stderr[-400:])
    sets = json.loads(done.stdout)["sets"]
    scores = {each["parameters"]["speed"]: each["scores"] for each in sets}
    require(scores == {1.0: [1.0], 2.0: [2.0]}, f"scores by speed: {scores}")


CHECKS: Final[dict[str, Callable[[Bench], object]]] = {
    name.partition("_")[2].replace("_", " "): function
    for name, function in list(globals().items())
    if name.startswith(("check_", "running_", "streaming_"))
}
