"""Pictures as PNG files in the data folder, each with a row in the database."""

from __future__ import annotations

import time
import zlib
from collections import deque
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.contract import CAMERA_FOLDER, KEPT_FRAME, MAX_CAMERA_PICTURES
from webots_mcp.database.files import make_folder, whole_file
from webots_mcp.errors import CommandRefusedError

_PNG_HEAD: Final = b"\x89PNG\r\n\x1a\n"


class HeldFrame(NamedTuple):
    """A camera's newest image at some moment, scaled down.

    Attributes:
        bgra: Four bytes a pixel, rows from the top left.
    """

    device: str
    sim_time_s: float
    wall_time_s: float
    width: int
    height: int
    bgra: bytes


class PictureFiles:
    """The newest camera frames of each device; older ones are deleted, with their rows."""

    def __init__(self, recorder: Recorder, clock: Clock, data_dir: Path) -> None:
        self._recorder = recorder
        self._clock = clock
        self._data_dir = data_dir
        self._kept: dict[str, deque[str]] = {}

    def save_frame(self, camera: Any, max_frames: int) -> str:
        """Write the camera's image as PNG; return its path relative to the data folder.

        Raises:
            CommandRefusedError: If the camera is disabled or has no image yet.
            OSError: If the file cannot be written.
        """
        frame = self.add_frame(str(camera.getName()), *image_of(camera), max_frames)
        return str(frame["path"])

    def add_frame(
        self,
        device: str,
        bgra: bytes,
        width: int,
        height: int,
        max_frames: int = MAX_CAMERA_PICTURES,
    ) -> dict[str, object]:
        """Write a picture of a device; return the result of its command.

        Raises:
            OSError: If the file cannot be written.
        """
        name = self._name_of(device)
        kept = self._kept_of(name)
        path = f"{CAMERA_FOLDER}/{name}.{_next_number(kept):06d}.png"
        size = self._write(path, encode_png(bgra, width, height))
        row = (self._clock.sim_time_s, time.time(), "camera", device, path, width, height, size)
        self._recorder.record("image", self._clock.run, row)
        kept.append(path)
        while len(kept) > max(1, max_frames):
            self._forget(kept.popleft())
        return {"path": path, "width": width, "height": height, "size_bytes": size}

    def add_kept(self, run: CurrentRun, segment_uuid: str, frame: HeldFrame) -> None:
        """Write a small frame of a full-rate segment, which exists as long as the segment.

        Raises:
            OSError: The file cannot be written.
        """
        number = f"{segment_uuid[:8]}-{round(1000 * frame.sim_time_s):06d}"
        path = f"{CAMERA_FOLDER}/{self._name_of(frame.device)}.{KEPT_FRAME}-{number}.png"
        size = self._write(path, encode_png(frame.bgra, frame.width, frame.height))
        times = (frame.sim_time_s, frame.wall_time_s)
        row = (*times, KEPT_FRAME, frame.device, path, frame.width, frame.height, size)
        self._recorder.record("image", run, row)

    def prepare_file(self, path: str) -> Path:
        """Return the file to write a picture to; create its folder and delete an old file."""
        file = self._data_dir / path
        make_folder(file.parent)
        file.unlink(missing_ok=True)
        return file

    def add_screenshot(self, path: str, width: int, height: int, size: int) -> dict[str, object]:
        """Record a picture that Webots wrote; return the result of its command."""
        clock = self._clock
        row = (clock.sim_time_s, time.time(), "screenshot", None, path, width, height, size)
        self._recorder.record("image", clock.run, row)
        return {"path": path, "width": width, "height": height, "size_bytes": size}

    def _name_of(self, device: str) -> str:
        """Return the beginning of a camera's file names."""
        registration = self._recorder.registration
        robot = registration.robot_name if registration else "robot"
        return f"{_file_name(robot)}.{_file_name(device)}"

    def _kept_of(self, name: str) -> deque[str]:
        """Return the existing frames of a device, oldest first; the folder is listed only once."""
        if name not in self._kept:
            self._kept[name] = self._left_before(name)
        return self._kept[name]

    def _left_before(self, name: str) -> deque[str]:
        """Return the frames of earlier sessions; listing takes 1 us per file of any camera."""
        folder = self._data_dir / CAMERA_FOLDER
        files = sorted(file.name for file in folder.glob(f"{name}.[0-9]*.png"))
        return deque(f"{CAMERA_FOLDER}/{file}" for file in files)

    def _write(self, path: str, data: bytes) -> int:
        """Write a file under another name and rename it: a reader never sees half a picture."""
        with whole_file(self.prepare_file(path)) as aside:
            aside.write_bytes(data)
        return len(data)

    def _forget(self, path: str) -> None:
        (self._data_dir / path).unlink(missing_ok=True)
        self._recorder.record("image forgotten", None, (path,))


def image_of(camera: Any) -> tuple[bytes, int, int]:
    """Return a camera's newest image (4 bytes a pixel: blue, green, red, alpha), width and height.

    Raises:
        CommandRefusedError: The camera is disabled or has no image yet.
    """
    device, width, height = str(camera.getName()), camera.getWidth(), camera.getHeight()
    if camera.getSamplingPeriod() <= 0:
        raise CommandRefusedError(
            f"camera {device!r} is disabled: call its enable(time_step) in the controller first"
        )
    try:
        image = camera.getImage()
    except ValueError as error:
        raise CommandRefusedError(f"camera {device!r} has no image yet") from error
    if not image:
        raise CommandRefusedError(f"camera {device!r} has no image yet")
    return image, width, height


def encode_png(bgra: bytes, width: int, height: int) -> bytes:
    """Encode a Webots image (blue, green, red, alpha; rows from the top) as PNG.

    Format: W3C Portable Network Graphics, section 11 (IHDR, IDAT, IEND), 8-bit RGB, filter 0.

    Raises:
        ValueError: The image does not have 4 * width * height bytes.
    """
    if len(bgra) != 4 * width * height:
        raise ValueError(f"{len(bgra)} bytes are not an image of {width} x {height} pixels")
    rgb = bytearray(3 * width * height)
    rgb[0::3], rgb[1::3], rgb[2::3] = bgra[2::4], bgra[1::4], bgra[0::4]
    stride = 3 * width
    rows = b"".join(b"\0" + rgb[i : i + stride] for i in range(0, len(rgb), stride))
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 2, 0, 0, 0))
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b""))
    return _PNG_HEAD + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    check = zlib.crc32(kind + data)
    return len(data).to_bytes(4, "big") + kind + data + check.to_bytes(4, "big")


def complete_png_size(file: Path) -> tuple[int, int, int] | None:
    """Return width, height and size in bytes of a PNG; None if it is not written completely."""
    try:
        data = file.read_bytes()
    except OSError:
        return None
    if not data.startswith(_PNG_HEAD) or not data.endswith(b"IEND\xaeB`\x82"):
        return None
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    return width, height, len(data)


def _file_name(text: str) -> str:
    """Return a text as part of a file name: valid on every system, and unique for each text."""
    most_bytes = 80
    name = "".join(c if c.isalnum() or c in "-_" else "_" for c in text)
    if name == text and 0 < len(name.encode()) <= most_bytes:
        return name
    short = name.encode()[:most_bytes].decode(errors="ignore")
    return f"{short}~{zlib.crc32(text.encode(errors='surrogatepass')):08x}"


def _next_number(kept: deque[str]) -> int:
    return int(kept[-1].split(".")[-2]) + 1 if kept else 1
