"""The session of one controller process: its parts, its runs, its states, its steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.bridge.actions import Control
from webots_mcp.bridge.breakpoints import Breakpoints, Watch
from webots_mcp.bridge.commands import ClaimedCommand, ClaimedCommands, Reloads
from webots_mcp.bridge.devices import DeviceReader, restart_motors
from webots_mcp.bridge.encoding import MAX_KEY_CHARACTERS, encode, key_text
from webots_mcp.bridge.error_report import ErrorReport, cut
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.keeping import Keeper
from webots_mcp.bridge.parameters import Parameters
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.pictures import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration, identify
from webots_mcp.bridge.scene_changes import SceneEdits
from webots_mcp.bridge.simulation import QUIT, Clock, Simulation, Step
from webots_mcp.bridge.watchdog import Watchdog
from webots_mcp.contract import UNMOVED, UNSEEN, VERSION
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.maintenance import Maintainer
from webots_mcp.signals.register import SignalNames, StateChanges

_IDLE_S: Final = 0.5  # a loop that recorded nothing for so long is blocked or waiting
_UNSEEN_S: Final = 1.0  # of simulation time; less may be one step whose end an interrupt hid
_BYTES_OF_A_CHARACTER: Final = 6  # of JSON: a number of 10 characters and its key take 100 bytes
_UNMOVED_S: Final = 10.0  # of wall time
_WHAT: Final = "the attached step"


class Throttle:
    """Admits one call in `interval`, and each call that is wanted for another reason.

    Attributes:
        interval: One call in this many is recorded.

    Raises:
        ValueError: The interval is less than 1.
    """

    def __init__(self, interval: int) -> None:
        if interval < 1:
            raise ValueError(f"throttle_interval must be 1 or more, got {interval!r}")
        self.interval = interval
        self._wanted = False
        self._calls_before_run = 0
        self.calls = 0
        self.skipped = 0
        self.stale = False  # the newest published state is not the newest recorded one

    def begin_run(self) -> None:
        """Count from here, so that equal runs are recorded at equal times."""
        self._calls_before_run = self.calls

    def want(self) -> None:
        """Admit the next call, whatever its number."""
        self._wanted = True

    def admits(self, force: object) -> bool:
        """Count a call; True if it is to be recorded, which any true value of `force` demands."""
        self.calls += 1
        if (self.calls - self._calls_before_run) % self.interval and not (force or self._wanted):
            self.skipped += 1
            self.stale = True
            return False
        self._wanted = self.stale = False
        return True


class Session:
    """All parts of a bridge, from its construction to its end, and the runs in it."""

    def __init__(
        self,
        simulation: Simulation,
        database: Database,
        data_dir: Path,
        throttle: Throttle,
        keep_last_s: float,
        errors: ErrorReport,
        kind: str | None = None,
        hang_after_s: float = 0.0,
    ) -> None:
        robot = (simulation.robot, simulation.supervisor)
        self.identity = identify(*robot, VERSION, throttle.interval, kind)
        self.errors = errors
        self.simulation = simulation
        self.throttle = throttle
        self.clock = Clock(simulation)
        self.recorder = Recorder(database, self.identity, self.clock, errors)
        self.journal = Journal(self.recorder, self.clock)
        self.heartbeat = Heartbeat(self.recorder, self.clock)
        self.reloads = Reloads(errors.failed)
        self.parameters = Parameters(self, self.identity.robot_name)
        self.scene = SceneEdits(self)
        self.album = Album(self, data_dir)
        self.keeper = Keeper(self, keep_last_s)
        self.pause = Pause(self)
        self.queue = ClaimedCommands(self.recorder)
        self.breakpoints = Breakpoints(self)
        self.watch = Watch(self.clock, simulation.basic_time_step_s / 100)
        self.control = Control(self)
        self.publisher = Publisher(self)
        self._watchdog = Watchdog(self, database, hang_after_s)
        self._unseen_reported = False
        self._began_s: float | None = time.monotonic()  # None once `_look_after` has judged it
        self._maintainer = _start_maintainer(database, self._look_after)

    @property
    def robot_name(self) -> str:
        """The name under which the robot is recorded."""
        registration = self.recorder.registration
        return registration.robot_name if registration else self.identity.robot_name

    def begin(self) -> None:
        """Begin the first run, and continue the previous session's reload or pause."""
        registration = self.recorder.registration
        run, reloaded = self.clock.run, registration is not None and registration.reloaded
        run.start_reason = "reload" if reloaded else "start"
        self.journal.event(run.start_reason)
        if reloaded:
            self.reloads.happened()
        if registration is not None:
            self._succeed_to(registration)
        self.breakpoints.begin()
        self._watchdog.begin()

    def _succeed_to(self, registration: Registration) -> None:
        simulation, clock = self.simulation, self.clock
        mode = simulation.mode_name if simulation.supervisor else None
        values = {"now": time.time(), "sim_time": clock.sim_time_s, "mode": mode}
        self.recorder.record("reload confirmed", clock.run, values)
        if registration.left_waiting:
            self.pause.set_world_free()
        if registration.paused_mode is not None:
            self.pause.take_over(registration.paused_mode)

    def serve(self) -> ClaimedCommand | None:
        """One round of the loop: the pending commands, and the heartbeat."""
        simulation = self.simulation
        self.look()
        if simulation.over:
            return None
        self.parameters.take_wanted()
        if self.keeper.busy:
            self.keeper.go_on()
        command = self.control.serve()
        self.heartbeat.poll()
        if simulation.over:
            self.end()
        return command

    def look(self, *, after_step: bool = False) -> None:
        """Begin a run if simulation time went back since the last call.

        Args:
            after_step: A step has just ended.
        """
        if self.clock.look(after_step=after_step):
            self.begin_run()

    def look_after_step(self) -> None:
        """Look right after a step, before the loop's own code runs."""
        self.look(after_step=True)
        self.heartbeat.beat_if_due()

    def begin_run(self) -> None:
        """Simulation time went back: end the old run at its newest known time, begin a new one."""
        self.recorder.end_run("reset", self.clock.ended_sim_time_s)
        self.clock.meter.begin_run()
        self.recorder.run = self.clock.run
        self.throttle.begin_run()
        self.reloads.happened()
        self.journal.event("reset")
        # Before the callbacks, which may read values that waited for the reset, and set others.
        self.parameters.begin_run()
        self.scene.begin_run()
        restart_motors(self)
        self.reloads.fire()
        self.heartbeat.beat()

    def look_for_unseen(self, seen_s: float) -> None:
        """Warn once that the loop makes steps that the bridge does not see.

        Args:
            seen_s: The newest simulation time at which the bridge saw the loop.
        """
        simulation = self.simulation
        if self._unseen_reported or simulation.over:
            return
        unseen_s = simulation.time_s - seen_s
        if unseen_s < _UNSEEN_S or not simulation.waits_for_robot:
            return
        self._unseen_reported = True
        text = f"{UNSEEN}; so far it has missed {unseen_s:.1f} s of simulation time"
        self.journal.log("warning", "bridge", text)
        self.errors.warn("unseen", text)

    def close(self, reason: str | None) -> None:
        """Write the waiting rows and end, for the given or the known reason."""
        # The maintainer first: its thread uses the recorder too.
        stop = () if self._maintainer is None else (self._maintainer.stop,)
        for close in (*stop, self._watchdog.close, self.keeper.close):
            try:
                close()
            except Exception as error:  # noqa: BLE001, PERF203  (the session ends whatever fails)
                self.errors.failed("close", error)
        reason = reason or self._end_reason
        self.recorder.close(reason, self.clock.sim_time_s)

    def let_go(self) -> None:
        """Resume a paused simulation, which no command could resume later, and answer commands."""
        self.pause.close()
        self.control.report_end(extern=self.identity.extern)

    def abandon(self) -> None:
        """In a forked child: leave the recording to the parent."""
        self._watchdog.abandon()
        self.recorder.abandon()
        self.keeper.abandon()

    @property
    def _end_reason(self) -> str:
        return "reload" if self.reloads.requested_by else "finished"

    def end(self) -> None:
        """Write everything when Webots says quit: it may kill the process from here on.

        The session stays usable, since the loop may also continue for a last few statements.
        """
        self.control.report_end(extern=self.identity.extern)
        self.keeper.write_all()
        self._watchdog.close()
        self.recorder.end(self._end_reason, self.clock.sim_time_s)

    def _look_after(self) -> None:
        """Called in the maintainer's thread, for a loop that is blocked or never calls the bridge.

        Waiting rows are written. Webots' API must not be called in this thread, so it is not known
        here whether simulation time advances without the bridge.
        """
        recorder, began_s = self.recorder, self._began_s
        if recorder.rows_waiting and time.monotonic() - recorder.last_use_s > _IDLE_S:
            recorder.flush()
        self._watchdog.look()
        if began_s is None or time.monotonic() - began_s < _UNMOVED_S:
            return
        self._began_s = None
        if self.clock.moved_s is None and not self.heartbeat.polled:
            self.journal.log("warning", "bridge", UNMOVED)


