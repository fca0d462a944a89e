"""`condition`: a condition that the asker gives held, in rows one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from webots_mcp.conditions import Condition, parse_condition
from webots_mcp.conditions.compiler import POSITION
from webots_mcp.errors import UnknownSignalError
from webots_mcp.naming import NO_POSITION, Value
from webots_mcp.store.detection.event import Event, EventOptions
from webots_mcp.store.detection.kind import Alike, EventKind, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.reading.held import Held, recorded_share, where_held
from webots_mcp.store.signals.catalogue import say_unknown

_MOST_VALUES: Final = 8


def condition_events(search: Search) -> Iterator[Event]:
    """Each stretch in which it held: it would have been hit as often."""
    if search.options.where is None:
        raise NotSearchableError("no condition was given: give where")
    condition = parse_condition(search.options.where)
    _require_known(condition, search)
    if search.recorded is None:
        raise NotSearchableError("nothing was recorded in that range")
    search.require_rows()
    held = where_held(search.connection, search.recorded, condition, search.deadline)
    if held.cut and held.reached_s is not None:
        then = f"ask again with start_s={held.reached_s:.3f}"
        search.not_searched("condition", f"time limit reached at {held.reached_s:.3f} s: {then}")
    if search.only is None:
        share = recorded_share(search.connection, search.segment.run_id)
        search.ledger.note_of_run(search.segment.run_id, share)
        _require_values(condition, held)
        search.ledger.rows += held.rows
        search.ledger.came_near(
            "condition", search.ledger.rows, f"true in none of {search.ledger.rows} rows"
        )
    for stretch in held.stretches:
        times = (stretch.start_s, stretch.end_s)
        yield search.event("condition", *times, condition.text, **_details(stretch.values))


def _require_known(condition: Condition, search: Search) -> None:
    unknown = [name for name in condition.signals if name not in search.known]
    said = [say_unknown(search.known, name) for name in unknown]
    if said := [*said, *condition.describe_lost(search.known)]:
        raise UnknownSignalError("; ".join(said))


def _require_values(condition: Condition, held: Held) -> None:
    """Of what is never there a condition can ask only whether it is missing."""
    if held.stretches or not held.never_there or "missing(" in condition.text:
        return
    names = ", ".join(sorted(held.never_there))
    why = f": {NO_POSITION}" if POSITION in held.never_there else ""
    raise NotSearchableError(f"{names} had no value in any row, so it could not be true{why}")


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
    alike=Alike(lambda events, unit: "stretches"),
    effort=4,
)
