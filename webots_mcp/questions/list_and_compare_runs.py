"""Tools about runs as a whole: which there were, are they well, how they differ, their names."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field

from webots_mcp.analysis.summary import MIN_EFFECT_SD
from webots_mcp.answers.answer_models import AnswerTable, CheckAnswer, ComparisonAnswer, RunsAnswer
from webots_mcp.answers.budget import (
    DETAIL_BUDGET_TOKENS,
    LONGEST_NAME,
    answer_about,
    condensed,
    figure,
    figures,
    fitting,
    header_of_only,
    notes_of,
    row_budget_tokens,
    seconds,
    short_name,
    shown,
    without_empty,
)
from webots_mcp.answers.shortening import WHOLE, cut_for_a_model, is_for_a_person, shorten
from webots_mcp.errors import InvalidInputError
from webots_mcp.judging.detection.event_options import EventOptions, both_of
from webots_mcp.questions.arguments import (
    AnyNames,
    ComparedRunIds,
    Cursor,
    Limit,
    Mode,
    Position,
    RobotName,
    RunId,
    ShownLimit,
    TrialSetId,
    Value,
)
from webots_mcp.questions.declaration import READS, SETS, question
from webots_mcp.questions.scored_runs import find_series, series_facts, spelled_out, unknown_of
from webots_mcp.signals.conditions.expectation import Expectation, read_expectation
from webots_mcp.signals.conditions.scoring import Scored
from webots_mcp.signals.naming import listed
from webots_mcp.store.project_file import Expected, file_of, read_project
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.relative_times import utc
from webots_mcp.store.runs import MOST_RUNS, RunInfo, annotate_run, list_runs, pace, run_info
from webots_mcp.store.trial_sets import origins_of, scored_runs

if TYPE_CHECKING:
    from webots_mcp.analysis.summary import Spread
    from webots_mcp.judging.checks.check import Finding
    from webots_mcp.judging.comparison import Comparison, Difference, Group
    from webots_mcp.judging.divergence import Parting
    from webots_mcp.judging.run_measures import Measure

RUN_COLUMNS: Final = (
    "run_id", "robot", "label", "branched_from", "score", "parameters", "started", "began_by",
    "ended_by", "duration_s", "real_time_factor", "own_ms", "step_wait_ms", "row_count",
    "purged_rows", "notable", "controller", "sha256", "git_commit", "world", "note",
)  # fmt: skip
GROUP_COLUMNS: Final = (
    "name", "robot", "runs", "labels", "parameters", "sha256", "ended_by",
    "total_duration_s", "real_time_factor",
)  # fmt: skip
MEASURE_COLUMNS: Final = (
    "name", "median", "range", "different", "interval", "runs_wanted", "compared", "runs",
    "holds_for",
)  # fmt: skip
DIFFERENCE_COLUMNS: Final = (
    "signal", "unit", "mean", "mean_range", "deviation", "effect", "deviation_ratio", "different",
    "interval", "deviation_different", "deviation_interval", "min", "max",
)  # fmt: skip
PARTED_COLUMNS: Final = (
    "signal", "unit", "start_s", "values", "by", "largest", "largest_at_s", "tolerance", "beyond_s",
    "row_count",
)  # fmt: skip
CHECK_COLUMNS: Final = ("check", "outcome", "evidence", "start_s", "count", "more")
_GOING_ON: Final = "going on"
_LEGEND: Final = {  # what columns of a comparison mean, where their names do not say it
    "range": "range, mean_range: minimum and maximum over the runs of a group",
    "deviation": "deviation: standard deviation within a run",
    "effect": "effect: difference of the means, in standard deviations (0.8 is large)",
    "deviation_ratio": "deviation_ratio: deviation divided by that of the first group",
    "interval": "interval: 90 % confidence interval of the difference",
    "runs_wanted": "runs_wanted: runs of each group that would decide",
    "compared": "compared: how many runs have such events, not how many events",
    "holds_for": "holds_for: what the figure covers; null: the first compared_s seconds",
}


@dataclass(frozen=True)
class ComparisonSizes:
    """How much of a comparison its answer shows.

    Attributes:
        differences: Signals that differ, unless a limit is given.
        of_series: The same next to a score over many runs.
        ids: Runs that are named in a list.
        note_characters: Characters of a note, and of a reason why a figure is unknown.
        diverging: Signals in which two runs diverge, and properties in which they differ.
        only_in: Signals that only some groups have.
        verdict_characters: Characters of a verdict.
        hash_characters: Characters of a hash.
        measures_share: Share of the rows' budget for measures; the signals that differ have the
            rest.
        evidence_characters: Characters of the evidence of a check.
        checks_tokens: Budget of the checks that did not pass.
        passed_tokens: Budget of what those that passed rest on; for a person all is shown.
        passed_characters: Characters of what held.
        passed_signals: Names of the signals that were judged.
    """

    differences: int = 15
    of_series: int = 6
    ids: int = 20
    note_characters: int = 300
    diverging: int = 10
    only_in: int = 10
    verdict_characters: int = 600
    hash_characters: int = 10
    measures_share: float = 0.75
    evidence_characters: int = 250
    checks_tokens: int = 1_400
    passed_tokens: int = 300
    passed_characters: int = 100
    passed_signals: int = 3


_SIZES: Final = ComparisonSizes()


@question(
    "List the runs",
    READS,
    command="runs",
    options={"parameters": "--parameter"},
    example="--parameter kp=3.5 -n 5",
    quotes=True,
    tier="core",
)
def webots_list_runs(
    recording: RecordingAccess,
    limit: Limit = 20,
    cursor: Cursor = None,
    parameters: Annotated[
        dict[str, Value] | None,
        Field(max_length=20, description='Only runs with these parameters, {"kp": 3.0}.'),
    ] = None,
    score: Annotated[
        str | None,
        Field(max_length=500, description="Score to add: max(pose.x)."),
    ] = None,
    robot: RobotName = None,
) -> RunsAnswer:
    """List the runs, newest first: when, how long, which world and code, and how each ended.

    A run begins with each start, reset or reload. For the difference between runs use
    webots_compare_runs; for the faults of one use webots_check_run. `own_ms` and `step_wait_ms`
    are wall-clock milliseconds per step in the controller's code and in step(). `notable` counts
    warnings, errors, dropped rows and failed commands.
    """
    from webots_mcp.judging.comparison import COMPARE_DEADLINE_S
    from webots_mcp.judging.run_series import score_each

    with recording.reader() as connection:
        header = view_robot(connection, robot).header() if robot else header_of_only(connection)
        most = min(limit, MOST_RUNS)
        found = list_runs(
            connection, robot=robot, limit=most, before_id=cursor, parameters=parameters
        )
        ids = [run.run_id for run in found.runs]
        scores = score_each(connection, ids, score, COMPARE_DEADLINE_S) if score else {}
        origins = origins_of(connection, ids)
        rows = fitting(
            [_run_row(run, scores.get(e := run.run_id), origins.get(e)) for run in found.runs]
        )
        older = len(rows) < len(found.runs)
        return RunsAnswer(
            **header,
            runs=condensed(RUN_COLUMNS, rows),
            total=found.total,
            cursor=found.runs[len(rows) - 1].run_id if older else found.cursor,
            hint=_unscored_hint(scores) if rows else _no_runs(parameters),
        )


@question(
    "Compare runs",
    READS,
    command="compare",
    positional=("run_ids",),
    options={"run_ids": "RUN", "min_effect_sd": "--min-effect"},
    example="3 4 --signal 'pose*'",
    quotes=True,
    tier="core",
)
def webots_compare_runs(
    recording: RecordingAccess,
    run_ids: ComparedRunIds = None,
    signals: AnyNames = None,
    limit: ShownLimit = None,
    trial_set: TrialSetId = None,
    position: Position = None,
    mode: Mode = None,
    min_effect_sd: Annotated[
        float,
        Field(
            gt=0,
            le=100,
            description="Smallest difference that matters, in standard deviations of repeated "
            "runs.",
        ),
    ] = MIN_EFFECT_SD,
    first_difference: Annotated[
        bool, Field(description="Find the first row in which two runs differ.")
    ] = False,
    score: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Score all runs: max(pose.x), or reward.",
        ),
    ] = None,
    goal: Annotated[
        str | None,
        Field(
            max_length=500,
            description="Condition of success: arrived.",
        ),
    ] = None,
    robot: RobotName = None,
) -> ComparisonAnswer:
    """Find out whether an edit or a parameter helped; with score, how a training went.

    Without run_ids it compares the runs before and after the last edit of the controller; with
    one run it gives its figures; with score it ranks all. `different` is true if the
    difference is larger than between repeated runs (at least 4 of each), false if there is none
    that matters, and null if this cannot be known yet: `undecided` says why. For curves use
    webots_plot.
    """
    from webots_mcp.judging.comparison import COMPARE_DEADLINE_S, MOST_COMPARED
    from webots_mcp.judging.divergence import compare_rows

    asked_ids, named = spelled_out(run_ids)
    is_series = score is not None or goal is not None or len(asked_ids or ()) > MOST_COMPARED
    if is_series and (trial_set or first_difference):
        raise InvalidInputError(
            "score and goal are for runs of a robot, and exclude trial_set and first_difference. "
            "A trial set has a score of its own: webots_get_trials shows it."
        )
    if asked_ids and trial_set:
        raise InvalidInputError(
            "run_ids and trial_set exclude each other. Give run_ids to compare these runs, or "
            "trial_set to compare all of that set."
        )
    if first_difference and (not asked_ids or len(asked_ids) != 2 or position or mode):
        raise InvalidInputError(
            f"first_difference=true needs exactly two runs, not {asked_ids or 'none'}: "
            "give run_ids with two ids from webots_list_runs. position and mode do not apply to it."
        )
    options = EventOptions(position=both_of(position), mode=mode)
    chosen = named if is_series else asked_ids  # the runs of a range may be of any robot
    first = chosen[0] if chosen else _first_run(recording, trial_set) if trial_set else None
    with recording.view(robot, first) as view:

        def find() -> dict[str, Any]:
            asked = _Asked(signals, limit, options, min_effect_sd)
            if is_series:
                return _scored(view, asked_ids, named, score, goal, asked)
            if not (first_difference and asked_ids):
                return _compared(view, asked, asked_ids, trial_set)
            limit_s = math.inf if is_for_a_person() else COMPARE_DEADLINE_S
            names, connection = signals or ("*",), view.connection
            found = compare_rows(connection, asked_ids, names=names, deadline_s=limit_s)
            return parting_facts(found, limit)

        return answer_about(view, ComparisonAnswer, find)


def _first_run(recording: RecordingAccess, set_id: int) -> int:
    """Of its best parameters, so that the answer is about the robot that was tried."""
    with recording.reader() as connection:
        return next(iter(scored_runs(connection, set_id).values()))[0]


@question(
    "Annotate a run",
    SETS,
    command="annotate",
    positional=("run_id", "label"),
    options={"run_id": "RUN", "label": "TEXT"},
    example="4 baseline --note 'before the new gait'",
    tier="all",
)
def webots_annotate_run(
    recording: RecordingAccess,
    label: Annotated[str, Field(max_length=100, description="Short name; '-' removes it.")] = "",
    note: Annotated[
        str, Field(max_length=4000, description="Note of any length; '-' removes it.")
    ] = "",
    robot: RobotName = None,
    run_id: RunId = None,
) -> RunsAnswer:
    """Give a run a label or a note, which also keeps it from being deleted.

    Labels are shown by webots_list_runs.
    """
    with recording.view(robot, run_id) as view:
        run = view.require_run()
        before = run_info(view.connection, run.id)
    with recording.writer() as connection:
        annotate_run(connection, run.id, label=_change(label), note=_change(note))
    with recording.view(robot, run.id) as view:
        after = run_info(view.connection, run.id)
        named = zip(RUN_COLUMNS, _run_row(after), strict=True)
        pairs = (("label", before.label, after.label), ("note", before.note, after.note))
        replaced = [
            f"{what} {short_name(old)!r} was {'replaced' if new else 'removed'}"
            for what, old, new in pairs
            if old and old != new
        ]
        return RunsAnswer(
            **view.header(),
            run={k: v for k, v in named if v is not None},
            hint="; ".join(replaced) or None,
        )


def _change(text: str) -> str | None:
    """None leaves it as it is, an empty text takes it away."""
    return "" if text == "-" else text or None


def _unscored_hint(scores: Mapping[int, Scored]) -> str | None:
    """Return why runs have no score: the reason of the newest."""
    reasons = [each.why for each in scores.values() if each.value is None]
    if not reasons:
        return None
    return cut_for_a_model(
        f"no score of {len(reasons)} of these runs: {reasons[0]}", _SIZES.verdict_characters
    )


def _no_runs(parameters: dict[str, Any] | None) -> str:
    if parameters:
        return "no run had these values of its parameters, or none before that cursor"
    return "no run was recorded, or none before that cursor"


def _values_of(parameters: Mapping[str, Any]) -> Any:
    """Values of parameters as they are, of many the first."""
    budget_tokens = row_budget_tokens() if is_for_a_person() else DETAIL_BUDGET_TOKENS
    return shorten(dict(parameters), budget_tokens, WHOLE).value or None


def _run_row(run: RunInfo, scored: Scored | None = None, origin: str | None = None) -> list[Any]:
    """Return a run as a row under `RUN_COLUMNS`."""
    return [
        run.run_id,
        short_name(run.robot),
        short_name(run.label),
        origin,
        None if scored is None else figure(scored.value),
        _values_of(run.parameters),
        started(run),
        run.start_reason,
        run.end_reason or _GOING_ON,
        seconds(run.duration_s),
        figure(run.real_time_factor),
        figure(run.own_ms),
        figure(run.step_wait_ms),
        run.row_count,
        run.purged_rows or None,
        shown(run.notable) or None,
        short_name(_file(run.controller)),
        run.controller_sha256 and run.controller_sha256[: _SIZES.hash_characters],
        run.git_commit and run.git_commit[: _SIZES.hash_characters],
        short_name(_file(run.world)),
        shown(run.note),
    ]


def started(run: RunInfo) -> str:
    """Return when the run began, UTC, as `since` takes it."""
    return utc(run.started_wall_time_s)


def _file(path: str | None) -> str | None:
    """Return the name of a file without its folder, of whichever system."""
    return path and PurePath(path.replace("\\", "/")).name


def parting_facts(found: Parting, limit: int | None = None) -> dict[str, Any]:
    """Return where two runs part, as an answer has it."""
    from webots_mcp.judging.divergence import PartedSignal

    notes, most = notes_of(found.notes), None if is_for_a_person() else _SIZES.diverging
    known = {short_name(n): shown([*pair]) for n, pair in list(found.unlike.items())[:most]}
    names, parted = PartedSignal._fields[1:-1], found.parted[: limit or _SIZES.diverging]
    rows = [[short_name(each.signal), *map(_cell, names, each[1:-1])] for each in parted]
    rows = fitting(rows, row_budget_tokens(limit, [known, notes]))
    left, worst = len(found.parted) - len(rows), found.worst
    return {
        "verdict": cut_for_a_model(found.verdict, _SIZES.verdict_characters),
        "different_before": known or None,
        "compared": {"row_count": found.rows, "signal_count": found.signals,
                     "start_s": seconds(found.from_s), "end_s": seconds(found.until_s)},
        "diverging": without_empty(PARTED_COLUMNS, rows),
        "growth": worst and {"signal": short_name(worst.signal), **worst.growth},
        "notes": notes,
        "hint": f"{left} more signals diverge: limit or signals for others" if left else None,
    }  # fmt: skip


def _cell(name: str, value: Any) -> Any:
    """Return a cell: times and differences rounded, values with all their digits."""
    if name.endswith("_s"):
        return seconds(value)
    return float(f"{value:.4g}") if isinstance(value, float) else value


class _Asked(NamedTuple):
    """What a comparison was asked for, but for the runs."""

    names: Sequence[str] | None
    limit: int | None
    options: EventOptions
    min_effect_sd: float


def _scored(
    view: RobotView,
    run_ids: Sequence[int] | None,
    named: Sequence[int],
    score: str | None,
    goal: str | None,
    of: _Asked,
) -> dict[str, Any]:
    """Return a score over all runs, and what the best and the worst of them did differently."""
    series = find_series(view, run_ids, named, score, goal)
    facts, (best, worst) = series_facts(series), series.ends
    if not best:
        return facts | {"unknown": unknown_of(series, {})}
    of = of._replace(limit=of.limit or _SIZES.of_series)
    parts = [v.model_dump() if isinstance(v, AnswerTable) else v for v in facts.values()]
    compared = _compared(view, of, groups={"worst": worst, "best": best}, other_parts=parts)
    return compared | facts | {"unknown": unknown_of(series, compared["unknown"] or {})}


def _compared(
    view: RobotView,
    of: _Asked,
    run_ids: Sequence[int] | None = None,
    set_id: int | None = None,
    *,
    groups: Mapping[str, Sequence[int]] | None = None,
    other_parts: Sequence[Any] = (),
) -> dict[str, Any]:
    """Return a comparison; `other_parts` are what else the answer holds."""
    from webots_mcp.judging.comparison import compare_runs

    names, limit, options, min_effect_sd = of
    found = compare_runs(
        view.connection,
        run_ids or None,
        groups=groups,
        set_id=set_id or None,
        robot=view.robot.name,
        names=names or ("*",),
        limit=limit or _SIZES.differences,
        options=options,
        min_effect_sd=min_effect_sd,
    )
    differing = [each for each in found.differences if _differs(each)]
    undecided = _undecided(found.measures, differing)
    shown_groups, only_in = _groups(found), list(found.only_in.items())
    notes = notes_of([_cut(each) for each in (*_edit_note(found.groups), *found.notes)])
    not_known = {_cut(name): _cut(why) for name, why in found.unknown.items()}
    most = len(only_in) if is_for_a_person() else _SIZES.only_in
    others = [*other_parts, shown_groups and shown_groups.rows, not_known, undecided, notes]
    of_measures = int(_SIZES.measures_share * row_budget_tokens(limit, others))
    measures = fitting(list(map(_measure_row, found.measures)), of_measures)
    others.append(measures)
    rows = [_difference_row(each, with_extremes=names is not None) for each in differing]
    rows = fitting(rows, row_budget_tokens(limit, [*others, only_in[:most]]))
    tables = [without_empty(MEASURE_COLUMNS, measures), without_empty(DIFFERENCE_COLUMNS, rows)]
    return {
        "groups": shown_groups,
        "legend": _legend(found, tables),
        "compared_s": seconds(found.compared_s),
        "measures": tables[0],
        "unknown": not_known or None,
        "undecided": undecided,
        "differences": tables[1],
        "total": found.total,
        "only_in": {name: list(groups) for name, groups in only_in[:most]} or None,
        "notes": notes,
        "hint": _hint(found, len(measures), len(rows), len(differing), len(only_in) - most),
    }


def _cut(text: str) -> str:
    return cut_for_a_model(text, _SIZES.note_characters)


def _legend(found: Comparison, tables: Sequence[AnswerTable | None]) -> str | None:
    """Return what the columns of the tables mean, in the words of one line."""
    columns = {column for table in tables if table for column in table.columns}
    if len(found.groups) < 2 or not columns:
        return None
    lists = f"lists: {', '.join(group.name for group in found.groups)}"
    return "; ".join([lists, *(text for name, text in _LEGEND.items() if name in columns)])


def _edit_note(groups: Sequence[Group]) -> list[str]:
    """Return what makes before and after, where runs around an edit are compared."""
    if [group.name for group in groups] != ["before", "after"]:
        return []
    sides = [f"{group.name}: {_runs_and_code(group)}" for group in groups]
    return [f"around the last edit of the controller; {', '.join(sides)}"]


def _runs_and_code(group: Group) -> str:
    numbers = ", ".join(str(run.run_id) for run in group.runs)
    code = dict.fromkeys(
        (run.git_commit or run.controller_sha256 or "")[: _SIZES.hash_characters]
        for run in group.runs
    )
    named = ", ".join(filter(None, code))
    return f"run{'s' * (len(group.runs) > 1)} {numbers}{f' with code {named}' if named else ''}"


def _undecided(
    measures: Sequence[Measure], differences: Sequence[Difference]
) -> dict[str, str] | None:
    """Return why `different` is null, by the names of the figures that share a reason."""
    names: dict[str, list[str]] = {}
    figures: list[Measure | Difference] = [*measures, *differences]
    for each in figures:
        if reasons := dict.fromkeys(reason for reason in each.reasons[1:] if reason):
            names.setdefault("; ".join(reasons), []).append(short_name(each.name) or "")
    if len(names) == 1 and len(figures) > 1 and len(next(iter(names.values()))) == len(figures):
        return {"all figures": next(iter(names))}
    return {listed(each): why for why, each in names.items()} or None


def _differs(difference: Difference) -> bool:
    """Return whether mean or deviation of any group differs from the first, or it was asked for."""
    if difference.asked:
        return True
    first, *others = difference.deviation
    return any(each != 0 for each in difference.effect[1:]) or any(each != first for each in others)


def _measure_row(measure: Measure) -> list[Any]:
    from webots_mcp.judging.run_measures import WHOLE_RUNS

    return [
        short_name(measure.name),
        _medians(measure.spread),
        _ranges(measure.spread),
        _verdicts_against_first(measure.different),
        _intervals(measure.interval),
        _verdicts_against_first(measure.runs_wanted),
        None if measure.compared == "means" else measure.compared,
        measure.runs and [_ids(each) for each in measure.runs],
        measure.holds_for if measure.holds_for == WHOLE_RUNS else None,
    ]


def _ids(run_ids: Sequence[int]) -> list[int | str]:
    """Return run ids; of many, for a model, the first and how many more there are."""
    if is_for_a_person() or len(run_ids) <= _SIZES.ids:
        return list(run_ids)
    return [*run_ids[: _SIZES.ids], f"and {len(run_ids) - _SIZES.ids} more"]


def _medians(spreads: Sequence[Spread | None]) -> list[float | None]:
    return figures([None if each is None else each.median for each in spreads])


def _ranges(spreads: Sequence[Spread | None]) -> list[list[float | None] | None] | None:
    """Return the minimum and the maximum of each group; None where each group is one run."""
    if all(each is None or each.low == each.high for each in spreads):
        return None
    return [None if each is None else figures([each.low, each.high]) for each in spreads]


def _groups(found: Comparison) -> AnswerTable | None:
    robots = {run.robot for group in found.groups for run in group.runs}
    rows = [_group_row(group, told_robot=len(robots) > 1) for group in found.groups]
    return condensed(GROUP_COLUMNS, rows)


def _group_row(group: Group, *, told_robot: bool) -> list[Any]:
    labels = [short_name(run.label) for run in group.runs if run.label]
    hashes = dict.fromkeys(
        (run.controller_sha256 or "")[: _SIZES.hash_characters] for run in group.runs
    )
    driven_s = sum(run.wall_duration_s - run.held_s for run in group.runs)
    return [
        group.name,
        short_name(group.runs[0].robot) if told_robot else None,
        _ids([run.run_id for run in group.runs]),
        labels[: _SIZES.only_in] or None,
        _values_of({n: v[0] if len(v) == 1 else v for n, v in group.parameters.items()}),
        ", ".join(hashes) or None,
        ", ".join(dict.fromkeys(run.end_reason or _GOING_ON for run in group.runs)),
        seconds(group.total_duration_s),
        figure(pace(group.total_duration_s, driven_s)),
    ]


def _difference_row(difference: Difference, *, with_extremes: bool) -> list[Any]:
    """Return a row under `DIFFERENCE_COLUMNS`; only an angle's name leaves its unit open."""
    return [
        short_name(difference.name),
        difference.unit if difference.kind == "angle" else None,
        _medians(difference.mean),
        _ranges(difference.mean),
        _medians(difference.deviation),
        _against_first(figures(difference.effect)),
        _against_first(figures(difference.deviation_ratio)),
        _verdicts_against_first(difference.different),
        _intervals(difference.interval),
        _verdicts_against_first(difference.deviation_different),
        _intervals(difference.deviation_interval),
        figures(difference.min) if with_extremes else None,
        figures(difference.max) if with_extremes else None,
    ]


