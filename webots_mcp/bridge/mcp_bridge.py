"""The public face of the bridge: what a controller calls."""

from __future__ import annotations

import atexit
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from webots_mcp.bridge.changes import Changes
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.commands import CONFIRM_RELOAD
from webots_mcp.bridge.control import Control, Handler
from webots_mcp.bridge.devices import read_devices
from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.heart import Heart
from webots_mcp.bridge.identity import identify
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pictures import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.bridge.stats import BridgeStats
from webots_mcp.contract import (
    STRICT_VARIABLE,
    Database,
    MemoryDatabase,
    resolve_database,
)
from webots_mcp.maintenance import Maintainer

LEVELS: Final = ("debug", "info", "warning", "error")
_CALM_S: Final = 0.5  # a loop that recorded nothing for so long stands still


class MCPBridge:
    """Records what a controller publishes, and runs the commands that are sent to it.

        bridge = MCPBridge(robot)
        while robot.step(time_step) != -1:
            bridge.publish({"pose": [x, y, yaw], "mode": mode})
            bridge.get_command()

    After construction no method raises into the control loop (the environment variable
    `WEBOTS_MCP_STRICT=1` makes them raise) and none waits for a lock. What could not be recorded
    is counted in `stats()` and said once on stderr. The methods belong to the loop's thread; only
    `log` may be called from others too.

    Args:
        robot: The controller's `Robot` or `Supervisor`, or an instance of a subclass.
        data_dir: Folder of the database and the pictures; see `resolve_data_dir`.
        throttle_interval: Every so many calls of `publish` one is recorded.
        database: A file, `":memory:"`, or a `MemoryDatabase` shared with a server; None for
            `webots.db` in the data folder.

    Raises:
        TypeError: `robot` is no robot, or `database` is of another type.
        ValueError: `throttle_interval` is less than 1.
    """

    def __init__(
        self,
        robot: Any,
        data_dir: str | os.PathLike[str] | None = None,
        throttle_interval: int = 5,
        *,
        database: str | os.PathLike[str] | MemoryDatabase | None = None,
    ) -> None:
        if throttle_interval < 1:
            raise ValueError(f"throttle_interval must be 1 or more, got {throttle_interval!r}")
        self.robot = robot
        self.database: Database
        self.data_dir: Path
        self.database, self.data_dir = resolve_database(database, data_dir)
        self._interval = throttle_interval
        self._strict = os.environ.get(STRICT_VARIABLE, "") not in ("", "0")
        self._simulation = Simulation(robot)
        _replace_bridge_of(robot)
        self._start_recording()
        self._reset_counters()
        _bridges[id(robot)] = self
        atexit.register(self.close)

    # -- the loop ------------------------------------------------------------------------------

    def publish(self, state: Mapping[Any, Any], force: bool = False) -> None:
        """Record the robot's state: every `throttle_interval`-th call, or now with `force`.

        Args:
            state: Nested dicts, sequences, numbers, texts, numpy arrays, dataclasses, ... What
                JSON cannot hold is replaced and named (see `webots_mcp.bridge.encoding`). It is
                never changed. When the call returns, the row is in the database.
            force: Record this call whatever its number.
        """
        self._publish_calls += 1
        try:
            if self._clock.look():
                self._begin_run()
            if not force and self._publish_calls % self._interval:
                self._publish_throttled += 1
                return
            started_s = time.perf_counter()
            self._record_state(state)
            self._measure(time.perf_counter() - started_s)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("publish", error)

    def get_command(self) -> dict[str, Any] | None:
        """Run the commands that wait for this robot; call it once in every round of the loop.

        While the simulation is paused by a command, the call lasts until it is resumed, stepped,
        reset or reloaded, by a command or by a person in Webots, or until Webots ends the
        controller.

        Returns:
            The command handled last in this call: `id`, `action`, `params`, and the parameters
            as keys; None where there was none.
        """
        try:
            if self._clock.look(came_round=True):
                self._begin_run()
            if self._simulation.over:
                return None
            command = self._control.serve()
            self._heart.poll()
            if self._simulation.over:
                self.close()
            return command.as_dict() if command else None
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("get_command", error)
            return None

    def auto_publish(
        self, extra: Mapping[Any, Any] | None = None, include_time: bool = True
    ) -> None:
        """Publish what all enabled devices say: `sensors`, `motors`, and `pose` where it is known.

        Args:
            extra: More keys; they win over those read from the devices.
            include_time: Add the simulation time as `time` (seconds).
        """
        if (self._publish_calls + 1) % self._interval:
            self.publish({})
            return
        try:
            state = read_devices(self.robot)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("auto_publish", error)
            state = dict[str, object]()
        if include_time:
            state["time"] = self._simulation.time_s
        self.publish({**state, **(extra or {})})

    # -- beside the state ----------------------------------------------------------------------

    def log(self, message: object, level: str = "info") -> None:
        """Record a line.

        Args:
            message: Its text.
            level: `debug`, `info`, `warning` or `error`; anything else counts as `info`.
        """
        try:
            if level not in LEVELS:
                known = ", ".join(LEVELS)
                self._recorder.complain("level", f"log level {level!r} is none of {known}")
                level = "info"
            self._journal.log(level, "controller", str(message))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("log", error)

    def save_camera_frame(self, camera: Any, max_frames: int = 50) -> str | None:
        """Save the camera's current image as PNG and enter it in the database.

        Args:
            camera: A Webots `Camera` that is enabled.
            max_frames: How many frames of this camera are kept; older ones are deleted.

        Returns:
            The file's path relative to the data folder; None where there is no image yet.
        """
        try:
            return self._album.save_frame(camera, max_frames)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("save_camera_frame", error)
            return None

    # -- commands and reloads ------------------------------------------------------------------

    def register_command(self, action: str, handler: Handler) -> None:
        """Let an assistant run `handler` as the custom action `action`.

        Args:
            action: Its name; the handler's docstring tells the assistant what it does.
            handler: Called inside `get_command()` with the command as one dict: `id`, `action`,
                `params`, and the parameters as keys. What it returns is the command's result; an
                exception is its error.

        Raises:
            ValueError: The name is built in, or empty.
            TypeError: The handler is not a plain function.
        """
        self._control.register(action, handler)

    def on_reload(self, callback: Callable[[], object]) -> None:
        """Call `callback` once for each reload or reset of the world, and on `reset_state`.

        A Supervisor's reset happens inside the same process (simulation time goes back); a reload
        starts a new one, which finds its predecessor in the database.
        """
        self._callbacks.append(callback)

    def detect_reload(self) -> bool:
        """Whether the world was reloaded or reset since the last call; true once for each."""
        try:
            if self._clock.look():
                self._begin_run()
            self._fire_reload()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("detect_reload", error)
        detected, self._reload_undetected = self._reload_undetected, False
        return detected

    # -- the bridge itself ---------------------------------------------------------------------

    @property
    def robot_name(self) -> str:
        """The name under which this robot is recorded: its own, or `name#2` if that is taken."""
        registration = self._recorder.registration
        return registration.robot_name if registration else self._identity.robot_name

    @property
    def run_id(self) -> int | None:
        """Id of the current run; None while nothing could be written yet."""
        return self._clock.run.id

    def stats(self) -> BridgeStats:
        """What was recorded so far, and what was not."""
        recorder = self._recorder
        return BridgeStats(
            rows_written=recorder.rows_written,
            rows_waiting=recorder.rows_waiting,
            rows_dropped=recorder.rows_dropped,
            publish_calls=self._publish_calls,
            publish_throttled=self._publish_throttled,
            values_replaced=self._journal.values_replaced,
            publish_mean_us=1e6 * self._publish_s / max(1, self._published),
            publish_max_us=1e6 * self._publish_max_s,
            failures=self._failures,
            last_error=recorder.last_error,
        )

    def close(self, reason: str | None = None) -> None:
        """Write what waits and end the session; what is published afterwards is dropped.

        Never needed for the data's sake: every row is written when its call returns.

        Args:
            reason: How the session ended; `finished`, or `reload` after a reload command.
        """
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        _bridges.pop(id(self.robot), None)
        if self._maintainer is not None:
            self._maintainer.stop()
        ended = "reload" if self._control.actions.reloading else "finished"
        self._recorder.close(reason or ended, self._clock.sim_time_s)

    def _abandon(self) -> None:
        """In a forked child: leave the session to the parent; what is published here is dropped."""
        self._closed = True
        self._recorder.abandon()

    def __enter__(self) -> MCPBridge:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close("crashed" if error is not None else None)

    # -- inside --------------------------------------------------------------------------------

    def _start_recording(self) -> None:
        from webots_mcp import __version__

        self._clock = Clock(self._simulation)
        self._identity = identify(self.robot, self._simulation.supervisor, __version__)
        self._recorder = Recorder(self.database, self._identity, self._clock, strict=self._strict)
        self._album = Album(self._recorder, self._clock, self.data_dir)
        self._journal = Journal(self._recorder, self._clock)
        self._heart = Heart(self._recorder, self._clock)
        self._control = Control(
            self._simulation,
            self._recorder,
            self._clock,
            self._journal,
            self._album,
            self._call_back,
            self._heart,
        )
        self._maintainer = self._start_maintainer()

    def _start_maintainer(self) -> Maintainer | None:
        """A log to keep short exists only in a file."""
        if isinstance(self.database, MemoryDatabase):
            return None
        maintainer = Maintainer(self.database, "bridge", on_tick=self._flush_if_calm)
        maintainer.start()
        return maintainer

    def _flush_if_calm(self) -> None:
        """Called from the maintainer's thread: write what waits if the loop stands still."""
        recorder = self._recorder
        if recorder.rows_waiting and time.monotonic() - recorder.last_use_s > _CALM_S:
            recorder.flush()

    def _reset_counters(self) -> None:
        self._closed = False
        self._callbacks: list[Callable[[], object]] = []
        self._changes = Changes()
        self._publish_calls = self._publish_throttled = self._published = 0
        self._publish_s = self._publish_max_s = 0.0
        self._failures = 0
        registration = self._recorder.registration
        reloaded = registration is not None and registration.reloaded
        self._reload_undetected = self._reload_unfired = reloaded
        self._enter_first_run("reload" if reloaded else "start")

    def _enter_first_run(self, reason: str) -> None:
        run = self._clock.run
        run.start_reason = reason
        self._journal.event(reason)
        registration = self._recorder.registration
        if registration is not None:
            times = {"now": time.time(), "sim_time": self._clock.sim_time_s}
            values = {**times, "robot": registration.robot_id}
            self._recorder.record(CONFIRM_RELOAD, run, values)

    def _begin_run(self) -> None:
        """Simulation time went back: the old run ends with what was last known of it."""
        self._recorder.end_run("reset", self._clock.ended_sim_time_s)
        self._recorder.run = self._clock.run
        self._changes.forget()
        self._reload_undetected = self._reload_unfired = True
        self._journal.event("reset")
        self._fire_reload()
        self._heart.beat()

    def _record_state(self, state: Mapping[Any, Any]) -> None:
        self._fire_reload()
        encoded = encode(state)
        if not encoded.text.startswith("{"):
            raise TypeError(f"publish() takes a dict, got {type(state).__name__}: {state!r:.80}")
        self._journal.state(encoded)
        if isinstance(state, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            for name, before, after in self._changes.look(state):
                self._journal.event("change", {"from": before, "to": after}, name)
        self._heart.beat_if_due()

    def _fire_reload(self) -> None:
        """Run the callbacks of `on_reload`, once for each reload or reset."""
        if self._reload_unfired and self._callbacks:
            self._reload_unfired = False
            self._call_back()

    def _call_back(self) -> list[Exception | None]:
        """Run the callbacks; what each one raised, if anything."""
        outcomes: list[Exception | None] = []
        for callback in self._callbacks:
            try:
                callback()
                outcomes.append(None)
            except Exception as error:  # noqa: BLE001, PERF203  (the next one still has to run)
                self._failed("on_reload callback", error)
                outcomes.append(error)
        return outcomes

    def _measure(self, duration_s: float) -> None:
        self._published += 1
        self._publish_s += duration_s
        self._publish_max_s = max(self._publish_max_s, duration_s)

    def _failed(self, method: str, error: Exception) -> None:
        """What the bridge could not do: counted and said once; raised in strict mode only."""
        self._failures += 1
        if self._strict:
            raise error
        kind = f"{method} {type(error).__name__}"
        self._recorder.complain(kind, f"{method} failed: {type(error).__name__}: {error}")


# One process has one robot; a second bridge on the same object takes over from the first.
_bridges: dict[int, MCPBridge] = {}


def _replace_bridge_of(robot: object) -> None:
    former = _bridges.get(id(robot))
    if former is not None:
        former.close("replaced")


def _leave_to_parent() -> None:
    for bridge in _bridges.values():
        bridge._abandon()
    _bridges.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
