"""Extremes, first, last and mean values of signals in thousands of runs, without their rows.

They come from the statistics of chunks, and from the few rows at the end of a run that are in no
chunk. A run is left out if that does not tell: if it goes on, if its rows are not where they should
be, or if a mean would need the times of its rows.
"""

from __future__ import annotations

import ast
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from webots_mcp.signals.conditions.compiler import Compiler, Condition
from webots_mcp.signals.conditions.scoring import Aggregate, Facts, Score, Scored
from webots_mcp.signals.conditions.syntax import Scanned, is_signal
from webots_mcp.store.chunk_making import MIN_ROWS_AT_END
from webots_mcp.store.registered_signals import RegisteredSignal

_NUMBERS: Final = ("num", "bool", "angle")  # kinds of signals
_RUNS: Final = "FROM run r CROSS JOIN {} WHERE r.robot_id = ? AND r.id BETWEEN ? AND ? AND {}"
_AFTER_CHUNKS: Final = (
    "s.run_id = r.id AND s.sim_time_s > coalesce((SELECT max(end_sim_time_s) FROM row_group g "
    "WHERE g.run_id = r.id), -9e999)"
)
_COMPARISONS: Final[dict[type[ast.cmpop], tuple[str, Callable[[float, float], bool]]]] = {
    ast.Lt: ("min", float.__lt__),
    ast.LtE: ("min", float.__le__),
    ast.Gt: ("max", float.__gt__),
    ast.GtE: ("max", float.__ge__),
}
_SAME_S: Final = 1e-9  # of each interval: times of even rows differ by the rounding of floats


@dataclass
class SignalFacts:
    """What the values of a signal in a run come to; None without a value."""

    min: float | None = None
    max: float | None = None
    first: float | None = None
    last: float | None = None

    def add(self, low: float, high: float, first: float, last: float) -> None:
        """Add values that come after the others."""
        self.min = low if self.min is None else min(self.min, low)
        self.max = high if self.max is None else max(self.max, high)
        self.first = first if self.first is None else self.first
        self.last = last


class _RunRows(NamedTuple):
    """Rows of a run: in chunks, and after them."""

    chunked: int
    after: int


