"""A sheet to draw on: pictures are painted as SVG, and become PNG without a browser."""

from __future__ import annotations

import io
import math
import tempfile
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args
from zlib import crc32

from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.series import MOST_POINTS

# Colours that people with any kind of colour vision can tell apart.
#
# Lines and marks: M. Okabe, K. Ito, "Color Universal Design" (2008), without the yellow, which is
# too light for a line on white. Areas: P. Tol, "Colour Schemes", SRON/EPS/TN/09-002 (2021), the
# scheme "light", made for the background of labels.


LINES: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES: Final = ("none", "6 2", "2 1.6", "6 2 2 2")  # in pixels
AREAS: Final = (
    "#77AADD", "#EE8866", "#44BB99", "#EEDD88", "#FFAABB", "#AAAA00", "#99DDFF", "#BBCC33",
)  # fmt: skip
_FIRST_CHOICE: Final = 4  # of the areas; the others are each close to one of these
OTHER_VALUES: Final = "others"  # the name that values share of which there are too many
FAINT: Final = "#767676"  # the lightest grey that is readable as text on white
INK: Final = "#333333"  # on areas, whatever the ground of the picture is
# Scales of colour whose lightness grows evenly, at equal distances: matplotlib's viridis and
# cividis, which are in the public domain.
_VIRIDIS: Final = (
    "#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80", "#5EC962", "#ADDC30",
    "#FDE725",
)  # fmt: skip
_CIVIDIS: Final = (
    "#00224E", "#123570", "#3B496C", "#575D6D", "#707173", "#8A8678", "#A59C74", "#C3B369",
    "#FEE838",
)  # fmt: skip
SCALES: Final = {"time": _VIRIDIS, "score": _CIVIDIS}
MOST_VALUES: Final = 2 * len(AREAS)
MOST_PANELS: Final = 3
MOST_LANES: Final = 4
WIDTH_PX: Final = 900
HEIGHT_PX: Final = 500
LEAST_WIDTH_PX: Final = 400
LEAST_HEIGHT_PX: Final = 300
MOST_PX: Final = 2000
ROW_PX: Final = 17
TEXT_PX: Final = 11.0  # the size of usual letters
_BESIDE_PX: Final = 200  # what stands beside an axis, about
_PANEL_PX: Final = 110
_TITLE_AND_LEGEND_PX: Final = 150
_BUCKET_PX: Final = 3  # in fewer pixels the band of extremes would hide behind the line
_LONGEST_NAME: Final = 24
_LEAST_SPAN: Final = 1e-11  # of the values: less is what rounding leaves of a constant
_FLAT: Final = 0.05  # of a constant value is shown above and below it
# Widths of letters in em, of the widest of the usual fonts, so that texts have room in all.
_NARROW: Final = frozenset("ijlftr|.,:;'!()[]/\\ -")
_BROAD: Final = frozenset("mwMW@%…")
# The last one comes with Pillow, for a computer without any font.
_FAMILIES: Final = "DejaVu Sans, Segoe UI, Helvetica Neue, Arial, Liberation Sans, Aileron"
_UNSEEN: Final = ("Cc", "Cf", "Zs", "Zl", "Zp", "Mn", "Me")  # spaces, controls, marks on letters
_NO_CHARACTER: Final = "\U0010ffff"  # no font has it
_CELL_PX: Final = 24
_SHOWN_TEXTS: Final = 3
_HATCHES: Final = (
    '<defs><pattern id="hatch-gap" width="6" height="6" patternUnits="userSpaceOnUse">'
    '<path d="M-1 7L7-1M-1 1L1-1M5 7L7 5" stroke="#A0A0A0" stroke-width=".8"/></pattern>'
    '<pattern id="hatch-unread" width="7" height="7" patternUnits="userSpaceOnUse">'
    f'<path d="M0 0L7 7M0 7L7 0" stroke="{LINES[1]}" stroke-opacity=".6" stroke-width=".8"/>'
    '</pattern><pattern id="hatch-dots" width="6" height="6" patternUnits="userSpaceOnUse">'
    '<circle cx="3" cy="3" r="1" fill="#333333"/></pattern></defs>'
)


class Area(NamedTuple):
    """How an area, or a stretch of a way, is filled."""

    colour: str
    dotted: bool


