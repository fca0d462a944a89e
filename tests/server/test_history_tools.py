"""The tools about the past, asked by a real client, on a recording whose story is known."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import GAP_S, NAN_S, STUCK_S, WALL_START_S
from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail, pictures_of, text_of
from tests.server.story import WAYS, Way, client_on, copy_of, rows_of, write_story
from webots_mcp.connection import connect
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.registry import asked_kinds
from webots_mcp.store.rollup.rolling import roll

pytestmark = pytest.mark.anyio

STORY = 1  # the run of which the story tells
EVERY: tuple[tuple[str, dict[str, Any]], ...] = (
    ("webots_list_signals", {}),
    ("webots_query_history", {"signals": ["pose"]}),
    ("webots_get_trends", {}),
    ("webots_find_events", {}),
    ("webots_get_timeline", {}),
    ("webots_monitor", {"lookback_s": 5}),
    ("webots_compare_runs", {}),
    ("webots_list_runs", {}),
    ("webots_query_sql", {"sql": "SELECT 1"}),
)


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_story(tmp_path_factory.mktemp("story") / "webots.db")


async def tell(file: Path, tool: str, **arguments: Any) -> dict[str, Any]:
    async with client_on(file) as client:
        return await ask(client, tool, **arguments)


async def refuse(file: Path, tool: str, **arguments: Any) -> str:
    async with client_on(file) as client:
        return await fail(client, tool, **arguments)


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
        x_mm = 30.0 * min(step, 100)  # it drives 3 m in 10 s, and stands
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
        assert medians["distance_m"] == [pytest.approx(3.0, rel=0.05)]
        assert medians["share of 1"] == [1.0]
        wrong = await fail(client, "webots_compare_runs", position=["rail.alongMm"])
        assert "position" in wrong


async def test_every_answer_says_about_which_robot_and_run_and_as_of_when(story: Path) -> None:
    for tool, arguments in EVERY:
        answer = await tell(story, tool, **arguments)
        assert (answer["robot"], answer["run_id"], answer["sim_time_s"]) == ("rover", 3, 59.9), tool
        assert answer["status"].startswith("stopped "), tool
        assert answer["age_s"] > 0, tool


async def test_signals_have_kinds_ranges_and_rows_without_a_value(
    story: Path,
) -> None:
    answer = await tell(story, "webots_list_signals", run_id=STORY)
    signals = {row["signal"]: row for row in rows_of(answer["signals"])}
    assert answer["total"] == len(signals) == 15
    assert (signals["mode"]["kind"], signals["mode"]["last"]) == ("text", "cruise")
    assert (signals["battery_v"]["unit"], signals["battery_v"]["max"]) == ("V", 12.6)
    assert signals["sensors.bumper"]["last"] is False
    assert signals["sensors.front"]["missing"] == "in 40 of 1150 rows; values from 0.0 to 119.9 s"
    assert signals["mode"]["missing"] is None
    assert "lidar.argmin" in signals


async def test_signals_come_in_pages_and_by_pattern(story: Path) -> None:
    first = await tell(story, "webots_list_signals", limit=10)
    second = await tell(story, "webots_list_signals", limit=10, cursor=first["cursor"])
    names = [row["signal"] for part in (first, second) for row in rows_of(part["signals"])]
    assert names == sorted(set(names))
    assert len(names) == first["total"] == 15
    assert "cursor" not in second
    part = await tell(story, "webots_list_signals", pattern="lidar.*")
    assert part["total"] == 5


async def test_an_extreme_is_never_lost_in_a_bucket(story: Path) -> None:
    answer = await tell(story, "webots_query_history", signals=["ir"], run_id=STORY, max_points=4)
    (run,) = answer["runs"]
    assert len(run["sim_time_s"]) <= 4
    assert max(run["numbers"]["ir"]["max"]) == 5.0
    whole = run["numbers"]["ir"]["whole"]
    assert (whole["max"], whole["max_at_s"]) == (5.0, 70.0)
    assert run["gaps"] == [[89.9, 95.0]]
    assert sum(run["count"]) == run["rows"] == 1150


async def test_rows_in_a_gap_are_null_and_modes_are_change_points(story: Path) -> None:
    answer = await tell(
        story,
        "webots_query_history",
        signals=["pose.0", "mode"],
        run_id=STORY,
        start_s=85,
        end_s=99,
    )
    (run,) = answer["runs"]
    buckets = dict(zip(run["sim_time_s"], run["numbers"]["pose.0"]["mean"], strict=True))
    assert all(mean is None for at, mean in buckets.items() if GAP_S[0] <= at < GAP_S[1] - 1)
    assert run["states"]["mode"]["since_s"] == [60.0, 95.0]
    assert run["states"]["mode"]["value"] == ["avoid", "cruise"]


async def test_what_did_not_change_is_said_once(story: Path) -> None:
    answer = await tell(story, "webots_query_history", signals=["target"])
    assert answer["runs"][0]["numbers"]["target"] == {"constant": 3.0}


async def test_raw_rows_come_in_pages_that_neither_repeat_nor_miss_one(story: Path) -> None:
    times: list[float] = []
    cursor: int | None = 0
    async with client_on(story) as client:
        while cursor is not None:
            answer = await ask(
                client, "webots_query_history",
                signals=["pose.0"], raw=True, max_points=250, cursor=cursor, run_id=STORY,
            )  # fmt: skip
            times += answer["raw"]["sim_time_s"]
            cursor = answer.get("cursor")
    assert len(times) == len(set(times)) == 1150


async def test_a_wall_time_range_reaches_over_runs(story: Path) -> None:
    answer = await tell(
        story,
        "webots_query_history",
        signals=["pose.0"],
        since=WALL_START_S,
        until=WALL_START_S + 70,
    )
    assert [run["run_id"] for run in answer["runs"]] == [1, 2]
    iso = {"since": "2023-11-14T22:13:20Z", "until": "2023-11-14T22:14:30Z"}
    same = await tell(story, "webots_query_history", signals=["pose.0"], **iso)
    assert same["runs"] == answer["runs"]


async def test_trends_say_in_one_line_what_a_person_would_notice(story: Path) -> None:
    answer = await tell(story, "webots_get_trends", run_id=STORY)
    (run,) = answer["runs"]
    says = {row["signal"]: row["says"] for row in rows_of(run["numbers"])}
    assert "rises from 0 to 12.78" in says["pose.0"]
    assert "every 2 s" in says["heading"]
    assert "1 spike, the largest 5 at 70 s" in says["ir"]
    assert "no value in 40 of 1150 rows" in says["sensors.front"]
    modes = {row["signal"]: row for row in rows_of(run["states"])}
    assert modes["mode"]["time_by_value_s"]["back_up"] == pytest.approx(8.0, abs=0.2)
    assert run["numbers"]["columns"] == ["signal", "says", "last", "mean", "deviation"]
    told = run["constant"].split(", ")
    assert "target 3" in told and len(told) == 4
    assert not says.keys() & {each.split(" ")[0] for each in told}


async def test_events_tell_what_nobody_noted(story: Path) -> None:
    answer = await tell(story, "webots_find_events", run_id=STORY)
    events = rows_of(answer["events"])
    found = {(event["kind"], event["name"]): event for event in events}
    assert found["silent", "sensors.front"]["start_s"] == NAN_S[0]
    assert found["gap", None]["start_s"] == pytest.approx(GAP_S[0], abs=0.2)
    assert found["oscillation", "heading"]["details"]["period_s"] == pytest.approx(2.0, rel=0.05)
    assert found["jump", "ir"]["start_s"] == 70.0
    assert [event["start_s"] for event in events] == sorted(event["start_s"] for event in events)
    assert sum(answer["verdicts"]["found"].values()) == len(events)


async def test_a_condition_is_found_in_the_past_as_often_as_it_would_have_been_hit(
    story: Path,
) -> None:
    where = "sensors.bumper and displacement(3) < 0.01"
    answer = await tell(story, "webots_find_events", run_id=STORY, where=where)
    assert answer["verdicts"]["found"] == {"condition": 1}
    (row,) = rows_of(answer["events"])
    assert (row["start_s"], row["name"]) == (43.0, where)
    assert row["details"]["sensors.bumper"] is True
    assert any("between two rows" in note for note in answer["notes"])
    assert "column 3" in await refuse(story, "webots_find_events", where="n = 3")


async def test_a_threshold_holds_for_at_least_so_long(story: Path) -> None:
    asked = {"signals": ["pose.0"], "above": 7.9, "run_id": STORY}
    both = await tell(story, "webots_find_events", **asked, for_s=2)
    assert [row["start_s"] for row in rows_of(both["events"])] == [39.6, 95.6]
    none = await tell(story, "webots_find_events", **asked, for_s=60)
    assert "pose.0 was beyond it for" in none["verdicts"]["came_near"]["threshold"]
    assert "need signals" in await refuse(story, "webots_find_events", above=1)


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


async def test_looking_back_reports_at_once_on_exactly_those_rows(story: Path) -> None:
    answer = await tell(story, "webots_monitor", lookback_s=15)
    (trend,) = answer["trends"]
    assert answer["rows"] == trend["rows"] == 301
    assert (trend["start_s"], trend["end_s"]) == (29.9, 59.9)
    assert answer["movement"]["distance_m"] == pytest.approx(9.0, abs=0.01)
    assert [row["details"]["what"] for row in rows_of(answer["events"])] == ["ended"]


async def test_looking_back_over_a_reset_tells_of_both_runs_and_no_way_between(
    story: Path, tmp_path: Path
) -> None:
    file = copy_of(story, tmp_path / "webots.db")
    with connect(file, "writer") as connection:
        connection.execute("DELETE FROM run WHERE id = 3")
    connection.close()
    answer = await tell(file, "webots_monitor", lookback_s=20)
    assert [trend["run_id"] for trend in answer["trends"]] == [1, 2]
    ways = answer["movement"]["runs"]
    assert sum(way["distance_m"] for way in ways) < 12  # the jump back would add 12.8


async def test_runs_tell_their_code_and_how_they_ended(story: Path) -> None:
    answer = await tell(story, "webots_list_runs")
    runs = rows_of(answer["runs"])
    assert [(run["run_id"], run["ended_by"]) for run in runs] == [
        (3, "finished"), (2, "crashed"), (1, "reset"),
    ]  # fmt: skip
    assert (runs[0]["controller"], runs[0]["sha256"], runs[0]["git_commit"]) == (
        "rover.py", "b" * 10, "beef",
    )  # fmt: skip
    assert runs[2]["notable"] == {"log error": 1, "log warning": 1, "dropped": 1}
    assert runs[2]["real_time_factor"] == pytest.approx(2.0, abs=0.01)
    older = await tell(story, "webots_list_runs", limit=1, cursor=3)
    assert [run["run_id"] for run in rows_of(older["runs"])] == [2]
    assert older["cursor"] == 2


async def test_before_and_after_the_last_edit_are_compared(story: Path) -> None:
    answer = await tell(story, "webots_compare_runs")
    before, after = rows_of(answer["groups"])
    assert (before["runs"], after["runs"]) == ([1, 2], [3])
    measures = {row["name"]: row for row in rows_of(answer["measures"])}
    assert answer["compared_s"] == pytest.approx(29.9, abs=0.01)
    assert measures["distance_m"]["median"][1] == pytest.approx(0.3 * 29.9, abs=0.01)
    differences = {row["signal"]: row for row in rows_of(answer["differences"])}
    assert differences["commanded_m_s"]["mean"] == [0.2, 0.3]
    assert "target" not in differences and "are equal" in answer["hint"]


async def test_a_label_is_kept_and_can_be_taken_away(story: Path, tmp_path: Path) -> None:
    file = copy_of(story, tmp_path / "webots.db")
    async with client_on(file, read_only=False) as client:
        answer = await ask(client, "webots_annotate_run", run_id=2, label="7", note="too slow")
        run = answer["run"]
        assert (run["run_id"], run["label"], run["note"]) == (2, "7", "too slow")
        answer = await ask(client, "webots_annotate_run", run_id=2, label="-")
        run = answer["run"]
        assert (run.get("label"), run["note"]) == (None, "too slow")
        assert "give a label or a note" in await fail(client, "webots_annotate_run", run_id=2)
        assert "no run 9" in await fail(client, "webots_annotate_run", run_id=9, label="x")


@pytest.mark.parametrize(
    "arguments",
    [
        {"run_id": STORY},
        {"kind": "trajectory", "run_id": STORY},
        {"signals": ["pose.0"], "run_ids": [2, 3]},
    ],
)
async def test_a_plot_is_a_caption_and_a_picture(story: Path, arguments: dict[str, Any]) -> None:
    async with client_on(story) as client:
        result = await client.call_tool("webots_plot", arguments)
    assert not result.is_error, text_of(result)
    assert result.structured_content is None
    (picture,) = pictures_of(result)
    assert picture.mime_type == "image/png"
    assert '"robot":"rover"' in text_of(result)
    assert '"shows":' in text_of(result)


async def test_sql_reads_and_the_schema_is_a_resource(story: Path) -> None:
    async with client_on(story) as client:
        sql = "SELECT run_id, count(*) AS rows FROM state GROUP BY run_id"
        answer = await ask(client, "webots_query_sql", sql=sql)
        assert answer["result"] == {"columns": ["run_id", "rows"],
                                    "rows": [[1, 1150], [2, 300], [3, 600]]}  # fmt: skip
        (content,) = (await client.read_resource("webots://schema")).contents
        assert "sim_time_s" in getattr(content, "text", "")


async def test_the_schema_is_told_before_anything_was_recorded(tmp_path: Path) -> None:
    async with client_on(tmp_path / "webots.db") as client:
        (content,) = (await client.read_resource("webots://schema")).contents
    assert "table state:" in getattr(content, "text", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("tool", "arguments", "words"),
    [
        ("webots_query_history", {"signals": ["moed"]}, "mode"),
        ("webots_query_history", {"signals": ["mode"], "run_id": 99}, "newest runs are [3, 2, 1]"),
        ("webots_get_trends", {"robot": "rovr"}, "did you mean 'rover'"),
        ("webots_get_trends", {"start_s": 9, "end_s": 3}, "reversed"),
        ("webots_find_events", {"start_s": 3, "end_s": 3}, "empty"),
        ("webots_get_trends", {"start_s": 3, "last_s": 3}, "two ways"),
        ("webots_get_trends", {"since": "yesterday"}, "ISO 8601"),
        ("webots_get_trends", {"since": 1700000100, "until": 1.7e9}, "until=1700000000"),
        ("webots_query_history", {"signals": ["mode"], "max_points": 10**9}, "less than or equal"),
        ("webots_find_events", {"kinds": ["threshold"]}, "above or below"),
        ("webots_find_events", {"kinds": ["explosion"]}, "must be one of 'run', 'gap'"),
        ("webots_get_timeline", {"cursor": "xyz"}, "no cursor"),
        ("webots_compare_runs", {"run_ids": [1, 1]}, "1 to 10"),
        ("webots_compare_runs", {"run_ids": [1, 99]}, "no run 99"),
        ("webots_plot", {"signals": ["nope"]}, "no signal 'nope'"),
        ("webots_query_sql", {"sql": "DELETE FROM state"}, "only one reading statement"),
        ("webots_query_sql", {"sql": "SELECT 1; SELECT 2"}, "only one statement"),
        ("webots_query_sql", {"sql": "ATTACH 'x' AS y"}, "only one reading statement"),
        ("webots_query_sql", {"sql": "SELECT sim_time FROM state"}, "sim_time_s"),
        ("webots_query_sql", {"sql": "SELECT * FROM stat"}, "state"),
    ],
)
async def test_bad_input_is_an_error_with_the_next_step(
    story: Path, tool: str, arguments: dict[str, Any], words: str
) -> None:
    assert words in await refuse(story, tool, **arguments)


async def test_without_a_database_every_tool_about_the_past_says_how_to_get_one(
    tmp_path: Path,
) -> None:
    file = tmp_path / "folder" / "webots.db"
    async with client_on(file) as client:
        for tool, arguments in EVERY:
            answer = await ask(client, tool, **arguments)
            assert answer["status"] == "never seen", tool
            assert "MCPBridge" in answer["hint"], tool
        assert "MCPBridge" in text_of(await client.call_tool("webots_plot", {}))
    assert not file.parent.exists()


async def test_a_run_without_a_row_says_so_in_every_tool(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    recorded.robot().log(0.0, "hello")
    async with client_on(tmp_path / "webots.db") as client:
        for tool, arguments in EVERY:
            if tool not in ("webots_list_runs", "webots_query_sql"):
                answer = await ask(client, tool, **arguments)
                assert (answer["robot"], answer["run_id"]) == ("rover", 1), tool
                assert answer["hint"], tool
    recorded.close()


async def test_sql_that_never_ends_is_ended(story: Path) -> None:
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"
    assert "give a recursion an end" in await refuse(
        story, "webots_query_sql", sql=endless.replace("SELECT x FROM c", "SELECT count(*) FROM c")
    )
    answer = await tell(story, "webots_query_sql", sql=endless)
    assert "only the first 100 rows" in answer["truncated"]
    huge = "SELECT hex(zeroblob(900000000))"
    assert "only reading" in await refuse(story, "webots_query_sql", sql=huge)


async def test_empty_answers_say_why_and_what_to_try(story: Path) -> None:
    for tool, arguments, words in (
        ("webots_get_trends", {"start_s": 500}, "leave the range out"),
        ("webots_query_history", {"signals": ["*"], "start_s": 500}, "leave the range out"),
        ("webots_get_trends", {"since": "2035-01-01"}, "webots_list_runs"),
        ("webots_query_sql", {"sql": "SELECT 1 WHERE 0"}, "webots_list_signals"),
    ):
        assert words in (await tell(story, tool, **arguments))["hint"], tool


async def test_of_each_kind_it_is_told_whether_it_was_found_is_absent_or_was_not_searched(
    story: Path,
) -> None:
    for kinds in (["stuck", "gap"], ["jump", "silent", "flat", "oscillation"], None):
        told = (await tell(story, "webots_find_events", kinds=kinds))["verdicts"]
        absent = [*told.get("came_near", ()), *told.get("absent", "").split(", ")]
        unsearched = [kind for each in told.get("not_searched", ()) for kind in each.split(", ")]
        lacking = [kind for kind in (*absent, *unsearched) if kind]
        assert len(lacking) == len(set(lacking))
        asked = {*(kinds or (kind.name for kind in asked_kinds(EventOptions())))}
        assert {*told.get("found", ()), *lacking} == asked
    (answer,) = [await tell(story, "webots_find_events", kinds=["still"], signals=["mode"])]
    assert "still" in answer["verdicts"]["came_near"] or answer["verdicts"]["found"]["still"]
    blind = await tell(story, "webots_find_events", kinds=["silent"], signals=["mode"])
    assert blind["verdicts"] == {
        "not_searched": {"silent": "no number was published, or none of these names"}
    }


async def test_answers_are_the_same_before_and_after_rolling_up(
    story: Path, tmp_path: Path
) -> None:
    rolled = copy_of(story, tmp_path / "webots.db")
    with connect(rolled, "writer") as connection:
        assert roll(connection, 100_000).done
    connection.close()
    for tool, arguments in (
        ("webots_list_signals", {"run_id": STORY}),
        ("webots_query_history", {"signals": ["*"], "run_id": STORY}),
        ("webots_get_trends", {"run_id": STORY}),
        ("webots_find_events", {"run_id": STORY}),
    ):
        before, after = [await tell(file, tool, **arguments) for file in (story, rolled)]
        changing = ("age_s", "status")
        assert {k: v for k, v in before.items() if k not in changing} == {
            k: v for k, v in after.items() if k not in changing
        }, tool


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
