"""A sheet to draw on, and the picture that it becomes.

This package imports matplotlib inside its functions only: with the first picture.
"""

from __future__ import annotations

import io
import textwrap
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import spelled_out
from webots_mcp.plotting.fonts import fit_fonts
from webots_mcp.plotting.palette import FAINT, INK
from webots_mcp.store.questions.series import MOST_POINTS

ImageFormat = Literal["png", "svg"]

MOST_PANELS: Final = 3
MOST_LANES: Final = 4
WIDTH_PX: Final = 900
HEIGHT_PX: Final = 500
LEAST_WIDTH_PX: Final = 400
LEAST_HEIGHT_PX: Final = 300
MOST_PX: Final = 2000
_DPI: Final = 100
BESIDE_PX: Final = 200  # what stands beside an axis, about: its labels and a legend
ROW_PX: Final = 17
_PANEL_PX: Final = 110
_TITLE_AND_LEGEND_PX: Final = 150
_BUCKET_PX: Final = 3  # in fewer pixels the band of extremes would hide behind the line
_LONGEST_NAME: Final = 24
_LETTER_PX: Final = 8  # of a bold title

# A user's matplotlibrc must not change the pictures; what is recorded is text, never TeX.
_STYLE: Final[dict[str, Any]] = {
    "text.parse_math": False,
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.limits": (-4, 5),
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "svg.hashsalt": "webots-mcp",
    "svg.fonttype": "none",  # text stays text: smaller, and it can be searched
}
_drawing = threading.Lock()  # matplotlib's settings and fonts belong to the process


@dataclass(frozen=True)
class Picture:
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
        lanes: How many rows of modes and flags have room below the panels.
        rows: The same with the rows of events.
    """

    points: int
    panels: int
    lanes: int
    rows: int


@dataclass(frozen=True)
class Sheet:
    """The form of a picture: its size in pixels (an SVG has 100 to the inch) and its format."""

    width_px: int = WIDTH_PX
    height_px: int = HEIGHT_PX
    image_format: ImageFormat = "png"

    def __post_init__(self) -> None:
        _require_size("width_px", self.width_px, LEAST_WIDTH_PX)
        _require_size("height_px", self.height_px, LEAST_HEIGHT_PX)
        if self.image_format not in get_args(ImageFormat):
            known = " or ".join(get_args(ImageFormat))
            raise InvalidInputError(f"a picture can be {known}, not {self.image_format!r}")

    @property
    def axis_px(self) -> int:
        """About how long the time axis becomes; exactly that is known only after painting."""
        return self.width_px - BESIDE_PX

    @property
    def room(self) -> Room:
        """What is still readable on it."""
        beside_panels_px = self.height_px - _TITLE_AND_LEGEND_PX
        rows = beside_panels_px // (2 * ROW_PX)
        return Room(
            points=min(self.axis_px // _BUCKET_PX, MOST_POINTS),
            panels=max(1, min(MOST_PANELS, beside_panels_px // _PANEL_PX)),
            lanes=min(MOST_LANES, rows),
            rows=rows,
        )


def _require_size(name: str, value: int, least: int) -> None:
    if not least <= value <= MOST_PX:
        raise InvalidInputError(f"{name}={value} must be from {least} to {MOST_PX}")


def draw(sheet: Sheet, paint: Callable[[Any], None]) -> tuple[bytes, tuple[str, ...]]:
    """The content of the file that `paint` makes of an empty matplotlib `Figure`, and notes."""
    from matplotlib import style  # 0.5 s and more, at the first picture
    from matplotlib.figure import Figure

    buffer = io.BytesIO()
    size = (sheet.width_px / _DPI, sheet.height_px / _DPI)
    with _drawing, style.context(["default", _STYLE]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a note says so
        figure: Any = Figure(figsize=size, dpi=_DPI, layout="constrained")
        paint(figure)
        _spell_out(figure)
        # In an SVG text stays text, for which the viewer has fonts.
        notes = fit_fonts(figure) if sheet.image_format == "png" else ()
        figure.savefig(buffer, format=sheet.image_format, metadata=_metadata(sheet))
    return buffer.getvalue(), notes


def _spell_out(figure: Any) -> None:
    """No text turns the direction of what stands beside it, nor breaks the XML of an SVG."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(spelled_out(text.get_text()))


def _metadata(sheet: Sheet) -> dict[str, str | None]:
    """Without the date, the same recording gives the same file."""
    return {"Date": None} if sheet.image_format == "svg" else {}


def image_format_of(file: Path) -> ImageFormat:
    """The format that a file's name asks for.

    Raises:
        InvalidInputError: Its suffix is neither .png nor .svg.
    """
    suffix = file.suffix.lower().removeprefix(".")
    for known in get_args(ImageFormat):
        if suffix == known:
            return known
    raise InvalidInputError(f"{file.name!r} is not the name of a picture: end it in .png or .svg")


def media_type(sheet: Sheet) -> str:
    """The media type of the sheet's format."""
    return "image/svg+xml" if sheet.image_format == "svg" else "image/png"


def paint_title(figure: Any, title: str) -> None:
    """At the top left, in as many lines as it needs."""
    text = wrapped(title, figure.get_figwidth() * figure.dpi)
    figure.suptitle(text, x=0.01, ha="left", fontsize=10, fontweight="bold")


def wrapped(text: str, width_px: float) -> str:
    """A line in as many lines as a picture of that width needs."""
    return textwrap.fill(text, int(width_px / _LETTER_PX))


def short(name: str) -> str:
    """A name that fits a legend, in one line: of a long one the end, which tells more."""
    line = " ".join(spelled_out(name).split())
    line = line if len(line) <= _LONGEST_NAME else f"…{line[1 - _LONGEST_NAME :]}"
    return f" {line}" if line.startswith("_") else line  # matplotlib hides labels in "_"
