"""The moment that a clip is about: an event, a simulation time, or the newest incident of a run."""

from __future__ import annotations

import json
import sqlite3
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import INSPECTION_EVENT, KEEP_AFTER_S
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.detection.stored_events import HITS
from webots_mcp.signals.naming import spelled_out
from webots_mcp.store.reading.ranges import recorded_bounds
from webots_mcp.store.reading.segment import newest_kept, shown_time
from webots_mcp.store.run_rows import RunRecord, camera_frame_bounds

# Those that say that something went wrong, or that somebody waited for it.
_INCIDENTS: Final = (*HITS, INSPECTION_EVENT)
_COLUMNS: Final = "run_id, sim_time_s, kind, name, data"
_LONGEST_NAME: Final = 60
_NAMED_EVENTS: Final = 5


class Moment(NamedTuple):
    """A moment of a run.

    Attributes:
        what: What happened then, in a few words; empty where only the time is known.
        signals: Those that the event is about.
    """

    run_id: int
    at_s: float
    what: str = ""
    signals: tuple[str, ...] = ()


def moment_of_event(connection: sqlite3.Connection, event_id: int) -> Moment:
    """Return the moment of a stored event.

    Raises:
        InvalidInputError: There is no such event.
    """
    row = connection.execute(f"SELECT {_COLUMNS} FROM event WHERE id = ?", (event_id,)).fetchone()
    if row is None:
        newest = connection.execute(
            "SELECT id, kind, name, run_id, sim_time_s FROM event WHERE kind IN (?, ?, ?) "
            "ORDER BY id DESC LIMIT ?",
            (*_INCIDENTS, _NAMED_EVENTS),
        ).fetchall()
        known = [
            f"{number} ({_event_text(kind, name)} at {time_s:.3f} s of run {run_id})"
            for number, kind, name, run_id, time_s in newest
        ]
        raise InvalidInputError(
            f"No event {event_id} is stored. webots_find_events gives an event_id only to what the "
            "bridge stored; of what it finds in values, give start_s as at_s. "
            + (f"Newest stored events: {', '.join(known)}." if known else "None is stored.")
        )
    return _moment(*row)


def moment_at(connection: sqlite3.Connection, run: RunRecord, at_s: float) -> Moment:
    """Return a moment of a run, to the millisecond that answers show.

    Raises:
        InvalidInputError: The time is not in the run.
    """
    first_s, last_s = span_of(connection, run)
    if not shown_time(first_s) - 0.001 <= at_s <= shown_time(last_s) + 0.001:
        raise InvalidInputError(
            f"at_s={at_s:g} is not in run {run.id}, which was recorded from {first_s:.3f} to "
            f"{last_s:.3f} s. Give a time in between, or another run_id."
        )
    return Moment(run.id, min(max(at_s, first_s), last_s))


def newest_moment(connection: sqlite3.Connection, run: RunRecord) -> Moment:
    """Return the newest incident of a run; without any, its last recorded moment."""
    row = connection.execute(
        f"SELECT {_COLUMNS} FROM event WHERE run_id = ? AND kind IN (?, ?, ?) "
        "ORDER BY sim_time_s DESC, kind = ?, id DESC LIMIT 1",
        (run.id, *_INCIDENTS, INSPECTION_EVENT),  # which accompanies a hit
    ).fetchone()
    if row is not None:
        return _moment(*row)
    kept = newest_kept(connection, run.id)
    _, last_s = span_of(connection, run)
    if kept is not None:
        hit_s = max(kept.start_s, kept.end_s - KEEP_AFTER_S)
        return Moment(run.id, min(hit_s, last_s), f"kept: {_cut(kept.reason)}")
    return Moment(run.id, last_s, "the end of the recording")


def span_of(connection: sqlite3.Connection, run: RunRecord) -> tuple[float, float]:
    """Return the first and the last simulation time of a run of which anything was recorded.

    Raises:
        NothingRecordedError: There is neither a row nor a picture of it.
    """
    known = [
        each
        for each in (recorded_bounds(connection, run.id), camera_frame_bounds(connection, run.id))
        if each is not None
    ]
    if not known:
        raise NothingRecordedError(
            f"Run {run.id} has no state and no picture, so there is nothing to show. "
            "webots_list_runs lists the runs with their rows."
        )
    return min(each[0] for each in known), max(each[1] for each in known)


def _moment(run_id: int, at_s: float, kind: str, name: str | None, data: str | None) -> Moment:
    """Return the moment of an event; a breakpoint stores the values of its condition's signals."""
    try:
        values = json.loads(data or "{}").get("values")
    except (ValueError, AttributeError):
        values = None
    names = tuple(map(str, cast("dict[str, Any]", values))) if isinstance(values, dict) else ()
    return Moment(run_id, float(at_s), _event_text(kind, name), names)


def _event_text(kind: str, name: str | None) -> str:
    return f"{kind} {_cut(name)}" if name else str(kind)


def _cut(text: str) -> str:
    line = " ".join(spelled_out(str(text)).split())
    return line if len(line) <= _LONGEST_NAME else f"{line[: _LONGEST_NAME - 1]}…"
