"""Painting clips: a picture or map, a line with clock and mode, and curves with a moving cursor.

What does not move (map, curves, texts) is painted once; for each frame Pillow puts the rest on it.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, cast

from webots_mcp.analysis.arrays import np
from webots_mcp.plotting.axes import AxesBox
from webots_mcp.plotting.canvas import Canvas, PlotImage, fitted, width_of
from webots_mcp.plotting.colours import INK, LINES, area_styles
from webots_mcp.plotting.curves import Curve
from webots_mcp.plotting.painting import paint_area
from webots_mcp.plotting.signal_plot import paint_signals
from webots_mcp.plotting.trajectory import paint_trajectory
from webots_mcp.plugins.clip.clip_content import ClipContent, RobotTrack
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.run_rows import opened

if TYPE_CHECKING:
    from PIL.Image import Image


_PAPER: Final = (255, 255, 255)
_SURROUND: Final = (32, 32, 32)  # beside a picture of another shape
_CURSOR: Final = (51, 51, 51)
_ACCENT: Final = LINES[1]  # the moment, and the robot


@dataclass(frozen=True)
class ClipLayout:
    """The layout of a clip and of its contact sheet, in pixels.

    Attributes:
        header_px: Height of the line with clock and mode; `text_px` of its letters.
        picture_px: Minimum and maximum height of a camera's picture.
        map_share: Height of the map as a share of its width.
        panel_px: Height of a curve with its name; `axis_px` of what is below the curves.
        stale_s: Age from which on a picture says of which time it is.
        at_end_s: Time beyond the ends of a curve up to which its last value is marked.
        least_outline_px: An outline that would be smaller is drawn as an arrow of `arrow_px`.
        gap_px: Gap between the tiles of a sheet.
        tile_header_px: Height of the line above a tile.
    """

    header_px: int = 28
    text_px: float = 14.0
    picture_px: tuple[int, int] = (120, 360)
    map_share: float = 0.75
    panel_px: int = 66
    axis_px: int = 62
    stale_s: float = 0.5
    at_end_s: float = 0.2
    least_outline_px: float = 14.0
    arrow_px: float = 11.0
    gap_px: int = 8
    tile_header_px: int = 22


_LAYOUT: Final = ClipLayout()


class ClipPainter:
    """Paints the frames of a clip, and its contact sheet.

    Args:
        content: What it shows.
        width_px: Width of a frame.

    Attributes:
        notes: Texts that no font of this computer can show.
    """

    def __init__(self, content: ClipContent, width_px: int) -> None:
        self._content, self._width = content, width_px
        self.notes: list[str] = []
        mode = content.mode
        self._styles = area_styles(mode.values) if mode else {}
        self._view: _View | None = None
        self._curves: _Curves | None = None

    # Frames ---------------------------------------------------------------------------------------

    def frames(self, times: Sequence[float]) -> Iterator[Image]:
        """Paint the frames at these simulation times."""
        header, width = _LAYOUT.header_px, self._width
        if self._view is None or self._curves is None:
            self._view, self._curves = self._unmoving(width, width)
        view, curves = self._view, self._curves
        labels = self._headers(times, width, header, _LAYOUT.text_px)
        for time_s, label in zip(times, labels, strict=True):
            frame = _new(width, header + view.height + curves.height)
            frame.paste(label, (0, 0))
            if view.height:
                frame.paste(view.at(time_s), (0, header))
            curves.paint(frame, header + view.height, [time_s])
            yield frame

    def _unmoving(
        self, view_px: int, curves_px: int, *, in_tile: bool = False
    ) -> tuple[_View, _Curves]:
        view = _View(self._content, view_px, in_tile=in_tile)
        curves = _Curves(self._content, curves_px)
        self.notes += [*view.notes, *curves.notes]
        return view, curves

    def _headers(
        self,
        times: Sequence[float],
        width: int,
        height: int,
        size: float,
        *,
        numbered: bool = False,
    ) -> list[Image]:
        """Return the lines with clock and mode, all painted in one go."""
        canvas = Canvas(width, height * max(1, len(times)))
        for row, time_s in enumerate(times):
            self._header(canvas, row * height, height, size, time_s, row + 1 if numbered else 0)
        painted = self._raster(canvas)
        return [
            painted.crop((0, row * height, width, (row + 1) * height)) for row in range(len(times))
        ]

    def _header(
        self, canvas: Canvas, top: int, height: int, size: float, time_s: float, number: int
    ) -> None:
        base, x = top + height / 2 + size * 0.36, 6.0
        if number:
            side = size + 4
            canvas.add("rect", x=x, y=top + (height - side) / 2, width=side, height=side, rx=3,
                       fill=canvas.theme.ink)  # fmt: skip
            canvas.text(x + side / 2, base - 0.5, str(number), size=size - 2, anchor="middle",
                        colour=canvas.theme.ground, font_weight="bold")  # fmt: skip
            x += side + 6
        clock = f"{time_s:.3f} s"
        canvas.text(x, base, clock, size=size, font_weight="bold")
        x += 1.1 * width_of(clock, size) + 6
        apart_s = time_s - self._content.moment.at_s
        apart = "moment" if abs(apart_s) < 0.0005 else f"{apart_s:+.2f} s".replace("-", "\u2212")
        colour = _ACCENT if apart == "moment" else canvas.theme.faint
        if x + width_of(apart, size - 2) < canvas.width_px:
            canvas.text(x, base, apart, size=size - 2, colour=colour)
            x += width_of(apart, size - 2) + 8
        value = self._content.mode_at(time_s)
        room = canvas.width_px - x - 18
        if value and room > 30:
            text = fitted(spelled_out(value), room, size - 1)
            wide = width_of(text, size - 1) + 12
            left = canvas.width_px - wide - 4
            style = self._styles.get(value)
            if style is not None:
                paint_area(canvas, style, (left, top + 3, wide, height - 6), 0.6)
            canvas.text(left + wide / 2, base, text, size=size - 1, anchor="middle", colour=INK)

    def _raster(self, canvas: Canvas) -> Image:
        image, notes = _rasterised(canvas)
        self.notes += notes
        return image

    # The contact sheet ----------------------------------------------------------------------------

    def sheet(self, times: Sequence[float], width_px: int) -> Image:
        """Paint the frames at these times beside each other, above the curves with a line for each.

        The lines have the numbers of the frames.
        """
        content, gap = self._content, _LAYOUT.gap_px
        has_view = bool(content.files or content.track)
        columns = min(4, math.ceil(math.sqrt(len(times)))) if len(times) > 3 else len(times)
        rows = math.ceil(len(times) / columns) if has_view else 0
        tile_px = (width_px - gap * (columns + 1)) // columns
        view, curves = self._unmoving(tile_px, width_px, in_tile=True)
        height = _LAYOUT.tile_header_px + view.height
        sheet = _new(width_px, rows * (height + gap) + gap + curves.height + 14)
        if has_view:
            labels = self._headers(times, tile_px, _LAYOUT.tile_header_px, 12.0, numbered=True)
            for number, (time_s, label) in enumerate(zip(times, labels, strict=True)):
                x = gap + number % columns * (tile_px + gap)
                y = gap + number // columns * (height + gap)
                sheet.paste(label, (x, y))
                sheet.paste(view.at(time_s), (x, y + _LAYOUT.tile_header_px))
        curves.paint(sheet, rows * (height + gap) + gap + 14, times, numbered=True)
        return sheet


class _View:
    """What is above the curves: the pictures of a camera, or the map; nothing of height 0."""

    def __init__(self, content: ClipContent, width: int, *, in_tile: bool = False) -> None:
        self._content, self._width = content, width
        self.notes: Sequence[str] = ()
        self._newest: tuple[object, Image] | None = None
        self._stale: dict[str, Image] = {}
        self.height = 0
        if content.files:
            least, most = _LAYOUT.picture_px
            share = sorted(each.height / each.width for each, _ in content.files if each.width)
            middle = share[len(share) // 2] if share else 0.75
            most = round(most * width / 480)
            self.height = min(max(round(width * middle), min(least, most)), most)
        elif content.track is not None:
            self.height = round(width * _LAYOUT.map_share)
            self._map = _Map(content.track, width, self.height, in_tile=in_tile)
            self.notes = self._map.notes

    def at(self, time_s: float) -> Image:
        """Return it as it was at a time."""
        if not self._content.files:
            return self._map.at(time_s)
        stored, file = self._content.picture_at(time_s)
        if self._newest is None or self._newest[0] != stored.id:
            with opened(file) as picture:
                self._newest = stored.id, self._fitted(picture.convert("RGB"))
        image = self._newest[1]
        if abs(time_s - stored.sim_time_s) <= _LAYOUT.stale_s:
            return image
        image = image.copy()
        image.paste(self._of_time(stored.sim_time_s), (6, 6))
        return image

    def _fitted(self, picture: Image) -> Image:
        """Return a picture in the middle of the box, as large as fits."""
        from PIL import Image as Pictures

        scale = min(self._width / picture.width, self.height / picture.height)
        size = tuple(max(1, round(side * scale)) for side in picture.size)
        scaled = picture.resize(cast("tuple[int, int]", size), Pictures.Resampling.BICUBIC)
        if scaled.size == (self._width, self.height):
            return scaled
        box = _new(self._width, self.height, _SURROUND)
        box.paste(scaled, ((self._width - scaled.width) // 2, (self.height - scaled.height) // 2))
        return box

    def _of_time(self, taken_s: float) -> Image:
        """Return a label that says of which time a picture is."""
        text = f"picture of {taken_s:.3f} s"
        if text not in self._stale:
            wide = round(width_of(text)) + 10
            canvas = Canvas(wide, 18)
            canvas.text(wide / 2, 13, text, anchor="middle", font_weight="bold")
            self._stale[text] = _rasterised(canvas)[0]
        return self._stale[text]


class _Map:
    """The map, and the robot's outline that moves over it."""

    def __init__(self, track: RobotTrack, width: int, height: int, *, in_tile: bool) -> None:
        self._track = track
        if in_tile:  # its labels would be too small to read, so it is cut out of a larger one
            canvas, box = paint_trajectory(track.axes, width + 60, height + 110, titled=False,
                                           obstacles=track.obstacles)  # fmt: skip
        else:
            canvas, box = paint_trajectory(
                track.axes, width, height, titled=False, obstacles=track.obstacles
            )
        painted, self.notes = _rasterised(canvas)
        if in_tile:
            left, top = round(box.left), round(box.top)
            room = (round(box.width), round(box.height))
            cut = painted.crop((left, top, left + room[0], top + room[1]))
            painted = _new(width, height)
            at = ((width - room[0]) // 2, (height - room[1]) // 2)
            painted.paste(cut, at)
            box = AxesBox(at[0], at[1], room[0], room[1], box.x, box.y)
        self._painted, self._box = painted, box
        self._per_m = box.width / (box.x[1] - box.x[0])

    def at(self, time_s: float) -> Image:
        """Return the map with the robot where it was at a time."""
        from PIL import ImageDraw

        x, y, heading = self._track.pose_at(time_s)
        image = self._painted.copy()
        draw = ImageDraw.Draw(image, "RGBA")
        place = (float(self._box.px(x)), float(self._box.py(y)))
        corners = self._outline(place, heading)
        fill = (*_rgb(_ACCENT), 150)
        draw.polygon(corners, fill=fill)
        draw.line([*corners, *corners[:2]], fill=_CURSOR, width=2, joint="curve")
        if heading is not None and len(corners) > 4:  # which end is its front
            reach = self._reach(heading, corners, place)
            ahead = (place[0] + reach * math.cos(heading), place[1] - reach * math.sin(heading))
            draw.line([place, ahead], fill=_CURSOR, width=2)
        return image

    def _outline(
        self, place: tuple[float, float], heading: float | None
    ) -> list[tuple[float, float]]:
        """Return the corners of the robot in pixels: of its outline, an arrow, or a diamond."""
        outline = self._track.outline
        size_px = self._per_m * 2 * max((math.hypot(*each) for each in outline), default=0.0)
        turn, scale = heading or 0.0, self._per_m
        if heading is None or size_px < _LAYOUT.least_outline_px:
            arrow = ((1.0, 0.0), (-0.8, 0.75), (-0.4, 0.0), (-0.8, -0.75))
            diamond = ((0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8))
            outline, scale = (diamond if heading is None else arrow), _LAYOUT.arrow_px
        cos, sin = math.cos(turn) * scale, math.sin(turn) * scale
        return [
            (place[0] + cos * ahead - sin * left, place[1] - (sin * ahead + cos * left))
            for ahead, left in outline
        ]

    @staticmethod
    def _reach(
        heading: float, corners: Sequence[tuple[float, float]], place: tuple[float, float]
    ) -> float:
        """Return how far the outline reaches ahead of the robot's origin, in pixels."""
        cos, sin = math.cos(heading), math.sin(heading)
        return max((x - place[0]) * cos - (y - place[1]) * sin for x, y in corners)


class _Curves:
    """The curves, with a dashed line at the moment; nothing of height 0 where there are none."""

    def __init__(self, content: ClipContent, width: int) -> None:
        self.height, self.notes = 0, cast("Sequence[str]", ())
        axes = content.signals
        if axes is None:
            return
        panels = len(axes.panels)
        self.height = panels * _LAYOUT.panel_px + 20 * len(axes.rows) + _LAYOUT.axis_px
        canvas, self._boxes = paint_signals(axes, width, self.height, titled=False)
        for box in self._boxes:
            x = float(box.px(content.moment.at_s))
            canvas.add("path", d=f"M{x:.1f} {box.top:.1f}V{box.bottom:.1f}", stroke=_ACCENT,
                       stroke_width=1.4, stroke_dasharray="3 3")  # fmt: skip
        self._painted, self.notes = _rasterised(canvas)
        self._pieces = [
            (box, _pieces_of(curve))
            for box, panel in zip(self._boxes, axes.panels, strict=False)
            for curve in panel.curves
        ]

    def paint(
        self, image: Image, top: int, times: Sequence[float], *, numbered: bool = False
    ) -> None:
        """Put the curves below each other at a height, with a line at each time."""
        from PIL import ImageDraw

        if not self.height:
            return
        image.paste(self._painted, (0, top))
        draw = ImageDraw.Draw(image)
        first, last = self._boxes[0], self._boxes[-1]
        taken_px = -math.inf
        for number, time_s in enumerate(times, 1):
            x = float(first.px(time_s))
            draw.line([(x, top + first.top), (x, top + last.bottom)], fill=_CURSOR,
                      width=1 if numbered else 2)  # fmt: skip
            for box, value in self._values_at(time_s):
                y = top + float(box.py(value))
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=_rgb(LINES[0]), outline=_PAPER)
            if numbered and x - taken_px > 14:
                taken_px = x
                draw.text((x, top - 1), str(number), fill=_CURSOR, anchor="mm",
                          font=_digits())  # fmt: skip

    def _values_at(self, time_s: float) -> Iterator[tuple[AxesBox, float]]:
        """Return the value of each curve at a time, with its axes; none where it is broken."""
        for box, pieces in self._pieces:
            for piece in pieces:
                if piece[0, 0] - _LAYOUT.at_end_s <= time_s <= piece[-1, 0] + _LAYOUT.at_end_s:
                    value = float(cast("Any", np).interp(time_s, piece[:, 0], piece[:, 1]))
                    if math.isfinite(value):
                        yield box, value
                    break


def _pieces_of(curve: Curve) -> list[Any]:
    """Return the points of a curve between its breaks, where a time is NaN."""
    rows: Any = np.array(curve.points, np.float64)
    breaks = np.flatnonzero(np.isnan(rows[:, 0])).tolist()
    edges = [-1, *breaks, len(rows)]
    return [rows[start + 1 : end] for start, end in pairwise(edges) if end > start + 1]


def _digits() -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(12)


def _rasterised(canvas: Canvas) -> tuple[Image, Sequence[str]]:
    from PIL import Image as Pictures

    made: PlotImage = canvas.picture("png", "", ())
    return Pictures.open(io.BytesIO(made.data)).convert("RGB"), made.notes


def _new(width: int, height: int, colour: tuple[int, int, int] = _PAPER) -> Image:
    from PIL import Image as Pictures

    return Pictures.new("RGB", (width, max(1, height)), colour)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue
