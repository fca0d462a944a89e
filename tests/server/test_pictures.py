"""The tools that show pictures."""

from __future__ import annotations

import base64
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.recordings.rows import Recorded
from tests.server.conftest import Connect, fail, pictures_of, text_of

pytestmark = pytest.mark.anyio


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
        assert caption["picture_age_wall_s"] >= 0
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
        ("gone.png", "its file is gone"),
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


async def test_a_controller_that_saves_no_frames_is_told_how_to(
    connect: Connect, recorded: Recorded
) -> None:
    recorded.robot()
    async with connect() as client:
        assert "save_camera_frame" in text_of(await client.call_tool("webots_get_camera", {}))
