"""The session of one controller process: its parts, its start and its end."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.command_queue import ClaimedCommand, ClaimedCommands
from webots_mcp.bridge.context import Context
from webots_mcp.bridge.control import Control
from webots_mcp.bridge.declared_parameters import CODE, Parameters
from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.goal import Watch
from webots_mcp.bridge.heartbeat import Heartbeat
from webots_mcp.bridge.identity import identify
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.keeping import Keeper
from webots_mcp.bridge.motors import Motors
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.picture_files import Album
from webots_mcp.bridge.publisher import Publisher
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Registration
from webots_mcp.bridge.reloads import Reloads
from webots_mcp.bridge.run_starts import Runs
from webots_mcp.bridge.scene_edits import SceneEdits
from webots_mcp.bridge.start_values import StartValues
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.bridge.webots_api import Simulation
from webots_mcp.contract import (
    PARAMETERS_VARIABLE,
    UNMOVED,
    UNSEEN,
    Database,
    MemoryDatabase,
)
from webots_mcp.errors import WebotsMCPError
from webots_mcp.maintenance import Maintainer

_IDLE_S: Final = 0.5  # a loop that recorded nothing for so long is blocked or waiting
_UNSEEN_S: Final = 1.0  # of simulation time; less may be one step whose end an interrupt hid
_UNMOVED_S: Final = 10.0  # of wall time


class Session:
    """All parts of a bridge, from its construction to its end.

    Attributes:
        context: The parts that commands work with.
        control: Serves commands.
        publisher: Handles published states.
        runs: Detects resets.
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
    ) -> None:
        from webots_mcp import __version__

        self._identity = identify(
            simulation.robot, simulation.supervisor, __version__, throttle.interval, kind
        )
        clock = Clock(simulation)
        recorder = Recorder(database, self._identity, clock, errors)
        journal, heartbeat = Journal(recorder, clock), Heartbeat(recorder, clock)
        reloads = Reloads(errors.failed)
        given = os.environ.get(PARAMETERS_VARIABLE)
        start_values = StartValues(given, self._identity.robot_name, errors)
        parameters = Parameters(clock, recorder, journal, start_values, self._set_parameter)
        scene = SceneEdits(simulation, clock, journal, errors.failed)
        motors = Motors(simulation, journal, errors.failed)
        self.runs = Runs(
            clock, recorder, journal, heartbeat, reloads, parameters, throttle, scene, motors
        )
        album = Album(recorder, clock, data_dir)
        keeper = Keeper(clock, recorder, journal, album, throttle, keep_last_s)
        look = self.runs.look_after_step
        pause = Pause(simulation, journal, heartbeat, look, keeper.write_all)
        self.context = Context(
            simulation=simulation,
            clock=clock,
            recorder=recorder,
            journal=journal,
            album=album,
            heartbeat=heartbeat,
            throttle=throttle,
            reloads=reloads,
            queue=ClaimedCommands(recorder),
            pause=pause,
            parameters=parameters,
            breakpoints=Breakpoints(simulation, clock, recorder, journal, pause, keeper),
            watch=Watch(clock, simulation.basic_time_step_s / 100),
            keeper=keeper,
            scene=scene,
        )
        self.control = Control(self.context)
        self.publisher = Publisher(self.context, self.runs)
        self._unseen_reported = False
        self._began_s: float | None = time.monotonic()  # None once `_look_after` has judged it
        self._maintainer = _start_maintainer(database, self._look_after)

    @property
    def robot_name(self) -> str:
        """The name under which the robot is recorded."""
        registration = self.context.recorder.session.registration
        return registration.robot_name if registration else self._identity.robot_name

    def begin(self) -> None:
        """Begin the first run, and continue the previous session's reload or pause."""
        registration = self.context.recorder.session.registration
        self.runs.begin_first(reloaded=registration is not None and registration.reloaded)
        if registration is not None:
            self._succeed_to(registration)
        self.context.breakpoints.begin()

    def _succeed_to(self, registration: Registration) -> None:
        simulation, clock = self.context.simulation, self.context.clock
        mode = simulation.mode_name if simulation.supervisor else None
        values = {"now": time.time(), "sim_time": clock.sim_time_s, "mode": mode}
        self.context.recorder.record("reload confirmed", clock.run, values)
        if registration.paused_mode is not None:
            self.context.pause.take_over(registration.paused_mode)

    def serve(self) -> ClaimedCommand | None:
        """One round of the loop: the pending commands, and the heartbeat."""
        simulation = self.context.simulation
        self.runs.look()
        if simulation.over:
            return None
        self._take_wanted_parameters()
        if self.context.keeper.busy:
            self.context.keeper.go_on()
        self.context.scene.look()
        command = self.control.serve()
        self.context.heartbeat.poll()
        if simulation.over:
            self.end()
        return command

    def _take_wanted_parameters(self) -> None:
        try:
            self.context.parameters.take_wanted()
        except WebotsMCPError as error:
            self.context.recorder.errors.failed("Parameter.set", error)

    def _set_parameter(self, name: str, value: object) -> None:
        """Set a parameter from the controller's code: at once in a handler, else at the next call.

        Within a round of the loop values must not change, so it waits for `get_command()` there.
        """
        parameters = self.context.parameters
        if self.control.handlers.running:
            parameters.set_now({name: value}, CODE)
            return
        try:
            parameters.want(name, value)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self.context.recorder.errors.failed("Parameter.set", error)

    def look_for_unseen(self, seen_s: float) -> None:
        """Warn once that the loop makes steps that the bridge does not see.

        Args:
            seen_s: The newest simulation time at which the bridge saw the loop.
        """
        simulation = self.context.simulation
        if self._unseen_reported or simulation.over:
            return
        unseen_s = simulation.time_s - seen_s
        if unseen_s < _UNSEEN_S or not simulation.waits_for_robot:
            return
        self._unseen_reported = True
        text = f"{UNSEEN}; so far it has missed {unseen_s:.1f} s of simulation time"
        self.context.journal.log("warning", "bridge", text)
        self.context.recorder.errors.warn("unseen", text)

    def close(self, reason: str | None) -> None:
        """Write the waiting rows and end, for the given or the known reason."""
        if self._maintainer is not None:
            self._maintainer.stop()  # first: its thread uses the recorder too
        self.context.keeper.close()
        reason = reason or self._end_reason
        self.context.recorder.close(reason, self.context.clock.sim_time_s)

    def let_go(self) -> None:
        """Resume a paused simulation, which no command could resume later, and answer commands."""
        self.context.pause.close()
        self.control.report_end(extern=self._identity.extern)

    @property
    def _end_reason(self) -> str:
        return "reload" if self.context.reloads.requested_by else "finished"

    def end(self) -> None:
        """Write everything when Webots says quit: it may kill the process from here on.

        The session stays usable, since the loop may also continue for a last few statements.
        """
        self.control.report_end(extern=self._identity.extern)
        self.context.keeper.write_all()
        self.context.recorder.end(self._end_reason, self.context.clock.sim_time_s)

    def _look_after(self) -> None:
        """Called in the maintainer's thread, for a loop that is blocked or never calls the bridge.

        Waiting rows are written. Webots' API must not be called in this thread, so it is not known
        here whether simulation time advances without the bridge.
        """
        recorder, began_s = self.context.recorder, self._began_s
        if recorder.rows_waiting and time.monotonic() - recorder.last_use_s > _IDLE_S:
            recorder.flush()
        if began_s is None or time.monotonic() - began_s < _UNMOVED_S:
            return
        self._began_s = None
        if self.context.clock.moved_s is None and not self.context.heartbeat.polled:
            self.context.journal.log("warning", "bridge", UNMOVED)


def _start_maintainer(database: Database, on_tick: Callable[[], Any]) -> Maintainer | None:
    """Start the maintainer; a database in memory has no write-ahead log to keep short."""
    if isinstance(database, MemoryDatabase):
        return None
    maintainer = Maintainer(database, "bridge", on_tick=on_tick)
    maintainer.start()
    return maintainer
