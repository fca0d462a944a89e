"""The built-in actions on the world as a whole: reset, reload, load_world, quit.

Each returns a generator, see `webots_mcp.bridge.control`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Final

from webots_mcp.bridge.claimed_commands import (
    Action,
    ClaimedCommand,
    ClaimedCommands,
    Progress,
    Reloads,
    whole_number,
)
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.simulation import Clock, Simulation, mode_now
from webots_mcp.database.files import full_path
from webots_mcp.database.location import require_world_of
from webots_mcp.errors import CommandRefusedError, ControllerEndedError, InvalidInputError

_RELOAD_TIMEOUT_S: Final = 30.0
_DIALOG: Final = "a dialog may be open in Webots (start it with --batch)"


class WorldActions:
    """Reset, reload or replace the world, and end the simulation."""

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        pause: Pause,
        queue: ClaimedCommands,
        reloads: Reloads,
        require_no_recording: Callable[[str], None],
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._pause = pause
        self._queue = queue
        self._reloads = reloads
        self._require_no_recording = require_no_recording

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "reset": self.reset,
            "reload": self.reload,
            "load_world": self.load_world,
            "quit": self.quit,
        }

    def reset(self, command: ClaimedCommand) -> Progress:
        """Reset the world; done when simulation time has gone back, which takes a step."""
        was_paused = self._pause.active
        self._queue.issue(command)
        self._pause.end(command.id)  # first: a paused simulation makes no physics step
        yield from self.reset_world()
        why = (
            "a reset takes a step, which ended the pause"
            if was_paused
            else "a reset keeps the mode"
        )
        return {
            "run_id": self._clock.run.id,
            **mode_now(self._simulation, self._clock),
            "why": f"{why}; the simulation runs",
        }

    def reset_world(self) -> Generator[None]:
        """Reset the world and wait until simulation time has gone back."""
        clock, run = self._clock, self._clock.run
        clock.await_reset()
        self._simulation.robot.simulationReset()
        timeout_s = 10.0
        deadline_s = time.monotonic() + timeout_s
        # The state that is published in the first step is of the new run.
        with self._pause.awaiting_reset():
            while clock.run is run:
                if time.monotonic() > deadline_s:
                    clock.forget_reset()
                    raise CommandRefusedError(
                        "simulationReset() was called, but simulation time did not go back within "
                        f"{timeout_s:.0f} s; check that the loop still calls step()"
                    )
                yield

    def reload(self, command: ClaimedCommand) -> Progress:
        """Ask for the reload; this process ends, and the next session confirms the command."""
        self._require_no_recording("a reload")
        return self._reload(command)

    def _reload(self, command: ClaimedCommand) -> Progress:
        self._queue.issue(command)
        self._reloads.requested_by = command
        self._pause.end(command.id)  # first: after worldReload() Webots answers nothing but quit
        self._simulation.robot.worldReload()
        deadline_s = time.monotonic() + _RELOAD_TIMEOUT_S
        while time.monotonic() < deadline_s:
            yield
        self._reloads.requested_by = None
        raise CommandRefusedError(
            f"worldReload() was called, but Webots has not ended the controller after "
            f"{_RELOAD_TIMEOUT_S:.0f} s; {_DIALOG}"
        )

    def load_world(self, command: ClaimedCommand) -> Progress:
        """Ask for another world of the project; this process ends, as all controllers do."""
        self._require_no_recording("another world")
        return self._load(command, self._world_of_project(command.params.get("world")))

    def _load(self, command: ClaimedCommand, world: Path) -> Progress:
        self._pause.end(command.id)  # first: a paused simulation makes no physics step
        self._simulation.robot.worldLoad(str(world))
        return (yield from _until_ended("worldLoad"))

    def _world_of_project(self, world: object) -> Path:
        """Return the file of a world, which must be in the project of the current one.

        Loading a world runs the code of its controllers. The bridge checks this, not the server,
        so that every client is bound by it.

        Raises:
            InvalidInputError: If it is no world, or a world of another project.
        """
        try:
            file = full_path(world) if isinstance(world, str) else Path()
            is_file = file.is_file()
        except OSError:  # the name is too long, has a NUL, or its links form a circle
            file, is_file = Path(), False
        if not is_file:
            raise InvalidInputError(
                f"world must be the full path of a world file, not {world!r:.200}"
            )
        present = full_path(self._simulation.robot.getWorldPath())
        require_world_of(require_world_of(None, present), file)
        return file

    def quit(self, command: ClaimedCommand) -> Progress:
        """Ask Webots to end; this process ends with it."""
        self._require_no_recording("the end of Webots")
        status = whole_number(command.params, "status", 0, 255, default=0)
        return self._quit(command, status)

    def _quit(self, command: ClaimedCommand, status: int) -> Progress:
        self._pause.end(command.id)
        self._simulation.robot.simulationQuit(status)
        return (yield from _until_ended("simulationQuit"))

    def _mode(
        self,
    ) -> dict[str, object]:
        return {"mode": self._simulation.mode_name, "sim_time_s": self._clock.sim_time_s}


def _until_ended(asked: str) -> Progress:
    """Wait until Webots ends the controller, which it does first of all."""
    deadline_s = time.monotonic() + _RELOAD_TIMEOUT_S
    try:
        while time.monotonic() < deadline_s:
            yield
    except ControllerEndedError:
        return {"controller": "it has ended"}
    raise CommandRefusedError(
        f"{asked}() was called, but Webots has not ended the controller after "
        f"{_RELOAD_TIMEOUT_S:.0f} s; {_DIALOG}"
    )
