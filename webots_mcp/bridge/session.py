"""Builds the parts of a bridge for one controller process and connects them."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from webots_mcp.bridge.attachment import Attachment, UnseenSteps
from webots_mcp.bridge.branch_start import find_origin
from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.claimed_commands import ClaimedCommand, ClaimedCommands, Handlers, Reloads
from webots_mcp.bridge.control import Control
from webots_mcp.bridge.controller_actions import ControllerActions
from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.devices import DeviceReader, restart_motors
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.full_rate import FullRateRecorder
from webots_mcp.bridge.inspection_actions import InspectionActions
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.parameters import Parameters
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.picture_actions import PictureActions
from webots_mcp.bridge.picture_files import PictureFiles
from webots_mcp.bridge.publishing import Publisher
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration, identify
from webots_mcp.bridge.run_goal import Watch
from webots_mcp.bridge.running_actions import RunningActions
from webots_mcp.bridge.scene_actions import SceneActions
from webots_mcp.bridge.scene_recording import SceneRecording
from webots_mcp.bridge.signal_meanings import SignalMeanings
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.bridge.watchdog import Watchdog
from webots_mcp.bridge.world_actions import WorldActions
from webots_mcp.bridge.world_saving import WorldSaving
from webots_mcp.contract import UNMOVED, VERSION
from webots_mcp.database.location import Database, MemoryDatabase
from webots_mcp.database.maintenance import Maintainer
from webots_mcp.database.tapes import tape_notes

_IDLE_S: Final = 0.5  # a loop that recorded nothing for this time is blocked or waiting
_UNMOVED_S: Final = 10.0  # wall time after which a loop must have called the bridge


class BridgeSession:
    """All parts of a bridge, from its construction to its end, and the runs in it.

    Only this class knows how the parts are connected: no part knows the session.
    """

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
        self.origin = find_origin(self.identity.robot_name, errors)
        if self.origin is not None:
            self.identity = self.identity._replace(world=self.origin.world)
            throttle.begin_after(self.origin.calls)
        self.errors = errors
        self.simulation = simulation
        self.throttle = throttle
        self.clock = clock = Clock(simulation)
        self.recorder = recorder = Recorder(database, self.identity, clock, errors)
        self.journal = journal = Journal(recorder, clock)
        self.heartbeat = Heartbeat(recorder, clock)
        self.variables = ControllerVariables(clock, journal, errors, data_dir)
        self.reloads = Reloads(errors.failed)
        self.picture_files = PictureFiles(recorder, clock, data_dir)
        self.full_rate = FullRateRecorder(
            clock, recorder, journal, self.picture_files, throttle, keep_last_s
        )
        self.pause = Pause(
            simulation,
            journal,
            self.heartbeat,
            self.full_rate.write_all,
            self.check_clock_after_step,
        )
        self.handlers = Handlers(recorder, journal, self.pause)
        self.parameters = Parameters(
            clock, recorder, journal, self.handlers, errors, self.identity.robot_name
        )
        self.meanings = SignalMeanings(recorder)
        self.breakpoints = Breakpoints(
            simulation, clock, recorder, journal, self.pause, self.full_rate, self.variables
        )
        self.watch = Watch(clock, simulation.basic_time_step_s / 100)
        self.publisher = self._build_publisher()
        self.unseen = UnseenSteps(simulation, journal, errors)
        self._scene = SceneActions(simulation, clock, journal, errors)
        self._scene_recording = SceneRecording(simulation, clock, journal, data_dir)
        self.control = self._build_control()
        self._watchdog = Watchdog(
            simulation, clock, recorder, journal, self.variables, database, hang_after_s
        )
        self._began_s: float | None = time.monotonic()  # None once `_on_tick` has checked the loop
        self._maintainer = _start_maintainer(database, self._on_tick)

    def _build_publisher(self) -> Publisher:
        devices = DeviceReader(self.simulation, self.journal, self.errors, self._describe_devices)
        return Publisher(
            self.clock,
            self.recorder,
            self.journal,
            self.heartbeat,
            self.throttle,
            self.breakpoints,
            self.watch,
            self.full_rate,
            devices,
            self.reloads,
            self.variables,
            self.begin_run,
        )

    def _build_control(self) -> Control:
        simulation, clock, pause, queue = (
            self.simulation, self.clock, self.pause, ClaimedCommands(self.recorder)
        )  # fmt: skip
        world = WorldActions(
            simulation, clock, pause, queue, self.reloads, self._scene_recording.require_none
        )
        running = RunningActions(
            simulation,
            clock,
            pause,
            self.throttle,
            self.watch,
            self.breakpoints,
            self.parameters,
            world.reset_world,
            self.check_clock,
        )
        actions = (
            running,
            world,
            WorldSaving(simulation, clock, pause, self.throttle),
            PictureActions(simulation, clock, self.picture_files),
            self._scene,
            self._scene_recording,
            InspectionActions(self.variables),
            ControllerActions(
                clock, pause, self.reloads, self.parameters, self.breakpoints, self.full_rate
            ),
        )
        by_name = {name: action for part in actions for name, action in part.by_name().items()}
        parts = (simulation, clock, self.journal, self.heartbeat, queue, pause)
        return Control(*parts, self.reloads, self.handlers, by_name)

    def _describe_devices(self) -> None:
        """Record the meaning of the signals that `auto_publish` makes of devices."""
        from webots_mcp.bridge.device_meanings import (
            describe_devices,  # only where devices are read
        )

        simulation = self.simulation
        known = describe_devices(simulation.robot, is_supervisor=simulation.supervisor)
        self.meanings.record_devices(known)

    def attach(self, serve: Callable[[], ClaimedCommand | None]) -> Attachment:
        """Publish and serve commands with each step of the robot from now on.

        Args:
            serve: Serves the pending commands, as `get_command()` does.
        """
        attachment = Attachment(
            self.publisher,
            self.throttle,
            self.simulation,
            self.clock,
            self.pause,
            self.handlers,
            self.errors,
            self.unseen,
            serve,
            self.end,
        )
        attachment.begin()
        return attachment

    @property
    def robot_name(self) -> str:
        """The name under which the robot is recorded."""
        registration = self.recorder.registration
        return registration.robot_name if registration else self.identity.robot_name

    def begin(self) -> None:
        """Begin the first run, and continue a reload or a pause of the previous session."""
        registration = self.recorder.registration
        run, reloaded = self.clock.run, registration is not None and registration.reloaded
        run.start_reason = "reload" if reloaded else "start"
        self.journal.event(run.start_reason)
        if reloaded:
            self.reloads.happened()
        if registration is not None:
            self._continue_previous(registration)
        self.breakpoints.begin()
        self._watchdog.begin()

    def _continue_previous(self, registration: Registration) -> None:
        """Confirm a reload that the previous session requested, and continue its pause."""
        simulation, clock = self.simulation, self.clock
        mode = simulation.mode_name if simulation.supervisor else None
        values = {"now": time.time(), "sim_time": clock.sim_time_s, "mode": mode}
        self.recorder.record("reload confirmed", clock.run, values)
        if registration.left_waiting:
            self.pause.set_world_free()
        if registration.paused_mode is not None:
            self.pause.take_over(registration.paused_mode)

    def serve(self) -> ClaimedCommand | None:
        """Serve the pending commands and write the heartbeat, once in each round of the loop."""
        simulation = self.simulation
        self.check_clock()
        if simulation.over:
            return None
        self.parameters.take_wanted()
        if tape_notes.replayed is not None:
            self.parameters.take_replayed(tape_notes.replayed.parameters_due())
        if self.full_rate.busy:
            self.full_rate.go_on()
        command = self.control.serve()
        self.heartbeat.poll()
        if simulation.over:
            self.end()
        return command

    def check_clock(self, *, after_step: bool = False) -> None:
        """Begin a run if simulation time has gone back since the last call.

        Args:
            after_step: Whether a step has just ended.
        """
        if self.clock.update(after_step=after_step):
            self.begin_run()

    def check_clock_after_step(self) -> None:
        """Begin a run if simulation time went back in the step that has just ended."""
        self.check_clock(after_step=True)
        self.heartbeat.beat_if_due()

    def begin_run(self) -> None:
        """End the run at its newest known time and begin the next: simulation time went back."""
        self.publisher.episode.end(self.clock.ended_sim_time_s)
        self.recorder.end_run("reset", self.clock.ended_sim_time_s)
        self.clock.meter.begin_run()
        self.recorder.run = self.clock.run
        self.throttle.begin_run()
        self.reloads.happened()
        self.journal.event("reset")
        # Before the callbacks of `on_reload`, which may read parameters or set them.
        self.parameters.begin_run()
        self._scene.begin_run()
        restart_motors(self.simulation.robot, self.journal, self.errors.failed)
        self.reloads.fire()
        self.heartbeat.beat()

    def close(self, reason: str | None) -> None:
        """Write the waiting rows and end the session.

        Args:
            reason: How it ended. If None: `reload` after a reload command, otherwise `finished`.
        """
        # The maintainer first: its thread uses the recorder too.
        stop = () if self._maintainer is None else (self._maintainer.stop,)
        for close in (*stop, self._watchdog.close, self.full_rate.close):
            try:
                close()
            except Exception as error:  # noqa: BLE001, PERF203  (the session ends whatever fails)
                self.errors.failed("close", error)
        reason = reason or self._end_reason
        self.publisher.episode.end(self.clock.sim_time_s)
        self.recorder.close(reason, self.clock.sim_time_s)

    def release_loop(self) -> None:
        """Resume a paused simulation, and answer open commands now; no later call will."""
        self.pause.close()
        try:
            self._scene_recording.close()
        except Exception as error:  # noqa: BLE001  (the session ends whatever fails)
            self.errors.failed("close", error)
        self.control.report_end(extern=self.identity.extern)

    def abandon(self) -> None:
        """Leave the recording to the parent in a forked child."""
        self._watchdog.abandon()
        self.recorder.abandon()
        self.full_rate.abandon()

    @property
    def _end_reason(self) -> str:
        return "reload" if self.reloads.requested_by else "finished"

    def end(self) -> None:
        """Write everything when Webots ends the controller, since it may kill the process next.

        The session stays usable: the controller may run a few more statements and publish again.
        """
        self.control.report_end(extern=self.identity.extern)
        self.full_rate.write_all()
        self._watchdog.close()
        self.publisher.episode.end(self.clock.sim_time_s)
        self.recorder.end(self._end_reason, self.clock.sim_time_s)

    def _on_tick(self) -> None:
        """Do once a second, in the maintainer's thread, what a silent loop does not do.

        Write waiting rows, check whether the loop hangs, and warn once if it never calls the
        bridge. Webots' API must not be called in this thread, so whether simulation time advances
        is only known from the bridge's own calls.
        """
        recorder, began_s = self.recorder, self._began_s
        if recorder.rows_waiting and time.monotonic() - recorder.last_use_s > _IDLE_S:
            recorder.flush()
        self._watchdog.check()
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
