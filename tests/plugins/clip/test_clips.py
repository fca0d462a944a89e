"""Clips as assistants ask for them: a contact sheet, and an animation in the data folder."""

from __future__ import annotations

import base64
import io
import json
import time
from pathlib import Path
from typing import Any

import pytest
from mcp import Client
from mcp.types import CallToolResult
from PIL import Image, ImageSequence

from tests.plugins.clip.conftest import HIT_S, Crash
from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, fail, pictures_of, text_of

pytestmark = pytest.mark.anyio
TOOL = "webots_get_clip"
# Where neither its length nor its usual range is the subject: ten frames instead of fifty.
SHORT = {"before_s": 0.5, "after_s": 0.5}


async def shown(client: Client, **arguments: Any) -> tuple[dict[str, Any], Image.Image]:
    """The caption and the contact sheet of an answer."""
    result: CallToolResult = await client.call_tool(TOOL, arguments)
    assert not result.is_error, text_of(result)
    (sheet,) = pictures_of(result)
    return json.loads(text_of(result)), Image.open(io.BytesIO(base64.b64decode(sheet.data)))


def frames_of(file: str | Path) -> list[Image.Image]:
    animation: Any = Image.open(file)
    with animation:
        return [each.convert("RGB") for each in ImageSequence.Iterator(animation)]


def length_ms(file: str | Path) -> int:
    length = 0
    animation: Any = Image.open(file)
    with animation:
        for each in ImageSequence.Iterator(animation):
            each.load()  # which reads the frame's duration
            length += each.info["duration"]
    return length


