"""Which numbers are angles, so that their means and trends go the short way round."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

from tests.history.recording import Recorder
from webots_mcp.store.reading.ranges import resolve_range
from webots_mcp.store.rollup.rolling import roll
from webots_mcp.store.signals.catalogue import known_signals


def turning(time_s: float) -> dict[str, Any]:
    yaw_rad = math.remainder(0.3 * time_s, math.tau)
    return {
        "pose": [time_s, 0.0, yaw_rad],
        "arm": {"pose": [0.1, 0.2, 0.05 * time_s]},
        "drone": {"pose": [time_s, 0.0, 1.5, 0.0, 0.0, yaw_rad]},
    }


def test_the_third_item_of_a_planar_pose_is_an_angle(empty: sqlite3.Connection) -> None:
    recorder = Recorder(empty)
    robot_id = recorder.robot("rover")
    recorder.run(recorder.session(robot_id, "a" * 64), robot_id)
    for second in range(200):
        recorder.publish(float(second), turning(float(second)))
    before = known_signals(empty, resolve_range(empty))
    roll(empty, 100_000)
    for known in (before, known_signals(empty, resolve_range(empty))):
        assert (known["pose.2"].kind, known["pose.2"].unit) == ("angle", "rad")
        assert known["arm.pose.2"].kind == "num"  # goes up to 10
        assert known["drone.pose.2"].kind == "num"  # of six items the third is z
