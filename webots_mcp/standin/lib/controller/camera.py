"""The camera."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from pathlib import Path

from .arguments import integer, number, text
from .device import Sensor


class Camera(Sensor):
    """Takes pictures: four bytes a pixel in the order blue, green, red, alpha."""

    _c_name = "camera"

    def __init__(self, name: int | str, sampling_period: int | None = None) -> None:
        super().__init__(name, sampling_period)
        self._fov: float = self._description.get("fov", 0.0)

    def getImage(self) -> bytes:
        """The last picture, rows from the top left.

        Raises:
            ValueError: The camera is disabled or has not taken a picture yet.
        """
        picture = self._value(None, "get_image") and self._session.fetch(self._tag)
        if picture is None or not self.getSamplingPeriod():
            raise ValueError("NULL pointer access")
        return picture

    @property
    def image(self) -> bytes:
        """The last picture; see `getImage`."""
        return self.getImage()

    def getImageArray(self) -> list[list[list[int]]]:
        """Red, green and blue by pixel, cut as Webots cuts it: `width` lists of `height` pixels."""
        image, width, height = self.getImage(), self.getWidth(), self.getHeight()
        pixels = [[image[i + 2], image[i + 1], image[i]] for i in range(0, len(image), 4)]
        return [pixels[x * height : (x + 1) * height] for x in range(width)]

    @staticmethod
    def imageGetRed(image: bytes, width: int, x: int, y: int) -> int:
        """Red of one pixel, 0 to 255."""
        return image[4 * (y * width + x) + 2]

    @staticmethod
    def imageGetGreen(image: bytes, width: int, x: int, y: int) -> int:
        """Green of one pixel, 0 to 255."""
        return image[4 * (y * width + x) + 1]

    @staticmethod
    def imageGetBlue(image: bytes, width: int, x: int, y: int) -> int:
        """Blue of one pixel, 0 to 255."""
        return image[4 * (y * width + x)]

    @staticmethod
    def imageGetGray(image: bytes, width: int, x: int, y: int) -> float:
        """The mean of the three colors of one pixel."""
        start = 4 * (y * width + x)
        return sum(image[start : start + 3]) / 3.0

    def getWidth(self) -> int:
        """Pixels in a row."""
        with self._session.lock:
            return self._description["width"]

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return self.getWidth()

    def getHeight(self) -> int:
        """Rows."""
        with self._session.lock:
            return self._description["height"]

    @property
    def height(self) -> int:
        """Rows."""
        return self.getHeight()

    def getNear(self) -> float:
        """The `near` field, metres."""
        return self._description["near"]

    def getFov(self) -> float:
        """Horizontal field of view in radians."""
        return self._fov

    def setFov(self, fov: float) -> None:
        """Zooms: sets the horizontal field of view, in radians."""
        self._fov = number(fov)
        self._session.change(self._tag, "fov", self._fov)

    @property
    def fov(self) -> float:
        """Horizontal field of view in radians."""
        return self.getFov()

    @fov.setter
    def fov(self, fov: float) -> None:
        self.setFov(fov)

    def saveImage(self, filename: str, quality: int) -> int:
        """Write the last picture to a .png or .jpg file: 0, or -1 if that fails."""
        path, quality = Path(text(filename)), integer(quality)
        if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            return -1
        from PIL import Image

        size, image = (self.getWidth(), self.getHeight()), self.getImage()
        try:
            Image.frombytes("RGBA", size, image, "raw", "BGRA").convert("RGB").save(
                path, quality=quality
            )
        except OSError:
            return -1
        return 0
