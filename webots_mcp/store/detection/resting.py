"""What a value that stays the same shows: a limit, a habit, or that it should have changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Final

from webots_mcp.naming import find_targets
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.intervals import Span
from webots_mcp.store.reading.ranges import just_after
from webots_mcp.store.reading.rows import read_columns
from webots_mcp.store.rollup.buckets import bucket_of
from webots_mcp.store.signals.registry import Signal

HABITUAL_ROWS: Final = 10  # with the same value at other times: it comes back to it
TARGET_WENT: Final = 0.1  # of the whole range of a target: so far it goes on, to show something
LONGEST_READ_S: Final = 120.0  # of a span: longer ones show it in their first part
MOSTLY_TOLD: Final = 0.5  # of the rows of a span have a speed that is not 0

_THERE_AT_OTHER_TIMES: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = :run AND signal_id = :signal "
    "AND (min = :value OR max = :value) AND (bucket < :first OR bucket > :last))"
)
_REPLACED_AT: Final = (
    "SELECT odd FROM state WHERE run_id = ? AND sim_time_s >= ? ORDER BY sim_time_s, id LIMIT 1"
)


class Resting:
    """A signal that rests at times, with what its rests are compared with."""

    def __init__(self, search: Search, signal: Signal) -> None:
        self.signal = signal
        self._search = search

    def shows(self, span: Span) -> str | None:
        """What there is to say of a value that the signal kept, but that it is frozen."""
        value = f"{span.key:.6g}" if isinstance(span.key, (int, float)) else span.key
        unit = f" {self.signal.unit}" if self.signal.unit else ""
        why = self.target_went_on(span)
        if self.is_limit(span):
            return f"at its limit of {value}{unit}" + (f", though {why}" if why else "")
        if why:
            return f"frozen: {why}"
        comes_back = self._rows_there(span) >= HABITUAL_ROWS
        return f"at {value}{unit}, as at other times" if comes_back else None

    def is_limit(self, span: Span) -> bool:
        """Whether it was never beyond the value that it kept, and was there at other times too.

        Only then it is where a sensor ends, or what a gate lets through: what counts or creeps is
        at its extreme wherever it stops.
        """
        if span.key not in self._extremes:
            return False
        if self._rows_there(span):
            return True
        buckets = bucket_of(span.start_s), bucket_of(span.end_s)
        asked = {"run": self._search.segment.run_id, "signal": self.signal.id, "value": span.key}
        asked |= {"first": buckets[0], "last": buckets[1]}
        found = self._search.connection.execute(_THERE_AT_OTHER_TIMES, asked)
        return bool(found.fetchone()[0])

    def target_went_on(self, span: Span) -> str | None:
        """Whether its target moved, or it was commanded to move, while it stayed; None if neither.

        For a position in the plane `stuck` reports that.
        """
        target, speed = self._targets
        return (_went(self._search, target, span) if target else None) or (
            _was_told(self._search, speed, span) if speed else None
        )

    def _rows_there(self, span: Span) -> int:
        """How many of the rows that were read outside of the span have the same value."""
        times, values = self._sample
        end = int(np.searchsorted(times, span.end_s, "right"))
        inside = values[int(np.searchsorted(times, span.start_s)) : end]
        there = int(np.count_nonzero(values == span.key))
        return there - int(np.count_nonzero(inside == span.key))

    @cached_property
    def _sample(self) -> tuple[Array, Array]:
        """Times and numbers that were read."""
        return self._search.view.sample([self.signal]).numbers(self.signal.name)

    @cached_property
    def _extremes(self) -> tuple[float | None, float | None]:
        """Of the whole run as far as it is rolled up, and of what was read."""
        rolled_up = self._search.extremes.get(self.signal.id or 0, (None, None))
        here = self._search.view.summary(self.signal)
        lows, highs = ((each for each in pair if each is not None) for pair in zip(
            rolled_up, (here.min, here.max), strict=True
        ))  # fmt: skip
        return min(lows, default=None), max(highs, default=None)

    @cached_property
    def _targets(self) -> tuple[Signal | None, Signal | None]:
        """Its target, and its commanded speed; of a position in the plane none."""
        known = self._search.known
        if self.signal in (self._search.motion.position or ()):
            return None, None
        numbers = [name for name, each in known.items() if each.kind in ("num", "angle")]
        target, speed = find_targets(self.signal.name, numbers)
        return known.get(target or ""), known.get(speed or "")


def _went(search: Search, target: Signal, span: Span) -> str | None:
    values = _values(search, target, span)
    if not len(values):
        return None
    low, high = search.extremes.get(target.id or 0, (None, None))
    seen = [each for each in (low, high, values.min(), values.max()) if each is not None]
    far = np.abs(values - values[0])
    if not far.max() > TARGET_WENT * (max(seen) - min(seen)):
        return None
    return f"its target {target.name} went from {values[0]:.4g} to {values[far.argmax()]:.4g}"


def _was_told(search: Search, speed: Signal, span: Span) -> str | None:
    values = _values(search, speed, span)
    nonzero = values[values != 0]
    if not len(values) or len(nonzero) < MOSTLY_TOLD * len(values):
        return None
    return f"{speed.name} was {float(np.median(nonzero)):.4g}"


def _values(search: Search, signal: Signal, span: Span) -> Array:
    """The numbers of a signal in a span, which may be none of those that are looked at."""
    end_s = min(just_after(span.end_s), span.start_s + LONGEST_READ_S)
    part = replace(search.segment, start_s=span.start_s, end_s=end_s)
    return read_columns(search.connection, part, [signal], search.deadline).numbers(signal.name)[1]


def replaced_value(search: Search, signal: Signal, at_s: float) -> str | None:
    """What a row had that JSON cannot hold, such as inf; None where it had nothing at all.

    Of a long array it is what the first of its items was.
    """
    row = search.connection.execute(_REPLACED_AT, (search.segment.run_id, at_s)).fetchone()
    replaced: Mapping[str, str] = json.loads(row[0]) if row and row[0] else {}
    first = f"{signal.name.rpartition('.')[0]}.0"
    return replaced.get(first if signal.reduce else signal.name)
