"""What the tools answer: one compact object each, with the same header."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr


@dataclass(frozen=True)
class ShownPicture:
    """A picture next to the data: an encoded file.

    Attributes:
        format: Of the data, as in `image/png`.
    """

    data: bytes
    format: str


def said(text: str) -> Any:
    """Return a field that may be missing, with what it means."""
    return Field(default=None, description=text)


class AnswerPart(BaseModel):
    """A part of an answer."""

    model_config = ConfigDict(defer_build=True)  # most processes use one kind of answer


class AnswerTable(AnswerPart):
    """Rows under column names; a name says its unit."""

    columns: list[str] = Field(
        description="Names of the columns; a name says its unit, as in start_s."
    )
    rows: list[list[Any]] = Field(
        description="One list of values for each row, in the order of the columns."
    )
    in_every_row: dict[str, Any] | None = said("Columns that have the same value in all rows.")


class Answer(AnswerPart):
    """The header of every answer: about what, as of when, and whether time is moving."""

    summary: str | None = said("The answer in one sentence.")
    robot: str | None = said("Name of the robot that the answer is about.")
    run_id: int | None = said("Number of the run that the answer is about.")
    sim_time_s: float | None = said("Simulation time of the newest data, in seconds.")
    age_s: float | int | None = said("Wall-clock seconds since the newest data.")
    newest_wall_time: str | None = said(
        "Time of day of the newest data in UTC, if that is more than an hour old."
    )
    status: str | None = said(
        "Whether the robot is running, paused or starting, stopped some time ago or never seen."
    )
    why: str | None = said("The evidence for the status.")
    quoted: str | None = said(
        "Present if the answer quotes texts that controllers or others wrote."
    )
    storage: str | None = said("How the recording was read, if it cannot be written.")
    position_by: str | None = said("Who saw the robot, if it publishes no position itself.")
    hint: str | None = said("What to do next.")
    left_out: list[str] | None = said("Invalid rows and values that the answer leaves out.")
    _pictures: list[ShownPicture] = PrivateAttr(default_factory=list[ShownPicture])

    @property
    def pictures(self) -> list[ShownPicture]:
        """What clients show next to the data, if they show both."""
        return self._pictures


class StateAnswer(Answer):
    """The newest published state."""

    state: Any = said("The newest data that the controller published.")
    shortened: str | None = said("How long parts of the state were shortened.")
    kept_at_full_rate: str | None = said(
        "The last full-rate segment of the run, and why it was kept."
    )
    pace: str | None = said("Whether the controller or the simulation sets the pace.")


class SensorsAnswer(Answer):
    """The newest sensor values."""

    sensors: dict[str, Any] = Field(
        default_factory=dict[str, Any],
        description="The newest values of the signals that are sensors.",
    )
    replaced: dict[str, str] | None = said(
        "Values that JSON cannot hold: path to nan, inf and the like."
    )
    devices_not_named_in_state: str | None = said(
        "Sensors that the state has not, or under another name than in Webots."
    )
    shortened: str | None = said("How long parts of the values were shortened.")


class FullStateAnswer(Answer):
    """The newest state or a part of it, newest events, and the recorder's health."""

    state: Any = said("The newest state, or the part of it at the path, with exact values.")
    path: str | None = said("Path of the part that is shown.")
    total: int | None = said("Number of members, items or characters of that part.")
    next_offset: int | None = said("Offset to ask with for the next page.")
    shortened: str | None = said("How long parts of the state were shortened.")
    replaced: dict[str, str] | None = said(
        "Values that JSON cannot hold: path to nan, inf and the like."
    )
    events: AnswerTable | None = said("The newest events.")
    recorder: dict[str, Any] | None = said(
        "Rows that wait and that were dropped, last full-rate segment, error, controller."
    )


