"""Pictures are painted as SVG on a canvas, and become PNG without a browser.

A sheet says how large a picture is, and how much is readable on it.
"""

from __future__ import annotations

import io
import tempfile
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final, Literal, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.plotting.colours import LINES, ON_PAPER, Theme
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.signal_history import MOST_POINTS

MOST_PANELS: Final = 3
WIDTH_PX: Final = 900
HEIGHT_PX: Final = 500
LEAST_WIDTH_PX: Final = 400
LEAST_HEIGHT_PX: Final = 300
MOST_PX: Final = 2000
ROW_PX: Final = 17
TEXT_PX: Final = 11.0  # the size of usual letters
ImageFormat = Literal["png", "svg"]


@dataclass(frozen=True)
class CanvasTexts:
    """How the canvas writes names and samples of colour.

    Attributes:
        name_characters: Characters of a name.
        cell_px: Width of a colour sample.
        texts: Texts that are listed.
    """

    name_characters: int = 24
    cell_px: int = 24
    texts: int = 3


_LEGEND: Final = CanvasTexts()


@dataclass(frozen=True)
class SheetLayout:
    """What the parts of a picture take in pixels, about.

    Attributes:
        beside_axis_px: What stands next to a horizontal axis.
        panel_px: A panel that is still readable.
        title_and_legend_px: Title, axis and legend.
        bucket_px: A bucket: in fewer pixels the band of extremes would hide behind the line.
        lanes: Maximum number of rows of modes and flags.
    """

    beside_axis_px: int = 200
    panel_px: int = 110
    title_and_legend_px: int = 150
    bucket_px: int = 3
    lanes: int = 4


_LAYOUT: Final = SheetLayout()


@dataclass(frozen=True)
class PlotImage:
    """A finished picture.

    Attributes:
        data: The file's content.
        media_type: `image/png` or `image/svg+xml`.
        caption: What it shows, in one line.
        notes: What is not in it, or what its reader should know.
    """

    data: bytes
    media_type: str
    caption: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Room:
    """How much a picture holds.

    Attributes:
        points: How many buckets a curve is made of.
        panels: How many panels are readable below each other.
        lanes: Number of rows of modes and flags that fit below the panels.
        rows: The same with the rows of events.
    """

    points: int
    panels: int
    lanes: int
    rows: int


