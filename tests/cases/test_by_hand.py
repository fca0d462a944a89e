"""Robots that were made to fool the judgements and did so: one for each cause."""

from __future__ import annotations

import math
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import pytest

from tests.cases.columns import Array, Random, noise, wrapped
from tests.cases.situations import Columns, Recording, Situation, recorded
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.store.reading.ranges import Scope, find_range

INTERVAL_S: Final = 0.032


@contextmanager
def asked(draw: Any, lasts_s: float = 80.0) -> Generator[Recording]:
    with recorded(Situation("by hand", draw, (), lasts_s, INTERVAL_S)) as recording:
        yield recording


def outcomes_of(recording: Recording) -> dict[str, str]:
    return {each.name: each.outcome for each in recording.checked.findings}


def complaints(recording: Recording) -> list[str]:
    return [name for name, each in outcomes_of(recording).items() if each in ("warn", "fail")]


def lagged(values: Array, rows: float = 4.0) -> Array:
    found, share = np.array(values), 1 - math.exp(-1 / rows)
    for at in range(1, len(values)):
        found[at] = found[at - 1] + share * (values[at] - found[at - 1])
    return found


def steps(t: Array, *parts: tuple[float, ...]) -> list[Array]:
    """Values that each hold until a time."""
    ends = np.array([part[0] for part in parts])
    at = np.minimum(np.searchsorted(ends, t, "right"), len(parts) - 1)
    return [np.array([part[1 + item] for part in parts])[at] for item in range(len(parts[0]) - 1)]


# -- a robot that can go sideways ------------------------------------------------------------------

AHEAD_AND_ASIDE: Final = [
    ("vx_cmd", "vy_cmd"),
    ("cmd_vel.linear.x", "cmd_vel.linear.y"),
    ("cmd.vx", "cmd.vy"),
    ("commanded_forward_m_s", "commanded_sideways_m_s"),
]


def omnidirectional(names: tuple[str, str], *, held: bool) -> Any:
    def draw(t: Array, random: Random) -> Columns:
        ahead, aside = steps(
            t, (2, 0, 0), (9, 0.3, 0), (11, 0, 0), (19, 0, 0.3), (22, 0, 0), (40, 0.3, 0),
            (60, 0, -0.3), (72, 0.3, 0), (80, 0, 0),
        )  # fmt: skip
        moves = ~(held & (t >= 45) & (t < 60))
        columns: dict[str, Any] = {
            "gps.x": np.cumsum(lagged(ahead) * moves) * INTERVAL_S + noise(random, t, 1e-3),
            "gps.y": np.cumsum(lagged(aside) * moves) * INTERVAL_S + noise(random, t, 1e-3),
            "imu.yaw": noise(random, t, 2e-3),
        }
        return columns | dict(zip(names, (ahead, aside), strict=True))

    return draw


@pytest.mark.parametrize("names", AHEAD_AND_ASIDE, ids=lambda names: names[1])
def test_a_robot_that_goes_sideways_was_told_to(names: tuple[str, str]) -> None:
    with asked(omnidirectional(names, held=False)) as recording:
        assert complaints(recording) == []


@pytest.mark.parametrize("names", AHEAD_AND_ASIDE, ids=lambda names: names[1])
def test_a_robot_that_is_told_to_go_sideways_and_does_not_is_stuck(names: tuple[str, str]) -> None:
    with asked(omnidirectional(names, held=True)) as recording:
        (stuck,) = recording.events("stuck").events
        assert stuck.start_s == pytest.approx(45, abs=1)
        assert outcomes_of(recording)["moves when commanded"] == "fail"


# -- wheels ----------------------------------------------------------------------------------------


def driving(t: Array, random: Random) -> tuple[Array, dict[str, Any]]:
    (speed,) = steps(t, (5, 0.0), (25, 0.3), (30, 0.0), (50, 0.3), (55, 0.0), (75, 0.3), (80, 0.0))
    went = np.cumsum(lagged(speed)) * INTERVAL_S
    place = {"gps.x": went + noise(random, t, 2e-3), "gps.y": noise(random, t, 2e-3)}
    return went, place | {"cmd_vel": speed}