MERGED: Final = Area("#DDDDDD", dotted=False)


def area_styles(values: Iterable[str]) -> dict[str, Area]:
    """A style for each value: eight colours, the same with dots, and grey from the 17th value on.

    The colour hangs on the value's own text, so that "cruise" looks alike in every picture, unless
    another value in the same one has taken it.
    """
    styles: dict[str, Area] = {}
    for value in sorted(set(values)):
        first = crc32(value.encode()) % _FIRST_CHOICE
        order = (*AREAS[first:_FIRST_CHOICE], *AREAS[:first], *AREAS[_FIRST_CHOICE:])
        styled = (Area(colour, dotted) for dotted in (False, True) for colour in order)
        free = (style for style in styled if style not in styles.values())
        styles[value] = MERGED if value == OTHER_VALUES else next(free, MERGED)
    return styles


def scaled(share: float, scale: str) -> str:
    """The colour at a share, from 0 to 1, of a scale."""
    stops = SCALES[scale]
    place = min(max(share, 0.0), 1.0) * (len(stops) - 1)
    index = min(int(place), len(stops) - 2)
    low, high = (bytes.fromhex(stops[index + i][1:]) for i in (0, 1))
    mixed = (round(a + (place - index) * (b - a)) for a, b in zip(low, high, strict=True))
    return "#" + bytes(mixed).hex().upper()


