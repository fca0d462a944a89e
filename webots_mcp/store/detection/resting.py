"""What a value that stays the same shows: a limit, a habit, or that it should have changed."""

from __future__ import annotations

import ast
from functools import cached_property
from typing import Final, NamedTuple

from webots_mcp.naming import find_targets
from webots_mcp.store.analysis.arrays import Array, np
from webots_mcp.store.conditions_on_arrays import compared
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.ranges import just_after
from webots_mcp.store.signals.registry import Signal

HABITUAL_ROWS: Final = 10  # with the same value at other times: it comes back to it
TARGET_WENT: Final = 0.1  # of the whole range of a target: so far it goes on, to show something
LONGEST_READ_S: Final = 120.0  # of a rest: longer ones show it in their first part
MOSTLY_TOLD: Final = 0.5  # of the rows of a rest have a speed that is not 0


class Rest(NamedTuple):
    """Rows [start, stop) with the same value, and the times of the first and the last of them."""

    start: int
    stop: int
    start_s: float
    end_s: float
    value: float

    @property
    def duration_s(self) -> float:
        """From the first row to the last."""
        return self.end_s - self.start_s


class Resting:
    """A signal that rests at times, with what its rests are compared with."""

    def __init__(self, search: Search, signal: Signal) -> None:
        self.signal = signal
        self._search = search

    def says(self, rest: Rest) -> str | None:
        """What there is to say of a value that the signal kept, but that it is frozen."""
        value = f"{rest.value:.6g}"
        unit = f" {self.signal.unit}" if self.signal.unit else ""
        why = self.target_went_on(rest)
        if self.is_limit(rest):
            return f"at its limit of {value}{unit}" + (f", though {why}" if why else "")
        if why:
            return f"frozen: {why}"
        comes_back = self._rows_there(rest) >= HABITUAL_ROWS
        return f"at {value}{unit}, as at other times" if comes_back else None

    def is_limit(self, rest: Rest) -> bool:
        """Whether it was never beyond the value that it kept, and was there at other times too.

        Only then it is where a sensor ends, or what a gate lets through: what counts or creeps is
        at its extreme wherever it stops.
        """
        low, high = _extremes(self._search, self.signal)
        return rest.value in (low, high) and self._rows_there(rest) > 0

    def target_went_on(self, rest: Rest) -> str | None:
        """Whether its target moved, or it was commanded to move, while it stayed; None if neither.

        For a position in the plane `stuck` reports that.
        """
        target, speed = self._targets
        return (_went(self._search, target, rest) if target else None) or (
            _was_told(self._search, speed, rest) if speed else None
        )

    def _rows_there(self, rest: Rest) -> int:
        """How many other rows of the run have the same value."""
        if rest.value not in self._alike:
            there = compared(self._search.whole, self.signal.name, ast.Eq, rest.value)
            self._alike[rest.value] = int(np.count_nonzero(there))
        return self._alike[rest.value] - (rest.stop - rest.start)

    @cached_property
    def _alike(self) -> dict[float, int]:
        """How many rows have a value."""
        return {}

    @cached_property
    def _targets(self) -> tuple[Signal | None, Signal | None]:
        """Its target, and its commanded speed; of a position in the plane none."""
        known = self._search.known
        if self.signal in (self._search.motion.position or ()):
            return None, None
        numbers = [name for name, each in known.items() if each.kind in ("num", "angle")]
        target, speed = find_targets(self.signal.name, numbers)
        return known.get(target or ""), known.get(speed or "")


def _went(search: Search, target: Signal, rest: Rest) -> str | None:
    values = _values(search, target, rest)
    if not len(values):
        return None
    low, high = _extremes(search, target)
    far = np.abs(values - values[0])
    if not far.max() > TARGET_WENT * (high - low):
        return None
    return f"its target {target.name} went from {values[0]:.4g} to {values[far.argmax()]:.4g}"


def _was_told(search: Search, speed: Signal, rest: Rest) -> str | None:
    values = _values(search, speed, rest)
    nonzero = values[values != 0]
    if not len(values) or len(nonzero) < MOSTLY_TOLD * len(values):
        return None
    return f"{speed.name} was {float(np.median(nonzero)):.4g}"


def _values(search: Search, signal: Signal, rest: Rest) -> Array:
    """The numbers of a signal in a rest, which may be none of those that are looked at."""
    end_s = min(just_after(rest.end_s), rest.start_s + LONGEST_READ_S)
    return search.frame.between(rest.start_s, end_s).usable(signal.name)[1]


def _extremes(search: Search, signal: Signal) -> tuple[float, float]:
    """Of the whole run."""
    zones = search.whole.zones(signal.name)
    low, high = (each[~np.isnan(each)] for each in (zones.min, zones.max))
    return float(low.min(initial=np.inf)), float(high.max(initial=-np.inf))
