"""Columns of situations: noise, angles, and texts that change with time."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Random = np.random.Generator
TURN: Final = math.tau


def noise(random: Random, like: Array, deviation: float) -> Array:
    """Return normal noise for each row."""
    return random.normal(0, deviation, len(like))


def wrapped(angle: Array) -> Array:
    """Return an angle between -pi and pi."""
    return np.remainder(angle + math.pi, TURN) - math.pi


def chosen(*choices: tuple[Any, str], otherwise: str) -> list[str]:
    """Return for each row the text of the first flag that holds."""
    flags, texts = [flag for flag, _ in choices], [text for _, text in choices]
    return np.select(flags, texts, otherwise).tolist()