ImageFormat = Literal["png", "svg"]


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
    """The form of a picture: its size in pixels and its format."""

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
    def room(self) -> Room:
        """What is still readable on it."""
        beside_panels_px = self.height_px - _TITLE_AND_LEGEND_PX
        rows = beside_panels_px // (2 * ROW_PX)
        return Room(
            points=min((self.width_px - _BESIDE_PX) // _BUCKET_PX, MOST_POINTS),
            panels=max(1, min(MOST_PANELS, beside_panels_px // _PANEL_PX)),
            lanes=min(MOST_LANES, rows),
            rows=rows,
        )


def _require_size(name: str, value: int, least: int) -> None:
    if not least <= value <= MOST_PX:
        raise InvalidInputError(f"{name}={value} must be from {least} to {MOST_PX}")


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


@dataclass(frozen=True)
class Look:
    """The colours of what surrounds the data, as CSS; in a page they follow its style."""

    ink: str = INK
    faint: str = FAINT
    grid: str = "#E3E3E3"
    ground: str = "#FFFFFF"


ON_PAPER: Final = Look()
ON_A_PAGE: Final = Look("var(--ink)", "var(--faint)", "var(--grid)", "var(--ground)")


class Canvas:
    """An SVG that is painted: elements over each other, in the order in which they are added."""

    def __init__(self, width_px: float, height_px: float, look: Look = ON_PAPER) -> None:
        self.width_px, self.height_px, self.look = width_px, height_px, look
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

        No text turns the direction of what stands beside it, nor breaks the XML.
        """
        text = spelled_out(text)
        self._texts.append(text)
        place = {"x": x, "y": y, "font_size": size, "fill": colour or self.look.ink}
        place |= {"text_anchor": anchor} if anchor != "start" else {}
        written = _written(place | attributes)
        self._parts.append(f"<text{written}>{escape(text, quote=False)}</text>")

    def svg(self) -> str:
        """The whole SVG."""
        width, height = f"{self.width_px:g}", f"{self.height_px:g}"
        ground = f'<rect width="100%" height="100%" fill="{self.look.ground}"/>'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}" font-family="{_FAMILIES}, sans-serif">'
            f"{_HATCHES}{ground}{''.join(self._parts)}</svg>"
        )

    def picture(self, image_format: ImageFormat, caption: str, notes: Sequence[str]) -> Picture:
        """The picture as a file; of a PNG a note says which texts no font here can show."""
        svg = self.svg()
        if image_format == "svg":
            return Picture(svg.encode(), "image/svg+xml", caption, tuple(notes))
        return Picture(_png(svg), "image/png", caption, (*notes, *_missing_fonts(self._texts)))


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
    """A note with the first of the texts that have characters which no font here has."""
    foreign = {character for text in texts for character in text if _is_foreign(character)}
    boxed = _boxed(sorted(foreign)) if foreign else set[str]()
    named = [repr(text) for text in dict.fromkeys(texts) if boxed & set(text)]
    if not named:
        return ()
    more = [f"{len(named) - _SHOWN_TEXTS} more"] if len(named) > _SHOWN_TEXTS else []
    return (
        f"no font of this computer has all characters of {', '.join([*named[:3], *more])}: boxes "
        "stand for them (install a font that has them, or draw an .svg)",
    )


def _is_foreign(character: str) -> bool:
    return not character.isascii() and unicodedata.category(character) not in _UNSEEN


def _boxed(characters: Sequence[str]) -> set[str]:
    """Those that are drawn like a character that no font has."""
    from PIL import Image

    cells = Canvas(_CELL_PX, _CELL_PX * (len(characters) + 1))
    for row, character in enumerate([_NO_CHARACTER, *characters]):
        cells.text(4, _CELL_PX * (row + 0.8), character)
    drawn = Image.open(io.BytesIO(_png(cells.svg()))).convert("L")
    rows = [drawn.crop((0, y, _CELL_PX, y + _CELL_PX)).tobytes()
            for y in range(0, drawn.height, _CELL_PX)]  # fmt: skip
    return {each for each, row in zip(characters, rows[1:], strict=True) if row == rows[0]}


# Texts --------------------------------------------------------------------------------------------


def width_of(text: str, size: float = TEXT_PX) -> float:
    """About how wide a text becomes, in pixels; rather more than less."""
    return size * sum(_em(character) for character in text)


def _em(character: str) -> float:
    if unicodedata.category(character) in ("Mn", "Me", "Cf"):
        return 0.0
    if character in _NARROW:
        return 0.4
    if character in _BROAD or unicodedata.east_asian_width(character) in "WF":
        return 1.0
    return 0.72 if character.isupper() else 0.64


def short(name: str) -> str:
    """A name that fits a legend, in one line: of a long one the end, which tells more."""
    line = " ".join(spelled_out(name).split())
    return line if len(line) <= _LONGEST_NAME else f"…{line[1 - _LONGEST_NAME :]}"


def fitted(text: str, width_px: float, size: float = TEXT_PX) -> str:
    """A text in one line that is no wider: of a longer one the end."""
    line = " ".join(spelled_out(text).split())
    if width_of(line, size) <= width_px:
        return line
    while line and width_of(f"…{line}", size) > width_px:
        line = line[1:]
    return f"…{line}"


def wrapped(text: str, width_px: float, size: float = TEXT_PX, most: int = 4) -> list[str]:
    """A text in as many lines as it needs, at most so many; the last one keeps its end."""
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


@dataclass(frozen=True)
class Frame:
    """Axes in pixels, and the range of values on each."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def right(self) -> float:
        """In pixels."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """In pixels."""
        return self.top + self.height

    def px(self, x: Any) -> Any:
        """A value, or an array of values, of the horizontal axis in pixels."""
        low, high = self.x
        return self.left + self.width * ((x - low) / (high - low))

    def py(self, y: Any) -> Any:
        """The same of the vertical axis."""
        low, high = self.y
        return self.bottom - self.height * ((y - low) / (high - low))


def axis_range(low: float, high: float, margin: float = 0.08) -> tuple[float, float]:
    """The range of an axis for such values: what is constant but for rounding is a flat line."""
    largest = max(abs(low), abs(high))
    middle = low / 2 + high / 2
    if high - low <= _LEAST_SPAN * largest:
        half = _FLAT * largest or 1.0
        return middle - half, middle + half
    half = (0.5 + margin) * (high - low)
    return middle - half, middle + half


def ticks(low: float, high: float, most: float) -> list[tuple[float, str]]:
    """Round values between two others, at most so many, with their labels."""
    least = (high - low) / max(most, 1.0)
    unit = 10.0 ** math.floor(math.log10(least))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [step * count for count in range(first, last + 1)]
    return [(value, _label(value, step, max(abs(low), abs(high)))) for value in values]


def _label(value: float, step: float, largest: float) -> str:
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if largest < 1e6 and decimals <= 5:
        return f"{value:.{decimals}f}" if value else "0"
    digits = max(1, math.ceil(math.log10(largest / step) + 1e-9) + 1)
    return f"{value:.{digits}g}" if value else "0"