def _against_first(figures: Sequence[Any]) -> Any:
    """Return what is said of each group but the first; of a single one without a list around it."""
    others = list(figures[1:])
    return others[0] if len(others) == 1 else others


def _verdicts_against_first(verdicts: Sequence[Any]) -> Any:
    """Return what is said of each group but the first; None where nothing is said of any."""
    return _against_first(verdicts) if any(each is not None for each in verdicts[1:]) else None


def _intervals(found: Sequence[tuple[float, float] | None]) -> Any:
    return _verdicts_against_first([None if each is None else figures(each) for each in found])


def _hint(found: Comparison, measures: int, shown: int, differing: int, only_in: int) -> str | None:
    if len(found.groups) == 1:
        return "what its signals did: webots_get_trends; what happened: webots_find_events"
    more = shown < differing or differing == len(found.differences) < found.total
    hints = [f"{measures} of {len(found.measures)} measures: limit shows the others"] * (
        measures < len(found.measures)
    )
    hints += [f"the {shown} that differ most of {found.total}: limit or signals for others"] * more
    hints += ["no numeric signal differs"] * (differing == 0)
    equal = 0 if more else found.total - differing
    hints += [f"mean and deviation of the other {equal} are equal"] * (equal > 0 and differing > 0)
    hints += [f"{only_in + _SIZES.only_in} signals are in some groups only"] * (only_in > 0)
    return "; ".join(hints) or None


