"""A kind of event is made known in one place, and everything that tells of events knows it."""

from __future__ import annotations

import ast
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

import webots_mcp
from tests.recordings.rover import Recorder
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection import event_kinds
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events, timeline
from webots_mcp.judging.detection.search import EventKind, Search
from webots_mcp.plotting.plotted_runs import event_lanes, plotted_runs
from webots_mcp.store.reading.ranges import Scope, find_range


def tilted(search: Search) -> Iterator[Event]:
    times, tilts = search.frame.usable("tilt")
    for time_s, tilt in zip(times.tolist(), tilts.tolist(), strict=True):
        if tilt > 1:
            yield search.event("tilted", time_s, time_s, "tilt", tilt=tilt)


@pytest.fixture
def tilting(empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch) -> sqlite3.Connection:
    """Two runs in which the robot leant over twice, and a kind of event that tells so."""
    kind = EventKind("tilted", "it leant over", tilted, of_numbers=True, drawn=0, stored=True)
    monkeypatch.setattr(event_kinds, "KINDS", [*event_kinds.KINDS, kind])
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    session_id = recorder.session(robot_id, "a" * 64)
    for reason in ("start", "reset"):
        recorder.run(session_id, robot_id, reason)
        for step in range(600):
            recorder.publish(step * 0.1, {"tilt": 1.5 if step in (200, 400) else 0.01 * (step % 7)})
    return empty


def test_a_kind_that_is_entered_once_is_found_compared_told_and_drawn(
    tilting: sqlite3.Connection,
) -> None:
    whole = find_range(tilting, Scope())
    assert find_events(tilting, whole).verdicts.found["tilted"] == 2
    assert timeline(tilting, whole).verdicts.found["tilted"] == 2
    (measure,) = (
        each for each in compare_runs(tilting, [1, 2]).measures if each.name == "tilted per min"
    )
    assert [spread and round(spread.median, 1) for spread in measure.spread] == [2.0, 2.0]
    (part,) = plotted_runs(tilting, [whole], ["tilt"])
    lanes, _ = event_lanes(tilting, part, ["tilt"])
    assert lanes[0].name == "tilted" and len(lanes[0].intervals) == 2


@pytest.mark.slow
def test_nothing_but_its_own_module_and_the_registry_names_a_kind() -> None:
    """`log`, `run`, `missing` and the like are words of other things too."""
    names = {"oscillation", "jump", "flat"}
    folder = Path(webots_mcp.__file__).parent
    own = {"jump.py", "oscillation.py", "sensors.py"}
    naming = {
        path.relative_to(folder).as_posix(): named
        for path in folder.rglob("*.py")
        if path.name not in own and (named := names & set(strings_in(path)))
    }
    assert naming == {}


def strings_in(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_options_name_kinds_of_the_registry() -> None:
    names = [kind.name for kind in event_kinds.asked_kinds(EventOptions())]
    assert "image" not in names and "condition" not in names and "stuck" in names
    assert len(set(event_kinds.kind_names())) == len(event_kinds.KINDS)
