"""The trials of a set as a flat table: one row per trial, with the figures of its parameters."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from webots_mcp.store.analysis.spread import Ranked
from webots_mcp.store.export.export_rows import Column, Row, Table
from webots_mcp.store.trials import (
    Trial,
    best_of,
    fetch_trial_set,
    ranking_of,
    trials_of,
)

_OF_TRIAL: Final = (
    "trial_set_id", "number", "run_id", "status", "score", "ended_by", "ended_sim_time_s", "error",
    "started_wall_time_s", "finished_wall_time_s",
)  # fmt: skip
_OF_PARAMETERS: Final = ("rank", "mean", "least", "greatest", "scores", "pruned", "failed")


@dataclass(frozen=True)
class TrialTable(Table):
    """The trials of a set, in order.

    Columns are those of the table `trial`, the parameters by name, and how trials with the same
    parameters did: rank (1 is the best), mean, least and greatest score, and how many gave a
    score, were pruned, and failed. A parameter called like one of those is `parameter NAME`.
    """

    head: ClassVar[tuple[Column, ...]] = ()
    trials: Sequence[Trial]
    figures: dict[str, tuple[Any, ...]]
    notes: Sequence[str] = ()

    @classmethod
    def of(cls, connection: sqlite3.Connection, set_id: int) -> TrialTable:
        """The trials as they are now.

        Raises:
            InvalidInputError: There is no such set.
        """
        trials = trials_of(connection, set_id)
        plan = json.loads(fetch_trial_set(connection, set_id).plan)
        sets = ranking_of(trials, best_of(plan)).sets
        return cls(
            trials, {_key(each.parameters): _figures(i, each) for i, each in enumerate(sets, 1)}
        )

    @property
    def total(self) -> int:
        """How many there are."""
        return len(self.trials)

    def rows(self, pass_number: int = 1) -> Iterator[Row]:
        """All of them; `pass_number` makes no difference."""
        for each in self.trials:
            values: dict[str, Any] = {name: getattr(each, name) for name in _OF_TRIAL}
            for name, value in each.values.items():
                values[_column(name)] = value
            figures = self.figures.get(_key(each.values), (None,) * len(_OF_PARAMETERS))
            yield Row((), values | dict(zip(_OF_PARAMETERS, figures, strict=True)), {})


def _figures(rank: int, ranked: Ranked) -> tuple[Any, ...]:
    spread = ranked.score or (None, None, None)
    return (rank, *spread, len(ranked.scores), ranked.pruned, len(ranked.failures))


def _key(parameters: dict[str, Any]) -> str:
    return json.dumps(parameters, sort_keys=True)


def _column(parameter: str) -> str:
    taken = parameter in (*_OF_TRIAL, *_OF_PARAMETERS)
    return f"parameter {parameter}" if taken else parameter
