"""Derive the meaning of signals from their values, if nothing else states it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from webots_mcp.signals.meaning import Meaning, meaning_by_behaviour
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal


@dataclass(frozen=True)
class BehaviourSample:
    """The rows of a run that show the behaviour of a signal.

    Attributes:
        parts: Number of parts of a run.
        rows: Rows of each part.
    """

    parts: int = 4
    rows: int = 512


_SAMPLE: Final = BehaviourSample()


def with_behaviour(
    meanings: Mapping[str, Meaning], known: Mapping[str, RegisteredSignal], frame: Frame
) -> dict[str, Meaning]:
    """Return the meanings, completed by the behaviour of each number of unknown meaning.

    Args:
        meanings: The meanings as declared, known from devices or named.
        known: The signals.
        frame: The rows of a run.
    """
    found = dict(meanings)
    for name in _unknown(meanings, known):
        zones = frame.zone_map(name)
        if not zones.value_count.any():
            continue
        found[name] = _told_by(frame, name)
    return found


def _unknown(
    meanings: Mapping[str, Meaning], known: Mapping[str, RegisteredSignal]
) -> Iterable[str]:
    return (
        name
        for name, each in meanings.items()
        if each.quantity is None and each.source == "unknown"
        if known[name].is_number and known[name].reduction is None
    )


def _told_by(frame: Frame, name: str) -> Meaning:
    """Return the meaning that parts of the run show.

    Theirs if they agree, else that of all values.
    """
    starts = range(0, len(frame), max(_SAMPLE.rows, -(-len(frame) // _SAMPLE.parts)))
    parts = [frame.rows(start, start + _SAMPLE.rows).usable(name)[1].tolist() for start in starts]
    reported = [meaning_by_behaviour(part) for part in parts if part]
    kinds = {each.why for each in reported}
    if len(kinds) == 1:
        return reported[0]
    joined = meaning_by_behaviour([value for part in parts for value in part])
    angles = [each for each in reported if each.quantity == "heading"]
    return angles[0] if angles and joined.quantity in (None, "heading") else joined
