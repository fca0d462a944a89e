"""Pictures of devices: drawn, and saved as files in the data folder, each with a row."""

from __future__ import annotations

import math
import struct
import sys
import time
import zlib
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.contract import CAMERA_FOLDER, KEPT_FRAME
from webots_mcp.database.files import make_folder, whole_file
from webots_mcp.errors import CommandRefusedError, InvalidInputError

MOST_FRAMES: Final = 50  # of a camera that are kept

_LONGEST_NAME_BYTES: Final = 80  # of a robot or a device, in the name of a file
_PNG_HEAD: Final = b"\x89PNG\r\n\x1a\n"
_PNG_TAIL: Final = b"IEND\xaeB`\x82"
_MOST_NAMED: Final = 10
_LONGEST_SIDE_PX: Final = 320
_SHORTEST_WIDTH_PX: Final = 160  # of a small image, which is magnified
_TOP_VIEW_PX: Final = 360
_MOST_RAYS: Final = 20_000
_POINT_PX: Final = 3
_SHADES: Final = 256
_RAMP: Final = ((220, 30, 30), (250, 220, 40), (40, 190, 80), (30, 60, 200))  # near to far


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


class Album:
    """The newest camera frames of each device; older ones are deleted, with their rows."""

    def __init__(self, recorder: Recorder, clock: Clock, data_dir: Path) -> None:
        self._recorder = recorder
        self._clock = clock
        self._data_dir = data_dir
        self._kept: dict[str, deque[str]] = {}

    def save_frame(self, camera: Any, max_frames: int) -> str:
        """Write the camera's image as PNG; returns its path relative to the data folder.

        Raises:
            CommandRefusedError: The camera is disabled or has no image yet.
            OSError: The file cannot be written.
        """
        frame = self.add_frame(str(camera.getName()), *image_of(camera), max_frames)
        return str(frame["path"])

    def add_frame(
        self, device: str, bgra: bytes, width: int, height: int, max_frames: int = MOST_FRAMES
    ) -> dict[str, object]:
        """Write a picture of a device; returns the result of its command.

        Raises:
            OSError: The file cannot be written.
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

    def add_kept(self, run: CurrentRun, stretch_uuid: str, frame: HeldFrame) -> None:
        """Write a small frame of a kept stretch, which exists as long as the stretch.

        Raises:
            OSError: The file cannot be written.
        """
        number = f"{stretch_uuid[:8]}-{round(1000 * frame.sim_time_s):06d}"
        path = f"{CAMERA_FOLDER}/{self._name_of(frame.device)}.{KEPT_FRAME}-{number}.png"
        size = self._write(path, encode_png(frame.bgra, frame.width, frame.height))
        times = (frame.sim_time_s, frame.wall_time_s)
        row = (*times, KEPT_FRAME, frame.device, path, frame.width, frame.height, size)
        self._recorder.record("image", run, row)

    def make_room(self, path: str) -> Path:
        """The file to write a picture to: its folder is created, an old file is deleted."""
        file = self._data_dir / path
        make_folder(file.parent)
        file.unlink(missing_ok=True)
        return file

    def add_screenshot(self, path: str, width: int, height: int, size: int) -> dict[str, object]:
        """Record a picture that Webots wrote; returns the result of its command."""
        clock = self._clock
        row = (clock.sim_time_s, time.time(), "screenshot", None, path, width, height, size)
        self._recorder.record("image", clock.run, row)
        return {"path": path, "width": width, "height": height, "size_bytes": size}

    def _name_of(self, device: str) -> str:
        """The beginning of a camera's file names."""
        registration = self._recorder.registration
        robot = registration.robot_name if registration else "robot"
        return f"{_file_name(robot)}.{_file_name(device)}"

    def _kept_of(self, name: str) -> deque[str]:
        """The existing frames of a device, oldest first; the folder is listed only once."""
        if name not in self._kept:
            self._kept[name] = self._left_before(name)
        return self._kept[name]

    def _left_before(self, name: str) -> deque[str]:
        """The frames of the robot's earlier sessions; listing costs 1 us per file of any camera."""
        folder = self._data_dir / CAMERA_FOLDER
        files = sorted(file.name for file in folder.glob(f"{name}.[0-9]*.png"))
        return deque(f"{CAMERA_FOLDER}/{file}" for file in files)

    def _write(self, path: str, data: bytes) -> int:
        """Write a file under another name and rename it: a reader never sees half a picture."""
        with whole_file(self.make_room(path)) as aside:
            aside.write_bytes(data)
        return len(data)

    def _forget(self, path: str) -> None:
        (self._data_dir / path).unlink(missing_ok=True)
        self._recorder.record("image forgotten", None, (path,))


