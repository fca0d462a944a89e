"""How the answer of `webots_compare_runs` shows a score over many runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.analysis.level_changes import FEWEST_VALUES
from webots_mcp.answers.budget import figure, fitting, without_empty
from webots_mcp.answers.shortening import cut_for_a_model, is_for_a_person
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import listed
from webots_mcp.store.recording import RobotView

if TYPE_CHECKING:
    from webots_mcp.judging.run_series import ScoredRun, ScoreSeries

SERIES_DEADLINE_S: Final = 5.0  # for scores and events that are computed run by run
PERSON_DEADLINE_S: Final = 120.0
CURVE_COLUMNS: Final = (
    "first_run",
    "last_run",
    "scored",
    "score_mean",
    "score_median",
    "score_low",
    "score_high",
)
LEVEL_COLUMNS: Final = ("first_run", "last_run", "run_count", "score_mean")
_RUN_COLUMNS: Final = ("run_id", "score")
_SHOWN_RUNS: Final = 5
_SHOWN_REASONS: Final = 3
_REASON_CHARACTERS: Final = 120
_MOST_LEVELS: Final = 8
_OUTCOMES: Final = {"goal": "goal_percent", "crashed": "crashed_percent", "stuck": "stuck_percent",
                    "fall": "fell_percent", "time over": "time_over_percent"}  # fmt: skip


def spelled_out(run_ids: Sequence[int | str] | None) -> tuple[list[int] | None, list[int]]:
    """Return run ids with ranges such as "20-90" spelled out, and those that are named singly.

    Raises:
        InvalidInputError: A range ends before it begins, or there are too many runs.
    """
    if run_ids is None:
        return None, []
    from webots_mcp.judging.run_series import MOST_RUNS

    found: list[int] = []
    for each in run_ids:
        first, _, last = str(each).partition("-")
        start, end = int(first), int(last or first)
        if end < start:
            raise InvalidInputError(
                f"The range {each!r} ends before it begins. Write '{end}-{start}'."
            )
        if end - start + len(found) >= MOST_RUNS:
            raise InvalidInputError(
                f"{each!r} names more than {MOST_RUNS:,} runs. Choose a shorter range."
            )
        found += range(start, end + 1)
    return found, [each for each in run_ids if isinstance(each, int)]


def find_series(
    view: RobotView,
    run_ids: Sequence[int] | None,
    named: Sequence[int],
    score: str | None,
    goal: str | None,
) -> ScoreSeries:
    """Score the runs; errors as for `score_series`."""
    from webots_mcp.judging.run_series import score_series

    deadline_s = PERSON_DEADLINE_S if is_for_a_person() else SERIES_DEADLINE_S
    return score_series(
        view.connection,
        view.robot.id,
        view.robot.name,
        run_ids,
        required=named,
        score=score,
        goal=goal,
        deadline_s=deadline_s,
    )


def series_facts(series: ScoreSeries) -> dict[str, Any]:
    """Return the members of the answer that are about the score."""
    ranked = series.ranked
    most = len(ranked) if is_for_a_person() else _SHOWN_RUNS
    shown = min(most, max(1, len(ranked) // 2), 20)
    return {
        "score": series.score,
        "scored": {"runs": len(series.runs), "score": len(ranked), **series.known},
        "trend": _in_sample(series) + (trend_of(series) or "") or None,
        "curve": without_empty((*CURVE_COLUMNS, *_OUTCOMES.values()), _curve_rows(series)),
        "levels": _levels(series),
        "best_runs": _runs(ranked[:shown]),
        "worst_runs": _runs(ranked[::-1][:shown]),
        "unscored": _unscored(series),
    }


def _in_sample(series: ScoreSeries) -> str:
    """Return that only some runs were scored, if so."""
    return "of a sample spread over all runs: " if series.sampled else ""


def trend_of(series: ScoreSeries) -> str | None:
    """Return how the score developed, in a sentence."""
    levels, best = series.levels, series.best_level
    if best is None:
        return None
    last, mean = levels[-1], f"{best.mean:.4g}"
    if len(series.ranked) < 2 * FEWEST_VALUES:
        return f"mean {mean}; {len(series.ranked)} runs are too few to find a change"
    if series.is_rising:
        return f"still rising over the last {series.recent} scored runs (mean {last.mean:.4g})"
    if len(levels) == 1:
        return f"no change of level in {last.count} scored runs (mean {mean})"
    if best is last:
        return (
            f"best level since run {last.first_run} (mean {mean}), no improvement in the "
            f"{last.count} scored runs since"
        )
    return (
        f"best from run {best.first_run} to {best.last_run} (mean {mean}); from run "
        f"{last.first_run} on the mean is {last.mean:.4g}"
    )


def unknown_of(series: ScoreSeries, compared: Mapping[str, str]) -> dict[str, str] | None:
    """Return what is not known of all runs, and of the best and the worst of them."""
    if is_for_a_person():
        return {**series.unknown, **compared} or None
    others = [name for name in compared if name.removesuffix(" per min") not in series.unknown]
    named = {"of best or worst runs": listed(others)} if others else {}
    cut = {name: cut_for_a_model(why, _REASON_CHARACTERS) for name, why in series.unknown.items()}
    return {**cut, **named} or None


def _curve_rows(series: ScoreSeries) -> list[list[Any]]:
    return [
        [
            point.first_run,
            point.last_run,
            point.scored,
            *map(figure, (point.mean, point.median, point.low, point.high)),
            *(_percent(*point.shares.get(name, (0, 0))) for name in _OUTCOMES),
        ]
        for point in series.curve
    ]


def _percent(having: int, known: int) -> float | None:
    return round(100 * having / known, 1) if known else None


def _levels(series: ScoreSeries) -> Any:
    """Return the levels, of many the last ones: what happened last is asked for most."""
    if len(series.levels) < 2:
        return None
    most = None if is_for_a_person() else _MOST_LEVELS
    rows = [
        [level.first_run, level.last_run, level.count, figure(level.mean)]
        for level in series.levels[-most if most else None :]
    ]
    return without_empty(LEVEL_COLUMNS, rows)


def _runs(runs: Iterable[ScoredRun]) -> Any:
    return without_empty(_RUN_COLUMNS, fitting([[run.run_id, figure(run.value)] for run in runs]))


def _unscored(series: ScoreSeries) -> dict[str, str] | None:
    """Return which runs have no score, by the reason."""
    by_reason: dict[str, list[int]] = {}
    for run in series.runs:
        if run.value is None:
            by_reason.setdefault(run.why or "unknown", []).append(run.run_id)
    return {
        cut_for_a_model(why, _REASON_CHARACTERS): f"{len(runs)} runs: {listed([*map(str, runs)])}"
        for why, runs in list(by_reason.items())[:_SHOWN_REASONS]
    } or None
