"""How often rules with a chosen number raise a false alarm: healthy robots, drawn at random.

`python -m tests.cases.false_alarms` prints a line for each rule.
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


def _events(asked: Recording) -> int:
    return len(asked.events("off_target").events)


def _check(name: str) -> Callable[[Recording], int]:
    return lambda asked: sum(each.name == name for each in asked.checked.of("warn", "fail"))


RULES: Final = (
    Rule("a height off a target that stays for 6 s or more", _height, _events, 5),
    Rule("a rounded value that rests as three times before", _rounded, _check("sensors live"), 1),
    Rule("a moving target that is not followed", _joint, _events, 1),
)


def measured(recordings: int) -> Iterator[tuple[str, int, int]]:
    """Yield for each rule how many false alarms there were in how many chances."""
    for rule in RULES:
        alarms = 0
        for number in range(recordings):
            interval_s = _INTERVALS_S[number % len(_INTERVALS_S)]
            lasts_s = 600.0 if rule.draw is _rounded else 120.0
            drawn = Situation(f"{rule.name} {number}", rule.draw, (), lasts_s, interval_s)
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
    for name, alarms, chances in measured(int(arguments[0]) if arguments else 60):
        print(f"{name}: {stated(alarms, chances)} false alarms", flush=True)


if __name__ == "__main__":
    main()
