"""A world gets an observer, and loses it again, and nothing else in it changes."""

from __future__ import annotations

from pathlib import Path

import pytest

from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.setup.observer_edits import (
    copy_of,
    has_observer,
    undo,
    with_observer,
    without_observer,
    world_change,
)
from webots_mcp.standin.in_process import DEFAULT_WORLD
from webots_mcp.standin.world import load_world

WORLD = b"""#VRML_SIM R2025a utf8
# a comment with a } and a " in it
EXTERNPROTO "https://example.org/E-puck.proto"
WorldInfo { info [ "a } in a \\" text" ] }
DEF ROVER Robot { name "rover" children [ Robot { name "mcp_observer" } ] }
"""


@pytest.mark.parametrize("extern", [False, True])
def test_the_observer_stands_at_the_end_and_can_be_taken_out_again(extern: bool) -> None:
    changed = with_observer(WORLD, extern=extern)
    assert changed.startswith(WORLD)
    assert (b'controller "<extern>"' in changed) is extern
    assert with_observer(changed) == changed
    assert without_observer(changed) == WORLD


def test_a_world_without_an_end_of_line_and_one_of_windows_keep_theirs() -> None:
    assert with_observer(WORLD.rstrip()).startswith(WORLD)
    windows = WORLD.replace(b"\n", b"\r\n")
    changed = with_observer(windows)
    assert b"\n" not in changed.replace(b"\r\n", b"")
    assert without_observer(changed) == windows


def test_an_observer_that_webots_has_written_anew_is_found() -> None:
    robot = b'DEF EYE Robot {\n  translation 0 0 1\n  name "mcp_observer"\n  supervisor TRUE\n}\n'
    after = b"DEF LAST Solid {\n}\n"
    assert without_observer(WORLD + robot + after) == WORLD + after


def test_a_robot_inside_another_is_not_taken_for_it() -> None:
    assert not has_observer(WORLD)
    with pytest.raises(InvalidInputError, match="no robot 'mcp_observer' at the top"):
        without_observer(WORLD)


def test_what_is_no_world_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="no world of Webots"):
        with_observer(b"PNG")
    with pytest.raises(InvalidInputError, match="there is no world"):
        world_change(tmp_path / "nothing.wbt", in_place=False, extern=False)


def test_the_stand_in_loads_a_world_with_an_observer(tmp_path: Path) -> None:
    world = tmp_path / "arena.wbt"
    world.write_bytes(with_observer(DEFAULT_WORLD.read_bytes()))
    robot = load_world(world).of_type("Robot")[-1].fields
    assert (robot["name"], robot["controller"]) == ("mcp_observer", "mcp_observer")
    assert (robot["supervisor"], robot["synchronization"]) == (True, False)


def test_a_copy_is_deleted_only_where_nothing_else_was_changed_in_it(tmp_path: Path) -> None:
    world = tmp_path / "arena.wbt"
    world.write_bytes(WORLD)
    change = world_change(world, in_place=False, extern=False)
    assert (change.file, change.before) == (copy_of(world), None)
    change.file.write_bytes(change.after)
    assert undo(change.file) is None
    assert not world_change(world, in_place=False, extern=False).is_needed
    change.file.write_bytes(change.after.replace(b"ROVER", b"MINE"))
    with pytest.raises(CommandRefusedError, match="more than the observer"):
        undo(change.file)
