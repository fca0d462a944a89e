"""Conditions over the past: where one that the asker gives held, and what scores are made of.

The kinds `condition` and `violation`, and the tree of a condition asked of arrays.
"""

from __future__ import annotations

import ast
import math
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import starmap
from typing import Any, Final, NamedTuple, cast

from webots_mcp.analysis.arrays import (
    Array,
    Flags,
    Gap,
    Indexes,
    RowSpan,
    Runs,
    find_gaps,
    median,
    no_runs,
    np,
    runs_of,
    weighted_mean,
)
from webots_mcp.analysis.summary import LARGEST
from webots_mcp.database.stored_breakpoints import EXPECTED, OF_PROJECT, VIOLATION
from webots_mcp.errors import (
    ConditionFailedError,
    InvalidConditionError,
    InvalidInputError,
    UnknownSignalError,
)
from webots_mcp.judging.detection.event import (
    Alike,
    Event,
    NotAskedError,
    NotSearchableError,
)
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.signals.conditions import Condition, Evaluator, parse_condition
from webots_mcp.signals.conditions.compiler import Compiler
from webots_mcp.signals.conditions.expectation import Expectation, parse_expectation
from webots_mcp.signals.conditions.functions import (
    ARITHMETIC,
    COMPARISONS,
    PLACES_KEPT,
    SAME_TIME_S,
)
from webots_mcp.signals.conditions.scoring import Aggregate
from webots_mcp.signals.conditions.syntax import FLAGS, Nodes, Scanned, function_of, is_signal
from webots_mcp.signals.naming import (
    FARTHEST_M,
    NO_POSITION,
    Value,
    counted,
    find_position,
    metres_in,
)
from webots_mcp.store.reading.catalogue import item_signal, resolve_signals, say_unknown
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.ranges import recorded_share
from webots_mcp.store.reading.segment import Segment, full_rate_parts, just_after
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.signal_history import WEIGHTED

