"""Items of long arrays that stay without a value: a part of a lidar that gives NaN.

A long array is recorded as a whole, and its items are no signals of their own. A sample of rows
shows which of them are NaN from a moment on; the rows around that moment show when it was.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple, cast

from webots_mcp.analysis.arrays import Flags, np
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.search import Search
from webots_mcp.store.chunks import parse

LEAST_SHARE: Final = 0.05  # of an array's items
_SAMPLED_ROWS: Final = 50
_FAULTY: Final = "nan"  # what a device gives that has no value; inf is a range without an end
_ROWS: Final = "SELECT id, data, replaced FROM state WHERE id IN ({marks})"


class _Silence(NamedTuple):
    """Items of an array that are NaN from a row of the frame on."""

    row: int
    items: int
    total: int


def missing_item_events(search: Search, kind: str) -> Iterator[Event]:
    """Of each long array with items that are NaN from a row up to the last one.

    Args:
        search: Where it is looked.
        kind: The kind of the events.
    """
    frame = search.frame
    asked = {each.name.rpartition(".")[0] for each in search.signals}
    arrays = [
        name
        for each in search.known.values()
        if each.reduction == "count" and (name := each.name.rpartition(".")[0]) in asked
    ]
    if not arrays or len(frame) < 2:
        return
    rows = np.unique(np.linspace(0, len(frame) - 1, _SAMPLED_ROWS).astype(np.intp)).tolist()
    states = _states_of(search, rows)
    for name in arrays:
        found = _silence_in(search, name, rows, states)
        if found is None:
            continue
        start_s, end_s = float(frame.times[found.row]), float(frame.times[-1])
        if end_s - start_s >= search.options.missing_s:
            details = {"value": _FAULTY, "items": found.items, "of_items": found.total}
            yield search.event(kind, start_s, end_s, name, **details)


_State = tuple[dict[str, Any], dict[str, Any]]


def _states_of(search: Search, rows: Sequence[int]) -> dict[int, _State]:
    """The states of some rows as they were recorded, and what was replaced in them."""
    by_id = {int(search.frame.ids[row]): row for row in rows}
    marks = ", ".join("?" * len(by_id))
    stored = search.connection.execute(_ROWS.format(marks=marks), [*by_id]).fetchall()
    return {
        by_id[state_id]: (parse(data), json.loads(replaced or "{}"))
        for state_id, data, replaced in stored
    }


def _silence_in(
    search: Search, name: str, rows: Sequence[int], states: dict[int, _State]
) -> _Silence | None:
    """Which items of an array are NaN up to the last row, and from which row on."""
    items = {row: _nan_items(*states[row], name) for row in rows if row in states}
    held = [row for row in rows if row in items and len(items[row])]
    if len(held) < 2 or len({len(items[row]) for row in held}) > 1 or held[-1] != rows[-1]:
        return None
    total = len(items[held[0]])
    is_nan: Flags = np.array([items[row] for row in held])
    lasting = np.logical_and.accumulate(is_nan[::-1], axis=0)[::-1]  # from there to the end
    counts = np.count_nonzero(lasting, axis=1)
    enough = np.flatnonzero(counts >= max(1.0, LEAST_SHARE * total))
    if not len(enough):
        return None
    first = int(enough[0])
    silent: Flags = lasting[first]
    row = held[first]
    before = held[first - 1] if first else row
    while row - before > 1:  # all of them became silent at once, or at least by then
        middle = (before + row) // 2
        states_there = _states_of(search, [middle])
        there = _nan_items(*states_there[middle], name) if states_there else []
        if len(there) == total and np.array(there)[silent].all():
            row = middle
        else:
            before = middle
    return _Silence(row, int(np.count_nonzero(silent)), total)


def _nan_items(state: dict[str, Any], replaced: dict[str, Any], name: str) -> list[bool]:
    """Of each item of an array whether it is NaN; nothing where there is no array."""
    value: Any = state
    for key in name.split("."):
        value = cast("dict[str, Any]", value).get(key) if isinstance(value, dict) else None
    if not isinstance(value, list):
        return []
    items = cast("list[Any]", value)
    if (kind := replaced.get(f"{name}.*")) is not None:  # of each null in it
        return [kind == _FAULTY and item is None for item in items]
    return [
        item is None and replaced.get(f"{name}.{at}") == _FAULTY for at, item in enumerate(items)
    ]