class WorldAnswer(Answer):
    """The world, the run, and who is in it."""

    world: str | None = said("Path of the world file.")
    title: str | None = said("Title of the world.")
    basic_time_step_ms: float | None = said("Basic time step of the world, in milliseconds.")
    observer: str | None = said(
        "Name of the observer; its signals world.KEY.x_m and solid.KEY.x_m are positions."
    )
    in_world: AnswerTable | None = said(
        "What the observer sees: robots, and solids with a DEF name."
    )
    real_time_factor: float | None = said(
        "Simulated seconds per wall-clock second over the last 5 s recorded (not the whole run)."
    )
    supervisor: bool | None = said("Whether the robot may control the simulation.")
    run: dict[str, Any] | None = said("The run: how it began and ended, its duration and its rows.")
    run_count: int | None = said("Number of recorded runs of the robot.")
    controller: dict[str, Any] | None = said(
        "The file, the code and the versions of the controller."
    )
    devices: dict[str, str] | None = said("Names of the devices with their types.")
    other_robots: AnswerTable | None = said("Other robots in the same simulation.")
    database: str | None = said("Path of the database file.")
    retention: dict[str, Any] | None = said(
        "How much is kept and who set that; size of the database."
    )
    data_dir: str | None = said("Folder of the recording.")
    lint: dict[str, Any] | None = said(
        "Faults of the world file: how many, and the worst one. webots_lint_world lists all."
    )


class LintAnswer(Answer):
    """Faults of a world file."""

    world: str | None = said("Path of the world file.")
    counts: dict[str, int] | None = said("Number of errors, warnings and notes.")
    faults: AnswerTable | None = said("One row for each fault, the worst first.")
    rules: dict[str, str] | None = said(
        "Why each rule that found something matters, and the page of Webots' documentation."
    )
    not_found: str | None = said("Rules that searched the whole world and found nothing.")
    not_searched: dict[str, str] | None = said(
        "Rules that could not judge everything, with the reason."
    )


class RobotsAnswer(Answer):
    """All robots ever seen."""

    robots: AnswerTable | None = said(
        "One row for each robot; rows_waiting, rows_dropped and last_error if there are any."
    )
    database: str | None = said("Path of the database file.")
    retention: dict[str, Any] | None = said(
        "How much is kept and who set that; size of the database."
    )


class DiagnosisAnswer(Answer):
    """What is not well between the controllers and their asker."""

    verdict: str | None = said("The worst result: ok, warning or wrong.")
    failed: list[dict[str, str]] | None = said("What is wrong, with the fix.")
    not_checked: dict[str, str] | None = said("What could not be checked, with the reason.")
    passed: str | None = said("Checks that found nothing wrong.")


class LogsAnswer(Answer):
    """Log lines, oldest first."""

    lines: AnswerTable | None = said("Log lines, oldest first.")
    total: int | None = said("Number of matching lines; with a cursor, of the older ones.")
    cursor: int | None = said("Cursor to ask with for older lines.")


class CommandAnswer(Answer):
    """What became of a command."""

    command_id: int | None = said("Number of the command.")
    action: str | None = said("Name of the action that was asked for.")
    outcome: str | None = said("done, failed, expired, cancelled, lost, or claimed (under way).")
    waited_wall_s: float | None = said("Wall-clock seconds that the call waited.")
    result: Any = said("What the controller returned.")
    error: str | None = said("What the controller or the bridge reported.")
    route: str | None = said("What steered: bridge, websocket (of Webots), keyboard or process.")
    evidence: str | None = said("What shows that it happened.")
    failed_routes: dict[str, str] | None = said("Why other routes did not work.")


class ParametersAnswer(Answer):
    """The parameters of a run."""

    parameters: AnswerTable | None = said(
        "One row for each parameter, with its value and its limits."
    )
    total: int | None = said("Number of parameters.")


class CommandsAnswer(Answer):
    """Commands, newest first, and what can be asked for."""

    commands: AnswerTable | None = said("Commands, newest first.")
    cursor: int | None = said("Cursor to ask with for older commands.")
    actions: dict[str, Any] | None = said(
        "Actions that the controller registered, with their docstrings."
    )
    built_in: list[str] | None = said("Names of the actions that every bridge has.")


