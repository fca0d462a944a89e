"""Worlds are read as Webots reads them, or refused with a line number."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp.standin import WorldError
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.standin.world import World, load_world

HEADER = "#VRML_SIM R2023b utf8\n"


def loaded(text: str, tmp_path: Path) -> World:
    path = tmp_path / "small.wbt"
    path.write_text(HEADER + text, encoding="utf-8")
    return load_world(path)


def test_the_arena_is_read_with_types_and_defaults() -> None:
    world = load_world(DEFAULT_WORLD)
    rover = world.find("ROVER")
    assert rover is not None
    assert rover.fields["translation"] == [-1.2, 0.0, 0.04]
    assert rover.fields["supervisor"] is True
    assert rover.fields["synchronization"] is True  # not in the file
    assert world.basic_time_step_ms == 16.0
    assert world.title == "Arena"
    sensor = world.find("ROVER.DS_LEFT")
    assert sensor is not None
    assert sensor.fields["lookupTable"] == [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]


def test_a_use_is_the_node_of_its_def() -> None:
    world = load_world(DEFAULT_WORLD)
    east, west = world.find("WALL_EAST"), world.find("WALL_WEST")
    assert east is not None and west is not None
    assert east.fields["children"][0] is west.fields["children"][0]


def test_nested_places_add_up(tmp_path: Path) -> None:
    world = loaded(
        """WorldInfo {}
        Pose { translation 1 0 0 rotation 0 0 1 1.5707963 children [
          DEF INNER Pose { translation 1 0 0 } ] }""",
        tmp_path,
    )
    inner = world.find("INNER")
    assert inner is not None
    frame = world.frame_of(inner)
    assert frame is not None
    assert frame.translation == pytest.approx((1.0, 1.0, 0.0), abs=1e-6)
    assert frame.yaw_rad == pytest.approx(1.5707963)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("WorldInfo {\n  title 5\n}", 2, "title has to be SFString"),
        ("WorldInfo {}\nSolid { translation 1 2 }", 3, "translation has to be SFVec3f"),
        ("WorldInfo {}\nSolid {\n", 3, "ends in the middle"),
        ("WorldInfo {}\nUSE NOBODY", 3, "before any DEF NOBODY"),
        ("WorldInfo {}\nSolid { children ] }", 3, "children has no value"),
        ("EXTERNPROTO\nWorldInfo {}", 2, "EXTERNPROTO has no URL"),
        ("WorldInfo {}\nPROTO Foo [ ] { }", 3, "no PROTO definitions"),
        ('WorldInfo { coordinateSystem "NUE" }', 2, "no coordinateSystem but ENU"),
        ("WorldInfo {}\nRectangleArena { floorSize 1 }", 3, "floorSize has to be SFVec2f"),
        ("Solid {}", 1, "no WorldInfo"),
        ("WorldInfo {}\n" + "Solid { children [ " * 500 + "] } " * 500, 3, "one in the other"),
        ("WorldInfo {}\nSolid { children " + "[" * 500, 3, "one in the other"),
        ("WorldInfo { basicTimeStep 0 }", 2, "positive"),
    ],
)
def test_a_bad_world_is_refused_with_its_line(
    text: str, line: int, message: str, tmp_path: Path
) -> None:
    with pytest.raises(WorldError, match=message) as caught:
        loaded(text, tmp_path)
    if "title" not in text:
        assert f"line {line}:" in str(caught.value)


def test_a_file_that_is_no_world_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "no.wbt"
    path.write_text("hello", encoding="utf-8")
    with pytest.raises(WorldError, match="a world begins with"):
        load_world(path)
    with pytest.raises(WorldError, match="cannot read the world"):
        load_world(tmp_path / "missing.wbt")
    with pytest.raises(WorldError, match="cannot read the world"):
        load_world("a\0b.wbt")


def test_what_is_left_out_is_counted_by_type_and_scaling_is_said_to_be_ignored(
    tmp_path: Path,
) -> None:
    world = loaded(
        """WorldInfo { }
        DEF A Foo { children [ Bar { } ] }
        USE A
        Floor { appearance Foo { } }
        Transform { scale 1 1 2 children [ Shape { geometry Mesh { } } ] }
        Zed { }""",
        tmp_path,
    )
    assert world.warnings() == [
        "WARNING: small.wbt, line 3: the stand-in has no Foo nodes; these 2 are left out.",
        "WARNING: small.wbt, line 6: the stand-in has no Mesh nodes; this one is left out.",
        "WARNING: small.wbt, line 7: the stand-in has no Zed nodes; this one is left out.",
        "WARNING: small.wbt, line 6: the stand-in scales nothing: what is in this Transform keeps "
        "its size.",
    ]


def test_worlds_with_the_axes_of_old_releases_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.wbt"
    path.write_text("#VRML_SIM R2021b utf8\nWorldInfo { }", encoding="utf-8")
    with pytest.raises(WorldError, match="have other axes: open and save it with Webots R2022a"):
        load_world(path)
