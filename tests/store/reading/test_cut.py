"""What there was no time to read is left out of an answer, and the answer says from where on."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Iterator

import pytest

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.detection.event import Event, count_by_kind
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import Search, events_touching
from webots_mcp.judging.verdicts import SearchCoverage, Verdicts
from webots_mcp.store.reading.catalogue import known_signals
from webots_mcp.store.reading.frame_summary import change_points
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.registered_signals import RegisteredSignal
from webots_mcp.store.signal_history import query_rows

pytestmark = pytest.mark.slow

ROWS = 8_000
INTERVAL_S = 0.25
MODES = {0.0: "rest", 500.0: "walk", 1500.0: "turn"}  # from when on
ENOUGH = 10_000  # looks at the clock
SOME = (*range(10), 13, 17, 22, 28, 35, 43, 52, 59)  # looks after which the time is over


@pytest.fixture(scope="module")
def unsummed() -> Iterator[sqlite3.Connection]:
    """A run that has ended and that nobody has summed up."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        for step in range(ROWS):
            time_s = step * INTERVAL_S
            recorder.publish(
                time_s, {"mode": mode_at(time_s), "gear": gear_at(time_s), "x": time_s}
            )
        recorder.end_run("finished")
        yield connection


def mode_at(time_s: float) -> str:
    return [mode for from_s, mode in MODES.items() if from_s <= time_s][-1]


def gear_at(time_s: float) -> str | int:
    """At first a number, of which no change is stored."""
    return 1 if time_s < 800 else "reverse"


def after(looks: int) -> Deadline:
    """A deadline that has passed when its clock was looked at so often."""
    return Deadline(looks, itertools.count().__next__)


def signals_of(connection: sqlite3.Connection, *names: str) -> list[RegisteredSignal]:
    known = known_signals(connection, find_range(connection, Scope()))
    return [known[name] for name in names]


@pytest.mark.parametrize(("start_s", "is_cut"), [(0.0, True), (900.0, True), (1990.0, False)])
def test_no_mode_is_told_but_that_of_the_rows_wherever_the_time_was_over(
    unsummed: sqlite3.Connection, start_s: float, *, is_cut: bool
) -> None:
    segment = Segment(1, start_s, 2000.0)
    wanted = signals_of(unsummed, "mode", "gear")
    reached_s = set[float | None]()
    for looks in SOME:
        found = change_points(unsummed, segment, wanted, after(looks))
        points = found.points["mode"]
        assert [point.value for point in points] == [mode_at(p.sim_time_s) for p in points]
        assert all(point.sim_time_s <= found.read_to_s(2000.0) for point in points)
        if points and "mode" not in found.since_before:
            assert points[0].sim_time_s == max(each for each in MODES if each <= start_s)
        seconds = found.longest_values("mode", 2000.0)
        assert sum(seconds.values()) == pytest.approx(found.read_to_s(2000.0) - start_s)
        reached_s.add(found.unread_from_s)
    whole = change_points(unsummed, segment, wanted, after(ENOUGH))
    assert whole.unread_from_s is None and not whole.since_before
    assert whole.points["gear"][-1].value == "reverse"
    assert (len(reached_s) > 3) is is_cut


def test_since_when_a_mode_is_in_force_is_looked_for_backwards(
    unsummed: sqlite3.Connection,
) -> None:
    """So that what is asked about is known before what was long before it."""
    segment = Segment(1, 1990.0, 2000.0)
    found = [
        change_points(unsummed, segment, signals_of(unsummed, "mode"), after(looks))
        for looks in (*SOME, ENOUGH)
    ]
    told = [each for each in found if each.points["mode"]]
    assert [each.points["mode"][0].value for each in told] == ["turn"] * len(told)
    assert all(each.unread_from_s is None for each in told), "ten seconds are read at once"
    assert any("mode" in each.since_before for each in told)
    assert told[-1].points["mode"][0].sim_time_s == 1500.0


def test_a_page_without_a_row_for_which_the_time_was_over_is_no_last_page(
    unsummed: sqlite3.Connection,
) -> None:
    page = query_rows(unsummed, find_range(unsummed, Scope()), ["*"], limit=1000, deadline_s=0.0)
    assert (page.ids, page.cursor, page.cut) == ([], None, True)


def test_a_kind_is_absent_only_where_all_of_it_was_looked_at(unsummed: sqlite3.Connection) -> None:
    whole = _verdicts(unsummed, ENOUGH)
    assert (whole.found["change"], whole.far) == (3, ["gap"])
    told = [_verdicts(unsummed, looks) for looks in SOME]
    assert not any("change" in {*each.far, *each.nearest} for each in told)
    cut = [each for each in told if "change" in each.reasons]
    assert any("change" in each.found for each in cut), "some of them were read"
    assert all("time limit reached" in each.not_searched["change"] for each in cut)


def test_the_newest_change_goes_on_only_where_it_was_looked_at_to_the_end(
    unsummed: sqlite3.Connection,
) -> None:
    for looks in SOME:
        coverage, options = SearchCoverage(), EventOptions(kinds=("change",), signals=("mode",))
        found = find_range(unsummed, Scope(start_s=400.0, end_s=600.0))
        (event,) = _look(unsummed, found.segments[0], options, coverage, looks)[-1:] or [None]
        if event is not None and event.end_s != 1500.0:
            assert not event.ongoing
            assert (
                "time limit reached"
                in coverage.verdicts(["change"], count_by_kind([])).gaps["change"]
            )


def _verdicts(connection: sqlite3.Connection, looks: int) -> Verdicts:
    coverage, options = SearchCoverage(), EventOptions(kinds=("gap", "change"))
    (segment,) = find_range(connection, Scope()).segments
    events = _look(connection, segment, options, coverage, looks)
    return coverage.verdicts([kind.name for kind in asked_kinds(options)], count_by_kind(events))


def _look(
    connection: sqlite3.Connection,
    segment: Segment,
    options: EventOptions,
    coverage: SearchCoverage,
    looks: int,
) -> list[Event]:
    known = known_signals(connection, find_range(connection, Scope()))
    kinds = asked_kinds(options)
    search = Search(connection, segment, known, kinds, options, after(looks), coverage)
    return events_touching(search)
