"""What the tools answer: one compact object each, with the same header."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr


@dataclass(frozen=True)
class ShownPicture:
    """A picture beside the data: an encoded file.

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

    columns: list[str]
    rows: list[list[Any]]
    in_every_row: dict[str, Any] | None = said("Columns with the same value in all rows.")


class Answer(AnswerPart):
    """The header of every answer: about what, as of when, and whether time is moving."""

    summary: str | None = said("What this answer says, in one sentence.")
    robot: str | None = None
    run_id: int | None = None
    sim_time_s: float | None = said("Simulation time of the newest data.")
    age_s: float | None = said("Wall time since the newest data.")
    status: str | None = said("running, paused, starting, 'stopped N s ago', 'never seen'.")
    why: str | None = said("What the status rests on.")
    quoted: str | None = said("Of answers with texts that controllers or others wrote.")
    storage: str | None = said("Where the recording cannot be written: how it was read.")
    position_by: str | None = said("Who saw the robot, where it publishes no position itself.")
    hint: str | None = said("What to do next.")
    left_out: list[str] | None = said("Invalid rows and values, which are left out.")
    _pictures: list[ShownPicture] = PrivateAttr(default_factory=list[ShownPicture])

    @property
    def pictures(self) -> list[ShownPicture]:
        """What is shown beside the data, by clients that show both."""
        return self._pictures


class StateAnswer(Answer):
    """The newest published state."""

    state: Any = said("Data published by the controller.")
    shortened: str | None = said("Rule by which parts were left out.")
    kept_at_full_rate: str | None = said("The run's last kept stretch.")
    pace: str | None = said("Whether controller or simulation sets the pace.")


class SensorsAnswer(Answer):
    """The newest sensor values."""

    sensors: dict[str, Any] = Field(default_factory=dict[str, Any])
    replaced: dict[str, str] | None = said("Values that JSON cannot hold: path to nan, inf, ...")
    devices_not_named_in_state: str | None = said(
        "Sensors that the state lacks, or names differently than Webots."
    )
    shortened: str | None = None


class FullStateAnswer(Answer):
    """The newest state or a part of it, newest events, and the recorder's health."""

    state: Any = None
    path: str | None = None
    total: int | None = said("How many members, items or characters it has.")
    next_offset: int | None = said("Ask again with this offset for more.")
    shortened: str | None = None
    replaced: dict[str, str] | None = None
    events: AnswerTable | None = None
    recorder: dict[str, Any] | None = said(
        "Rows waiting and dropped, last kept stretch, error, controller."
    )


class WorldAnswer(Answer):
    """The world, the run, and who is in it."""

    world: str | None = None
    title: str | None = None
    basic_time_step_ms: float | None = None
    observer: str | None = said("Its signals world.KEY.x_m and solid.KEY.x_m are places.")
    in_world: AnswerTable | None = said("What the observer sees: robots, and solids with a DEF.")
    real_time_factor: float | None = said(
        "Simulation time per wall time over the last seconds recorded."
    )
    supervisor: bool | None = said("Whether it may control the simulation.")
    run: dict[str, Any] | None = None
    runs_recorded: int | None = None
    controller: dict[str, Any] | None = None
    devices: dict[str, str] | None = None
    other_robots: AnswerTable | None = said("Other robots in the same simulation.")
    database: str | None = None
    retention: dict[str, Any] | None = said("How much is kept, set by whom; size of the database.")
    data_dir: str | None = None


class RobotsAnswer(Answer):
    """All robots ever seen."""

    robots: AnswerTable | None = said(
        "rows_waiting, rows_dropped, last_error: where there are any."
    )
    database: str | None = None
    retention: dict[str, Any] | None = None


class DiagnosisAnswer(Answer):
    """What is not well between the controllers and their asker."""

    verdict: str | None = said("ok, warning or wrong: the worst.")
    failed: list[dict[str, str]] | None = None
    not_checked: dict[str, str] | None = said("Why, and which.")
    passed: str | None = said("Checks that found nothing.")


class LogsAnswer(Answer):
    """Log lines, oldest first."""

    lines: AnswerTable | None = None
    matching: int | None = said("How many lines match (with a cursor: how many older ones).")
    cursor: int | None = said("Ask again with this cursor for older lines.")


class CommandAnswer(Answer):
    """What became of a command."""

    command_id: int | None = None
    action: str | None = None
    outcome: str | None = said("done, failed, expired, cancelled, lost, or claimed (under way).")
    waited_s: float | None = None
    result: Any = said("What the controller answered.")
    error: str | None = said("What the controller or the bridge said.")
    route: str | None = said("What steered: bridge, websocket (of Webots), keyboard, process.")
    evidence: str | None = said("What shows that it happened.")
    failed_routes: dict[str, str] | None = said("Why other routes did not work.")


class ParametersAnswer(Answer):
    """The parameters of a run."""

    parameters: AnswerTable | None = None
    total: int | None = None


