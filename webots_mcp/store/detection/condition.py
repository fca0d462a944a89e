"""`condition`: a condition that the asker gives held, in rows one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.errors import UnknownSignalError
from webots_mcp.naming import Value
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.held import recorded_share, where_held

_MOST_VALUES: Final = 8


def condition_events(search: Search) -> Iterator[Event]:
    """Each stretch in which it held: it would have been hit as often."""
    if search.options.where is None:
        raise NotSearchableError("no condition was given: give where")
    condition = parse_condition(search.options.where)
    _require_known(condition, search)
    if search.recorded is None:
        raise NotSearchableError("nothing was recorded in that range")
    held = where_held(search.connection, search.recorded, condition, search.deadline)
    if held.cut and held.reached_s is not None:
        then = f"ask again with start_s={held.reached_s:.3f}"
        search.not_searched("condition", f"the time was over at {held.reached_s:.3f} s: {then}")
    if search.only is None:
        search.ledger.notes.append(recorded_share(search.connection, search.segment.run_id))
        search.came_near("condition", 0.0, f"it held in none of {held.rows} rows")
    for stretch in held.stretches:
        times = (stretch.start_s, stretch.end_s)
        yield search.event("condition", *times, condition.text, **_details(stretch.values))


def _require_known(condition: Condition, search: Search) -> None:
    unknown = condition.nearest_to_unknown(search.known)
    said = [f"no signal {name!r} is recorded; there is {near}" for name, near in unknown]
    if said := [*said, *condition.describe_lost(search.known)]:
        raise UnknownSignalError("; ".join(said))


def _details(values: dict[str, Value]) -> dict[str, Any]:
    return dict(list(values.items())[:_MOST_VALUES])


def _is_given(options: EventOptions) -> bool:
    return options.where is not None


CONDITION: Final = EventKind(
    "condition",
    "see where",
    condition_events,
    usual=_is_given,
    lasts=True,
    counted=False,
)
