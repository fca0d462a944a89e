"""Beginning runs: the first of a session, and one at each reset of the world."""

from __future__ import annotations

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.declared_parameters import Parameters
from webots_mcp.bridge.heartbeat import Heartbeat
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.motors import Motors
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.reloads import Reloads
from webots_mcp.bridge.scene_edits import SceneEdits
from webots_mcp.bridge.throttle import Throttle


class Runs:
    """Begins each run, and calls the controller's callbacks."""

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        heartbeat: Heartbeat,
        reloads: Reloads,
        parameters: Parameters,
        throttle: Throttle,
        scene: SceneEdits,
        motors: Motors,
    ) -> None:
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._heartbeat = heartbeat
        self._reloads = reloads
        self._parameters = parameters
        self._throttle = throttle
        self._scene = scene
        self._motors = motors

    def look(self, *, after_step: bool = False) -> None:
        """Begin a run if simulation time went back since the last call.

        Args:
            after_step: A step has just ended.
        """
        if self._clock.look(after_step=after_step):
            self.begin()

    def look_after_step(self) -> None:
        """Look right after a step, before the loop's own code runs."""
        self.look(after_step=True)
        self._heartbeat.beat_if_due()

    def begin(self) -> None:
        """Simulation time went back: end the old run at its newest known time, begin a new one."""
        self._recorder.end_run("reset", self._clock.ended_sim_time_s)
        self._recorder.session.run = self._clock.run
        self._throttle.begin_run()
        self._reloads.happened()
        self._journal.event("reset")
        # Before the callbacks, which may read values that waited for the reset, and set others.
        self._parameters.begin_run()
        self._scene.begin_run()
        self._motors.begin_run()
        self._reloads.fire()
        self._heartbeat.beat()

    def begin_first(self, *, reloaded: bool) -> None:
        """Begin the session's first run, after a reload or a start."""
        run = self._clock.run
        run.start_reason = "reload" if reloaded else "start"
        self._journal.event(run.start_reason)
        if reloaded:
            self._reloads.happened()
