"""`condition`: a condition that the asker gives held, in rows one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.naming import NO_POSITION, Value
from webots_mcp.store.analysis.arrays import Runs, np, runs_of
from webots_mcp.store.conditions_on_arrays import OnArrays, first_failure, position_in
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.kept import kept_parts
from webots_mcp.store.reading.ranges import Segment, recorded_share
from webots_mcp.store.reading.wall_time import frame_of_purged
from webots_mcp.store.signals.catalogue import say_unknown

_MOST_VALUES: Final = 8
_ROWS_BEFORE: Final = 20  # a range: what was there last, for `changed` and `rate`
_SOME_BEFORE: Final = (
    "SELECT min(sim_time_s) FROM (SELECT sim_time_s FROM state WHERE run_id = ? "
    f"AND sim_time_s < ? ORDER BY sim_time_s DESC LIMIT {_ROWS_BEFORE})"
)


def condition_events(search: Search) -> Iterator[Event]:
    """Each stretch in which it held: it would have been hit as often."""
    if search.options.where is None:
        raise NotSearchableError("no condition was given: give where")
    condition = parse_condition(search.options.where)
    _require_known(condition, search)
    if search.recorded is None:
        raise NotSearchableError("nothing was recorded in that range")
    frame = _read(search, search.recorded, condition)
    position = position_in(frame, search.known) if condition.asks_position else None
    first = int(np.searchsorted(frame.times, search.recorded.start_s))
    runs = where_held(condition, frame, position, first)
    read = frame.was_read()[first:]
    search.not_searched("condition", *map(str, frame.unread))
    if frame.unread and not read.any():
        raise NotSearchableError("; ".join(map(str, frame.unread)))
    if frame.cut_at_s is not None:
        then = f"ask again with start_s={frame.cut_at_s:.3f}"
        search.not_searched("condition", f"time limit reached at {frame.cut_at_s:.3f} s: {then}")
    share = recorded_share(search.connection, search.segment.run_id)
    search.ledger.note_of_run(search.segment.run_id, share)
    if not len(runs):
        _require_values(condition, frame, position)
    rows = search.ledger.rows = search.ledger.rows + int(np.count_nonzero(read))
    search.ledger.note_nearest("condition", rows, f"true in none of {rows} rows")
    for run, values in zip(runs.each(), values_at(condition, frame, position, runs), strict=True):
        details = dict(list(values.items())[:_MOST_VALUES])
        yield search.event("condition", run.start_s, run.end_s, condition.text, **details)


def _read(search: Search, segment: Segment, condition: Condition) -> Frame:
    """The rows of a segment, and those before it as far as the condition remembers."""
    run_id, start_s = segment.run_id, segment.start_s
    (known_from_s,) = search.connection.execute(_SOME_BEFORE, (run_id, start_s)).fetchone()
    if (run := frame_of_purged(search.connection, run_id)) is not None:
        place = int(run.places([start_s])[0])
        before = run.rows(place - _ROWS_BEFORE, place)
        known_from_s = before.bounds_s[0] if len(before) else None
    known_from_s = start_s if known_from_s is None else known_from_s
    longer = replace(segment, start_s=min(known_from_s, start_s - condition.remembers_s))
    every_call = bool(kept_parts(search.connection, run_id, longer.start_s, segment.end_s))
    frame = read_frame(search.connection, longer, search.deadline, every_call=every_call)
    if not len(frame) and frame.unread:
        raise NotSearchableError("; ".join(map(str, frame.unread)))
    return frame


def where_held(
    condition: Condition, frame: Frame, position: tuple[str, str] | None, first: int = 0
) -> Runs:
    """Where a condition held in the rows from the first that was asked for on.

    Raises:
        InvalidInputError: The values are not of the kinds that it can be asked of.
    """
    holds, failures = OnArrays(condition.scanned, frame, position).condition(condition.tree)
    if failed := first_failure(failures):
        place = f"in run {frame.run_id}, at {frame.times[failed.row]:.3f} s"
        raise InvalidInputError(f"{failed.why} ({place})")
    return runs_of(holds & frame.was_read() & (np.arange(len(frame)) >= first), frame.times)


def values_at(
    condition: Condition, frame: Frame, position: tuple[str, str] | None, runs: Runs
) -> Iterator[dict[str, Value]]:
    """The signals of a condition in the first row of each run."""
    names = dict.fromkeys([*condition.signals, *(position or ())])
    columns = {name: frame.values_at(name, runs.starts) for name in names}
    return ({name: column[place] for name, column in columns.items()} for place in range(len(runs)))


def _require_known(condition: Condition, search: Search) -> None:
    unknown = [name for name in condition.signals if name not in search.known]
    said = [say_unknown(search.known, name) for name in unknown]
    if said := [*said, *condition.describe_lost(search.known)]:
        raise UnknownSignalError("; ".join(said))


def _require_values(condition: Condition, frame: Frame, position: tuple[str, str] | None) -> None:
    """Of what is never there a condition can ask only whether it is missing."""
    lost = condition.asks_position and position is None
    missing = [name for name in condition.signals if not frame.zones(name).value_count.any()]
    if "missing(" in condition.text or not (lost or missing):
        return
    names = ", ".join(sorted([*missing, *["the position"] * lost]))
    why = f": {NO_POSITION}" if lost else ""
    raise NotSearchableError(f"{names} had no value in any row, so it could not be true{why}")


CONDITION: Final = EventKind(
    "condition",
    "see where",
    condition_events,
    usual=lambda options: options.where is not None,
    lasts=True,
    counted=False,
    alike=Alike(lambda events, unit: "stretches"),
)