def _start_maintainer(database: Database, on_tick: Callable[[], Any]) -> Maintainer | None:
    """Start the maintainer; a database in memory has no write-ahead log to keep short."""
    if isinstance(database, MemoryDatabase):
        return None
    maintainer = Maintainer(database, "bridge", on_tick=on_tick)
    maintainer.start()
    return maintainer


class Publisher:
    """Handles each call of `publish` and `auto_publish`.

    Attributes:
        recorded: Recorded calls.
        total_s: The time that they took.
        longest_s: The longest of them.
        devices: Reads the devices for `auto_publish`.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._clock = session.clock
        self._heartbeat = session.heartbeat
        self._throttle = session.throttle
        self._breakpoints = session.breakpoints
        self._watch = session.watch
        self._keeper = session.keeper
        self._changes = StateChanges()
        self._names = SignalNames()
        session.recorder.new_database_entries.append(self._names.begin_anew)
        self.devices = DeviceReader(session)
        self._run = session.clock.run
        self._own_bytes = 0  # that a state of the devices takes in memory, about
        self.recorded = 0
        self.total_s = self.longest_s = 0.0

    def publish(self, state: Mapping[Any, Any], force: bool, own_bytes: int = 0) -> None:
        """Record the state if this call is due, a breakpoint is hit or a goal is reached."""
        if self._clock.look():
            self._session.begin_run()
        wanted, hit, keeper, breakpoints = force, None, self._keeper, self._breakpoints
        # Tested here, since even an empty call would slow down every `publish`.
        if breakpoints.armed or breakpoints.run is not self._clock.run:
            hit = breakpoints.look(state)
            wanted |= breakpoints.reaches  # the past, asked of rows, is the same
        if self._watch.asks_states:
            wanted = self._watch.look(state) or wanted
        if self._throttle.admits(wanted or hit or self._heartbeat.loop):
            self._record(state)
        elif keeper.fills:
            keeper.add(state, own_bytes)
        if keeper.frames.cameras:
            self._look_at_cameras(at_once=bool(hit))
        if hit:
            breakpoints.act(hit, state)  # after recording: a pause must show the state of the hit
        if keeper.busy:
            keeper.go_on()

    def publish_devices(
        self, extra: Mapping[Any, Any], include_time: bool, force: bool = False
    ) -> dict[Any, Any] | None:
        """Record the devices' values; they are read if this call is due.

        Where breakpoints are armed or a run has a goal, they are read in every call; for the ring
        buffer as often as the limit on the time for reading allows.

        Returns:
            The state; None where the devices were not read.
        """
        state = None
        if self._clock.look():
            self._session.begin_run()
        keeper, throttle = self._keeper, self._throttle
        due = keeper.fills and (throttle.calls + 1) % self.devices.ring_interval == 0
        if due or self._breakpoints.ask_states() or self._watch.asks_states:
            state = self._read(extra, include_time)
            # What the devices say is made anew each time: nothing else can change it.
            self.publish(state, force, own_bytes=0 if extra else self._own_bytes)
            return state
        if throttle.admits(force or self._heartbeat.loop is not None):
            state = self._read(extra, include_time)
            self._record(state)
        elif keeper.fills:
            keeper.leave_out(self.devices.why)
        if keeper.frames.cameras:
            self._look_at_cameras(at_once=False)
        if keeper.busy:
            keeper.go_on()
        return state

    def unread(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        """A state without the devices."""
        return ({"time": self._clock.sim_time_s} if include_time else {}) | _finite(extra)

    def _look_at_cameras(self, *, at_once: bool) -> None:
        """Hold due camera frames with the states; at a hit take one of each camera."""
        keeper = self._keeper
        if at_once or keeper.frames.is_due(self._clock.sim_time_s):
            keeper.look_at_cameras(at_once=at_once)

    def _read(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        return self.devices.read() | self.unread(extra, include_time)

    def _record(self, state: Mapping[Any, Any]) -> None:
        started_s = time.perf_counter()
        self._session.reloads.fire()
        encoded = encode(state)
        if not encoded.text.startswith("{"):
            raise TypeError(f"publish() takes a dict, got {type(state).__name__}")
        self._session.journal.state(encoded)
        if isinstance(state, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            self._record_changes(state)
        self._own_bytes = _BYTES_OF_A_CHARACTER * len(encoded.text)
        self._names.look(state, encoded.text, self._session.recorder.enter_signals)
        self._heartbeat.beat_if_due()
        self._count(time.perf_counter() - started_s)

    def _count(self, duration_s: float) -> None:
        self.recorded += 1
        self.total_s += duration_s
        if duration_s > self.longest_s:
            self.longest_s = duration_s

    def _record_changes(self, state: Mapping[Any, Any]) -> None:
        if self._clock.run is not self._run:
            self._run = self._clock.run
            self._changes.forget()
        for name, before, after in self._changes.look(state):
            shown = cut(key_text(name), MAX_KEY_CHARACTERS)
            self._session.journal.event("change", {"from": before, "to": after}, shown)


def _finite(extra: Mapping[Any, Any]) -> dict[Any, Any]:
    """A mapping as a dict of `len` items: the iterator of a user's own mapping may be endless."""
    if extra.__class__ is dict:
        return cast("dict[Any, Any]", extra)
    if not isinstance(extra, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"a state must be a dict, got {type(extra).__name__}")
    return dict(islice(extra.items(), len(extra)))


