"""Checks of how a robot moved: as it was commanded, as its wheels turned, as others measured it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, cast

from webots_mcp.analysis.arrays import Array, median, np, runs_of
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.checks.finding import Finding, RunUnderCheck, times, total_s
from webots_mcp.judging.detection.fall import FALL
from webots_mcp.judging.detection.jump import JUMP
from webots_mcp.judging.detection.kinds import Event, NotSearchableError
from webots_mcp.judging.detection.oscillation import OSCILLATION
from webots_mcp.judging.detection.search import ROLLS_OUT_S, in_metres, places_in
from webots_mcp.judging.detection.slip import SLIP, flies
from webots_mcp.judging.detection.standstill import COMMAND_NOISE, TURNED_RAD
from webots_mcp.judging.detection.targets import OFF_TARGET, pursuits_in
from webots_mcp.signals.naming import BRANCHES, counted, listed, words_of
from webots_mcp.signals.register import PLACES
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.signals import RegisteredSignal, stored_roles

APART_S: Final = 3.0  # command and measurement for so long
NO_COMMAND: Final = (
    "nothing says when it should move: publish commanded_m_s, the speeds of its wheels, or mode"
)
_OF_RANGE: Final = 0.1  # of a target's whole range: what is apart by more is not there
_NEARER: Final = 0.002  # of that range, within `APART_S`: what comes so much nearer is on its way
_NOISE: Final = 6.0  # standard deviations; for half as many it may come nearer by chance
_HOLDING: Final = frozenset(("gripper", "finger", "hand", "claw", "jaw"))  # they close on things
_FITTED: Final = 0.2  # of the way: so much of it lays one estimate over the other
_LEAST_WAY_M: Final = 1.0
_SAME: Final = 0.1  # of the fitted way: two that are farther apart there are no two of one thing
_WARNS: Final = (0.05, 0.1)  # of the way, and m: farther apart is a drift worth a look
_FAILS: Final = (0.15, 0.3)
_OTHER_LENGTH: Final = 1.15  # times as long: worth a word


def moves_when_commanded(run: RunUnderCheck) -> Finding:
    """Fails where it stood although a command, its wheels or its mode say that it should move.

    Warns where only a mode that is the same in the whole run says so, or motors that lift it.
    """
    stood = run.events("standstill")
    stuck = [each for each in run.events("stuck") if each.duration_s >= APART_S]
    if stuck:
        evidence = f"stuck {times(len(stuck))}, {total_s(stuck):.3g} s in total"
        first = f"{evidence}; the first time {stuck[0].details['evidence_for']}"
        first += f", but {against}" if (against := stuck[0].details.get("evidence_against")) else ""
        outcome = "fail" if any(_is_shown(run, each) for each in stuck) else "warn"
        return Finding(outcome, first, stuck[0].start_s, len(stuck), run.more("stuck"))
    if undecided := run.found.verdicts.reasons.get("stuck"):
        return Finding("not judged", "; ".join(undecided))
    return Finding("pass", f"{counted(len(stood), 'standstill')}, none against a command")


def rests_when_commanded(run: RunUnderCheck) -> Finding:
    """Warns where it turned by 0.1 rad or went 5 cm while every command was 0."""
    motion = run.motion
    commands = [*filter(None, (motion.commanded, motion.turn_command)), *motion.wheel_commands]
    if not commands:
        raise NotSearchableError("no command is known")
    frame = run.frame
    idle = np.ones(len(frame), np.bool_)
    for each in commands:
        idle &= np.abs(frame.numbers(each.name)) <= COMMAND_NOISE * run.noise.of(each.name)
    moved: list[tuple[float, str]] = []
    for rest in runs_of(idle, frame.times).spans():
        if rest.end_s - rest.start_s >= ROLLS_OUT_S + APART_S:
            part = frame.between(rest.start_s + ROLLS_OUT_S, just_after(rest.end_s))
            moved += ((rest.start_s, each) for each in _moved_in(run, part))
    if not moved:
        return Finding("pass", "it rested whenever every command was 0")
    names = listed([each.name for each in commands], 3)
    evidence = f"{moved[0][1]} although {names} {'was' if len(commands) == 1 else 'were'} 0"
    shown = run.shows(*(each.name for each in commands[:2]))
    return Finding("warn", evidence, moved[0][0], len(moved), shown)


def _moved_in(run: RunUnderCheck, part: Frame) -> Iterator[str]:
    """How it moved in some rows, beyond the noise of its heading and position."""
    ends = max(1, min(len(part) // 4, 50))
    motion = run.motion
    may_turn = motion.turn_command is None and not motion.wheel_commands  # by a command unknown
    if (heading := motion.heading) is not None and not may_turn:
        turn = heading.turn or math.tau
        course = part.numbers(heading.name)
        course = unwrap(course[np.isfinite(course)], turn) * math.tau / turn
        if len(course) > 2 * ends:
            turned = median(course[-ends:]) - median(course[:ends])
            noise = run.noise.of(heading.name) * math.tau / turn
            if abs(turned) > max(TURNED_RAD, _NOISE * noise):
                yield f"turned by {turned:.2g} rad in {part.bounds_s[1] - part.bounds_s[0]:.3g} s"
    if motion.position is not None and (motion.commanded or motion.wheel_commands):
        rows, x, y = places_in(part, motion.position)
        if len(rows) > 2 * ends:
            way_m = math.hypot(*(median(each[-ends:]) - median(each[:ends]) for each in (x, y)))
            if way_m > max(run.search.options.stuck_m, _NOISE * run.noise.position_m):
                yield f"moved {way_m:.2g} m in {part.bounds_s[1] - part.bounds_s[0]:.3g} s"


def _is_shown(run: RunUnderCheck, stuck: Event) -> bool:
    """Whether more says that it should have moved than a constant mode, or motors that lift it."""
    said = stuck.details["evidence_for"].split("; ")
    if flies(run.search):
        said = [each for each in said if not each.startswith("wheels at ")]
    by_mode = [each for each in said if each.startswith(("in mode ", "mode "))]
    mode = run.motion.mode
    may_change = mode is not None and len(set(run.frame.coded(mode.name).labels)) > 2
    return len(said) > len(by_mode) or (bool(said) and may_change)


# -- command and measurement -----------------------------------------------------------------------


def follows_targets(run: RunUnderCheck) -> Finding:
    """Fails where something was a tenth of its target's range away for 3 s and came no nearer.

    Places where a robot shall go are no targets, and grippers hold things. A target that is always
    0 has no range to judge by.
    """
    found = run.events(OFF_TARGET.name)
    if not found:
        pursuits = pursuits_in(run.search)
        if not pursuits:
            raise NotSearchableError("no target is published next to what it is the target of")
        said = f"{counted(len(pursuits), 'target')} followed, as by {pursuits[0].measured.name}"
        return Finding("pass", said)
    names = listed(list(dict.fromkeys(each.name or "" for each in found)), 3)
    longest = max(found, key=lambda each: each.duration_s)
    details = longest.details
    evidence = (
        f"{names}: {details['off_percent']:g} % off {details['target']} for "
        f"{longest.duration_s:.3g} s without coming nearer"
    )
    return Finding("fail", evidence, found[0].start_s, len(found), run.more(OFF_TARGET.name))


def stays_stable(run: RunUnderCheck) -> Finding:
    """Warns where an oscillation of heading, wheels, speed and the like became twice as large."""
    growing = [
        each
        for each in run.events(OSCILLATION.name)
        if each.details.get("amplitude_at_end", 0.0) > each.details.get("amplitude_at_start", 0.0)
    ]
    if not growing:
        return Finding("pass", "no oscillation grew")
    worst = max(
        growing,
        key=lambda e: e.details["amplitude_at_end"] / (e.details["amplitude_at_start"] or 1),
    )
    start, end = (worst.details[f"amplitude_at_{at}"] for at in ("start", "end"))
    names = listed(list(dict.fromkeys(each.name or "" for each in growing)), 3)
    evidence = (
        f"{names}: the amplitude grew from {start:.3g} to {end:.3g} in {worst.duration_s:.3g} s, "
        f"with a period of {worst.details['period_s']:.3g} s"
    )
    return Finding("warn", evidence, worst.start_s, len(growing), run.more(OSCILLATION.name))


# -- attitude --------------------------------------------------------------------------------------


def stays_upright(run: RunUnderCheck) -> Finding:
    """Fails where it fell: tilted by over 60 degrees, and lay for a second or more."""
    falls = run.events(FALL.name)
    if not falls:
        return Finding("pass", run.found.verdicts.not_found.get(FALL.name) or "it never fell")
    first = falls[0]
    got_up = first.details.get("got_up")
    after = f"and got up {first.duration_s:.3g} s later" if got_up else "and stayed down"
    who = f"{first.name} " if first.name else ""
    evidence = f"{who}fell {times(len(falls))}: tilted by {first.details['tilt_deg']:.3g}° {after}"
    return Finding("fail", evidence, first.start_s, len(falls), run.more(FALL.name))


# -- wheels and motion -----------------------------------------------------------------------------


def wheels_grip(run: RunUnderCheck) -> Finding:
    """Fails where the wheels drove ahead for 3 s and it went less than half as far as usual.

    Also where it turned while the wheels of both sides turned alike: one side slipped.
    """
    slips = run.events(SLIP.name)
    if not slips:
        return Finding("pass", run.found.verdicts.not_found.get(SLIP.name) or "no wheel slipped")
    first = slips[0]
    longest_s = max(each.duration_s for each in slips)
    evidence = f"slipped {times(len(slips))}, up to {longest_s:.3g} s; {first.details['says']}"
    return Finding("fail", evidence, first.start_s, len(slips), run.more(SLIP.name))


# -- two estimates of one thing --------------------------------------------------------------------


def estimates_agree(run: RunUnderCheck) -> Finding:
    """Warns where two positions came apart by 5 % of the way, and fails from 15 % on.

    Each may have a frame of its own: they are laid over each other where the run begins; two that
    are far apart there already are not taken for estimates of one thing.
    """
    known = run.search.known
    by_role = {role: known[name] for name, role in stored_roles(known).items() if name in run.frame}
    pairs = [(by_role.get(f"x{place}"), by_role.get(f"y{place}")) for place in PLACES]
    positions = [(x, y) for x, y in pairs if x and y]
    made = [_drift(run, positions[0], other) for other in positions[1:]]
    if not (findings := [each for each in made if each is not None]):
        raise NotSearchableError(
            "no second position of the robot that goes along with the first"
            f" for {_LEAST_WAY_M:g} m: publish gps and odometry, say"
        )
    return min(findings, key=lambda each: ("fail", "warn", "pass").index(each.outcome))


def _drift(
    run: RunUnderCheck,
    one: tuple[RegisteredSignal, RegisteredSignal],
    other: tuple[RegisteredSignal, RegisteredSignal],
) -> Finding | None:
    """None where they are no two of one thing, or it went too little to tell."""
    both = [in_metres(each, run.frame.numbers(each.name)) for each in (*one, *other)]
    there = np.flatnonzero(np.isfinite(both).all(axis=0))
    if len(there) < 10:
        return None
    a: Any = both[0][there] + 1j * both[1][there]
    b: Any = both[2][there] + 1j * both[3][there]
    thin = max(1, len(there) // 500)
    way_m: Array = np.abs(np.diff(a[::thin])).cumsum()
    if way_m[-1] < _LEAST_WAY_M or np.abs(np.diff(b[::thin])).sum() < 0.2 * way_m[-1]:
        return None
    first = max(5, int(np.count_nonzero(way_m < _FITTED * way_m[-1])) * thin)
    a, b = a - a[:first].mean(), b - b[:first].mean()
    off = min((_laid_over(a, each, first) for each in (b, b.conj())), key=lambda each: each.max())
    if off[:first].max() > max(_SAME * _FITTED * way_m[-1], 0.1) and not _are_own(one, other):
        return None
    names = " and ".join(each[0].name.rpartition(".")[0] or each[0].name for each in (one, other))
    warns_m, fails_m = (max(share * way_m[-1], least) for share, least in (_WARNS, _FAILS))
    worst_m = float(off.max())
    evidence = f"{names}: {worst_m:.3g} m apart at most, of a path of {way_m[-1]:.3g} m"
    ratio = float(np.abs(np.diff(b[::thin])).sum() / way_m[-1])
    if not 1 / _OTHER_LENGTH < ratio < _OTHER_LENGTH:
        evidence += f"; the second path is {ratio:.3g} times as long"
    if worst_m <= warns_m:
        return Finding("pass", evidence)
    since_s = float(run.frame.times[there][int(np.argmax(off > warns_m))])
    outcome = "fail" if worst_m > fails_m else "warn"
    return Finding(outcome, evidence, since_s, 1, run.shows(one[0].name, other[0].name))


def _laid_over(a: Any, b: Any, first: int) -> Array:
    """How far two paths are apart where the second is turned so that its beginning fits best."""
    turn = cast("complex", np.vdot(b[:first], a[:first]))
    return np.asarray(np.abs(a - b * (turn / abs(turn) if turn else 1.0)))


def _are_own(*positions: tuple[RegisteredSignal, RegisteredSignal]) -> bool:
    """Whether the names of all say that they are positions of the robot itself."""
    return all(
        not set(BRANCHES).isdisjoint(words_of(x.name.partition(".")[0])) for x, _ in positions
    )


def stays_in_place(run: RunUnderCheck) -> Finding:
    """Warns where the position jumped: something put it elsewhere, or the estimate is wrong."""
    if run.motion.position is None:
        raise NotSearchableError("no position is published")
    leaps = [each for each in run.events(JUMP.name) if each.name == "position"]
    if not leaps:
        return Finding("pass", "its position never jumped")
    far_m = max(float(each.details.get("distance_m", 0.0)) for each in leaps)
    evidence = f"its position jumped {times(len(leaps))}, up to {far_m:.3g} m"
    return Finding("warn", evidence, leaps[0].start_s, len(leaps), run.more(JUMP.name))