@pytest.mark.slow
async def test_a_hit_is_shown_by_its_event_with_the_frames_before_it(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(4.0, 7.0)
    event_id = crash.hit()
    async with connect() as client:
        told, sheet = await shown(client, event_id=event_id)
    assert told["shows"] == (
        "frames of eye from 3.000 to 8.000 s around 6.000 s (breakpoint front_m < 0.1)"
    )
    assert told["signals"][0] == "front_m", "the signal of the condition comes first"
    assert "t" not in told["signals"], "a clock has no news"
    assert len(told["sheet_sim_time_s"]) == 16
    assert HIT_S in told["sheet_sim_time_s"]
    assert sheet.width == 1000
    file = Path(told["file"])
    assert file.parent.name == "clips"
    assert told["size_bytes"] == file.stat().st_size < 3_000_000
    frames = frames_of(file)
    assert len(frames) == told["frames"]
    assert frames[0].size == (told["width_px"], told["height_px"])
    assert length_ms(file) == pytest.approx(5000 + 1000, abs=60), "real time, and the last frame"
    colours: list[Any] = [frame.getpixel((240, 150)) for frame in frames]
    reds = [int(colour[0]) for colour in colours]
    assert reds == sorted(reds) and reds[-1] - reds[0] > 50, "the pictures follow each other"


async def test_an_event_of_a_search_names_the_id_that_a_clip_takes(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(5.0, 7.0)
    event_id = crash.hit()
    async with connect() as client:
        found = await client.call_tool("webots_find_events", {"kinds": ["bridge_event"]})
        assert f'"event_id":{event_id}' in text_of(found)


@pytest.mark.slow
async def test_without_a_moment_the_newest_hit_is_shown_else_the_end(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(5.0, 7.0)
    async with connect() as client:
        at_end, _ = await shown(client)
        assert "around 10.000 s (the end of the recording)" in at_end["shows"]
        assert at_end["notes"][0] == "the recording ends at 10.000 s"
        crash.hit()
        crash.robot.event(HIT_S, "inspection", "front_m < 0.1", {"frames": []})
        told, _ = await shown(client)
        assert "(breakpoint front_m < 0.1)" in told["shows"]
        assert told["signals"][0] == "front_m"


@pytest.mark.slow
async def test_where_only_poses_are_recorded_the_robot_moves_over_the_map(
    connect: Connect, crash: Crash
) -> None:
    crash.drive()
    async with connect() as client:
        told, sheet = await shown(client, at_s=HIT_S)
    assert told["shows"].startswith("map from 3.000 to 8.000 s")
    assert len(told["sheet_sim_time_s"]) == 12
    assert sheet.format == "PNG"
    first, last = (frames_of(told["file"])[i] for i in (0, -1))
    assert first.crop((0, 28, 480, 388)).tobytes() != last.crop((0, 28, 480, 388)).tobytes()


async def test_without_pictures_and_poses_the_curves_are_shown(
    connect: Connect, crash: Crash
) -> None:
    crash.drive(position=False)
    async with connect() as client:
        told, _ = await shown(client, at_s=5, **SHORT)
        assert told["shows"].startswith("curves from")
        assert any("no map" in note for note in told["notes"])
        assert "No map can be drawn" in await fail(client, TOOL, at_s=5, view="map")


async def test_pictures_without_states_are_shown_too(connect: Connect, crash: Crash) -> None:
    crash.film(1.0, 3.0)
    async with connect() as client:
        told, _ = await shown(client, at_s=2)
    assert told["shows"] == "frames of eye from 1.000 to 3.000 s around 2.000 s"
    assert "signals" not in told


@pytest.mark.slow
async def test_of_several_cameras_one_is_chosen_and_the_others_are_named(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(5.0, 7.0, "left")
    crash.film(5.0, 7.0, "right", every_s=0.1)
    async with connect() as client:
        told, _ = await shown(client, at_s=HIT_S, **SHORT)
        assert told["camera"] == "right"
        assert told["notes"] == ["other cameras there: left"]
        assert (await shown(client, at_s=HIT_S, camera="left", **SHORT))[0]["camera"] == "left"
        why = await fail(client, TOOL, at_s=HIT_S, camera="nose")
        assert "Camera 'nose' has no frame" in why
        assert "left, right" in why


@pytest.mark.slow
async def test_one_picture_is_enough_and_says_so(connect: Connect, crash: Crash) -> None:
    crash.drive().frame(HIT_S)
    async with connect() as client:
        told, _ = await shown(client, at_s=HIT_S, **SHORT)
        assert told["shows"].startswith("map"), "a moving map shows more than one frame"
        only = "camera eye has only one frame there, of 6.000 s"
        assert told["notes"] == [only, "camera='eye' shows that frame"]
        told, _ = await shown(client, at_s=HIT_S, camera="eye", **SHORT)
    assert told["sheet_sim_time_s"] == [HIT_S]
    assert told["notes"] == [only]


@pytest.mark.slow
async def test_files_that_are_damaged_or_gone_are_left_out_and_counted(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(5.0, 6.0)
    crash.frame(6.2, data=b"no picture")
    crash.frame(6.4).unlink()
    cut = crash.frame(6.6)
    cut.write_bytes(cut.read_bytes()[:60])
    async with connect() as client:
        told, _ = await shown(client, at_s=HIT_S, before_s=1, after_s=0.6)
        assert max(told["sheet_sim_time_s"]) == 6.0
        assert "3 of 9 frames could not be read" in told["notes"][0]
        for path in crash.folder.glob("camera/*"):
            path.write_bytes(b"")
        told, _ = await shown(client, at_s=HIT_S, before_s=1, after_s=0.6)
    assert told["shows"].startswith("map"), "without a usable picture the map is shown"


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (640, 40), (40, 640), (161, 119), (3000, 2000)])
async def test_pictures_of_any_size_fit_the_frame(
    connect: Connect, crash: Crash, size: tuple[int, int]
) -> None:
    crash.drive()
    for time_s in (5.0, 6.0, 7.0):
        crash.frame(time_s, size=size)
    async with connect() as client:
        told, _ = await shown(client, at_s=HIT_S, before_s=1, after_s=1)
    frames = frames_of(told["file"])
    assert frames[0].width == 480
    assert all(frame.height <= 28 + 360 + 320 for frame in frames)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"at_s": 99}, "at_s=99 is not in run 1, which was recorded from 0.000 to 10.000 s"),
        ({"at_s": -1}, "is not in run 1"),
        ({"event_id": 77}, "No event 77 is stored"),
        ({"event_id": 1, "at_s": 3}, "Leave one of them out"),
        ({"at_s": 3, "signals": ["a", "b", "c", "d"]}, "signals"),
        ({"at_s": 3, "signals": ["front"]}, "front"),
        ({"at_s": 3, "before_s": 1000}, "before_s"),
        ({"at_s": 3, "view": "camera"}, "No camera frame was recorded"),
        ({"at_s": 3, "image_format": "mp4"}, "image_format"),
        ({"run_id": 9}, "No run 9"),
    ],
)
async def test_what_cannot_be_shown_is_refused_with_what_can(
    connect: Connect, crash: Crash, asked: dict[str, Any], said: str
) -> None:
    crash.drive()
    async with connect() as client:
        assert said in await fail(client, TOOL, **asked)


@pytest.mark.slow
async def test_an_event_of_another_run_or_robot_is_refused(
    connect: Connect, crash: Crash, recorded: Recorded
) -> None:
    crash.drive()
    event_id = crash.hit()
    other = Crash(recorded, crash.folder, "other").drive()
    async with connect() as client:
        assert "is of run 1, not of run" in await fail(
            client, TOOL, event_id=event_id, run_id=other.robot.run_id
        )
        assert "robot='rover'" in await fail(client, TOOL, event_id=event_id, robot="other")
        assert (await shown(client, event_id=event_id, **SHORT))[0]["run_id"] == 1
        assert "several" in await fail(client, TOOL, at_s=3) or "rover" in await fail(
            client, TOOL, at_s=3
        )
        told, _ = await shown(client, at_s=3, robot="other", **SHORT)
        assert told["robot"] == "other"


