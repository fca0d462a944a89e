"""Events, the timeline and the monitor, asked by a client of a recording whose story is known."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import STUCK_S
from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail
from tests.server.history.conftest import STORY, tell
from tests.server.story import WAYS, Way, client_on, rows_of
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions

pytestmark = pytest.mark.anyio


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
async def test_since_when_is_it_stuck_is_one_call_in_both_eras_and_over_stdio(
    story: Path, way: Way
) -> None:
    async with client_on(story, way) as client:
        answer = await ask(client, "webots_find_events", kinds=["stuck"], run_id=STORY)
    (stuck,) = rows_of(answer["events"])
    assert stuck["start_s"] == pytest.approx(STUCK_S[0], abs=0.2)
    assert stuck["duration_s"] == pytest.approx(STUCK_S[1] - STUCK_S[0], abs=0.3)
    assert (stuck["details"]["mode"], stuck["@mode"], stuck["@pose.0"]) == ("cruise", "cruise", 8.0)


async def test_position_and_mode_can_be_named(recorded: Recorded, connect: Connect) -> None:
    robot = recorded.robot()
    for step in range(200):
        # It drives 3 m in 10 s, stands, and drives on.
        x_mm = 30.0 * (min(step, 100) + max(0, step - 190))
        robot.state(step * 0.1, {"rail": {"alongMm": x_mm, "acrossMm": 0.0}, "betriebsart": 1})
    named = {"position": ["rail.alongMm", "rail.acrossMm"], "mode": "betriebsart"}
    async with connect(read_only=True) as client:
        unnamed = await ask(client, "webots_find_events", kinds=["stuck"])
        assert "position=[x, y]" in str(unnamed["verdicts"]["not_searched"])
        answer = await ask(client, "webots_find_events", kinds=["stuck"], **named)
        (stuck,) = rows_of(answer["events"])
        assert stuck["start_s"] == pytest.approx(10.0, abs=0.2)
        assert stuck["details"]["x_m"] == pytest.approx(3.0, abs=0.05)
        compared = await ask(client, "webots_compare_runs", run_ids=[robot.run_id], **named)
        medians = {each["name"]: each["median"] for each in rows_of(compared["measures"])}
        assert medians["distance_m"] == [pytest.approx(3.27, rel=0.05)]
        assert medians["share of 1"] == [1.0]
        wrong = await fail(client, "webots_compare_runs", position=["rail.alongMm"])
        assert "position" in wrong


async def test_the_timeline_goes_on_page_by_page(story: Path) -> None:
    seen: list[tuple[Any, ...]] = []
    cursor = ""
    async with client_on(story) as client:
        while True:
            page = await ask(client, "webots_get_timeline", run_id=STORY, limit=4, cursor=cursor)
            seen += [(r["kind"], r.get("name"), r["start_s"]) for r in rows_of(page["events"])]
            if not (cursor := page.get("cursor", "")):
                break
    assert len(seen) == len(set(seen)) == sum(page["verdicts"]["found"].values())
    assert [at for _, _, at in seen] == sorted(at for _, _, at in seen)
    assert ("command", "set_speed", 20.0) in seen
    assert ("image", "cam", 30.0) in seen


async def test_of_each_kind_it_is_told_whether_it_was_found_is_absent_or_was_not_searched(
    story: Path,
) -> None:
    for kinds in (["stuck", "gap"], ["jump", "missing", "flat", "oscillation"], None):
        told = (await tell(story, "webots_find_events", kinds=kinds))["verdicts"]
        absent = [*told.get("nearest", ()), *told.get("not_found", "").split(", ")]
        unsearched = [kind for each in told.get("not_searched", ()) for kind in each.split(", ")]
        lacking = [kind for kind in (*absent, *unsearched) if kind]
        assert len(lacking) == len(set(lacking))
        asked = {*(kinds or (kind.name for kind in asked_kinds(EventOptions())))}
        if kinds is None:
            asked -= {"violation"}  # nothing is expected
        assert {*told.get("found", ()), *lacking} == asked
    (answer,) = [await tell(story, "webots_find_events", kinds=["standstill"], signals=["mode"])]
    assert (
        "standstill" in answer["verdicts"]["nearest"] or answer["verdicts"]["found"]["standstill"]
    )
    blind = await tell(story, "webots_find_events", kinds=["missing"], signals=["mode"])
    assert blind["verdicts"] == {
        "not_searched": {"missing": "no number was published, or none with these names"}
    }


@pytest.mark.slow
async def test_what_find_events_does_not_show_is_named_by_time_and_a_cursor_shows_it(
    story: Path,
) -> None:
    async with client_on(story) as client:
        told: Counter[str] = Counter()
        asked: dict[str, Any] = {"run_id": STORY, "limit": 4}
        while True:
            answer = await ask(client, "webots_find_events", **asked)
            rows = answer["events"]["rows"]
            assert 0 < len(rows) <= 4
            told.update(row[0] for row in rows)
            if "cursor" not in answer:
                break
            assert all(" from " in each for each in answer["not_shown"].values())
            asked["cursor"] = answer["cursor"]
    assert told == Counter(answer["verdicts"]["found"]) and "image" not in told


async def test_an_error_that_many_warnings_follow_is_counted_among_what_is_not_shown(
    recorded: Recorded, connect: Connect
) -> None:
    robot = recorded.robot()
    robot.state(0.0, {"n": 0})
    robot.log(1.0, "the motor driver failed", "error")
    for number in range(60):
        letters = chr(97 + number % 26) * 5 + chr(97 + number // 26)
        robot.log(2.0 + number, f"{letters} is not what {letters} was {letters * 3}", "warning")
    robot.state(70.0, {"n": 1})
    async with connect(read_only=True) as client:
        for tool, asked in (("webots_find_events", {}), ("webots_monitor", {"lookback_wall_s": 9})):
            not_shown = (await ask(client, tool, **asked))["not_shown"]
            assert not_shown["log"].endswith(" s, errors among them: 1")


async def test_what_is_left_out_of_several_runs_is_named_by_run_because_each_has_its_own_time(
    recorded: Recorded, connect: Connect
) -> None:
    robot = recorded.robot()
    for run in (1, 2):
        if run == 2:
            robot.end_run("reset")
            robot.run_id = robot.begin_run("reset")
        for step in range(1, 5):
            robot.state(3.0 * step / run, {"n": step})
            robot.log(3.0 * step / run, f"it slips {step}", "warning")
    async with connect(read_only=True) as client:
        asked: dict[str, Any] = {"kinds": ["log"], "since_wall_time": 0, "group": False}
        both = await ask(client, "webots_find_events", limit=1, **asked)
        one = await ask(client, "webots_find_events", kinds=["log"], group=False, limit=1)
    assert both["not_shown"] == {"log": "7 from 3.0 s of run 1 to 4.5 s of run 2"}
    assert one["not_shown"] == {"log": "3 from 1.5 to 4.5 s"}
