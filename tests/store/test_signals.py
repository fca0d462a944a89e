"""Signals are found by name, and listed with what is known of them."""

from __future__ import annotations

import sqlite3

import pytest

from tests.recordings.rover import start_run
from webots_mcp.errors import InvalidInputError, UnknownSignalError
from webots_mcp.judging.trends import trends
from webots_mcp.signals.naming import flatten
from webots_mcp.signals.register import MAX_SIGNALS, Place, places
from webots_mcp.store.chunk_making import chunk_whole_run, make_chunks
from webots_mcp.store.reading.catalogue import catalogue, list_signals, resolve_signals
from webots_mcp.store.reading.ranges import Scope, find_range, find_subject
from webots_mcp.store.signal_history import query_rows


def test_every_leaf_has_a_dotted_name() -> None:
    state = {"pose": [1, 2.5], "a": {"b": {"on": True}}, "mode": "x", "none": None, "empty": []}
    assert flatten(state) == {
        "pose.0": 1, "pose.1": 2.5, "a.b.on": True, "mode": "x", "none": None,
    }  # fmt: skip


def test_a_long_array_is_summarised() -> None:
    state = {"lidar": [5.0] * 16 + [1.0, None]}
    assert flatten(state) == {
        "lidar.count": 18, "lidar.min": 1.0, "lidar.max": 5.0, "lidar.mean": 81 / 17,
        "lidar.argmin": 16,
    }  # fmt: skip


def test_the_place_of_a_leaf_is_where_sqlite_finds_it(empty: sqlite3.Connection) -> None:
    text = '{"pose": [1, {"deep er": 7}], "a.b": 2, "ok": {"0": 3}}'
    state = {"pose": [1, {"deep er": 7}], "a.b": 2, "ok": {"0": 3}}
    assert places({"x": list(range(20))})["x.max"] == Place("$.x", "max")
    for name, value in flatten(state).items():
        path = places(state)[name].path
        assert empty.execute("SELECT json_extract(?, ?)", (text, path)).fetchone() == (value,)


def test_the_list_says_what_each_signal_did(rover: sqlite3.Connection) -> None:
    listed = list_signals(rover, run_id=1)
    by_name = {signal.name: signal for signal in listed.signals}
    assert listed.total == len(by_name)
    assert "lidar.min" in by_name and "lidar.0" not in by_name
    battery = by_name["battery_v"]
    assert (battery.kind, battery.unit, battery.rows) == ("num", "V", 1150)
    assert battery.max == 12.6 and battery.min == pytest.approx(12.6 - 0.1199)
    assert (battery.first_s, battery.last_s) == (0.0, 119.9)
    front = by_name["sensors.front"]
    assert front.missing == 40
    assert by_name["heading"].kind == "angle"
    assert by_name["sensors.bumper"].kind == "bool"
    assert (by_name["mode"].kind, by_name["mode"].last) == ("text", "cruise")
    assert by_name["mode"].last_s == 119.9


def test_a_list_can_be_narrowed_and_is_honest_about_its_length(rover: sqlite3.Connection) -> None:
    listed = list_signals(rover, run_id=1, pattern="lidar.*", limit=2)
    assert [signal.name for signal in listed.signals] == ["lidar.argmin", "lidar.count"]
    assert listed.total == 5


def test_a_branch_means_all_below_it(rover: sqlite3.Connection) -> None:
    known = catalogue(rover, find_subject(rover))
    names = [signal.name for signal in resolve_signals(known, ["pose", "sensors.*", "mode"])]
    assert names == ["pose.0", "pose.1", "sensors.front", "sensors.bumper", "mode"]


STRANGE = (
    'q"uote', "back\\slash", "new\nline", "nul\0", "apo's", "ünï😀", "", " ", "a.b", "[0]", "x[1]",
    "$", "*", "st*r", "%", "?", "1", "n.'\"", "..",
)  # fmt: skip


@pytest.mark.parametrize("chunked", [False, True])
def test_whatever_a_key_is_called_it_is_a_signal(empty: sqlite3.Connection, chunked: bool) -> None:
    recorder = start_run(empty)
    for step in range(30):
        flat = {name: step + index for index, name in enumerate(STRANGE)}
        recorder.publish(float(step), {**flat, "deep": flat})
    if chunked:
        make_chunks(empty)
    names = {*STRANGE, *(f"deep.{name}" for name in STRANGE)}
    assert {signal.name for signal in list_signals(empty).signals} == names
    for index, name in enumerate(STRANGE):
        for asked in (name, f"deep.{name}"):
            page = query_rows(empty, find_range(empty, Scope()), [asked], limit=2)
            assert page.values[asked] == [index, index + 1]


