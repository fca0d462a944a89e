"""`list_runs` and `annotate_run`: what was run, with which code, and how it ended."""

from __future__ import annotations

import math
import re
import sqlite3
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np
from webots_mcp.analysis.summary import (
    Spread,
    Verdict,
    chance_of,
    chance_of_counts,
    may_differ,
    spread_of,
    verdicts_on,
)
from webots_mcp.analysis.track import PathLength, tracks_of, travelled
from webots_mcp.database.connection import transaction
from webots_mcp.database.liveness import dead_sessions
from webots_mcp.database.pauses import paused_s
from webots_mcp.errors import ConditionFailedError, InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.condition import aggregated, position_in
from webots_mcp.judging.detection.events import Found, asked_kinds, kind_names, search_events
from webots_mcp.judging.detection.kinds import EventOptions
from webots_mcp.judging.detection.search import Motion, doubt_of_length, doubt_of_unit, in_metres
from webots_mcp.signals.conditions.scoring import Facts, Score, Scored, parse_score
from webots_mcp.signals.naming import FARTHEST_M, NAME_POSITION, listed, nearest_first
from webots_mcp.signals.parameter import Value
from webots_mcp.store.parameters import HAD_VALUES, as_filter, notable_parameters
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.frame_source import Unread
from webots_mcp.store.reading.frame_summary import change_points
from webots_mcp.store.reading.ranges import TimeRange, unrecorded, whole_run
from webots_mcp.store.reading.segment import Deadline, Segment, Subject, in_one_snapshot, kept_parts
from webots_mcp.store.robots import resolve_robot
from webots_mcp.store.run_rows import OWN_MS, STEP_WAIT_MS, fetch_run
from webots_mcp.store.signals import Signal

MOST_RUNS: Final = 200
MAX_LABEL: Final = 100
MAX_NOTE: Final = 4000

_RUNS: Final = (
    "SELECT r.id, b.name, r.session_id, s.controller, s.controller_sha256, s.git_commit, r.world, "
    "r.start_reason, r.end_reason, r.label, r.note, r.purged_rows, "
    f"{OWN_MS}, {STEP_WAIT_MS}, "
    # Rows, times and what was said last are those of a heartbeat, which newer rows may follow.
    "r.row_count + CASE WHEN r.ended_wall_time_s IS NULL THEN (SELECT count(*) FROM state "
    "WHERE run_id = r.id AND sim_time_s > CASE WHEN r.row_count > 0 THEN r.last_sim_time_s "
    "ELSE -9e999 END) ELSE 0 END, "
    "r.started_wall_time_s, max(r.last_wall_time_s, coalesce((SELECT wall_time_s FROM state "
    "WHERE run_id = r.id ORDER BY sim_time_s DESC, id DESC LIMIT 1), 0)), "
    "r.started_sim_time_s, max(r.last_sim_time_s, coalesce((SELECT max(sim_time_s) FROM state "
    "WHERE run_id = r.id), r.started_sim_time_s)) "
    "FROM run r JOIN session s ON s.id = r.session_id JOIN robot b ON b.id = r.robot_id "
)
_WHAT: Final = (
    "run_id", "robot", "session_id", "controller", "controller_sha256", "git_commit", "world",
    "start_reason", "end_reason", "label", "note", "purged_rows",
    "own_ms", "step_wait_ms", "row_count",
)  # fmt: skip
_PAGE: Final = (
    f"{_RUNS} WHERE (:robot IS NULL OR r.robot_id = :robot) AND (:before IS NULL OR r.id < :before)"
    f" AND {HAD_VALUES} ORDER BY r.id DESC LIMIT :limit"
)
_ONE: Final = f"{_RUNS} WHERE r.id = ?"
_TOTAL: Final = (
    f"SELECT count(*) FROM run r WHERE (:robot IS NULL OR robot_id = :robot) AND {HAD_VALUES}"
)
_NOTABLE: Final = (
    "SELECT 'log ' || level, count(*) FROM log WHERE run_id = :run "
    "AND level IN ('warning', 'error', 'critical') GROUP BY level UNION ALL "
    "SELECT kind, count(*) FROM event WHERE run_id = :run "
    "AND kind NOT IN ('change', 'start', 'reset', 'reload') GROUP BY kind UNION ALL "
    "SELECT 'command ' || status, count(*) FROM command c JOIN run r ON r.id = :run "
    "AND r.session_id = c.session_id WHERE c.status IN ('failed', 'lost') "
    "AND c.claimed_wall_time_s BETWEEN r.started_wall_time_s AND r.last_wall_time_s "
    "GROUP BY status"
)
_ANNOTATE: Final = (
    "UPDATE run SET label = CASE WHEN :label IS NULL THEN label ELSE nullif(:label, '') END, "
    "note = CASE WHEN :note IS NULL THEN note ELSE nullif(:note, '') END WHERE id = :run"
)


