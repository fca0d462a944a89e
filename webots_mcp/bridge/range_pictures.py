"""Distances as pictures for a person, with their scale in metres.

A range finder's image is coloured, near red and far blue; a lidar's points are drawn as seen from
above, since its own image is often a single row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from webots_mcp.bridge.raster import (
    BLACK,
    GREY,
    LETTER_PX,
    TEXT_HEIGHT_PX,
    WHITE,
    Canvas,
    colour,
)
from webots_mcp.errors import CommandRefusedError

_LONGEST_SIDE_PX: Final = 320
_SHORTEST_WIDTH_PX: Final = 160  # room for two labels next to each other
_BAR_PX: Final = 10
_TOP_VIEW_PX: Final = 360
_MOST_RAYS: Final = 20_000
_POINT_PX: Final = 3
_SHADES: Final = 256
_RAMP: Final = ((220, 30, 30), (250, 220, 40), (40, 190, 80), (30, 60, 200))  # near to far


def draw_depths(device: Any) -> tuple[Canvas, str]:
    """A range finder's image in colours above a colour bar, and the scale in words.

    Raises:
        CommandRefusedError: It has no image yet.
    """
    ranges, width, height = _ranges_of(device), device.getWidth(), device.getHeight()
    near_m, far_m = device.getMinRange(), device.getMaxRange()
    step = math.ceil(max(width, height) / _LONGEST_SIDE_PX)
    grown = max(1, _SHORTEST_WIDTH_PX // width) if step == 1 else 1
    rows = [ranges[i : i + width : step] for i in range(0, len(ranges), width * step)]
    shown = max(_SHORTEST_WIDTH_PX, grown * len(rows[0]))
    canvas = Canvas(shown, grown * len(rows) + _BAR_PX + TEXT_HEIGHT_PX + 6)
    shades, per_m = _shades(), (_SHADES - 1) / max(far_m - near_m, 1e-9)
    for number, row in enumerate(rows):
        pixels = [_shade_of(shades, (each - near_m) * per_m) for each in row]
        wide = [pixel for pixel in pixels for _ in range(grown)]
        for line in range(grown):
            canvas.row(grown * number + line, wide)
    _explain(canvas, shades, grown * len(rows) + 2, near_m, far_m)
    scale = f"red {_metres(near_m)}, yellow, green, blue {_metres(far_m)}; black: nothing in range"
    return canvas, scale


def draw_from_above(device: Any) -> tuple[Canvas, str]:
    """A lidar's points as seen from above with distance rings, and the scale in words.

    Raises:
        CommandRefusedError: It has no scan yet.
    """
    ranges = _ranges_of(device)
    points = _points(ranges, device)
    farthest_m = max((math.hypot(*point) for point in points), default=device.getMaxRange())
    spacing_m = _round_number(farthest_m / 4)
    rings = max(1, math.ceil(farthest_m / spacing_m - 1e-6))
    canvas, middle = Canvas(_TOP_VIEW_PX, _TOP_VIEW_PX), _TOP_VIEW_PX / 2
    per_m = (middle - 8) / (rings * spacing_m)
    _draw_edges(canvas, device.getFov())
    for number in range(1, rings + 1):
        radius = number * spacing_m * per_m
        canvas.circle(middle, middle, radius, GREY)
        canvas.text(int(middle) + 4, int(middle - radius) + 3, _metres(number * spacing_m), GREY)
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


def _draw_edges(canvas: Canvas, fov_rad: float) -> None:
    """Draw the limits of the field of view, unless it is a full circle."""
    if fov_rad > 2 * math.pi - 0.1:
        return
    middle = canvas.width / 2
    for angle_rad in (fov_rad / 2, -fov_rad / 2):
        x, y = middle * (1 - math.sin(angle_rad)), middle * (1 - math.cos(angle_rad))
        canvas.line(middle, middle, x, y, GREY)


def _explain(canvas: Canvas, shades: list[int], y: int, near_m: float, far_m: float) -> None:
    pixels = [shades[i * (_SHADES - 1) // (canvas.width - 1)] for i in range(canvas.width)]
    for line in range(_BAR_PX):
        canvas.row(y + line, pixels)
    below, far = y + _BAR_PX + 2, _metres(far_m)
    canvas.text(1, below, _metres(near_m), WHITE)
    canvas.text(canvas.width - LETTER_PX * len(far), below, far, WHITE)


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