class BreakpointAnswer(Answer):
    """A breakpoint that was set or removed."""

    breakpoint_id: int | None = said("Number of the breakpoint.")
    condition: str | None = said("Condition that triggers it.")
    action: str | None = said("What happens when it is hit.")
    armed: bool | None = said("Whether the controller evaluates it now; null if it did not say.")
    notes: list[str] | None = said("Remarks on its signals.")


class BreakpointsAnswer(Answer):
    """The breakpoints of a robot."""

    breakpoints: AnswerTable | None = said("One row for each breakpoint.")


class InspectionAnswer(Answer):
    """The controller's own variables, at an event or now."""

    event_id: int | None = said("Number of the event at which they were recorded.")
    at_s: float | None = said("Simulated seconds at which they had these values.")
    cause: str | None = said("What happened then: a breakpoint, a violation, an error or a hang.")
    frames: list[dict[str, Any]] | None = said(
        "The controller's functions that were being executed, the innermost first: `at` is file "
        "and line."
    )
    path: str | None = said("The variable that was asked for.")
    value: Any = said("Its value.")
    line: str | None = said("File and line that was being executed.")
    inspections: AnswerTable | None = said("Inspections of the run, newest first.")


class NotedAnswer(Answer):
    """An answer about a range of time, with what there is to know about that range."""

    notes: list[str] | None = said("Limits of the range, of sampling, and similar remarks.")


class SignalsAnswer(NotedAnswer):
    """The signals of a run."""

    signals: AnswerTable | None = said(
        "One row for each signal; missing counts the rows without a value."
    )
    total: int | None = said("Number of matching signals.")
    cursor: int | None = said("Cursor to ask with for more signals.")


class SignalMeaningsAnswer(NotedAnswer):
    """What signals mean."""

    signals: AnswerTable | None = said(
        "One row for each signal; source is declared, device, named, behaviour or unknown."
    )
    total: int | None = said("Number of matching signals.")
    unknown: list[str] | None = said("Numeric signals of unknown meaning, which are not judged.")
    changed: list[str] | None = said(
        "The signals that were described, or whose description was removed."
    )


class NumberSeries(AnswerPart):
    """A numeric signal: one item per bucket in each list, null where it has no value."""

    unit: str | None = said("Unit of the values.")
    value: list[float | None] | None = said(
        "The values, if each bucket is one row; then there are no other lists."
    )
    constant: float | None = said(
        "The value, if it is the same in every bucket; then there are no lists."
    )
    min: list[float | None] | None = said("Minimum of each bucket.")
    max: list[float | None] | None = said("Maximum of each bucket.")
    mean: list[float | None] | None = said("Mean of each bucket, weighted by time.")
    last: list[float | None] | None = said("Last value of each bucket.")
    count: list[int] | None = said("Values per bucket, if they differ from the count of the run.")
    whole: dict[str, float | None] | None = said(
        "Minimum, maximum and mean over the range, with the times of the extremes."
    )
    without_value: bool | None = said("True if the range holds no value.")
    replaced: dict[str, int] | None = said("Number of values that were nan, inf or too large.")


class ChangeSeries(AnswerPart):
    """A text or boolean signal: its values, each with the time from which on it had it."""

    since_s: list[float | None] = said(
        "Simulation time in seconds at which each value began; null first: it began earlier."
    )
    value: list[str | bool | None] = Field(description="The values in order.")
    total: int | None = said("Number of changes, if not all are shown.")
    time_by_value_s: dict[str, float] = Field(description="Seconds that the signal had each value.")