class CommandsAnswer(Answer):
    """Commands, newest first, and what can be asked for."""

    commands: AnswerTable | None = None
    cursor: int | None = said("Ask again with this cursor for older ones.")
    actions: dict[str, Any] | None = said("The controller's own actions with their docstrings.")
    built_in: list[str] | None = None


class BreakpointAnswer(Answer):
    """A breakpoint that was set or removed."""

    breakpoint_id: int | None = None
    condition: str | None = None
    action: str | None = None
    armed: bool | None = said("Whether the controller asks it now; null where it did not say.")
    notes: list[str] | None = None


class BreakpointsAnswer(Answer):
    """The breakpoints of a robot."""

    breakpoints: AnswerTable | None = None


class NotedAnswer(Answer):
    """An answer about a range of time, with what there is to know about that range."""

    notes: list[str] | None = said("Limits of the range, of sampling, and similar remarks.")


class SignalsAnswer(NotedAnswer):
    """The signals of a run."""

    signals: AnswerTable | None = said("missing: rows of the run without a value of it.")
    total: int | None = said("How many match.")
    cursor: int | None = said("Ask again with this cursor for more.")


class SignalMeaningsAnswer(NotedAnswer):
    """What signals mean."""

    signals: AnswerTable | None = said("source: declared, device, named or unknown.")
    total: int | None = said("How many signals match.")
    unknown: list[str] | None = said("Numeric signals of unknown meaning, which are not judged.")
    changed: list[str] | None = said("The signals that were described, or the undone names.")


class NumberSeries(AnswerPart):
    """A numeric signal: one item per bucket in each list, null where it has no value."""

    unit: str | None = None
    value: list[float | None] | None = said(
        "Where every bucket is one row; then there is nothing else."
    )
    constant: float | None = said("The same in every bucket; then there is nothing else.")
    min: list[float | None] | None = None
    max: list[float | None] | None = None
    mean: list[float | None] | None = None
    last: list[float | None] | None = None
    count: list[int] | None = said("Values per bucket, where they are not those of the run.")
    whole: dict[str, float | None] | None = said("Over the range.")
    without_value: bool | None = said("True: no value in the range.")
    replaced: dict[str, int] | None = said(
        "How often nan, inf, ... or too large a number stood there."
    )


class ChangeSeries(AnswerPart):
    """A text or boolean signal: its values, each with the time from which on it had it."""

    since_s: list[float | None] = Field(
        description="First null: it began earlier; there was no time to find when."
    )
    value: list[str | bool | None]
    total: int | None = said("How many changes, if not all are shown.")
    time_by_value_s: dict[str, float]


class RunSeries(AnswerPart):
    """The part of an answer that is about one run."""

    run_id: int
    start_s: float | None
    end_s: float | None
    step_s: float | None = said("Length of a bucket, s; missing where each bucket is one row.")
    sim_time_s: list[float | None] | None = said("Begin of each bucket.")
    count: list[int] | None = said("Values per bucket.")
    numbers: dict[str, NumberSeries] | None = None
    states: dict[str, ChangeSeries] | None = None
    row_count: int | None = None
    recording_gaps: list[list[float | None]] | None = said("[from, to] where no row was recorded.")
    recording_gap_count: int | None = said("How many, if not all are shown.")
    rows_missing_from_s: float | None = said(
        "Reading took too long: from here on rows are missing."
    )


class RowColumns(AnswerPart):
    """Rows as they were recorded, as columns."""

    run_id: list[int] | None = said("Where it is not the header's.")
    sim_time_s: list[float | None]
    signals: dict[str, list[Any]]
    replaced: dict[str, dict[str, int]] | None = None


class HistoryAnswer(NotedAnswer):
    """Signals over a range."""

    runs: list[RunSeries] | None = None
    raw: RowColumns | None = None
    cursor: int | None = said("With raw: ask again with this cursor for the next rows.")


class RunTrendTables(AnswerPart):
    """The trends of one run."""

    run_id: int
    start_s: float | None
    end_s: float | None
    row_count: int
    resolution_s: float | None = said("Shapes and slopes come from means over this many seconds.")
    numbers: AnswerTable | None = said("What changed most is first.")
    states: AnswerTable | None = said("Text and flags that changed.")
    constant: str | None = said("What never changed, with its value.")
    without_value: str | None = said("Signals without a value in the range.")
    not_shown: str | None = said("Of those that changed.")
    rows_missing_from_s: float | None = said(
        "Reading took too long: from here on rows are missing."
    )


class TrendsAnswer(NotedAnswer):
    """What each signal did over a range."""

    runs: list[RunTrendTables] | None = None


class KindVerdicts(AnswerPart):
    """What became of each kind that was asked for."""

    found: dict[str, int] | None = said("How many there are in the range, shown or not.")
    not_found: str | None = said("Searched for and not found.")
    nearest: dict[str, str] | None = said("Not found either; what came nearest.")
    not_searched: dict[str, str] | None = said(
        "Not searched for, or only in part: why, and what to ask instead."
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
        "Columns with @ hold that signal's value when the event began."
    )
    verdicts: KindVerdicts | None = None
    from_s: float | None = said("Begin of the range, where that is not the begin of the run.")
    not_shown: dict[str, str] | None = said(
        "How many of each kind there are beside these, and when they began."
    )
    cursor: str | None = said("Ask again with this cursor for those that are not shown.")