@pytest.mark.slow
@pytest.mark.parametrize("at_s", [0.0, 10.0])
async def test_a_moment_at_the_edge_of_a_run_is_shown_as_far_as_it_was_recorded(
    connect: Connect, crash: Crash, at_s: float
) -> None:
    crash.drive().robot.end_run("crashed")
    async with connect() as client:
        told, _ = await shown(client, at_s=at_s, **SHORT)
        assert len(told["notes"]) == 1
        assert at_s in told["sheet_sim_time_s"]
        alone, _ = await shown(client, at_s=at_s, before_s=0, after_s=0)
    assert alone["frames"] == 1
    assert alone["sheet_sim_time_s"] == [at_s]


async def test_a_run_without_anything_says_so(connect: Connect, recorded: Recorded) -> None:
    recorded.robot()
    async with connect() as client:
        result = await client.call_tool(TOOL, {})
    assert "has no state and no picture" in text_of(result)


@pytest.mark.slow
async def test_speed_stretches_the_animation_and_a_gif_is_a_gif(
    connect: Connect, crash: Crash
) -> None:
    crash.drive().film(5.0, 7.0)
    async with connect() as client:
        told, _ = await shown(
            client, at_s=HIT_S, before_s=1, after_s=1, speed=0.5, image_format="gif"
        )
    assert told["file"].endswith(".gif")
    assert length_ms(told["file"]) == pytest.approx(2000 / 0.5 + 1000, abs=120)
    assert told["frames"] == pytest.approx(41, abs=1)


@pytest.mark.slow
async def test_a_clip_of_noise_stays_within_its_size_and_processor_time(
    connect: Connect, crash: Crash
) -> None:
    crash.drive()
    noises: list[bytes] = []
    for _ in range(5):
        noise = io.BytesIO()
        Image.effect_noise((640, 480), 90).convert("RGB").save(noise, "PNG", compress_level=1)
        noises.append(noise.getvalue())
    for number in range(41):
        noise_of = noises[number % len(noises)]
        crash.frame(round(3.0 + number * 0.1, 6), size=(640, 480), data=noise_of)
    for form in ("webp", "gif"):
        began_s = time.process_time()
        async with connect() as client:
            told, _ = await shown(client, at_s=5.0, before_s=2, after_s=2, image_format=form)
        assert time.process_time() - began_s < 10, "3 s at least, and the sheet, three times over"
        assert told["size_bytes"] <= 3_000_000
        assert told["frames"] >= 8


@pytest.mark.slow
async def test_a_read_only_server_shows_the_sheet_and_writes_nothing(
    connect: Connect, crash: Crash
) -> None:
    crash.drive()
    async with connect(read_only=True) as client:
        told, _ = await shown(client, at_s=5, **SHORT)
    assert told["not_saved"] == "this server is --read-only"
    assert not (crash.folder / "clips").exists()


@pytest.mark.slow
async def test_a_folder_that_takes_no_file_costs_only_the_animation(
    connect: Connect, crash: Crash
) -> None:
    crash.drive()
    (crash.folder / "clips").write_text("a file of this name")
    async with connect() as client:
        told, _ = await shown(client, at_s=5, **SHORT)
    assert "cannot be written" in told["not_saved"]


@pytest.mark.slow
async def test_the_newest_fifty_clips_are_kept(
    connect: Connect, crash: Crash, monkeypatch: pytest.MonkeyPatch
) -> None:
    from webots_mcp.plugins.clip import get_clip

    monkeypatch.setattr(get_clip, "MOST_CLIPS", 2)
    crash.drive()
    (crash.folder / "clips").mkdir()
    own = crash.folder / "clips" / "mine.webp"
    own.write_bytes(b"a file of the user")
    async with connect() as client:
        for at_s in (4, 5, 6):
            await shown(client, at_s=at_s, before_s=0.2, after_s=0.2)
    left = sorted(each.name.rpartition("-")[0] for each in (crash.folder / "clips").iterdir())
    assert left == ["", "run-1-at-5.000s", "run-1-at-6.000s"]
    assert own.is_file()


@pytest.mark.slow
async def test_clips_of_one_moment_do_not_replace_each_other(
    connect: Connect, crash: Crash
) -> None:
    crash.drive()
    async with connect() as client:
        files = [
            Path((await shown(client, at_s=5, before_s=before_s, after_s=0.2))[0]["file"])
            for before_s in (0.2, 0.4, 0.2)
        ]
    assert files[0] == files[2] != files[1]
    assert all(file.is_file() for file in files)


async def test_a_heading_on_other_axes_is_replaced_by_the_direction_of_motion(
    crash: Crash, file: Path
) -> None:
    from contextlib import closing

    from webots_mcp.database.connection import connect as connected
    from webots_mcp.plugins.clip.clip_content import content_of
    from webots_mcp.plugins.clip.moment import Moment

    for step in range(101):
        time_s = step / 10
        compass = {"x": 0.5 * time_s, "y": 0.0, "yaw": 1.57}
        crash.robot.state(time_s, {"pose": compass})
    with closing(connected(file, "reader")) as connection:
        content = content_of(connection, file.parent, Moment(1, 5.0), 3, 2)
    assert content.track is not None
    x, y, heading = content.track.pose_at(5.05)
    assert (x, y) == (pytest.approx(2.525), 0.0)
    assert heading == pytest.approx(0.0, abs=1e-6)