class RunSeries(AnswerPart):
    """The part of an answer that is about one run."""

    run_id: int = Field(description="Number of the run.")
    start_s: float | None = Field(
        description="Begin of the range in this run, in simulated seconds."
    )
    end_s: float | None = Field(description="End of the range in this run, in simulated seconds.")
    step_s: float | None = said("Length of a bucket in seconds; missing if each bucket is one row.")
    sim_time_s: list[float | None] | None = said(
        "Simulation time at which each bucket begins, in seconds."
    )
    count: list[int] | None = said("Values per bucket.")
    numbers: dict[str, NumberSeries] | None = said("Numeric signals by name.")
    states: dict[str, ChangeSeries] | None = said("Text and boolean signals by name.")
    row_count: int | None = said("Number of rows in the range.")
    recording_gaps: list[list[float | None]] | None = said(
        "[from, to] in simulated seconds where no row was recorded."
    )
    recording_gap_count: int | None = said("Number of gaps, if not all are shown.")
    rows_missing_from_s: float | None = said(
        "Simulation time from which on rows are missing: reading took too long."
    )


class RowColumns(AnswerPart):
    """Rows as they were recorded, as columns."""

    run_id: list[int] | None = said("Run of each row, if it is not that of the header.")
    sim_time_s: list[float | None] = Field(description="Simulation time of each row, in seconds.")
    signals: dict[str, list[Any]] = Field(
        description="The values of each signal, one for each row."
    )
    replaced: dict[str, dict[str, int]] | None = said(
        "Number of values of each signal that were nan, inf or too large."
    )


class HistoryAnswer(NotedAnswer):
    """Signals over a range."""

    runs: list[RunSeries] | None = said("The range, one part for each run.")
    raw: RowColumns | None = said("Rows as they were recorded.")
    cursor: int | None = said("Cursor to ask with for the next rows, with raw.")


class RunTrendTables(AnswerPart):
    """The trends of one run."""

    run_id: int = Field(description="Number of the run.")
    start_s: float | None = Field(
        description="Begin of the range in this run, in simulated seconds."
    )
    end_s: float | None = Field(description="End of the range in this run, in simulated seconds.")
    row_count: int = Field(description="Number of rows in the range.")
    resolution_s: float | None = said("Shapes and slopes come from means over this many seconds.")
    numbers: AnswerTable | None = said(
        "Numeric signals that changed, the largest change first; deviation is the standard "
        "deviation."
    )
    states: AnswerTable | None = said("Text and boolean signals that changed.")
    constant: str | None = said("Signals that never changed, with their values.")
    without_value: str | None = said("Signals without a value in the range.")
    not_shown: str | None = said("Number of changed signals that are not shown.")
    rows_missing_from_s: float | None = said(
        "Simulation time from which on rows are missing: reading took too long."
    )


class TrendsAnswer(NotedAnswer):
    """What each signal did over a range."""

    runs: list[RunTrendTables] | None = said("The trends of each run in the range.")


class KindVerdicts(AnswerPart):
    """What became of each kind that was asked for."""

    found: dict[str, int] | None = said("Number of events of each kind in the range, shown or not.")
    not_found: str | None = said("Kinds that were searched and not found.")
    nearest: dict[str, str] | None = said(
        "Kinds that were searched and not found, with what came nearest."
    )
    not_searched: dict[str, str] | None = said(
        "Kinds that were not searched, or only in part: why, and what to do."
    )
    _none_in_part: list[str] = PrivateAttr(default_factory=list[str])

    @property
    def none_in_part(self) -> list[str]:
        """Kinds that stand in `not_searched`, and of which the searched part has none."""
        return self._none_in_part

    @classmethod
    def with_parts(cls, none_in_part: list[str], **verdicts: Any) -> KindVerdicts:
        """Return verdicts of which those kinds were searched for in a part and not found."""
        made = cls(**verdicts)
        made._none_in_part = none_in_part
        return made


