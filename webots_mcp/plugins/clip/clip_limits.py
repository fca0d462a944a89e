"""What can be asked of a clip, and its limits: what its tool is declared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

ClipView = Literal["camera", "map"]
ClipFormat = Literal["webp", "gif"]


@dataclass(frozen=True)
class ClipLimits:
    """How large a clip is, and what it may cost.

    Attributes:
        longest_s: Simulated seconds before a moment, and after it.
        max_bytes: Maximum size of the file.
        processor_share: Processor time of painting and encoding frames per simulated second;
            `least_processor_s` for any clip.
        frames: Maximum number of frames; `frames_per_s` of the animation.
        smooth_s: Time that a frame is shown from which on a note says how to get a smoother one.
        width_px: Width of a frame, and `sheet_px` of the contact sheet.
        sheet_frames: Maximum number of frames on the sheet.
        jpeg_quality: Quality of a sheet with camera frames, from 1 to 100.
        film_px: Width of a film of camera frames alone, which has `film_least` frames at least;
            `film_processor_s` is what it may cost.
    """

    longest_s: float = 120.0
    max_bytes: int = 3_000_000
    processor_share: float = 0.75
    least_processor_s: float = 3.0
    frames: int = 100
    frames_per_s: float = 10.0
    smooth_s: float = 0.5
    width_px: int = 480
    sheet_px: int = 1000
    sheet_frames: int = 16
    jpeg_quality: int = 88
    film_px: int = 320
    film_least: int = 3
    film_processor_s: float = 0.5


@dataclass(frozen=True)
class ContentLimits:
    """Limits of what a clip shows.

    Attributes:
        signals: Curves below the picture.
        frames: Camera frames that are looked at, of all cameras.
        points: Points of a curve.
        wrong_heading_rad: Median difference from the direction of motion from which on a recorded
            heading is not on the map's axes, and the direction of motion is shown instead.
        moving_share: A step counts as motion if it is longer than this share of the longest step.
        deadline_s: Time limit of reading curves, and of reading the path.
    """

    signals: int = 3
    frames: int = 2_000
    points: int = 200
    wrong_heading_rad: float = 0.5
    moving_share: float = 0.1
    deadline_s: float = 2.0


CLIP_LIMITS: Final = ClipLimits()
CONTENT_LIMITS: Final = ContentLimits()