@dataclass(frozen=True)
class RunInfo:
    """A run.

    Attributes:
        end_reason: None while it goes on; where its process is gone, how that will be judged.
        duration_s: Simulated seconds.
        own_ms: Mean wall time of a step in the controller's own code; None where few were seen.
        step_wait_ms: Likewise in `step` itself.
        held_s: Of the wall time, that for which the simulation was paused by a command.
        row_count: State rows; retention has deleted `purged_rows` of them.
        notable: How often what needs attention was stored: warnings, errors, dropped rows,
            failed or lost commands, trouble with storage.
        parameters: Those that are not as the code declared them, or differ between the runs that
            were asked for together; a text names changes in the middle of the run.
    """

    run_id: int
    robot: str
    session_id: int
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    world: str | None
    start_reason: str
    end_reason: str | None
    label: str | None
    note: str | None
    purged_rows: int
    own_ms: float | None
    step_wait_ms: float | None
    row_count: int
    started_wall_time_s: float
    wall_duration_s: float
    held_s: float
    duration_s: float
    notable: dict[str, int]
    parameters: dict[str, Value | str]

    @property
    def real_time_factor(self) -> float | None:
        """Simulated seconds per second of wall time, but for the time it was held."""
        return pace(self.duration_s, self.wall_duration_s - self.held_s)


@dataclass(frozen=True)
class RunList:
    """Runs, the newest first.

    Attributes:
        total: How many there are in all.
        cursor: Give it as `before_id` for older ones; None after the oldest.
    """

    runs: tuple[RunInfo, ...]
    total: int
    cursor: int | None


@in_one_snapshot
def list_runs(
    connection: sqlite3.Connection,
    *,
    robot: str | None = None,
    limit: int = 20,
    before_id: int | None = None,
    parameters: Mapping[str, Value] | None = None,
) -> RunList:
    """List runs, the newest first.

    Args:
        connection: Any.
        robot: Whose; None for all robots.
        limit: 1 to 200.
        before_id: Only runs with smaller ids: the `cursor` of the page before.
        parameters: Only runs in which these parameters had these values at some time.

    Raises:
        UnknownRobotError: No robot has that name.
        InvalidInputError: `limit` is out of bounds, or no parameter was ever called so.
    """
    if not 1 <= limit <= MOST_RUNS:
        raise InvalidInputError(f"limit={limit} must be from 1 to {MOST_RUNS}")
    robot_id = None if robot is None else resolve_robot(connection, robot, time.time()).id
    asked = {"robot": robot_id, "parameters": as_filter(connection, parameters or {})}
    page = {**asked, "before": before_id, "limit": limit + 1}
    rows: list[Any] = connection.execute(_PAGE, page).fetchall()
    runs = tuple(_infos(connection, rows[:limit]))
    total = connection.execute(_TOTAL, asked).fetchone()[0]
    return RunList(runs, total, runs[-1].run_id if len(rows) > limit else None)


def run_info(connection: sqlite3.Connection, run_id: int) -> RunInfo:
    """One run.

    Raises:
        UnknownRunError: No run has that id.
    """
    (run,) = run_infos(connection, [run_id])
    return run