class CheckAnswer(NotedAnswer):
    """Whether a run is well."""

    outcome: str | None = said("The worst: fail, not looked at, warn, pass, or not judged.")
    checks: AnswerTable | None = said(
        "Those that did not pass; more: the call that shows it in full."
    )
    passed: list[str] | None = None
    counts: dict[str, int] | None = said("How many checks came to each outcome, shown or not.")
    expected: dict[str, str] | None = said("What became of each condition of `expect`.")


class TimelineAnswer(NotedAnswer):
    """A page of what happened, in order of time."""

    events: AnswerTable | None = None
    verdicts: KindVerdicts | None = None
    cursor: str | None = said("Ask again with this cursor for later ones.")


class MonitorAnswer(NotedAnswer):
    """What was recorded in a window of wall time: of exactly those rows."""

    window_s: float | None = said("Wall time that was looked at.")
    row_count: int | None = said("States recorded in the window.")
    movement: dict[str, Any] | None = None
    trends: list[RunTrendTables] | None = said("More than one: time went back in between.")
    events: AnswerTable | None = said(
        "Columns with @ hold that signal's value when the event began."
    )
    verdicts: KindVerdicts | None = None
    not_shown: dict[str, str] | None = said(
        "How many of each kind there are beside these, and when they began."
    )


class TrialsAnswer(NotedAnswer):
    """How far a trial set is, and its parameters ranked."""

    trial_set: int | None = None
    state: str | None = said("under way, done, stopped and why, ...")
    trials: int | None = None
    over: int | None = None
    pruned: int | None = said("Ended early, as the plan says.")
    failed: int | None = None
    score: str | None = None
    ranked: AnswerTable | None = said(
        "The best first; score is the mean, range least and greatest of repeats."
    )
    noise: float | None = said("Standard deviation of the scores of like trials.")
    is_best_confirmed: bool | None = said("By more than the spread of repeats; null: unknown.")
    verdict: str | None = None


class RunAnswer(CommandAnswer):
    """What came of a `run` command."""

    stopped: str | None = said(
        "condition held, simulation time reached, run ended, interrupted, or "
        "wall time limit reached."
    )
    stop_reason: str | None = None
    ran: dict[str, Any] | None = said("How far simulation time came.")
    values: dict[str, Any] | None = said("Of the condition's signals.")
    mode: str | None = None
    state: Any = said("As published at the step where it stopped.")
    state_at_s: float | None = None
    shortened: str | None = None
    movement: dict[str, Any] | None = None
    trends: RunTrendTables | None = None
    events: AnswerTable | None = None
    not_shown: dict[str, str] | None = None
    rows: AnswerTable | None = said("The last rows, of its signals.")
    picture: dict[str, Any] | None = None


class SqlAnswer(Answer):
    """What a SELECT returned."""

    result: AnswerTable | None = None
    truncated: str | None = said("Why rows or parts are missing.")


class RunsAnswer(Answer):
    """Runs, the newest first."""

    runs: AnswerTable | None = None
    run: dict[str, Any] | None = said("The one that was annotated.")
    total: int | None = None
    cursor: int | None = said("Ask again with this cursor for older ones.")


class ComparisonAnswer(NotedAnswer):
    """Runs beside each other; the first group is the reference."""

    verdict: str | None = said("With first_difference: where the two part.")
    unlike: dict[str, list[Any]] | None = said("What was not the same of them to begin with.")
    compared: dict[str, Any] | None = said("Rows that both have at the same simulation time.")
    parted: AnswerTable | None = said("In the order in which they part; beyond_s: the tolerance.")
    growth: dict[str, Any] | None = said("Largest difference of the signal that parts most.")
    groups: AnswerTable | None = None
    compared_s: float | None = said(
        "All figures are about the first seconds of each run, this many."
    )
    measures: AnswerTable | None = said(
        "Each run as a whole: median over the runs of each group, and their range. "
        "Of each group but the first: different; null where it cannot be told, then runs_wanted: "
        "this many runs of each would tell, if they went on like these. interval: of the "
        "difference of the means, 90 %. compared: share of runs, where rare events are counted by "
        "run; runs: those that have any. holds_for: null is compared_s."
    )
    unknown: dict[str, str] | None = said(
        "Figures that are null, or not of everything: why; what to do."
    )
    undecided: dict[str, str] | None = said("Why different is null.")
    differences: AnswerTable | None = said(
        "Signals, most different first; lists are in the order of the groups. Of each "
        "group but the first (a list where there are several): effect, how far the mean is from "
        "the first group's, in standard deviations (0.8 is large, null: unequal constants), "
        "deviation_ratio, different and interval of the mean, deviation_different and "
        "deviation_interval of the deviation. min and max where signals were named."
    )
    total: int | None = said("Numeric signals that all groups have.")
    only_in: dict[str, list[str]] | None = said("Signals that not every group has.")
