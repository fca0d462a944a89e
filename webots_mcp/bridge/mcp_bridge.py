"""The public interface of the bridge: what a controller calls.

Most controllers import it before they know whether they will record. What a session needs is
imported when a bridge is made, before the robot moves; no step of the loop waits for an import.
"""

from __future__ import annotations

import atexit
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import (
    ENDED_BY,
    HANG_AFTER_S,
    HANG_VARIABLE,
    KEEP_LAST_S,
    KEEP_LAST_VARIABLE,
    LOG_LEVELS,
    MAX_CAMERA_PICTURES,
    RESTORED_EVENT,
    STRICT_VARIABLE,
    THROTTLE_VARIABLE,
    BreakpointAction,
    find_log_level,
)
from webots_mcp.database.location import Database, MemoryDatabase, resolve_database
from webots_mcp.errors import CommandRefusedError

if TYPE_CHECKING:
    import logging

    from webots_mcp.bridge.attachment import Attachment
    from webots_mcp.bridge.branch_start import RestoredState
    from webots_mcp.bridge.capture import Capture
    from webots_mcp.bridge.claimed_commands import ClaimedCommand, Handler
    from webots_mcp.bridge.parameters import Parameter, V

_FALSE: Final = ("", "0", "false", "no", "off")
_MOST_SECONDS: Final = 3600.0
_KEEPING: Final = ("error", "critical")  # log levels


