"""Pictures of the whole arena from above, for `exportImage` and movies."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, sin
from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.standin.arena import Arena, Body
from webots_mcp.standin.geometry import Color, Shape, UprightBox

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

SIZE_PX: Final = (800, 600)
_MARGIN_PX: Final = 20


@dataclass(frozen=True)
class PictureRequest:
    """A request for a picture of the arena."""

    path: Path
    quality: int


@dataclass(frozen=True)
class Label:
    """A text over the picture. Position and size are fractions of the picture."""

    text: str
    x: float
    y: float
    size: float
    rgb: int


@dataclass(frozen=True)
class MapScale:
    """The conversion from metres to pixels."""

    x_m: float
    y_m: float
    pixels_per_m: float

    @staticmethod
    def of(shapes: list[Shape]) -> MapScale:
        """Return the scale at which all shapes fit, with x to the right and y upwards."""
        corners = [corner for shape in shapes for corner in _outline(shape)] or [(-1.0, -1.0)]
        xs, ys = [x for x, _ in corners], [y for _, y in corners]
        width, height = max(xs) - min(xs), max(ys) - min(ys)
        free_px = [size - 2 * _MARGIN_PX for size in SIZE_PX]
        scale = min(free_px[0] / max(width, 0.1), free_px[1] / max(height, 0.1))
        return MapScale((max(xs) + min(xs)) / 2.0, (max(ys) + min(ys)) / 2.0, scale)

    def at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the pixel of a point."""
        return (
            SIZE_PX[0] / 2.0 + (x_m - self.x_m) * self.pixels_per_m,
            SIZE_PX[1] / 2.0 - (y_m - self.y_m) * self.pixels_per_m,
        )


def save_picture(
    picture: PictureRequest, arena: Arena, time_s: float, labels: Iterable[Label]
) -> None:
    """Draw the arena and write the file, in the format of its extension.

    Raises:
        ValueError: The extension is neither .png nor .jpg.
        OSError: The file cannot be written.
        ImportError: Pillow is not installed.
    """
    kind = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}.get(picture.path.suffix.lower())
    if kind is None:
        raise ValueError(f"unknown extension {picture.path.suffix!r}, use .png or .jpg")
    draw_view(arena, time_s, labels).save(picture.path, kind, quality=picture.quality)


def draw_view(arena: Arena, time_s: float, labels: Iterable[Label]) -> Image:
    """Return a picture of the arena from above.

    Raises:
        ImportError: Pillow is not installed.
    """
    from PIL import Image, ImageDraw  # Imported late: most simulations never need a picture.

    image = Image.new("RGB", SIZE_PX, _rgb(arena.colors.sky))
    pen = ImageDraw.Draw(image)
    chart = MapScale.of([shape for body in arena.bodies for shape in body.shapes])
    _draw_floor(pen, chart, arena)
    for body in arena.bodies:
        _draw_body(pen, chart, body)
    pen.text((8, 4), f"{time_s:.3f} s", fill=(0, 0, 0), font_size=16)
    for label in labels:
        _draw_label(pen, label)
    return image


def _draw_floor(pen: ImageDraw, chart: MapScale, arena: Arena) -> None:
    corners = [c for body in arena.bodies for shape in body.shapes for c in _outline(shape)]
    if not corners:
        return
    left, top = chart.at(min(x for x, _ in corners), max(y for _, y in corners))
    right, bottom = chart.at(max(x for x, _ in corners), min(y for _, y in corners))
    pen.rectangle((left, top, right, bottom), fill=_rgb(arena.colors.floor))


def _draw_body(pen: ImageDraw, chart: MapScale, body: Body) -> None:
    for shape in body.shapes:
        _draw_shape(pen, chart, shape)
    radius = body.footprint.radius_m
    if body.node.type_name == "Robot" and radius:
        x, y = body.centre()
        nose = (x + radius * cos(body.yaw_rad) * 1.6, y + radius * sin(body.yaw_rad) * 1.6)
        pen.line((*chart.at(x, y), *chart.at(*nose)), fill=(220, 30, 30), width=4)
        pen.text(chart.at(x + radius, y + radius), body.name, fill=(0, 0, 0), font_size=14)


def _draw_shape(pen: ImageDraw, chart: MapScale, shape: Shape) -> None:
    if isinstance(shape, UprightBox):
        pen.polygon([chart.at(*corner) for corner in _outline(shape)], fill=_rgb(shape.color))
        return
    radius_px = shape.radius_m * chart.pixels_per_m
    pen.circle(chart.at(shape.x, shape.y), radius_px, fill=_rgb(shape.color))


def _draw_label(pen: ImageDraw, label: Label) -> None:
    at = (label.x * SIZE_PX[0], label.y * SIZE_PX[1])
    rgb = (label.rgb >> 16 & 255, label.rgb >> 8 & 255, label.rgb & 255)
    pen.text(at, label.text, fill=rgb, font_size=max(label.size * SIZE_PX[1], 8.0))


def _outline(shape: Shape) -> list[tuple[float, float]]:
    if not isinstance(shape, UprightBox):
        r = shape.radius_m
        return [(shape.x + dx, shape.y + dy) for dx in (-r, r) for dy in (-r, r)]
    c, s, a, b = shape.cos_yaw, shape.sin_yaw, shape.half_x_m, shape.half_y_m
    corners = ((a, b), (-a, b), (-a, -b), (a, -b))
    return [(shape.x + c * u - s * v, shape.y + s * u + c * v) for u, v in corners]


def _rgb(color: Color) -> tuple[int, int, int]:
    r, g, b = (min(max(round(part * 255), 0), 255) for part in color)
    return r, g, b
