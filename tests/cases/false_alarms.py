"""How often rules with a chosen number raise a false alarm: healthy robots, drawn at random.

`python -m tests.cases.false_alarms [RECORDINGS [DRAW]]` prints a line for each rule.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from tests.cases.columns import TURN, Array, Random, noise
from tests.cases.situations import Columns, Recording, Situation, recorded

_INTERVALS_S: Final = (0.02, 0.1, 0.25)
_NO_MORE_THAN: Final = 3.0  # with none in n tries the rate is under 3 / n, 19 times of 20


class Rule(NamedTuple):
    """A rule, healthy robots for it, and the chances for a false alarm in each recording."""

    name: str
    draw: Callable[[Array, Random], Columns]
    alarms: Callable[[Recording], int]
    chances: int


def _height(t: Array, random: Random) -> Columns:
    """Five targets of a height; reached with some delay, time constant and fastest speed."""
    aims = random.uniform(0.5, 10, 5)
    target = aims[np.minimum((t // (t[-1] / 5)).astype(int), 4)]
    delay_s, constant_s = random.uniform(0, 2), 10 ** random.uniform(-0.7, 1.3)
    fastest = 10 ** random.uniform(-0.3, 1)
    step, value, course = float(t[1] - t[0]), float(target[0]), list[float]()
    for wanted in np.interp(t - delay_s, t, target).tolist():
        speed = max(-fastest, min(fastest, (wanted - value) / constant_s))
        value += speed * step
        course.append(value)
    scatter = 10 ** random.uniform(-3, -1)
    return {"altitude_m": np.array(course) + noise(random, t, scatter), "altitude_target_m": target}


def _rounded(t: Array, random: Random) -> Columns:
    """A temperature that a thermostat keeps, rounded to about its noise."""
    period_s = random.uniform(40, 300)
    wave = np.abs((t / period_s) % 1 - 0.5)
    reading = 20 + random.uniform(0.3, 3) * wave + noise(random, t, 0.03)
    return {"room_temperature_c": np.round(reading / 0.1) * 0.1, "pose.x": 0.1 * t, "pose.y": 0 * t}


def _joint(t: Array, random: Random) -> Columns:
    """A joint that follows a moving target with some gain and lag; its speed varies."""
    period_s, gain, lag_s = 10 ** random.uniform(-0.2, 1.2), random.uniform(0.4, 1), 0.0
    lag_s = random.uniform(0, 0.2) * period_s
    size = 1 + random.uniform(0, 0.5) * np.sin(TURN * t / random.uniform(20, 60))
    aim = size * np.sin(TURN * t / period_s) + 0.3 * np.sin(TURN * t / (2.7 * period_s))
    follows = gain * np.interp(t - lag_s, t, aim)
    scatter = 10 ** random.uniform(-3, -1.3)
    return {"elbow.target": aim, "elbow.position": follows + noise(random, t, scatter)}


def _stepped(t: Array, random: Random) -> Columns:
    """A joint of second order, damped by a ratio of 0.5 or more, whose target steps."""
    aims = random.uniform(-2, 2, 12)
    damping, turns_rad_s = random.uniform(0.5, 1.5), 10 ** random.uniform(0, 1.3)
    target = aims[np.minimum((t // (t[-1] / 12)).astype(int), 11)]
    step_s, at, speed = 0.005, float(target[0]), 0.0
    moments = np.arange(0.0, float(t[-1]) + step_s, step_s)
    course = np.empty(len(moments))
    for row, aim in enumerate(target[np.searchsorted(t, moments).clip(0, len(t) - 1)].tolist()):
        speed += (turns_rad_s**2 * (aim - at) - 2 * damping * turns_rad_s * speed) * step_s
        at += speed * step_s
        course[row] = at
    scatter = 10 ** random.uniform(-3, -1)
    follows = np.interp(t, moments, course) + noise(random, t, scatter)
    return {"elbow.target": target, "elbow.position": follows}


def _wheels(t: Array, random: Random) -> Columns:
    """A robot on wheels or tracks that drives straight on, in curves and turns in place."""
    parts = np.minimum((t // (t[-1] / 16)).astype(int), 15)
    mean = random.choice([-5.0, 3.0, 5.0, 8.0], 16)[parts]
    apart = np.where(random.random(16) < 0.3, 0.0, random.uniform(-4, 4, 16))[parts]
    on_spot = (random.random(16) < 0.25)[parts]
    mean = np.where(on_spot, 0.0, mean)
    left, right = mean - apart, mean + apart
    radius_m = random.uniform(0.02, 0.2)
    track_m = radius_m * random.uniform(4, 10)  # so that it turns by 2 rad/s at most
    unlike = random.uniform(0.9, 1.1)  # radii of both sides
    skids = random.uniform(0.5, 1.0)  # of a turn that wheels without slip would make
    step = np.diff(t, prepend=0.0)
    rolled = left * radius_m * unlike, right * radius_m
    yaw = np.cumsum(skids * (rolled[1] - rolled[0]) / track_m * step)
    ahead = (rolled[0] + rolled[1]) / 2
    places = (np.cumsum(ahead * each(yaw) * step) for each in (np.cos, np.sin))
    noises = 10 ** random.uniform(-3.5, -2, 3)
    x, y = (each + noise(random, t, noises[0]) for each in places)
    return {
        "gps.x": x,
        "gps.y": y,
        "imu.yaw": np.remainder(yaw + noise(random, t, noises[1]) + np.pi, TURN) - np.pi,
        "left_wheel_speed": left + noise(random, t, 5 * noises[2]),
        "right_wheel_speed": right + noise(random, t, 5 * noises[2]),
    }


def _events(asked: Recording) -> int:
    return len(asked.events("off_target").events)


def _slips(asked: Recording) -> int:
    return len(asked.events("slip").events)


def _check(name: str) -> Callable[[Recording], int]:
    return lambda asked: sum(each.name == name for each in asked.checked.of("warn", "fail"))


RULES: Final = (
    Rule("a height off a target that stays for 6 s or more", _height, _events, 5),
    Rule("a rounded value that rests as three times before", _rounded, _check("sensors live"), 1),
    Rule("a moving target that is not followed", _joint, _events, 1),
    Rule("a target that steps and is passed", _stepped, _events, 11),
    Rule("a side of wheels that slips", _wheels, _slips, 1),
)


def measured(recordings: int, draw: str = "") -> Iterator[tuple[str, int, int]]:
    """Yield for each rule how many false alarms there were in how many chances.

    Args:
        recordings: Of each rule.
        draw: Any text; with another one, other robots are drawn.
    """
    for rule in RULES:
        alarms = 0
        for number in range(recordings):
            interval_s = _INTERVALS_S[number % len(_INTERVALS_S)]
            lasts_s = 600.0 if rule.draw is _rounded else 120.0
            drawn = Situation(f"{rule.name} {number}{draw}", rule.draw, (), lasts_s, interval_s)
            with recorded(drawn) as asked:
                alarms += rule.alarms(asked)
        yield rule.name, alarms, rule.chances * recordings


def stated(alarms: int, chances: int) -> str:
    """Return the rate in words."""
    at_most = "" if alarms else f" (under {100 * _NO_MORE_THAN / chances:.2g} %)"
    return f"{alarms} of {chances}{at_most}"


def main() -> None:
    """Print the rates."""
    arguments: list[Any] = sys.argv[1:]
    recordings = int(arguments[0]) if arguments else 60
    for name, alarms, chances in measured(recordings, *arguments[1:2]):
        print(f"{name}: {stated(alarms, chances)} false alarms", flush=True)


if __name__ == "__main__":
    main()
