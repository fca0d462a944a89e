"""Recorded pictures as a model can look at them: small enough, in a format that clients show."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

from mcp.server.mcpserver import Image

from webots_mcp.store.images import opened

LONGEST_SIDE_PX: Final = 1000
MAX_SENT_BYTES: Final = 4_000_000  # more than such a picture has pixels: something else is in it
_JPEG_QUALITY: Final = 85


def load_picture(file: Path) -> tuple[Image, str]:
    """A picture within 1,000 pixels, and a note where it had to be scaled (else empty).

    Raises:
        InvalidInputError: The file holds no complete picture, or is too large.
    """
    with opened(file) as picture:
        picture.load()
        short = max(picture.size) <= LONGEST_SIDE_PX
        if short and picture.format and file.stat().st_size <= MAX_SENT_BYTES:
            return Image(data=file.read_bytes(), format=picture.format.lower()), ""
        scaled = picture.convert("RGB")
        scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
        jpeg = io.BytesIO()
        scaled.save(jpeg, "JPEG", quality=_JPEG_QUALITY)
    (width, height), (true_width, true_height) = scaled.size, picture.size
    note = f"shown at {width} x {height} of {true_width} x {true_height} pixels"
    return Image(data=jpeg.getvalue(), format="jpeg"), note
