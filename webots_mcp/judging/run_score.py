"""The score of a run, as trials and comparisons rank by it."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

from webots_mcp.errors import ConditionFailedError, InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.condition import aggregated, position_in
from webots_mcp.judging.detection.event_kinds import kind_names
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import search_events
from webots_mcp.signals.conditions.scoring import Facts, Score, Scored, parse_score
from webots_mcp.signals.naming import listed, nearest_first
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import TimeRange, unrecorded, whole_run
from webots_mcp.store.reading.segment import (
    Deadline,
    Subject,
    full_rate_parts,
    in_one_snapshot,
    just_after,
)
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import run_info

SCORE_DEADLINE_S: Final = 60.0


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
    start_s: float | None = None,
    end_s: float | None = None,
    deadline_s: float = SCORE_DEADLINE_S,
) -> RunScore:
    """Score a run.

    Args:
        connection: Any.
        run_id: The run.
        text: The score; see 'webots-mcp help trials'.
        start_s: Only what came after this simulation time counts; None for all of it.
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
    if start_s is not None:
        duration_s -= start_s - began_s
        segment = replace(segment, start_s=just_after(start_s), open_start=False)
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
        kept = len(full_rate_parts(connection, run_id, -math.inf, math.inf))
        notes = [unrecorded(connection, run_id)]
        notes += ["rows that only full-rate segments have do not count"] if kept else []
        if said := "; ".join(filter(None, notes)):
            alike.setdefault(said, []).append(str(run_id))
    return [
        f"scores: {said}" if len(runs) == len(scored) else f"scores of run {listed(runs)}: {said}"
        for said, runs in alike.items()
    ]


def _found(
    score: Score,
    frame: Frame,
    known: Mapping[str, RegisteredSignal],
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
    stored = [
        kind
        for (kind,) in connection.execute(
            "SELECT DISTINCT kind FROM event WHERE run_id = ?", (run_id,)
        ).fetchall()
    ]
    known = [*kind_names(), *stored, *("breakpoint", "pause", "resume", "dropped", "storage")]
    for kind, column in score.kinds.items():
        if kind not in known:
            offer = ", ".join(nearest_first(kind, list(dict.fromkeys(known)))[:5])
            raise InvalidInputError(
                f"{score.place(column)}: unknown kind of event {kind!r}. Kinds, the "
                f"nearest first: {offer}"
            )


def _count(
    connection: sqlite3.Connection, kind: str, time_range: TimeRange, deadline: Deadline
) -> int | str:
    if kind not in kind_names():
        (segment,) = time_range.segments
        bounds = (segment.run_id, kind, segment.holds_from_s, segment.holds_to_s)
        return int(
            connection.execute(
                "SELECT count(*) FROM event WHERE run_id = ? AND kind = ? AND sim_time_s >= ? "
                "AND sim_time_s < ?",
                bounds,
            ).fetchone()[0]
        )
    try:
        options = EventOptions(kinds=(kind,))
        found = search_events(
            connection, time_range, options, around=(), group=False, deadline_s=deadline.left_s
        )
    except NothingRecordedError as error:
        return str(error)
    return found.verdicts.not_searched.get(kind) or len(found.events)
