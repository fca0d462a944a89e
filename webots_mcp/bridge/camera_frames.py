"""Small frames of the cameras that a controller names, held for the last seconds of a run."""

from __future__ import annotations

import math
import time
from array import array
from collections import deque
from typing import Any, Final

from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.picture_files import HeldFrame, image_of

LONGEST_SIDE_PX: Final = 160
MOST_FRAMES: Final = 78  # of all cameras together: 8 MB, were they square
_MOST_FRAMES_PER_S: Final = 100.0


class _Camera:
    """A camera of which frames are taken.

    Attributes:
        due_s: Simulation time of its next frame.
        missed: Frames that could not be taken.
    """

    def __init__(self, device: Any, interval_s: float) -> None:
        self.device = device
        self.name = str(device.getName())
        self.interval_s = interval_s
        self.due_s = self.taken_s = -math.inf
        self.missed = 0

    def frame(self, now_s: float) -> HeldFrame:
        """Return the newest image, scaled down, and set when the next frame is due."""
        self.taken_s = now_s
        period_s = self.device.getSamplingPeriod() / 1000
        # Summed floating-point steps may fall a little short.
        self.due_s = now_s + max(self.interval_s, period_s) - 1e-9
        scaled = scale_down(*image_of(self.device))
        return HeldFrame(self.name, now_s, time.time(), *scaled)


class CameraFrames:
    """Takes frames of cameras, and holds those of the last seconds of a run.

    Args:
        last_s: Seconds of simulation time that are held, in 78 frames at most.

    Attributes:
        cameras: The cameras of which frames are taken, by name.
        missed: Frames that could not be taken or written.
    """

    def __init__(self, journal: Journal, last_s: float) -> None:
        self._journal = journal
        self._last_s = last_s
        self._held: deque[HeldFrame] = deque(maxlen=MOST_FRAMES)
        self._taken_s = self._due_s = -math.inf
        self.cameras: dict[str, _Camera] = {}
        self.missed = 0

    def watch(self, device: Any, frames_per_s: float) -> None:
        """Take this many frames of a camera per second of simulation time.

        Raises:
            TypeError: If the device is not a camera.
            ValueError: If the number is out of bounds.
        """
        methods = ("getName", "getSamplingPeriod", "getWidth", "getHeight", "getImage")
        missing = [name for name in methods if not callable(getattr(device, name, None))]
        if missing:
            kind = type(device).__name__
            raise TypeError(f"a Camera is needed, and {kind} has no {', '.join(missing)}")
        if not 0 < frames_per_s <= _MOST_FRAMES_PER_S:
            most = f"{_MOST_FRAMES_PER_S:g}"
            raise ValueError(f"frames_per_s must be above 0 and at most {most}: {frames_per_s!r}")
        camera = _Camera(device, 1 / frames_per_s)
        self.cameras[camera.name] = camera
        self._due_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Return whether a frame is due, or simulation time has gone back."""
        return not self._taken_s <= now_s < self._due_s

    def take_due(self, now_s: float, *, at_once: bool) -> list[HeldFrame]:
        """Take and return the frames that are due; with `at_once` one of each camera."""
        again = now_s < self._taken_s  # a new run
        due = [
            each
            for each in self.cameras.values()
            if again or now_s >= each.due_s or (at_once and now_s > each.taken_s)
        ]
        frames = [frame for each in due if (frame := self._frame_of(each, now_s)) is not None]
        self._taken_s = now_s
        self._due_s = min((each.due_s for each in self.cameras.values()), default=math.inf)
        return frames

    def add(self, frame: HeldFrame) -> None:
        """Hold the newest frame, and forget those that are too old."""
        while self._held and self._held[0].sim_time_s < frame.sim_time_s - self._last_s:
            self._held.popleft()
        self._held.append(frame)

    def take(self, start_s: float) -> list[HeldFrame]:
        """Return the frames taken since a simulation time, and forget all held frames."""
        frames = [frame for frame in self._held if frame.sim_time_s >= start_s]
        self._held.clear()
        return frames

    def _frame_of(self, camera: _Camera, now_s: float) -> HeldFrame | None:
        """Return a frame of a camera; None if it has none, which is logged the second time."""
        try:
            return camera.frame(now_s)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            camera.missed += 1
            self.missed += 1
            if camera.missed == 2:  # the first one may come before the camera's first image
                self._journal.log("warning", "bridge", f"keep_camera: {describe(error)}")
            return None


def scale_down(bgra: bytes, width: int, height: int) -> tuple[int, int, bytes]:
    """Reduce an image to 160 pixels per side at most, by keeping each n-th pixel.

    Returns:
        Width, height and pixels of the reduced image.

    Raises:
        ValueError: If the image does not have 4 * width * height bytes.
    """
    if len(bgra) != 4 * width * height:
        raise ValueError(f"{len(bgra)} bytes are not an image of {width} x {height} pixels")
    step = math.ceil(max(width, height) / LONGEST_SIDE_PX)
    if step <= 1:
        return width, height, bgra
    stride = 4 * width
    kept_rows = [bgra[i : i + stride] for i in range(0, len(bgra), stride * step)]
    # Slices of an array are made at the speed of C, those of a memoryview pixel by pixel.
    pixels = array("I", b"".join(kept_rows))
    if width % step == 0:  # then one slice steps through all rows
        return width // step, len(kept_rows), pixels[::step].tobytes()
    rows = [pixels[i : i + width : step] for i in range(0, len(pixels), width)]
    return math.ceil(width / step), len(rows), b"".join(rows)