def image_of(camera: Any) -> tuple[bytes, int, int]:
    """A camera's newest image (4 bytes a pixel: blue, green, red, alpha), width and height.

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
    """A PNG of a Webots camera image (4 bytes a pixel: blue, green, red, alpha; rows from the top).

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
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 1)), (b"IEND", b""))
    return _PNG_HEAD + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def complete_png_size(file: Path) -> tuple[int, int, int] | None:
    """(width, height, size in bytes) of a PNG that is written completely, else None."""
    try:
        data = file.read_bytes()
    except OSError:
        return None
    if not data.startswith(_PNG_HEAD) or not data.endswith(_PNG_TAIL):
        return None
    width, height = struct.unpack(">II", data[16:24])
    return width, height, len(data)


def _file_name(text: str) -> str:
    """A part of a file name that is valid on every system and differs for different texts."""
    name = "".join(c if c.isalnum() or c in "-_" else "_" for c in text)
    if name == text and 0 < len(name.encode()) <= _LONGEST_NAME_BYTES:
        return name
    short = name.encode()[:_LONGEST_NAME_BYTES].decode(errors="ignore")
    return f"{short}~{zlib.crc32(text.encode(errors='surrogatepass')):08x}"


def _next_number(kept: deque[str]) -> int:
    return int(kept[-1].split(".")[-2]) + 1 if kept else 1


# -- pictures of a device --------------------------------------------------------------------------


class Picture(NamedTuple):
    """A picture of a device's newest measurement.

    Attributes:
        bgra: Four bytes a pixel, rows from the top left.
        scale: The meaning of its colours or rings in metres; None for a camera's picture.
    """

    bgra: bytes
    width: int
    height: int
    scale: str | None = None


def _drawn(drawn: tuple[PixelCanvas, str]) -> Picture:
    canvas, scale = drawn
    return Picture(canvas.bgra, canvas.width, canvas.height, scale)


# By class name in Webots' `controller` package; without a name asked for, the first kind is chosen.
_PICTURES: Final[dict[str, Callable[[Any], Picture]]] = {
    "Camera": lambda device: Picture(*image_of(device)),
    "RangeFinder": lambda device: _drawn(draw_depths(device)),
    "Lidar": lambda device: _drawn(draw_from_above(device)),
}


def take_picture(device: Any) -> Picture:
    """The picture of a device that `find_pictured` found.

    Raises:
        CommandRefusedError: It has none yet.
    """
    return _PICTURES[type(device).__name__](device)