def run_infos(connection: sqlite3.Connection, run_ids: Sequence[int]) -> list[RunInfo]:
    """Several runs, in this order.

    Raises:
        UnknownRunError: One of these ids is no run's.
    """
    ids = [fetch_run(connection, run_id).id for run_id in run_ids]
    return _infos(connection, [connection.execute(_ONE, (each,)).fetchone() for each in ids])


def annotate_run(
    connection: sqlite3.Connection,
    run_id: int,
    *,
    label: str | None = None,
    note: str | None = None,
) -> None:
    """Give a run a label (short, to find it by) or a note; an empty text takes it away.

    Args:
        connection: In the role "writer".
        run_id: Which run.
        label: At most 100 characters; None leaves it as it is.
        note: At most 4,000 characters; None leaves it as it is.

    Raises:
        UnknownRunError: No run has that id.
        InvalidInputError: Neither is given, or one is too long.
    """
    if label is None and note is None:
        raise InvalidInputError("give a label or a note")
    for name, text, longest in (("label", label, MAX_LABEL), ("note", note, MAX_NOTE)):
        if text is not None and len(text) > longest:
            raise InvalidInputError(
                f"the {name} has {len(text)} characters; at most {longest} are kept"
            )
    values = {"run": run_id, "label": label, "note": note}
    with transaction(connection):  # it waits for the lock, and Ctrl-C ends that
        if not connection.execute(_ANNOTATE, values).rowcount:
            fetch_run(connection, run_id)  # says which there are


def pace(duration_s: float, wall_s: float) -> float | None:
    """The real-time factor; None where the wall time is too short: under a second."""
    return duration_s / wall_s if wall_s >= 1 else None


def _infos(connection: sqlite3.Connection, rows: Sequence[tuple[Any, ...]]) -> list[RunInfo]:
    gone = dict(dead_sessions(connection))
    parameters = notable_parameters(connection, [row[0] for row in rows])
    return [_info(connection, row, gone, parameters[row[0]]) for row in rows]


def _info(
    connection: sqlite3.Connection,
    row: tuple[Any, ...],
    gone: dict[int, str],
    parameters: dict[str, Value | str],
) -> RunInfo:
    """One run; `gone` says how sessions ended that still look open."""
    *what, started_wall_s, last_wall_s, started_s, last_s = row
    named = dict(zip(_WHAT, what, strict=True))
    named["end_reason"] = named["end_reason"] or gone.get(named["session_id"])
    return RunInfo(
        **named,
        started_wall_time_s=started_wall_s,
        wall_duration_s=last_wall_s - started_wall_s,
        held_s=paused_s(connection, row[0], last_wall_s),
        duration_s=last_s - started_s,
        notable=dict(connection.execute(_NOTABLE, {"run": row[0]}).fetchall()),
        parameters=parameters,
    )


# What whole runs came to, in groups: the way, the modes and the events of a stretch.


_SHARE: Final = "share of "
_DUST: Final = 1e-9  # of a figure
_OF_THIS_RUN: Final = re.compile(r"^run \d+ lasted only [^;,]*|(?<=a period is over )\S+")
_RATE: Final = " per min"
NO_MODE: Final = (
    "no mode is known: publish one as a text, such as mode, or name the signal of one: mode=NAME"
)
NO_WAY: Final = "fewer than two rows have a position"
OUT_OF_TIME: Final = "time limit reached before all rows were read: compare fewer runs at once"
_SPEED: Final = "mean_speed_m_s"


@dataclass(frozen=True)
class Way:
    """Where a robot was in a stretch of one run.

    Attributes:
        times: Of the rows that have a position, in s.
        x_m: In metres, as `y_m`.
        cut_at_s: As of a frame: where the deadline cut it.
        unread: As of a frame: all that was not read.
    """

    times: Array
    x_m: Array
    y_m: Array
    cut_at_s: float | None
    unread: tuple[Unread, ...]

    @property
    def length(self) -> PathLength:
        """How long it is, without what the noise of the position adds from row to row."""
        return travelled(tracks_of(self.times, self.x_m, self.y_m))


