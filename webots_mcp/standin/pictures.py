"""Pictures: of the whole arena from above, for `exportImage`, and those of cameras."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, hypot, inf, sin, tan
from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.standin.arena import Arena, Body, SceneColors
from webots_mcp.standin.geometry import Color, Shape, Target, UprightBox, targets_from

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

SIZE_PX: Final = (800, 600)
_MARGIN_PX: Final = 20
_FORMATS: Final = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
_LIGHT: Final = (0.8, 0.6)


@dataclass(frozen=True)
class PictureRequest:
    """A picture that was asked for."""

    path: Path
    quality: int


@dataclass(frozen=True)
class Label:
    """A text over the picture; place and size are shares of the picture."""

    text: str
    x: float
    y: float
    size: float
    rgb: int


@dataclass(frozen=True)
class MapScale:
    """From metres to pixels."""

    x_m: float
    y_m: float
    pixels_per_m: float

    @staticmethod
    def of(shapes: list[Shape]) -> MapScale:
        """The chart that shows all shapes, x to the right and y upwards."""
        corners = [corner for shape in shapes for corner in _outline(shape)] or [(-1.0, -1.0)]
        xs, ys = [x for x, _ in corners], [y for _, y in corners]
        width, height = max(xs) - min(xs), max(ys) - min(ys)
        room = [size - 2 * _MARGIN_PX for size in SIZE_PX]
        scale = min(room[0] / max(width, 0.1), room[1] / max(height, 0.1))
        return MapScale((max(xs) + min(xs)) / 2.0, (max(ys) + min(ys)) / 2.0, scale)

    def at(self, x_m: float, y_m: float) -> tuple[float, float]:
        """The pixel of a point."""
        return (
            SIZE_PX[0] / 2.0 + (x_m - self.x_m) * self.pixels_per_m,
            SIZE_PX[1] / 2.0 - (y_m - self.y_m) * self.pixels_per_m,
        )


def save_picture(
    picture: PictureRequest, arena: Arena, time_s: float, labels: Iterable[Label]
) -> None:
    """Draw the arena and write the file; the format is the extension's.

    Raises:
        ValueError: The extension is neither .png nor .jpg.
        OSError: The file cannot be written.
        ImportError: Pillow is not installed.
    """
    from PIL import Image, ImageDraw  # only here: most simulations never need a picture

    kind = _FORMATS.get(picture.path.suffix.lower())
    if kind is None:
        raise ValueError(f"unknown extension {picture.path.suffix!r}, use .png or .jpg")
    image = Image.new("RGB", SIZE_PX, _rgb(arena.colors.sky))
    pen = ImageDraw.Draw(image)
    chart = MapScale.of([shape for body in arena.bodies for shape in body.shapes])
    _draw_floor(pen, chart, arena)
    for body in arena.bodies:
        _draw_body(pen, chart, body)
    pen.text((8, 4), f"{time_s:.3f} s", fill=(0, 0, 0), font_size=16)
    for label in labels:
        _draw_label(pen, label)
    image.save(picture.path, kind, quality=picture.quality)


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


# Pictures of cameras, one ray per column of pixels ------------------------------------------------


"""Where the light comes from, so that the sides of a box differ."""


@dataclass(frozen=True)
class CameraView:
    """What a camera saw at one moment."""

    x: float
    y: float
    z: float
    yaw_rad: float
    width: int
    height: int
    field_of_view_rad: float
    shapes: tuple[Shape, ...]


def render(view: CameraView, colors: SceneColors) -> bytes:
    """The picture: blue, green, red, alpha for each pixel, rows from the top left."""
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
    for distance, target in seen:  # far ones first: near ones cover them
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
    """One opaque pixel: blue, green, red, alpha."""
    r, g, b = (min(max(round(part * 255), 0), 255) for part in color)
    return bytes((b, g, r, 255))
