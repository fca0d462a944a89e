"""One situation at many rates and noises: it is answered alike, or said not to be searchable.

`python -m tests.cases.rates` prints the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from tests.cases.columns import TURN, Array, Random
from tests.cases.situations import Columns, Recording, Situation, recorded

INTERVALS_S: Final = (0.008, 0.032, 0.128, 0.5)
NOISES: Final = (0.0, 0.001, 0.005, 0.02)  # shares of the range of a signal
RIGHT, NOT_SEARCHED = "found", "not searched"
DENIED, INEXACT = "denied", "inexact"
_LASTS_S: Final = 60.0
_TOLERANCE_S: Final = 1.0
_TOLERANCE_ROWS: Final = 3

Span = tuple[float, float]
Noisy = Callable[[Array, float], Array]  # a signal and its range: the same with noise


@dataclass(frozen=True)
class Fault:
    """A fault whose answer must not depend on the rate or the noise.

    Attributes:
        kind: The kind of event, or the check, that has to answer.
        spans: From when to when it happens, each time.
        by_check: Whether a check answers, of which only the start is known.
    """

    draw: Callable[[Array, Noisy], Columns]
    kind: str
    spans: tuple[Span, ...]
    by_check: bool = False


def _pose(x: Array, like: Array, noisy: Noisy, range_m: float) -> dict[str, Array]:
    return {"pose.x": noisy(x, range_m), "pose.y": noisy(0 * like, range_m)}


def _stuck(t: Array, noisy: Noisy) -> Columns:
    way = 0.3 * (np.minimum(t, 20) + np.maximum(0, t - 40))
    return {**_pose(way, t, noisy, 0.3 * 40), "commanded_speed_m_s": 0 * t + 0.3}


def _dropout(t: Array, noisy: Noisy) -> Columns:
    gone = np.any([(t >= start) & (t < end) for start, end in _DROPOUTS], axis=0)
    reading = noisy(1.5 + 0.3 * np.sin(t / 5), 0.6)
    return {"front_distance_m": np.where(gone, 0.0, reading)}


def _oscillation(t: Array, noisy: Noisy) -> Columns:
    swings = (t >= 20) & (t < 40)
    return {"roll": noisy(0.2 * swings * np.sin(TURN * t / 2), 0.4)}


def _slip(t: Array, noisy: Noisy) -> Columns:
    speed = 0.2 * np.where((t >= 30) & (t < 50), 0.3, 1.0)
    way = np.cumsum(speed) * (t[1] - t[0])
    wheels = {f"wheels.{side}_rad_s": 0 * t + 5 for side in ("left", "right")}
    return {**_pose(way, t, noisy, 12.0), **wheels}


def _off_target(t: Array, noisy: Noisy) -> Columns:
    on = 1.0 * ((t >= 5) & (t < 45))
    jammed = (t >= 15) & (t < 45)
    return {
        "elbow.target": on + 0.5 * (t >= 10) * on,
        "elbow.position": noisy(on + 0.5 * (t >= 10) * on - 0.35 * jammed, 1.5),
    }


def _fall(t: Array, noisy: Noisy) -> Columns:
    pitch = 1.5 * np.clip((t - 33) / 0.6, 0, 1)
    return {"roll": noisy(0 * t, 1.5), "pitch": noisy(pitch, 1.5)}


def _flat(t: Array, noisy: Noisy) -> Columns:
    reading = noisy(20 + 4 * np.sin(t / 3) + 2 * np.sin(t / 1.3), 12.0)
    frozen = (t >= 25) & (t < 50)
    return {"temperature_c": np.where(frozen, reading[np.argmax(frozen)], reading)}


_DROPOUTS: Final[tuple[Span, ...]] = ((10, 11), (22, 23), (31, 32), (44, 45), (52, 53))
FAULTS: Final[dict[str, Fault]] = {
    "stuck": Fault(_stuck, "stuck", ((20, 40),)),
    "dropout": Fault(_dropout, "jump", _DROPOUTS),
    "oscillation": Fault(_oscillation, "oscillation", ((20, 40),)),
    "slip": Fault(_slip, "wheels grip", ((30, 50),), by_check=True),
    "off_target": Fault(_off_target, "off_target", ((15, 45),)),
    "fall": Fault(_fall, "fall", ((33, 60),)),
    "flat": Fault(_flat, "flat", ((25, 50),)),
}


def answer(name: str, interval_s: float, noise: float) -> str:
    """Record a fault at a rate with a noise, and say how it is answered."""
    fault = FAULTS[name]

    def draw(t: Array, random: Random) -> Columns:
        return fault.draw(t, lambda signal, size: signal + random.normal(0, noise * size, len(t)))

    with recorded(Situation(name, draw, (), _LASTS_S, interval_s)) as asked:
        judge = _by_check if fault.by_check else _by_events
        return judge(asked, fault, max(_TOLERANCE_S, _TOLERANCE_ROWS * interval_s))


def _by_check(asked: Recording, fault: Fault, tolerance_s: float) -> str:
    (found,) = (each for each in asked.checked.findings if each.name == fault.kind)
    if found.outcome not in ("warn", "fail"):
        return DENIED if found.outcome == "pass" else NOT_SEARCHED
    exact = found.since_s is not None and abs(found.since_s - fault.spans[0][0]) <= tolerance_s
    return RIGHT if exact else INEXACT


def _by_events(asked: Recording, fault: Fault, tolerance_s: float) -> str:
    answered = asked.events(fault.kind)
    found = [(each.start_s, each.end_s) for each in answered.events]
    if not found:
        return NOT_SEARCHED if fault.kind in answered.verdicts.reasons else DENIED
    exact = len(found) == len(fault.spans) and all(
        abs(got - want) <= tolerance_s
        for pair, span in zip(found, fault.spans, strict=True)
        for got, want in zip(pair, span, strict=True)
    )
    return RIGHT if exact else INEXACT


def table() -> Iterator[tuple[str, float, list[str]]]:
    """Yield for each fault and interval the answers at all noises."""
    for name, interval_s in product(FAULTS, INTERVALS_S):
        yield name, interval_s, [answer(name, interval_s, noise) for noise in NOISES]


def main() -> None:
    """Print the table."""
    print(f"{'fault':12} {'a row each':>10} " + " ".join(f"{100 * n:>10g} %" for n in NOISES))
    for name, interval_s, answers in table():
        cells = " ".join(f"{each:>12}" for each in answers)
        print(f"{name:12} {1000 * interval_s:>7g} ms {cells}")


if __name__ == "__main__":
    main()
