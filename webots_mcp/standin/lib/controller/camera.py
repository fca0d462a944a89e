"""The camera."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from math import tan
from pathlib import Path

from .arguments import integer, number, text
from .console import say
from .device import Sensor
from .lacking import lacks


@lacks(
    "disableRecognitionSegmentation enableRecognitionSegmentation exposure focal_distance "
    "getExposure getFocalDistance getMaxFocalDistance getMinFocalDistance "
    "getRecognitionNumberOfObjects getRecognitionObjects getRecognitionSamplingPeriod "
    "getRecognitionSegmentationImage getRecognitionSegmentationImageArray "
    "hasRecognitionSegmentation isRecognitionSegmentationEnabled max_focal_distance "
    "min_focal_distance recognitionDisable recognitionEnable saveRecognitionSegmentationImage "
    "segmentation_image setExposure setFocalDistance"
)
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

    @property
    def near(self) -> float:
        """The `near` field, metres."""
        return self.getNear()

    def getFov(self) -> float:
        """Horizontal field of view in radians."""
        return self._fov

    def setFov(self, f: float) -> None:
        """Zoom: set the horizontal field of view, in radians; needs a Zoom node."""
        low, high = self.getMinFov(), self.getMaxFov()
        if not low <= number(f) <= high:
            self._complain("set_fov", f" out of zoom range [{low:f}, {high:f}].")
            return
        self._fov = number(f)
        self._session.change(self._tag, "fov", self._fov)

    @property
    def fov(self) -> float:
        """Horizontal field of view in radians."""
        return self.getFov()

    @fov.setter
    def fov(self, f: float) -> None:
        self.setFov(f)

    def getMinFov(self) -> float:
        """The narrowest field of view, radians: that of the Zoom node, or the only one."""
        return self._description["min_fov"]

    @property
    def min_fov(self) -> float:
        """The narrowest field of view, radians: that of the Zoom node, or the only one."""
        return self.getMinFov()

    def getMaxFov(self) -> float:
        """The widest field of view, radians: that of the Zoom node, or the only one."""
        return self._description["max_fov"]

    @property
    def max_fov(self) -> float:
        """The widest field of view, radians: that of the Zoom node, or the only one."""
        return self.getMaxFov()

    def getFocalLength(self) -> float:
        """The focal length in pixels."""
        return self.getWidth() / 2.0 / tan(self._fov / 2.0)

    @property
    def focal_length(self) -> float:
        """The focal length in pixels."""
        return self.getFocalLength()

    def hasRecognition(self) -> bool:
        """False: cameras of the stand-in recognize nothing."""
        return False

    def saveImage(self, filename: str, quality: int) -> int:
        """Write the last picture to a .png or .jpg file: 0, or -1 if that fails."""
        path, quality = Path(text(filename)), integer(quality, position=3)
        if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            return -1
        from PIL import Image

        size, image = (self.getWidth(), self.getHeight()), self.getImage()
        try:
            Image.frombytes("RGBA", size, image, "raw", "BGRA").convert("RGB").save(
                path, quality=quality
            )
        except OSError:
            say(f"Insufficient permissions to write file: {filename}")
            return -1
        return 0
