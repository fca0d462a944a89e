"""What is said of labelled recordings: the part of them that is tested each time."""

from __future__ import annotations

import math
import sqlite3
from itertools import combinations, pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.exploring import attempts
from tests.judging.detection import drawing, driving
from tests.judging.detection.asking import Answer, ask_since
from tests.judging.detection.drawing import KINDS, draw_case
from tests.judging.detection.goals import missed_goals
from tests.judging.detection.labelled import Case, Measure
from tests.judging.detection.measuring import measure
from tests.judging.detection.writing import write_all
from tests.memory import memory_connection
from tests.recordings.rover import WALL_START_S
from webots_mcp.analysis.oscillations import DECIDE
from webots_mcp.judging.detection import standstill
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.reading.ranges import Scope, find_range

pytestmark = pytest.mark.slow

EXAMPLES = attempts(4, exploring=100)
MOST_VALUES = 10_000  # that are added to a run: enough to be searched, and read in no time
LOOKED_FOR: tuple[Measure, ...] = (
    "standstill", "missing", "flat", "dropout", "leap", "swing", "gap",
)  # fmt: skip

SEEDS = st.integers(0, 2**32 - 1)


def asked(case: Case, measures: tuple[Measure, ...]) -> tuple[list[int], Answer]:
    with memory_connection() as connection:
        run_ids = write_all(connection, case.runs)
        return run_ids, ask_since(connection, measures, WALL_START_S)


@given(kind=st.sampled_from(list(KINDS)), seed=SEEDS)
@settings(max_examples=2 * EXAMPLES, deadline=None)
def test_an_answer_keeps_to_the_recording_and_tells_nothing_twice(kind: str, seed: int) -> None:
    case = draw_case(kind, seed, 0, most_values=MOST_VALUES)
    run_ids, answer = asked(case, LOOKED_FOR)
    runs = dict(zip(run_ids, case.runs, strict=True))
    told = sorted(answer.claims, key=lambda each: (str(each.source), each.run_id, each.start_s))
    for claim in told:
        times = runs[claim.run_id].times
        assert times[0] <= claim.start_s <= claim.end_s <= times[-1]
    for before, after in combinations(told, 2):
        if (before.source, before.run_id) == (after.source, after.run_id):
            slower = max(before.period_s or 1, after.period_s or 1)
            faster = min(before.period_s or 1, after.period_s or 1)
            assert before.end_s <= after.start_s or slower > DECIDE.much_slower * faster


STANDING = EventOptions(kinds=("standstill", "stuck"))


def stood(connection: sqlite3.Connection, *span_s: float) -> list[tuple[str, float, float]]:
    """The kind, begin and end of what is told of all of the run, or of a part of it."""
    bounds = dict(zip(("start_s", "end_s"), span_s, strict=False))
    asked = find_range(connection, Scope(run_id=1, **bounds))  # pyright: ignore[reportArgumentType]
    found = find_events(connection, asked, STANDING, limit=1000, around=(), group=False)
    return [(each.kind, each.start_s, each.end_s) for each in found.events]


@given(kind=st.sampled_from(list(driving.DRAWN)), seed=SEEDS, share=st.floats(0.0, 0.9))
@settings(max_examples=2 * EXAMPLES, deadline=None)
def test_a_robot_stood_as_long_whatever_part_of_its_run_is_asked_for(
    kind: str, seed: int, share: float
) -> None:
    run = draw_case(kind, seed, 0, most_values=0).runs[-1]
    with memory_connection() as connection:
        write_all(connection, [run])
        whole = stood(connection)
        start_s = float(run.times[0]) + share * run.duration_s
        for lasts_s in (0.5, 10.0, 60.0):
            end_s = start_s + lasts_s
            here = [each for each in whole if each[1] < end_s and each[2] >= start_s]
            assert stood(connection, start_s, end_s) == here
    for before, after in pairwise(sorted(whole, key=lambda each: each[1])):
        assert before[2] <= after[1]  # none is told within another


BY_CHANCE = {"settling", "roaming"}  # of so few cases, whether their goals are reached


def test_standstills_are_the_same_however_many_are_judged_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs = [draw_case(kind, 3, 0, most_values=0).runs[-1] for kind in driving.DRAWN]
    options = EventOptions(kinds=("standstill", "stuck"))
    with memory_connection() as connection:
        write_all(connection, runs)
        whole = find_range(connection, Scope(since_wall_time=0.0))
        at_once = find_events(connection, whole, options, limit=500, deadline_s=math.inf)
        assert {event.kind for event in at_once.events} == {"standstill", "stuck"}
        for rows_at_once in (1, 500):
            monkeypatch.setattr(standstill, "JUDGED_AT_ONCE", rows_at_once)
            again = find_events(connection, whole, options, limit=500, deadline_s=math.inf)
            assert again.events == at_once.events


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - BY_CHANCE))
def test_what_is_told_of_labelled_recordings_reaches_the_goals(kind: str) -> None:
    most_values = drawing.MOST_VALUES if KINDS[kind].others else MOST_VALUES
    report = measure([kind], 2, 1, most_values=most_values)
    missed = {key: missed_goals(key, tally) for key, tally in report.tallies.items()}
    assert {key: goals for key, goals in missed.items() if goals} == {}, report.wrong