def way_in(frame: Frame, position: tuple[Signal, Signal]) -> Way:
    """The way of a robot in a frame, as far as it is read before the deadline."""
    x, y = (in_metres(each, frame.numbers(each.name)) for each in position)
    there = np.maximum(np.abs(x), np.abs(y)) <= FARTHEST_M
    return Way(frame.times[there], x[there], y[there], frame.cut_at_s, frame.unread)


@dataclass(frozen=True)
class RunPart:
    """A run, and what its own robot's signals are."""

    robot_id: int
    segment: Segment
    known: dict[str, Signal]
    motion: Motion

    def cut(self, compared_s: float) -> RunPart:
        """The first so many seconds of it."""
        end_s = self.segment.start_s + compared_s
        whole = end_s >= self.segment.end_s
        return self if whole else replace(self, segment=self.segment.until(end_s))


@dataclass(frozen=True)
class Measure:
    """What each run came to as a whole, over the compared stretch, by group.

    Attributes:
        name: distance_m, mean_speed_m_s, `share of MODE` (of the time), `KIND per min` (events),
            own_ms_per_step (wall time in the controller's own code, of the whole run).
        spread: Over the runs of the group; None where it is not known of all of them.
        different: Whether the group differs from the first by more than like runs do; None where
            that cannot be decided, because both groups are one run each, a figure is missing, or
            more runs are wanted; False where a difference that matters is excluded.
        runs_wanted: So many runs of each group would tell, if they went on like these; None where
            nothing shows that they would.
        interval: The difference of the means lies in it nine times of ten (`analysis.summary`).
    """

    name: str
    spread: list[Spread | None]
    different: list[bool | None]
    runs_wanted: list[int | None]
    interval: list[tuple[float, float] | None]


@dataclass(frozen=True)
class Outcomes:
    """What the runs came to.

    Attributes:
        unknown: Figures that are not known, or not wholly: of which runs, why, and what would
            make them known.
    """

    measures: tuple[Measure, ...]
    unknown: dict[str, str]


def outcomes_of(
    connection: sqlite3.Connection,
    groups: Sequence[Sequence[RunPart]],
    options: EventOptions,
    deadline: Deadline,
    min_effect_sd: float,
) -> Outcomes:
    """What the runs came to: the way, the modes and the events of the compared stretch."""
    found = [[_outcome(connection, part, options, deadline) for part in group] for group in groups]
    runs = [run for group in found for run in group]
    names = dict.fromkeys(name for run in runs for name in run.figures)
    kinds: list[str] = list(dict.fromkeys(kind for run in runs for kind in run.events))
    tests, of_more = _facts(found, list(names), kinds)
    measures = [
        _measure(name, figures, verdicts_on(figures, tests, chance_of, of_more, min_effect_sd))
        for name in names
        for figures in [[[run.figure(name) for run in group] for group in found]]
    ]
    measures += [_counted(kind, found, tests, of_more, min_effect_sd) for kind in kinds]
    return Outcomes(tuple(measures), _not_known(runs))


def _facts(
    groups: Sequence[Sequence[_Outcome]], names: Sequence[str], kinds: Sequence[str]
) -> tuple[int, int]:
    """How many figures can differ by chance, each on its own, and how many if runs are repeated.

    Not those that are the same in all runs, nor counts of too few events (`may_differ`); the
    distance and the mean speed over the same time are one fact, and the last share of the time
    follows from the others.
    """
    runs = [run for group in groups for run in group]
    vary = [name for name in names if _varies([run.figure(name) for run in runs])]
    shares = sum(name.startswith(_SHARE) for name in vary)
    alike = (_SPEED in vary) + (shares > 0)
    kinds = [kind for kind in kinds if len({run.events_of(kind) for run in runs}) > 1]
    counts = [[[run.events_of(kind) or 0 for run in group] for group in groups] for kind in kinds]
    figures, counted = len(vary) - alike, sum(map(may_differ, counts))
    return max(1, figures + counted), max(1, figures + len(kinds))


def _varies(figures: Sequence[float | None]) -> bool:
    """Whether the figures of some runs differ, by more than adding makes of one."""
    known = [figure for figure in figures if figure is not None]
    spread = max(known, default=0.0) - min(known, default=0.0)
    return len(known) < len(figures) or spread > _DUST * max(map(abs, known), default=0.0)


