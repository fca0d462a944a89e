"""Two runs of a report compared: the answer of `compare_runs` as sentences and tables."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from webots_mcp.analysis.summary import Spread
from webots_mcp.errors import NothingRecordedError
from webots_mcp.judging.checks.check_run import CheckedRun
from webots_mcp.judging.comparison import Comparison, Difference, compare_runs
from webots_mcp.judging.run_measures import GOAL_REACHED, Measure
from webots_mcp.judging.verdicts import WORST_FIRST
from webots_mcp.plugins.report.tables import Grid, GridRow
from webots_mcp.plugins.report.words import cut, format_value, length, number
from webots_mcp.signals import naming
from webots_mcp.store.run_parameters import RunParameter, parameters_of
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import run_infos

MOST_DIFFERENCES: Final = 30
_MOST_SAID: Final = 5
_MOST_DECIDED: Final = 3
_MOST_LINES: Final = 8  # of differences; tables have the others
# They say how the run was recorded and controlled, not what the robot achieved.
_NO_ACHIEVEMENTS: Final = (
    "duration_s", "own_ms_per_step", "change per min", "command per min", "bridge_event per min",
)  # fmt: skip
_OUTCOMES: Final = {"fail": "failed", "warn": "warned", "pass": "passed"}
_SHARE_OF_TEXTS: Final = 0.1  # Of the bytes of all texts.
_MOST_REPEATS: Final = 5  # runs of each side, with the one that was named
_AS_LONG: Final = 0.95  # of the shorter run: a repeat lasted at least that long
# Measures of which one direction is better, with the sign of that direction.
_BETTER_IF: Final = {GOAL_REACHED: 1, "time_to_goal_s": -1}
_LARGE: Final = ((0.8, "large"), (0.5, "medium"), (0.2, "small"))  # Cohen's names for sizes of d.


class ComparisonVerdict(NamedTuple):
    """How the second run compares with the first.

    Attributes:
        words: "better", "worse", "not different" or "cannot tell".
        text: The same in sentences, with the measure and its interval.
        mark: The class of its colour.
    """

    words: str
    text: str
    mark: str = ""


@dataclass(frozen=True)
class RunComparison:
    """Two runs compared.

    Attributes:
        verdict: Which run did better, or that this cannot be decided.
        says: The comparison in sentences.
        differing: Names of signals that differ, the largest difference first.
        why_not: Why the runs could not be compared, or an empty text.
    """

    verdict: ComparisonVerdict
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
        found = compare_runs(connection, with_repeats(connection, run_ids), limit=MOST_DIFFERENCES)
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


def with_repeats(connection: sqlite3.Connection, run_ids: Sequence[int]) -> list[int]:
    """Return two runs with their newest repeats: runs of equal code, world and parameters.

    Only repeats show how much figures vary between runs. Without them it returns the two runs, as
    it does for two runs that repeat each other.

    Raises:
        UnknownRunError: A run does not exist.
    """
    infos = run_infos(connection, run_ids)
    least_s = _AS_LONG * min(each.duration_s for each in infos)
    chosen: list[list[int]] = []
    for info in infos:
        if info.controller_sha256 is None:
            return list(run_ids)
        robot_id = fetch_run(connection, info.run_id).robot_id
        asked = (robot_id, info.controller_sha256, info.world, least_s)
        others = [
            row[0]
            for row in connection.execute(
                "SELECT r.id FROM run r JOIN session s ON s.id = r.session_id WHERE r.robot_id = ? "
                "AND s.controller_sha256 = ? AND r.world IS ? AND r.row_count > 0 "
                "AND r.last_sim_time_s - r.started_sim_time_s >= ? ORDER BY r.id DESC LIMIT 200",
                asked,
            )
        ]
        known = parameters_of(connection, [info.run_id, *others])
        values = {run_id: _parameter_values(each) for run_id, each in known.items()}
        same = [each for each in others if values[each] == values[info.run_id]]
        rest = [each for each in same if each != info.run_id]
        chosen.append([info.run_id, *sorted(rest[: _MOST_REPEATS - 1])])
    first, second = chosen
    if run_ids[1] in first or run_ids[0] in second:
        return list(run_ids)
    return [*first, *second]


def _parameter_values(parameters: Mapping[str, RunParameter]) -> list[tuple[str, str]]:
    return sorted((name, repr(each.values)) for name, each in parameters.items())


def verdict_of(checked: Sequence[CheckedRun], measures: Sequence[Measure]) -> ComparisonVerdict:
    """Return which of two runs did better: by its goal, then by its checks, then by no measure.

    A measure decides only if repeats show that it differs by more than chance; other figures have
    no direction that is better.
    """
    first, second = checked
    for decide in (_by_goal, _by_goal_of_repeats):
        if (verdict := decide(first, second, measures)) is not None:
            return verdict
    judged = [each.outcome in ("fail", "warn", "pass") for each in checked]
    if not all(judged):
        unknown = " and ".join(
            f"run {each.run_id}" for each, known in zip(checked, judged, strict=True) if not known
        )
        text = f"Cannot tell which run did better: the checks could not judge {unknown}."
        return ComparisonVerdict("cannot tell", f"{text} {_by_figures(measures)}")
    ranks = [WORST_FIRST.index(each.outcome) for each in checked]
    if ranks[0] == ranks[1]:
        text = f"Neither run did better by its checks: both {_OUTCOMES[first.outcome]}."
        decided = [each.different[-1] for each in measures if each.different]
        same = bool(decided) and all(each is False for each in decided)
        words = "not different" if same else "cannot tell"
        return ComparisonVerdict(words, f"{text} {_by_figures(measures)}")
    is_second = ranks[1] > ranks[0]
    better, worse = (second, first) if is_second else (first, second)
    reason = next(each for each in worse.worst_first if each.outcome == worse.outcome)
    text = (
        f"Run {better.run_id} did better: its checks {_OUTCOMES[better.outcome]}, those of run "
        f"{worse.run_id} {_OUTCOMES[worse.outcome]} ({reason.name}: {cut(reason.evidence, 160)})."
    )
    return _directed(is_second, text)


def _directed(is_second: bool, text: str) -> ComparisonVerdict:
    """Return that the second run is better or worse than the first."""
    if is_second:
        return ComparisonVerdict("better", text, "good")
    return ComparisonVerdict("worse", text, "error")


def _by_goal(
    first: CheckedRun, second: CheckedRun, measures: Sequence[Measure]
) -> ComparisonVerdict | None:
    """Return the verdict if all runs of one side reached their goal and none of the other."""
    goals = next((each.spread for each in measures if each.name == GOAL_REACHED), ())
    reached = [each.median for each in goals if each is not None]
    if sorted(reached) != [0.0, 1.0]:
        return None
    better, worse = (first, second) if reached[0] > reached[1] else (second, first)
    text = f"Run {better.run_id} did better: it reached its goal, run {worse.run_id} did not."
    return _directed(better is second, text)


def _by_goal_of_repeats(
    first: CheckedRun, second: CheckedRun, measures: Sequence[Measure]
) -> ComparisonVerdict | None:
    """Return the verdict of the first measure with a direction in which repeats differ."""
    for each in measures:
        sign = _BETTER_IF.get(each.name)
        interval = each.interval[-1] if each.interval else None
        if sign is None or interval is None or not each.different[-1]:
            continue
        is_second = sign * sum(interval) > 0
        better = second if is_second else first
        return _directed(is_second, f"Run {better.run_id} did better: {_with_interval(each)}.")
    return None


def _by_figures(measures: Sequence[Measure]) -> str:
    """Return what measures of repeats show, or why runs without repeats show nothing."""
    if not any(each.interval and each.interval[-1] for each in measures):
        return (
            "Other figures are of one run each, so their differences may be chance. Repeat both "
            "runs: a report compares all runs of the same code, world and parameters."
        )
    different = [each for each in measures if each.different and each.different[-1]]
    if not different:
        known = next(each for each in measures if each.interval and each.interval[-1])
        why = next((f": {each}" for each in known.reasons[::-1] if each), "")
        said = f"In the repeats of both, no figure is known to differ{why}."
        return f"{said} The first figure: {_with_interval(known)}."
    said = "; ".join(_with_interval(each) for each in different[:_MOST_DECIDED])
    return f"What differs by more than repeats do: {said}."


def _with_interval(measure: Measure) -> str:
    """Return a measure of both, and the interval in which their difference lies."""
    one, other = measure.spread[0], measure.spread[-1]
    said = measure.name
    if one is not None and other is not None:
        said += f" {_change(one, other)}"
    interval = measure.interval[-1]
    if interval is None:
        return said
    low, high = (f"{each:+.3g}" for each in interval)
    return f"{said}, the difference is {low} to {high} (90 % interval of {measure.compared})"


def _says(found: Comparison) -> list[str]:
    """Return sentences on parameters, measures and the signals that differ most."""
    first, second = (group.name for group in found.groups)
    said = [
        f"The first {length(found.compared_s)} of each run are compared: {second} with {first}."
    ]
    said += [
        f"{name}: {_values(second_had)} instead of {_values(first_had)}."
        for name, first_had, second_had in _differing_parameters(found)
    ]
    for each in found.measures:
        one, other = each.spread[0], each.spread[-1]
        if one is None or other is None or each.name in _NO_ACHIEVEMENTS:
            continue
        if one.median != other.median:
            said.append(f"{each.name}: {_change(one, other)}.")
    large = [each for each in found.differences if abs(each.effect[1] or 0.0) >= _LARGE[-1][0]]
    for each in large[:_MOST_SAID]:
        one, other = each.mean
        if one is not None and other is not None:
            said.append(f"mean of {each.name}: {_change(one, other)}{_effect(each)}.")
    said = said[: _MOST_LINES + 1]
    return said if len(said) > 1 else [*said, "No figure differs."]


def _change(one: Spread, other: Spread) -> str:
    by = other.median - one.median
    change = f"{100 * by / abs(one.median):+.3g} %" if one.median else f"{by:+.3g}"
    return f"{number(other.median)} instead of {number(one.median)} ({change})"


def _effect(difference: Difference) -> str:
    size = difference.effect[1]
    if size is None:
        return ""
    word = next((word for limit, word in _LARGE if abs(size) >= limit), "very small")
    return f"; a {word} change, compared with its variation within a run (effect {number(size)})"


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
