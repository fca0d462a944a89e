"""A batch of state rows turned into columns: one per run and signal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, cast

from webots_mcp.naming import LONGEST_SPREAD_ARRAY, REDUCTIONS, Value, flatten
from webots_mcp.store.signals.flatten import parse

ANY_ITEM: Final = "*"

Point = tuple[int, float, Value]  # state id, simulation time, value


@dataclass(slots=True)
class BatchColumn:
    """One signal of one run in the rows of the batch.

    Attributes:
        sample: The data of the first row that holds the signal: it shows where its value is.
    """

    robot_id: int
    run_id: int
    name: str
    sample: str
    points: list[Point] = field(default_factory=list[Point])
    replaced_row_count: int = 0
    first_wall_time_s: float = 0.0
    last_wall_time_s: float = 0.0


class Batch:
    """State rows in the order of their ids, as they are added."""

    def __init__(self) -> None:
        self.rows = 0
        self._runs: dict[int, dict[str, BatchColumn]] = {}

    def add(
        self,
        state_id: int,
        robot_id: int,
        run_id: int,
        sim_time_s: float,
        wall_time_s: float,
        data: str,
        replaced: str | None,
    ) -> None:
        """Add a row; one whose data is no JSON object only counts."""
        self.rows += 1
        columns = self._runs.setdefault(run_id, {})
        for name, value in flatten(parse(data)).items():
            column = columns.get(name)
            if column is None:
                column = columns[name] = BatchColumn(robot_id, run_id, name, data)
                column.first_wall_time_s = wall_time_s
            column.points.append((state_id, sim_time_s, value))
            column.last_wall_time_s = wall_time_s
        reasons = replaced_names(replaced)
        for name in reasons.keys() & columns.keys():
            state, _, value = columns[name].points[-1]
            columns[name].replaced_row_count += state == state_id and is_replaced(
                reasons, name, value
            )

    def columns(self) -> Iterator[BatchColumn]:
        """Every signal of every run."""
        for columns in self._runs.values():
            yield from columns.values()


def replaced_names(replaced: str | None) -> dict[str, str]:
    """What was replaced (nan, inf, ...) by signal: by its own name, or by an item of its array.

    Of an array in which all nulls are of one kind it is named for every item, and under `name.*`.
    """
    if replaced is None:
        return {}
    reasons: dict[str, str] = {}
    for path, reason in cast("dict[str, str]", parse(replaced)).items():
        array, _, item = path.rpartition(".")
        if item == ANY_ITEM:
            reasons.update((f"{array}.{index}", reason) for index in range(LONGEST_SPREAD_ARRAY))
        if item == ANY_ITEM or item.isdecimal():
            reasons.update((f"{array}.{reduction}", reason) for reduction in REDUCTIONS)
        reasons[path] = reason
    return reasons


def is_replaced(reasons: dict[str, str], name: str, value: Value) -> bool:
    """Whether a value is what the reasons of its row are about: of `name.*` only the nulls are."""
    array, _, item = name.rpartition(".")
    return not item.isdecimal() or value is None or f"{array}.{ANY_ITEM}" not in reasons