_MOST_VALUES: Final = 8
_MOST_IN_ALL: Final = 4  # numbers whose figures over all times are given
_ROWS_BEFORE: Final = 20  # a range: what was there last, for `changed` and `rate`
_FOLDING: Final = {"min": "minimum", "max": "maximum"}
_MIRRORED: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE,
    ast.Eq: ast.Eq, ast.NotEq: ast.NotEq,
}  # fmt: skip
NONE_EXPECTED: Final = (
    "nothing is expected of this run: bridge.expect(...), webots-mcp.toml, or "
    "webots_check_run(expect=[...])"
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
    first = int(frame.places([search.recorded.start_s])[0])
    runs = where_held(condition, frame, position, first)
    read = frame.was_read()[first:]
    search.not_searched("condition", *map(str, frame.unread))
    if frame.unread and not read.any():
        raise NotSearchableError("; ".join(map(str, frame.unread)))
    if frame.cut_at_s is not None:
        then = f"ask again with start_s={frame.cut_at_s:.3f}"
        search.not_searched("condition", f"time limit reached at {frame.cut_at_s:.3f} s: {then}")
    share = recorded_share(search.connection, search.segment.run_id)
    search.coverage.note_of_run(search.segment.run_id, share)
    if not len(runs):
        _require_values(condition, frame, position)
    rows = search.coverage.rows = search.coverage.rows + int(np.count_nonzero(read))
    never = f"{condition.text!r} was true in none of {rows} rows"
    nearest = _nearest(condition, frame, position, first)
    search.coverage.note_nearest("condition", rows, f"{never}{nearest}")
    also, gaps = _also_asked(search, condition), find_gaps(frame.times) if len(runs) else ()
    if len(runs):
        in_all = _figures_in_all(frame, [*condition.signals, *also], runs, gaps)
        search.coverage.notes.append(WEIGHTED)
        search.coverage.note_of_run(search.segment.run_id, in_all)
    for run, values in zip(runs.spans(), values_at(condition, frame, position, runs), strict=True):
        details = dict(list(values.items())[:_MOST_VALUES])
        details |= _extremes_in(frame, [*values, *also], run)
        details |= _when_true(condition, frame, position, run)
        if missing_s := _not_recorded_s(gaps, run):
            details["not_recorded_s"] = round(missing_s, 3)
        yield search.event("condition", run.start_s, run.end_s, condition.text, **details)


def _nearest(
    condition: Condition, frame: Frame, position: tuple[str, str] | None, first: int
) -> str:
    """The value that came nearest to what a comparison of one value with a number asks for."""
    rows = frame.was_read() & (np.arange(len(frame)) >= first)
    tree = condition.tree.elts[0] if isinstance(condition.tree, ast.Tuple) else condition.tree
    found = _worst(condition, frame, position, rows, tree, nearest=True)
    if found is None:
        return ""
    name, value, time_s = found
    return f"; nearest: {name} {value:.4g} at {time_s:.6g} s"


def _when_true(
    condition: Condition, frame: Frame, position: tuple[str, str] | None, run: RowSpan
) -> dict[str, float]:
    """Of what has to hold for some time: from when it was true, and when it had held so long."""
    if not isinstance(condition.tree, ast.Tuple):
        return {}
    inner = holds_in(condition.scanned, condition.tree.elts[0], frame, position)
    before = np.flatnonzero(~inner[: run.start])
    begin = int(before[-1]) + 1 if len(before) else 0
    return {
        "true_from_s": round(float(frame.times[begin]), 3), "fulfilled_s": round(run.start_s, 3),
    }  # fmt: skip


def _not_recorded_s(gaps: Sequence[Gap], run: RowSpan) -> float:
    """For how long no row was recorded in a stretch: nobody knows whether it held."""
    inside = (each for each in gaps if each.start_s >= run.start_s and each.end_s <= run.end_s)
    return sum(each.end_s - each.start_s for each in inside)


def _also_asked(search: Search, condition: Condition) -> list[str]:
    """The numbers that were named next to a condition: what they were while it held is wanted."""
    if tuple(search.options.signals) == ("*",):
        return []
    named = resolve_signals(search.known, search.options.signals)
    return [e.name for e in named if e.is_number and e.name not in condition.signals]


def _extremes_in(frame: Frame, names: Sequence[str], run: RowSpan) -> dict[str, Any]:
    """The mean, minimum and maximum of each number while a condition held once."""
    found: dict[str, Any] = {}
    part = frame.rows(run.start, run.stop)
    for name in names:
        if len(found) >= _MOST_VALUES or name not in frame:
            continue
        numbers = part.usable(name)[1]
        if len(numbers) > 1 and numbers.min() < numbers.max():
            found[f"{name} meanwhile"] = _figures_of(numbers, part.usable_weights(name))
    return found


def _figures_in_all(frame: Frame, names: Sequence[str], runs: Runs, gaps: Sequence[Gap]) -> str:
    """What numbers came to in all the rows in which a condition held, in words."""
    held: Flags = np.zeros(len(frame), np.bool_)
    for start, stop in zip(runs.starts.tolist(), runs.stops.tolist(), strict=True):
        held[start:stop] = True
    lasted_s = float((np.append(np.diff(frame.times), 0.0))[held].sum())
    missing_s = sum(_not_recorded_s(gaps, run) for run in runs.spans()) if gaps else 0.0
    lasted_s -= missing_s
    said = [f"true in {counted(int(np.count_nonzero(held)), 'row')}, {lasted_s:.4g} s"]
    for name in names:
        if len(said) > _MOST_IN_ALL or name not in frame:
            continue
        numbers = frame.numbers(name)
        rows = held & (np.abs(numbers) <= LARGEST)
        if rows.any():
            weights = None if frame.weights is None else frame.weights[rows]
            of = _figures_of(numbers[rows], weights)
            said.append(f"{name} mean {of['mean']:g}, min {of['min']:g}, max {of['max']:g}")
    said += [f"{missing_s:.4g} s in between were not recorded"] * bool(missing_s)
    return "; ".join(said)


def _figures_of(numbers: Array, weights: Array | None) -> dict[str, float]:
    mean = weighted_mean(numbers, weights)
    figures = {"mean": mean, "min": numbers.min(), "max": numbers.max()}
    return {each: float(f"{figure:.6g}") for each, figure in figures.items()}


def _read(search: Search, segment: Segment, condition: Condition) -> Frame:
    """The rows of a segment, and those before it as far as the condition remembers."""
    run_id, start_s = segment.run_id, segment.start_s
    place = int(search.whole.places([start_s])[0])
    before = search.whole.rows(place - _ROWS_BEFORE, place)
    known_from_s = before.bounds_s[0] if len(before) else start_s
    longer = replace(segment, start_s=min(known_from_s, start_s - condition.remembers_s))
    every_call = bool(full_rate_parts(search.connection, run_id, longer.start_s, segment.end_s))
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
    try:
        holds = holds_in(condition.scanned, condition.tree, frame, position)
    except ConditionFailedError as error:
        raise InvalidInputError(str(error)) from error
    if not holds[first:].any():
        return no_runs()
    return runs_of(holds & frame.was_read() & (np.arange(len(frame)) >= first), frame.times)


def values_at(
    condition: Condition, frame: Frame, position: tuple[str, str] | None, runs: Runs
) -> Iterator[dict[str, Value]]:
    """The signals of a condition in the first row of each run."""
    names = dict.fromkeys([*condition.signals, *(position or ())])
    columns = {name: frame.values_at(name, runs.starts) for name in names}
    return ({name: column[place] for name, column in columns.items()} for place in range(len(runs)))


def _require_known(condition: Condition, search: Search) -> None:
    known = search.known
    unknown = [e for e in condition.signals if e not in known and item_signal(known, e) is None]
    said = [
        f"{condition.quoted_text(name)}. {say_unknown(known, name)}"
        if condition.quoted_text(name)
        else say_unknown(known, name)
        for name in unknown
    ]
    if said := [*said, *condition.describe_lost(search.known)]:
        raise UnknownSignalError("; ".join(said))


def _require_values(condition: Condition, frame: Frame, position: tuple[str, str] | None) -> None:
    """Of what is never there a condition can ask only whether it is missing."""
    lost = condition.asks_position and position is None
    missing = [name for name in condition.signals if not frame.zone_map(name).value_count.any()]
    if "missing(" in condition.text or not (lost or missing):
        return
    names = ", ".join(sorted([*missing, *["the position"] * lost]))
    why = f": {NO_POSITION}" if lost else ""
    raise NotSearchableError(f"{names} had no value in any row, so it could not be true{why}")


CONDITION: Final = EventKind(
    "condition",
    "`where` holds",
    condition_events,
    usual=lambda options: options.where is not None,
    lasts=True,
    counted=False,
    alike=Alike(lambda events, unit: "stretches"),
    severity=85,
)


# -- the parsed tree asked of all rows at once -----------------------------------------------------
#
# In each row the outcome is that of the closures that the controller asks of each state; see
# 'webots-mcp help conditions'. A value is NaN where a row has no number. Integers beyond 2^53 are
# those of 64-bit floats. Where a text stands in the place of a number, the closures themselves are
# asked, row by row: they know in which row that is an error.


class _MixedKindsError(Exception):
    """A text stands where a number is needed, at least in one row."""


class Texts(NamedTuple):
    """The texts of a value: per row the place of its label, or one for all; 0 for none."""

    codes: Any
    labels: Sequence[Value]


class Values(NamedTuple):
    """A value in each row, or one for all of them: a number, a text, or none."""

    numbers: Any  # NaN where it is none
    texts: Texts | None = None

    @property
    def missing(self) -> Flags:
        """Where it is neither a number nor a text."""
        lacking = np.isnan(self.numbers)
        return lacking if self.texts is None else lacking & (self.texts.codes == 0)


def holds_in(
    scanned: Scanned, tree: ast.expr, frame: Frame, position: tuple[str, str] | None
) -> Flags:
    """In which rows of a frame a condition holds.

    Args:
        scanned: What the tree was parsed from.
        tree: Of a condition.
        frame: The rows.
        position: The names of x and y, for displacements; None where none are known.

    Raises:
        ConditionFailedError: The values are not of the kinds that it can be asked of.
    """
    try:
        return _OnArrays(scanned, frame, position).condition(tree)
    except _MixedKindsError:
        answers = _one_by_one(Compiler(scanned, tree, _as_it_is), frame, position)
        return np.fromiter(answers, np.bool_, len(frame))


def numbers_in(
    scanned: Scanned, tree: ast.expr, frame: Frame, position: tuple[str, str] | None
) -> Array:
    """The number within a score in each row, NaN where it has none; as `holds_in`."""
    try:
        return _OnArrays(scanned, frame, position).number(tree)
    except _MixedKindsError:
        answers = _one_by_one(Compiler(scanned, tree, _as_it_is, number=True), frame, position)
        found = (math.nan if answer is None else float(answer) for answer in answers)
        return np.fromiter(found, np.float64, len(frame))


def _as_it_is(value: Any) -> Any:
    return value


def _one_by_one(
    compiled: Compiler, frame: Frame, position: tuple[str, str] | None
) -> Iterator[Any]:
    """What the closures of the controller say of each row."""
    evaluator = Evaluator(compiled, _as_it_is)
    columns = {name: frame.values(name) for name in [*compiled.readers, *(position or ())]}
    for row, time_s in enumerate(frame.times.tolist()):
        values = ((name, column[row]) for name, column in columns.items())
        state = {name: value for name, value in values if value is not None}
        try:
            yield evaluator.holds(state, time_s)
        except ConditionFailedError as error:
            place = f"in run {frame.run_id}, at {time_s:.3f} s"
            raise ConditionFailedError(f"{error} ({place})") from None


class _OnArrays(Nodes):
    """Asks the nodes of a parsed condition, or of a number within a score, of the rows of a frame.

    It raises `_MixedKindsError` where the outcome in a row may be an error.
    """

    def __init__(self, scanned: Scanned, frame: Frame, position: tuple[str, str] | None) -> None:
        super().__init__(scanned)
        self._frame = frame
        self._position = position

    def condition(self, node: ast.expr) -> Flags:
        """Whether it holds in each row."""
        return self._in_each_row(self._condition(node))

    def number(self, node: ast.expr) -> Array:
        """Its numbers; NaN where it has none."""
        return self._in_each_row(self._number(node))

    def _in_each_row(self, found: Any) -> Any:
        """A constant is the same in each row."""
        return np.broadcast_to(found, (len(self._frame),))

    # -- conditions ----------------------------------------------------------------------------

    def _condition(self, node: ast.expr) -> Flags:
        if isinstance(node, ast.BoolOp):
            combine = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
            return reduce(combine, map(self._condition, node.values))
        if isinstance(node, ast.UnaryOp):
            return ~self._condition(node.operand)
        if isinstance(node, ast.Compare):
            return self._comparison(node)
        if isinstance(node, ast.Tuple):
            held, seconds = self.condition(node.elts[0]), _seconds(node.elts[1])
            return lasting(self._frame.times, held, seconds)
        if function_of(node) == "missing":
            return self._value(cast("ast.Call", node).args[0]).missing
        if function_of(node) == "changed":
            asked = self._value(cast("ast.Call", node).args[0])
            codes = asked.texts.codes if asked.texts else np.intp(0)
            both = self._in_each_row(asked.numbers), self._in_each_row(codes)
            return changed(self._frame.times, *both)
        numbers = self._numbers_of(node)
        return ~np.isnan(numbers) & (numbers != 0)

    def _comparison(self, node: ast.Compare) -> Flags:
        sides = [node.left, *node.comparators]
        simple = self._by_zones(sides[0], sides[1], type(node.ops[0])) if len(sides) == 2 else None
        if simple is not None:
            return simple
        values = [self._value(side) for side in sides]
        steps = zip(map(type, node.ops), values, values[1:], strict=False)
        return reduce(np.logical_and, starmap(_compared, steps))

    def _by_zones(self, left: ast.expr, right: ast.expr, op: type[ast.cmpop]) -> Flags | None:
        """A signal beside a number: decoded is only where a chunk's extremes leave it open."""
        if is_signal(right):
            left, right, op = right, left, _MIRRORED[op]
        number = right.value if isinstance(right, ast.Constant) else None
        if not is_signal(left) or type(number) not in (int, float):
            return None
        name = self._signal_name(left)
        if name not in self._frame or self._texts(name) is not None:
            return None
        return compared(self._frame, name, op, float(cast("float", number)))

    # -- values --------------------------------------------------------------------------------

    def _value(self, node: ast.expr) -> Values:
        if isinstance(node, ast.Name) and node.id in FLAGS:
            return Values(np.float64(FLAGS[node.id]))
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return Values(np.float64(math.nan), Texts(np.intp(1), (None, node.value)))
        if is_signal(node):
            name = self._signal_name(node)
            return Values(self._numbers(name), self._texts(name))
        return Values(self._number(node))

    def _number(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Constant):
            return np.float64(cast("float", node.value))
        if is_signal(node):
            return self._numbers_of(node)
        if isinstance(node, ast.BinOp):
            both = self._number(node.left), self._number(node.right)
            return _worked_out(ARITHMETIC[type(node.op)], *both)
        if isinstance(node, ast.UnaryOp):
            number = self._number(node.operand)
            return -number if isinstance(node.op, ast.USub) else number
        return self._call(cast("ast.Call", node))

    def _call(self, node: ast.Call) -> Any:
        name = function_of(node)
        if name == "displacement":
            return self._displacement(_seconds(node.args[0]))
        numbers = [self._number(each) for each in node.args]
        if name == "abs":
            return np.abs(numbers[0])
        if name == "rate":
            return rate(self._frame.times, self._in_each_row(numbers[0]))
        return reduce(partial(_worked_out, getattr(np, _FOLDING[str(name)])), numbers)

    def _displacement(self, seconds: float) -> Any:
        if self._position is None:
            return np.float64(math.nan)
        metres = metres_in(self._position[0])
        x, y = (self._numbers(name) for name in self._position)
        near = (np.abs(x) <= FARTHEST_M) & (np.abs(y) <= FARTHEST_M)
        found = np.full(len(x), math.nan)
        places = self._frame.times[near], x[near] * metres, y[near] * metres
        found[near] = displacement(*places, seconds)
        return found

    def _numbers_of(self, node: ast.expr) -> Array:
        name = self._signal_name(node)
        if self._texts(name) is not None:
            raise _MixedKindsError
        return self._numbers(name)

    def _numbers(self, name: str) -> Array:
        if name not in self._frame:
            return np.full(len(self._frame), math.nan)
        return self._frame.numbers(name)

    def _texts(self, name: str) -> Texts | None:
        zones = self._frame.zone_map(name)
        if not ((zones.value_count < zones.held_count) | np.isnan(zones.min)).any():
            return None
        texts = Texts(*self._frame.texts(name))
        return texts if len(texts.labels) > 1 else None


def compared(frame: Frame, name: str, op: type[ast.cmpop], limit: float) -> Flags:
    """In which rows the number of a signal compares so with a limit.

    Decoded is only where the extremes of a chunk leave it open.
    """
    zones = frame.zone_map(name)
    is_full = zones.value_count == zones.row_count
    always, never = _verdicts(op, zones.min, zones.max, limit)
    holds = np.repeat(always & is_full, zones.row_count)
    never = never & is_full | (zones.held_count == 0)
    for start, numbers in frame.opened(name, ~(always & is_full | never)):
        found = COMPARISONS[op][1](numbers, limit)
        found = found & ~np.isnan(numbers) if op is ast.NotEq else found
        holds[start : start + len(numbers)] = found
    return holds


def position_in(frame: Frame, known: Mapping[str, RegisteredSignal]) -> tuple[str, str] | None:
    """The names of x and y of a robot, as far as they have values in a frame; None without any."""
    numbers = [name for name, signal in known.items() if signal.is_number]
    while (found := find_position(numbers)) is not None:
        lacking = [name for name in found if not frame.zone_map(name).value_count.any()]
        if not lacking:
            return found
        numbers = [name for name in numbers if name not in lacking]
    return None


def aggregated(
    aggregate: Aggregate, frame: Frame, position: tuple[str, str] | None = None
) -> float | None:
    """What the values of a run come to; None where no row has a value.

    Rows count for as long as they last, up to the next one, in means and times, so that a stretch
    with more rows than others does not count more. Where no time has passed, rows count alike.

    Raises:
        ConditionFailedError: The values are not of the kinds that it can be asked of.
    """
    asked, lasts_s = (aggregate.scanned, aggregate.tree, frame, position), np.diff(frame.times)
    if aggregate.function == "time":
        holds = holds_in(*asked)
        return float(lasts_s[holds[:-1]].sum()) if len(frame) else None
    numbers = numbers_in(*asked)
    there = ~np.isnan(numbers)
    found = numbers[there]
    if not len(found):
        return None
    if aggregate.function in ("first", "last"):
        return float(found[0 if aggregate.function == "first" else -1])
    if aggregate.function != "mean":
        return float(found.min() if aggregate.function == "min" else found.max())
    known_s = lasts_s[there[:-1]]
    if known_s.sum() > 0:
        return float((numbers[:-1][there[:-1]] * known_s).sum() / known_s.sum())
    return float(found.mean())


# -- of the rows before ------------------------------------------------------------------------


def lasting(times: Array, holds: Flags, seconds: float) -> Flags:
    """Whether it has held in every row for so many seconds."""
    begins = np.flatnonzero(np.diff(holds, prepend=False) & holds)
    begun = np.searchsorted(begins, np.arange(len(times)), "right") - 1
    since_s = times[begins[np.maximum(begun, 0)]] if len(begins) else times
    return holds & (times - since_s >= seconds - SAME_TIME_S)


def changed(times: Array, numbers: Array, codes: Indexes) -> Flags:
    """Whether a value is another than the last one that was there.

    Args:
        times: Of the rows.
        numbers: NaN where there is none.
        codes: Of texts; 0 where there is none.
    """
    there = np.flatnonzero(~np.isnan(numbers) | (codes > 0))
    of_texts = codes[there]
    own = np.where(of_texts == 0, numbers[there], 0.0)
    others = (own[1:] != own[:-1]) | (of_texts[1:] != of_texts[:-1])
    found = np.zeros(len(times), np.bool_)
    found[there[1:]] = others
    return found


def rate(times: Array, numbers: Array) -> Array:
    """By how much it changes per second, from one row that has a value to the next.

    While time stands still the rate stays as it is.
    """
    there = np.flatnonzero(~np.isnan(numbers))
    newer = there[_apart(times[there], SAME_TIME_S, strictly=True)]
    known = np.zeros(len(times), np.bool_)  # where the rate is set anew
    found = np.full(len(times), math.nan)
    with np.errstate(all="ignore"):
        found[newer[1:]] = np.diff(numbers[newer]) / np.diff(times[newer])
    found[~np.isfinite(found)] = math.nan
    known[newer] = True
    known[np.isnan(numbers)] = True
    latest = np.maximum.accumulate(np.where(known, np.arange(len(times)), 0))
    return found[latest]


def displacement(times: Array, x: Array, y: Array, seconds: float) -> Array:
    """Metres between each place and where the robot was so many seconds before.

    Compared is with the newest of 200 places that is at least as old; NaN where it is over twice
    as old, or none is.
    """
    if not len(times):
        return np.zeros(0)
    kept = _apart(times, seconds / PLACES_KEPT)
    kept_s = times[kept]
    newest = np.searchsorted(kept, np.arange(len(times)), "right") - 1
    then = np.searchsorted(kept_s, kept_s - seconds + SAME_TIME_S, "right") - 1
    was = kept[np.maximum(then, 0)[newest]]
    older_s = times - times[was] - seconds
    found = np.hypot(x - x[was], y - y[was])
    return np.where((older_s >= -SAME_TIME_S) & (older_s <= seconds + SAME_TIME_S), found, math.nan)


def _apart(times: Array, least_s: float, *, strictly: bool = False) -> Indexes:
    """The first row, and each that comes so long after the one that was taken before."""
    far = np.greater if strictly else np.greater_equal
    if far(np.diff(times), least_s).all():
        return np.arange(len(times))
    after = np.searchsorted(times, times + least_s, "right" if strictly else "left")
    after -= far(times[after - 1] - times, least_s)  # where the sum was rounded
    after += (after < len(times)) & ~far(times[np.minimum(after, len(times) - 1)] - times, least_s)
    rows, taken = after.tolist(), [0]
    while (row := rows[taken[-1]]) < len(times):
        taken.append(row)
    return np.array(taken)


# -- of values --------------------------------------------------------------------------------


def _compared(op: type[ast.cmpop], left: Values, right: Values) -> Flags:
    _, compare = COMPARISONS[op]
    holds: Any = compare(left.numbers, right.numbers)
    if op is ast.NotEq:
        holds = holds & ~np.isnan(left.numbers) & ~np.isnan(right.numbers)
    if left.texts is None and right.texts is None:
        return holds
    one, other = _ranked(left.texts, right.texts)
    holds = holds | (compare(one, other) & (one > 0) & (other > 0))
    mixed = (one > 0) & ~np.isnan(right.numbers) | (other > 0) & ~np.isnan(left.numbers)
    if op is ast.NotEq:
        return holds | mixed
    if op is not ast.Eq and np.any(mixed):
        raise _MixedKindsError
    return holds


def _worked_out(apply: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
    with np.errstate(all="ignore"):
        found = apply(left, right)
    return np.where(np.isfinite(found), found, math.nan)


def _seconds(node: ast.expr) -> float:
    return float(cast("Any", node).value)


def _ranked(left: Texts | None, right: Texts | None) -> tuple[Any, Any]:
    """Codes of both whose order is that of the texts; 0 for none."""
    labels = {str(label) for each in (left, right) if each for label in each.labels[1:]}
    ranks = {label: rank for rank, label in enumerate(sorted(labels), 1)}
    return _ranks(left, ranks), _ranks(right, ranks)


def _ranks(texts: Texts | None, ranks: dict[str, int]) -> Any:
    if texts is None:
        return np.intp(0)
    return np.array([0, *(ranks[str(label)] for label in texts.labels[1:])], np.intp)[texts.codes]


def _verdicts(op: type[ast.cmpop], low: Array, high: Array, limit: float) -> tuple[Any, Any]:
    """In which chunks all numbers, and in which none, compare so with a limit."""
    if op is ast.Eq:
        return (low == limit) & (high == limit), (low > limit) | (high < limit)
    if op is ast.NotEq:
        always, never = _verdicts(ast.Eq, low, high, limit)
        return never, always
    compare = COMPARISONS[op][1]
    least, most = (low, high) if op in (ast.Gt, ast.GtE) else (high, low)
    return compare(least, limit), ~(compare(most, limit) | np.isnan(most))


# -- what shall hold -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Adherence:
    """How an expectation held in the rows of a run.

    Attributes:
        violations: Where it did not.
        rows: Of how many it was asked.
        meant_s: For how long it was asked, and `held_s` for how long of that it held: each row
            lasts to the next one, the last as long as usual, an only one not at all.
        lacking: Rows in which it was meant and had no value to be asked of.
        after_s: How long the run took until it held for the first time; None if it never did.
        worst: The value that was farthest on the wrong side, where it compares with a number.
    """

    violations: Runs
    rows: int
    meant_s: float
    held_s: float
    lacking: int
    after_s: float | None
    worst: tuple[str, float] | None


def expectations_of(
    connection: sqlite3.Connection, run_id: int, *, of_project: bool = True
) -> list[Expectation]:
    """What was expected of a run: by its controller's code, and by its project as compiled last.

    Args:
        connection: Any.
        run_id: The run.
        of_project: False leaves out what its project expects.
    """
    found = dict[tuple[str, str, str | None], Expectation]()
    for expects, during, name, by in connection.execute(EXPECTED, (run_id,)).fetchall():
        with suppress(InvalidConditionError):
            if of_project or by != OF_PROJECT:
                each = parse_expectation(expects, during, name)
                found[each.asks] = each
    return list(found.values())


def every_call_of(search: Search) -> Frame:
    """All rows of the run, in kept stretches each call: violations keep the seconds around them."""
    whole = Segment(search.segment.run_id, search.began_s, just_after(search.ended_s))
    return read_frame(search.connection, whole, search.deadline, every_call=True)


def judge_expectation(
    expectation: Expectation, frame: Frame, known: dict[str, RegisteredSignal]
) -> Adherence:
    """Ask an expectation of the rows of a run.

    Raises:
        ConditionFailedError: The values are not of the kinds that it can be asked of.
    """
    position = position_in(frame, known) if expectation.asks_position else None
    during, expected = expectation.during, expectation.expected
    meant: Flags = np.array(frame.was_read())
    if during is not None:
        meant &= holds_in(during.scanned, during.tree, frame, position)
    if len(frame):
        meant &= frame.times - frame.times[0] >= expectation.takes_s - SAME_TIME_S
        meant[0] &= not expectation.needs_two
    lacks: Flags = np.zeros(len(frame), np.bool_)
    if not expectation.asks_missing:
        for name in (*expected.signals, *(position or ())):
            lacks |= np.isnan(frame.numbers(name)) & (frame.texts(name).codes == 0)
        lacks |= expected.asks_position and position is None
    asked: Flags = meant & ~lacks
    holds: Flags = asked & holds_in(expected.scanned, expected.tree, frame, position)
    violated: Flags = asked & ~holds
    run_s = frame.times - frame.times[:1]
    after_s = float(run_s[np.argmax(holds)]) if holds.any() else None
    if (within_s := expectation.within_s) is not None:  # it is decided once it held, or is late
        reached = np.logical_or.accumulate(holds)
        late = frame.was_read() & (run_s > within_s + SAME_TIME_S)
        asked, violated = late | reached, late & ~np.append(False, reached)[:-1]
        if len(frame) and any(e.start_s <= frame.times[0] + within_s for e in frame.unread):
            asked, violated, after_s = asked & False, violated & False, None  # it may have held
    steps_s = np.diff(frame.times)
    lasts_s = np.append(steps_s, median(steps_s) if len(steps_s) else 0.0)[: len(frame)]
    meant_s, bad_s = (float(lasts_s[each].sum()) for each in (asked, violated))
    runs = runs_of(violated, frame.times)
    worst = found[:2] if (found := _worst(expected, frame, position, violated)) else None
    rows, lacking = (int(np.count_nonzero(each)) for each in (asked, meant & lacks))
    return Adherence(runs, rows, meant_s, meant_s - bad_s, lacking, after_s, worst)


def _worst(
    expected: Condition,
    frame: Frame,
    position: tuple[str, str] | None,
    rows: Flags,
    tree: ast.expr | None = None,
    *,
    nearest: bool = False,
) -> tuple[str, float, float] | None:
    """Of a comparison of one value with a number: the value farthest from holding, and when.

    Args:
        expected: What should hold.
        frame: The rows.
        position: The names of x and y.
        rows: Those that are looked at.
        tree: The comparison, where it is a part of the condition.
        nearest: The value nearest to holding instead.
    """
    tree = expected.tree if tree is None else tree
    if not isinstance(tree, ast.Compare) or len(tree.ops) != 1 or not rows.any():
        return None
    left, right, op = tree.left, tree.comparators[0], tree.ops[0]
    flipped = isinstance(left, ast.Constant)
    side, other = (right, left) if flipped else (left, right)
    is_fit = isinstance(other, ast.Constant | ast.UnaryOp) and not isinstance(side, ast.Constant)
    if not is_fit or isinstance(op, ast.Eq | ast.NotEq):
        return None
    try:
        values = np.array(numbers_in(expected.scanned, side, frame, position))
    except ConditionFailedError:
        return None
    there = np.flatnonzero(rows & ~np.isnan(values))
    if not len(there):
        return None
    wants_more = isinstance(op, ast.Gt | ast.GtE) is not flipped
    takes_least = wants_more is not nearest
    row = there[values[there].argmin() if takes_least else values[there].argmax()]
    start, end = side.col_offset, side.end_col_offset or 0
    columns = expected.scanned.columns
    text = expected.scanned.original[columns[start] : columns[end]]
    return text.strip(), float(values[row]), frame.rows(int(row), int(row) + 1).bounds_s[0]


def violation_events(search: Search) -> Iterator[Event]:
    """Each stretch in which something that was expected did not hold."""
    expected = expectations_of(search.connection, search.segment.run_id)
    if not expected:
        if len(search.kinds) > 1:
            raise NotAskedError
        raise NotSearchableError(NONE_EXPECTED)
    frame = every_call_of(search)
    search.not_searched(VIOLATION, *map(str, frame.unread))
    for each in expected:
        try:
            held = judge_expectation(each, frame, search.known)
        except ConditionFailedError as error:
            search.not_searched(VIOLATION, str(error))
            continue
        position = position_in(frame, search.known) if each.asks_position else None
        values = values_at(each.violation, frame, position, held.violations)
        for run, details in zip(held.violations.spans(), values, strict=True):
            here = search.segment
            if run.start_s < here.end_s and run.end_s >= here.start_s:
                details = {"expected": each.text, **dict(list(details.items())[:8])}
                yield search.event(VIOLATION, run.start_s, run.end_s, each.name, **details)


VIOLATIONS: Final = EventKind(
    VIOLATION,
    "an expectation does not hold",
    violation_events,
    lasts=True,
    drawn=1,
    alike=Alike(lambda events, unit: "violations"),
    severity=90,
)
