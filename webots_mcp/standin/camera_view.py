"""Pictures of cameras: one ray for each column of pixels."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from math import cos, hypot, inf, sin, tan
from typing import Final

from webots_mcp.standin.arena import SceneColors
from webots_mcp.standin.geometry import Color, Shape, Target, targets_from

_LIGHT: Final = (0.8, 0.6)
"""Direction that the light comes from, so that the sides of a box differ."""


@dataclass(frozen=True)
class CameraView:
    """Everything that a camera sees at one moment."""

    x: float
    y: float
    z: float
    yaw_rad: float
    width: int
    height: int
    field_of_view_rad: float
    shapes: tuple[Shape, ...]


def render(view: CameraView, colors: SceneColors) -> bytes:
    """Return blue, green, red and alpha of each pixel, in rows from the top left."""
    targets = targets_from(view.shapes, view.x, view.y, None)
    focal_px = view.width / 2.0 / tan(view.field_of_view_rad / 2.0)
    sky, floor = pixel(colors.sky), pixel(colors.floor)
    background = sky * (view.height // 2) + floor * (view.height - view.height // 2)
    columns = array("I")
    for column in range(view.width):
        columns.frombytes(_column(view, column, focal_px, targets, background))
    return b"".join(columns[row :: view.height].tobytes() for row in range(view.height))


def _column(
    view: CameraView, column: int, focal_px: float, targets: list[Target], background: bytes
) -> bytes:
    aside = (view.width / 2.0 - column - 0.5) / focal_px
    length = hypot(1.0, aside)
    c, s = cos(view.yaw_rad), sin(view.yaw_rad)
    dx, dy = (c - s * aside) / length, (s + c * aside) / length
    hits = [(t.distance_m(dx, dy), t) for t in targets]
    seen = sorted((hit for hit in hits if hit[0] < inf), key=lambda hit: -hit[0])
    pixels = background
    for distance, target in seen:  # The farthest first: near targets cover far ones.
        scale_px = focal_px * length / max(distance, 0.01)
        top = _row(view, target.shape.top_m, scale_px)
        bottom = _row(view, target.shape.bottom_m, scale_px)
        color = _shaded(target, distance, dx, dy)
        pixels = pixels[: 4 * top] + color * (bottom - top) + pixels[4 * bottom :]
    return pixels


def _row(view: CameraView, height_m: float, scale_px: float) -> int:
    row = round(view.height / 2.0 - (height_m - view.z) * scale_px)
    return min(max(row, 0), view.height)


def _shaded(target: Target, distance_m: float, dx: float, dy: float) -> bytes:
    nx, ny = target.inward(distance_m, dx, dy)
    light = 0.7 + 0.3 * (nx * _LIGHT[0] + ny * _LIGHT[1])
    r, g, b = target.shape.color
    return pixel((r * light, g * light, b * light))


def pixel(color: Color) -> bytes:
    """Return one opaque pixel: blue, green, red, alpha."""
    r, g, b = (min(max(round(part * 255), 0), 255) for part in color)
    return bytes((b, g, r, 255))
