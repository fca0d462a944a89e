"""The pictures of a run inside a report: scaled down, and as many as fit into its size limit."""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.event import Event
from webots_mcp.plugins.report.words import (
    time_at,
)
from webots_mcp.store.run_rows import inside, opened

MOST_PICTURES: Final = 24  # Of a run.
LONGEST_SIDE_PX: Final = 640
_SMALL_BYTES: Final = 60_000  # Files up to this size are embedded unchanged.
_JPEG_QUALITY: Final = 82
_AROUND_BYTES: Final = 400  # Markup around a picture.


class EmbeddedPicture(NamedTuple):
    """A picture in a report: its data URI and its caption."""

    uri: str
    caption: str

    @property
    def size_bytes(self) -> int:
        """Return the bytes that it takes in the report."""
        return len(self.uri) + _AROUND_BYTES


class EmbeddedPictures(NamedTuple):
    """The pictures that are shown, the number of all, and of files that could not be used."""

    shown: Sequence[EmbeddedPicture]
    total: int
    unusable: int


def pictures_of(found: Sequence[Event], data_dir: Path, room_bytes: float) -> EmbeddedPictures:
    """Return pictures spread evenly over the run, with the first and the newest among them."""
    tried = [_picture(event, data_dir) for event in spread(found, MOST_PICTURES)]
    made = [picture for picture in tried if picture is not None]
    return EmbeddedPictures(_within(made, room_bytes), len(found), len(tried) - len(made))


def picture_near(
    found: Sequence[Event], data_dir: Path, at_s: float, within_s: float
) -> EmbeddedPicture | None:
    """Return the picture nearest to a moment; None if none was taken within some seconds of it."""
    near = [each for each in found if abs(each.start_s - at_s) <= within_s]
    for event in sorted(near, key=lambda each: abs(each.start_s - at_s)):
        if (picture := _picture(event, data_dir)) is not None:
            return picture
    return None


def spread(items: Sequence[Event], most: int) -> list[Event]:
    """Return at most `most` items, evenly spread, with the first and the last among them."""
    if len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


def _within(pictures: Sequence[EmbeddedPicture], room_bytes: float) -> list[EmbeddedPicture]:
    """Return all pictures, else every second, every third and so on, until they fit."""
    for step in range(1, len(pictures) + 1):
        kept = list(pictures[::step])
        if sum(picture.size_bytes for picture in kept) <= room_bytes:
            return kept
    return []


def _picture(event: Event, data_dir: Path) -> EmbeddedPicture | None:
    """Return the picture of an event; None if its file is missing or no picture."""
    try:
        media_type, data = _content(inside(data_dir, str(event.details["path"])))
    except (InvalidInputError, NothingRecordedError):
        return None
    kind = "" if event.details["kind"] == "camera" else f", {event.details['kind']}"
    caption = f"{time_at(event.start_s)} s, {event.name or 'main view'}{kind}"
    return EmbeddedPicture(f"data:{media_type};base64,{b64encode(data).decode()}", caption)


def _content(file: Path) -> tuple[str, bytes]:
    """Return media type and content of a picture, scaled down to 640 pixels."""
    with opened(file) as picture:
        picture.load()
        fits = max(picture.size) <= LONGEST_SIDE_PX and file.stat().st_size <= _SMALL_BYTES
        if fits and picture.format:
            return f"image/{picture.format.lower()}", file.read_bytes()
        scaled = picture.convert("RGB")
        scaled.thumbnail((LONGEST_SIDE_PX, LONGEST_SIDE_PX))
        buffer = io.BytesIO()
        scaled.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return "image/jpeg", buffer.getvalue()
