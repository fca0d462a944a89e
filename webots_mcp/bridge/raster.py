"""Drawing into an image with the standard library alone: points, lines, circles, a few letters."""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Iterable
from typing import Final

_GLYPHS: Final = {  # three pixels wide, five rows from the top
    "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717",
    "6": "74757", "7": "71222", "8": "75757", "9": "75717", ".": "00002", "m": "00775",
    " ": "00000",
}  # fmt: skip
_DOT_PX: Final = 2  # of a letter
LETTER_PX: Final = 4 * _DOT_PX
TEXT_HEIGHT_PX: Final = 5 * _DOT_PX


def colour(red: int, green: int, blue: int) -> int:
    """A pixel in the order of a Webots image: the bytes blue, green, red, alpha."""
    return int.from_bytes(bytes((blue, green, red, 255)), sys.byteorder)


BLACK: Final = colour(0, 0, 0)
GREY: Final = colour(110, 110, 110)
WHITE: Final = colour(255, 255, 255)


class Canvas:
    """An image to draw into; drawing outside of it has no effect."""

    def __init__(self, width: int, height: int, background: int = BLACK) -> None:
        self.width = width
        self.height = height
        self._pixels = array("I", [background]) * (width * height)

    @property
    def bgra(self) -> bytes:
        """Four bytes a pixel, rows from the top left."""
        return self._pixels.tobytes()

    def fill(self, x: int, y: int, width: int, height: int, colour: int) -> None:
        """Fill a rectangle, given its upper left corner."""
        left, right = max(0, x), min(self.width, x + width)
        row = array("I", [colour]) * max(0, right - left)
        for line in range(max(0, y), min(self.height, y + height)):
            start = line * self.width
            self._pixels[start + left : start + left + len(row)] = row

    def row(self, y: int, pixels: Iterable[int]) -> None:
        """Set a row from its left end on."""
        given = array("I", pixels)[: self.width]
        self._pixels[y * self.width : y * self.width + len(given)] = given

    def circle(self, x: float, y: float, radius: float, colour: int) -> None:
        """Draw the outline of a circle."""
        count = max(8, int(8 * radius))
        for number in range(count):
            angle = 2 * math.pi * number / count
            at = x + radius * math.cos(angle), y + radius * math.sin(angle)
            self.fill(round(at[0]), round(at[1]), 1, 1, colour)

    def line(self, x: float, y: float, to_x: float, to_y: float, colour: int) -> None:
        """Draw a straight line."""
        count = max(1, math.ceil(max(abs(to_x - x), abs(to_y - y))))
        for number in range(count + 1):
            share = number / count
            at = x + share * (to_x - x), y + share * (to_y - y)
            self.fill(round(at[0]), round(at[1]), 1, 1, colour)

    def text(self, x: int, y: int, text: str, colour: int) -> None:
        """Write digits, dots and the letter m."""
        for place, letter in enumerate(text):
            for row, bits in enumerate(_GLYPHS[letter]):
                for column in range(3):
                    if int(bits) >> (2 - column) & 1:
                        dot = (x + place * LETTER_PX + column * _DOT_PX, y + row * _DOT_PX)
                        self.fill(*dot, _DOT_PX, _DOT_PX, colour)
