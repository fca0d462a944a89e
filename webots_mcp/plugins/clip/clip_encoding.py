"""Encoding a clip as WebP or GIF within a size and within processor time."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.plugins.clip.clip_limits import ClipFormat

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class EncodingLimits:
    """How a clip is encoded.

    Attributes:
        webp_quality: Quality of WebP, from 1 to 100; `webp_effort` is its `method`, from 0 to 6.
        gif_colours: Colours of each frame of a GIF.
        sample: Frames that are encoded first, to learn how long and how large the whole will be.
        smallest: Share of the width below which frames are left out rather than scaled down more.
        fewest: Frames that are never left out.
        rounds: Attempts at most.
        margin: Share of the size that an estimate aims at.
    """

    webp_quality: int = 72
    webp_effort: int = 2
    gif_colours: int = 96
    sample: int = 5
    smallest: float = 0.5
    fewest: int = 8
    rounds: int = 5
    margin: float = 0.85


_LIMITS: Final = EncodingLimits()


@dataclass(frozen=True)
class EncodedClip:
    """An encoded clip: its file, size in pixels, and the times of the frames that are in it."""

    data: bytes
    width: int
    height: int
    times: Sequence[float]


def encode_clip(
    paint: Callable[[Sequence[float]], Iterable[Image]],
    times: Sequence[float],
    *,
    speed: float,
    image_format: ClipFormat,
    max_bytes: int,
    processor_s: float,
) -> EncodedClip:
    """Encode frames as an animation that repeats, and that is no larger than asked for.

    What is too large is scaled down to half of its width, then has fewer frames. Of a clip that
    would take too long frames are left out.

    Args:
        paint: Paints the frames of some times.
        times: Simulation times of the frames, rising.
        speed: Simulated seconds per second of the animation.
        image_format: Of the file.
        max_bytes: Maximum size of the file.
        processor_s: Processor time that painting and encoding may take, about.
    """
    size = next(iter(paint(times[:1]))).size  # with what is painted only once
    sampled_s = time.thread_time()
    trial = _every(times, _LIMITS.sample)
    data = _encoded(list(paint(trial)), [100] * len(trial), image_format)
    now_s = time.thread_time()
    each_s = max(1e-4, (now_s - sampled_s) / len(trial))
    each_bytes = len(data) / len(trial)
    most = max(_LIMITS.fewest, int((processor_s - (now_s - sampled_s)) / each_s))
    kept, scale = _every(times, most), 1.0
    estimate = each_bytes * len(kept)
    for _ in range(_LIMITS.rounds):
        aim = _LIMITS.margin * max_bytes
        if estimate > max_bytes:
            wanted = math.sqrt(aim / estimate)  # bytes grow about with the number of pixels
            if scale * wanted < _LIMITS.smallest:
                missing = (scale * wanted / _LIMITS.smallest) ** 2
                kept = _every(kept, max(_LIMITS.fewest, int(missing * len(kept))))
                scale = _LIMITS.smallest
            else:
                scale *= wanted
        made = (_scaled(each, scale) for each in paint(kept))
        data = _encoded(list(made), _durations_ms(kept, speed), image_format)
        if len(data) <= max_bytes:
            break
        estimate = float(len(data))
    width, height = (max(1, round(side * scale)) for side in size)
    return EncodedClip(data, width, height, kept)


def _every(times: Sequence[float], most: int) -> list[float]:
    """Return at most that many of the times, evenly spread, with the first and the last."""
    if len(times) <= most:
        return list(times)
    last = len(times) - 1
    return [times[round(i * last / (most - 1))] for i in range(most)]


def _scaled(image: Image, scale: float) -> Image:
    from PIL import Image as Pictures

    if scale == 1.0:
        return image
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Pictures.Resampling.LANCZOS)


def _durations_ms(times: Sequence[float], speed: float) -> list[int]:
    """Return how long each frame is shown; the last one stays for a second.

    Rounding does not add up. Browsers show a frame of less than 20 ms for longer.
    """
    ends = [1000 * (each - times[0]) / speed for each in times]
    shown = [max(20, round(b) - round(a)) for a, b in pairwise(ends)]
    return [*shown, 1000]


def _encoded(frames: Sequence[Image], durations_ms: Sequence[int], form: ClipFormat) -> bytes:
    from PIL.Image import Dither

    file = io.BytesIO()
    options: dict[str, Any] = {"save_all": True, "duration": list(durations_ms), "loop": 0}
    if form == "gif":
        frames = [
            each.quantize(_LIMITS.gif_colours, method=2, dither=Dither.NONE) for each in frames
        ]
        frames[0].save(file, "GIF", append_images=frames[1:], **options)
    else:
        frames[0].save(
            file, "WEBP", append_images=frames[1:], quality=_LIMITS.webp_quality,
            method=_LIMITS.webp_effort, **options,
        )  # fmt: skip
    return file.getvalue()
