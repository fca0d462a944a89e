"""The built-in actions that take pictures: screenshot, take_frame.

Each returns a generator, see `webots_mcp.bridge.control`.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from pathlib import Path

from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress, whole_number
from webots_mcp.bridge.picture_files import PictureFiles, complete_png_size
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.contract import SCREENSHOT_FOLDER
from webots_mcp.errors import CommandRefusedError, InvalidInputError


class PictureActions:
    """Take screenshots and pictures of devices."""

    def __init__(
        self,
        simulation: Simulation,
        clock: Clock,
        files: PictureFiles,
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._files = files

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "screenshot": self.screenshot,
            "take_frame": self.take_frame,
        }

    def screenshot(self, command: ClaimedCommand) -> Progress:
        """Ask for the picture; Webots writes the file some time later, or never."""
        quality = whole_number(command.params, "quality", 1, 100, default=100)
        path = f"{SCREENSHOT_FOLDER}/command-{command.id:06d}.png"
        file = self._files.prepare_file(path)
        self._simulation.robot.exportImage(str(file), quality)
        size = yield from _wait_for_picture(file)
        return self._files.add_screenshot(path, *size)

    def take_frame(self, command: ClaimedCommand) -> Progress:
        """Take a picture of the newest measurement of a camera, a range finder or a lidar."""
        name = command.params.get("camera") or ""
        if not isinstance(name, str):
            raise InvalidInputError(f"camera must be the name of a device, not {name!r:.80}")
        from webots_mcp.bridge.device_pictures import find_pictured, take_picture  # seldom needed

        device = find_pictured(self._simulation.robot, name)
        picture, camera = take_picture(device), str(device.getName())
        saved = self._files.add_frame(camera, picture.bgra, picture.width, picture.height)
        when = {"sim_time_s": self._clock.sim_time_s}
        return {"camera": camera, **saved, **when, "scale": picture.scale}
        yield


def _wait_for_picture(file: Path) -> Generator[None, None, tuple[int, int, int]]:
    timeout_s = 10.0  # Webots writes the file at its next rendering, or never
    deadline_s = time.monotonic() + timeout_s
    while (size := complete_png_size(file)) is None:
        if time.monotonic() > deadline_s:
            raise CommandRefusedError(
                f"Webots wrote no complete picture to {file} within {timeout_s:.0f} s; "
                "its console has the reason"
            )
        yield
    return size