@dataclass(frozen=True)
class Sheet:
    """The form of a picture: its size in pixels and its format."""

    width_px: int = WIDTH_PX
    height_px: int = HEIGHT_PX
    image_format: ImageFormat = "png"

    def __post_init__(self) -> None:
        _require_size("width_px", self.width_px, LEAST_WIDTH_PX)
        _require_size("height_px", self.height_px, LEAST_HEIGHT_PX)
        if self.image_format not in get_args(ImageFormat):
            known = " or ".join(get_args(ImageFormat))
            raise InvalidInputError(f"A picture can be {known}, not {self.image_format!r}.")

    @property
    def room(self) -> Room:
        """What is still readable on it."""
        beside_panels_px = self.height_px - _LAYOUT.title_and_legend_px
        rows = beside_panels_px // (2 * ROW_PX)
        return Room(
            points=min((self.width_px - _LAYOUT.beside_axis_px) // _LAYOUT.bucket_px, MOST_POINTS),
            panels=max(1, min(MOST_PANELS, beside_panels_px // _LAYOUT.panel_px)),
            lanes=min(_LAYOUT.lanes, rows),
            rows=rows,
        )


def _require_size(name: str, value: int, least: int) -> None:
    if not least <= value <= MOST_PX:
        raise InvalidInputError(f"{name}={value} must be from {least} to {MOST_PX}.")


def image_format_of(file: Path) -> ImageFormat:
    """Return the format that a file's name asks for.

    Raises:
        InvalidInputError: Its suffix is neither .png nor .svg.
    """
    suffix = file.suffix.lower().removeprefix(".")
    for known in get_args(ImageFormat):
        if suffix == known:
            return known
    raise InvalidInputError(f"{file.name!r} is not the name of a picture. End it in .png or .svg.")


class Canvas:
    """An SVG that is painted: elements over each other, in the order in which they are added."""

    def __init__(self, width_px: float, height_px: float, theme: Theme = ON_PAPER) -> None:
        self.width_px, self.height_px, self.theme = width_px, height_px, theme
        self._parts: list[str] = []
        self._texts: list[str] = []

    def add(self, element: str, **attributes: Any) -> None:
        """Add an element; a name as `stroke_width` is the attribute `stroke-width`."""
        self._parts.append(f"<{element}{_written(attributes)}/>")

    def open(self, element: str = "g", **attributes: Any) -> None:
        """Begin an element that the next ones are in."""
        self._parts.append(f"<{element}{_written(attributes)}>")

    def close(self, element: str = "g") -> None:
        """End it."""
        self._parts.append(f"</{element}>")

    def text(
        self, x: float, y: float, text: str, *, size: float = TEXT_PX, colour: str = "",
        anchor: str = "start", **attributes: Any,
    ) -> None:  # fmt: skip
        """Add a text in one line; `y` is where its letters stand.

        No text changes the direction of its surroundings or breaks the XML.
        """
        text = spelled_out(text)
        self._texts.append(text)
        place = {"x": x, "y": y, "font_size": size, "fill": colour or self.theme.ink}
        place |= {"text_anchor": anchor} if anchor != "start" else {}
        written = _written(place | attributes)
        self._parts.append(f"<text{written}>{escape(text, quote=False)}</text>")

    def svg(self) -> str:
        """Return the whole SVG."""
        width, height = f"{self.width_px:g}", f"{self.height_px:g}"
        # Aileron comes with Pillow, for a computer without any font.
        families = "DejaVu Sans, Segoe UI, Helvetica Neue, Arial, Liberation Sans, Aileron"
        families += ", sans-serif"
        ground = f'<rect width="100%" height="100%" fill="{self.theme.ground}"/>'
        hatches = (
            '<defs><pattern id="hatch-gap" width="6" height="6" patternUnits="userSpaceOnUse">'
            '<path d="M-1 7L7-1M-1 1L1-1M5 7L7 5" stroke="#A0A0A0" stroke-width=".8"/></pattern>'
            '<pattern id="hatch-unread" width="7" height="7" patternUnits="userSpaceOnUse"><path '
            f'd="M0 0L7 7M0 7L7 0" stroke="{LINES[1]}" stroke-opacity=".6" stroke-width=".8"/>'
            '</pattern><pattern id="hatch-dots" width="6" height="6" '
            'patternUnits="userSpaceOnUse"><circle cx="3" cy="3" r="1" '
            'fill="#333333"/></pattern></defs>'
        )
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}" font-family="{families}">'
            f"{hatches}{ground}{''.join(self._parts)}</svg>"
        )

    def picture(self, image_format: ImageFormat, caption: str, notes: Sequence[str]) -> PlotImage:
        """Return the picture as a file; of a PNG a note says which texts no font here can show."""
        svg = self.svg()
        if image_format == "svg":
            return PlotImage(svg.encode(), "image/svg+xml", caption, tuple(notes))
        return PlotImage(_png(svg), "image/png", caption, (*notes, *_missing_fonts(self._texts)))


def _written(attributes: dict[str, Any]) -> str:
    named = ((name.rstrip("_").replace("_", "-"), each) for name, each in attributes.items())
    return "".join(f' {name}="{_value(each)}"' for name, each in named)


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}".rstrip("0").rstrip(".")
    return escape(str(value))


def _png(svg: str) -> bytes:
    """Rasterise it, with the fonts of this computer, and one that is always there."""
    import resvg_py
    from PIL import ImageFont

    spare: Any = ImageFont.load_default(TEXT_PX)
    with tempfile.TemporaryDirectory() as folder:
        font = Path(folder) / "spare.ttf"
        font.write_bytes(spare.font_bytes)
        return resvg_py.svg_to_bytes(svg_string=svg, font_files=[str(font)])


