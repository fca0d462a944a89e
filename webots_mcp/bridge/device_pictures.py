"""Pictures of the newest measurement of a camera, a range finder or a lidar.

A range finder's image is coloured, red for near and blue for far. A lidar's points are drawn as
seen from above, since its own image is often a single row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.picture_files import image_of
from webots_mcp.bridge.pixel_canvas import BLACK, GREY, WHITE, PixelCanvas, colour
from webots_mcp.errors import CommandRefusedError, InvalidInputError


@dataclass(frozen=True)
class DevicePictures:
    """How the values of a device become a picture.

    Attributes:
        named: Devices that an error names.
        shades: Grey levels.
        width_px: Width to which a small image is magnified.
    """

    named: int = 10
    shades: int = 256
    width_px: int = 160


_SIZES: Final = DevicePictures()


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
    """Return the picture of a device that `find_pictured` found.

    Raises:
        CommandRefusedError: If it has none yet.
    """
    return _PICTURES[type(device).__name__](device)


def find_pictured(robot: Any, name: str) -> Any:
    """Return the enabled device of that name, or (for "") the first one: cameras come first.

    Raises:
        InvalidInputError: If there is no such device, or it takes no pictures.
        CommandRefusedError: If it is disabled, or all devices are.
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
    shown = ", ".join(f"{each!r} ({_kind(pictured[each])})" for each in asked[: _SIZES.named])
    raise CommandRefusedError(
        f"disabled: {shown}; call robot.getDevice({asked[0]!r}).enable(time_step) in the "
        "controller, and ask again after its next step"
    )


def _no_such(name: str, device: Any, pictured: dict[str, Any]) -> str:
    what = f"{name!r} is a {_kind(device)}" if device is not None else f"no device {name!r}"
    known = [f"{each!r} ({_kind(pictured[each])})" for each in pictured][: _SIZES.named]
    return f"{what}; devices with pictures: {', '.join(known) or 'none on this robot'}"


def _kind(device: Any) -> str:
    return type(device).__name__


def draw_depths(device: Any) -> tuple[PixelCanvas, str]:
    """Return a range finder's image in colours, and the scale in words.

    Raises:
        CommandRefusedError: If it has no image yet.
    """
    ranges, width, height = _ranges_of(device), device.getWidth(), device.getHeight()
    near_m, far_m = device.getMinRange(), device.getMaxRange()
    step = math.ceil(max(width, height) / 320)  # at most 320 pixels per side
    grown = max(1, _SIZES.width_px // width) if step == 1 else 1
    rows = [ranges[i : i + width : step] for i in range(0, len(ranges), width * step)]
    shown = max(_SIZES.width_px, grown * len(rows[0]))
    canvas = PixelCanvas(shown, grown * len(rows))
    shades, per_m = _shades(), (_SIZES.shades - 1) / max(far_m - near_m, 1e-9)
    for number, row in enumerate(rows):
        pixels = [_shade_of(shades, (each - near_m) * per_m) for each in row]
        wide = [pixel for pixel in pixels for _ in range(grown)]
        for line in range(grown):
            canvas.row(grown * number + line, wide)
    scale = f"red {_metres(near_m)}, yellow, green, blue {_metres(far_m)}; black: nothing in range"
    return canvas, scale


def draw_from_above(device: Any) -> tuple[PixelCanvas, str]:
    """Return a lidar's points as seen from above with distance rings, and the scale in words.

    Raises:
        CommandRefusedError: If it has no scan yet.
    """
    ranges = _ranges_of(device)
    points = _points(ranges, device)
    farthest_m = max((math.hypot(*point) for point in points), default=device.getMaxRange())
    spacing_m = _round_number(farthest_m / 4)
    rings = max(1, math.ceil(farthest_m / spacing_m - 1e-6))
    side_px, point_px = 360, 3
    canvas, middle = PixelCanvas(side_px, side_px), side_px / 2
    per_m = (middle - 8) / (rings * spacing_m)
    for number in range(1, rings + 1):
        radius = number * spacing_m * per_m
        canvas.circle(middle, middle, radius, GREY)
    for ahead_m, left_m in points:
        x, y = round(middle - left_m * per_m), round(middle - ahead_m * per_m)
        canvas.fill(x - 1, y - 1, point_px, point_px, WHITE)
    canvas.fill(int(middle) - 3, int(middle) - 3, 7, 7, colour(40, 200, 80))
    total = _metres(rings * spacing_m)
    return canvas, f"from above, up is ahead; a ring each {_metres(spacing_m)}, the last {total}"


def _ranges_of(device: Any) -> Sequence[float]:
    """Return a device's ranges, unless they are a null pointer, which can crash Python."""
    if not device.range_image:
        raise CommandRefusedError(
            f"{device.getName()!r} has not measured anything yet: ask again after a step"
        )
    return device.getRangeImage()


def _points(ranges: Sequence[float], lidar: Any) -> list[tuple[float, float]]:
    """Return the points as metres ahead and to the left, layer after layer."""
    columns, layers = lidar.getHorizontalResolution(), lidar.getNumberOfLayers()
    fov_rad, vertical_rad = lidar.getFov(), lidar.getVerticalFov()
    points: list[tuple[float, float]] = []
    most_rays = 20_000  # drawing more would take longer than a step
    for index in range(0, len(ranges), math.ceil(len(ranges) / most_rays)):
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
    """Return the colours of distances from near to far."""
    ramp = ((220, 30, 30), (250, 220, 40), (40, 190, 80), (30, 60, 200))  # near to far
    parts = len(ramp) - 1
    shades: list[int] = []
    for number in range(_SIZES.shades):
        part, share = divmod(number * parts / _SIZES.shades, 1)
        low, high = ramp[int(part)], ramp[int(part) + 1]
        mixed = [round(a + share * (b - a)) for a, b in zip(low, high, strict=True)]
        shades.append(colour(*mixed))
    return shades


def _shade_of(shades: list[int], place: float) -> int:
    return shades[int(min(max(place, 0), _SIZES.shades - 1))] if math.isfinite(place) else BLACK


def _round_number(length_m: float) -> float:
    """Return the next larger 1, 2 or 5 times a power of ten."""
    power = 10 ** math.floor(math.log10(max(length_m, 1e-3)))
    return next(power * each for each in (1, 2, 5, 10) if power * each >= length_m * (1 - 1e-9))


def _metres(length_m: float) -> str:
    return f"{round(length_m, 3):.10g} m"
