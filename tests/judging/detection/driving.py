"""Robots that drive, stop, dock, creep and turn, with the truth about where they stood."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby
from typing import Any, Final

import numpy as np

from tests.judging.detection.labelled import Array, Incident, LabelledRun, interval_of, noise_of

NOISES_M: Final = (0.0, 0.002, 0.005, 0.01, 0.02, 0.03)
NOISE_LEVELS_M: Final = (0.0, 0.005, 0.03)
# Words that contain hold, rest, ready, turn, stop and wait, and are modes in which robots drive.
DRIVING_MODES: Final = (
    "cruise", "returning", "threshold_wait", "forest", "already_home", "FOLLOW_LINE", "restock",
    "stop_and_go", "waiting_for_ball", "S3", "turn_to_goal", "Suche",
)  # fmt: skip
RESTING_MODES: Final = ("idle", "docked", "charging", "S0", "scan", "grasp", "fini", "drive_done")
LEAST_STANDSTILL_S: Final = 3.5  # 3 s count; one that is a row shorter or longer is not judged
SURELY_NONE_S: Final = 2.0
_FINE_S: Final = 0.005
_WHEEL_RADIUS_M: Final = 0.05
_FORMS: Final = ("pose", "position", "gps", "odom")
_EVIDENCE: Final = ("commanded", "wheels", "mode", "measured", "none")
_TOLD: Final = ("commanded", "wheels", "pushing")  # these show that it was told to stand
_MODELESS: Final = ("pushing", "speed_alone", "nothing")  # nor is anything taken for a mode
_UNTOLD: Final = ("none", "speed_alone", "nothing")  # these never show that it should move
TWITCHES_M: Final = (0.005, 0.025)


@dataclass(frozen=True)
class Phase:
    """A stretch in which a robot does one thing.

    Attributes:
        speed_m_s: How fast it truly drives.
        told_m_s: What its wheels are told; unlike the speed where something holds it.
    """

    duration_s: float
    speed_m_s: float
    turn_rad_s: float
    mode: str
    told_m_s: float


def phase(duration_s: float, speed_m_s: float, mode: str, turn_rad_s: float = 0.0) -> Phase:
    """One in which the robot does what it is told."""
    return Phase(duration_s, speed_m_s, turn_rad_s, mode, speed_m_s)


def held(duration_s: float, told_m_s: float, mode: str) -> Phase:
    """One in which the robot stands although it is told to drive."""
    return Phase(duration_s, 0.0, 0.0, mode, told_m_s)


def drive_of(rng: np.random.Generator, seconds: float, speed_m_s: float, mode: str) -> list[Phase]:
    """A drive with bends: straight on, wide and narrow turns of 1 to 5 s each."""
    phases: list[Phase] = []
    left_s = seconds
    while left_s > 0:
        part_s = min(left_s, float(rng.uniform(1, 5)))
        turn = float(rng.choice([0.0, 0.0, 0.5, -0.5, 0.8, -0.8, 1.5, -1.5]))
        phases.append(phase(part_s, speed_m_s, mode, turn))
        left_s -= part_s
    return phases


def driven(
    rng: np.random.Generator,
    phases: Sequence[Phase],
    interval_s: float,
    noise_m: float,
    evidence: str | None = None,
    form: str | None = None,
) -> LabelledRun:
    """The recording of a robot that goes through the phases one after the other.

    Args:
        rng: Draws the noise, and under which names things are published.
        phases: What it does.
        interval_s: Between two rows.
        noise_m: Standard deviation in each coordinate.
        evidence: What tells whether it should move: its commanded speed, its wheels' speeds, its
            mode, a measured speed beside the mode, or none; None draws one of these. Besides
            there is a measured speed with noise, beside the mode ("noisy") or without one
            ("speed_alone"), and what wheels are told beside what they do ("pushing").
        form: Under which name the position is published; None draws one.
    """
    evidence = evidence or str(rng.choice(_EVIDENCE))
    times = times_of(rng, sum(each.duration_s for each in phases), interval_s)
    at = _phases_at(phases, times)
    x, y, heading, way_m = way_of(phases, times)
    noise = rng.normal(0, noise_m, (2, len(times)))
    columns = {
        **_position(form or str(rng.choice(_FORMS)), x + noise[0], y + noise[1], heading),
        **_evidence(rng, evidence, [phases[index] for index in at]),
        **({} if evidence in _MODELESS else _unrelated(rng, len(times))),
    }
    incidents = _standstills(phases, interval_s, noise_m, evidence)
    return LabelledRun(times, columns, interval_s, tuple(incidents), noise_m, way_m)


def times_of(rng: np.random.Generator, duration_s: float, interval_s: float) -> Array:
    """Of rows that come evenly; a clock either counts its steps or adds them up."""
    rows = int(duration_s / interval_s) + 1
    if rng.random() < 0.5:
        steps: Array = np.arange(rows, dtype=np.float64)
        return np.round(steps * interval_s, 9)
    return np.array(list(accumulate([0.0] + [interval_s] * (rows - 1))))


def _phases_at(phases: Sequence[Phase], times: Array) -> list[int]:
    """Which phase it is at each of the times."""
    ends = list(accumulate(each.duration_s for each in phases))
    return np.minimum(np.searchsorted(ends, times, side="right"), len(phases) - 1).tolist()


def way_of(phases: Sequence[Phase], times: Array) -> tuple[Array, Array, Array, float]:
    """x, y and heading at those times without noise, and the metres travelled until the last."""
    fine = np.arange(0.0, float(times[-1]) + _FINE_S, _FINE_S)
    at = _phases_at(phases, fine)
    speed = np.array([each.speed_m_s for each in phases])[at]
    heading = np.cumsum(np.array([each.turn_rad_s for each in phases])[at]) * _FINE_S
    steps = np.stack((speed * np.cos(heading), speed * np.sin(heading), np.abs(speed))) * _FINE_S
    way: Array = np.cumsum(steps, axis=1) - steps[:, :1]
    x, y, travelled, turned = (np.interp(times, fine, each) for each in (*way, heading))
    return x, y, turned, float(travelled[-1])


def _position(form: str, x: Array, y: Array, heading: Array) -> dict[str, Any]:
    yaw = np.angle(np.exp(1j * heading)).tolist()
    places = list(zip(x.tolist(), y.tolist(), strict=True))
    if form == "pose":
        return {"pose": [[*place, turn] for place, turn in zip(places, yaw, strict=True)]}
    if form == "position":
        return {"position": [{"x": a, "y": b} for a, b in places], "heading": yaw}
    if form == "gps":
        return {"gps": [[a, b, 0.04] for a, b in places], "heading": yaw}
    return {"odom": [{"x": a, "y": b, "theta": c} for (a, b), c in zip(places, yaw, strict=True)]}


def _evidence(rng: np.random.Generator, evidence: str, rows: Sequence[Phase]) -> dict[str, Any]:
    """What is published of what the robot is told, and in which mode it is."""
    found: dict[str, Any] = {"mode": [row.mode for row in rows]}
    if evidence in ("none", "nothing"):
        return {}
    if evidence == "pushing":
        told = [round(row.told_m_s / _WHEEL_RADIUS_M, 4) for row in rows]
        turned = [round(row.speed_m_s / _WHEEL_RADIUS_M, 4) for row in rows]
        return {"cmd": [[each] * 2 for each in told], "wheels": [[each] * 2 for each in turned]}
    if evidence in ("noisy", "speed_alone"):
        noise_m_s = rng.normal(0, rng.uniform(0.002, 0.02), len(rows))
        speeds = [row.speed_m_s + each for row, each in zip(rows, noise_m_s.tolist(), strict=True)]
        return {"speed": speeds} | (found if evidence == "noisy" else {})
    if evidence == "commanded":
        found["commanded_m_s"] = [row.told_m_s for row in rows]
    if evidence == "wheels":
        found["wheels"] = [_wheels(row) for row in rows]
    if evidence == "measured":
        found["speed"] = [row.speed_m_s for row in rows]
    return found


def _wheels(row: Phase) -> dict[str, float]:
    ahead, apart = row.told_m_s / _WHEEL_RADIUS_M, row.turn_rad_s
    return {"left": round(ahead - apart, 4), "right": round(ahead + apart, 4)}


def _unrelated(rng: np.random.Generator, rows: int) -> dict[str, Any]:
    """What is published beside, and says nothing about whether the robot should move."""
    found: dict[str, Any] = {}
    if rng.random() < 0.4:
        found["status"] = ["ready"] * rows
    if rng.random() < 0.4:
        found["arm"] = [{"state": "idle"}] * rows
    return found


def _standstills(
    phases: Sequence[Phase], interval_s: float, noise_m: float, evidence: str
) -> list[Incident]:
    """Where it stood, and where it was stuck, if what is published tells.

    Standing while it turns is told or not, and is not stuck. Who stands at the end of a way in the
    same mode is stuck or has come: where the mode is all that is published, nobody can tell.
    """
    known = evidence not in _UNTOLD
    driven_in = set() if evidence in _TOLD else {each.mode for each in phases if each.speed_m_s}
    found: list[Incident] = []
    start_s = 0.0
    before: Phase | None = None
    reached = 0
    for (stands, told), group in groupby(phases, lambda each: (not each.speed_m_s, each.told_m_s)):
        part = list(group)
        reached += len(part)
        end_s = start_s + sum(each.duration_s for each in part)
        if stands and end_s - start_s >= SURELY_NONE_S:
            turning = any(each.turn_rad_s for each in part)
            optional = turning or end_s - start_s < LEAST_STANDSTILL_S
            after = phases[reached] if reached < len(phases) else None
            errors_s = (_least_error_s(each, interval_s, noise_m) for each in (before, after))
            begin_s, last_s = errors_s
            stop = Incident("standstill", start_s, end_s, optional=optional)
            found.append(replace(stop, begin_error_s=begin_s, end_error_s=last_s))
            come = not told and any(each.mode in driven_in for each in part)
            if evidence not in ("speed_alone", "nothing") and (told or come or not known):
                unclear = optional or come or not known
                found.append(Incident("stuck", start_s, end_s, optional=unclear))
        start_s, before = end_s, part[-1]
    return found


def _least_error_s(before: Phase | None, interval_s: float, noise_m: float) -> float:
    """Standard deviation that no unbiased estimate of the end of that drive falls below.

    Nobody knows how fast it came nor how it braked. A parabola through the n rows of its last
    steady part has at the last of them the variance noise**2 3 (3 n**2 - 3 n + 2) / (n (n + 1)
    (n + 2)), which the speed turns into time; no other estimate without bias is better (Gauss and
    Markov; for normal noise it is the bound of Cramer and Rao). Who knew that the last part was
    straight and steady would be off by 2/3 of it (2 noise / root of n, in place of 3, for many
    rows). Where it stands is known far better.
    """
    if before is None or not before.speed_m_s:
        return 0.0
    rows = max(1, round(before.duration_s / interval_s))
    variance = 3 * (3 * rows**2 - 3 * rows + 2) / (rows * (rows + 1) * (rows + 2))
    return noise_m * variance**0.5 / abs(before.speed_m_s)


def _setting(rng: np.random.Generator) -> tuple[float, float, float]:
    """Row interval, noise and speed of a drive."""
    interval_s = interval_of(rng, [0.008, 0.016, 0.032, 0.064, 0.1, 0.16, 0.25, 0.5])
    noise_m = noise_of(float(rng.choice(NOISES_M)), NOISE_LEVELS_M)
    return interval_s, noise_m, float(rng.uniform(0.1, 0.4))


def _modes(rng: np.random.Generator) -> tuple[str, str]:
    return str(rng.choice(DRIVING_MODES)), str(rng.choice(RESTING_MODES))


def draw_stop_and_go(rng: np.random.Generator) -> LabelledRun:
    """Drives of 2 to 15 s between stops of 4 to 15 s, each in a mode of its own and told so."""
    interval_s, noise_m, speed = _setting(rng)
    driving, resting = _modes(rng)
    phases = drive_of(rng, float(rng.uniform(5, 12)), speed, driving)
    while sum(each.duration_s for each in phases) < 100:
        phases.append(phase(float(rng.uniform(4, 15)), 0.0, resting))
        phases += drive_of(rng, float(rng.uniform(2, 15)), speed, driving)
    return driven(rng, phases, interval_s, noise_m)


def draw_held(rng: np.random.Generator) -> LabelledRun:
    """Something holds the robot once or twice, for 5 to 30 s, in a mode in which it drove."""
    interval_s, noise_m, speed = _setting(rng)
    driving, _ = _modes(rng)
    phases = drive_of(rng, float(rng.uniform(20, 40)), speed, driving)
    for _ in range(int(rng.integers(1, 3))):
        phases.append(held(float(rng.uniform(5, 30)), speed, driving))
        phases += drive_of(rng, float(rng.uniform(15, 30)), speed, driving)
    return driven(rng, phases, interval_s, noise_m)


def draw_docking(rng: np.random.Generator) -> LabelledRun:
    """Ever slower to a dock, 20 to 60 s there, and away.

    The last half second is driven at 25 to 100 mm/s. At 30 mm of noise even the best estimate of
    when the robot stood is then 3 rows off in the median (`_least_error_s`).
    """
    interval_s, noise_m, speed = _setting(rng)
    driving, resting = _modes(rng)
    phases = drive_of(rng, float(rng.uniform(20, 40)), speed, driving)
    phases += [phase(0.5, speed * share, driving) for share in (0.8, 0.6, 0.4, 0.25)]
    phases.append(phase(float(rng.uniform(20, 60)), 0.0, resting))
    phases += drive_of(rng, float(rng.uniform(20, 30)), speed, driving)
    return driven(rng, phases, interval_s, noise_m)


def draw_creep(rng: np.random.Generator) -> LabelledRun:
    """A steady 5 to 18 mm/s for 40 to 90 s between drives: slow, and at no time standing."""
    interval_s, noise_m, speed = _setting(rng)
    driving, other = _modes(rng)
    turn = float(rng.choice([0.0, 0.0, 0.05]))
    phases = drive_of(rng, 20.0, speed, driving)
    creeping = phase(float(rng.uniform(40, 90)), float(rng.uniform(0.005, 0.018)), other, turn)
    phases += [creeping, *drive_of(rng, 20.0, speed, driving)]
    return driven(rng, phases, interval_s, noise_m)


def draw_settling(rng: np.random.Generator) -> LabelledRun:
    """Up to a place at a steady 1 to 4 mm/s for 40 to 90 s, 20 to 60 s there, and away.

    How far it creeps is as long as the place is wide; from when on it stands shows in the rows.
    """
    interval_s, noise_m, speed = _setting(rng)
    driving, other = _modes(rng)
    phases = drive_of(rng, 20.0, speed, driving)
    phases.append(phase(float(rng.uniform(40, 90)), float(rng.uniform(0.001, 0.004)), other))
    phases.append(phase(float(rng.uniform(20, 60)), 0.0, other))
    return driven(rng, [*phases, *drive_of(rng, 20.0, speed, driving)], interval_s, noise_m)


def draw_turning(rng: np.random.Generator) -> LabelledRun:
    """Turns on the spot of 5 to 15 s, in the mode of the drive or in one of its own."""
    interval_s, noise_m, speed = _setting(rng)
    driving, other = _modes(rng)
    phases = drive_of(rng, 15.0, speed, driving)
    for _ in range(int(rng.integers(1, 4))):
        turn = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.5))
        mode = str(rng.choice([driving, other]))
        phases.append(phase(float(rng.uniform(5, 15)), 0.0, mode, turn))
        phases += drive_of(rng, 15.0, speed, driving)
    return driven(rng, phases, interval_s, noise_m)


def draw_noisy_speed(rng: np.random.Generator) -> LabelledRun:
    """Stops that are meant, of a robot whose measured speed is noise of 2 to 20 mm/s then."""
    interval_s, noise_m, speed = _setting(rng)
    driving, resting = _modes(rng)
    phases = drive_of(rng, float(rng.uniform(5, 12)), speed, driving)
    while sum(each.duration_s for each in phases) < 150:
        phases.append(phase(float(rng.uniform(4, 15)), 0.0, resting))
        phases += drive_of(rng, float(rng.uniform(2, 15)), speed, driving)
    return driven(rng, phases, interval_s, noise_m, str(rng.choice(["noisy", "speed_alone"])))


def draw_pushing(rng: np.random.Generator) -> LabelledRun:
    """Wheels that are told to turn and do not; in half of the cases it never moved before."""
    interval_s, noise_m, speed = _setting(rng)
    drive = drive_of(rng, 20.0, speed, "") if rng.random() < 0.5 else []
    phases = [*drive, held(float(rng.uniform(20, 60)), speed, "")]
    return driven(rng, phases, interval_s, noise_m, "pushing")


def draw_twitching(rng: np.random.Generator) -> LabelledRun:
    """A robot that stands and is told to drive after a while, which moves it by 5 and 25 mm."""
    interval_s, noise_m, speed = _setting(rng)
    driving, resting = _modes(rng)
    waits_s, told_s, rests_s = (float(rng.uniform(*each)) for each in ((5, 40), (25, 50), (10, 40)))
    drive = drive_of(rng, 20.0, speed, driving) if rng.random() < 0.5 else []
    phases = [*drive, phase(waits_s, 0.0, resting), held(told_s, speed, resting)]
    run = driven(
        rng, [*phases, phase(rests_s, 0.0, resting)], interval_s, noise_m, "commanded", "pose"
    )
    told_from_s = sum(each.duration_s for each in drive) + waits_s
    for share, far_m in zip((0.4, 0.95), TWITCHES_M, strict=True):
        run = moved(run, int((told_from_s + share * told_s) / interval_s), (far_m, 0.0))
    stuck = [each for each in run.incidents if each.measure == "stuck"]
    stands = replace(stuck[0], measure="standstill", start_s=told_from_s - waits_s,
                     end_s=float(run.times[-1]))  # fmt: skip
    return replace(run, incidents=(stands, *stuck))


def draw_hovering(rng: np.random.Generator) -> LabelledRun:
    """A drone with a row a second or two between flights: it drifts by 5 cm about its place."""
    interval_s, speed = float(rng.choice([0.5, 1.0])), float(rng.uniform(0.3, 1.0))
    driving, resting = _modes(rng)
    phases = drive_of(rng, 20.0, speed, driving)
    while sum(each.duration_s for each in phases) < 300:
        phases.append(phase(float(rng.uniform(30, 90)), 0.0, resting))
        phases += drive_of(rng, 20.0, speed, driving)
    evidence = str(rng.choice(["nothing", "noisy", "mode"]))
    run = driven(rng, phases, interval_s, 0.005, evidence, "pose")
    drift = rng.normal(0, 0.05 * 0.6, (len(run.times), 2))
    for row in range(1, len(drift)):
        drift[row] += 0.8 * drift[row - 1]
    pose = [
        [x + dx, y + dy, yaw]
        for (x, y, yaw), (dx, dy) in zip(run.columns["pose"], drift.tolist(), strict=True)
    ]
    optional = tuple(
        replace(each, optional=True) for each in run.incidents if each.measure == "standstill"
    )
    return replace(run, columns={**run.columns, "pose": pose}, incidents=optional)


def moved(run: LabelledRun, first: int, by_m: tuple[float, float]) -> LabelledRun:
    """The run with every position from that row on elsewhere."""
    name = next(each for each in ("pose", "position", "gps", "odom") if each in run.columns)
    places = [
        _place(value, by_m) if at >= first else value for at, value in enumerate(run.columns[name])
    ]
    return replace(run, columns={**run.columns, name: places})


def _place(value: Any, by_m: tuple[float, float]) -> Any:
    if isinstance(value, dict):
        return {**value, "x": value["x"] + by_m[0], "y": value["y"] + by_m[1]}
    return [value[0] + by_m[0], value[1] + by_m[1], value[2]]


def draw_rest(rng: np.random.Generator) -> LabelledRun:
    """Two minutes at rest."""
    interval_s, noise_m, _ = _setting(rng)
    return driven(rng, [phase(120.0, 0.0, _modes(rng)[1])], interval_s, noise_m)


def draw_drive(rng: np.random.Generator) -> LabelledRun:
    """Two minutes of driving without a stop."""
    interval_s, noise_m, speed = _setting(rng)
    return driven(rng, drive_of(rng, 120.0, speed, _modes(rng)[0]), interval_s, noise_m)


DRAWN: Final[dict[str, Callable[[np.random.Generator], LabelledRun]]] = {
    "stop_and_go": draw_stop_and_go,
    "held": draw_held,
    "docking": draw_docking,
    "creep": draw_creep,
    "settling": draw_settling,
    "turning": draw_turning,
    "rest": draw_rest,
    "drive": draw_drive,
    "noisy_speed": draw_noisy_speed,
    "pushing": draw_pushing,
    "twitching": draw_twitching,
    "hovering": draw_hovering,
}
