"""Events that are found and checks of the same run never contradict each other."""

from __future__ import annotations

import sqlite3
from typing import Any, Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.cases import healthy_robots, problems
from tests.cases.public import PUBLIC
from tests.cases.situations import HEALTHY, PROBLEMS, recorded
from tests.cases.unfamiliar import ROBOTS, situation_of
from tests.exploring import attempts
from tests.judging.checks.labelled import FAULTS, healthy
from tests.judging.checks.labelled import record as record_run
from tests.judging.detection.drawing import KINDS, draw_case
from tests.judging.detection.publishing import WAYS, Publishing, moments
from tests.judging.detection.writing import write_all
from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.checks.check_run import CHECKS, check_run
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.verdicts import Outcome
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import one_reading

pytestmark = pytest.mark.slow

_MODULES = (healthy_robots, problems)  # which fill the registries
_EXAMPLES = attempts(8, exploring=200)
_UNHURRIED_S: Final = 300.0
_SEEDS = st.integers(0, 2**32 - 1)
# Each of these events is a fault; of the other kinds a check tells whether one of them is.
_REPORTED_BY: Final = {
    "stuck": "moves when commanded",
    "off_target": "follows its targets",
    "fall": "stays upright",
    "slip": "wheels grip",
    "degradation": "sensors keep their noise",
    "gap": "misses no steps",
    "log": "logs no errors",
}
_NOT_MADE: Final[set[Outcome]] = {"not applicable", "not judged", "not looked at"}


def contradictions(
    connection: sqlite3.Connection, run_id: int, *, by_default: bool = False
) -> list[str]:
    """What of the events and checks of a run does not fit together.

    Args:
        connection: Any.
        run_id: The run.
        by_default: Events are asked for without naming kinds, as most people do.
    """
    kinds = tuple(dict.fromkeys(kind for check in CHECKS for kind in check.kinds))
    options = EventOptions() if by_default else EventOptions(kinds)
    with one_reading(connection):  # both judge the same rows, which are parsed once
        found = find_events(
            connection, find_range(connection, Scope(run_id=run_id)), options, limit=500,
            group=False, deadline_s=_UNHURRIED_S,
        )  # fmt: skip
        findings = check_run(connection, run_id, deadline_s=_UNHURRIED_S).findings
    outcomes = {each.name: each.outcome for each in findings}
    wrong = list[str]()
    for kind, check in _REPORTED_BY.items():
        if found.verdicts.found.get(kind) and outcomes[check] not in ("warn", "fail", "not judged"):
            wrong.append(f"{kind} was found, and {check!r} came to {outcomes[check]}")
        if outcomes[check] in ("warn", "fail") and not found.verdicts.found.get(kind):
            wrong.append(f"{check!r} came to {outcomes[check]}, and no {kind} was found")
    if _has_leap(found.events) and outcomes["stays in place"] == "pass":
        wrong.append("the position jumped, and it stays in place")
    for check in CHECKS:
        unsearched = [kind for kind in check.kinds if found.verdicts.why_unsearched(kind)]
        undecided = [
            kind
            for kind in _REPORTED_BY.keys() & {*check.kinds}
            if outcomes[check.name] == "not judged" and kind in found.verdicts.not_found
            if kind not in found.verdicts.reasons
        ]
        if undecided:
            wrong.append(f"{check.name!r} is not judged, and {undecided} denied")
        if unsearched and outcomes[check.name] not in _NOT_MADE:
            wrong.append(f"{unsearched} not searched, and {check.name!r} was judged")
        if outcomes[check.name] == "pass":
            seen = (found.verdicts.found, found.verdicts.not_found)
            wrong += [
                f"{check.name!r} passed, and {kind} was not searched"
                for kind in check.kinds
                if not any(kind in each for each in seen)
            ]
    return wrong


def _has_leap(events: tuple[Event, ...]) -> bool:
    return any(each.kind == "jump" and each.name == "position" for each in events)


_CASES: Final = {**HEALTHY, **PROBLEMS, **PUBLIC}


@pytest.mark.parametrize("name", _CASES)
def test_situations_of_public_reports(name: str) -> None:
    with recorded(_CASES[name]) as asked:
        assert contradictions(asked.connection, asked.run_id, by_default=True) == []


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_unfamiliar_kinds(name: str) -> None:
    with recorded(situation_of(name, 0.2, faulty=True)) as asked:
        assert contradictions(asked.connection, asked.run_id, by_default=True) == []


@pytest.mark.slow
@given(kind=st.sampled_from(list(KINDS)), seed=_SEEDS)
@settings(max_examples=_EXAMPLES, deadline=None)
def test_labelled_recordings(kind: str, seed: int) -> None:
    run = draw_case(kind, seed, 0, most_values=0).runs[-1]
    with memory_connection() as connection:
        (run_id,) = write_all(connection, [run])
        assert contradictions(connection, run_id) == []


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["", *FAULTS])
def test_runs_with_one_fault_each(fault: str) -> None:
    rng = np.random.default_rng(5)
    run = healthy(rng)
    run = FAULTS[fault][0](rng, run) if fault else run
    with memory_connection() as connection:
        assert contradictions(connection, record_run(connection, run)) == []


@given(
    ways=st.lists(st.sampled_from(WAYS), min_size=1, max_size=3),
    interval_s=st.sampled_from([0.1, 0.3, 0.5, 1.0]),
    is_held=st.booleans(),
    gaps=st.booleans(),
)
@settings(max_examples=2 * _EXAMPLES, deadline=None)
def test_robots_that_publish_in_several_ways_at_once(
    ways: list[Publishing], interval_s: float, is_held: bool, gaps: bool
) -> None:
    with memory_connection() as connection:
        recorder = start_run(connection)
        for row, each in enumerate(moments(interval_s, is_held=is_held)):
            if gaps and 60 <= row % 150 < 90:
                continue
            state: dict[str, Any] = {}
            for way in ways:
                state |= way.publish(each)
            recorder.publish(each.t, state)
        recorder.end_run("finished")
        assert contradictions(connection, 1) == []
