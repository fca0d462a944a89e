"""Following the recording of one trial: when it is over, and with which parameters it ran.

A trial is over after a simulated time, or when a condition holds.
"""

from __future__ import annotations

import json
import sqlite3
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from webots_mcp.errors import (
    InvalidInputError,
)
from webots_mcp.signals.conditions import Evaluator, parse_condition
from webots_mcp.steering.trial_plan import TrialPlan
from webots_mcp.store.chunks import parse

_SAME_TIME_S: Final = 1e-6
Ending: TypeAlias = Literal["for_s", "until", "prune"]


class End(NamedTuple):
    """The simulation time at which a trial ended, and what ended it."""

    sim_time_s: float
    by: Ending


class TrialWatch:
    """Follows the recording of one trial."""

    def __init__(self, plan: TrialPlan) -> None:
        self._plan = plan
        self._last_id = 0
        self._evaluators: list[tuple[Ending, Evaluator]] = []
        if plan.until is not None:
            self._evaluators.append(("until", parse_condition(plan.until).evaluator()))
        if plan.prune is not None:
            self._evaluators.append(("prune", parse_condition(plan.prune).evaluator()))
        self.robot_id: int | None = None
        self.run_id: int | None = None
        self.reached_s: float | None = None
        self._started_s = 0.0

    def find_end(self, connection: sqlite3.Connection) -> End | None:
        """Return the end of the trial as far as it is recorded; None before.

        Raises:
            InvalidInputError: It is not clear which robot to use, or its controller does not
                have the parameters that are to be tried.
            ConditionFailedError: If `until` or `prune` cannot be evaluated on the signals.
        """
        if self.run_id is None and not self._find_run(connection):
            return None
        self.reached_s = connection.execute(
            "SELECT max(sim_time_s) FROM state WHERE run_id = ?", (self.run_id,)
        ).fetchone()[0]
        if not self._evaluators:
            return self._by_time(self.reached_s)
        for row_id, sim_time_s, data in connection.execute(
            "SELECT id, sim_time_s, data FROM state WHERE run_id = ? AND id > ? ORDER BY id",
            (self.run_id, self._last_id),
        ):
            self._last_id = row_id
            if (end := self._by_time(sim_time_s)) and sim_time_s > end.sim_time_s + _SAME_TIME_S:
                return end
            if by := self._condition_at(parse(data), sim_time_s):
                return End(sim_time_s, by)
        return self._by_time(self.reached_s)

    def _condition_at(self, state: Any, sim_time_s: float) -> Ending | None:
        """Return the first condition that holds; every condition is evaluated on every state."""
        held: list[Ending] = [by for by, each in self._evaluators if each.holds(state, sim_time_s)]
        return held[0] if held else None

    def require_parameters(self, connection: sqlite3.Connection, wanted: dict[str, Any]) -> None:
        """Check that the run began with the wanted values.

        Raises:
            InvalidInputError: If the controller has not declared a parameter.
            ValueError: If it did not accept a value.
        """
        if self.run_id is None:
            return
        taken = dict(
            connection.execute(
                (
                    "SELECT name, value FROM parameter_value WHERE run_id = ? AND id IN "
                    "(SELECT min(id) FROM parameter_value WHERE run_id = ? GROUP BY name)"
                ),
                (self.run_id, self.run_id),
            ).fetchall()
        )
        declared = {
            row[0]: row[1:]
            for row in connection.execute(
                "SELECT name, low, high, choices FROM parameter WHERE robot_id = ?",
                (self.robot_id,),
            )
        }
        for name, value in wanted.items():
            if name not in taken:
                known = ", ".join(sorted(declared)) or "none"
                raise InvalidInputError(
                    f"The controller declares no parameter {name!r}. It declares {known}; see "
                    "bridge.parameter() in 'webots-mcp help trials'."
                )
            if json.loads(taken[name]) != value:
                low, high, choices = declared.get(name, (None, None, None))
                allowed = f"choices {choices}" if choices else f"from {low} to {high}"
                raise ValueError(
                    f"{name}={value!r} was not taken ({allowed}); it ran with {taken[name]}"
                )

    def _by_time(self, sim_time_s: float | None) -> End | None:
        if self._plan.for_s is None or sim_time_s is None:
            return None
        end_s = self._started_s + self._plan.for_s
        return End(end_s, "for_s") if sim_time_s >= end_s - _SAME_TIME_S else None

    def _find_run(self, connection: sqlite3.Connection) -> bool:
        robots = connection.execute("SELECT id, name FROM robot ORDER BY id").fetchall()
        wanted = self._plan.robot
        chosen = [row for row in robots if wanted in (None, row[1])]
        if wanted is None and len(robots) > 1:
            names = ", ".join(name for _, name in robots)
            raise InvalidInputError(
                f"Several robots record ({names}). Name one of them as robot = '...'."
            )
        for robot_id, _ in chosen:
            row = connection.execute(
                "SELECT id, started_sim_time_s FROM run WHERE robot_id = ? ORDER BY id LIMIT 1",
                (robot_id,),
            ).fetchone()
            if row is not None:
                self.robot_id = robot_id
                self.run_id, self._started_s = row
        return self.run_id is not None