def _measure(
    name: str, groups: Sequence[Sequence[float | None]], verdicts: Sequence[Verdict]
) -> Measure:
    different, wanted, interval = map(list, zip(*verdicts, strict=True))
    return Measure(name, [spread_of(each) for each in groups], different, wanted, interval)


def _counted(
    kind: str,
    groups: Sequence[Sequence[_Outcome]],
    tests: int,
    of_more: int,
    min_effect_sd: float,
) -> Measure:
    """Events per minute; whether they differ is asked of their counts, in stretches of a length."""
    counts = [[run.events_of(kind) for run in group] for group in groups]
    rate = 60 / groups[0][0].duration_s
    per_min = [[None if each is None else each * rate for each in group] for group in counts]
    verdicts = verdicts_on(counts, tests, chance_of_counts, of_more, min_effect_sd)
    scaled = [
        each._replace(interval=each.interval and (each.interval[0] * rate, each.interval[1] * rate))
        for each in verdicts
    ]
    return _measure(f"{kind}{_RATE}", per_min, scaled)


def _not_known(runs: Sequence[_Outcome]) -> dict[str, str]:
    """Why figures are not known: those that share a reason under one key, reasons in one text."""
    alike: dict[tuple[str, str], dict[int, str]] = {}
    for run in runs:
        for name, reasons in run.unknown.items():
            for why in reasons:
                key = (name, _OF_THIS_RUN.sub("", why))
                alike.setdefault(key, {})[run.run_id] = why
    sharing: dict[str, list[str]] = {}
    for (name, _), reasons in alike.items():
        sharing.setdefault(_reason_of_runs(reasons, len(runs)), []).append(name)
    by_reason: dict[str, list[str]] = {}
    for why, names in sharing.items():
        by_reason.setdefault(", ".join(names), []).append(why)
    return {names: "; ".join(reasons) for names, reasons in by_reason.items()}


def _reason_of_runs(reasons: dict[int, str], of: int) -> str:
    """One sentence for runs that share a reason; where their figures differ, those of the first."""
    first, *others = reasons.items()
    if any(why != first[1] for _, why in others):
        return f"{first[1]}; likewise run {', '.join(str(run_id) for run_id, _ in others)}"
    if len(reasons) == of or first[1].startswith(f"run {first[0]} "):
        return first[1]
    return f"run {', '.join(map(str, reasons))}: {first[1]}"


class _Outcome(NamedTuple):
    """What one run came to in the compared stretch.

    Attributes:
        has_mode: Its mode is known: one in which it never was took no time.
        events: How many of each kind.
        unknown: What is not known of it, or not wholly, with why.
        unlooked: Kinds that were not looked for at all, or not in rows that could not be read.
        complete: All rows were looked at.
    """

    run_id: int
    duration_s: float
    figures: dict[str, float | None]
    has_mode: bool
    events: Counter[str]
    unknown: dict[str, tuple[str, ...]]
    unlooked: frozenset[str]
    complete: bool

    def figure(self, name: str) -> float | None:
        """The way, or the share of the time that a mode took."""
        none = 0.0 if name.startswith(_SHARE) and self.has_mode else None
        return self.figures.get(name, none)

    def events_of(self, kind: str) -> int | None:
        """How many events of a kind, where that is known."""
        return self.events[kind] if self.complete and kind not in self.unlooked else None


