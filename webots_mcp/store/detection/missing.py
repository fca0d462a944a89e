"""`missing`: a signal that had a value has none."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Final

from webots_mcp.naming import listed
from webots_mcp.store.analysis.arrays import MOSTLY, Flags, Runs, np, runs_of
from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import Alike, EventKind
from webots_mcp.store.detection.search import MOST_NAMED, Search
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.signals.catalogue import other_form
from webots_mcp.store.signals.registry import Signal

MANY_SILENCES: Final = 10  # of a signal that mostly has no value: it comes so by nature
_INDEX: Final = re.compile(r"\.\d+$")  # items that go missing at once are reported as the array


def missing_events(search: Search) -> Iterator[Event]:
    """It has begun, and lasts to the signal's next value, if any."""
    shorter: Counter[str] = Counter()
    for signal in search.in_time("missing", search.required_numbers(), judged=False):
        runs = _silences(search, signal)
        if not len(runs):
            continue
        least_s = _least_silence_s(search, signal, runs)
        for run in runs.only(runs.durations_s >= least_s).each():
            replaced = search.frame.rows(run.start, run.start + 1).replaced(signal.name)
            details = {"value": next(iter(replaced))} if replaced else {}
            yield search.event("missing", run.start_s, run.end_s, signal.name, **details)
        short = runs.only((runs.durations_s > 0) & (runs.durations_s < least_s))
        if len(short):
            longest = max(short.each(), key=lambda run: run.duration_s)
            span = f"for {longest.duration_s:.3g} s from {longest.start_s:.6g} s"
            share = longest.duration_s / least_s
            search.note_nearest("missing", share, f"{signal.name} had no value {span}")
        if least_s == search.options.missing_s:
            asked, array = search.asked or search.segment, _INDEX.sub(".*", signal.name)
            inside = (short.starts_s < asked.end_s) & (short.ends_s >= asked.start_s)
            shorter[array] = max(int(np.count_nonzero(inside)), shorter[array])
    if counts := (+shorter).most_common():
        times = [f"{name} {count} time{'s' * (count > 1)}" for name, count in counts]
        limit = f"for less than missing_s={search.options.missing_s:g} s"
        note = f"without a value {limit}, so not counted as missing: {listed(times, MOST_NAMED)}"
        search.ledger.note_of_run(search.segment.run_id, note)


def _silences(search: Search, signal: Signal) -> Runs:
    """Where neither the signal has a value nor its array in its other form, long or short."""
    frame, other = search.frame, other_form(search.known, signal)
    signals = [each for each in (signal, other) if each]
    missing = [rows_without_value(frame, each.name) for each in signals]
    lacking = [each for each in missing if each is not None]
    if len(lacking) < len(missing):
        return runs_of(np.zeros(0, np.bool_), frame.times)
    runs = runs_of(np.all(lacking, axis=0), frame.times)
    return runs.only(_have_begun(search, signals, runs) & ~_are_shorter(search, signal, runs))


def rows_without_value(frame: Frame, name: str) -> Flags | None:
    """The rows that have no value of a signal; None where all have one, by the statistics."""
    zones = frame.zones(name)
    is_lacking = zones.value_count < zones.row_count
    if not is_lacking.any():
        return None
    lacks = np.repeat(zones.held_count == 0, zones.row_count)
    for start, stop in zones.spans(is_lacking & (zones.held_count > 0)):
        part = frame.rows(start, stop)
        lacks[start:stop] = np.isnan(part.numbers(name)) & (part.texts(name).codes == 0)
    return lacks


def _have_begun(search: Search, signals: Sequence[Signal], runs: Runs) -> Flags:
    """What had no value before its first one was not there yet; that is no silence."""
    begun = (runs.starts_s > search.began_s) & (signals[0].kind != "null")
    if len(runs) and begun[0] and runs.starts[0] == 0:
        before = search.whole.between(search.began_s, float(runs.starts_s[0]))
        begun[0] = any(before.zones(each.name).value_count.any() for each in signals)
    return begun


def _are_shorter(search: Search, signal: Signal, runs: Runs) -> Flags:
    """Whether the array was there when it began, but so short or long that it has no such item.

    A long one is reduced; whose items are all replaced (a lidar that sees nothing) has no number.
    """
    if not len(runs) or not (signal.reduction or signal.path.endswith("]")):
        return np.zeros(len(runs), np.bool_)
    frame, array = search.frame, signal.name.rpartition(".")[0]
    others = frame.held(f"{array}.0") | frame.held(f"{array}.count")
    return others[runs.starts] & ~frame.held(signal.name)[runs.starts]


def _least_silence_s(search: Search, signal: Signal, runs: Runs) -> float:
    """Longer for an intermittent signal: three times its usual interval between values."""
    least_s = search.options.missing_s
    zones = search.frame.zones(signal.name)
    is_usual = zones.value_count.sum() >= MOSTLY * zones.row_count.sum()
    if is_usual or len(runs) < MANY_SILENCES:
        return least_s
    usual_s = float(np.sort(runs.durations_s)[len(runs) // 2])
    if 3 * usual_s <= least_s:
        return least_s
    rarely = f"{signal.name} is intermittent (a value about every {usual_s:.3g} s)"
    search.ledger.notes.append(f"{rarely}: it counts as missing after {3 * usual_s:.3g} s")
    return 3 * usual_s


MISSING: Final = EventKind(
    "missing",
    "no value",
    missing_events,
    lasts=True,
    least_s=lambda options: options.missing_s,
    of_numbers=True,
    drawn=2,
    alike=Alike(lambda events, unit: "stretches without a value", of_arrays=True),
)