class MCPBridge:
    """Records what a controller publishes, and runs the commands that are sent to it.

    One line records the values of the robot's devices and serves commands, at each step:

        bridge = MCPBridge.attach(robot)

    A loop that publishes a state of its own:

        bridge = MCPBridge(robot)
        while robot.step(time_step) != -1:
            bridge.publish({"pose": [x, y, yaw], "mode": mode})
            bridge.get_command()

    After construction no method raises into the control loop (the environment variable
    `WEBOTS_MCP_STRICT=1` makes them raise) and none waits for a lock. What could not be recorded
    is counted in `stats()` and reported once on stderr. The methods must be called in the loop's
    thread; only `log` may be called in others too.

    Args:
        robot: The controller's `Robot` or `Supervisor`, or an instance of a subclass.
        data_dir: Folder of the database and the pictures; see `resolve_data_dir`.
        throttle_interval: One call of `publish` in this many is recorded; the environment
            variable `WEBOTS_MCP_THROTTLE_INTERVAL` overrides it.
        keep_last_s: Seconds of simulation time before a moment that are kept at full rate: every
            call of `publish`, also those that the throttle drops (see `keep`). They are held in
            memory, up to 8 MB; beyond that the oldest are forgotten. Five seconds show what led to
            a crash or a hit, and cost a throttled call some microseconds, one of `auto_publish` up
            to 100 us on average for reading devices (see `stats().ring_interval`). 0 holds nothing;
            the environment variable `WEBOTS_MCP_KEEP_LAST_S` overrides it.
        hang_after_s: If the loop gives no sign of life for this many seconds of wall time, and does
            not wait for Webots in `step`, the stacks of all threads are recorded. 0 turns it off;
            it is also off for a database in memory. The environment variable
            `WEBOTS_MCP_HANG_AFTER_S` overrides it.
        capture_output: Also record what the process prints on stdout and stderr, as log lines of
            the logger `stdout` or `stderr`, up to 500 a second of each. The output still appears
            where it did before. Output of C code and of child processes is included; a child that
            is to outlive the controller needs a stdout of its own.
        database: A file, `":memory:"`, or a `MemoryDatabase` shared with a server; None for
            `webots.db` in the data folder.
        tape: Whether to record each call of Webots' API on a tape next to the database, on which
            'webots-mcp rerun' runs new code; "images" with the images of cameras and lidars. None
            for `WEBOTS_MCP_TAPE`, else `tape = true` in webots-mcp.toml. Recorded from here on: set
            one of these two instead to include what was asked and enabled before.

    Raises:
        TypeError: `robot` is not a robot, or `database` is of another type.
        ValueError: `throttle_interval` is less than 1, or `keep_last_s` or `hang_after_s` not from
            0 to 3600.
    """

    _kind: str | None = None  # the robot's kind, if a subclass sets one, as the observer does

    def __init__(
        self,
        robot: Any,
        data_dir: str | os.PathLike[str] | None = None,
        throttle_interval: int = 5,
        *,
        keep_last_s: float = KEEP_LAST_S,
        hang_after_s: float = HANG_AFTER_S,
        capture_output: bool = False,
        database: str | os.PathLike[str] | MemoryDatabase | None = None,
        tape: bool | Literal["images"] | None = None,
    ) -> None:
        from webots_mcp.bridge.error_report import ErrorReport
        from webots_mcp.bridge.session import BridgeSession
        from webots_mcp.bridge.simulation import Simulation
        from webots_mcp.bridge.tape_start import find_tape

        keep_last_s = _seconds("keep_last_s", KEEP_LAST_VARIABLE, keep_last_s)
        hang_after_s = _seconds("hang_after_s", HANG_VARIABLE, hang_after_s)
        throttle = Throttle(int(os.environ.get(THROTTLE_VARIABLE) or throttle_interval))
        self.robot = robot
        self.database: Database
        self.data_dir: Path
        self.database, self.data_dir = resolve_database(database, data_dir)
        self._closed = False
        self._close_after_answer = False
        self._restored_read = False
        strict = os.environ.get(STRICT_VARIABLE, "").lower() not in _FALSE
        self._errors = ErrorReport(strict=strict)
        taped = find_tape(tape, self.database)  # before the steps of the robot's class are replaced
        simulation = Simulation(robot)
        # After the check of the robot, before the new session: a refused construction leaves the
        # former bridge as it is, and two sessions of one robot never overlap.
        if (former := _bridges.get(id(robot))) is not None:
            former.close("superseded")
        where = (self.database, self.data_dir)
        limits = (throttle, keep_last_s, self._errors, self._kind, hang_after_s)
        self._session = BridgeSession(simulation, *where, *limits)
        self._meter = simulation.meter
        self._publisher = self._session.publisher
        self._session.begin()
        if taped is not None:
            run_uuid = self._session.recorder.run_uuid
            taped.open(self.data_dir, self._session.recorder.uuid, robot, run_uuid)
        self._capture = self._capture_output() if capture_output else None
        self._attachment: Attachment | None = None
        _bridges[id(robot)] = self
        atexit.register(self._close_at_exit)

    # -- attaching -----------------------------------------------------------------------------

    @classmethod
    def attach(cls, robot: Any, **options: Any) -> MCPBridge:
        """Record the devices' values and serve commands with each `step` of the robot.

            bridge = MCPBridge.attach(robot)
            while robot.step(time_step) != -1:
                ...

        It does not matter where and how the controller steps: in a subclass with a `step` of its
        own, in a function of another module, by `stepBegin` and `stepEnd`, or by a
        `vehicle.Driver`. Only a method that was stored before (`step = robot.step`) or that
        replaces it (`robot.step = mine`) is not seen; the bridge warns of that. Each step in which
        simulation time advances publishes once (see `auto_publish`), when it ends; commands are
        served when a step begins, `step(0)` included. The step returns what Webots answers. After a
        -1 everything is written, and Webots is not called any more.

        A state that the controller publishes is recorded together with the devices' values. A
        controller that also calls `get_command()` receives the command that was served last. The
        steps of a handler are recorded, and no other command is served in them.

        Args:
            robot: As for `MCPBridge`. If it has an open bridge, that one is attached.
            options: As for `MCPBridge`.

        Returns:
            The robot's bridge; `detach()` undoes the attachment.

        Raises:
            ValueError: Options are given and the robot has a bridge already.
        """
        bridge = _bridges.get(id(robot))
        if bridge is None:
            bridge = cls(robot, **options)
        elif options:
            raise ValueError(
                f"the robot already has a bridge, so {', '.join(options)} cannot be set; close() "
                "that bridge first, or call attach(robot) without options"
            )
        if bridge._attachment is None:
            bridge._attachment = bridge._session.attach(bridge._serve)
        return bridge

    def detach(self) -> None:
        """Undo `attach`: from now on the loop itself publishes and calls `get_command()`."""
        if self._attachment is not None:
            self._attachment.end()
            self._attachment = None

    # -- the loop ------------------------------------------------------------------------------

    def publish(self, state: Mapping[Any, Any], force: bool = False) -> None:
        """Record the robot's state: every `throttle_interval`-th call, or now with `force`.

        While a command pauses the loop or makes single steps, each call is recorded, so that the
        newest recorded state of a paused robot is its current one.

        Args:
            state: Nested dicts, sequences, numbers, texts, numpy arrays, dataclasses, ... Values
                that JSON cannot hold are replaced and named (see `webots_mcp.bridge.encoding`). The
                state itself is never changed. When the call returns, the row is in the database.
            force: Record this call whatever its number.
        """
        self._meter.leave_own()
        try:
            if self._attachment is None:
                self._publisher.publish(state, force)
            else:
                self._publisher.publish_devices(state, include_time=True, force=force)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("publish", error)
        finally:
            self._meter.leave_bridge()

    def get_command(self) -> dict[str, Any] | None:
        """Run the pending commands of this robot; call it once in every round of the loop.

        While the simulation is paused by a command, the call lasts until it is resumed, stepped,
        reset or reloaded, by a command or by a person in Webots, or until Webots ends the
        controller.

        Returns:
            The command handled last in this call: `id`, `action`, `params`, and the parameters
            as keys; None where there was none. A command with an unknown action is returned too;
            its recorded answer is an error.
        """
        self._meter.leave_own()
        try:
            command = self._serve()
            if self._attachment is not None:
                served_by_step = self._attachment.take_command()
                command = command or served_by_step
            return command.as_dict() if command else None
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("get_command", error)
            return None
        finally:
            self._meter.leave_bridge()

    def auto_publish(
        self, extra: Mapping[Any, Any] | None = None, include_time: bool = True
    ) -> dict[Any, Any]:
        """Publish the values of all enabled devices: `sensors`, `motors`, `actuators`, `pose`, ...

        The rule for each class of devices is in `webots_mcp.bridge.devices`. Nothing is enabled or
        changed, and no packet or key is consumed.

        Args:
            extra: More keys, which replace equal ones of the devices.
            include_time: Add the simulation time as `time` (seconds).

        Returns:
            The state as it was published, without the devices where this call was throttled and did
            not read them. Empty where publishing failed.
        """
        self._meter.leave_own()
        try:
            extra = extra or {}
            state = self._publisher.publish_devices(extra, include_time)
            if state is None:
                state = self._publisher.unread(extra, include_time)
            return state
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("auto_publish", error)
            return {}
        finally:
            self._meter.leave_bridge()

    def keep(self, reason: str) -> None:
        """Keep the last `keep_last_s` seconds at full rate, and the two that follow.

        Every call of `publish` in them becomes a row, also those that the throttle drops. The
        bridge does this by itself where a breakpoint with the action `pause` or `keep` is hit, with
        a log line of the level `error` or above, and where an exception ends the controller. The
        held calls are written with the calls that follow, about a millisecond at a time. Stretches
        that overlap become one; at most 600 s of a run are kept.

        Args:
            reason: Why they are kept; it is stored with the segment.
        """
        from webots_mcp.bridge.encoding import text_of

        try:
            self._session.full_rate.keep(text_of(reason))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("keep", error)

    def keep_camera(self, camera: Any, frames_per_s: float = 5.0) -> None:
        """Hold small frames of a camera with the last seconds, and keep them with those.

            bridge.keep_camera(camera)

        With `publish` the camera's newest image is taken at that rate, scaled down to 160 pixels at
        most (each n-th of a row, each n-th row), and held in memory: the last 78 frames of all
        cameras, up to 8 MB. One is also taken at the step of a breakpoint's hit. In a
        full-rate segment they become PNG files, one with each call (about a millisecond), which
        exist as long as the segment. A frame that could not be taken is counted in `stats()`; a
        camera's second such frame is logged. Nothing is taken if `keep_last_s` is 0.

        Args:
            camera: A Webots `Camera`; it may be enabled later.
            frames_per_s: Frames per second of simulation time, up to 100, and at most as many as
                the camera's sampling period allows. A later call for the same camera changes it.
        """
        try:
            full_rate = self._session.full_rate
            if not full_rate.enabled:
                raise CommandRefusedError(full_rate.why_not)
            full_rate.frames.watch(camera, frames_per_s)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("keep_camera", error)

    # -- logs and pictures ---------------------------------------------------------------------

    def log(self, message: object, level: str | int = "info") -> None:
        """Record a log line; its first 10,000 characters are stored.

        Args:
            message: Its text.
            level: `debug`, `info`, `warning` (or `warn`), `error` or `critical`, in either case,
                or a number as in `logging` (`logging.WARNING`); anything else counts as `info`.
        """
        self._log(message, level, None)

    def log_handler(self, level: int | str = 0) -> logging.Handler:
        """Return a handler that records what a controller logs with Python's `logging`.

            logging.getLogger().addHandler(bridge.log_handler())

        Each line has its level and the name of its logger. Any thread may log. A message that
        cannot be formatted is recorded as it was given, with the reason; nothing raises.

        Args:
            level: The handler records this level and those above it.
        """
        from webots_mcp.bridge.log_handler import LogHandler  # `logging` is a tenth of a start

        return LogHandler(self._log, level)

    def _log(self, message: object, level: object, logger: str | None) -> None:
        from webots_mcp.bridge.encoding import text_of

        try:
            known = find_log_level(level)
            if known is None:
                names = ", ".join(LOG_LEVELS)
                self._errors.warn("level", f"log level {level!r:.80} is not one of {names}")
            text = text_of(message)
            self._session.journal.log(known or "info", "controller", text, logger)
            if known in _KEEPING:
                self._session.full_rate.ask(f"{known}: {text}")
                self._session.variables.record("error", text, "log")
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("log", error)

    def save_camera_frame(self, camera: Any, max_frames: int = MAX_CAMERA_PICTURES) -> str | None:
        """Save the camera's current image as PNG, with a row in the database.

        Args:
            camera: A Webots `Camera` that is enabled.
            max_frames: How many frames of this camera are stored; older ones are deleted.

        Returns:
            The file's path relative to the data folder; None where there is no image yet.
        """
        try:
            return self._session.picture_files.save_frame(camera, max_frames)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("save_camera_frame", error)
            return None

    # -- commands and reloads ------------------------------------------------------------------

    def register_command(self, action: str, handler: Handler) -> None:
        """Let an assistant run `handler` as the custom action `action`.

        Built-in actions cannot be replaced: a handler for one is never called, which is logged
        once. The exception is `reset_state`, whose handler replaces the callbacks of `on_reload`.

        Args:
            action: Its name; the assistant reads the handler's docstring as its description.
            handler: Called inside `get_command()` with the command as one dict: `id`, `action`,
                `params`, and the parameters as keys. Its return value is the command's result; an
                exception is the command's error.

        Raises:
            ValueError: The name is empty, over 100 characters, or not printable.
            TypeError: The name is not a text, or the handler is not a plain function.
        """
        self._session.handlers.register(action, handler)

    def parameter(
        self,
        name: str,
        default: V,
        *,
        low: float | None = None,
        high: float | None = None,
        choices: Sequence[V] | None = None,
        doc: str = "",
        unit: str | None = None,
    ) -> Parameter[V]:
        """Declare a value that an assistant may tune while the controller runs.

            kp = bridge.parameter("kp", 2.0, low=0.0, high=10.0, doc="steering gain")
            while robot.step(time_step) != -1:
                motor.setVelocity(kp.value * error)
                bridge.get_command()

        It begins with its value in the environment variable `WEBOTS_MCP_PARAMETERS` (a JSON object
        of names and values), else with `default`. It changes only inside `get_command()` and when
        the world is reset; each value is recorded with its time. A reset keeps the values, a
        reload begins with the first ones again. Declaring a name again updates its declaration,
        and a log line names the differences.

        Args:
            name: Up to 100 characters, without a space or `=`; `arm.kp` is fine.
            default: A float, int, bool or str, which decides the type.
            low: The smallest value of a number; None without a bound.
            high: The largest value of a number; None without a bound.
            choices: The only values that it may have.
            doc: A description for the assistant.
            unit: The unit of a number, such as `m/s`.

        Raises:
            TypeError: An argument has an invalid type.
            ValueError: One is out of bounds, they contradict each other, or there are 500
                parameters already.
        """
        from webots_mcp.signals.parameter import declare

        declaration = declare(
            name, default, low=low, high=high, choices=choices, doc=doc, unit=unit
        )
        return self._session.parameters.declare(declaration)

    def describe(
        self,
        name: str,
        *,
        quantity: str | None = None,
        role: str | None = None,
        unit: str | None = None,
        target_of: str | None = None,
        same_as: str | None = None,
        side: str | None = None,
        low: float | None = None,
        high: float | None = None,
    ) -> None:
        """Say what a published signal means if its name does not.

            bridge.describe("u", quantity="speed", role="commanded", unit="m/s")
            bridge.describe("q.*", quantity="joint position", unit="rad", low=-1.5, high=1.5)

        Events, checks and comparisons then use it, also for runs that were recorded before. A
        signal whose meaning is unknown is not judged. The declaration is stored with the robot; a
        later one replaces it. 'webots-mcp help meanings' lists the quantities
        and the names that need no description.

        Args:
            name: The dotted name of the signal, such as `motors.left`. A `*` stands for any text.
            quantity: What it measures or sets, such as `speed`, `wheel speed` or `distance`.
            role: `measured`, `commanded`, `target` or `limit`.
            unit: Its unit, such as `m/s`.
            target_of: The measured signal whose target it is.
            same_as: Another signal that measures the same.
            side: The part of the robot, such as `left` or `front right`.
            low: The lowest value that it can have.
            high: The highest value that it can have.

        Raises:
            ValueError: A value is not allowed (the text lists those that are), nothing is said, or
                there are 2,000 declarations already.
        """
        from webots_mcp.signals.meaning import declare_meaning

        said = {
            "quantity": quantity, "role": role, "unit": unit, "target_of": target_of,
            "same_as": same_as, "side": side, "low": low, "high": high,
        }  # fmt: skip
        self._session.meanings.declare(declare_meaning(name, **said))

    def breakpoint(
        self, condition: str, action: BreakpointAction = "pause", after_hits: int = 1
    ) -> int | None:
        """Pause, keep or log when a condition begins to hold, as long as this session lasts.

            bridge.breakpoint("front_m < 0.1 for 0.5", action="log")

        It is evaluated on each published state, also on those that are not recorded, and is armed
        again after a reset. A hit is recorded as an event with the values of the condition's
        signals, and its state is recorded too.

        Args:
            condition: In the language of 'webots-mcp help conditions'.
            action: `pause` pauses the simulation at that step, which needs a Supervisor; `keep`
                keeps the seconds around the hit at full rate (see `keep`), as `pause` does too;
                `log` only records the hit.
            after_hits: The action is taken from this hit of a run on.

        Returns:
            Its id; None while the database cannot be written.

        Raises:
            InvalidInputError: The condition or the action is invalid, or there are 32 breakpoints
                already.
        """
        return self._session.breakpoints.set(condition, action, after_hits)

    def expect(
        self, condition: str, *, during: str | None = None, name: str | None = None
    ) -> int | None:
        """State what must hold, always or while `during` holds, as long as this session lasts.

            bridge.expect("front_m > 0.1", during="mode == 'drive'", name="keeps its distance")

        It is evaluated like a breakpoint. When it stops holding, an event of the kind `violation`
        is recorded, and the seconds around it are kept at full rate (see `keep`). States without a
        value of the condition are not judged. `webots-mcp check` reports the share of the time in
        which it held.

        Args:
            condition: In the language of 'webots-mcp help conditions'. With `within 20` at
                its end it must hold once, within 20 seconds from the start of the run.
            during: Only while this condition holds.
            name: The name in reports; by default the condition.

        Returns:
            Its id among the breakpoints; None while the database cannot be written.

        Raises:
            InvalidInputError: A condition or the name is invalid, or there are 32 breakpoints and
                expectations already.
        """
        return self._session.breakpoints.expect(condition, during, name)

    def on_reload(self, callback: Callable[[], object]) -> None:
        """Call `callback` once for each reload or reset of the world, and on `reset_state`.

        A Supervisor's reset happens inside the same process (simulation time goes back); a reload
        starts a new process, which recognises its predecessor in the database.
        """
        self._session.reloads.add(callback)

    def detect_reload(self) -> bool:
        """Return whether the world was reloaded or reset since the last call, once for each."""
        reloads = self._session.reloads
        try:
            self._session.check_clock()
            reloads.fire()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("detect_reload", error)
        return reloads.detect()

    # -- the bridge itself ---------------------------------------------------------------------

    @property
    def robot_name(self) -> str:
        """The name under which this robot is recorded: its own, or `name#2` if that is taken."""
        return self._session.robot_name

    @property
    def run_id(self) -> int | None:
        """Id of the current run; None while nothing has been written yet."""
        return self._session.clock.run.id

    @property
    def restored(self) -> RestoredState | None:
        """What a controller in a branch continues with; None in any other run.

            if bridge.restored is not None:
                mode = bridge.restored.state["mode"]
                integral = bridge.restored.state["integral"]

        A branch is a copy of the world at a moment of another run ('webots-mcp help branches').
        Webots brings back positions and velocities; the controller starts anew, and takes its own
        variables from here. Reading it the first time is recorded as an event.
        """
        origin = self._session.origin
        if origin is None or origin.restored is None:
            return None
        moment = origin.restored
        if not self._restored_read:
            self._restored_read = True
            try:
                where: dict[str, object] = {"run_id": moment.run_id, "at_s": moment.sim_time_s}
                self._session.journal.event(RESTORED_EVENT, where)
            except Exception as error:  # noqa: BLE001  (the robot comes first)
                self._errors.failed("restored", error)
        return moment

    def stats(self) -> BridgeStats:
        """Return how much was recorded so far and how much was not, and how long it took."""
        recorder, throttle = self._session.recorder, self._session.throttle
        publisher = self._publisher
        return BridgeStats(
            rows_written=recorder.rows_written,
            rows_waiting=recorder.rows_waiting,
            rows_dropped=recorder.rows_dropped,
            publish_calls=throttle.calls,
            publish_throttled=throttle.skipped,
            values_replaced=self._session.journal.values_replaced,
            publish_mean_us=1e6 * publisher.total_s / max(1, publisher.recorded),
            publish_max_us=1e6 * publisher.longest_s,
            ring_interval=publisher.devices.ring_interval,
            frames_missed=self._session.full_rate.frames.missed,
            failures=self._errors.failures,
            last_error=self._errors.last_error,
        )

    def close(self, reason: str | None = None) -> None:
        """Write the waiting rows and end the session; what is published afterwards is dropped.

        No data is lost without it: every row is written when its call returns. In a handler of
        `register_command` the bridge closes once the command's answer is written.

        Args:
            reason: How the session ended; `finished`, or `reload` after a reload command.
        """
        if self._closed:
            return
        if reason is None and self._session.handlers.running:
            self._close_after_answer = True  # a closed bridge could not write the answer
            return
        try:
            if self._attachment is not None:
                self._attachment.publish_missing()
                self._attachment.report_unseen()
            elif self._session.clock.moved_s is None:
                self._session.unseen.check(self._session.clock.sim_time_s)
            self.detach()
            self._session.release_loop()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("close", error)
        _bridges.pop(id(self.robot), None)
        if self._capture is not None:
            self._capture.close()
        try:
            self._session.close(reason)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("close", error)
        self._closed = True  # last: an interrupted call is repeated by `_close_at_exit`
        atexit.unregister(self._close_at_exit)

    def __enter__(self) -> MCPBridge:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is not None:
            self._record_exception(error)
        self.close("crashed" if error is not None else None)

    # -- inside --------------------------------------------------------------------------------

    def _serve(self) -> ClaimedCommand | None:
        command = self._session.serve()
        if self._close_after_answer:
            self.close()
        return command

    def _record_exception(self, error: BaseException) -> None:
        """Keep the seconds before an exception that ends the controller, and log it.

        An interrupt (Ctrl-C, SystemExit) is not logged as an error.
        """
        if self._closed:
            return
        from webots_mcp.bridge.error_report import describe

        why = f"{ENDED_BY} {describe(error)}"
        self._session.control.why_ended = why
        self.keep(why)
        if isinstance(error, Exception):
            self._session.journal.log("error", "controller", why)
            self._session.variables.record_uncaught(error, why)

    def _capture_output(self) -> Capture:
        from webots_mcp.bridge.capture import Capture  # only here: seldom needed

        capture = Capture(self._record_output)
        capture.begin()
        return capture

    def _record_output(self, stream: str, lines: Sequence[str]) -> None:
        try:
            self._session.journal.output(stream, lines)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("capture_output", error)

    def _leave_to_parent(self) -> None:
        """Leave the session to the parent of a forked child, which records nothing."""
        self._closed = True
        self.detach()
        if self._capture is not None:
            self._capture.abandon()
        self._session.abandon()

    def _close_at_exit(self) -> None:
        """Close when the interpreter ends, and record the exception that ended it, if any."""
        # `sys.last_value` is that exception, but at a prompt (ps1) it is the last one printed.
        error = None if hasattr(sys, "ps1") else getattr(sys, "last_value", None)
        if isinstance(error, BaseException):
            self._record_exception(error)
        self.close("crashed" if isinstance(error, Exception) else None)


