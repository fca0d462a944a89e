"""Calls in a row: what each costs with everything in the processor's caches."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from tests.benchmarks.measuring import Samples, alternate, ratio, time_calls
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import make_states
from tests.benchmarks.table import Line, Target, duration
from tests.benchmarks.ways import BridgeWay, JsonFiles, RawSqlite, Way
from webots_mcp import MCPBridge
from webots_mcp.bridge.keeping import scale_down
from webots_mcp.bridge.pictures import encode_png
from webots_mcp.contract import KEEP_LAST_S
from webots_mcp.standin import InProcessSupervisor

_BLOCKS = 30
_WRITES = 200  # calls in a block
_READS = 1000


@benchmark("publish", "publish(), recorded, calls in a row")
def measure_publish(bench: Bench) -> Iterable[Line]:
    yield from _publish(bench, orjson=False)
    try:
        yield from _publish(bench, orjson=True)
    except NotMeasurableError:
        return


def _publish(bench: Bench, *, orjson: bool) -> Iterable[Line]:
    encoder = "orjson" if orjson else "standard library JSON"
    bench.say(encoder)
    robot, folder, calls = Rover(), bench.place(encoder), _calls(bench, _WRITES)
    ways: dict[str, Way] = {
        "bridge": BridgeWay(robot, folder, orjson=orjson),
        "files": JsonFiles(folder),
        "raw": RawSqlite(folder),
    }
    taken = _take_turns(bench, {name: _publishing(way, robot, calls) for name, way in ways.items()})
    for way in ways.values():
        way.close()
    ours, files, raw = taken["bridge"], taken["files"], taken["raw"]
    yield Line(
        f"p50, {encoder}",
        duration(ours.p50),
        f"JSON file {duration(files.p50)}",
        ratio(ours, files),
        target=None if orjson else Target(0.15),
    )
    yield Line(
        f"p50, {encoder}",
        duration(ours.p50),
        f"raw sqlite3 + json.dumps {duration(raw.p50)}",
        ratio(ours, raw),
        target=None if orjson else Target(1.5),
    )
    yield Line(
        f"p99.9, {encoder}",
        duration(ours.p999),
        f"JSON file {duration(files.p999)}",
        ours.p999 / files.p999,
    )


def _publishing(way: Way, robot: Rover, calls: int) -> Callable[[], list[float]]:
    states = make_states()

    def call(i: int) -> None:
        robot.step(8)
        way.publish(states[i % len(states)])

    def run_block() -> list[float]:
        way.begin()
        return time_calls(call, calls)

    return run_block


@benchmark("throttled", "publish(), a call that is not recorded, and held nowhere")
def measure_throttled(bench: Bench) -> Iterable[Line]:
    yield _cost_of_dropped(bench, keep_last_s=0, target=Target(2.0))


@benchmark("held", "publish(), a call that is not recorded, with the ring buffer")
def measure_held(bench: Bench) -> Iterable[Line]:
    yield _cost_of_dropped(bench, keep_last_s=KEEP_LAST_S, target=Target(15.0))


def _cost_of_dropped(bench: Bench, keep_last_s: float, target: Target) -> Line:
    robot, state = Rover(), make_states(1)[0]
    way = BridgeWay(robot, bench.folder, every=1_000_000_000, keep_last_s=keep_last_s)

    def call(_: int) -> None:
        robot.step(8)
        way.publish(state)

    calls = _calls(bench, 5 * _READS)
    pair = {"call": lambda: time_calls(call, calls), "none": lambda: time_calls(robot.step, calls)}
    taken = _take_turns(bench, pair)
    way.close()
    cost_us = 1e6 * (taken["call"].p50 - taken["none"].p50)
    return Line("p50", duration(taken["call"].p50), "minus the empty call", cost_us, "us", target)


@benchmark("devices", "auto_publish(), what reading devices for the ring buffer adds to a call")
def measure_devices(bench: Bench) -> Iterable[Line]:
    for lidars in (1, 30):
        yield _cost_of_reading(bench, lidars)


def _cost_of_reading(bench: Bench, lidars: int) -> Line:
    """Processor time; of slow devices most calls read nothing, so the mean tells."""
    pair = {
        name: _reading(bench.place(f"{name} {lidars}"), lidars, seconds, _calls(bench, 300))
        for name, seconds in (("ring", KEEP_LAST_S), ("none", 0.0))
    }
    taken = _take_turns(bench, pair)
    ring, none = taken["ring"].mean, taken["none"].mean
    beside = f"without ring {duration(none)}"
    added_us = 1e6 * (ring - none)
    return Line(f"mean, {lidars} lidars", duration(ring), beside, added_us, "us", Target(120.0))


def _reading(
    folder: Path, lidars: int, keep_last_s: float, calls: int
) -> Callable[[], list[float]]:
    robot = InProcessSupervisor("rover")
    lidar = robot.getDevice("lidar")
    lidar.enable(8)
    robot.step(32)
    robot.devices.update({f"lidar {i}": lidar for i in range(1, lidars)})
    bridge = MCPBridge(
        robot, data_dir=folder, throttle_interval=1_000_000_000, keep_last_s=keep_last_s
    )

    def run_block() -> list[float]:
        started_s = time.process_time()
        for _ in range(calls):
            bridge.auto_publish()
        return [(time.process_time() - started_s) / calls]

    return run_block


@benchmark("frames", "publish(), what small camera frames (keep_camera) add to a call")
def measure_frames(bench: Bench) -> Iterable[Line]:
    """Processor time, with steps of 8 ms: one call in 25 takes a frame."""
    for width, height in ((160, 120), (640, 480)):
        camera = _Camera(width, height)
        pair = {
            name: _filming(bench.place(f"{name} {width}"), of, _calls(bench, 1000))
            for name, of in (("camera", camera), ("none", None))
        }
        taken = _take_turns(bench, pair)
        filmed, plain = taken["camera"].mean, taken["none"].mean
        beside, added_us = f"without camera {duration(plain)}", 1e6 * (filmed - plain)
        yield Line(
            f"mean, {width} x {height}", duration(filmed), beside, added_us, "us", Target(15.0)
        )
        yield _cost_of_writing(*scale_down(camera.getImage(), width, height), _calls(bench, 50))


def _cost_of_writing(width: int, height: int, bgra: bytes, calls: int) -> Line:
    started_s = time.process_time()
    for _ in range(calls):
        encode_png(bgra, width, height)
    taken_s = (time.process_time() - started_s) / calls
    return Line("mean, a frame as PNG, when kept", duration(taken_s), "noise", 1e3 * taken_s, "ms")


class _Camera:
    """Copies its image with each call, as that of Webots does; noise, which packs worst."""

    def __init__(self, width: int, height: int) -> None:
        self._size = width, height
        self._image = bytearray(os.urandom(4 * width * height))

    def getName(self) -> str:
        return "camera"

    def getSamplingPeriod(self) -> int:
        return 8

    def getWidth(self) -> int:
        return self._size[0]

    def getHeight(self) -> int:
        return self._size[1]

    def getImage(self) -> bytes:
        return bytes(self._image)


def _filming(folder: Path, camera: _Camera | None, calls: int) -> Callable[[], list[float]]:
    robot, state = Rover(), make_states(1)[0]
    bridge = MCPBridge(robot, data_dir=folder, throttle_interval=1_000_000_000)
    if camera is not None:
        bridge.keep_camera(camera)

    def run_block() -> list[float]:
        started_s = time.process_time()
        for _ in range(calls):
            robot.step(8)
            bridge.publish(state)
        return [(time.process_time() - started_s) / calls]

    return run_block


@benchmark("poll", "get_command() with nothing to do, calls in a row")
def measure_poll(bench: Bench) -> Iterable[Line]:
    robot, calls = Rover(), _calls(bench, _READS)
    ways: dict[str, Way] = {
        "bridge": BridgeWay(robot, bench.folder),
        "files": JsonFiles(bench.folder),
        "raw": RawSqlite(bench.folder),
    }
    taken = _take_turns(bench, {name: _polling(way, robot, calls) for name, way in ways.items()})
    for way in ways.values():
        way.close()
    ours = taken["bridge"]
    for name, label in (("files", "exists, open, json.load"), ("raw", "indexed SELECT")):
        yield Line(
            "p50",
            duration(ours.p50),
            f"{label} {duration(taken[name].p50)}",
            ratio(ours, taken[name]),
            target=Target(0.3) if name == "files" else None,
        )


def _polling(way: Way, robot: Rover, calls: int) -> Callable[[], list[float]]:
    def call(_: int) -> None:
        robot.step(8)
        way.get_command()

    return lambda: time_calls(call, calls)


def _calls(bench: Bench, full: int) -> int:
    """Calls in a block: fewer only in a quick run."""
    return min(full, bench.count(5 * full, least=10))


def _take_turns(
    bench: Bench, contenders: dict[str, Callable[[], list[float]]]
) -> dict[str, Samples]:
    blocks = bench.count(_BLOCKS, least=2)
    taken = alternate(contenders, blocks)
    return {name: Samples(durations) for name, durations in taken.items()}
