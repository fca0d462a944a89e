"""Recorded pictures as a model can look at them: small enough, in a format that clients show."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from webots_mcp.questions.answers import ShownPicture
from webots_mcp.store.run_rows import opened

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

LONGEST_SIDE_PX: Final = 1000
MAX_SENT_BYTES: Final = 4_000_000  # more than such a picture has pixels: something else is in it
_JPEG_QUALITY: Final = 85
_GAP_PX: Final = 4


def load_sheet(files: Sequence[Path]) -> ShownPicture:
    """Pictures beside each other, from left to right and from top to bottom, as one.

    Raises:
        InvalidInputError: A file holds no complete picture, or is too large.
    """
    from PIL import Image as Pictures

    columns = math.ceil(math.sqrt(len(files)))
    side_px = LONGEST_SIDE_PX // columns - _GAP_PX
    parts = [_thumbnail(file, side_px) for file in files]
    width, height = (max(part.size[i] for part in parts) + _GAP_PX for i in (0, 1))
    sheet = Pictures.new("RGB", (columns * width, math.ceil(len(parts) / columns) * height))
    for number, part in enumerate(parts):
        sheet.paste(part, (number % columns * width, number // columns * height))
    png = io.BytesIO()
    sheet.save(png, "PNG")
    return ShownPicture(data=png.getvalue(), format="png")


def _thumbnail(file: Path, side_px: int) -> Picture:
    with opened(file) as picture:
        scaled = picture.convert("RGB")
    scaled.thumbnail((side_px, side_px))
    return scaled


def load_picture(file: Path) -> tuple[ShownPicture, str]:
    """A picture within 1,000 pixels, and a note where it had to be scaled (else empty).

    Raises:
        InvalidInputError: The file holds no complete picture, or is too large.
    """
    with opened(file) as picture:
        picture.load()
        short = max(picture.size) <= LONGEST_SIDE_PX
        if short and picture.format and file.stat().st_size <= MAX_SENT_BYTES:
            return ShownPicture(data=file.read_bytes(), format=picture.format.lower()), ""
        scaled = picture.convert("RGB")
        scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
        jpeg = io.BytesIO()
        scaled.save(jpeg, "JPEG", quality=_JPEG_QUALITY)
    (width, height), (true_width, true_height) = scaled.size, picture.size
    note = f"shown at {width} x {height} of {true_width} x {true_height} pixels"
    return ShownPicture(data=jpeg.getvalue(), format="jpeg"), note
