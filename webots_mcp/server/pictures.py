"""Recorded pictures as a model can look at them: small enough, in a format that clients show."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

from mcp.server.mcpserver import Image

from webots_mcp.errors import NothingRecordedError

LONGEST_SIDE_PX: Final = 1000
_JPEG_QUALITY: Final = 85


def load_picture(file: Path) -> tuple[Image, str]:
    """A picture within 1,000 pixels, and a note where it had to be scaled (else empty).

    Pillow is imported here, at the first picture: it would add to the server's start.

    Raises:
        NothingRecordedError: The file is gone or holds no complete picture.
    """
    from PIL import Image as Pictures
    from PIL import UnidentifiedImageError

    try:
        data = file.read_bytes()
        picture = Pictures.open(io.BytesIO(data))
        picture.load()
    except (OSError, UnidentifiedImageError, Pictures.DecompressionBombError) as error:
        raise NothingRecordedError(f"{file} cannot be shown as a picture: {error}") from error
    if max(picture.size) <= LONGEST_SIDE_PX and picture.format in ("PNG", "JPEG"):
        return Image(data=data, format=picture.format.lower()), ""
    scaled = picture.convert("RGB")
    scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
    jpeg = io.BytesIO()
    scaled.save(jpeg, "JPEG", quality=_JPEG_QUALITY)
    (width, height), (true_width, true_height) = scaled.size, picture.size
    note = f"shown at {width} x {height} of {true_width} x {true_height} pixels"
    return Image(data=jpeg.getvalue(), format="jpeg"), note