@pytest.mark.parametrize("name", ["{}_wheel_sensor", "wheel_{}_rad", "{}_motor_sensor"])
def test_how_far_wheels_have_turned_is_not_how_fast_they_turn(name: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        went, columns = driving(t, random)
        return columns | {name.format(side): went / 0.03 for side in ("left", "right")}

    with asked(draw) as recording:
        assert complaints(recording) == []


@pytest.mark.parametrize("names", ["left_speed right_speed", "wheels.left wheels.right"])
def test_a_speed_that_a_controller_sets_has_a_greatest_value(names: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        _, columns = driving(t, random)
        set_speed = np.clip(9 * np.sin(t / 3) + 3 * np.sin(t / 1.7), -6.28, 6.28)
        return columns | dict.fromkeys(names.split(), set_speed)

    with asked(draw) as recording:
        assert "sensors within limits" not in complaints(recording)


# -- sensors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", ["roll pitch yaw", "imu.rpy", "rpy", "tilt.roll tilt.pitch"])
@pytest.mark.parametrize("unit", [1.0, math.degrees(1)], ids=["rad", "deg"])
def test_a_fall_is_seen_whatever_its_angles_are_called(names: str, unit: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        lies = np.clip((t - 30) / 0.6, 0, 1)
        parts = [unit * (each + noise(random, t, 3e-3)) for each in (1.5 * lies, 0 * t, 0.2 * lies)]
        columns = names.split()
        if len(columns) == 1:
            return {names: np.stack(parts, axis=1)}
        return dict(zip(columns, parts, strict=False))

    with asked(draw, 45.0) as recording:
        (fall,) = recording.events("fall").events
        assert fall.start_s == pytest.approx(30.3, abs=0.5)
        assert outcomes_of(recording)["stays upright"] == "fail"


def test_noise_that_grows_with_the_distance_is_no_degradation() -> None:
    def draw(t: Array, random: Random) -> Columns:
        _, columns = driving(t, random)
        distance = np.where(t < 40, 0.4, 2.5) + 0.02 * np.sin(t)
        return columns | {"front_m": distance * (1 + noise(random, t, 0.02))}

    with asked(draw) as recording:
        assert outcomes_of(recording)["sensors keep their noise"] != "warn"


@pytest.mark.parametrize(
    ("name", "nothing"),
    [("ball_distance", -1.0), ("ball_dist_m", 0.0), ("lead_distance_m", 999.0), ("front_m", -1.0)],
)
def test_nothing_in_sight_is_no_dropout(name: str, nothing: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        _, columns = driving(t, random)
        seen = 2 + 0.5 * np.sin(t / 4) + noise(random, t, 0.01)
        return columns | {name: np.where(t % 7 < 5.5, seen, nothing)}

    with asked(draw) as recording:
        assert "sensors drop nothing" not in complaints(recording)


@pytest.mark.parametrize("noise_m", [0.02, 0.05, 0.1])
def test_positions_of_a_robot_that_waits_before_it_drives_agree(noise_m: float) -> None:
    def draw(t: Array, random: Random) -> Columns:
        ahead, turns = steps(
            t, (30, 0, 0), (50, 0.6, 0), (53, 0.2, 0.5), (75, 0.6, 0), (78, 0.2, 0.5),
            (100, 0.6, 0), (110, 0, 0),
        )  # fmt: skip
        heading = np.cumsum(lagged(turns)) * INTERVAL_S
        speed = lagged(ahead)
        x, y = (np.cumsum(speed * each) * INTERVAL_S for each in (np.cos(heading), np.sin(heading)))
        return {
            "gps.x": x + noise(random, t, noise_m), "gps.y": y + noise(random, t, noise_m),
            "odom.x": x, "odom.y": y, "imu.yaw": wrapped(heading), "cmd_vel.linear": ahead,
        }  # fmt: skip

    with asked(draw, 110.0) as recording:
        assert outcomes_of(recording)["estimates agree"] == "pass"


@pytest.mark.parametrize("names", ["left_encoder right_encoder", "leftTicks rightTicks"])
def test_a_counter_that_stands_still_while_the_other_side_counts_froze(names: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        went, columns = driving(t, random)
        counts = np.floor(went * 5000)
        frozen = np.where(t > 31, counts[np.argmax(t > 31)], counts)
        return columns | dict(zip(names.split(), (frozen, counts), strict=True))

    with asked(draw) as recording:
        assert "sensors live" in complaints(recording)


def test_a_signal_of_unknown_meaning_that_goes_to_0_again_and_again_is_not_passed() -> None:
    def draw(t: Array, random: Random) -> Columns:
        _, columns = driving(t, random)
        gone = (t % 15 > 12) & (t % 15 < 12.15)
        return columns | {"cliffLeft": np.where(gone, 0.0, 2.6 + noise(random, t, 0.01))}

    with asked(draw) as recording:
        assert len(recording.events("jump").events) >= 3
        assert outcomes_of(recording)["sensors drop nothing"] == "not judged"


@pytest.mark.parametrize("kind", ["flat", "jump", "missing", "oscillation", "degradation"])
def test_every_kind_can_be_asked_of_one_item_of_a_long_array(kind: str) -> None:
    def draw(t: Array, random: Random) -> Columns:
        _, columns = driving(t, random)
        scan = np.stack([2 + noise(random, t, 0.01) for _ in range(40)], axis=1)
        scan[len(t) // 2 :, 12] = 2.0
        return columns | {"scan": scan}

    with asked(draw) as recording:
        found = recording.events(kind, signals=["scan.12", "gps.x"])
        assert {each.name for each in found.events} == ({"scan.12"} if kind == "flat" else set())
        assert found.verdicts.why_unsearched(kind) is None


def test_a_part_of_a_run_tells_degrees_as_the_whole_does() -> None:
    def draw(t: Array, random: Random) -> Columns:
        lies = np.clip((t - 30) / 0.6, 0, 1)
        return {"roll": 86 * lies + noise(random, t, 0.2), "pitch": noise(random, t, 0.2)}

    with asked(draw, 45.0) as recording:
        part = find_range(recording.connection, Scope(run_id=1, start_s=5.0, end_s=20.0))
        found = find_events(recording.connection, part, EventOptions(kinds=("fall",)))
        assert not found.events
        nearest = found.verdicts.nearest["fall"]
        assert float(nearest.removeprefix("largest tilt was ").partition("°")[0]) < 3


# -- episodes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["episode", "info.done", None])
def test_a_robot_that_is_put_back_for_an_episode_did_not_jump(name: str | None) -> None:
    def draw(t: Array, random: Random) -> Columns:
        moves = (t % 20 > 2) & (t % 20 < 17)
        columns: dict[str, Any] = {
            "gps.x": 0.25 * np.clip(t % 20 - 2, 0, 15) + noise(random, t, 1e-3),
            "gps.y": noise(random, t, 1e-3),
            "cmd_vel": 0.25 * moves,
        }
        if name is not None:
            columns[name] = t // 20 if name == "episode" else (t % 20 < 0.1).tolist()
        return columns

    with asked(draw) as recording:
        expected = ["stays in place"] if name is None else []
        assert complaints(recording) == expected
