"""`silent`: a signal that had a value has none."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.naming import LONGEST_SPREAD_ARRAY, listed
from webots_mcp.store.analysis.summary import Summary
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.resting import replaced_value
from webots_mcp.store.detection.search import MOST_NAMED, Search
from webots_mcp.store.reading.intervals import MOSTLY, Silent, Span, common
from webots_mcp.store.rollup.tables import watermark
from webots_mcp.store.signals.catalogue import other_form
from webots_mcp.store.signals.registry import Signal

MANY_SILENCES: Final = 10  # of a signal that mostly has no value: it comes so by nature
_INDEX: Final = re.compile(r"\.\d+$")  # items that fall silent at once are reported as the array

# Whether it had a value before, in the rollups or in rows that are not rolled up yet.
_HAD_VALUE: Final = (
    "SELECT EXISTS (SELECT 1 FROM all_rollup WHERE run_id = :run AND signal_id = :signal "
    "AND first_sim_time_s < :before) OR EXISTS (SELECT 1 FROM state WHERE id > :mark "
    "AND +run_id = :run AND sim_time_s < :before AND json_extract(data, :path) IS NOT NULL)"
)
_TYPES_AT: Final = (  # of the array, and of the item in it
    "SELECT json_type(data, ?), json_type(data, ?) FROM state WHERE run_id = ? "
    "AND sim_time_s >= ? ORDER BY sim_time_s, id LIMIT 1"
)


def silent_events(search: Search) -> Iterator[Event]:
    """It has begun, and lasts to the signal's next value, if any."""
    shorter: Counter[str] = Counter()
    asked = search.asked or search.segment
    for index, signal in enumerate(search.required_numbers()):
        here = search.view.summary(signal)
        if here.present == here.rows:
            continue
        if search.is_over("silent", search.numbers[index:]):
            break
        spans = [
            span
            for span in _without_value(search, signal)
            if _has_begun(search, signal, span) and not _is_shorter(search, signal, span)
        ]
        least_s = _least_silence_s(search, signal, here, spans)
        short = 0
        for span in spans:
            lasts_s = span.end_s - span.start_s
            if lasts_s >= least_s:
                instead = replaced_value(search, signal, span.start_s)
                details = {**span.how_exact, **({"value": instead} if instead else {})}
                yield search.event("silent", span.start_s, span.end_s, signal.name, **details)
            elif lasts_s > 0:
                what = f"{signal.name} had no value for {lasts_s:.3g} s from {span.start_s:.6g} s"
                search.came_near("silent", lasts_s / least_s, what)
                short += span.start_s < asked.end_s and span.end_s >= asked.start_s
        if short and least_s == search.options.silent_s:
            array = _INDEX.sub(".*", signal.name)
            shorter[array] = max(short, shorter[array])
    if shorter:
        counts = [
            f"{name} {count} time{'s' * (count > 1)}" for name, count in shorter.most_common()
        ]
        limit = f"for less than silent_s={search.options.silent_s:g} s"
        note = f"without a value {limit}, so not counted as silent: {listed(counts, MOST_NAMED)}"
        search.ledger.note_of_run(search.segment.run_id, note)


def _without_value(search: Search, signal: Signal) -> list[Span]:
    """Where neither the signal has a value nor its array in its other form, long or short."""
    spans = search.view.spans(signal, Silent())
    other = other_form(search.known, signal)
    if other is None or not spans:
        return spans
    return list(common(spans, search.view.spans(other, Silent())))


def _has_begun(search: Search, signal: Signal, span: Span) -> bool:
    """What had no value before its first one was not there yet; that is no silence."""
    if span.start_s <= search.began_s or signal.kind == "null":
        return False
    if not span.from_first:
        return True
    other = other_form(search.known, signal)
    return any(_had_value(search, each, span.start_s) for each in (signal, other) if each)


def _had_value(search: Search, signal: Signal, at_s: float) -> bool:
    run_id = search.segment.run_id
    asked = {"run": run_id, "signal": signal.id, "before": at_s, "path": signal.path}
    asked["mark"] = watermark(search.connection, run_id)
    return bool(search.connection.execute(_HAD_VALUE, asked).fetchone()[0])


def _is_shorter(search: Search, signal: Signal, span: Span) -> bool:
    """Whether the array was there when it began, but so short or long that it has no such item.

    A long one is reduced; whose items are all replaced (a lidar that sees nothing) has no number.
    """
    array = signal.path if signal.reduce else signal.path.rpartition("[")[0]
    if not array:
        return False
    item = f"{array}[{LONGEST_SPREAD_ARRAY}]" if signal.reduce else signal.path
    asked = (array, item, search.segment.run_id, span.start_s)
    types = search.connection.execute(_TYPES_AT, asked).fetchone()
    return types is not None and types[0] == "array" and types[1] != "null"


def _least_silence_s(search: Search, signal: Signal, here: Summary, spans: Sequence[Span]) -> float:
    """Longer for an intermittent signal: three times its usual interval between values."""
    least_s = search.options.silent_s
    lengths = sorted(span.end_s - span.start_s for span in spans)
    if here.present >= MOSTLY * here.rows or len(lengths) < MANY_SILENCES:
        return least_s
    usual_s = lengths[len(lengths) // 2]
    if 3 * usual_s <= least_s:
        return least_s
    search.ledger.notes.append(
        f"{signal.name} is intermittent (a value about every {usual_s:.3g} s): it counts as silent "
        f"after {3 * usual_s:.3g} s"
    )
    return 3 * usual_s


SILENT: Final = EventKind(
    "silent",
    "no value",
    silent_events,
    lasts=True,
    least_s=lambda options: options.silent_s,
    of_numbers=True,
    drawn=2,
    alike=Alike(lambda events, unit: "stretches without a value", of_arrays=True),
)
