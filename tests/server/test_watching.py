"""What a stretch of rows shows."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.server.watching import Watched, evenly, find_place
from webots_mcp.store.states import State


def watch(*published: dict[str, object]) -> Watched:
    watched = Watched()
    rows = [State(i, 1, i * 0.5, 0.0, json.dumps(data), None) for i, data in enumerate(published)]
    watched.read(rows)
    return watched


@pytest.mark.parametrize(
    ("names", "place"),
    [
        ({"pose.0", "pose.1", "pose.2"}, ("pose.0", "pose.1")),
        ({"robot.pose.x", "robot.pose.y"}, ("robot.pose.x", "robot.pose.y")),
        ({"gps.0", "gps.1", "position.x", "position.y"}, ("position.x", "position.y")),
        ({"sensors.gps.0", "sensors.gps.1"}, ("sensors.gps.0", "sensors.gps.1")),
        ({"x", "y"}, ("x", "y")),
        ({"joints.0", "joints.1", "x"}, None),
    ],
)
def test_where_the_robot_is_is_found_by_name(
    names: set[str], place: tuple[str, str] | None
) -> None:
    assert find_place(dict.fromkeys(sorted(names), 1.0)) == place


def test_a_way_there_and_back_has_a_distance_and_no_displacement() -> None:
    movement = watch({"pose": [0, 0]}, {"pose": [3, 4]}, {"pose": [0, 0]}).movement()
    assert movement is not None
    assert (movement["distance"], movement["displacement"]) == (10.0, 0.0)


def test_a_lost_position_does_not_count_as_a_way() -> None:
    movement = watch({"pose": [0, 0]}, {"pose": [None, 1]}, {"pose": [0, 1]}).movement()
    assert movement is not None
    assert movement["distance"] == 1.0


def test_a_jump_to_the_start_at_a_reset_is_no_way_that_was_travelled() -> None:
    watched = watch({"pose": [0, 0]}, {"pose": [5, 0]})
    watched.read([State(9, 2, 0.0, 0.0, '{"pose": [0, 0]}', None)])
    assert watched.distance == 5.0


def test_the_numbers_that_changed_most_come_first_whatever_their_unit() -> None:
    watched = watch({"mm": 1000.0, "v": 12.0, "zero": 0.0, "still": 5},
                    {"mm": 1100.0, "v": 6.0, "zero": 0.0, "still": 5})  # fmt: skip
    assert [name for name, _ in watched.changed_most()] == ["v", "mm"]


def test_changes_of_text_and_flags_are_found_at_any_depth_with_their_time() -> None:
    watched = watch({"arm": {"mode": "a", "ok": True}}, {"arm": {"mode": "b", "ok": True}})
    assert watched.changes == [(0.5, "arm.mode", "a", "b")]


def test_what_is_missing_is_counted_and_breaks_nothing() -> None:
    watched = watch({"front": 1.0}, {"front": None}, {"front": 3.0}, {})
    assert (watched.numbers["front"].missing, watched.numbers["front"].last) == (1, 3.0)


@given(st.lists(st.integers(), unique=True, max_size=300), st.integers(2, 50))
def test_a_sample_is_in_order_and_keeps_both_ends(ids: list[int], most: int) -> None:
    chosen = evenly(sorted(ids), most)
    assert len(chosen) == min(len(ids), most)
    assert chosen == sorted(set(chosen))
    assert not ids or (chosen[0], chosen[-1]) == (min(ids), max(ids))
