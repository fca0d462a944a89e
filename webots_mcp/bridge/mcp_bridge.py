"""The public face of the bridge: what a controller calls."""

from __future__ import annotations

import atexit
import os
import sys
import time
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.bridge import open_bridges
from webots_mcp.bridge.changes import Changes
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.commands import CommandQueue, describe
from webots_mcp.bridge.context import Context
from webots_mcp.bridge.control import Control
from webots_mcp.bridge.devices import read_devices
from webots_mcp.bridge.encoding import encode, text_of
from webots_mcp.bridge.handlers import Handler
from webots_mcp.bridge.heartbeat import Heartbeat
from webots_mcp.bridge.identity import identify
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.open_bridges import OpenBridge
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.pictures import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.reloads import Reloads
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.bridge.stats import BridgeStats, PublishCost
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import (
    LOG_LEVELS,
    STRICT_VARIABLE,
    THROTTLE_VARIABLE,
    Database,
    MemoryDatabase,
    find_log_level,
    resolve_database,
)
from webots_mcp.maintenance import Maintainer

if TYPE_CHECKING:
    import logging

_FALSE: Final = ("", "0", "false", "no", "off")
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
        throttle_interval: Every so many calls of `publish` one is recorded; the environment
            variable `WEBOTS_MCP_THROTTLE_INTERVAL` overrides it.
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
        self._throttle = Throttle(int(os.environ.get(THROTTLE_VARIABLE) or throttle_interval))
        self.robot = robot
        self.database: Database
        self.data_dir: Path
        self.database, self.data_dir = resolve_database(database, data_dir)
        self._strict = os.environ.get(STRICT_VARIABLE, "").lower() not in _FALSE
        self._closed = False
        self._failures = 0
        self._cost = PublishCost()
        self._changes = Changes()
        self._reloads = Reloads(self._failed)
        self._simulation = Simulation(robot)
        open_bridges.close_former(robot)
        self._start_recording()
        self._begin_first_run()
        open_bridges.enter(robot, OpenBridge(self.close, self._leave_to_parent))
        atexit.register(self._close_at_exit)

    # -- the loop ------------------------------------------------------------------------------

    def publish(self, state: Mapping[Any, Any], force: bool = False) -> None:
        """Record the robot's state: every `throttle_interval`-th call, or now with `force`.

        Each call is recorded where a command pauses or makes single steps: what is shown of a
        paused robot is its newest state.

        Args:
            state: Nested dicts, sequences, numbers, texts, numpy arrays, dataclasses, ... What
                JSON cannot hold is replaced and named (see `webots_mcp.bridge.encoding`). It is
                never changed. When the call returns, the row is in the database.
            force: Record this call whatever its number.
        """
        try:
            if self._clock.look():
                self._begin_run()
            if self._throttle.admits(force or self._heartbeat.loop is not None):
                self._record_state(state)
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
            self._heartbeat.poll()
            if self._simulation.over:
                self._end()
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
        try:
            if self._clock.look():
                self._begin_run()
            if self._throttle.admits(self._heartbeat.loop is not None):
                self._record_state({**self._read_devices(include_time), **_finite(extra or {})})
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("auto_publish", error)

    # -- beside the state ----------------------------------------------------------------------

    def log(self, message: object, level: str | int = "info") -> None:
        """Record a line, of which the first 10,000 characters are kept.

        Args:
            message: Its text.
            level: `debug`, `info`, `warning` (or `warn`), `error` or `critical`, in either case,
                or a number as in `logging` (`logging.WARNING`); anything else counts as `info`.
        """
        self._log(message, level, None)

    def log_handler(self, level: int | str = 0) -> logging.Handler:
        """A handler that records what a controller logs with Python's `logging`.

            logging.getLogger().addHandler(bridge.log_handler())

        Each line has its level and the name of its logger. Any thread may log. A message that
        cannot be formatted is recorded as it was given, with the reason; nothing raises.

        Args:
            level: The handler passes on this level and those above it.
        """
        from webots_mcp.bridge.log_handler import LogHandler  # `logging` costs a tenth of a start

        return LogHandler(self._log, level)

    def _log(self, message: object, level: object, logger: str | None) -> None:
        try:
            known = find_log_level(level)
            if known is None:
                names = ", ".join(LOG_LEVELS)
                self._recorder.errors.warn("level", f"log level {level!r:.80} is none of {names}")
            self._journal.log(known or "info", "controller", text_of(message), logger)
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
            ValueError: The name is built in, empty, over 100 characters, or not printable.
            TypeError: The name is no text, or the handler is not a plain function.
        """
        self._control.handlers.register(action, handler)

    def on_reload(self, callback: Callable[[], object]) -> None:
        """Call `callback` once for each reload or reset of the world, and on `reset_state`.

        A Supervisor's reset happens inside the same process (simulation time goes back); a reload
        starts a new one, which finds its predecessor in the database.
        """
        self._reloads.add(callback)

    def detect_reload(self) -> bool:
        """Whether the world was reloaded or reset since the last call; true once for each."""
        try:
            if self._clock.look():
                self._begin_run()
            self._reloads.fire()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("detect_reload", error)
        return self._reloads.detect()

    # -- the bridge itself ---------------------------------------------------------------------

    @property
    def robot_name(self) -> str:
        """The name under which this robot is recorded: its own, or `name#2` if that is taken."""
        registration = self._recorder.session.registration
        return registration.robot_name if registration else self._identity.robot_name

    @property
    def run_id(self) -> int | None:
        """Id of the current run; None while nothing could be written yet."""
        return self._clock.run.id

    def stats(self) -> BridgeStats:
        """What was recorded so far, and what was not."""
        recorder = self._recorder
        return BridgeStats(
            rows_written=recorder.counts.written,
            rows_waiting=recorder.rows_waiting,
            rows_dropped=recorder.counts.lost,
            publish_calls=self._throttle.calls,
            publish_throttled=self._throttle.skipped,
            values_replaced=self._journal.values_replaced,
            publish_mean_us=self._cost.mean_us,
            publish_max_us=self._cost.max_us,
            failures=self._failures,
            last_error=recorder.errors.last_error,
        )

    def close(self, reason: str | None = None) -> None:
        """Write what waits and end the session; what is published afterwards is dropped.

        Never needed for the data's sake: every row is written when its call returns.

        Args:
            reason: How the session ended; `finished`, or `reload` after a reload command.
        """
        if self._closed:
            return
        reason = reason or self._end_reason
        self._let_go()
        open_bridges.leave(self.robot)
        if self._maintainer is not None:
            self._maintainer.stop()
        self._recorder.close(reason, self._clock.sim_time_s)
        self._closed = True  # last: an interrupted call is made up for at the exit
        atexit.unregister(self._close_at_exit)

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
        self._heartbeat = Heartbeat(self._recorder, self._clock)
        self._pause = Pause(self._simulation, self._journal, self._heartbeat, self._look)
        self._control = Control(self._context())
        self._maintainer = self._start_maintainer()

    def _context(self) -> Context:
        return Context(
            simulation=self._simulation,
            clock=self._clock,
            recorder=self._recorder,
            journal=self._journal,
            album=self._album,
            heartbeat=self._heartbeat,
            throttle=self._throttle,
            reloads=self._reloads,
            queue=CommandQueue(self._recorder),
            pause=self._pause,
        )

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

    def _begin_first_run(self) -> None:
        run, registration = self._clock.run, self._recorder.session.registration
        reloaded = registration is not None and registration.reloaded
        run.start_reason = "reload" if reloaded else "start"
        self._journal.event(run.start_reason)
        if reloaded:
            self._reloads.happened()
        if registration is not None:
            times = {"now": time.time(), "sim_time": self._clock.sim_time_s}
            mode = self._simulation.mode_name if self._simulation.supervisor else None
            self._recorder.record("reload confirmed", run, {**times, "mode": mode})
            if registration.paused_mode is not None:
                self._pause.take_over(registration.paused_mode)

    def _let_go(self) -> None:
        """A pause that nobody could end any more would stop the whole simulation."""
        try:
            self._pause.close()
            self._control.report_end(extern=self._identity.extern)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("close", error)

    def _look(self) -> None:
        """Time has passed, or gone back, outside of the loop: in a step of a handler's."""
        if self._clock.look():
            self._begin_run()
        self._heartbeat.beat_if_due()

    def _begin_run(self) -> None:
        """Simulation time went back: the old run ends with what was last known of it."""
        self._recorder.end_run("reset", self._clock.ended_sim_time_s)
        self._recorder.session.run = self._clock.run
        self._changes.forget()
        self._reloads.happened()
        self._journal.event("reset")
        self._reloads.fire()
        self._heartbeat.beat()

    @property
    def _end_reason(self) -> str:
        return "reload" if self._reloads.requested_by else "finished"

    def _end(self) -> None:
        """Webots may kill the process from here on, or let the loop say its last words."""
        self._control.report_end(extern=self._identity.extern)
        self._recorder.end(self._end_reason, self._clock.sim_time_s)

    def _record_state(self, state: Mapping[Any, Any]) -> None:
        started_s = time.perf_counter()
        self._reloads.fire()
        encoded = encode(state)
        if not encoded.text.startswith("{"):
            raise TypeError(f"publish() takes a dict, got {type(state).__name__}")
        self._journal.state(encoded)
        if isinstance(state, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            for name, before, after in self._changes.look(state):
                self._journal.event("change", {"from": before, "to": after}, name)
        self._heartbeat.beat_if_due()
        self._cost.add(time.perf_counter() - started_s)

    def _leave_to_parent(self) -> None:
        """In a forked child: leave the session to the parent; what is published here is dropped."""
        self._closed = True
        self._recorder.abandon()

    def _close_at_exit(self) -> None:
        """The interpreter keeps the exception that ends it; at a prompt it keeps others too."""
        error = None if hasattr(sys, "ps1") else getattr(sys, "last_value", None)
        if isinstance(error, Exception):
            self.log(f"the controller ended by {describe(error)}", "error")
            self.close("crashed")
        self.close()

    def _read_devices(self, include_time: bool) -> dict[str, object]:
        """What the devices say; without what cannot be read, which is counted."""
        try:
            state = read_devices(self.robot)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._failed("auto_publish", error)
            state = dict[str, object]()
        if include_time:
            state["time"] = self._clock.sim_time_s
        return state

    def _failed(self, method: str, error: Exception) -> None:
        """What the bridge could not do: counted and said once; raised in strict mode only."""
        self._failures += 1
        if self._strict:
            raise error
        kind = f"{method} {type(error).__name__}"
        self._recorder.errors.warn(kind, f"{method} failed: {describe(error)}")


def _finite(extra: Mapping[Any, Any]) -> dict[Any, Any]:
    """As many items as it says; a mapping of the user's own may never come to its end."""
    if not isinstance(extra, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"extra is a dict, got {type(extra).__name__}")
    return dict(islice(extra.items(), len(extra)))
