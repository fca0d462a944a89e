"""What the bridge costs a controller's loop, between steps in which the controller waits.

A call in a row of equal calls costs less: all that it needs lies in the processor's caches.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from tests.benchmarks.core import (
    Bench,
    Line,
    Samples,
    Target,
    added,
    alternate,
    benchmark,
    compared,
    duration,
    processor_s,
    ratio,
)
from tests.benchmarks.ways import (
    BridgeWay,
    RawSqlite,
    Rover,
    State,
    encoder,
    make_states,
)
from webots_mcp import MCPBridge
from webots_mcp.bridge.camera_frames import scale_down
from webots_mcp.bridge.picture_files import encode_png
from webots_mcp.contract import DATABASE_NAME, KEEP_LAST_S
from webots_mcp.database.connection import connect
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.simulator.observer import Observer
from webots_mcp.standin import InProcessSupervisor

_NEVER = 1_000_000_000  # is a call recorded
_STEPS = 125  # in a block: about a second
_SENSORS = ("ds_left", "ds_right", "gps", "inertial unit", "lidar")
_CONDITIONS = {
    "a threshold": "battery_j < 0.1",
    "for half a second": "distance.ds1 < 0.1 for 0.5",
    "arithmetic in a chain": "0 < abs(gyro[0] - 1) < step",
    "a changed text": "changed(mode)",
    "a rate": "rate(battery_j) < -1",
    "a signal that is missing": "absent.front < 1",
    "displacement": "displacement(3) < 0.05",
    "three in one": "mode == 'drive' and (displacement(3) < 0.05 for 2)",
}

Call = Callable[[State], object]


def _between_steps(bench: Bench, calls: Mapping[str, Call]) -> dict[str, Samples]:
    """Seconds of each call, in blocks of steps of 8 ms in which the process sleeps."""
    steps, states = min(_STEPS, bench.count(5 * _STEPS, least=5)), make_states()

    def block(call: Call) -> list[float]:
        robot, durations = Rover(), list[float]()
        for i in range(steps):
            robot.pace()
            started_s = time.perf_counter()
            call(states[i % len(states)])
            durations.append(time.perf_counter() - started_s)
        return durations

    bench.say(", ".join(calls))
    blocks = {name: partial(block, call) for name, call in calls.items()}
    return {name: Samples(found) for name, found in alternate(blocks, bench.count(12)).items()}


@benchmark("loop", "publish() and get_command() in every step of a real 8 ms loop")
def measure_loop(bench: Bench) -> Iterable[Line]:
    with encoder(orjson=False) as name:
        yield from _ways(bench, name)
    with encoder(orjson=True) as name:
        yield from _ways(bench, name)


def _ways(bench: Bench, encoding: str) -> Iterable[Line]:
    with ExitStack() as stack:
        robot, place = Rover(), bench.place(encoding)
        ways = {
            "bridge": stack.enter_context(closing(BridgeWay(robot, place))),
            "raw": stack.enter_context(closing(RawSqlite(place))),
        }
        taken = _between_steps(bench, {name: _both(robot, way) for name, way in ways.items()})
    ours, raw = taken["bridge"], taken["raw"]
    step = f"publish and get_command, {encoding}"
    # A row must cost little more than the INSERT itself. On a busy machine the ratio is higher.
    yield compared(f"{step}, p50", ours.p50, "raw sqlite3", raw.p50, ratio(ours, raw), 1.25)
    yield compared(f"{step}, p99.9", ours.p999, "raw sqlite3", raw.p999, ours.p999 / raw.p999)


def _both(robot: Rover, way: BridgeWay | RawSqlite) -> Call:
    def step(state: State) -> None:
        robot.step(8)
        way.publish(state)
        way.get_command()

    return step


@benchmark("throttled", "publish(), a call that is not recorded, of 39 values, in an 8 ms loop")
def measure_throttled(bench: Bench) -> Iterable[Line]:
    robot, places = Rover(), [bench.place(name) for name in ("dropped", "held")]
    with ExitStack() as stack:
        dropped, held = (
            stack.enter_context(closing(BridgeWay(robot, place, every=_NEVER, keep_last_s=last_s)))
            for place, last_s in zip(places, (0, KEEP_LAST_S), strict=True)
        )

        def call(publish: Call) -> Call:
            return lambda state: (robot.step(8), publish(state))

        calls = {"none": call(lambda _: None), "dropped": dropped.publish, "held": held.publish}
        taken = _between_steps(bench, {name: call(publish) for name, publish in calls.items()})
    none = taken["none"].p50
    yield added("p50, held nowhere", taken["dropped"].p50, "the empty call", none, "us", 2)
    more = taken["dropped"].p50
    yield added("p50, the ring buffer", taken["held"].p50, "held nowhere", more, "us", 5)


@benchmark("attach", "what attaching adds to a step of a robot of ten devices")
def measure_attach(bench: Bench) -> Iterable[Line]:
    """Processor time of a step, in which the ten devices are read."""
    steps = bench.count(500, least=20)
    with ExitStack() as stack:
        robots = {name: _equipped() for name in ("each", "one of five", "plain")}
        for name, every in (("each", 1), ("one of five", 5)):
            bridge = MCPBridge.attach(
                robots[name], data_dir=bench.place(name), throttle_interval=every
            )
            stack.enter_context(closing(bridge))

        def block(robot: Any) -> list[float]:
            return [processor_s(lambda: [robot.step(16) for _ in range(steps)]) / steps]

        blocks = {name: partial(block, robot) for name, robot in robots.items()}
        taken = {name: Samples(found) for name, found in alternate(blocks, bench.count(12)).items()}
    plain = taken["plain"].p50
    yield added("mean, each step recorded", taken["each"].p50, "no bridge", plain, "us", 80)
    few = taken["one of five"].p50
    yield added("mean, one of five recorded", few, "no bridge", plain, "us", 40)


def _equipped() -> InProcessSupervisor:
    """A rover with its five sensors enabled, each of them by two names.

    Its lidar answers one scan, as Webots copies one: to compute it takes the stand-in longer than
    all that is measured here.
    """
    robot = InProcessSupervisor("rover")
    for name in _SENSORS:
        device = robot.getDevice(name)
        device.enable(16)
        robot.devices[f"{name} 2"] = device
    scan = [1.0 + i / 64 for i in range(64)]
    robot.getDevice("lidar")._ranges = lambda: scan  # pyright: ignore[reportPrivateUsage]
    return robot


@benchmark("watch", "whose time a loop takes, and whether it hangs: what knowing that costs")
def measure_watching(bench: Bench) -> Iterable[Line]:
    steps = bench.count(20_000, least=100)
    with closing(MCPBridge(_stepping(), data_dir=bench.folder)) as bridge:
        robots = {"bridged": bridge.robot, "plain": _stepping()}

        def block(robot: Any) -> list[float]:
            return [processor_s(lambda: [robot.step(16) for _ in range(steps)]) / steps]

        blocks = {name: partial(block, robot) for name, robot in robots.items()}
        taken = {name: Samples(found) for name, found in alternate(blocks, bench.count(12)).items()}
        look = bridge._session._watchdog.check  # pyright: ignore[reportPrivateUsage]
        looks = bench.count(500, least=10)
        look_s = processor_s(lambda: [look() for _ in range(looks)]) / looks
    plain = taken["plain"].p50
    yield added("a step, processor time", taken["bridged"].p50, "no bridge", plain, "us", 1)
    yield added("once a second, in the maintainer's thread", look_s, "", 0, "us", 100)


def _stepping() -> Any:
    """A robot whose steps take no time, of a class of its own, which a bridge may change."""
    members = {name: value for name, value in vars(Rover).items() if not name.startswith("__")}
    return type("Robot", (), members | {"__init__": Rover.__init__, "step": _step})()


def _step(_robot: object, _ms: int) -> int:
    return 0


@benchmark("fast", "steps per second kept in fast mode, one of five steps recorded")
def measure_fast_mode(bench: Bench) -> Iterable[Line]:
    states = make_states()
    for step_us in (100, 500, 2000):
        steps = bench.count(200_000 // step_us, least=10)
        with closing(BridgeWay(Rover(), bench.place(f"{step_us} us"), every=5)) as way:

            def block(call: Call | None, *, step_us: int = step_us, steps: int = steps) -> float:
                started_s = time.perf_counter()
                for i in range(steps):
                    until_s = time.perf_counter() + step_us / 1e6
                    while time.perf_counter() < until_s:  # as a simulator that computes
                        pass
                    if call is not None:
                        call(states[i % len(states)])
                return steps / (time.perf_counter() - started_s)

            blocks = {"ours": partial(block, _both(Rover(), way)), "none": partial(block, None)}
            taken = alternate(blocks, bench.count(20, least=2))
        ours, none = Samples.of(taken["ours"]), Samples.of(taken["none"])
        beside = f"no bridge {none.p50:.0f}/s"
        yield Line(f"{step_us} us a step", f"{ours.p50:.0f}/s", beside, ratio(ours, none))


@benchmark("frames", "publish(), what small camera frames (keep_camera) add to a call")
def measure_frames(bench: Bench) -> Iterable[Line]:
    """Processor time, with steps of 8 ms: one call in 25 takes a frame."""
    for width, height in ((160, 120), (640, 480)):
        camera, calls = _Camera(width, height), bench.count(1000, least=10)
        blocks = {
            name: _filming(bench.place(f"{name} {width}"), of, calls)
            for name, of in (("camera", camera), ("none", None))
        }
        taken = {
            name: median(found)
            for name, found in alternate(blocks, bench.count(30, least=2)).items()
        }
        what = f"mean, {width} x {height}"
        yield added(what, taken["camera"], "without camera", taken["none"], "us", 15)
        yield _writing(*scale_down(camera.getImage(), width, height), bench.count(50))


def _writing(width: int, height: int, bgra: bytes, pictures: int) -> Line:
    taken_s = processor_s(lambda: [encode_png(bgra, width, height) for _ in range(pictures)])
    return added("mean, a frame as PNG, when kept", taken_s / pictures, "", 0, "ms")


class _Camera:
    """Copies its image with each call, as that of Webots does; noise, which packs worst."""

    def __init__(self, width: int, height: int) -> None:
        self._width, self._height = width, height
        self._image = os.urandom(4 * width * height)

    def getName(self) -> str:
        return "camera"

    def getSamplingPeriod(self) -> int:
        return 8

    def getWidth(self) -> int:
        return self._width

    def getHeight(self) -> int:
        return self._height

    def getImage(self) -> bytes:
        return bytes(bytearray(self._image))


def _filming(folder: Path, camera: _Camera | None, calls: int) -> Callable[[], float]:
    robot, state = Rover(), make_states(1)[0]
    bridge = MCPBridge(robot, data_dir=folder, throttle_interval=_NEVER)
    if camera is not None:
        bridge.keep_camera(camera)
    return lambda: (
        processor_s(lambda: [(robot.step(8), bridge.publish(state)) for _ in range(calls)]) / calls
    )


@benchmark("inspection", "reading the controller's variables: at a hit, and watched paths")
def measure_inspection(bench: Bench) -> Iterable[Line]:
    """Processor time of a publish with and without five watched paths, and of a hit."""
    calls = bench.count(2000, least=20)
    with ExitStack() as stack:
        bridges = {
            name: stack.enter_context(closing(MCPBridge(Rover(), data_dir=bench.place(name))))
            for name in ("watched", "plain", "hit")
        }
        loops = {name: _Loop(bridge) for name, bridge in bridges.items()}
        loops["watched"].watch()
        blocks = {name: partial(loops[name].publish, calls) for name in ("watched", "plain")}
        taken = {name: median(found) for name, found in alternate(blocks, bench.count(12)).items()}
        plain, watched = taken["plain"], taken["watched"]
        yield added("mean, five watched paths, one publish", watched, "no path", plain, "us", 20)
        hits = bench.count(300, least=5)
        with ThreadPoolExecutor(1) as thread:  # without the frames of the benchmark itself
            rounds = bench.count(9, least=2)
            hit_s = median(thread.submit(loops["hit"].hit, hits).result() for _ in range(rounds))
        yield added("mean, one hit", hit_s, "", 0, "us", 1000)
        size = loops["hit"].bytes_of_inspection()
        yield Line("one inspection", f"{size} bytes", "", size, "bytes", Target(3000))


class _Pid:
    def __init__(self) -> None:
        self.kp, self.ki, self.kd = 2.0, 0.1, 0.01
        self.integral = 0.0


class _Loop:
    """A controller of the usual form: an object with a loop, and its controllers."""

    def __init__(self, bridge: MCPBridge) -> None:
        self.bridge = bridge
        self.pid = _Pid()
        self.mode, self.speed = "drive", 2.0
        self.path = [(float(i), float(i)) for i in range(40)]
        self.table = {"x": 1.0, "y": 2.0}
        self.scan = [1.0] * 360
        self._state = make_states(1)[0]

    def watch(self) -> None:
        variables = self.bridge._session.variables  # pyright: ignore[reportPrivateUsage]
        error = 0.0
        for path in ("self.pid.integral", "self.mode", "self.path[3]", "self.table['x']", "error"):
            variables.watch({"path": path}, sys._getframe())  # pyright: ignore[reportPrivateUsage]
        self.pid.integral = error

    def publish(self, calls: int) -> float:
        def work() -> None:
            for turn in range(calls):
                error = 0.1 * turn
                self.pid.integral += error
                self.bridge.publish(self._state)

        return processor_s(work) / calls

    def hit(self, hits: int) -> float:
        variables = self.bridge._session.variables  # pyright: ignore[reportPrivateUsage]
        variables.prepare()

        def work() -> None:
            for turn in range(hits):
                variables.record("breakpoint", "mode == 'drive'", object())
                self.pid.integral += turn

        return processor_s(work) / hits

    def bytes_of_inspection(self) -> int:
        """The size of the newest one in the database."""
        with closing(connect(self.bridge.data_dir / DATABASE_NAME, "reader")) as connection:
            sizes = "SELECT length(data) FROM event WHERE kind = 'inspection' ORDER BY id DESC"
            return int(connection.execute(sizes).fetchone()[0])


@benchmark("conditions", "a condition, evaluated with each published state (processor time)")
def measure_conditions(bench: Bench) -> Iterable[Line]:
    """Each kind by itself, and 32 at once as a robot may have."""
    calls = bench.count(2000, least=100)
    contenders = {name: _evaluating([text], calls) for name, text in _CONDITIONS.items()}
    contenders["32 of these kinds"] = _evaluating(list(_CONDITIONS.values()) * 4, calls)
    for name, blocks in alternate(contenders, bench.count(15, least=2)).items():
        count = 32 if name.startswith("32") else 1
        cost_s = median(blocks) / calls / count
        target = None if name == "three in one" else Target(2)
        yield Line(name, duration(cost_s), "each", 1e6 * cost_s, "us", target)


def _evaluating(texts: list[str], calls: int) -> Callable[[], float]:
    """Seconds of the processor for so many states."""
    states = make_states()

    def evaluate() -> None:
        evaluators = [parse_condition(text).evaluator() for text in texts]
        for i in range(calls):
            for evaluator in evaluators:
                evaluator.holds(states[i % len(states)], i * 0.008)

    return partial(processor_s, evaluate)


_WATCHED_WORLD = "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 16 }\n"
_WATCHED = 'Robot {{ name "{}" translation {} 0 0 {} }}\n'
_WATCHING = 'supervisor TRUE synchronization FALSE controller "mcp_observer"'


@benchmark("custom_data", "what a robot without a bridge adds to a round of its observer, a step")
def measure_custom_data(bench: Bench) -> Iterable[Line]:
    """Processor time; each robot writes another JSON object of 39 values before each step."""
    texts, states = [json.dumps(state) for state in make_states()], make_states()
    with closing(RawSqlite(bench.place("raw"))) as raw:
        for robots in (1, 10, 50):
            steps = bench.count(1000 // robots, least=3)
            writing, silent = (
                _watched(bench.place(f"{robots} {text}"), robots, text) for text in ("-", "")
            )

            def rounds(
                observer: Observer, nodes: Any, given: list[str], *, steps: int = steps
            ) -> float:
                def work() -> None:
                    for i in range(steps):
                        for node in nodes:
                            node.fields["customData"] = given[i % len(given)]
                        observer.go_on()

                return processor_s(work) / steps / len(nodes)

            def insert(steps: int) -> float:
                def work() -> None:
                    for i in range(steps):
                        raw.publish(states[i % len(states)])

                return processor_s(work) / steps

            blocks = {
                "writing": partial(rounds, *writing, texts),
                "silent": partial(rounds, *silent, [""]),
                "raw": partial(insert, steps),
            }
            taken = {name: median(v) for name, v in alternate(blocks, bench.count(9, 2)).items()}
            ours = taken["writing"] - taken["silent"]
            what = f"of {robots} robots, each"
            yield compared(what, ours, "raw sqlite3", taken["raw"], ours / taken["raw"], 4)
            for observer, _ in (writing, silent):
                observer.custom_data.close()
                observer.bridge.close()


def _watched(folder: Path, robots: int, text: str) -> tuple[Observer, list[Any]]:
    """An observer in a world of robots that have written this, and their nodes."""
    world = folder / "world.wbt"
    nodes = [_WATCHED.format(number, number, "") for number in range(robots)]
    nodes.append(_WATCHED.format("observer", -1, _WATCHING))
    world.write_text("".join([_WATCHED_WORLD, *nodes]))
    robot = InProcessSupervisor("observer", world=world)
    observer = Observer(robot, 16, data_dir=folder)
    watched = [each.node for each in robot.simulation.simulator.robots if each.name != "observer"]
    for _ in range(2 * robots + 20):  # until all are found, and have their sessions
        for node in watched:
            node.fields["customData"] = text
        observer.go_on()
    return observer, watched


BENCHMARKS = (
    measure_custom_data,
    measure_loop,
    measure_throttled,
    measure_attach,
    measure_watching,
    measure_fast_mode,
    measure_frames,
    measure_inspection,
    measure_conditions,
)