class EventsAnswer(NotedAnswer):
    """What happened in a range, in order of time."""

    events: AnswerTable | None = said(
        "Events in order of time; a column with @ holds that signal's value when the event began."
    )
    verdicts: KindVerdicts | None = said("What became of each kind that was searched for.")
    start_s: float | None = said("Begin of the range, where that is not the begin of the run.")
    not_shown: dict[str, str] | None = said(
        "Number of events of each kind that are not shown, and when they began."
    )
    cursor: str | None = said("Cursor to ask with for the events that are not shown.")


class CheckAnswer(NotedAnswer):
    """Whether a run is well."""

    outcome: str | None = said(
        "The worst outcome: fail, not looked at, warn, pass, not judged or not applicable."
    )
    checks: AnswerTable | None = said(
        "Checks that did not pass; more is the call that shows one in full."
    )
    passed: list[str] | None = said("Names of the checks that passed.")
    passed_on: dict[str, str] | None = said(
        "What held in each check that passed, and the signals that were judged."
    )
    counts: dict[str, int] | None = said("How many checks came to each outcome, shown or not.")
    expected: dict[str, str] | None = said("What became of each condition of `expect`.")


class TimelineAnswer(NotedAnswer):
    """A page of what happened, in order of time."""

    events: AnswerTable | None = said("What was recorded, in order of time.")
    verdicts: KindVerdicts | None = said("Number of entries of each kind.")
    cursor: str | None = said("Cursor to ask with for later entries.")


class MonitorAnswer(NotedAnswer):
    """What was recorded in a window of wall time: of exactly those rows."""

    window_wall_s: float | None = said("Wall-clock seconds that were watched.")
    row_count: int | None = said("Number of rows recorded in the window.")
    movement: dict[str, Any] | None = said(
        "From where to where the robot moved, with path and displacement in metres."
    )
    trends: list[RunTrendTables] | None = said(
        "The trends of each run in the window; a reset in between makes two."
    )
    events: AnswerTable | None = said(
        "Events in order of time; a column with @ holds that signal's value when the event began."
    )
    verdicts: KindVerdicts | None = said("What became of each kind that was searched for.")
    not_shown: dict[str, str] | None = said(
        "Number of events of each kind that are not shown, and when they began."
    )


class TrialsAnswer(NotedAnswer):
    """How far a trial set is, and its parameters ranked."""

    trial_set: int | None = said("Number of the trial set.")
    state: str | None = said("Whether the set is under way, done, or stopped and why.")
    trials: int | None = said("Number of trials in the set.")
    over: int | None = said("Number of trials that have ended.")
    pruned: int | None = said("Number of trials that ended early, as the plan says.")
    failed: int | None = said("Number of trials that failed.")
    score: str | None = said("The score that is compared.")
    ranked: AnswerTable | None = said(
        "Sets of parameters, the best first; score is the mean of repeats, range their "
        "minimum and maximum."
    )
    noise: float | None = said("Standard deviation of the scores of repeated trials.")
    is_best_confirmed: bool | None = said(
        "Whether the best leads by more than repeats scatter; null if that is unknown."
    )
    verdict: str | None = said("What the ranking shows.")


class RunAnswer(CommandAnswer):
    """What came of a `run` command."""

    stopped: str | None = said(
        "condition held, simulation time reached, run ended, interrupted, or wall time "
        "limit reached."
    )
    stop_reason: str | None = said("Why it stopped, in words.")
    ran: dict[str, Any] | None = said("How far simulation time came.")
    values: dict[str, Any] | None = said("Values of the condition's signals when it stopped.")
    mode: str | None = said("Mode of the simulation afterwards.")
    state: Any = said("The state as published at the step where it stopped.")
    state_at_s: float | None = said("Simulation time of that state, in seconds.")
    shortened: str | None = said("How long parts of the state were shortened.")
    movement: dict[str, Any] | None = said(
        "From where to where the robot moved, with path and displacement in metres."
    )
    trends: RunTrendTables | None = said("What each signal did meanwhile.")
    events: AnswerTable | None = said("What happened meanwhile, in order of time.")
    not_shown: dict[str, str] | None = said(
        "Number of events of each kind that are not shown, and when they began."
    )
    rows: AnswerTable | None = said("The last rows, of the condition's signals.")
    picture: dict[str, Any] | None = said(
        "The picture of the end: its kind, its time and its file."
    )