# -- is a run well? --------------------------------------------------------------------------------


@question(
    "Check a run",
    READS,
    command="check",
    positional=("run_id",),
    options={"run_id": "RUN"},
    example="4 --junit check.xml",
    quotes=True,
    tier="core",
)
def webots_check_run(
    recording: RecordingAccess,
    expect: Annotated[
        list[Annotated[str, Field(max_length=1100)]] | None,
        Field(
            max_length=20,
            description="Conditions that should hold, such as front_m > 0.1 during "
            "mode == 'drive', or goal_m < 0.1 within 20 (in the first 20 s).",
        ),
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> CheckAnswer:
    """Judge whether the robot behaved well in a run: motion, sensors, estimates, pace, log, goal.

    Each check passes, warns or fails with its evidence, or is not applicable or not judged with
    what is missing. It judges the robot; if nothing is recorded use webots_diagnose_setup. For
    when and how often something happened use webots_find_events.
    """
    expected = [read_expectation(each) for each in expect or ()]
    file = file_of(recording.data_dir)
    project = None if file is None else read_project(file).expected
    with recording.view(robot, run_id) as view:
        return answer_about(view, CheckAnswer, lambda: _checked(view, expected, project))


def _checked(
    view: RobotView, expected: Sequence[Expectation], project: Sequence[Expected] | None
) -> dict[str, Any]:
    """Return what became of the checks, the worst first; of those that passed the names."""
    from webots_mcp.judging.checks.check_run import CHECK_DEADLINE_S, check_run

    deadline_s = 120.0 if is_for_a_person() else CHECK_DEADLINE_S
    run_id = view.require_run().id
    checked = check_run(
        view.connection, run_id, expect=expected, project=project, deadline_s=deadline_s
    )
    others = [each for each in checked.worst_first if each.outcome != "pass"]
    rows = fitting(
        [_check_row(each) for each in others], None if is_for_a_person() else _SIZES.checks_tokens
    )
    left = Counter(each.outcome for each in others[len(rows) :])
    passed = checked.of("pass")
    counts = ", ".join(f"{count} {outcome}" for outcome, count in left.items())
    asked = {f"expects: {each.name}": each.name for each in expected}
    return {
        "expected": _expectations(checked.findings, asked),
        "counts": dict(Counter(each.outcome for each in checked.findings)),
        "outcome": checked.outcome,
        "checks": without_empty(CHECK_COLUMNS, rows),
        "passed": [each.name for each in passed] or None,
        "passed_on": _bases(passed),
        "notes": [f"not shown: {counts}; webots-mcp check shows all"] if left else None,
    }


def _expectations(findings: Sequence[Finding], asked: Mapping[str, str]) -> dict[str, str] | None:
    """Return what became of the conditions that were asked for, of the first ones that fit."""
    found = [
        (
            cut_for_a_model(asked[each.name], LONGEST_NAME),
            cut_for_a_model(f"{each.outcome}: {each.evidence}", _SIZES.passed_characters),
        )
        for each in findings
        if each.name in asked
    ]
    return dict(fitting(found, None if is_for_a_person() else _SIZES.passed_tokens)) or None


def _bases(passed: Sequence[Finding]) -> dict[str, str] | None:
    """Return what each check that passed rests on, of the first ones that fit."""
    found = [(each.name, _basis(each)) for each in passed]
    return dict(fitting(found, None if is_for_a_person() else _SIZES.passed_tokens)) or None


def _basis(finding: Finding) -> str:
    """Return what a check that passed rests on: what held, and the signals that were judged."""
    most = len(finding.signals) if is_for_a_person() else _SIZES.passed_signals
    names = listed([short_name(name) or "" for name in finding.signals], most)
    held = cut_for_a_model(finding.evidence, _SIZES.passed_characters)
    return f"{held} ({names})" if names else held


def _check_row(finding: Finding) -> list[Any]:
    return [
        finding.name,
        finding.outcome,
        cut_for_a_model(finding.evidence, _SIZES.evidence_characters),
        seconds(finding.since_s),
        finding.often,
        finding.more or None,
    ]
