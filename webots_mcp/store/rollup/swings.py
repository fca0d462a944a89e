"""Swings of what a robot swings with: found where 500 s are over, and stored with their rollups.

They show in all rows of a signal only, for which a question about hours has no time.
"""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import astuple
from typing import Final

from webots_mcp.naming import in_snake_case
from webots_mcp.store.analysis.features import unwrap
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS, Swing, find_swings, joined_swings
from webots_mcp.store.reading.ranges import Segment
from webots_mcp.store.reading.rows import Columns, Numbers, numbers_of
from webots_mcp.store.rollup.buckets import COARSE_BUCKETS, stored_texts
from webots_mcp.store.signals.registry import Signal

LONGEST_PERIOD_S: Final = 5.0
ACROSS_S: Final = 20.0  # of the stretch next to it: longer than six half swings of that period
STRETCH_ROWS: Final = 10_000  # that are searched at once
MOST_SIGNALS: Final = 20  # of which swings are stored

# Sensors swing by nature while a robot drives.
_SWINGING: Final = re.compile(
    r"(^|[._])(heading|yaw|roll|pitch|theta|bearing|steer\w*|wheels?|motors?|speed|velocity|pose|pos"
    r"|position|odom|odometry|left|right|cmd|command\w*|error)([._]|$)",
    re.IGNORECASE,
)


def may_swing(signal: Signal) -> bool:
    """Whether it is named like something that a robot swings with."""
    return signal.is_number and _SWINGING.search(in_snake_case(signal.name)) is not None


def swings_in(numbers: Numbers, signal: Signal, half_swings: int, period_s: float) -> list[Swing]:
    """The swings of a signal in rows one after the other, of so many half swings at least."""
    times, values = numbers.of(signal.name)
    values = unwrap(values, signal.turn) if signal.turn else values
    return find_swings(times, values, least_half_swings=half_swings, longest_period_s=period_s)


class SwingsToStore:
    """Collects the swings of a coarse bucket, stretch by stretch."""

    def __init__(self, signals: Iterable[Signal]) -> None:
        self.signals = [signal for signal in signals if may_swing(signal)][:MOST_SIGNALS]
        self._found: dict[str, list[Swing]] = {signal.name: [] for signal in self.signals}

    def add(self, columns: Columns) -> None:
        """Look in some rows one after the other."""
        numbers = numbers_of(columns, self.signals)
        for signal in self.signals:
            swings = swings_in(numbers, signal, LEAST_HALF_SWINGS, LONGEST_PERIOD_S)
            self._found[signal.name].extend(swings)

    def stored(self) -> dict[int, str]:
        """What is stored, by the ids of the signals."""
        return {
            signal.id: json.dumps([astuple(swing) for swing in joined_swings(found)])
            for signal, found in zip(self.signals, self._found.values(), strict=True)
            if signal.id is not None
        }


def stored_swings(
    connection: sqlite3.Connection, segment: Segment, span: range, signals: Sequence[Signal]
) -> tuple[range, dict[str, list[Swing]]]:
    """The swings that are stored of signals, and of which coarse buckets all of them are.

    Args:
        connection: Any.
        segment: Of which run.
        span: Buckets of 10 s that lie inside of what is asked for.
        signals: Which; those that have to be searched are left out.
    """
    coarse = range(0)
    found: dict[str, list[Swing]] = {}
    for signal in signals:
        coarse, texts = stored_texts(connection, segment.run_id, span, signal.id, "swings")
        if coarse and None not in texts:
            found[signal.name] = [
                Swing(*each) for text in texts for each in json.loads(text or "[]")
            ]
    return range(coarse.start * COARSE_BUCKETS, coarse.stop * COARSE_BUCKETS), found