def test_a_key_called_like_the_default_pattern_does_not_hide_the_others(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"*": 1, "x": 2, "a": {"*": 3, "b": 4}})
    known = catalogue(empty, find_subject(empty))
    assert [signal.name for signal in resolve_signals(known, ["*"])] == ["*", "x", "a.*", "a.b"]
    assert [signal.name for signal in resolve_signals(known, ["a.*"])] == ["a.*", "a.b"]


def test_an_unknown_name_is_answered_with_near_ones(rover: sqlite3.Connection) -> None:
    known = catalogue(rover, find_subject(rover))
    with pytest.raises(UnknownSignalError, match="battery_v"):
        resolve_signals(known, ["batery"])
    with pytest.raises(UnknownSignalError, match=r"sensors\.front"):
        resolve_signals(known, ["front"])
    with pytest.raises(InvalidInputError, match="No signal is named"):
        resolve_signals(known, [])


def test_rows_that_do_not_hold_a_signal_have_no_value_of_it(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    for step in range(40):
        recorder.publish(float(step), {"x": step} | ({"lidar": 1.0} if step < 10 else {}))
        if step in (4, 25):
            missing = {signal.name: signal.missing for signal in list_signals(empty).signals}
            make_chunks(empty)
            chunked = {signal.name: signal.missing for signal in list_signals(empty).signals}
            assert missing == chunked == {"lidar": max(0, step + 1 - 10), "x": 0}
    assert list_signals(empty).signals[0].missing == 30


@pytest.mark.parametrize("chunked", [False, True])
def test_numbers_too_large_to_reckon_with_are_values(
    empty: sqlite3.Connection, chunked: bool
) -> None:
    recorder = start_run(empty)
    for step in range(40):
        recorder.publish(float(step), {"big": 1e301})
    if chunked:
        make_chunks(empty)
    (big,) = list_signals(empty).signals
    assert (big.missing, big.first_s, big.last_s, big.last) == (0, 0.0, 39.0, 1e301)


@pytest.mark.parametrize("course", ["tn", "nt", "_t", "_n", "bn"])
def test_a_signal_that_changes_its_kind_is_told_the_same_before_and_after_rolling(
    empty: sqlite3.Connection, course: str
) -> None:
    recorder = start_run(empty)
    for step in range(300):
        kind = course[step * len(course) // 300]
        value = {"t": "word", "n": step // 50, "b": step % 100 < 50, "_": None}[kind]
        recorder.publish(step * 0.1, {"x": step, "value": value})
    before = (list_signals(empty), trends(empty, find_range(empty, Scope())))
    while not make_chunks(empty, 50).done:
        pass
    assert (list_signals(empty), trends(empty, find_range(empty, Scope()))) == before


def test_rows_in_no_chunk_yet_are_in_the_list(empty: sqlite3.Connection) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {"x": 1.0})
    make_chunks(empty)
    recorder.publish(1.0, {"x": 5.0, "y": None})
    x, y = list_signals(empty).signals
    assert (x.rows, x.min, x.max, x.last) == (2, 1.0, 5.0, 5.0)
    assert (y.rows, y.kind, y.missing) == (1, "null", 2)


def test_a_name_and_a_kind_in_the_midst_of_rows_in_no_chunk_are_known(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    for step in range(900):
        state: dict[str, object] = {"x": step, "front": "n/a" if step == 450 else step}
        recorder.publish(step * 0.1, state | ({"fault": 7} if 300 <= step < 310 else {}))
    known = catalogue(empty, find_subject(empty, None, 1))
    assert (known["front"].kind, known["fault"].kind) == ("text", "num")
    told = trends(empty, find_range(empty, Scope(run_id=1)))
    assert "fault" in [trend.name for trend in told.runs[0].numbers]


def test_who_asks_for_a_name_beyond_the_limit_is_told_of_the_limit(
    empty: sqlite3.Connection,
) -> None:
    recorder = start_run(empty)
    recorder.publish(0.0, {f"s{number}": number for number in range(MAX_SIGNALS + 1)})
    recorder.end_run("finished")
    chunk_whole_run(empty, 1)
    with pytest.raises(UnknownSignalError, match=f"Only the first {MAX_SIGNALS} names of a robot"):
        trends(empty, find_range(empty, Scope(run_id=1)), [f"s{MAX_SIGNALS}"])
