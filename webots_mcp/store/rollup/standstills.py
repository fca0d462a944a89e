"""Standstills: found where 500 s are over, and stored with the rollups of the position's x.

With each stands what its rows show, so that whether the robot should have moved can be weighed
without them.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Sequence
from typing import Any, Final

from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.evidence import Counts, Observed, Part
from webots_mcp.store.detection.motion import Motion, tracks_in
from webots_mcp.store.detection.standstills import (
    Nearest,
    Standing,
    StretchStandings,
    in_all,
    standings_of,
)
from webots_mcp.store.reading.rows import Columns
from webots_mcp.store.rollup.buckets import COARSE_BUCKETS, stored_texts

MOST_PARTS: Final = 2000  # of the standstills of 500 s; of more the rows are read
_ASKED: Final = ("mode", "commanded", "min_commanded", "stuck_m", "stuck_s")


class StandstillsToStore:
    """Collects the standstills of a coarse bucket, stretch by stretch."""

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._found: list[StretchStandings] = []
        self.signals = motion.evidence if motion.position else []

    def add(self, columns: Columns) -> None:
        """Look in some rows one after the other."""
        motion = self._motion
        tracks = tracks_in(columns, motion.position) if motion.position else []
        self._found.append(standings_of(columns, tracks, motion, EventOptions(), columns))

    def stored(self) -> dict[int, str]:
        """What is stored, by the id of the signal."""
        found, position = in_all(self._found), self._motion.position
        parts = sum(len(each.observed.parts) for each in found.standings)
        if position is None or position[0].id is None or parts > MOST_PARTS:
            return {}
        whole = {
            "signals": [signal.id for signal in self.signals],
            "seen_s": found.seen_s,
            "noise_m": found.noise_m,
            "nearest": found.nearest,
            "found": [_row(each) for each in found.standings],
        }
        return {position[0].id: json.dumps(whole, separators=(",", ":"))}


def _row(standing: Standing) -> tuple[Any, ...]:
    ends = (standing.start_s, standing.end_s)
    observed = standing.observed
    return (*ends, standing.x_m, standing.y_m, observed.counts, observed.parts)


def _standing(row: Sequence[Any]) -> Standing:
    start_s, end_s, x_m, y_m, counts, parts = row
    observed = Observed([Part(*each) for each in parts], Counts(*counts))
    return Standing(start_s, end_s, x_m, y_m, observed)


def stored_standstills(
    connection: sqlite3.Connection, run_id: int, span: range, motion: Motion, options: EventOptions
) -> tuple[range, list[StretchStandings]]:
    """The standstills that are stored, and in which buckets of 10 s they are all that there are.

    Args:
        connection: Any.
        run_id: Of which run.
        span: Buckets of 10 s that lie inside of what is asked for.
        motion: The signals that tell of them; with others nothing is stored.
        options: What counts as one; only the usual are stored.
    """
    usual = EventOptions()
    if motion.position is None or any(
        getattr(options, name) != getattr(usual, name) for name in _ASKED
    ):
        return range(0), []
    coarse, texts = stored_texts(connection, run_id, span, motion.position[0].id, "standstills")
    stored: list[dict[str, Any]] = [json.loads(text or "{}") for text in texts]
    signals = [signal.id for signal in motion.evidence]
    if any(each.get("signals") != signals for each in stored):
        return range(0), []
    inside = range(coarse.start * COARSE_BUCKETS, coarse.stop * COARSE_BUCKETS)
    return inside, [_stretch(each) for each in stored]


def _stretch(stored: dict[str, Any]) -> StretchStandings:
    nearest = stored["nearest"] and Nearest(*stored["nearest"])
    standings = [_standing(row) for row in stored["found"]]
    return StretchStandings(standings, stored["seen_s"], stored["noise_m"], nearest)
