"""Near misses: the names that somebody who wrote another one probably meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher
from typing import Final

_LONGEST: Final = 100  # characters that are compared


def nearest_first(name: str, known: Iterable[str]) -> list[str]:
    """The known names, those most like the given one first; equally like ones keep their order.

    Alike is who has the same letters, whatever their case, as a whole or in the last part of a
    dotted name: `front` is near `sensors.front`.
    """
    meant = name[:_LONGEST].lower()
    return sorted(known, key=lambda each: -_likeness(meant, each[:_LONGEST].lower()))


def _likeness(name: str, other: str) -> float:
    """From 0 (no letter in common) to 1 (the same)."""
    parts = {(name, other), (name, other.rpartition(".")[2]), (name.rpartition(".")[2], other)}
    likeness = max(SequenceMatcher(None, *pair).ratio() for pair in parts)
    return max(likeness, 0.8) if name and name in other else likeness
