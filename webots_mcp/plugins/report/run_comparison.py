"""Two runs of a report compared: the answer of `compare_runs` as sentences and tables."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from webots_mcp.analysis.summary import Spread
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.checks import CheckedRun
from webots_mcp.judging.comparison import Comparison, Difference, compare_runs
from webots_mcp.judging.run_measures import GOAL_REACHED, Measure
from webots_mcp.judging.verdicts import WORST_FIRST
from webots_mcp.plugins.report.grid import Grid, GridRow
from webots_mcp.plugins.report.words import cut, format_value, length, number
from webots_mcp.signals import naming

MOST_DIFFERENCES: Final = 30
_MOST_SAID: Final = 5
_OUTCOMES: Final = {"fail": "failed", "warn": "warned", "pass": "passed"}
_SHARE_OF_TEXTS: Final = 0.1  # Of the bytes of all texts.
_LARGE: Final = ((0.8, "large"), (0.5, "medium"), (0.2, "small"))  # Cohen's names for sizes of d.


@dataclass(frozen=True)
class RunComparison:
    """Two runs compared.

    Attributes:
        verdict: Which run did better, or that this cannot be told.
        says: The comparison in sentences.
        differing: Names of signals that differ, the largest difference first.
        why_not: Why the runs could not be compared, or an empty text.
    """

    verdict: str = ""
    says: Sequence[str] = ()
    differing: Sequence[str] = ()
    parameters: Grid | None = None
    measures: Grid | None = None
    differences: Grid | None = None
    notes: Sequence[str] = ()
    why_not: str = ""


def compare_two_runs(
    connection: sqlite3.Connection,
    run_ids: Sequence[int],
    budget_bytes: float,
    checked: Sequence[CheckedRun],
) -> RunComparison:
    """Compare two runs, in texts of about a tenth of `budget_bytes` at most.

    Args:
        connection: Connection to the recording.
        run_ids: The two runs.
        budget_bytes: Size of all texts of the report.
        checked: The checks of each.

    Raises:
        UnknownRunError: A run does not exist.
    """
    try:
        found = compare_runs(connection, run_ids, limit=MOST_DIFFERENCES)
    except NothingRecordedError as error:
        return RunComparison(verdict_of(checked, ()), why_not=str(error))
    names = [group.name for group in found.groups]
    differences = _differences(found, names).within(_SHARE_OF_TEXTS * budget_bytes)
    notes = [f"not known: {figures}: {why}" for figures, why in found.unknown.items()]
    notes += [
        f"only in {' and '.join(groups)}: {naming.listed(only)}" for groups, only in _only_in(found)
    ]
    return RunComparison(
        verdict_of(checked, found.measures),
        _says(found),
        [each.name for each in found.differences if each.effect[1]],
        _parameters(found, names),
        _measures(found, names),
        differences if differences.rows else None,
        (*found.notes, *notes),
    )


def verdict_of(checked: Sequence[CheckedRun], measures: Sequence[Measure]) -> str:
    """Return which of two runs did better: by its goal if both had one, else by its checks.

    Figures of one run each decide nothing: how much they vary between runs is not known.
    """
    first, second = checked
    goals = next((each.spread for each in measures if each.name == GOAL_REACHED), ())
    reached = [each.median for each in goals if each is not None]
    if len(reached) == 2 and reached[0] != reached[1]:
        better, worse = (first, second) if reached[0] > reached[1] else (second, first)
        return f"Run {better.run_id} did better: it reached its goal, run {worse.run_id} did not."
    ranks = [WORST_FIRST.index(each.outcome) for each in checked]
    judged = [each.outcome in ("fail", "warn", "pass") for each in checked]
    if not all(judged):
        unknown = " and ".join(
            f"run {each.run_id}" for each, known in zip(checked, judged, strict=True) if not known
        )
        return f"Cannot tell which run did better: the checks could not judge {unknown}."
    if ranks[0] == ranks[1]:
        return (
            f"Neither run did better by its checks: both {_OUTCOMES[first.outcome]}. Other figures "
            "are of one run each, so their differences may be chance."
        )
    better, worse = (first, second) if ranks[0] > ranks[1] else (second, first)
    reason = next(each for each in worse.worst_first if each.outcome == worse.outcome)
    return (
        f"Run {better.run_id} did better: its checks {_OUTCOMES[better.outcome]}, those of run "
        f"{worse.run_id} {_OUTCOMES[worse.outcome]} ({reason.name}: {cut(reason.evidence, 160)})."
    )


def _says(found: Comparison) -> list[str]:
    """Return sentences on parameters, measures and the signals that differ most."""
    first, second = (group.name for group in found.groups)
    said = [
        f"The first {length(found.compared_s)} of each run are compared: {second} with {first}."
    ]
    said += [
        f"{name}: {first} {_values(first_had)}, {second} {_values(second_had)}."
        for name, first_had, second_had in _differing_parameters(found)
    ]
    for each in found.measures:
        one, other = each.spread
        if one is not None and other is not None and one.median != other.median:
            said.append(f"{each.name}: {_change(one, other)}.")
    large = [each for each in found.differences if abs(each.effect[1] or 0.0) >= _LARGE[-1][0]]
    for each in large[:_MOST_SAID]:
        one, other = each.mean
        if one is not None and other is not None:
            said.append(f"mean of {each.name}: {_change(one, other)}{_effect(each)}.")
    return said if len(said) > 1 else [*said, "No figure differs."]


def _change(one: Spread, other: Spread) -> str:
    by = other.median - one.median
    change = f"{100 * by / abs(one.median):+.3g} %" if one.median else f"{by:+.3g}"
    return f"{number(other.median)} instead of {number(one.median)} ({change})"


def _effect(difference: Difference) -> str:
    size = difference.effect[1]
    if size is None:
        return ""
    word = next((word for limit, word in _LARGE if abs(size) >= limit), "hardly any")
    return f"; beside how much it varies within a run that is {word} (effect {number(size)})"


def _differing_parameters(
    found: Comparison,
) -> list[tuple[str, Sequence[object], Sequence[object]]]:
    first, second = (group.parameters for group in found.groups)
    names = dict.fromkeys((*first, *second))
    return [(name, first.get(name, ()), second.get(name, ())) for name in names]


def _values(values: Sequence[object]) -> str:
    return "; ".join(map(format_value, values)) or "without it"


def _parameters(found: Comparison, names: Sequence[str]) -> Grid | None:
    rows = [
        GridRow([name, _values(one), _values(other)])
        for name, one, other in _differing_parameters(found)
    ]
    return Grid(("parameter", *names), rows) if rows else None


def _measures(found: Comparison, names: Sequence[str]) -> Grid | None:
    rows = [GridRow([each.name, *map(_median, each.spread)]) for each in found.measures]
    return Grid(("figure", *names), rows) if rows else None


def _differences(found: Comparison, names: Sequence[str]) -> Grid:
    first, second = names
    columns = ("signal", "unit", f"mean, {first}", f"mean, {second}", "effect",
               f"deviation, {first}", f"deviation, {second}")  # fmt: skip
    rows = [
        GridRow([
            each.name, each.unit or "", *map(_median, each.mean), number(each.effect[1]),
            *map(_median, each.deviation),
        ])
        for each in found.differences
    ]  # fmt: skip
    return Grid(columns, rows, left_out=found.total - len(rows))


def _median(spread: Spread | None) -> str:
    return number(None if spread is None else spread.median)


def _only_in(found: Comparison) -> list[tuple[tuple[str, ...], list[str]]]:
    """Return signals that exist in one run only, by the run."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, groups in found.only_in.items():
        names.setdefault(groups, []).append(name)
    return list(names.items())