# -- attached steps --------------------------------------------------------------------------------
# What each step of an attached robot does in addition: publish the devices and serve commands.  A
# round of the controller's loop lies between two steps. The devices' values are published when a
# step ends, so that they are recorded whatever the controller does next. Commands are served when
# the next step begins, as a call of `get_command()` at the end of the loop would: by then the
# controller has computed its reaction to the last step. Where the controller publishes by itself,
# the bridge does not publish a second time: the devices' values become part of the controller's
# own row.


class Attachment:
    """Listens to the steps of a robot, from `begin` to `end`. Nothing raises into a step.

    Args:
        session: Publishes states.
        serve: Serves the pending commands, as `get_command()` does.
    """

    def __init__(self, session: Session, serve: Callable[[], ClaimedCommand | None]) -> None:
        self._session = session
        self._serve = serve
        self._errors = session.errors
        self._throttle = session.throttle
        self._pause = session.pause
        self._clock = session.clock
        self._calls = self._throttle.calls  # of publish, up to the end of the last step
        self._left_to_controller = False  # the controller published in the last round
        self._last_served: ClaimedCommand | None = None

    def begin(self) -> None:
        """Listen to each step from now on."""
        self._session.control.handlers.loop_polls = False
        self._clock.stepped_s = self._session.simulation.time_s
        self._pause.listen_to_steps(self)

    def end(self) -> None:
        """Listen to no more steps."""
        self._session.control.handlers.loop_polls = True
        self._pause.listen_to_steps(None)

    def take_command(self) -> ClaimedCommand | None:
        """The command that was served last, for a loop that also calls `get_command()`."""
        self._session.control.handlers.loop_polls = True
        command, self._last_served = self._last_served, None
        if self._clock.sim_time_s > self._clock.stepped_s:
            self.look_for_unseen()
        return command

    def look_for_unseen(self) -> None:
        """Warn once where simulation time advanced by steps that the bridge did not see."""
        self._session.look_for_unseen(self._clock.stepped_s)

    def before(self, step: Step) -> None:
        """The controller's round is over: publish its state if it did not, and serve commands."""
        if step.finishes or self._pause.in_user_code:
            return
        try:
            self.publish_missing()
            self._last_served = self._serve() or self._last_served
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def after(self, step: Step, answer: int) -> None:
        """A step has ended, or Webots asks the controller to quit."""
        try:
            if answer == QUIT:
                self._session.end()
            elif step.ends:
                self._publish_round()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed(_WHAT, error)

    def publish_missing(self) -> None:
        """Publish the devices where the controller published a round ago, but not in this one."""
        over = self._session.simulation.over
        if self._left_to_controller and self._throttle.calls == self._calls and not over:
            self._publish()

    def _publish_round(self) -> None:
        self._left_to_controller = self._throttle.calls > self._calls
        self._calls = self._throttle.calls
        if not self._left_to_controller:
            self._publish()

    def _publish(self) -> None:
        self._left_to_controller = False
        try:
            self._session.publisher.publish_devices({}, include_time=True)
        finally:
            self._calls = self._throttle.calls
