"""Reading published states back."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recordings.rows import Recorded
from webots_mcp.bridge.encoding import encode
from webots_mcp.errors import InvalidInputError, InvalidRangeError
from webots_mcp.store.logs import LogFilter, LogWindow, count_lines, newest_lines, window_of
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.run_rows import StateRecord, newest_state, real_time_factor, select


def recorded_state(published: dict[str, Any]) -> StateRecord:
    encoded = encode(published)
    return StateRecord(1, 1, 0.0, 0.0, encoded.text, encoded.replaced_text)


def test_the_newest_state_of_a_run_is_found(recorded: Recorded) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1})
    robot.state(1.0, {"x": 2})
    state = newest_state(recorded.connection, robot.run_id)
    assert state is not None
    assert state.value() == {"x": 2}


def test_a_run_without_rows_has_no_state(recorded: Recorded) -> None:
    assert newest_state(recorded.connection, recorded.robot().run_id) is None


def test_values_that_json_cannot_hold_come_back_recognisable() -> None:
    nan, inf = float("nan"), float("inf")
    published = {"pose": [1.0, nan], "a.b": {"c": -inf}, "raw": b"ab", "mixed": [nan, 0.5, inf]}
    assert recorded_state(published).value() == {
        "pose": [1.0, "nan"],
        "a.b": {"c": "-inf"},
        "raw": "YWI=",
        "mixed": ["nan", 0.5, "inf"],
    }


@given(
    st.dictionaries(
        st.text(max_size=4),
        st.recursive(
            st.sampled_from([1.5, float("nan"), float("inf"), None, "text"]),
            lambda inner: (
                st.lists(inner, max_size=3)
                | st.dictionaries(st.text(max_size=3), inner, max_size=3)
            ),
            max_leaves=8,
        ),
        max_size=4,
    )
)
def test_decoding_never_fails_on_what_the_bridge_encoded(published: dict[str, Any]) -> None:
    value = recorded_state(published).value()
    assert set(value) == set(published)


def test_a_part_of_a_state_is_found_by_its_path() -> None:
    value = {"sensors": {"front.left": [1, 2, {"deep": 3}]}}
    assert select(value, "") is value
    assert select(value, "sensors.front.left.2.deep") == 3


@pytest.mark.parametrize(
    ("path", "said"),
    [("sensor", "Use one of"), ("sensors.7", "no index"), ("sensors.0.x", "has no members")],
)
def test_a_wrong_path_is_answered_with_what_there_is(path: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        select({"sensors": [1, 2]}, path)


def test_the_real_time_factor_is_that_of_the_last_seconds(recorded: Recorded) -> None:
    robot = recorded.robot()
    robot.state(0.0, {}, at=robot.now - 100)
    for i in range(5):
        robot.state(50 + 2.0 * i, {}, at=robot.now + i)
    assert real_time_factor(recorded.connection, robot.run_id) == pytest.approx(2.0)


def test_log_lines_are_filtered_by_text_level_and_time(recorded: Recorded) -> None:
    robot = recorded.robot()
    for i, (level, text) in enumerate(
        [("info", "Start"), ("warning", "wall 100% near"), ("error", "Wall hit"), ("debug", "x")]
    ):
        robot.log(float(i), text, level)
    run = LogFilter(robot.run_id, LogWindow(0, 10))

    def found(**changes: Any) -> list[str]:
        asked = LogFilter(**(vars(run) | changes))
        lines = newest_lines(recorded.connection, asked, 10)
        assert count_lines(recorded.connection, asked) == len(lines)
        return [line.message for line in lines]

    assert found(text="WALL") == ["wall 100% near", "Wall hit"]
    assert found(text="%") == ["wall 100% near"]
    assert found(lowest_level="warning") == ["wall 100% near", "Wall hit"]
    assert found(window=LogWindow(1.0, 2.0)) == ["wall 100% near"]


def test_a_window_is_half_open_and_last_s_counts_back_from_the_newest_row() -> None:
    assert window_of(Scope(last_s=2.0), 9.0).start_s == pytest.approx(7.0, abs=0.0005)
    bounds = window_of(Scope(start_s=1.0, end_s=4.0), 9.0)
    assert bounds == pytest.approx((1.0, 4.0), abs=0.0005)


@pytest.mark.parametrize(
    "bounds",
    [
        {"start_s": 4.0, "end_s": 4.0},
        {"start_s": 5.0, "end_s": 4.0},
        {"last_s": 0.0},
        {"last_s": 1.0, "start_s": 0.0},
        {"start_s": float("nan")},
    ],
)
def test_a_contradictory_window_is_refused(bounds: dict[str, float]) -> None:
    with pytest.raises(InvalidRangeError):
        window_of(Scope(**bounds), 9.0)  # pyright: ignore[reportArgumentType]
