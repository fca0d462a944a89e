"""Tools that read: what they answer, and what they say when there is nothing to answer."""

from __future__ import annotations

import base64
import io
import json
import os
import sqlite3
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, ask, fail, pictures_of, text_of
from webots_mcp.bridge.encoding import encode
from webots_mcp.contract import SCHEMA_VERSION
from webots_mcp.server.sensing import unnamed_devices
from webots_mcp.server.shortening import compact_json
from webots_mcp.store.migrate import upgrade

pytestmark = pytest.mark.anyio

DEFAULT_LIMIT = 8_000  # characters: about 2,000 tokens
FULL_LIMIT = 22_000
DATA_TOOLS = (
    "webots_list_robots",
    "webots_get_world_info",
    "webots_get_robot_state",
    "webots_get_sensors",
    "webots_get_full_state",
    "webots_get_logs",
    "webots_list_commands",
)


async def test_every_answer_names_robot_run_time_age_and_status(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    written_s = time.time() - 0.5
    for step in (2, 1, 0):  # rows 10 s apart: a slow test still finds the robot running
        robot.state(12.34567 - step, {"x": 1}, at=written_s - 10 * step)
    async with connect() as client:
        for tool in DATA_TOOLS:
            asked_s = time.time()
            answer = await ask(client, tool)
            header = [answer[name] for name in ("robot", "run_id", "sim_time_s", "status")]
            assert header == ["rover", robot.run_id, 12.3457, "running"], tool
            assert asked_s - written_s - 0.01 < answer["age_s"] < time.time() - written_s + 0.01


async def test_the_header_tells_the_time_before_the_first_state(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot()
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state")
    assert answer["sim_time_s"] == 0.0
    assert "bridge.publish" in answer["hint"]


async def test_a_new_run_without_a_state_points_to_the_one_before(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    earlier = robot.run_id
    robot.begin_run("reset")
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state")
    assert f"in an earlier one (run_id={earlier})" in answer["hint"]


async def test_without_a_database_every_reading_tool_says_how_to_get_one(
    connect: Connect, file: Path
) -> None:
    async with connect() as client:
        for tool in DATA_TOOLS:
            answer = await ask(client, tool)
            assert answer["status"] == "never seen"
            for word in (str(file), "MCPBridge", "webots-mcp demo", "--data-dir"):
                assert word in answer["hint"], tool
        assert "MCPBridge" in text_of(await client.call_tool("webots_get_camera", {}))
        assert "MCPBridge" in text_of(await client.call_tool("webots_monitor", {}))
    assert not file.exists()


async def test_an_empty_file_and_an_empty_database_are_nothing_recorded_either(
    connect: Connect, file: Path
) -> None:
    file.touch()
    async with connect() as client:
        assert "is empty" in (await ask(client, "webots_list_robots"))["hint"]
        Recorded(file).close()
        assert "MCPBridge" in (await ask(client, "webots_list_robots"))["hint"]


async def test_a_database_that_appears_later_is_found(connect: Connect, file: Path) -> None:
    async with connect() as client:
        assert (await ask(client, "webots_get_robot_state"))["status"] == "never seen"
        recorded = Recorded(file)
        recorded.robot().state(1.0, {"x": 1})
        assert (await ask(client, "webots_get_robot_state"))["state"] == {"x": 1}
        recorded.close()


async def test_several_live_robots_are_listed_until_one_is_named(
    connect: Connect, recorded: Recorded
) -> None:
    for name in ("rover", "crane"):
        recorded.robot(name).state(1.0, {"i am": name})
    async with connect() as client:
        assert "'rover' (Supervisor, live)" in await fail(client, "webots_get_robot_state")
        answer = await ask(client, "webots_get_robot_state", robot="crane")
        assert answer["state"] == {"i am": "crane"}
        assert "did you mean 'crane'" in await fail(client, "webots_get_robot_state", robot="crne")
        rows = (await ask(client, "webots_list_robots"))["robots"]["rows"]
        assert [row[0] for row in rows] == ["rover", "crane"]


async def test_an_earlier_run_can_be_read_and_is_named_as_such(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(5.0, {"x": 5})
    robot.end_run("reset")
    first = robot.run_id
    robot.begin_run("reset")
    robot.state(1.0, {"x": 1})
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state", run_id=first)
        assert (answer["state"], answer["sim_time_s"]) == ({"x": 5}, 5.0)
        assert answer["status"].startswith("stopped")
        assert "earlier run; it ended by reset" in answer["why"]
        assert "no run 77" in await fail(client, "webots_get_robot_state", run_id=77)


async def test_the_state_is_rounded_and_long_arrays_are_summarised(
    connect: Connect, recorded: Recorded
) -> None:
    lidar = [5.0 + i for i in range(180)]
    lidar[7] = 0.123456
    recorded.robot().state(1.0, {"pose": [1.23456, -2.0], "lidar": lidar})
    async with connect() as client:
        answer = await ask(client, "webots_get_robot_state")
    assert answer["state"]["pose"] == [1.235, -2.0]
    assert answer["state"]["lidar"]["argmin"] == 7
    assert "arrays over 16 items" in answer["shortened"]
    assert "webots_get_full_state" in answer["hint"]


async def test_odd_values_are_recognisable(connect: Connect, recorded: Recorded) -> None:
    lidar = [float("inf")] * 40 + [0.5] * 140
    encoded = encode({"front": float("nan"), "lidar": lidar, "x": 1.0})
    robot = recorded.robot()
    robot.state(1.0, json.loads(encoded.text), encoded.odd)
    async with connect() as client:
        answer = await ask(client, "webots_get_sensors")
    assert answer["sensors"]["front"] == "nan"
    assert answer["sensors"]["lidar"]["inf"] == 40
    assert answer["replaced"]["front"] == "nan"
    assert "x" not in answer["sensors"]
    assert answer["devices_not_named_in_state"] == "eye (Camera)"


def test_a_device_is_named_in_the_state_however_its_words_are_arranged() -> None:
    names = ("ds0", "ds7", "front left sonar", "leftEncoder", "range_finder", "gps")
    devices: dict[str, str] = dict.fromkeys(names, "DistanceSensor")
    state = {"ds": [1, 2], "sonar": {"front_left": 1.0}, "encoder": {"left": 3}, "seen": {"gps": 1}}
    assert list(unnamed_devices(state, devices)) == ["ds7", "range_finder"]


async def test_a_state_without_sensors_says_where_to_look(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"x": 1.0})
    async with connect() as client:
        answer = await ask(client, "webots_get_sensors")
    assert answer["sensors"] == {}
    assert "webots_get_robot_state" in answer["hint"]


@pytest.mark.parametrize(
    "state",
    [
        {"lidar": [0.1 * i for i in range(180)], "pose": [1.0, 2.0, 3.0]},
        {"text": "x" * 1_000_000},
        {f"key {i}": {"value": i * 1.234567, "text": "y" * 50} for i in range(10_000)},
        {"grid": [[float(i * j) for i in range(200)] for j in range(200)]},
    ],
    ids=["lidar", "long text", "1 MB of keys", "grid"],
)
async def test_answers_stay_short_whatever_is_published(
    connect: Connect, recorded: Recorded, state: dict[str, Any]
) -> None:
    robot = recorded.robot()
    robot.state(1.0, state)
    robot.beat(actions=json.dumps({f"action {i}": "z" * 5000 for i in range(100)}))
    for i in range(100):
        robot.log(1.0, f"{i} " + "w" * 10_000, "warning")
        robot.event(1.0, "change", "text", {"from": "v" * 5000, "to": "u" * 5000})
    async with connect() as client:
        for tool in DATA_TOOLS:
            characters = len(compact_json(await ask(client, tool)))
            limit = FULL_LIMIT if tool == "webots_get_full_state" else DEFAULT_LIMIT
            assert characters < limit, tool


async def test_a_part_of_the_state_comes_whole_in_pages(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot().state(1.0, {"sensors": {"lidar": [i + 0.123456 for i in range(180)]}})
    async with connect() as client:
        path = "sensors.lidar"
        page = await ask(client, "webots_get_full_state", path=path, limit=100)
        assert page["state"][:2] == [0.123456, 1.123456]
        assert (page["total"], page["next_offset"]) == (180, 100)
        rest = await ask(client, "webots_get_full_state", path=path, offset=100)
        assert len(rest["state"]) == 80
        assert "next_offset" not in rest
        assert "there are ['lidar']" in await fail(
            client, "webots_get_full_state", path="sensors.lidr"
        )


async def test_the_full_state_has_events_and_the_recorders_health(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot(rows_waiting=3, rows_dropped=2, last_error="disk full")
    robot.state(1.0, {"x": 0.123456789})
    robot.event(0.5, "change", "mode", {"from": "a", "to": "b"})
    async with connect() as client:
        answer = await ask(client, "webots_get_full_state")
    assert answer["state"] == {"x": 0.123456789}
    assert answer["events"]["rows"] == [[0.5, "change", "mode", {"from": "a", "to": "b"}]]
    health = answer["recorder"]
    assert (health["rows_waiting"], health["rows_dropped"]) == (3, 2)
    assert health["last_error"] == "disk full"
    assert health["controller_sha256"] == "a" * 64


async def test_the_full_state_says_which_seconds_were_kept_last(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.state(60.0, {"x": 1})
    async with connect() as client:
        assert "kept_at_full_rate" not in (await ask(client, "webots_get_full_state"))["recorder"]
        robot.kept(5.0, 12.0, "breakpoint 1: front_m < 0.1")
        robot.kept(40.0, 47.0, "error: the gear is gone")
        answer = await ask(client, "webots_get_full_state")
        seen = await ask(client, "webots_get_robot_state")
        robot.kept(58.0, 62.0, "pause")
        goes_on = (await ask(client, "webots_get_robot_state"))["kept_at_full_rate"]
    assert goes_on == "58.000 s on, until 62.000 s: pause"
    assert seen["kept_at_full_rate"] == answer["recorder"]["kept_at_full_rate"]
    assert answer["recorder"]["kept_at_full_rate"] == "40.000-47.000 s: error: the gear is gone"


async def test_the_world_is_described_with_its_companions(
    connect: Connect, recorded: Recorded
) -> None:
    rover = recorded.robot("rover")
    recorded.robot("referee")
    for i in range(5):
        rover.state(i * 1.0, {}, at=rover.now + i * 0.5)
    async with connect() as client:
        answer = await ask(client, "webots_get_world_info", robot="rover")
    assert answer["world"].endswith("arena.wbt")
    assert answer["basic_time_step_ms"] == 16.0
    assert answer["real_time_factor"] == 2.0
    assert answer["run"]["rows"] == 5
    assert answer["companions"]["rows"] == [["referee", "Supervisor", ""]]
    assert answer["controller"]["file"].endswith("rover.py")


async def test_log_lines_are_paged_towards_older_ones(connect: Connect, recorded: Recorded) -> None:
    robot = recorded.robot()
    for i in range(120):
        robot.log(i * 1.0, f"line {i}", "error" if i % 10 == 0 else "info")
    async with connect() as client:
        newest = await ask(client, "webots_get_logs")
        assert [row[2] for row in newest["lines"]["rows"]][-1] == "line 119"
        assert (len(newest["lines"]["rows"]), newest["matching"]) == (50, 120)
        older = await ask(client, "webots_get_logs", cursor=newest["cursor"])
        assert older["lines"]["rows"][-1][2] == "line 69"
        errors = await ask(client, "webots_get_logs", level="error", start_s=50, end_s=100)
        assert [row[0] for row in errors["lines"]["rows"]] == [50.0, 60.0, 70.0, 80.0, 90.0]
        nothing = await ask(client, "webots_get_logs", filter_text="collision")
        assert "leave out filter_text" in nothing["hint"]
        assert "less than end_s" in await fail(client, "webots_get_logs", start_s=5, end_s=5)


async def test_log_lines_come_from_before_a_reset_too_each_with_its_run(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    before = robot.run_id
    robot.log(60.0, "before the reset", "critical")
    robot.run_id = robot.begin_run("reset")
    robot.log(0.5, "after the reset")
    recorded.robot("other").log(1.0, "of another robot")
    async with connect() as client:
        newest = await ask(client, "webots_get_logs", robot="rover")
        rows = [(row[2], row[3]) for row in newest["lines"]["rows"]]
        assert rows == [("before the reset", before), ("after the reset", robot.run_id)]
        ranged = await ask(client, "webots_get_logs", robot="rover", last_s=10)
        assert [row[2] for row in ranged["lines"]["rows"]] == ["after the reset"]
        earlier = await ask(client, "webots_get_logs", run_id=before)
        assert [row[2] for row in earlier["lines"]["rows"]] == ["before the reset"]
        grave = await ask(client, "webots_get_logs", robot="rover", level="critical")
        assert [row[1] for row in grave["lines"]["rows"]] == ["critical"]


async def test_a_camera_frame_comes_as_a_picture_with_its_age(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    robot = recorded.robot()
    robot.state(2.0, {})
    (file.parent / "camera").mkdir()
    Image.new("RGB", (160, 120), "red").save(file.parent / "camera" / "1.png")
    robot.image(1.5, "camera/1.png")
    async with connect() as client:
        result = await client.call_tool("webots_get_camera", {})
        caption = json.loads(text_of(result))
        assert (caption["camera"], caption["picture_sim_time_s"]) == ("eye", 1.5)
        assert caption["picture_age_s"] >= 0
        assert [picture.mime_type for picture in pictures_of(result)] == ["image/png"]
        other = await client.call_tool("webots_get_camera", {"camera": "left"})
        assert "there are some of run_id=1: eye" in text_of(other)


async def test_a_big_picture_is_scaled_and_the_original_named(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    Image.new("RGB", (3000, 1500), "blue").save(file.parent / "big.png")
    recorded.robot().image(1.0, "big.png", width=3000, height=1500)
    async with connect() as client:
        result = await client.call_tool("webots_get_camera", {})
    assert pictures_of(result)[0].mime_type == "image/jpeg"
    assert "1000 x 500 of 3000 x 1500" in text_of(result)
    assert "big.png" in text_of(result)


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("gone.png", "the file is gone"),
        ("", "is not a regular file"),
        ("text.png", "is not a usable PNG or JPEG"),
        ("../../etc/passwd", "outside the data folder"),
        ("/etc/passwd", "outside the data folder"),
        ("a\0.png", "is not a usable path"),
        ("x" * 256, "is not a usable path"),
        ("x/" * 3000, "is not a usable path"),
        ("text.png/eye.png", "is not a usable path"),
        ("sparse.png", "it has 2,000,000,000 bytes, 64,000,000 is the limit"),
        ("wide.png", "it has 64,000,000 pixels, 50,000,000 is the limit"),
        ("cut.png", "is not a usable PNG or JPEG"),
        ("frame.gif", "is not a usable PNG or JPEG"),
    ],
)
async def test_a_picture_that_cannot_be_shown_says_why(
    connect: Connect, recorded: Recorded, file: Path, path: str, said: str
) -> None:
    write_bad_pictures(file.parent)
    recorded.robot().image(1.0, path)
    async with connect() as client:
        assert said in text_of(await client.call_tool("webots_get_camera", {}))


def write_bad_pictures(folder: Path) -> None:
    (folder / "text.png").write_text("no picture")
    Image.new("1", (8000, 8000)).save(folder / "wide.png")
    Image.new("RGB", (40, 30)).save(folder / "frame.gif")
    Image.effect_noise((400, 300), 50).save(folder / "whole.png")
    (folder / "cut.png").write_bytes((folder / "whole.png").read_bytes()[:5000])
    (folder / "sparse.png").write_bytes((folder / "whole.png").read_bytes())
    os.truncate(folder / "sparse.png", 2_000_000_000)


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes of POSIX")
async def test_a_link_or_a_pipe_in_the_place_of_a_picture_is_not_opened(
    connect: Connect, recorded: Recorded, file: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "secret.png"
    Image.new("RGB", (40, 30)).save(elsewhere)
    (file.parent / "out.png").symlink_to(elsewhere)
    (file.parent / "loop.png").symlink_to("loop.png")
    os.mkfifo(file.parent / "pipe.png")
    robot = recorded.robot()
    async with connect() as client:
        for path, said in (
            ("out.png", "outside the data folder"),
            ("loop.png", "is not a usable path"),
            ("pipe.png", "is not a regular file"),
        ):
            robot.image(1.0, path)
            assert said in await fail(client, "webots_get_camera"), path


async def test_a_small_picture_in_a_long_file_is_encoded_anew(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    Image.new("RGB", (40, 30)).save(file.parent / "long.png")
    with (file.parent / "long.png").open("ab") as end:
        end.write(bytes(10_000_000))
    recorded.robot().image(1.0, "long.png")
    async with connect() as client:
        result = await client.call_tool("webots_get_camera", {})
    assert len(pictures_of(result)[0].data) < 10_000


async def test_the_frames_around_a_hit_are_shown_by_time_one_or_many(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    robot = recorded.robot()
    for second in range(10):
        Image.new("RGB", (16, 12), (second * 20, 0, 0)).save(file.parent / f"{second}.png")
        robot.image(second, f"{second}.png", kind="kept" if 3 <= second <= 7 else "camera")
    robot.kept(2.5, 7.5, "breakpoint 1: n == 5")
    async with connect() as client:

        async def shown(**arguments: Any) -> tuple[dict[str, Any], Image.Image]:
            result = await client.call_tool("webots_get_camera", arguments)
            picture = Image.open(io.BytesIO(base64.b64decode(pictures_of(result)[0].data)))
            return json.loads(text_of(result)), picture.convert("RGB")

        newest, _ = await shown()
        near, picture = await shown(at_s=5.2)
        several, sheet = await shown(at_s=5.0, frames=4)
        missing, _ = await shown(at_s=2.4, frames=16)
        far, _ = await shown(at_s=-30.0)
    assert far["hint"] == "no picture is nearer to -30 s than 30.0 s" and "hint" not in near
    assert newest["picture_sim_time_s"] == 9.0 and "kept" not in newest
    assert (near["picture_sim_time_s"], near["kept"]) == (5.0, "breakpoint 1: n == 5")
    assert picture.getpixel((8, 6)) == (100, 0, 0)
    assert several["pictures_sim_time_s"] == [4.0, 5.0, 6.0, 7.0]
    reds = [sheet.getpixel((x, y)) for y in (6, 22) for x in (8, 28)]
    assert reds == [(20 * second, 0, 0) for second in (4, 5, 6, 7)]
    assert missing["pictures_sim_time_s"] == [0.0, 1.0, 2.0, 8.0, 9.0]


async def test_a_kept_stretch_says_that_it_has_camera_frames(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    for second in range(10):
        robot.state(second, {"n": second})
        robot.image(second, f"{second}.png", kind="kept")
    robot.kept(2.0, 6.0, "a look")
    async with connect() as client:
        (event,) = (await ask(client, "webots_find_events", kinds=["kept"]))["events"]["rows"]
    assert "'frames': 5" in str(event)


async def test_a_controller_that_saves_no_frames_is_told_how_to(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot()
    async with connect() as client:
        assert "save_camera_frame" in text_of(await client.call_tool("webots_get_camera", {}))


async def test_a_file_that_is_no_database_is_a_clear_error(connect: Connect, file: Path) -> None:
    file.write_text("certainly no database, " * 100)
    async with connect() as client:
        assert "is not a database" in await fail(client, "webots_list_robots")


async def test_a_database_of_another_application_is_left_alone(
    connect: Connect, file: Path
) -> None:
    with sqlite3.connect(file) as other:
        other.execute("CREATE TABLE contact (name TEXT)")
    other.close()
    async with connect() as client:
        text = await fail(client, "webots_list_robots")
    assert f"{file} belongs to another application" in text


async def test_a_damaged_database_is_a_clear_error(
    connect: Connect, recorded: Recorded, file: Path
) -> None:
    recorded.robot()
    recorded.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    recorded.close()
    data = file.read_bytes()
    file.write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))
    async with connect() as client:
        assert "damaged" in await fail(client, "webots_list_robots")


async def test_a_database_of_a_newer_version_is_a_clear_error(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    async with connect() as client:
        assert "pip install --upgrade" in await fail(client, "webots_list_robots")


async def test_an_older_database_is_migrated_once_by_the_server(
    connect: Connect, file: Path
) -> None:
    upgrade(file, "0001")
    async with connect() as client:
        assert (await ask(client, "webots_list_robots"))["status"] == "never seen"
    connection = sqlite3.connect(file)
    assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
    connection.close()


async def test_a_read_only_server_does_not_migrate(connect: Connect, file: Path) -> None:
    upgrade(file, "0001")
    async with connect(read_only=True) as client:
        assert "webots-mcp migrate" in await fail(client, "webots_list_robots")


async def test_where_a_run_has_no_frame_those_that_have_some_are_named(
    connect: Connect, recorded: Recorded
) -> None:
    robot = recorded.robot()
    robot.image(1.0, "camera/a.png")
    second = recorded.robot()
    second.state(1.0, {"x": 1})
    async with connect() as client:
        for camera in ("", "eye", "left"):
            told = text_of(await client.call_tool("webots_get_camera", {"camera": camera}))
            assert f"there are some of run_id={robot.run_id}: eye" in told
