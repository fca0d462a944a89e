"""The pictures of a run: as many as have room, downscaled, inside the page."""

from __future__ import annotations

import io
import sqlite3
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.plugins.report.words import time_at
from webots_mcp.store.detection.events import search_events
from webots_mcp.store.detection.kinds import Event, EventOptions
from webots_mcp.store.reading.ranges import TimeRange
from webots_mcp.store.run_rows import inside, opened

MOST_PICTURES: Final = 24  # of a run
LONGEST_SIDE_PX: Final = 640
_SMALL_BYTES: Final = 60_000  # such a file goes in as it is
_JPEG_QUALITY: Final = 82
_AROUND_BYTES: Final = 400  # of marks around a picture


class Picture(NamedTuple):
    """A picture in the page: its data URI, and what it shows."""

    uri: str
    caption: str

    @property
    def size_bytes(self) -> int:
        """What it takes in the page."""
        return len(self.uri) + _AROUND_BYTES


class Pictures(NamedTuple):
    """Those that are shown, of how many, and how many of their files could not be used."""

    shown: Sequence[Picture]
    total: int
    unusable: int


def pictures_of(
    connection: sqlite3.Connection, whole: TimeRange, data_dir: Path, room_bytes: float
) -> Pictures:
    """Pictures that are spread evenly over the run, the first and the newest among them."""
    found = search_events(
        connection, whole, EventOptions(kinds=("image",)), around=(), group=False
    ).events
    tried = [_picture(event, data_dir) for event in spread(found, MOST_PICTURES)]
    made = [picture for picture in tried if picture is not None]
    return Pictures(_within(made, room_bytes), len(found), len(tried) - len(made))


def spread(items: Sequence[Event], most: int) -> list[Event]:
    """At most so many of the items, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return list(items)
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


def _within(pictures: Sequence[Picture], room_bytes: float) -> list[Picture]:
    """All of them, else every second, every third and so on, until they have room."""
    for step in range(1, len(pictures) + 1):
        kept = list(pictures[::step])
        if sum(picture.size_bytes for picture in kept) <= room_bytes:
            return kept
    return []


def _picture(event: Event, data_dir: Path) -> Picture | None:
    """None where the file is gone, or holds no picture."""
    try:
        media_type, data = _content(inside(data_dir, str(event.details["path"])))
    except (InvalidInputError, NothingRecordedError):
        return None
    kind = "" if event.details["kind"] == "camera" else f", {event.details['kind']}"
    caption = f"{time_at(event.start_s)} s, {event.name or 'main view'}{kind}"
    return Picture(f"data:{media_type};base64,{b64encode(data).decode()}", caption)


def _content(file: Path) -> tuple[str, bytes]:
    """Media type and content of a picture within 640 pixels."""
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
