"""Where two runs part is found to the row, and equal is said only of what was compared."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.recordings.rover import Recorder
from webots_mcp.errors import InvalidInputError, UnknownRunError, UnknownSignalError
from webots_mcp.judging.divergence import (
    Parting,
    compare_repeats,
    compare_rows,
    repeats_noted,
    verdict_on,
)
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

ROWS = 500
STEP_S = 0.016
NOISE_ROW, TURN_ROW = 201, 300
State = Callable[[int], Mapping[str, Any] | None]


def record(
    connection: sqlite3.Connection,
    state: State,
    rows: int = ROWS,
    *,
    first: int = 1,
    robot: str = "r",
    code: str = "a",
) -> Recorder:
    """A run; row k at k steps, unless its state is None; `REPLACED` of a state is its column."""
    recorder = Recorder(connection)
    known = connection.execute("SELECT id FROM robot WHERE name = ?", (robot,)).fetchone()
    robot_id = known[0] if known else recorder.robot(robot)
    connection.execute("BEGIN")
    recorder.run(recorder.session(robot_id, code * 64), robot_id)
    for row in range(first, first + rows):
        if (made := state(row)) is not None:
            replaced = made.get("REPLACED")
            data = {name: value for name, value in made.items() if name != "REPLACED"}
            recorder.publish(round(row * STEP_S, 6), data, replaced)
    recorder.end_run("finished")
    connection.execute("COMMIT")
    return recorder


def driving(row: int) -> dict[str, Any]:
    return {
        "pose": {"x": 0.2 * row * STEP_S, "y": 0.1},
        "compass": {"x": math.sin(row)},
        "mode": "cruise",
        "bumper": False,
    }


def with_one_bit(row: int) -> dict[str, Any]:
    """The compass is off by one bit in a single row, the position grows apart from the next on."""
    state = driving(row)
    if row == NOISE_ROW:
        state["compass"]["x"] = math.nextafter(state["compass"]["x"], 2.0)
    if row > NOISE_ROW:
        state["pose"]["x"] += 1e-9 * 1.1 ** (row - NOISE_ROW)
    if row >= TURN_ROW:
        state["mode"] = "turn"
    return state


def at(row: int) -> float:
    return pytest.approx(row * STEP_S, abs=1e-9)  # pyright: ignore[reportReturnType]


def of(found: Parting, name: str) -> Any:
    return next(each for each in found.parted if each.signal == name)


@pytest.fixture(params=["rows", "chunks", "purged"])
def kept(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[sqlite3.Connection], sqlite3.Connection]:
    """The same recording as rows, in chunks of 64 rows, and with its rows deleted since."""

    def keep(connection: sqlite3.Connection) -> sqlite3.Connection:
        if request.param != "rows":
            monkeypatch.setattr(chunk_making, "GROUP_ROWS", 64)
            assert make_chunks(connection, 100_000).done
        if request.param == "purged":
            prune(connection, tmp_path, Retention(state=Limit(rows=0), outlive=0), rest=False)
            assert connection.execute("SELECT count(*) FROM state").fetchone() == (0,)
        return connection

    return keep


def test_one_bit_of_noise_is_found_to_the_row(
    empty: sqlite3.Connection, kept: Callable[..., sqlite3.Connection]
) -> None:
    record(empty, driving)
    record(empty, with_one_bit)
    found = compare_rows(kept(empty), [1, 2])
    assert [each.signal for each in found.parted] == ["compass.x", "pose.x", "mode"]
    compass, pose, mode = found.parted
    bit = math.ulp(math.sin(NOISE_ROW))
    assert (compass.from_s, compass.by, compass.row_count) == (at(NOISE_ROW), bit, 1)
    assert (compass.beyond_s, compass.largest) == (None, bit)
    assert (pose.from_s, pose.unit, pose.tolerance) == (at(NOISE_ROW + 1), "m", 0.001)
    assert pose.beyond_s == at(NOISE_ROW + 145), "1e-9 * 1.1 ** n > 0.001"
    assert pose.largest_at_s == at(ROWS)
    assert (mode.from_s, mode.values, mode.by) == (at(TURN_ROW), ("cruise", "turn"), None)
    assert found.worst is pose and found.is_equal is False
    assert found.verdict == (
        f"equal to the last digit until 3.216 s; then compass.x by {bit:.3g}; "
        f"pose.x beyond 0.001 m from 5.536 s on; pose.x by at most {pose.largest:.3g} m"
    )
    assert [*pose.growth] == [f"until {s} s" for s in ("0.500", "1.000", "2.000", "5.000", "8.000")]
    *none, at_5_s, at_the_end = pose.growth.values()
    assert none == [0, 0, 0] and 0 < at_5_s < at_the_end == pytest.approx(pose.largest, rel=1e-3)
    assert compare_rows(empty, [2, 1]).parted[1].from_s == at(NOISE_ROW + 1)
    only = compare_rows(empty, [1, 2], names=["mode"], until_s=at_s(TURN_ROW - 1))
    assert (only.is_equal, only.signals, only.rows) == (True, 1, TURN_ROW - 1)


def at_s(row: int) -> float:
    return round(row * STEP_S, 6)


def test_equal_runs_are_equal_until_the_shorter_ends(
    empty: sqlite3.Connection, kept: Callable[..., sqlite3.Connection]
) -> None:
    record(empty, driving)
    record(empty, driving, 400)
    found = compare_rows(kept(empty), [1, 2])
    assert (found.is_equal, found.rows, found.signals, found.is_whole) == (True, 400, 5, True)
    assert found.verdict == (
        "equal to the last digit in the 400 rows and 5 signals that were compared, until 6.400 s"
    )
    assert found.notes == ("one run goes on to 8.000 s, which the other does not",)
    assert compare_repeats(empty, [1, 2], until_s=3.0)[0].is_equal is True
    (short,) = compare_repeats(empty, [1, 2], until_s=7.0)
    assert (short.is_equal, short.notes[0]) == (None, "a run ends before 7 s")


def test_a_row_without_a_partner_is_counted_and_compared_with_no_other(
    empty: sqlite3.Connection, kept: Callable[..., sqlite3.Connection]
) -> None:
    record(empty, driving)
    record(empty, lambda row: None if row in (7, 100) else driving(row))
    record(empty, lambda row: driving(row) if row % 5 == 2 else None)
    kept(empty)
    found = compare_rows(empty, [1, 2])
    assert (found.rows, found.parted) == (ROWS - 2, ())
    assert found.is_equal is None, "the rows that are missing may have been others"
    assert found.notes[0].startswith("without a partner at the same simulation time")
    assert found.verdict.endswith("signals that were compared, until 8.000 s; not all was compared")
    throttled = compare_rows(empty, [3, 2])
    assert (throttled.rows, throttled.parted) == (99, ()), "one of a hundred is missing in run 2"
    assert [each.rpartition(": ")[2] for each in throttled.notes[:2]] == [
        "1 row of run 3, the first at 0.112 s",
        "395 rows of run 2, the first at 0.048 s",
    ]


def test_texts_flags_nulls_and_replaced_values_are_compared(empty: sqlite3.Connection) -> None:
    before = {"t": "a", "f": True, "n": None, "r": None, "gone": 1, "k": 1, "same": None}
    later = {"t": "b", "f": False, "n": 1.5, "r": None, "k": True, "same": None}
    record(empty, lambda _: {**before, "REPLACED": {"r": "nan", "same": "nan"}})
    record(
        empty,
        lambda row: {
            **(before if row < 10 else later),
            "REPLACED": {"r": "nan" if row < 10 else "inf", "same": "nan"},
        },
    )
    found = compare_rows(empty, [1, 2])
    assert {each.signal: each.values for each in found.parted} == {
        "t": ("a", "b"),
        "f": (True, False),
        "n": (None, 1.5),
        "r": ("(nan)", "(inf)"),
        "gone": (1, "(absent)"),
        "k": (1, True),
    }
    assert {(each.from_s, each.by, each.beyond_s) for each in found.parted} == {
        (at_s(10), None, at_s(10))
    }
    assert "until 0.160 s; then " in found.verdict


def test_what_was_not_alike_to_begin_with_comes_first(empty: sqlite3.Connection) -> None:
    for number, code in enumerate("ab"):
        recorder = record(empty, driving if number else with_one_bit, code=code)
        for name, value, time_s in (("kp", 1.0 + number, 0.0), ("ki", 2.0, 0.0), ("ki", 3.0, 1.0)):
            stamped = recorder.at(time_s + number * (time_s > 0))
            recorder.insert(
                "parameter_value", **stamped, name=name, value=str(value), is_default=1,
                set_by="code",
            )  # fmt: skip
    versions = json.dumps({"python": "3.12.1", "sqlite": "3.45"})
    empty.execute("UPDATE session SET versions = ?", (json.dumps({"python": "3.11.7"}),))
    empty.execute("UPDATE session SET versions = ?, git_commit = 'beef' WHERE id = 2", (versions,))
    empty.execute("UPDATE run SET world = '/w/b.wbt', basic_time_step_ms = 32 WHERE id = 2")
    found = compare_rows(empty, [1, 2])
    assert [*found.unlike] == [
        "controller_sha256", "git_commit", "world", "basic_time_step_ms", "parameter kp",
        "parameter ki", "version of python", "version of sqlite",
    ]  # fmt: skip
    assert found.unlike["parameter ki"] == (
        "2, then 3 from 1.000 s on",
        "2, then 3 from 2.000 s on",
    )
    assert found.unlike["version of sqlite"] == (None, "3.45")
    assert found.verdict.startswith("not alike to begin with (controller_sha256, git_commit, wo")
    assert "; equal to the last digit until 3.216 s" in found.verdict


@pytest.mark.parametrize("damage", ["numbers = x'00' WHERE signal_id > 0", "labels = '[' "])
def test_what_cannot_be_read_is_named_and_not_judged(
    empty: sqlite3.Connection, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 100)
    record(empty, driving)
    record(empty, with_one_bit)
    make_chunks(empty, 100_000)
    empty.execute("DELETE FROM state")
    # The chunks of run 2 that hold the row with the bit, and those after it.
    where = "AND" if "WHERE" in damage else "WHERE"
    (group,) = empty.execute("SELECT min(id) + 2 FROM row_group WHERE run_id = 2").fetchone()
    empty.execute(f"UPDATE chunk SET {damage} {where} run_id = 2 AND group_id >= {group}")
    found = compare_rows(empty, [1, 2])
    unread = {
        each.partition("the chunk of ")[2].partition(" is damaged")[0] for each in found.notes
    }
    assert found.verdict.endswith("; not all was compared")
    if "numbers" in damage:
        assert {each.signal for each in found.parted} == {"mode"}
        assert unread == {"pose.x", "pose.y", "compass.x"}
    else:
        assert [each.signal for each in found.parted] == ["compass.x", "pose.x"]
        assert unread == {"mode", "bumper"}
    assert found.notes[0].startswith("run 2: not read from 3.216 to ")
    alike = compare_rows(empty, [1, 2], until_s=3.0)
    assert (alike.is_equal, alike.notes) == (True, ())
    empty.execute("UPDATE chunk SET numbers = x'00' WHERE signal_id = 0 AND run_id = 2")
    lost = compare_rows(empty, [1, 2])
    assert (lost.rows, lost.is_equal, lost.verdict) == (0, None, "nothing could be compared")
    assert "the chunk of simulation times is damaged" in lost.notes[0]
    assert not any("of run 1" in each for each in lost.notes), "nobody knows their partners"


def test_the_time_limit_leaves_signals_uncompared_and_says_so(empty: sqlite3.Connection) -> None:
    for _ in range(2):
        record(empty, driving)
    make_chunks(empty, 100_000)
    found = compare_rows(empty, [1, 2], deadline_s=0.0)
    assert found.is_equal is None
    assert found.verdict == "nothing could be compared"
    assert "5 signals: time limit reached" in found.notes[0]


def test_only_signals_of_both_are_compared_and_the_others_named(empty: sqlite3.Connection) -> None:
    record(empty, driving)
    record(empty, lambda row: {"pose": driving(row)["pose"], "arm": 1}, robot="other")
    record(empty, lambda _: {"arm": 1}, robot="other")
    found = compare_rows(empty, [1, 2])
    assert (found.signals, found.is_equal) == (2, None)
    assert found.notes == ("only run 1 has compass.x, mode, bumper", "only run 2 has arm")
    assert found.unlike == {"robot": ("r", "other")}
    nothing = compare_rows(empty, [1, 3])
    assert (nothing.signals, nothing.is_equal) == (0, None)
    assert nothing.verdict.endswith("nothing could be compared")


def test_runs_are_aligned_by_simulation_time(empty: sqlite3.Connection) -> None:
    record(empty, with_one_bit)
    record(empty, driving, 300, first=150)  # attached late
    record(empty, driving, first=10_000)
    found = compare_rows(empty, [1, 2])
    assert (found.from_s, found.rows, found.is_whole) == (at(150), 300, True)
    assert found.notes[0] == f"one run begins at {at_s(1):.3f} s, the other at {at_s(150):.3f} s"
    assert found.parted[0].from_s == at(NOISE_ROW)
    apart = compare_rows(empty, [1, 3])
    assert (apart.rows, apart.is_equal) == (0, None)
    assert apart.notes == ("no row has a partner that could be read",)


def test_rows_at_one_time_are_compared_in_their_order(empty: sqlite3.Connection) -> None:
    for changed in (False, True):
        recorder = record(empty, lambda row: {"a": row}, 20)
        for each in (0, 1, 2):  # a paused simulation
            recorder.publish(at_s(20), {"a": each + 10 * (changed and each == 2)})
        recorder.publish(at_s(21), {"a": 21})
    recorder.publish(at_s(21), {"a": 5})
    found = compare_rows(empty, [1, 2])
    (only,) = found.parted
    assert (only.from_s, only.values, only.row_count) == (at(20), (2.0, 12.0), 1)
    assert found.notes[0].startswith("without a partner at the same simulation time")


def test_what_matters_is_a_millimetre_a_thousandth_of_a_radian_or_of_the_value(
    empty: sqlite3.Connection,
) -> None:
    def state(off: float) -> State:
        return lambda row: {
            "front_mm": 10.0 + 0.5 * off * row,
            "yaw": math.remainder(math.pi - 1e-4 + 1e-5 * off * row, math.tau),
            "heading_deg": (359.99 + 0.001 * off * row) % 360,
            "force": 500.0 + 0.1 * off * row,
        }

    for off in (0, 1):
        record(empty, state(off))
    found = compare_rows(empty, [1, 2])
    assert of(found, "front_mm").beyond_s == at(3)  # over 1 mm
    yaw, heading, force = (of(found, name) for name in ("yaw", "heading_deg", "force"))
    assert (yaw.beyond_s, yaw.unit) == (at(101), "rad")
    assert yaw.largest == pytest.approx(5e-3), "and no whole turn"
    assert heading.beyond_s == at(58) and heading.largest == pytest.approx(0.5)
    assert force.tolerance == pytest.approx(0.55) and force.beyond_s == at(6)
    strict = compare_rows(empty, [1, 2], within=2.0)
    assert [each.signal for each in strict.parted if each.beyond_s] == ["front_mm", "force"]


def test_what_chunks_do_not_keep_is_said_not_to_be_compared(empty: sqlite3.Connection) -> None:
    for scan in ([1.0, 2.0, 3.0], [1.0, 3.0, 2.0]):
        record(empty, lambda _, scan=scan: {"scan": [0.5] * 20 + scan}, 20)
    found = compare_rows(empty, [1, 2])
    assert found.parted == () and found.notes[0].startswith(
        "of arrays of more than 16 items count, min,"
    )


def test_repeats_are_judged_against_the_first_and_so_are_trials(empty: sqlite3.Connection) -> None:
    for state in (driving, driving, with_one_bit):
        record(empty, state)
    found = compare_repeats(empty, [1, 2, 3])
    assert [each.is_equal for each in found] == [True, False]
    assert verdict_on(found).startswith(
        "run 1 and 1 of 2 others part; run 3: equal to the last dig"
    )

    def noted(*run_ids: int) -> list[str]:
        set_id = create_trial_set(empty, '{"best": "highest"}', [{"speed": 1.0} for _ in run_ids])
        for trial, run_id in zip(trials_of(empty, set_id), run_ids, strict=True):
            finish_trial(empty, trial, TrialResult(run_id, 1.0, None, "for_s", 8.0))
        return repeats_noted(empty, set_id)

    (same,) = noted(1, 2)
    assert same.startswith("repeats of speed 1.0: 2 runs: equal to the last digit in the 500 rows")
    (parted,) = noted(1, 2, 3)
    assert parted.startswith("repeats of speed 1.0: run 1 and 1 of 2 others part; run 3: ")
    assert noted(1) == [] == repeats_noted(empty, create_trial_set(empty, "{}", [{}]))


def test_what_cannot_be_compared_is_refused(empty: sqlite3.Connection) -> None:
    record(empty, driving)
    record(empty, driving)
    for run_ids in ([1], [1, 1], [1, 2, 1]):
        with pytest.raises(InvalidInputError, match="two different runs"):
            compare_rows(empty, run_ids)
    with pytest.raises(UnknownRunError):
        compare_rows(empty, [1, 9])
    with pytest.raises(UnknownSignalError, match="pose"):
        compare_rows(empty, [1, 2], names=["poze.x"])
