"""Questions about a robot that knows no position of its own, beside an observer that sees it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from mcp import Client

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import ask, text_of
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import motion_in
from webots_mcp.judging.run_measures import way_in
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.catalogue import catalogue, list_signals
from webots_mcp.store.reading.frame import Frame, read_frame
from webots_mcp.store.reading.segment import Deadline, Segment
from webots_mcp.store.recording import RecordingAccess

SPEED_M_S: Final = 0.5
DRIVES_S: Final = 20.0
LASTS_S: Final = 60.0
HALF_TURN_RAD_S: Final = math.pi / 7
WORLD: Final = {
    "robots": [
        {"key": "ROVER", "type": "Robot", "name": "rover"},
        {"key": "arm", "type": "Robot"},
    ]
}


def x_m(time_s: float) -> float:
    """It drives, and then stands to the end."""
    return SPEED_M_S * min(time_s, DRIVES_S)


def yaw(time_s: float) -> float:
    """It turns round and round."""
    return math.remainder(HALF_TURN_RAD_S * time_s, math.tau)


class Seen:
    """A robot that publishes its mode every 80 ms, and an observer that sees it every 100 ms."""

    def __init__(self, folder: Path) -> None:
        self.rows = Recorded(folder / "webots.db")
        self.recording = RecordingAccess(folder / "webots.db", folder)
        self.began_s = time.time() - LASTS_S
        self.rover = self._robot("rover", supervisor=0)

    def _robot(self, name: str, **session: Any) -> RecordedRobot:
        robot = self.rows.robot(name, **session)
        robot.connection.execute(
            "UPDATE run SET started_wall_time_s = ? WHERE id = ?", (self.began_s, robot.run_id)
        )
        return robot

    def drive(self, **more: Any) -> None:
        for row in range(round(LASTS_S / 0.08)):
            time_s = row * 0.08
            mode = "drive" if time_s < DRIVES_S else "wait"
            self.rover.state(time_s, {"mode": mode, **more}, at=self.began_s + time_s)

    def observe(self, start_s: float = 0.0, *, instance: str = "webots-1") -> RecordedRobot:
        observer = self._robot("mcp_observer", instance=instance)
        observer.connection.execute(
            "UPDATE robot SET kind = 'Observer' WHERE id = ?", (observer.id,)
        )
        observer.event(start_s, "world", None, WORLD)
        for row in range(round(start_s / 0.1), round(LASTS_S / 0.1)):
            time_s = row * 0.1
            pose = {"x_m": x_m(time_s), "y_m": 0.25, "z_m": 0.04, "heading_rad": yaw(time_s)}
            seen = {"world": {"ROVER": pose, "arm": {**pose, "x_m": -7.0}}}
            observer.state(time_s, seen, at=self.began_s + time_s)
        return observer

    def frame(self) -> Frame:
        whole = Segment(self.rover.run_id, -math.inf, math.inf)
        return read_frame(self.rows.connection, whole, Deadline())

    def signals(self) -> set[str]:
        listed = list_signals(self.rows.connection, robot="rover")
        return {each.name for each in listed.signals}


@pytest.fixture
def seen(tmp_path: Path) -> Iterator[Seen]:
    seen = Seen(tmp_path)
    yield seen
    seen.rows.close()


@pytest.mark.parametrize("in_chunks", [False, True])
def test_the_pose_at_each_row_lies_between_those_that_were_seen(
    seen: Seen, *, in_chunks: bool
) -> None:
    seen.drive()
    seen.observe()
    if in_chunks:
        make_chunks(seen.rows.connection, 100_000)
    frame = seen.frame()
    wanted = [x_m(time_s) for time_s in frame.times.tolist()]
    assert frame.numbers("observer.x_m").tolist() == pytest.approx(wanted, abs=1e-9)
    assert frame.zone_map("observer.x_m").value_count.sum() == len(frame)
    turned = zip(frame.numbers("observer.heading_rad"), map(yaw, frame.times), strict=True)
    assert max(abs(math.remainder(is_s - was, math.tau)) for is_s, was in turned) < 0.05


@pytest.mark.anyio
async def test_every_question_has_that_position_and_names_its_source(seen: Seen) -> None:
    seen.drive()
    seen.observe()
    server = create_server(seen.recording.database, seen.recording.data_dir)
    async with Client(server) as client:

        async def told(tool: str, **arguments: Any) -> dict[str, Any]:
            return await ask(client, tool, robot="rover", **arguments)

        state = (await told("webots_get_robot_state"))["state"]
        wanted = {"x_m": 10.0, "y_m": 0.25, "z_m": 0.04, "heading_rad": yaw(59.92)}
        assert state["observer"] == pytest.approx(wanted, abs=0.05)
        whole = await told("webots_get_full_state", path="observer.x_m")
        assert whole["state"] == pytest.approx(10.0)

        stuck = await told("webots_find_events", kinds=["standstill"])
        assert [row[:2] for row in stuck["events"]["rows"]] == [["standstill", 20.0]]
        assert stuck["position_by"].startswith("observer 'mcp_observer' saw the position")
        where = await told("webots_find_events", where="displacement(3) < 0.01")
        assert "observer.x_m" in str(where["events"])
        assert "observer.x_m" in str(await told("webots_get_trends"))
        names = ["observer.x_m", "mode"]
        for raw in (False, True):
            history = await told("webots_query_history", signals=names, raw=raw, end_s=1)
            assert "observer.x_m" in str(history)
        checked = await told("webots_check_run", expect=["displacement(3) < 1.6"])
        assert "displacement(3) < 1.6" in str(checked["passed"])
        plot = await client.call_tool("webots_plot", {"kind": "trajectory", "robot": "rover"})
        assert "observer.y_m [m] over observer.x_m [m]" in text_of(plot)


def test_how_far_it_went_is_measured(seen: Seen) -> None:
    seen.drive()
    seen.observe()
    frame = seen.frame()
    with seen.recording.view("rover") as view:
        known = catalogue(view.connection, view.subject)
    motion = motion_in(frame, known, EventOptions())
    assert motion.position is not None
    assert way_in(frame, motion.position).length.length_m == pytest.approx(10.0, rel=0.01)


@pytest.mark.parametrize("position", [{"pose": [1.0, 2.0, 0.0]}, {"gps": {"x": 1.0, "y": 2.0}}])
def test_a_robot_that_publishes_its_position_keeps_it(seen: Seen, position: dict[str, Any]) -> None:
    seen.drive(**position)
    seen.observe()
    assert not any(name.startswith("observer") for name in seen.signals())


def test_a_gps_that_never_had_a_fix_is_no_position(seen: Seen) -> None:
    seen.drive(gps={"x": None, "y": None})
    seen.observe()
    assert "observer.x_m" in seen.signals()


def test_what_was_not_observed_has_no_pose(seen: Seen) -> None:
    seen.drive()
    seen.observe(start_s=30.0)
    frame = seen.frame()
    has_pose = frame.held("observer.x_m")
    assert frame.times[has_pose].min() == pytest.approx(30.0, abs=0.1)
    assert has_pose.sum() == pytest.approx(len(frame) / 2, abs=3)


def test_an_observer_of_another_simulation_did_not_see_it(seen: Seen) -> None:
    seen.drive()
    seen.observe(instance="webots-2")
    assert seen.signals() == {"mode"}


def test_an_empty_world_at_the_very_end_takes_nothing_back(seen: Seen) -> None:
    seen.drive()
    observer = seen.observe()
    observer.event(LASTS_S, "world", None, {"robots": []})
    assert "observer.x_m" in seen.signals()
