"""How a clip and its contact sheet are made from the recording."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.clip.clip_content import ClipContent, content_of, frames_of_a_camera
from webots_mcp.plugins.clip.clip_encoding import EncodedClip, encode_clip
from webots_mcp.plugins.clip.clip_limits import CLIP_LIMITS as LIMITS
from webots_mcp.plugins.clip.clip_limits import ClipFormat, ClipView
from webots_mcp.plugins.clip.clip_painting import ClipPainter
from webots_mcp.plugins.clip.moment import Moment
from webots_mcp.store.reading.segment import in_one_snapshot

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class Clip:
    """A finished clip.

    Attributes:
        data: The animation; `format` of it.
        sheet: The contact sheet; `sheet_format` of it.
        frame_times: Simulation times of the frames of the animation.
        sheet_times: Simulation times of the frames on the sheet, by their numbers from 1 on.
        notes: What is not in it, or what its viewer should know.
    """

    content: ClipContent
    data: bytes
    format: ClipFormat
    width: int
    height: int
    frame_times: Sequence[float]
    sheet: bytes
    sheet_format: str
    sheet_times: Sequence[float]
    notes: Sequence[str]

    @property
    def signals(self) -> list[str]:
        """The signals whose curves are drawn."""
        axes = self.content.signals
        return [name for panel in axes.panels for name in panel.names] if axes else []


@in_one_snapshot
def make_clip(
    connection: sqlite3.Connection,
    data_dir: Path,
    moment: Moment,
    *,
    before_s: float = 3.0,
    after_s: float = 2.0,
    signals: Sequence[str] = (),
    camera: str = "",
    view: ClipView | None = None,
    speed: float = 1.0,
    image_format: ClipFormat = "webp",
) -> Clip:
    """Make a clip of the seconds around a moment, and its contact sheet.

    Args:
        connection: Connection to the recording.
        data_dir: Folder of the pictures.
        moment: What it is about.
        before_s: Simulated seconds before the moment.
        after_s: Simulated seconds after it.
        signals: Curves to draw, at most three; empty for those that changed most.
        camera: Name of the camera; empty for the one with most frames in the range.
        view: "camera" or "map" above the curves; None for the camera where it has frames.
        speed: Simulated seconds per second of the animation.
        image_format: "webp" or "gif".

    Raises:
        InvalidInputError: A time is out of bounds; there is no such camera, or no map.
        NothingRecordedError: Nothing of the range can be shown.
        UnknownSignalError: A name matches no signal.
    """
    for name, value in (("before_s", before_s), ("after_s", after_s)):
        if not 0 <= value <= LIMITS.longest_s:
            raise InvalidInputError(f"{name}={value:g} must be from 0 to {LIMITS.longest_s:g}.")
    content = content_of(
        connection, data_dir, moment, before_s, after_s, signals=signals, camera=camera, view=view
    )
    painter = ClipPainter(content, LIMITS.width_px)
    made = encode_clip(
        painter.frames,
        frame_times(content, speed),
        speed=speed,
        image_format=image_format,
        max_bytes=LIMITS.max_bytes,
        processor_s=max(LIMITS.least_processor_s, LIMITS.processor_share * content.length_s),
    )
    sheet_times = sheet_times_of(content)
    sheet, sheet_format = _as_file(content, painter.sheet(sheet_times, LIMITS.sheet_px))
    apart_s = content.length_s / max(1, len(made.times) - 1)
    notes = [*content.notes, *painter.notes]
    if apart_s / speed > LIMITS.smooth_s:
        notes.append(f"one frame every {apart_s:.2g} s: less time or a higher speed is smoother")
    return Clip(content, made.data, image_format, made.width, made.height, made.times, sheet,
                sheet_format, sheet_times, tuple(dict.fromkeys(notes)))  # fmt: skip


def camera_film(
    connection: sqlite3.Connection,
    data_dir: Path,
    run_id: int,
    span: tuple[float, float],
    at_s: float,
    max_bytes: int,
) -> tuple[EncodedClip, str] | None:
    """Return a small film of camera frames alone, with the clock, and the name of the camera.

    Args:
        connection: Connection to the recording.
        data_dir: Folder of the pictures.
        run_id: The run.
        span: Simulation times from which to which it goes.
        at_s: The moment that it is about.
        max_bytes: Maximum size of the film.

    Returns:
        None if no camera has enough frames there, or the film would be too large.
    """
    camera, files = frames_of_a_camera(connection, data_dir, run_id, span)
    if len(files) < LIMITS.film_least:
        return None
    start_s, end_s = (files[i][0].sim_time_s for i in (0, -1))
    content = ClipContent(
        Moment(run_id, at_s), "", start_s, end_s, camera, files, None, None, None, ()
    )
    made = encode_clip(
        ClipPainter(content, LIMITS.film_px).frames,
        [each.sim_time_s for each, _ in files],
        speed=1.0,
        image_format="webp",
        max_bytes=max_bytes,
        processor_s=LIMITS.film_processor_s,
    )
    return (made, camera) if len(made.data) <= max_bytes else None


def frame_times(content: ClipContent, speed: float = 1.0) -> list[float]:
    """Return the times of the frames: ten per second of the animation, the moment among them."""
    steps = max(1, min(LIMITS.frames - 1, round(content.length_s * LIMITS.frames_per_s / speed)))
    step_s = content.length_s / steps
    if step_s <= 0:
        return [content.start_s]
    times = [content.start_s + step_s * number for number in range(steps)] + [content.end_s]
    nearest = min(range(len(times)), key=lambda i: abs(times[i] - content.moment.at_s))
    times[nearest] = min(max(content.moment.at_s, content.start_s), content.end_s)
    return times


def sheet_times_of(content: ClipContent) -> list[float]:
    """Return the times of the frames on the sheet: of pictures, else evenly spread.

    The one nearest to the moment is among them.
    """
    if content.files:
        times = [each.sim_time_s for each, _ in content.files]
    else:
        steps = LIMITS.sheet_frames - 5
        times = [content.start_s + content.length_s * i / steps for i in range(steps + 1)]
    at_s = content.moment.at_s
    nearest = min(range(len(times)), key=lambda i: abs(times[i] - at_s))
    if not content.files:
        times[nearest] = at_s
    if len(times) <= LIMITS.sheet_frames:
        return list(dict.fromkeys(times))
    last = len(times) - 1
    chosen = [round(i * last / (LIMITS.sheet_frames - 1)) for i in range(LIMITS.sheet_frames)]
    closest = min(range(len(chosen)), key=lambda i: abs(chosen[i] - nearest))
    chosen[closest] = nearest
    return [times[i] for i in chosen]


def _as_file(content: ClipContent, sheet: Image) -> tuple[bytes, str]:
    """Return a sheet as JPEG where it shows camera frames, else as PNG."""
    from PIL import Image as Pictures

    file = io.BytesIO()
    if content.files:
        sheet.save(file, "JPEG", quality=LIMITS.jpeg_quality)
        return file.getvalue(), "jpeg"
    sheet.quantize(128, dither=Pictures.Dither.NONE).save(file, "PNG", optimize=True)
    return file.getvalue(), "png"