def find_pictured(robot: Any, name: str) -> Any:
    """The enabled device of that name, or (for "") the first one: cameras come first.

    Raises:
        InvalidInputError: There is no such device, or it takes no pictures.
        CommandRefusedError: It is disabled, or all are.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    order = list(_PICTURES)
    pictured = {n: d for n, d in devices.items() if type(d).__name__ in _PICTURES}
    if name and name not in pictured:
        raise InvalidInputError(_no_such(name, devices.get(name), pictured))
    asked = [name] if name else sorted(pictured, key=lambda n: order.index(_kind(pictured[n])))
    enabled = [each for each in asked if pictured[each].getSamplingPeriod() > 0]
    if enabled:
        return pictured[enabled[0]]
    if not asked:
        raise CommandRefusedError("this robot has no camera, range finder or lidar")
    shown = ", ".join(f"{each!r} ({_kind(pictured[each])})" for each in asked[:_MOST_NAMED])
    raise CommandRefusedError(
        f"disabled: {shown}; call robot.getDevice({asked[0]!r}).enable(time_step) in the "
        "controller, and ask again after its next step"
    )


def _no_such(name: str, device: Any, pictured: dict[str, Any]) -> str:
    what = f"{name!r} is a {_kind(device)}" if device is not None else f"no device {name!r}"
    known = [f"{each!r} ({_kind(pictured[each])})" for each in pictured][:_MOST_NAMED]
    return f"{what}; devices with pictures: {', '.join(known) or 'none on this robot'}"


def _kind(device: Any) -> str:
    return type(device).__name__


# -- distances as pictures -------------------------------------------------------------------------
# A range finder's image is coloured, near red and far blue; a lidar's points are drawn as seen
# from above, since its own image is often a single row.


def draw_depths(device: Any) -> tuple[PixelCanvas, str]:
    """A range finder's image in colours, and the scale in words.

    Raises:
        CommandRefusedError: It has no image yet.
    """
    ranges, width, height = _ranges_of(device), device.getWidth(), device.getHeight()
    near_m, far_m = device.getMinRange(), device.getMaxRange()
    step = math.ceil(max(width, height) / _LONGEST_SIDE_PX)
    grown = max(1, _SHORTEST_WIDTH_PX // width) if step == 1 else 1
    rows = [ranges[i : i + width : step] for i in range(0, len(ranges), width * step)]
    shown = max(_SHORTEST_WIDTH_PX, grown * len(rows[0]))
    canvas = PixelCanvas(shown, grown * len(rows))
    shades, per_m = _shades(), (_SHADES - 1) / max(far_m - near_m, 1e-9)
    for number, row in enumerate(rows):
        pixels = [_shade_of(shades, (each - near_m) * per_m) for each in row]
        wide = [pixel for pixel in pixels for _ in range(grown)]
        for line in range(grown):
            canvas.row(grown * number + line, wide)
    scale = f"red {_metres(near_m)}, yellow, green, blue {_metres(far_m)}; black: nothing in range"
    return canvas, scale


def draw_from_above(device: Any) -> tuple[PixelCanvas, str]:
    """A lidar's points as seen from above with distance rings, and the scale in words.

    Raises:
        CommandRefusedError: It has no scan yet.
    """
    ranges = _ranges_of(device)
    points = _points(ranges, device)
    farthest_m = max((math.hypot(*point) for point in points), default=device.getMaxRange())
    spacing_m = _round_number(farthest_m / 4)
    rings = max(1, math.ceil(farthest_m / spacing_m - 1e-6))
    canvas, middle = PixelCanvas(_TOP_VIEW_PX, _TOP_VIEW_PX), _TOP_VIEW_PX / 2
    per_m = (middle - 8) / (rings * spacing_m)
    for number in range(1, rings + 1):
        radius = number * spacing_m * per_m
        canvas.circle(middle, middle, radius, GREY)
    for ahead_m, left_m in points:
        x, y = round(middle - left_m * per_m), round(middle - ahead_m * per_m)
        canvas.fill(x - 1, y - 1, _POINT_PX, _POINT_PX, WHITE)
    canvas.fill(int(middle) - 3, int(middle) - 3, 7, 7, colour(40, 200, 80))
    total = _metres(rings * spacing_m)
    return canvas, f"from above, up is ahead; a ring each {_metres(spacing_m)}, the last {total}"


def _ranges_of(device: Any) -> Sequence[float]:
    """A device's ranges; a null pointer is tested first, since reading it can crash Python."""
    if not device.range_image:
        raise CommandRefusedError(
            f"{device.getName()!r} has not measured anything yet: ask again after a step"
        )
    return device.getRangeImage()


