"""Draws pictures with the standard library alone: an image of pixels, rectangles and circles."""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Iterable
from typing import Final


def colour(red: int, green: int, blue: int) -> int:
    """Return a pixel in the order of a Webots image: the bytes blue, green, red, alpha."""
    return int.from_bytes(bytes((blue, green, red, 255)), sys.byteorder)


BLACK: Final = colour(0, 0, 0)
GREY: Final = colour(110, 110, 110)
WHITE: Final = colour(255, 255, 255)


class PixelCanvas:
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
