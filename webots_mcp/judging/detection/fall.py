"""`fall`: a robot that stood upright tipped over and stayed down.

The tilt is the angle between the robot's up axis now and while it stood at first, from its roll and
pitch, so that a sensor that is mounted upside down does not matter. To which side it fell follows
from the world's up direction in the robot's own axes: x ahead, y to the left, z up. What flies or
climbs at such a tilt has not fallen: its position goes on changing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from webots_mcp.analysis.arrays import Array, np, runs_of
from webots_mcp.judging.detection.event import Event, NotSearchableError
from webots_mcp.judging.detection.search import (
    EventKind,
    Search,
    in_metres,
    is_counted_by_wheels,
)
from webots_mcp.signals.meaning import words_in
from webots_mcp.signals.naming import SOLIDS, WORLD
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.registered_signals import RegisteredSignal

UPRIGHT_RAD: Final = math.radians(30)  # below it a robot stands ...
FALLEN_RAD: Final = math.radians(60)  # ... beyond this it has tipped over ...
DOWN_RAD: Final = math.radians(45)  # ... and beyond this it lies
SETTLED_S: Final = 1.0  # for so long each of them has to last
MOVES_M_S: Final = 0.1  # what lies is slower in most seconds ...
_DEGREES: Final = 360.0
_BETWEEN: Final = math.tan(math.radians(67.5))  # nearer to one side than to between two sides
_NOISE: Final = 6.0  # ... but for so many standard deviations of a second's mean place
_FALLEN_DEG: Final = math.degrees(FALLEN_RAD)
NO_ATTITUDE: Final = (
    "no roll and pitch are recorded: publish them (of an InertialUnit), in rad or deg"
)
_OBSERVED: Final = (f"{WORLD}.", f"{SOLIDS}.")


class Attitude(NamedTuple):
    """What is known of how a body is tilted.

    Attributes:
        body: The branch of signals of a robot that an observer sees; None for the robot itself.
        roll: None where only the pitch is known; it counts as 0 then. `pitch` likewise.
    """

    body: str | None
    roll: RegisteredSignal | None
    pitch: RegisteredSignal | None


def fall_events(search: Search) -> Iterator[Event]:
    """From where the tilt leaves the upright range to where the robot stands again, if ever.

    In the run of an observer, of each robot that it sees.
    """
    attitudes = attitudes_in(search)
    if not attitudes:
        raise NotSearchableError(NO_ATTITUDE)
    are_known = False
    for attitude in attitudes:
        turns = _turns_of(search.whole, attitude.roll, attitude.pitch)
        tilted = tilt_of(search.frame, attitude.roll, attitude.pitch, turns)
        times, tilt = tilted.times, tilted.tilt
        if len(times) < 2:
            continue
        are_known = True
        search.judged(
            "fall",
            filter(None, (attitude.roll, attitude.pitch)),
            [(float(times[0]), float(times[-1]))],
        )
        yield from _falls_of(search, attitude.body, tilted)
        largest_deg = math.degrees(float(tilt.max()))
        of_body = "" if attitude.body is None else f" of {attitude.body}"
        what = f"largest tilt{of_body} was {largest_deg:.0f}°; {_FALLEN_DEG:.0f}° count"
        search.note_nearest("fall", float(tilt.max()) / FALLEN_RAD, what)
    if not are_known:
        raise NotSearchableError("roll and pitch have no value in that range")


def _falls_of(search: Search, body: str | None, tilted: Tilt) -> Iterator[Event]:
    fell_s, times, tilt = -math.inf, tilted.times, tilted.tilt
    for run in runs_of(tilt > DOWN_RAD, times).spans():
        lies = tilt[run.start : run.stop]
        lasts_s = run.end_s - run.start_s
        if run.start_s < fell_s or lasts_s < SETTLED_S or lies.max() < FALLEN_RAD:
            continue
        if body is None and _moves_on(search, run.start_s, run.end_s):
            continue
        before = np.flatnonzero(tilt[: run.start] > UPRIGHT_RAD)
        left = run.start
        while left > 0 and tilt[left - 1] > UPRIGHT_RAD:
            left -= 1
        stood = runs_of(tilt[:left] <= UPRIGHT_RAD, times[:left])
        if not len(stood.only(stood.durations_s >= SETTLED_S)) or len(before) == run.start:
            continue
        again = runs_of(tilt[run.stop :] <= UPRIGHT_RAD, times[run.stop :])
        up = again.only(again.durations_s >= SETTLED_S)
        fell_s = float(up.starts_s[0]) if len(up) else float(times[-1])
        details: dict[str, Any] = {
            "tilt_deg": round(math.degrees(float(np.median(lies))), 1),
            "got_up": bool(len(up)),
        }
        if direction := tilted.direction(slice(run.start, run.stop)):
            details["direction"] = direction
        yield search.event("fall", float(times[left]), fell_s, body, **details)


def _moves_on(search: Search, start_s: float, end_s: float) -> bool:
    """Return whether its place changed in most seconds of an interval.

    Means of seconds are compared, so that neither noise nor the rate of rows decides. Nothing is
    known to move where no place is known, or only what wheels count that may turn in the air.
    """
    motion = search.motion
    places = [
        each
        for each in (*(motion.position or ()), motion.height)
        if each is not None and not is_counted_by_wheels(each)
    ]
    part = search.frame.between(start_s, end_s)
    seconds = np.floor((part.times - start_s) / SETTLED_S).astype(np.intp)
    starts = np.flatnonzero(np.diff(seconds, prepend=-1))
    if len(starts) < 2:
        return False
    counts = np.diff(starts, append=len(seconds))
    moved_m2 = np.zeros(len(starts) - 1)
    least_m = MOVES_M_S * SETTLED_S
    for each in places:
        values = in_metres(each, part.bridged(each.name))
        means = np.add.reduceat(values, starts) / counts
        moved_m2 += np.diff(means) ** 2
        noise = in_metres(each, np.array([search.noise.of(each.name)]))[0]
        least_m = max(least_m, float(_NOISE * noise / np.sqrt(np.median(counts))))
    return bool(np.count_nonzero(moved_m2 > least_m**2) > len(moved_m2) / 2)


class Tilt(NamedTuple):
    """How a body is tilted in rows with an attitude.

    Attributes:
        times: Of the rows.
        tilt: From how it stood in its first second, in rad.
        ahead: How far the world's up direction points ahead in the body; 0 where it stands.
        left: How far it points to the body's left.
    """

    times: Array
    tilt: Array
    ahead: Array
    left: Array

    def direction(self, rows: slice) -> str:
        """Return to which side it lies in some rows; empty where that is not known.

        What points up is opposite to the side that it lies on. A body that lies between two sides
        is named by both.
        """
        ahead, left = (float(np.median(each[rows])) for each in (self.ahead, self.left))
        if math.hypot(ahead, left) < math.sin(UPRIGHT_RAD):
            return ""
        along, across = "back" if ahead > 0 else "forward", "right" if left > 0 else "left"
        if abs(ahead) > _BETWEEN * abs(left):
            return along
        return across if abs(left) > _BETWEEN * abs(ahead) else f"{along} {across}"


def tilt_of(
    frame: Frame,
    roll: RegisteredSignal | None,
    pitch: RegisteredSignal | None,
    turns: tuple[float, float],
) -> Tilt:
    """Return how a body is tilted.

    Args:
        frame: The rows.
        roll: None where only the pitch is known; it counts as 0 then.
        pitch: As `roll`.
        turns: A whole turn of both.
    """
    angles = [
        np.zeros(len(frame)) if each is None else frame.bridged(each.name, turn) * math.tau / turn
        for each, turn in zip((roll, pitch), turns, strict=True)
    ]
    there = np.isfinite(angles[0]) & np.isfinite(angles[1])
    across, along = (each[there] for each in angles)
    times = frame.times[there]
    if not len(times):
        return Tilt(times, across, across, across)
    up = np.stack((-np.sin(along), np.sin(across) * np.cos(along), np.cos(across) * np.cos(along)))
    first = np.median(up[:, times <= times[0] + SETTLED_S], axis=1)
    first /= np.linalg.norm(first) or 1.0
    tilt = np.arccos(np.minimum(np.maximum(first @ up, -1.0), 1.0))
    ahead: Array = np.array([1.0, 0.0, 0.0]) - first[0] * first
    ahead /= float(np.linalg.norm(ahead)) or 1.0
    return Tilt(times, tilt, ahead @ up, np.cross(first, ahead) @ up)


def _turns_of(
    run: Frame, roll: RegisteredSignal | None, pitch: RegisteredSignal | None
) -> tuple[float, float]:
    """Return a whole turn of both: those without a unit are degrees where one exceeds 2 pi."""
    known = {each.name: each.turn for each in (roll, pitch) if each is not None}
    open_ones = [
        each
        for each in (roll, pitch)
        if each is not None and each.stated_unit is None and each.turn != _DEGREES
        if "rad" not in words_in(each.name)
    ]
    if any(_exceeds_a_turn(run, each.name) for each in open_ones):
        known |= {each.name: _DEGREES for each in open_ones}
    of_roll, of_pitch = ((each and known[each.name]) or math.tau for each in (roll, pitch))
    return of_roll, of_pitch


def _exceeds_a_turn(run: Frame, name: str) -> bool:
    zones = run.zone_map(name)
    return bool((zones.max > math.tau).any() or (zones.min < -math.tau).any())


def attitudes_in(search: Search) -> list[Attitude]:
    """Return the attitudes in a run: of the robot itself, else of the robots that it observes.

    Roll and pitch of one device belong together, and the first device that has one counts.
    """
    by_branch: dict[str, dict[str, RegisteredSignal]] = {}
    for name, meaning in search.meanings.items():
        is_one = meaning.quantity in ("roll", "pitch") and meaning.is_sensed
        if is_one and search.whole.zone_map(name).value_count.any():
            found = by_branch.setdefault(name.rpartition(".")[0], {})
            found.setdefault(str(meaning.quantity), search.known[name])
    seen = {branch: each for branch, each in by_branch.items() if branch.startswith(_OBSERVED)}
    attitudes = [
        Attitude(branch, each.get("roll"), each.get("pitch"))
        for branch, each in seen.items()
        if branch.startswith(f"{WORLD}.")  # what is no robot may lie as it likes
    ]
    own = [each for branch, each in by_branch.items() if branch not in seen]
    if own:  # what stands in two branches (`roll.value`, `pitch.value`) is one attitude as well
        own.sort(key=len, reverse=True)
        merged = {quantity: each[quantity] for each in reversed(own) for quantity in each}
        attitudes.insert(0, Attitude(None, merged.get("roll"), merged.get("pitch")))
    return attitudes


FALL: Final = EventKind(
    "fall",
    "tipped over",
    fall_events,
    lasts=True,
    around_s=lambda options: 10 * SETTLED_S,
    drawn=0,
    severity=80,
)
