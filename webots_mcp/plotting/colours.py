"""Colours that people with any kind of colour vision can tell apart.

Lines and marks: M. Okabe, K. Ito, "Color Universal Design" (2008), without the yellow, which is
too light for a line on white. Areas: P. Tol, "Colour Schemes", SRON/EPS/TN/09-002 (2021), the
scheme "light", made for the background of labels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple
from zlib import crc32

LINES: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
EVENT_COLOURS: Final = (*LINES[1:-1], LINES[0])  # one kind after the other
AREAS: Final = (
    "#77AADD", "#EE8866", "#44BB99", "#EEDD88", "#FFAABB", "#AAAA00", "#99DDFF", "#BBCC33",
)  # fmt: skip
_FIRST_CHOICE: Final = 4  # of the areas; the others are each close to one of these
OTHER_VALUES: Final = "others"  # the name that values share of which there are too many
FAINT: Final = "#767676"  # the lightest grey that is readable as text on white
INK: Final = "#333333"  # on areas, whatever the ground of the picture is
# Scales whose lightness grows evenly, at equal distances: matplotlib's viridis and cividis, which
# are in the public domain.
SCALES: Final = {
    "time": (
        "#440154", "#472D7B", "#3B528B", "#2C728E", "#21918C", "#28AE80", "#5EC962", "#ADDC30",
        "#FDE725",
    ),
    "score": (
        "#00224E", "#123570", "#3B496C", "#575D6D", "#707173", "#8A8678", "#A59C74", "#C3B369",
        "#FEE838",
    ),
}  # fmt: skip
MOST_VALUES: Final = 2 * len(AREAS)


class Area(NamedTuple):
    """How an area, or a segment of a path, is filled."""

    colour: str
    dotted: bool


MERGED: Final = Area("#DDDDDD", dotted=False)


def area_styles(values: Iterable[str]) -> dict[str, Area]:
    """Return a style for each value: eight colours, the same with dots, then grey.

    The colour hangs on the value's own text, so that "cruise" has one colour in every picture,
    unless another value in the same one has taken it.
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
    """Return the colour at a share, from 0 to 1, of a scale."""
    stops = SCALES[scale]
    place = min(max(share, 0.0), 1.0) * (len(stops) - 1)
    index = min(int(place), len(stops) - 2)
    low, high = (bytes.fromhex(stops[index + i][1:]) for i in (0, 1))
    mixed = (round(a + (place - index) * (b - a)) for a, b in zip(low, high, strict=True))
    return "#" + bytes(mixed).hex().upper()


@dataclass(frozen=True)
class Theme:
    """The colours of what surrounds the data, as CSS; in a page they follow its style."""

    ink: str = INK
    faint: str = FAINT
    grid: str = "#E3E3E3"
    ground: str = "#FFFFFF"


ON_PAPER: Final = Theme()
ON_A_PAGE: Final = Theme("var(--ink)", "var(--faint)", "var(--grid)", "var(--ground)")
