"""What changes nothing about a robot changes no answer about it.

Each situation is recorded as it is and in another way: with single missing values, with lost rows,
under one key, in 32-bit floats. Found must be the same kinds of events, and checks must end alike,
except those that are about what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, Final

import numpy as np
import pytest

from tests.cases import healthy_robots, problems
from tests.cases.columns import Array
from tests.cases.public import PUBLIC
from tests.cases.situations import (
    HEALTHY,
    PROBLEMS,
    Columns,
    Recording,
    Situation,
    record,
)
from tests.memory import memory_connection
from webots_mcp.store.reading.segment import one_reading

pytestmark = pytest.mark.slow

_MODULES = (healthy_robots, problems)  # which fill the registries
SITUATIONS: Final = PROBLEMS | HEALTHY | PUBLIC
_ABOUT_DROPOUTS: Final = frozenset(("gap", "missing", "run", "log", "change"))
_CHECKS_OF_DROPOUTS: Final = frozenset(("sensors have values", "misses no steps"))
Answers = tuple[frozenset[str], dict[str, str]]


def _without_values(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """No sensor has a value in the first row, and each misses one row of 53, at other times."""
    found = dict(columns)
    for at, (name, column) in enumerate(columns.items()):
        if name != "recorded" and getattr(column, "dtype", None) == np.float64:
            values: Array = np.array(column)
            values[0] = math.nan
            values[7 + at :: 53] = math.nan
            found[name] = values
    return times, found


def _without_rows(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """Two rows of 97 that follow each other are lost."""
    lost = np.zeros(len(times), np.bool_)
    lost[11::97] = lost[12::97] = True
    rows = np.flatnonzero(~lost)
    return times[rows], {name: _part(column, rows) for name, column in columns.items()}


def _under_a_key(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """All that it publishes stands under the key `state`."""
    return times, {
        name if name == "recorded" else f"state.{name}": column for name, column in columns.items()
    }


def _under_its_name(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """All that it publishes stands under the name of the robot."""
    return times, {
        name if name == "recorded" else f"freddy.{name}": column for name, column in columns.items()
    }


def _with_underscores(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """It publishes `gps_x` in place of `gps.x`."""
    return times, {name.replace(".", "_"): column for name, column in columns.items()}


def _in_single_precision(times: Array, columns: Columns) -> tuple[Array, Columns]:
    """Sensors give 32-bit floats."""
    return times, {
        name: np.float64(np.float32(column))
        if getattr(column, "dtype", None) == np.float64
        else column
        for name, column in columns.items()
    }


def _part(column: Any, rows: Any) -> Any:
    if isinstance(column, np.ndarray):
        return column[rows]
    return [column[row] for row in rows.tolist()] if isinstance(column, list) else column


def _answers(times: Array, columns: Columns) -> Answers:
    with memory_connection() as connection:
        record(connection, times, columns)
        with one_reading(connection):
            asked = Recording(connection)
            found = frozenset(asked.events().verdicts.found) - _ABOUT_DROPOUTS
            outcomes = {each.name: each.outcome for each in asked.checked.findings}
    return found, {name: each for name, each in outcomes.items() if name not in _CHECKS_OF_DROPOUTS}


@cache
def _whole(name: str) -> Answers:
    return _answers(*SITUATIONS[name].columns())


@pytest.mark.parametrize("name", SITUATIONS)
@pytest.mark.parametrize(
    "change",
    [
        _without_values,
        _without_rows,
        _under_a_key,
        _under_its_name,
        _with_underscores,
        _in_single_precision,
    ],
    ids=["values", "rows", "key", "name", "underscores", "floats"],
)
def test_what_changes_nothing_about_a_robot_changes_no_answer(
    name: str, change: Callable[[Array, Columns], tuple[Array, Columns]]
) -> None:
    each: Situation = SITUATIONS[name]
    assert _answers(*change(*each.columns())) == _whole(name)
