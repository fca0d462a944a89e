"""Many summaries at once: the fields of those of stretches that follow each other, as arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final

from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, np
from webots_mcp.store.analysis.summary import COUNTS, LENGTH_DUST, NO_LENGTH, Summary, merge

_EXTREMES_AND_ENDS: Final = ("first", "min", "max", "last")


class Summaries:
    """Summaries of stretches that follow each other, in order.

    Attributes:
        table: A row for each, a column for each field, NaN where it is None.
    """

    def __init__(self, table: Array) -> None:
        self.table = table

    @classmethod
    def of(cls, parts: Sequence[Summary]) -> Summaries:
        """Those of a list."""
        table: Array = np.array(parts, np.float64)
        return cls(np.reshape(table, (len(parts), len(Summary._fields))))

    def as_list(self) -> list[Summary]:
        """One by one."""
        return [_summary(row) for row in self.table.tolist()]

    def __getitem__(self, field: str) -> Array:
        """A field of each, NaN where it is None."""
        return self._fields[Summary._fields.index(field)]

    @cached_property
    def _fields(self) -> Array:
        return np.ascontiguousarray(np.transpose(self.table))

    @property
    def rows(self) -> int:
        """Of all of them."""
        return int(self["rows"].sum())

    def one(self, place: int) -> Summary:
        """That at a place."""
        return _summary(self.table[place].tolist())

    def of_groups(self, starts: Indexes) -> Summaries:
        """Of each group of them, given where it begins, the ends and the extremes."""
        lasts = np.append(starts, len(self.table))[1:] - 1
        table = self.table[starts]
        for name in ("last", "last_sim_time_s"):
            table[:, Summary._fields.index(name)] = self[name][lasts]
        for name, extreme in (("min", np.fmin), ("max", np.fmax)):
            table[:, Summary._fields.index(name)] = extreme.reduceat(self[name], starts)
        return Summaries(table)

    def whole(self) -> Summary:
        """The same as `merge`."""
        filled = ~np.isnan(self["sum"])
        if len(filled) == 1 or not filled.any():
            return merge(self.as_list())
        if not filled.all():
            return Summaries(self.table[filled]).whole()._replace(rows=self.rows)
        present, total = int(self["present"].sum()), math.fsum(self["sum"].tolist())
        low, high = int(self["min"].argmin()), int(self["max"].argmax())
        shifts = self["sum"] / self["present"] - total / present
        squares = self["squares"] + self["present"] * shifts * shifts
        return Summary(
            self.rows,
            present,
            int(self["changes"].sum() + np.count_nonzero(self._stepped)),
            *self._at("first", 0),
            *self._at("last", -1),
            *self._at("min", low),
            *self._at("max", high),
            total,
            math.fsum(squares.tolist()),
            self._sum_where_angle("sines"),
            self._sum_where_angle("cosines"),
            *self._steps(),
        )

    def centres(self, turn: float | None) -> Array:
        """The mean of each, as `Summary.centre`; NaN where there is none."""
        means: Array = self["sum"] / self["present"]
        if turn is None:
            return means
        centres = np.arctan2(self["sines"], self["cosines"]) * turn / math.tau
        centres[(centres < 0) & (self["min"] >= 0)] += turn
        centres[self._lengths < NO_LENGTH] = np.nan
        return np.where(np.isnan(self["sines"]), means, centres)

    def variances(self, turn: float | None) -> Array:
        """The square of the deviation within each, as `Summary.deviation_in`; 0 where it has none.

        Args:
            turn: A whole turn of what is an angle, in its unit; the sines of each are known then.
        """
        if turn is None:
            varied = (self["present"] > 1) & (self["min"] < self["max"])
            return np.where(varied, self["squares"] / np.maximum(1, self["present"] - 1), 0.0)
        lengths = self._lengths
        varied = (self["present"] > 1) & (lengths <= 1 - LENGTH_DUST) & (lengths > 0)
        variances = -2 * np.log(np.where(varied, lengths, 1.0))
        return np.asarray(variances * (turn / math.tau) ** 2, np.float64)

    def known_values(self) -> tuple[Array, Array]:
        """Times and values of the ends and extremes of each, in order."""
        times = np.concatenate([self[f"{each}_sim_time_s"] for each in _EXTREMES_AND_ENDS])
        values = np.concatenate([self[each] for each in _EXTREMES_AND_ENDS])
        order = np.lexsort((values, times))
        times, values = times[order], values[order]
        known = ~np.isnan(times) & ~np.isnan(values)
        known[1:] &= (np.diff(times) != 0) | (np.diff(values) != 0)
        return times[known], values[known]

    @property
    def _lengths(self) -> Array:
        """Mean resultant lengths."""
        return np.asarray(np.hypot(self["sines"], self["cosines"]) / self["present"], np.float64)

    @cached_property
    def _stepped(self) -> Flags:
        """Whether the next one begins with another value than one ends with."""
        return np.asarray(self["last"][:-1] != self["first"][1:], np.bool_)

    def _at(self, field: str, place: int) -> tuple[float, float]:
        return float(self[field][place]), float(self[f"{field}_sim_time_s"][place])

    def _sum_where_angle(self, field: str) -> float | None:
        return None if np.isnan(self[field]).any() else math.fsum(self[field].tolist())

    def _steps(self) -> tuple[float | None, float | None, float | None]:
        """The largest step, and until and since when the first and the last value were there."""
        steps = np.concatenate(
            (self["largest_step"], np.abs(self["first"][1:] - self["last"][:-1]))
        )
        starts, ends = self["first_sim_time_s"], self["last_sim_time_s"]
        if np.isnan(steps).any() or np.any(ends[:-1] > starts[1:]):
            return None, None, None
        until, since = self["first_until_sim_time_s"], self["last_since_sim_time_s"]
        if np.isnan(until[0]) or np.isnan(since).any():
            return float(steps.max()), None, None
        varied = self["min"] != self["max"]
        from_first = np.flatnonzero(varied[:-1] | self._stepped)
        to_last = np.flatnonzero(varied[1:] | self._stepped)
        until_s = float(until[from_first[0] if len(from_first) else -1])
        since_s = float(since[to_last[-1] + 1 if len(to_last) else 0])
        return float(steps.max()), None if math.isnan(until_s) else until_s, since_s


def _summary(row: list[float]) -> Summary:
    counts, figures = map(int, row[:COUNTS]), row[COUNTS:]
    return Summary(*counts, *[None if figure != figure else figure for figure in figures])
