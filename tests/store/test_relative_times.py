"""How long ago something was, in words, and the time of day in the data of an answer."""

from __future__ import annotations

import time
from datetime import datetime
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.store.recording import view_robot
from webots_mcp.store.relative_times import LONG_AGO_S, age_in_words, ago


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (-3.0, "0.0 s"),
        (0.25, "0.2 s"),
        (9.94, "9.9 s"),
        (42.4, "42 s"),
        (119.0, "119 s"),
        (120.0, "2 minutes"),
        (7_199.0, "120 minutes"),
        (7_200.0, "2 hours"),
        (172_800.0, "2 days"),
        (95_892_994.0, "3 years"),
        (86_400.0 * 100, "3 months"),
    ],
)
def test_an_age_is_said_in_the_unit_in_which_a_person_thinks_of_it(
    seconds: float, words: str
) -> None:
    assert age_in_words(seconds) == words
    assert ago(seconds) == f"{words} ago"


def test_what_is_long_ago_is_said_in_words_and_comes_with_its_time_of_day(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    now_s = time.time()
    young = view_robot(recorded.connection, "rover").header()
    assert "newest_wall_time" not in young
    at_s = now_s - 95_892_994.0
    recorded.connection.execute("UPDATE state SET wall_time_s = ?", (at_s,))
    recorded.connection.execute("UPDATE run SET last_wall_time_s = ?", (at_s,))
    recorded.connection.execute(
        "UPDATE session SET started_wall_time_s = ?1, last_seen_wall_time_s = ?1, "
        "moved_wall_time_s = ?1, ended_wall_time_s = ?1, end_reason = 'finished'",
        (at_s,),
    )
    old = view_robot(recorded.connection, "rover").header()
    recorded.close()
    assert old["status"] == "stopped 3 years ago"
    assert old["age_s"] == pytest.approx(95_892_994.0, abs=120) and old["age_s"] > LONG_AGO_S
    said_s = datetime.fromisoformat(old["newest_wall_time"].replace("Z", "+00:00")).timestamp()
    assert said_s == pytest.approx(at_s, abs=1.0)
