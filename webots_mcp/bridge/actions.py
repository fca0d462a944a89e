"""The built-in actions.

Each is a generator: it yields until its outcome is known (once a round of the user's loop, or of
the hold), returns the command's result, or raises the command's error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.commands import Command, CommandQueue, describe
from webots_mcp.bridge.hold import Hold
from webots_mcp.bridge.pictures import Album, complete_png_size
from webots_mcp.bridge.simulation import Simulation
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import MAX_STEPS, SCREENSHOT_FOLDER, SUPERVISOR_ACTIONS
from webots_mcp.errors import CommandRefusedError, InvalidInputError

Progress = Generator[None, None, object]
CallBack = Callable[[], Sequence[Exception | None]]

_SCREENSHOT_TIMEOUT_S: Final = 10.0
_RESET_TIMEOUT_S: Final = 10.0
_RELOAD_TIMEOUT_S: Final = 30.0


class Actions:
    """What the built-in commands do to the simulation."""

    def __init__(
        self,
        simulation: Simulation,
        queue: CommandQueue,
        hold: Hold,
        clock: Clock,
        album: Album,
        call_back: CallBack,
        throttle: Throttle,
    ) -> None:
        self._simulation = simulation
        self._queue = queue
        self._hold = hold
        self._clock = clock
        self._album = album
        self._call_back = call_back
        self._throttle = throttle
        self.reloading: Command | None = None
        self._generators: Final[dict[str, Callable[[Command], Progress]]] = {
            "pause": self._pause,
            "resume": self._resume,
            "fast": self._fast,
            "step": self._step,
            "reset": self._reset,
            "reload": self._reload,
            "screenshot": self._screenshot,
            "reset_state": self._reset_state,
        }

    def begin(self, command: Command) -> Progress:
        """The generator of a built-in action.

        Raises:
            CommandRefusedError: It needs a Supervisor and this robot is none.
        """
        if command.action in SUPERVISOR_ACTIONS:
            self._simulation.require_supervisor(command.action)
        return self._generators[command.action](command)

    def _pause(self, command: Command) -> Progress:
        """Hold at once; or after one more round where the state of this one was throttled."""
        if self._throttle.stale and not self._hold.held:
            self._throttle.want()
            yield
        self._hold.take(command)
        return self._mode()

    def _resume(self, command: Command) -> Progress:
        before = self._hold.mode_before if self._hold.held else self._simulation.mode_name
        self._hold.release(command, "real_time")
        why = "resume means real time"
        if before == "fast":
            why += "; it ran fast before, and the command fast goes on so"
        return {**self._mode(), "why": why}
        yield

    def _fast(self, command: Command) -> Progress:
        self._hold.release(command, "fast")
        return self._mode()
        yield

    def _mode(self) -> dict[str, object]:
        return {"mode": self._simulation.mode_name, "sim_time_s": self._clock.sim_time_s}

    def _step(self, command: Command) -> Progress:
        """Let the user's loop come round `steps` times, each with its own step, then hold.

        A loop that does not ask for commands in every round makes more; those made are told.
        """
        steps = _whole_number(command.params, "steps", 1, MAX_STEPS)
        from_s, from_step = self._clock.sim_time_s, self._clock.steps_seen
        self._hold.release(command, stepping=True)
        try:
            while (made := self._clock.steps_seen - from_step) < steps:
                yield
        except CommandRefusedError as interruption:
            made = self._clock.steps_seen - from_step
            text = f"{interruption} after {made} of {steps} steps"
            raise CommandRefusedError(text) from None
        self._hold.take(command)
        advanced_s = round(self._clock.sim_time_s - from_s, 6)
        return {"steps": made, "advanced_s": advanced_s, **self._mode()}

    def _reset(self, command: Command) -> Progress:
        """Ask for the reset; done when simulation time went back, which takes a physics step."""
        run, held = self._clock.run, self._hold.held
        self._queue.issue(command)
        self._hold.release(command)  # first: a paused simulation makes no physics step
        self._clock.await_reset()
        self._simulation.robot.simulationReset()
        deadline_s = time.monotonic() + _RESET_TIMEOUT_S
        while self._clock.run is run:
            if time.monotonic() > deadline_s:
                self._clock.forget_reset()
                raise CommandRefusedError(
                    "simulationReset() was called, but simulation time did not go back within "
                    f"{_RESET_TIMEOUT_S:.0f} s"
                )
            yield
        why = "a reset takes a step, which ended the pause" if held else "a reset keeps the mode"
        return {"run_id": self._clock.run.id, **self._mode(), "why": f"{why}; time goes on"}

    def _reload(self, command: Command) -> Progress:
        """Ask for the reload; this process ends, and the next session confirms the command."""
        self._queue.issue(command)
        self.reloading = command
        self._hold.release(command)  # first: after worldReload() Webots answers nothing but quit
        self._simulation.robot.worldReload()
        deadline_s = time.monotonic() + _RELOAD_TIMEOUT_S
        while time.monotonic() < deadline_s:
            yield
        self.reloading = None
        raise CommandRefusedError(
            f"worldReload() was called, but the controller still runs after "
            f"{_RELOAD_TIMEOUT_S:.0f} s; a dialog may be open in Webots (start it with --batch)"
        )

    def _screenshot(self, command: Command) -> Progress:
        """Ask for the picture; the simulator writes the file some time later, or never."""
        quality = _whole_number(command.params, "quality", 1, 100, default=100)
        path = f"{SCREENSHOT_FOLDER}/command-{command.id:06d}.png"
        file = self._album.make_room(path)
        self._simulation.robot.exportImage(str(file), quality)
        size = yield from _wait_for_picture(file)
        return self._album.add_screenshot(path, *size)

    def _reset_state(self, command: Command) -> Progress:
        with self._hold.users_code():
            outcomes = self._call_back()
        if not outcomes:
            raise CommandRefusedError(
                "nothing to reset: this controller registered no callback with bridge.on_reload()"
            )
        if errors := [describe(error) for error in outcomes if error is not None]:
            raise CommandRefusedError(
                f"{len(errors)} of {len(outcomes)} callbacks failed: {'; '.join(errors)}"
            )
        return {"callbacks": len(outcomes)}
        yield


def _wait_for_picture(file: Path) -> Generator[None, None, tuple[int, int, int]]:
    deadline_s = time.monotonic() + _SCREENSHOT_TIMEOUT_S
    while (size := complete_png_size(file)) is None:
        if time.monotonic() > deadline_s:
            raise CommandRefusedError(
                f"Webots wrote no complete picture to {file} within {_SCREENSHOT_TIMEOUT_S:.0f} s; "
                "its console tells why"
            )
        yield
    return size


def _whole_number(
    params: dict[str, Any], name: str, least: int, most: int, default: int = 1
) -> int:
    value = params.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise InvalidInputError(f"{name} must be a whole number from {least} to {most}: {value!r}")
    return value