def _seconds(name: str, variable: str, given: float) -> float:
    seconds = float(os.environ.get(variable) or given)
    if not 0 <= seconds <= _MOST_SECONDS:
        raise ValueError(f"{name} must be from 0 to {_MOST_SECONDS:g}, got {seconds!r}")
    return seconds


# -- the open bridges of this process --------------------------------------------------------------
# One per robot: a second one closes the first. Those of a parent that forked the process are
# dropped.


_bridges: dict[int, MCPBridge] = {}


def _leave_to_parent() -> None:
    for bridge in _bridges.values():
        bridge._leave_to_parent()  # pyright: ignore[reportPrivateUsage]
    _bridges.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


class BridgeStats(NamedTuple):
    """What a bridge recorded so far, and what it could not record.

    Attributes:
        rows_written: Rows that the database has taken.
        rows_waiting: Rows that it could not take yet: in the file next to it, else in memory.
        rows_dropped: Rows that will never be in it.
        publish_calls: Calls of `publish` and `auto_publish` in the session.
        publish_throttled: Calls that the throttle did not record.
        values_replaced: Values that JSON cannot hold; `replaced` of their row names them.
        publish_mean_us: The mean duration of a recorded call, in microseconds.
        publish_max_us: The longest duration of a recorded call, in microseconds.
        ring_interval: One call of `auto_publish` in this many is held in the ring buffer.
        frames_missed: Camera frames that could not be taken or written.
        failures: Calls of the bridge's methods that failed.
        last_error: The newest error, with its reason; None if there was none.
    """

    rows_written: int
    rows_waiting: int
    rows_dropped: int
    publish_calls: int
    publish_throttled: int
    values_replaced: int
    publish_mean_us: float
    publish_max_us: float
    ring_interval: int
    frames_missed: int
    failures: int
    last_error: str | None