class SqlAnswer(Answer):
    """What a SELECT returned."""

    result: AnswerTable | None = said("The rows that the SELECT returned.")
    truncated: str | None = said("Why rows or parts of values are missing.")


class RunsAnswer(Answer):
    """Runs, the newest first."""

    runs: AnswerTable | None = said("One row for each run, newest first.")
    run: dict[str, Any] | None = said("The run that was annotated.")
    total: int | None = said("Number of matching runs.")
    cursor: int | None = said("Cursor to ask with for older runs.")


class RerunAnswer(Answer):
    """What new code commands on an old run, up to the first difference."""

    verdict: str | None = said("The outcome in one sentence.")
    comparison: str | None = said(
        "equal, differs, not repeatable, not on the tape, ended early, or timed out."
    )
    equal_rounds: int | None = said("Rounds of the loop in which all commands are equal.")
    equal_until_s: float | None = said("Simulation time up to which they are.")
    of_rounds: int | None = said("Rounds of the run that were replayed.")
    differences: list[str] | None = said("What differs in the first round that differs.")
    deciding_line: dict[str, Any] | None = said(
        "Line that decided, with the values on it in both versions."
    )
    not_recorded: str | None = said("What was asked and is not on the tape.")
    likely_causes: list[str] | None = said("Why the recorded code does not repeat itself.")
    exception: str | None = said("Exception that ended the new code.")
    place: str | None = said("File and line at which the replay ended.")
    file: str | None = said("Controller that was run.")
    basis: str | None = said("What the answer rests on, where the run has no tape.")


class ComparisonAnswer(NotedAnswer):
    """Runs side by side; the first group is the reference."""

    score: str | None = said("The score of all runs; more is better.")
    scored: dict[str, int] | None = said(
        "Number of runs, how many have a score, and of how many each outcome is known."
    )
    trend: str | None = said("How the score developed over the runs.")
    curve: AnswerTable | None = said(
        "Score and outcomes of consecutive runs: score_low and score_high bound the middle 80 %."
    )
    levels: AnswerTable | None = said("Consecutive runs at the same level of the score.")
    best_runs: AnswerTable | None = said("The runs with the highest scores.")
    worst_runs: AnswerTable | None = said("The runs with the lowest scores.")
    unscored: dict[str, str] | None = said("Why runs have no score, by reason the runs.")

    verdict: str | None = said("Where the two runs diverge, with first_difference.")
    different_before: dict[str, list[Any]] | None = said(
        "Properties in which the two runs differed from the beginning."
    )
    compared: dict[str, Any] | None = said("Rows that both runs have at the same simulation time.")
    diverging: AnswerTable | None = said(
        "Signals in the order in which they diverge; beyond_s is when they exceed the tolerance."
    )
    growth: dict[str, Any] | None = said("Largest difference of the signal that diverges most.")
    groups: AnswerTable | None = said("The groups of runs; the first is the reference.")
    legend: str | None = said("What the columns of measures and differences mean.")
    compared_s: float | None = said("All figures are about this many first seconds of each run.")
    measures: AnswerTable | None = said(
        "Figures of whole runs: the median over the runs of each group; different is null "
        "if undecided."
    )
    unknown: dict[str, str] | None = said(
        "Figures that are null or incomplete, with the reason and what to do."
    )
    undecided: dict[str, str] | None = said("Why different is null, by figure.")
    differences: AnswerTable | None = said(
        "Signals, most different first: the mean of each group; different is null if undecided."
    )
    total: int | None = said("Number of numeric signals that all groups have.")
    only_in: dict[str, list[str]] | None = said("Signals that not every group has.")