class RunStatistics:
    """Runs of a robot whose rows are all in chunks or few.

    Args:
        connection: Any.
        robot_id: Whose.
        run_ids: Its runs, rising.
        known: Its signals.

    Attributes:
        durations_s: Of these runs, in simulated seconds as scores count them.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        robot_id: int,
        run_ids: Sequence[int],
        known: Mapping[str, RegisteredSignal],
    ) -> None:
        self._connection = connection
        self._known = known
        self._runs = (robot_id, run_ids[0], run_ids[-1])
        self._signals: dict[str, tuple[int, str, str | None]] = {
            str(name): (int(signal_id), str(path), reduction)
            for name, signal_id, path, reduction in connection.execute(
                "SELECT name, id, path, reduction FROM signal WHERE robot_id = ?", (robot_id,)
            )
        }
        self._found: dict[str, dict[int, SignalFacts]] = {}
        self._rows: dict[int, _RunRows] = {}
        self.durations_s: dict[int, float] = {}
        self._find_runs(set(run_ids))

    def scores(self, score: Score) -> dict[int, Scored]:
        """Return the scores of the runs that statistics tell; none if the score asks for more."""
        names = [self._signal_in(each) for each in score.aggregates]
        if score.kinds or None in names:
            return {}
        columns = [
            self._values(str(name), each.function)
            for name, each in zip(names, score.aggregates, strict=True)
        ]
        return {
            run_id: score.of(Facts(duration_s, {}, [column[run_id] for column in columns]))
            for run_id, duration_s in self.durations_s.items()
            if all(run_id in column for column in columns)
        }

    def holds(self, condition: Condition) -> dict[int, bool]:
        """Return whether a condition holds at some time of a run, where statistics tell."""
        tree = condition.tree
        if is_signal(tree):
            name = self._name_in(condition.scanned, tree, number=False)
            if name is None or self._known[name].kind != "bool":
                return {}
            return {run_id: bool(value) for run_id, value in self._values(name, "max").items()}
        if not isinstance(tree, ast.Compare) or len(tree.ops) != 1 or not is_signal(tree.left):
            return {}
        function, holds = _COMPARISONS.get(type(tree.ops[0]), ("", None))
        name = self._name_in(condition.scanned, tree.left, number=True)
        limit = tree.comparators[0].value if isinstance(tree.comparators[0], ast.Constant) else None
        if holds is None or name is None or not isinstance(limit, (int, float)):
            return {}
        return {
            run_id: value is not None and holds(float(value), float(limit))
            for run_id, value in self._values(name, function).items()
        }

    def _find_runs(self, wanted: set[int]) -> None:
        """Find the ended runs whose rows are all in complete chunks or after them."""
        after = {
            int(run_id): int(count)
            for run_id, count in self._connection.execute(
                f"SELECT r.id, count(*) {_RUNS.format('state s', _AFTER_CHUNKS)} GROUP BY r.id",
                self._runs,
            )
        }
        for run_id, reason, start_s, end_s, rows, chunked in self._connection.execute(
            "SELECT r.id, start_reason, started_sim_time_s, last_sim_time_s, row_count, (SELECT "
            "CASE WHEN min(is_complete) = 0 OR max(lost_value_count) > 0 THEN -1 "
            "ELSE coalesce(sum(row_count), 0) END FROM row_group g WHERE g.run_id = r.id) "
            "FROM run r WHERE robot_id = ? AND id BETWEEN ? AND ? AND is_chunked = 1 "
            "AND ended_wall_time_s IS NOT NULL",
            self._runs,
        ):
            last = after.get(run_id, 0)
            is_whole = chunked >= 0 and chunked + last == rows
            if run_id in wanted and is_whole and last < MIN_ROWS_AT_END:
                self._rows[run_id] = _RunRows(chunked, last)
                self.durations_s[run_id] = end_s - (0.0 if reason == "reset" else start_s)

    def _signal_in(self, aggregate: Aggregate) -> str | None:
        """Return the signal of whose plain values an aggregate is made."""
        if aggregate.function == "time" or not is_signal(aggregate.tree):
            return None
        return self._name_in(aggregate.scanned, aggregate.tree, number=True)

    def _name_in(self, scanned: Scanned, tree: ast.expr, *, number: bool) -> str | None:
        """Return the name of the one signal in a tree, if it has numbers that were recorded."""
        names = list(Compiler(scanned, tree, lambda value: value, number=number).columns)
        name = names[0] if len(names) == 1 else ""
        is_number = name in self._known and self._known[name].kind in _NUMBERS
        return name if is_number and name in self._signals else None

    def _values(self, name: str, function: str) -> dict[int, float | None]:
        """Return an aggregate of a signal by run."""
        if function == "mean":
            return self._means(name)
        if name not in self._found:
            self._found[name] = self._facts_of(name)
        return {run_id: getattr(each, function) for run_id, each in self._found[name].items()}

    def _facts_of(self, name: str) -> dict[int, SignalFacts]:
        signal_id, path, reduction = self._signals[name]
        found = {
            run_id: SignalFacts()
            for run_id, rows in self._rows.items()
            if not rows.after or reduction is None
        }
        chunks = self._connection.execute(
            "SELECT k.run_id, k.min, k.max, k.first, k.last "
            f"{_RUNS.format('chunk k JOIN row_group g ON g.id = k.group_id', 'k.run_id = r.id')} "
            "AND k.signal_id = ? AND k.value_count > 0 ORDER BY k.run_id, g.start_sim_time_s",
            (*self._runs, signal_id),
        )
        for run_id, low, high, first, last in chunks:
            if run_id in found and low is not None:
                found[run_id].add(low, high, first, last)
        for run_id, _, value in self._values_after(path) if reduction is None else ():
            if run_id in found and value is not None:
                found[run_id].add(value, value, value, value)
        return found

    def _values_after(self, path: str) -> list[tuple[int, float, float | None]]:
        """Return run, time and number (None for another value) of each row after the chunks."""
        rows = self._connection.execute(
            "SELECT r.id, s.sim_time_s, CASE WHEN json_type(s.data, ?) IN ('integer', 'real', "
            f"'true', 'false') THEN json_extract(s.data, ?) END "
            f"{_RUNS.format('state s', _AFTER_CHUNKS)} ORDER BY r.id, s.sim_time_s, s.id",
            (path, path, *self._runs),
        )
        return [(int(run_id), time_s, value) for run_id, time_s, value in rows]

    def _means(self, name: str) -> dict[int, float | None]:
        """Return means weighted by time, of runs all in one group or none.

        In a group of even rows it is the mean of all values but the last, after which no time
        passes.
        """
        signal_id, path, reduction = self._signals[name]
        found: dict[int, float | None] = {}
        even = self._connection.execute(
            "SELECT k.run_id, (k.sum - k.last) / (k.row_count - 1) "
            f"{_RUNS.format('chunk k', 'k.run_id = r.id')} AND k.signal_id = ? "
            "AND k.row_count > 1 AND k.row_count = k.value_count AND EXISTS (SELECT 1 FROM chunk t "
            "WHERE t.run_id = k.run_id AND t.group_id = k.group_id AND t.signal_id = 0 AND "
            "t.row_count = k.row_count AND abs(t.largest_step * (t.row_count - 1) - "
            "(t.last - t.first)) < ? * t.row_count)",
            (*self._runs, signal_id, _SAME_S),
        )
        for run_id, mean in even:
            rows = self._rows.get(run_id)
            if rows is not None and not rows.after and run_id not in found:
                found[run_id] = mean
        several = [
            int(run_id)
            for (run_id,) in self._connection.execute(
                "SELECT run_id FROM row_group WHERE run_id BETWEEN ? AND ? GROUP BY run_id "
                "HAVING count(*) > 1",
                self._runs[1:],
            )
        ]
        for run_id in several:
            found.pop(run_id, None)
        if reduction is None:
            found |= self._means_after(path)
        return found

    def _means_after(self, path: str) -> dict[int, float | None]:
        """Return the means of runs without chunks."""
        rows: dict[int, list[tuple[float, float | None]]] = {}
        for run_id, time_s, value in self._values_after(path):
            if run_id in self._rows and not self._rows[run_id].chunked:
                rows.setdefault(run_id, []).append((time_s, value))
        return {run_id: _mean(of_run) for run_id, of_run in rows.items()}


def _mean(rows: Sequence[tuple[float, float | None]]) -> float | None:
    """Return the mean of values, each weighted by the time to the next row."""
    known = [value for _, value in rows if value is not None]
    weighted = [
        (after_s - time_s, value)
        for (time_s, value), (after_s, _) in pairwise(rows)
        if value is not None
    ]
    total_s = sum(lasts_s for lasts_s, _ in weighted)
    if total_s > 0:
        return sum(lasts_s * value for lasts_s, value in weighted) / total_s
    return sum(known) / len(known) if known else None