def _missing_fonts(texts: Iterable[str]) -> tuple[str, ...]:
    """Return a note with the first of the texts that have characters which no font here has."""
    foreign = {character for text in texts for character in text if _is_foreign(character)}
    boxed = _boxed(sorted(foreign)) if foreign else set[str]()
    named = [repr(text) for text in dict.fromkeys(texts) if boxed & set(text)]
    if not named:
        return ()
    more = [f"{len(named) - _LEGEND.texts} more"] if len(named) > _LEGEND.texts else []
    return (
        f"no font of this computer has all characters of {', '.join([*named[:3], *more])}: boxes "
        "stand for them (install a font that has them, or draw an .svg)",
    )


def _is_foreign(character: str) -> bool:
    """Return whether a font may not have a character: not ASCII, no space, control or accent."""
    unseen = ("Cc", "Cf", "Zs", "Zl", "Zp", "Mn", "Me")
    return not character.isascii() and unicodedata.category(character) not in unseen


def _boxed(characters: Sequence[str]) -> set[str]:
    """Return those that are drawn like a character that no font has."""
    from PIL import Image

    cells = Canvas(_LEGEND.cell_px, _LEGEND.cell_px * (len(characters) + 1))
    for row, character in enumerate(["\U0010ffff", *characters]):  # no font has it
        cells.text(4, _LEGEND.cell_px * (row + 0.8), character)
    drawn = Image.open(io.BytesIO(_png(cells.svg()))).convert("L")
    rows = [drawn.crop((0, y, _LEGEND.cell_px, y + _LEGEND.cell_px)).tobytes()
            for y in range(0, drawn.height, _LEGEND.cell_px)]  # fmt: skip
    return {each for each, row in zip(characters, rows[1:], strict=True) if row == rows[0]}


# Texts --------------------------------------------------------------------------------------------


def width_of(text: str, size: float = TEXT_PX) -> float:
    """About how wide a text becomes, in pixels; rather more than less."""
    return size * sum(_em(character) for character in text)


def _em(character: str) -> float:
    """Return the width of a letter in the widest of the usual fonts, so that texts fit in all."""
    if unicodedata.category(character) in ("Mn", "Me", "Cf"):
        return 0.0
    if character in "ijlftr|.,:;'!()[]/\\ -":
        return 0.4
    if character in "mwMW@%…" or unicodedata.east_asian_width(character) in "WF":
        return 1.0
    return 0.72 if character.isupper() else 0.64


def short(name: str) -> str:
    """Return a name that fits a legend, in one line: of a long one the end, which says more."""
    line = " ".join(spelled_out(name).split())
    return (
        line if len(line) <= _LEGEND.name_characters else f"…{line[1 - _LEGEND.name_characters :]}"
    )


def fitted(text: str, width_px: float, size: float = TEXT_PX) -> str:
    """Return a text in one line that is no wider: of a longer one the end."""
    line = " ".join(spelled_out(text).split())
    if width_of(line, size) <= width_px:
        return line
    while line and width_of(f"…{line}", size) > width_px:
        line = line[1:]
    return f"…{line}"


def wrapped(text: str, width_px: float, size: float = TEXT_PX, most: int = 4) -> list[str]:
    """Return a text in as many lines as it needs, at most that many; the last one keeps its end."""
    lines: list[str] = []
    words = spelled_out(text).split()
    while words and len(lines) < most - 1:
        count = len(words)
        while count > 1 and width_of(" ".join(words[:count]), size) > width_px:
            count -= 1
        lines.append(fitted(" ".join(words[:count]), width_px, size))
        del words[:count]
    return [*lines, fitted(" ".join(words), width_px, size)] if words else lines


# Axes ---------------------------------------------------------------------------------------------
