"""Each kind that rests on what signals mean is found, judged, listed, drawn and reported."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest

from tests.judging.asking import ask
from tests.recordings.rows import Recorded, RecordedRobot
from webots_mcp import MemoryDatabase
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.event_kinds import KINDS, drawn_kinds
from webots_mcp.plotting.canvas import Sheet
from webots_mcp.plotting.interactive_svg import signals_figure
from webots_mcp.plotting.signal_plot import compose_signals, plot_signals
from webots_mcp.plugins.report.chapter import chapter_of
from webots_mcp.store.reading.ranges import Scope, find_range

State = Callable[[float, random.Random], dict[str, Any]]
LASTS_S, ROW_S = 80.0, 0.1


def tips_over(time_s: float, rng: random.Random) -> dict[str, Any]:
    roll = 1.5 * min(max(time_s - 40, 0), 1) + rng.gauss(0, 0.005)
    return {"imu": {"roll_rad": roll, "pitch_rad": rng.gauss(0, 0.005)}}


def slips(time_s: float, rng: random.Random) -> dict[str, Any]:
    """Its left side stops pulling at 40 s: it turns to the left while both wheels turn alike."""
    yaw = 0.2 * max(time_s - 40, 0)
    x = 0.2 * min(time_s, 40) + (math.sin(yaw) if yaw else 0)
    y = 1 - math.cos(yaw)
    return {
        "pose": {"x": x, "y": y, "yaw": math.remainder(yaw, math.tau)},
        "wheels": {"left_rad_s": 4.0, "right_rad_s": 4.0},
    }


def stays_away(time_s: float, rng: random.Random) -> dict[str, Any]:
    target = 1.0 if time_s // 10 % 2 == 0 else -1.0
    position = -1.0 if time_s >= 40 else target
    return {"elbow": {"target": target, "position": position + rng.gauss(0, 0.002)}}


def grows_noisy(time_s: float, rng: random.Random) -> dict[str, Any]:
    noise = 0.004 if time_s < 40 else 0.05
    return {"front_distance_m": 2 + 0.3 * math.sin(time_s / 9) + rng.gauss(0, noise)}


def swings_more(time_s: float, rng: random.Random) -> dict[str, Any]:
    amplitude = 0.02 * math.exp(max(time_s - 40, 0) / 15) if time_s > 40 else 0.0
    return {"steering_rad": amplitude * math.sin(3 * time_s) + rng.gauss(0, 0.0005)}


def loses_rays(time_s: float, rng: random.Random) -> dict[str, Any]:
    rays = [1 + 0.01 * ray + rng.gauss(0, 0.002) for ray in range(100)]
    return {"scan": [None] * 50 + rays[50:] if time_s >= 40 else rays}


# Kind, state, the signals of a plot, the check and its outcome, and what the event says.
CASES: list[tuple[str, State, list[str], str, str, dict[str, Any]]] = [
    ("fall", tips_over, ["imu.*"], "stays upright", "fail", {"got_up": False}),
    ("slip", slips, ["pose.*"], "wheels grip", "fail", {"side": "left"}),
    ("off_target", stays_away, ["elbow.*"], "follows its targets", "fail",
     {"target": "elbow.target"}),
    ("degradation", grows_noisy, ["front_distance_m"], "sensors keep their noise", "warn", {}),
    ("oscillation", swings_more, ["steering_rad"], "stays stable", "warn", {}),
    ("missing", loses_rays, ["scan.mean"], "sensors speak", "warn",
     {"items": 50, "of_items": 100}),
]  # fmt: skip


@pytest.fixture
def robot() -> Iterator[RecordedRobot]:
    database = MemoryDatabase()
    with closing(Recorded(database)) as recorded:
        yield recorded.robot(now=1e9)
    database.close()


def record(robot: RecordedRobot, state: State) -> None:
    rng = random.Random(1)
    for row in range(round(LASTS_S / ROW_S)):
        data = state(row * ROW_S, rng)
        nan = {"scan.*": "nan"} if None in data.get("scan", ()) else None
        robot.state(round(row * ROW_S, 3), data, nan)


@pytest.mark.parametrize(
    ("kind", "state", "names", "check", "outcome", "says"), CASES, ids=[each[0] for each in CASES]
)
def test_a_kind_is_found_judged_drawn_and_reported(
    robot: RecordedRobot, kind: str, state: State, names: list[str], check: str,
    outcome: str, says: dict[str, Any],
) -> None:  # fmt: skip
    record(robot, state)
    connection = robot.connection
    found: list[Event] = list(ask(connection, kind).events)
    assert found, kind
    first = found[0]
    assert first.start_s == pytest.approx(40, abs=4.0), first
    assert {name: first.details[name] for name in says} == says

    # In a part of the run it is the same, or it is said that the part does not show it.
    part = ask(connection, kind, bounds={"run_id": 1, "start_s": 42.0, "end_s": 60.0})
    starts_s = [each.start_s for each in part.events][:1]
    assert starts_s == [pytest.approx(first.start_s, abs=0.6)] or kind in part.verdicts.reasons

    (finding,) = [each for each in check_run(connection, 1).findings if each.name == check]
    assert finding.outcome == outcome, finding
    assert finding.since_s == pytest.approx(first.start_s, abs=0.1)

    whole = find_range(connection, Scope(run_id=1))
    plot, notes = compose_signals(connection, [whole], names)
    (lane,) = [each for each in plot.events if each.name == kind]
    assert lane.intervals[0].start_s == pytest.approx(first.start_s, abs=0.6), notes
    picture = plot_signals(connection, [whole], names, sheet=Sheet(image_format="svg"))
    assert f">{kind} (" in picture.data.decode()
    assert kind in picture.caption.partition("Events: ")[2]
    assert kind in json.dumps(signals_figure(plot).data["events"])

    chapter = chapter_of(connection, 1, 1e6, 60.0)
    assert any(each.event.kind == kind for each in chapter.moments)
    assert any(kind in row.cells for row in chapter.events.rows)  # type: ignore[union-attr]

    robot.begin_run("reset")
    record(robot, lambda time_s, rng: state(min(time_s, 39.0), rng))
    names_of_measures = {each.name for each in compare_runs(connection, [1, 2]).measures}
    assert any(kind in each for each in names_of_measures)


@pytest.mark.slow
def test_a_healthy_robot_has_none_of_them(robot: RecordedRobot) -> None:
    def healthy(time_s: float, rng: random.Random) -> dict[str, Any]:
        early = min(time_s, 39.0)
        states = [each(early, rng) for each in (tips_over, slips, stays_away, loses_rays)]
        moving = {"front_distance_m": 2 + 0.3 * math.sin(time_s / 9) + rng.gauss(0, 0.004)}
        driven = {"pose": {"x": 0.2 * time_s, "y": 0.0, "yaw": 0.0}}
        joined: dict[str, Any] = {}
        for each in states:
            joined |= each
        target = math.sin(time_s / 2)
        return joined | moving | driven | {"elbow": {"target": target, "position": target}}

    record(robot, healthy)
    for kind in ("fall", "slip", "off_target", "degradation", "missing"):
        assert not ask(robot.connection, kind).events, kind


def test_every_kind_that_lasts_and_is_judged_has_a_row_in_plots() -> None:
    drawn = {each.name for each in drawn_kinds()}
    judged = {each.name for each in KINDS if each.lasts and each.of_numbers}
    assert judged - drawn == set()
