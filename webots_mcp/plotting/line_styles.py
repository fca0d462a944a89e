"""The colour and the dashes of each line in a picture: of a curve, or of the path of a run."""

from __future__ import annotations

from typing import Final, NamedTuple

from webots_mcp.plotting.colours import LINES, Theme

# Lengths of dashes and gaps in pixels. Their number and that of the colours have no common factor
# but 1, so that 28 lines differ.
DASHES: Final = ("none", "6 2", "2 1.6", "6 2 2 2")


class LineStyle(NamedTuple):
    """How a line is drawn.

    Attributes:
        dash: The value of `stroke-dasharray` in SVG; "none" for a solid line.
    """

    colour: str
    dash: str


def line_style(index: int, theme: Theme) -> LineStyle:
    """Return the style of the line with that index among the lines of a picture.

    Black takes the colour of the theme's text, which is light on a dark page.
    """
    colour = LINES[index % len(LINES)]
    return LineStyle(theme.ink if colour == "#000000" else colour, DASHES[index % len(DASHES)])