def _points(ranges: Sequence[float], lidar: Any) -> list[tuple[float, float]]:
    """The points as metres ahead and to the left; layer after layer, each from left to right."""
    columns, layers = lidar.getHorizontalResolution(), lidar.getNumberOfLayers()
    fov_rad, vertical_rad = lidar.getFov(), lidar.getVerticalFov()
    points: list[tuple[float, float]] = []
    for index in range(0, len(ranges), math.ceil(len(ranges) / _MOST_RAYS)):
        distance_m = ranges[index]
        if math.isfinite(distance_m):
            layer, column = divmod(index, columns)
            angle_rad = fov_rad * (0.5 - (column + 0.5) / columns)
            height = 0.5 - layer / (layers - 1) if layers > 1 else 0.0
            on_ground_m = distance_m * math.cos(vertical_rad * height)
            point = on_ground_m * math.cos(angle_rad), on_ground_m * math.sin(angle_rad)
            points.append(point)
    return points


def _shades() -> list[int]:
    """The colours of distances from near to far."""
    parts = len(_RAMP) - 1
    shades: list[int] = []
    for number in range(_SHADES):
        part, share = divmod(number * parts / _SHADES, 1)
        low, high = _RAMP[int(part)], _RAMP[int(part) + 1]
        mixed = [round(a + share * (b - a)) for a, b in zip(low, high, strict=True)]
        shades.append(colour(*mixed))
    return shades


def _shade_of(shades: list[int], place: float) -> int:
    return shades[int(min(max(place, 0), _SHADES - 1))] if math.isfinite(place) else BLACK


def _round_number(length_m: float) -> float:
    """The next larger 1, 2 or 5 times a power of ten."""
    power = 10 ** math.floor(math.log10(max(length_m, 1e-3)))
    return next(power * each for each in (1, 2, 5, 10) if power * each >= length_m * (1 - 1e-9))


def _metres(length_m: float) -> str:
    return f"{round(length_m, 3):.10g} m"


# -- drawing with the standard library alone -------------------------------------------------------


def colour(red: int, green: int, blue: int) -> int:
    """A pixel in the order of a Webots image: the bytes blue, green, red, alpha."""
    return int.from_bytes(bytes((blue, green, red, 255)), sys.byteorder)


BLACK: Final = colour(0, 0, 0)
GREY: Final = colour(110, 110, 110)
WHITE: Final = colour(255, 255, 255)


class PixelCanvas:
    """An image to draw into; drawing outside of it has no effect."""

    def __init__(self, width: int, height: int, background: int = BLACK) -> None:
        self.width = width
        self.height = height
        self._pixels = array("I", [background]) * (width * height)

    @property
    def bgra(self) -> bytes:
        """Four bytes a pixel, rows from the top left."""
        return self._pixels.tobytes()

    def fill(self, x: int, y: int, width: int, height: int, colour: int) -> None:
        """Fill a rectangle, given its upper left corner."""
        left, right = max(0, x), min(self.width, x + width)
        row = array("I", [colour]) * max(0, right - left)
        for line in range(max(0, y), min(self.height, y + height)):
            start = line * self.width
            self._pixels[start + left : start + left + len(row)] = row

    def row(self, y: int, pixels: Iterable[int]) -> None:
        """Set a row from its left end on."""
        given = array("I", pixels)[: self.width]
        self._pixels[y * self.width : y * self.width + len(given)] = given

    def circle(self, x: float, y: float, radius: float, colour: int) -> None:
        """Draw the outline of a circle."""
        count = max(8, int(8 * radius))
        for number in range(count):
            angle = 2 * math.pi * number / count
            at = x + radius * math.cos(angle), y + radius * math.sin(angle)
            self.fill(round(at[0]), round(at[1]), 1, 1, colour)