def _outcome(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> _Outcome:
    run_id, duration_s = part.segment.run_id, part.segment.end_s - part.segment.start_s
    figures: dict[str, float | None] = {}
    own_ms = run_info(connection, run_id).own_ms
    if own_ms is not None:
        figures["own_ms_per_step"] = own_ms
    unknown: dict[str, tuple[str, ...]] = {}
    position = part.motion.position
    if position is None:
        unknown["distance_m, mean_speed_m_s"] = (NAME_POSITION,)
    else:
        read = way_in(read_frame(connection, part.segment, deadline), position)
        is_known = len(read.times) > 1 and not (deadline.passed or read.unread)
        way = read.length if is_known else None
        speed = None if way is None else way.length_m / duration_s
        figures |= {"distance_m": way and way.length_m, _SPEED: speed}
        doubt = OUT_OF_TIME if deadline.passed else "; ".join(map(str, read.unread))
        doubt = doubt or (NO_WAY if way is None else doubt_of_unit(position, speed or 0.0))
        if doubt := doubt or (way and doubt_of_length(way)):
            unknown["distance_m, mean_speed_m_s"] = (doubt,)
    modes, unread = _mode_times(connection, part, deadline)
    if deadline.passed or unread:
        modes = {}
    figures |= {f"{_SHARE}{mode}": seconds / duration_s for mode, seconds in modes.items()}
    if not modes:
        unknown["share of each mode"] = (OUT_OF_TIME if deadline.passed else unread or NO_MODE,)
    found = _events(connection, part, options, deadline)
    verdicts, counts = found.verdicts, Counter(event.kind for event in found.events)
    kinds = sorted(asked_kinds(options), key=lambda kind: not kind.stored)
    counts = {kind.name: counts[kind.name] for kind in kinds}
    if deadline.passed:
        unknown[f"events{_RATE}"] = (OUT_OF_TIME,)
    else:
        unknown |= {f"{kind}{_RATE}": reasons for kind, reasons in verdicts.reasons.items()}
    return _Outcome(
        run_id,
        duration_s,
        figures,
        bool(modes),
        Counter({kind: count for kind, count in counts.items() if count}),
        unknown,
        frozenset(e for e in verdicts.reasons if verdicts.unlooked(e) or verdicts.unread(e)),
        not deadline.passed,
    )


def _mode_times(
    connection: sqlite3.Connection, part: RunPart, deadline: Deadline
) -> tuple[dict[str, float], str]:
    """Seconds in each mode, and what was not read."""
    if part.motion.mode is None:
        return {}, ""
    changes = change_points(connection, part.segment, [part.motion.mode], deadline)
    times = changes.longest_values(part.motion.mode.name, part.segment.end_s)
    return times, "; ".join(map(str, changes.unread))


def _events(
    connection: sqlite3.Connection, part: RunPart, options: EventOptions, deadline: Deadline
) -> Found:
    kinds = tuple(kind.name for kind in asked_kinds(options) if kind.counted)
    whole = TimeRange(part.robot_id, "", (part.segment,), "simulation")
    wanted = replace(options, kinds=kinds)
    return search_events(
        connection, whole, wanted, around=(), group=False, deadline_s=deadline.left_s
    )


# -- `score_run`: what a finished run comes to, by an expression over signals and events -----------


SCORE_DEADLINE_S: Final = 60.0
_STORED: Final = (
    "SELECT count(*) FROM event WHERE run_id = ? AND kind = ? AND sim_time_s >= ? "
    "AND sim_time_s < ?"
)
_STORED_KINDS: Final = "SELECT DISTINCT kind FROM event WHERE run_id = ?"
_BRIDGE_KINDS: Final = ("breakpoint", "pause", "resume", "dropped", "storage")


@dataclass(frozen=True)
class RunScore:
    """What a run came to.

    Attributes:
        value: None where the run does not give one.
        why: Why it does not.
        duration_s: Simulated seconds that were scored.
    """

    run_id: int
    score: str
    value: float | None
    why: str | None
    duration_s: float
    rows: int


@in_one_snapshot
def score_run(
    connection: sqlite3.Connection,
    run_id: int,
    text: str,
    *,
    end_s: float | None = None,
    deadline_s: float = SCORE_DEADLINE_S,
) -> RunScore:
    """Score a run.

    Args:
        connection: Any.
        run_id: The run.
        text: The score; see docs/trials.md.
        end_s: Only what came up to and with this simulation time counts; None for all of it.
        deadline_s: A run that takes longer to read has no score.

    Raises:
        InvalidConditionError: The text is no score.
        UnknownRunError, UnknownSignalError: As they say.
        InvalidInputError: It counts events of a kind that there is not.
    """
    score = parse_score(text)
    run, segment = run_info(connection, run_id), whole_run(connection, run_id)
    subject = Subject(fetch_run(connection, run_id).robot_id, run.robot, run_id)
    require_kinds(connection, score, run_id)
    if segment is None:
        why = f"run {run_id} has no state row: its controller published nothing"
        return RunScore(run_id, score.text, None, why, run.duration_s, 0)
    known = catalogue(connection, subject)
    score.require_known(known)
    noticed_s = fetch_run(connection, run_id).started_sim_time_s
    began_s = 0.0 if run.start_reason == "reset" else noticed_s  # a reset shows a step later
    duration_s = run.duration_s + noticed_s - began_s
    if end_s is not None and end_s < segment.end_s:
        duration_s = end_s - began_s
        segment = segment.through(end_s)
    time_range = TimeRange(subject.robot_id, subject.robot, (segment,), "simulation")
    deadline = Deadline(deadline_s)
    counts = {kind: _count(connection, kind, time_range, deadline) for kind in score.kinds}
    frame = read_frame(connection, segment, deadline, full_rate=False)
    found = Scored(None, f"time limit reached after {len(frame)} rows")
    if frame.cut_at_s is None:
        found = _found(score, frame, known, duration_s, counts)
    return RunScore(run_id, score.text, *found, duration_s, len(frame))


def unseen(connection: sqlite3.Connection, run_ids: Iterable[int | None]) -> list[str]:
    """What was published and is not in scores of these runs, in a sentence for runs that are alike.

    Rows that only a kept stretch has are in none, so that runs are judged by equally many.
    """
    alike: dict[str, list[str]] = {}
    scored = list(filter(None, run_ids))
    for run_id in scored:
        kept = len(kept_parts(connection, run_id, -math.inf, math.inf))
        notes = [unrecorded(connection, run_id)]
        notes += ["rows that only kept stretches have do not count"] if kept else []
        if said := "; ".join(filter(None, notes)):
            alike.setdefault(said, []).append(str(run_id))
    return [
        f"scores: {said}" if len(runs) == len(scored) else f"scores of run {listed(runs)}: {said}"
        for said, runs in alike.items()
    ]


def _found(
    score: Score,
    frame: Frame,
    known: Mapping[str, Signal],
    duration_s: float,
    counts: Mapping[str, int | str],
) -> Scored:
    position = position_in(frame, known)
    try:
        aggregates = [aggregated(each, frame, position) for each in score.aggregates]
    except ConditionFailedError as error:
        return Scored(None, str(error))
    if frame.unread:
        return Scored(None, "; ".join(map(str, frame.unread)))
    return score.of(Facts(duration_s, counts, aggregates))


def require_kinds(connection: sqlite3.Connection, score: Score, run_id: int) -> None:
    """Refuse kinds of events that there are not, as in that run: their count would be 0.

    Raises:
        InvalidInputError: With the kinds that there are.
    """
    stored = [kind for (kind,) in connection.execute(_STORED_KINDS, (run_id,)).fetchall()]
    known = [*kind_names(), *stored, *_BRIDGE_KINDS]
    for kind, column in score.kinds.items():
        if kind not in known:
            offer = ", ".join(nearest_first(kind, list(dict.fromkeys(known)))[:5])
            raise InvalidInputError(
                f"{score.place(column)}: there is no kind of event {kind!r}; there is {offer}"
            )


def _count(
    connection: sqlite3.Connection, kind: str, time_range: TimeRange, deadline: Deadline
) -> int | str:
    if kind not in kind_names():
        (segment,) = time_range.segments
        bounds = (segment.run_id, kind, segment.holds_from_s, segment.holds_to_s)
        return int(connection.execute(_STORED, bounds).fetchone()[0])
    try:
        options = EventOptions(kinds=(kind,))
        found = search_events(
            connection, time_range, options, around=(), group=False, deadline_s=deadline.left_s
        )
    except NothingRecordedError as error:
        return str(error)
    return found.verdicts.not_searched.get(kind) or len(found.events)
