"""However a robot is published: held in place, it is never said to be well or to have moved."""

from __future__ import annotations

import sqlite3
from typing import NamedTuple

import pytest

from tests.judging.detection.publishing import WAYS, Publishing, moments
from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.signals.meaning import declare_meaning
from webots_mcp.store.meanings import set_meanings
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.reading.segment import one_reading

INTERVALS_S = (0.064, 0.5)
_CHECKS = {"stuck": "moves when commanded", "off_target": "follows its targets"}


class Told(NamedTuple):
    """What is said of a run.

    Attributes:
        word: `found`, `not found` or `not searched`.
        outcome: Of the check of this kind.
        why: What is missing, where it was not searched.
        spans_s: Begin and end of what was found.
    """

    word: str
    outcome: str
    why: str
    spans_s: list[tuple[float, float]]


def tell(way: Publishing, interval_s: float, *, is_held: bool, declares: bool = False) -> Told:
    """Record the robot in one way and ask of it."""
    with memory_connection() as connection:
        recorder = start_run(connection)
        for each in moments(interval_s, is_held=is_held):
            recorder.publish(each.t, way.publish(each))
        recorder.end_run("finished")
        if declares:
            said = [declare_meaning(name, **of) for name, of in (way.declared or {}).items()]
            set_meanings(connection, 1, said, "mcp")
        with one_reading(connection):  # events and checks are asked of the same rows
            return _told(connection, way.kind)


def _told(connection: sqlite3.Connection, kind: str) -> Told:
    found = find_events(
        connection, find_range(connection, Scope(run_id=1)), EventOptions(kinds=(kind,))
    )
    verdicts = found.verdicts
    word = "not found" if kind in verdicts.not_found else "not searched"
    word = "found" if kind in verdicts.found else word
    checks = {each.name: each.outcome for each in check_run(connection, 1).findings}
    spans_s = [(each.start_s, each.end_s) for each in found.events]
    why = verdicts.not_searched.get(kind, "")
    return Told(word, checks[_CHECKS[kind]], why, spans_s)


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", INTERVALS_S)
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.name)
def test_a_held_robot_is_found_or_not_searched_and_a_healthy_one_is_never_called_so(
    way: Publishing, interval_s: float
) -> None:
    held = tell(way, interval_s, is_held=True)
    assert held.outcome != "pass"
    if held.word == "found":
        ((start_s, end_s),) = held.spans_s
        assert (start_s, end_s) == pytest.approx(way.expected_s, abs=1.5)
    else:
        assert held.word == "not searched" and held.why
    well = tell(way, interval_s, is_held=False)
    assert well.word != "found" and well.outcome not in ("warn", "fail")


@pytest.mark.parametrize("way", [each for each in WAYS if each.declared], ids=lambda way: way.name)
def test_what_names_do_not_tell_is_searched_once_it_is_declared(way: Publishing) -> None:
    assert tell(way, 0.064, is_held=True).word == "not searched"
    held = tell(way, 0.064, is_held=True, declares=True)
    assert (held.word, held.outcome) == ("found", "fail")
    well = tell(way, 0.064, is_held=False, declares=True)
    assert (well.word, well.outcome) == ("not found", "pass")
