"""Checks of how a robot moved: as it was commanded, as its wheels turned, as others measured it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, cast

from webots_mcp.analysis.arrays import Array, Indexes, RowSpan, median, noise_of, np, runs_of
from webots_mcp.analysis.summary import usable_part
from webots_mcp.judging.checks.check import Examined, RunUnderCheck, times, total_s
from webots_mcp.judging.detection.event import Event, NotSearchableError
from webots_mcp.judging.detection.fall import FALL, FALLEN_RAD
from webots_mcp.judging.detection.holding import grips_in
from webots_mcp.judging.detection.jump import JUMP
from webots_mcp.judging.detection.oscillation import GROWS, OSCILLATION, growth_begins_s
from webots_mcp.judging.detection.search import ROLLS_OUT_S, in_metres, places_in
from webots_mcp.judging.detection.slip import SLIP, SLIPS, flies
from webots_mcp.judging.detection.standstill import (
    COMMAND_NOISE,
    SPEED_UNITS,
    TURNED_RAD,
)
from webots_mcp.judging.detection.targets import (
    OFF_S,
    OFF_SHARE,
    OFF_TARGET,
    OVERSHOT,
    pursuits_in,
)
from webots_mcp.judging.verdicts import Coverage, Fault
from webots_mcp.signals.meaning import words_in
from webots_mcp.signals.naming import BRANCHES, METRES, counted, listed, words_of
from webots_mcp.signals.register import PLACES
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.registered_signals import RegisteredSignal, stored_roles

APART_S: Final = 3.0  # command and measurement for so long
NO_COMMAND: Final = (
    "nothing says when it should move: publish commanded_m_s, the speeds of its wheels, or mode"
)
_LEAST_CELLS: Final = 10  # rows that two measurements are compared in
_OF_RANGE: Final = 0.1  # of a target's whole range: what is apart by more is not there
_NEARER: Final = 0.002  # of that range, within `APART_S`: what comes so much nearer is on its way
_PARTS: Final = (500, 250, 125, 60, 30)  # of a path, of which its length is measured
_NOISE: Final = 6.0  # standard deviations; for half as many it may come nearer by chance
_HOLDING: Final = frozenset(("gripper", "finger", "hand", "claw", "jaw"))  # they close on things
_FITTED: Final = 0.2  # of the way: so much of it lays one estimate over the other
_LEAST_WAY_M: Final = 1.0
_SAME: Final = 0.1  # of the fitted way: two that are farther apart there are no two of one thing
_WARNS: Final = (0.05, 0.1)  # of the way, and m: farther apart is a drift worth a look
_FAILS: Final = (0.15, 0.3)
_OTHER_LENGTH: Final = 1.15  # times as long: worth a word
_HEADING_WARNS_RAD: Final = 0.35  # two headings so far apart in the middle of a second, for 3 s
_HEADING_FAILS_RAD: Final = 1.0
_HEADING_CELL_S: Final = 1.0
# Words of who measures a heading, and of what it is: a name of others is not of the robot's own.
_MEASURES: Final = frozenset((
    "ahrs", "compass", "ekf", "estimate", "estimated", "filtered", "fused", "gps", "gyro", "imu",
    "mag", "magnetometer", "odom", "odometry", "pose", "position", "sensor", "true",
))  # fmt: skip
_EPISODES: Final = frozenset(("episode", "trial", "reset", "done", "terminated", "truncated"))
_HEADINGS: Final = frozenset(("attitude", "deg", "degree", "euler", "heading", "rad", "rpy", "yaw"))


def moves_when_commanded(run: RunUnderCheck) -> Examined:
    """Fails where it stood although a command, its wheels or its mode say that it should move.

    Warns where only a mode that is the same in the whole run says so, or motors that lift it.
    """
    stood = run.events("standstill")
    if stuck := run.events("stuck"):
        evidence = f"stuck {times(len(stuck))}, {total_s(stuck):.3g} s in total"
        first = f"{evidence}; the first time {stuck[0].details['evidence_for']}"
        first += f", but {against}" if (against := stuck[0].details.get("evidence_against")) else ""
        severity = "fail" if any(_is_shown(run, each) for each in stuck) else "warn"
        return Fault(severity, first, stuck[0].start_s, len(stuck), run.more("stuck"))
    options = run.search.options
    return run.covered(
        f"{counted(len(stood), 'standstill')}, none against a command",
        of="stuck",
        limit=f"limit {options.stuck_m:g} m in {options.stuck_s:g} s",
    )


def rests_when_commanded(run: RunUnderCheck) -> Examined:
    """Warns where it turned by 0.1 rad or went 5 cm while every command was 0."""
    motion = run.motion
    of_body = (motion.commanded, motion.sideways, motion.turn_command)
    commands = [*filter(None, of_body), *motion.wheel_commands]
    commands = [each for each in commands if each.name in run.frame]
    if not commands:
        raise NotSearchableError(
            "no command is recorded: publish the commanded speed, such as commanded_m_s"
        )
    frame = run.frame
    idle = np.ones(len(frame), np.bool_)
    for each in commands:
        idle &= np.abs(frame.bridged(each.name)) <= COMMAND_NOISE * run.noise.of(each.name)
    least_s = ROLLS_OUT_S + APART_S
    rests = [
        rest for rest in runs_of(idle, frame.times).spans() if rest.end_s - rest.start_s >= least_s
    ]
    names = listed([each.name for each in commands], 3)
    was = "was" if len(commands) == 1 else "were"
    if not rests:
        never = f"{names} {was} never 0" + f" for {least_s:g} s" * bool(idle.any())
        raise NotSearchableError(f"it was never commanded to rest: {never}")
    moved: list[tuple[RowSpan, str]] = []
    leaps_s = [each.start_s for each in _leaps_in(run)]
    for rest in rests:
        if any(rest.start_s <= leap_s <= rest.end_s for leap_s in leaps_s):
            continue  # something put it elsewhere meanwhile, which another check tells
        part = frame.between(rest.start_s + ROLLS_OUT_S, just_after(rest.end_s))
        moved += ((rest, each) for each in _moved_in(run, part))
    if not moved:
        rested = "it rested whenever every command was 0"
        judged = counted(len(commands), "command")
        lasts_s = sum(rest.end_s - rest.start_s for rest in rests)
        limit = f"limit {TURNED_RAD:g} rad or 5 cm"
        return run.covered(rested, judged=judged, limit=limit, lasts_s=lasts_s)
    first, how = moved[0]
    while_0 = f"{names} {was} 0 from {first.start_s:.6g} to {first.end_s:.6g} s"
    evidence = f"{how} although {while_0}"
    seen = [*(run.motion.position or ()), *filter(None, [run.motion.heading])]
    shown = run.shows(*(each.name for each in [*commands[:2], *seen]))
    return Fault("warn", evidence, first.start_s, len(moved), shown)


def _moved_in(run: RunUnderCheck, part: Frame) -> Iterator[str]:
    """How it moved in some rows, beyond the noise of its heading and position.

    Compared are the medians of the first and of the last rows, of as many as half of them hold.
    """
    ends = max(1, min(len(part) // 4, 50))
    motion = run.motion
    may_turn = motion.turn_command is None and not motion.wheel_commands  # by a command unknown
    if (heading := motion.heading) is not None and not may_turn:
        turn = heading.turn or math.tau
        times_s, course = usable_part(part.times, part.bridged(heading.name, turn))
        course = course * math.tau / turn
        if len(course) > 2 * ends:
            turned = median(course[-ends:]) - median(course[:ends])
            noise = run.noise.of(heading.name) * math.tau / turn
            if abs(turned) > max(TURNED_RAD, _NOISE * noise):
                yield f"turned by {turned:.2g} rad {_between(times_s, ends)}"
    if motion.position is not None and (motion.commanded or motion.wheel_commands):
        rows, x, y = places_in(part, motion.position)
        if len(rows) > 2 * ends:
            way_m = math.hypot(*(median(each[-ends:]) - median(each[:ends]) for each in (x, y)))
            if way_m > max(run.search.options.stuck_m, _NOISE * run.noise.position_m):
                yield f"moved {way_m:.2g} m {_between(part.times[rows], ends)}"


def _between(times_s: Array, ends: int) -> str:
    """From when to when a way was measured: between the middles of the rows at both ends."""
    first_s, last_s = (median(each) for each in (times_s[:ends], times_s[-ends:]))
    of = f" (medians of {ends} rows)" if ends > 1 else ""
    return f"from {first_s:.4g} to {last_s:.4g} s{of}"


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


def follows_targets(run: RunUnderCheck) -> Examined:
    """Fails where something was a tenth of its target's range away for 3 s and came no nearer.

    Also where it made less than half of the usual share of the motion of a target that keeps
    moving. Warns where a target that had stepped was passed by a quarter of the step, and where a
    closed gripper lost the force with which it held something. Places where a robot shall go are no
    targets, and grippers hold things. A target that is always 0 has no range to judge by.
    """
    found = run.events(OFF_TARGET.name)
    if not found:
        pursuits = pursuits_in(run.search)
        if not pursuits and (grips := grips_in(run.search)):
            return run.covered(f"{counted(len(grips), 'grip')} kept", of=OFF_TARGET.name)
        if not pursuits:
            raise NotSearchableError("no target is published next to what it is the target of")
        said = f"{counted(len(pursuits), 'target')} followed, as by {pursuits[0].measured.name}"
        limit = f"limit {100 * OFF_SHARE:g} % off for {OFF_S:g} s"
        return run.covered(said, of=OFF_TARGET.name, limit=limit)
    away = [each for each in found if OVERSHOT not in each.details]
    if not away:
        return _overshot(run, found)
    names = listed(list(dict.fromkeys(each.name or "" for each in away)), 3)
    longest = max(away, key=lambda each: each.duration_s)
    details = longest.details
    evidence = (
        f"{names}: {details['off_percent']:g} % off {details['target']} for "
        f"{longest.duration_s:.3g} s, {details.get('says', 'without coming nearer')}"
    )
    firm = run.firmest(each.name or "" for each in found)
    more = run.more(OFF_TARGET.name)
    grips = {each.force.name for each in grips_in(run.search)}
    severity = "warn" if grips.issuperset(each.name or "" for each in away) else "fail"
    return Fault(severity, evidence, found[0].start_s, len(found), more, signals=firm)


def _overshot(run: RunUnderCheck, found: list[Event]) -> Fault:
    worst = max(found, key=lambda each: each.details[OVERSHOT])
    names = listed(list(dict.fromkeys(each.name or "" for each in found)), 3)
    evidence = f"{names}: overshot {times(len(found))}; at most {worst.details['says']}"
    firm = run.firmest(each.name or "" for each in found)
    more = run.more(OFF_TARGET.name)
    return Fault("warn", evidence, found[0].start_s, len(found), more, signals=firm)


def stays_stable(run: RunUnderCheck) -> Examined:
    """Warns where an oscillation of heading, wheels, speed and the like became twice as large.

    It has to grow steadily: of those that do not, a rank test takes one in 1,000 to grow. What
    follows a target whose oscillation grew as well does what it shall, and how a joint shall move
    is planned.
    """
    pursuits = pursuits_in(run.search)
    targets = {each.measured.name: each.target.name for each in pursuits}
    planned = {
        each.target.name
        for each in pursuits
        if run.meanings[each.measured.name].quantity == "joint position"
    }
    growing: dict[float, Event] = {}
    for each in run.events(OSCILLATION.name):
        ends = (each.details.get(f"amplitude_at_{at}", 0.0) for at in ("start", "end"))
        if next(ends) >= next(ends) or each.name in planned:
            continue
        if _target_grew(run, each, targets.get(each.name or "")):
            continue
        turn = run.search.known[each.name or ""].turn
        if (since_s := growth_begins_s(run.frame, each, turn)) is not None:
            growing.setdefault(since_s, each)
    if not growing:
        return run.covered(
            "no oscillation grew", of=OSCILLATION.name, limit=f"limit {GROWS:g} times"
        )
    worst = max(
        growing.values(),
        key=lambda e: e.details["amplitude_at_end"] / (e.details["amplitude_at_start"] or 1),
    )
    start, end = (worst.details[f"amplitude_at_{at}"] for at in ("start", "end"))
    names = listed(list(dict.fromkeys(each.name or "" for each in growing.values())), 3)
    evidence = (
        f"{names}: the amplitude grew from {start:.3g} to {end:.3g} in {worst.duration_s:.3g} s, "
        f"with a period of {worst.details['period_s']:.3g} s"
    )
    return Fault("warn", evidence, min(growing), len(growing), run.more(OSCILLATION.name))


def _target_grew(run: RunUnderCheck, growing: Event, target: str | None) -> bool:
    """Whether the target of an oscillation went to and fro twice as far at its end as well.

    How far it went to and fro is what it moved beyond the way from its first value to its last: a
    target that steps or ramps once, as for a landing, did not.
    """
    if target is None:
        return False
    two_s = 2 * float(growing.details["period_s"])
    ends = (
        (growing.start_s, growing.start_s + two_s),
        (growing.end_s - two_s, just_after(growing.end_s)),
    )
    moved: list[float] = []
    largest = 0.0
    for span in ends:
        values = run.frame.between(*span).usable(target)[1]
        if not len(values):
            return False
        moved.append(float(np.abs(np.diff(values)).sum()) - abs(float(values[-1] - values[0])))
        largest = max(largest, len(values) * float(np.abs(values).max()))
    rounding = float(np.finfo(np.float64).eps) * largest
    return moved[1] >= GROWS * moved[0] and moved[1] > rounding


# -- attitude --------------------------------------------------------------------------------------


def stays_upright(run: RunUnderCheck) -> Examined:
    """Fails where it fell: tilted by over 60 degrees, and lay for a second or more."""
    falls = run.events(FALL.name)
    if not falls:
        said = run.found.verdicts.not_found.get(FALL.name) or "it never fell"
        return run.covered(said, of=FALL.name, limit=f"limit {math.degrees(FALLEN_RAD):.0f}°")
    first = falls[0]
    got_up = first.details.get("got_up")
    after = f"and got up {first.duration_s:.3g} s later" if got_up else "and stayed down"
    who = f"{first.name} " if first.name else ""
    to = f" ({first.details['direction']})" if "direction" in first.details else ""
    tilted = f"tilted by {first.details['tilt_deg']:.3g}°{to} {after}"
    evidence = f"{who}fell {times(len(falls))}: {tilted}"
    return Fault("fail", evidence, first.start_s, len(falls), run.more(FALL.name))


# -- wheels and motion -----------------------------------------------------------------------------


def wheels_grip(run: RunUnderCheck) -> Examined:
    """Fails where the wheels drove ahead for 3 s and it went less than half as far as usual.

    Also where it turned while the wheels of both sides turned alike: one side slipped.
    """
    slips = run.events(SLIP.name)
    if not slips:
        said = run.found.verdicts.not_found.get(SLIP.name) or "no wheel slipped"
        return run.covered(said, of=SLIP.name, limit=f"slip limit {100 * SLIPS:g} %")
    first = slips[0]
    longest_s = max(each.duration_s for each in slips)
    evidence = f"slipped {times(len(slips))}, up to {longest_s:.3g} s; {first.details['says']}"
    return Fault("fail", evidence, first.start_s, len(slips), run.more(SLIP.name))


# -- two estimates of one thing --------------------------------------------------------------------


def estimates_agree(run: RunUnderCheck) -> Examined:
    """Warns where two positions came apart by 5 % of the way, and fails from 15 % on.

    So for two headings by 0.35 and 1 rad for 3 s. Each may have a frame of its own: they are laid
    over each other where the run begins; two positions that are far apart there already are not
    taken for estimates of one thing.
    """
    known = run.search.known
    by_role = {role: known[name] for name, role in stored_roles(known).items() if name in run.frame}
    pairs = [(by_role.get(f"x{place}"), by_role.get(f"y{place}")) for place in PLACES]
    positions = [(x, y) for x, y in pairs if x and y]
    if not positions and run.motion.position is not None:
        positions = [run.motion.position]
    made: list[Examined | None] = []
    if positions:
        declared = _same_positions(run, positions[0])
        others = [each for each in positions[1:] if each not in declared]
        made = [_drift(run, positions[0], each) for each in others]
        made += [_drift(run, positions[0], each, is_declared=True) for each in declared]
    headings = [name for name in known if name in run.frame and _is_own_heading(run, name)]
    made += [_turned_apart(run, headings[0], other) for other in headings[1:]]
    made += [_values_apart(run, *each) for each in _same_values(run)]
    if not (examined := [each for each in made if each is not None]):
        raise NotSearchableError(
            "needs two independent positions or headings of a robot that moves at least "
            f"{_LEAST_WAY_M:g} m: publish, for example, gps and odometry, or declare same_as"
        )
    faults = [each for each in examined if isinstance(each, Fault)]
    return min(faults, key=lambda each: each.severity, default=examined[0])


def _drift(
    run: RunUnderCheck,
    one: tuple[RegisteredSignal, RegisteredSignal],
    other: tuple[RegisteredSignal, RegisteredSignal],
    *,
    is_declared: bool = False,
) -> Examined | None:
    """None where they are no two of one thing, or it went too little to tell."""
    both = [in_metres(each, run.frame.numbers(each.name)) for each in (*one, *other)]
    there = np.flatnonzero(np.isfinite(both).all(axis=0))
    if len(there) < 10:
        return None
    a: Any = both[0][there] + 1j * both[1][there]
    b: Any = both[2][there] + 1j * both[3][there]
    way_m, rows = _way_of(a)
    other_m = float(_way_of(b)[0][-1])
    if way_m[-1] < _LEAST_WAY_M or other_m < 0.2 * way_m[-1]:
        return None
    first = max(5, int(np.count_nonzero(way_m < _FITTED * way_m[-1])) * rows)
    a, b = a - a[:first].mean(), b - b[:first].mean()
    off = min((_laid_over(a, each, first) for each in (b, b.conj())), key=lambda each: each.max())
    is_apart = off[:first].max() > max(_SAME * _FITTED * way_m[-1], 0.1)
    if is_apart and not is_declared and not _are_own(one, other):
        return None
    names = " and ".join(each[0].name.rpartition(".")[0] or each[0].name for each in (one, other))
    warns_m, fails_m = (max(share * way_m[-1], least) for share, least in (_WARNS, _FAILS))
    worst_m = float(off.max())
    evidence = f"{names}: {worst_m:.3g} m apart at most, of a path of {way_m[-1]:.3g} m"
    ratio = other_m / float(way_m[-1])
    if not 1 / _OTHER_LENGTH < ratio < _OTHER_LENGTH:
        evidence += f"; the second path is {ratio:.3g} times as long"
    if worst_m <= warns_m:
        limit = f"limit {100 * _WARNS[0]:g} % of the path"
        return run.covered(evidence, judged="2 positions", limit=limit)
    since_s = float(run.frame.times[there][int(np.argmax(off > warns_m))])
    severity = "fail" if worst_m > fails_m else "warn"
    return Fault(severity, evidence, since_s, 1, run.shows(one[0].name, other[0].name))


def _is_own_heading(run: RunUnderCheck, name: str) -> bool:
    """Whether a heading is measured, and its name says of nothing but by whom."""
    meaning, words = run.meanings[name], frozenset(words_in(run.search.own_names[name]))
    if not run.search.known[name].is_number or meaning.quantity not in ("heading", None):
        return False
    is_heading = meaning.quantity == "heading" or not words.isdisjoint(("heading", "yaw"))
    return is_heading and meaning.role in ("measured", None) and words <= _MEASURES | _HEADINGS


def _turned_apart(run: RunUnderCheck, one: str, other: str) -> Examined:
    """How far two headings came apart; they may differ in sense and where they begin to count."""
    courses: list[Array] = []
    for name in (one, other):
        in_degrees = not frozenset(words_in(name)).isdisjoint(("deg", "degree"))
        turn = run.search.known[name].turn or (360 if in_degrees else math.tau)
        courses.append(np.asarray(run.frame.numbers(name) * math.tau / turn))
    there = np.isfinite(courses[0]) & np.isfinite(courses[1])
    clock = run.frame.times[there]
    if len(clock) < 2:
        return Coverage.lacking(f"{one} and {other} are never known at once", "absent")
    a, b = (each[there] for each in courses)
    cells = np.flatnonzero(np.diff(clock // _HEADING_CELL_S, prepend=-1))
    one_turn, other_turn = ((np.cos(each), np.sin(each)) for each in (a, b))
    both = [_cells_apart(one_turn, other_turn, sense, cells) for sense in (1, -1)]
    off = min(both, key=median)
    apart = runs_of(off > _HEADING_WARNS_RAD, clock[cells])
    long = apart.only(apart.durations_s + _HEADING_CELL_S >= APART_S)
    evidence = f"{one} and {other}: {off.max():.3g} rad apart at most"
    if not len(long):
        limit = f"limit {_HEADING_WARNS_RAD:g} rad for {APART_S:g} s"
        return run.covered(evidence, signals=[one, other], judged="2 headings", limit=limit)
    worst = max(median(off[each.start : each.stop]) for each in long.spans())
    evidence = f"{one} and {other}: {worst:.3g} rad apart, {times(len(long))} for 3 s or more"
    return Fault(
        "fail" if worst > _HEADING_FAILS_RAD else "warn",
        evidence,
        float(long.starts_s[0]),
        len(long),
        run.shows(one, other),
        signals=(one, other),
    )


def _cells_apart(
    one: tuple[Array, Array], other: tuple[Array, Array], sense: int, cells: Indexes
) -> Array:
    """The mean angle of a difference in each cell, from that of the first cell on.

    Args:
        one: Cosine and sine of an angle.
        other: The same of the angle that is subtracted.
        sense: -1 where that one counts the other way round.
        cells: Where each cell begins.
    """
    (a, b), (c, d) = one, other
    along: Array = np.add.reduceat(a * c + sense * b * d, cells)
    across: Array = np.add.reduceat(b * c - sense * a * d, cells)
    along, across = along * along[0] + across * across[0], across * along[0] - along * across[0]
    return np.abs(np.arctan2(across, along))


def _same_positions(
    run: RunUnderCheck, one: tuple[RegisteredSignal, RegisteredSignal]
) -> list[tuple[RegisteredSignal, RegisteredSignal]]:
    """Positions of which it was declared that they measure the same as the first."""
    known, same = run.search.known, _declared_same(run)
    both = [[b if a == each.name else a for a, b in same if each.name in (a, b)] for each in one]
    return [(known[x], known[y]) for x, y in zip(*both, strict=False)]


def _declared_same(run: RunUnderCheck) -> list[tuple[str, str]]:
    """Pairs of signals that were published and declared to measure the same thing."""
    return [
        (name, each.same_as)
        for name, each in run.meanings.items()
        if each.same_as is not None and name in run.frame and each.same_as in run.frame
        if not each.sets and not run.meanings[each.same_as].sets
    ]


def _same_values(run: RunUnderCheck) -> list[tuple[RegisteredSignal, RegisteredSignal]]:
    """The declared pairs that are no coordinates of a position, which may have its own frame."""
    return [
        (run.search.known[one], run.search.known[other])
        for one, other in _declared_same(run)
        if not {run.meanings[one].quantity, run.meanings[other].quantity} & {"x", "y"}
    ]


def _values_apart(
    run: RunUnderCheck, one: RegisteredSignal, other: RegisteredSignal
) -> Examined | None:
    """Whether two measurements of one value are apart for 3 s, by medians of a second each."""
    a, b = (_in_one_unit(each, run.frame.numbers(each.name)) for each in (one, other))
    there = np.flatnonzero(np.isfinite(a) & np.isfinite(b))
    reach = float(np.ptp(np.concatenate((a[there], b[there])))) if len(there) else 0.0
    if len(there) < _LEAST_CELLS or not reach:
        return None
    off = np.abs(a[there] - b[there])
    if one.turn:
        off = np.abs(np.remainder(a[there] - b[there] + math.pi, math.tau) - math.pi)
    clock = run.frame.times[there]
    starts = np.flatnonzero(np.diff(np.floor(clock), prepend=-1))
    middles = np.array([float(np.median(part)) for part in np.split(off, starts[1:].tolist())])
    noises = [_in_one_unit(each, np.array([run.noise.of(each.name)]))[0] for each in (one, other)]
    noise = _NOISE * float(max(noises))
    names = f"{one.name} and {other.name}"
    for limits in (_FAILS, _WARNS):
        severity, share = ("fail" if limits is _FAILS else "warn"), limits[0]
        apart = runs_of(middles > max(share * reach, noise), clock[starts])
        long = apart.only(apart.durations_s >= APART_S)
        if len(long):
            span = next(iter(long.spans()))
            far = float(np.median(middles[span.start : span.stop]))
            evidence = f"{names}: {far:.3g} apart, {100 * far / reach:.3g} % of their range"
            more = run.shows(one.name, other.name)
            firm = run.firmest([one.name])
            return Fault(severity, evidence, span.start_s, len(long), more, signals=firm)
    judged, limit = "2 measurements", f"limit {100 * _WARNS[0]:g} % of their range"
    return run.covered(f"{names}: {float(middles.max()):.3g} apart", judged=judged, limit=limit)


def _in_one_unit(signal: RegisteredSignal, values: Array) -> Array:
    """Values in metres, radians, m/s or rad/s, where they have such a unit."""
    if signal.turn:
        return values * (math.tau / signal.turn)
    unit = signal.unit or ""
    return values * SPEED_UNITS.get(unit, METRES.get(unit, 1.0))


def _way_of(path: Any) -> tuple[Array, int]:
    """How far it went up to the end of each part of a path, beyond noise, and the rows of a part.

    Places are the means of parts. There are as many parts as show motion: with few parts noise
    hardly adds to the way, and with many ones curves are not cut short.
    """
    noise_m = math.hypot(noise_of(path.real), noise_of(path.imag))
    steps, least_m, rows = np.zeros(0), 0.0, 1
    for parts in _PARTS:
        rows = max(1, len(path) // parts)
        means: Any = np.reshape(path[: len(path) // rows * rows], (-1, rows)).mean(axis=1)
        steps, least_m = np.abs(np.diff(means)), _NOISE * noise_m / math.sqrt(rows)
        if float(np.quantile(steps, 0.9)) > 2 * least_m:
            break
    return np.where(steps > least_m, steps, 0.0).cumsum(), rows


def _laid_over(a: Any, b: Any, first: int) -> Array:
    """How far two paths are apart where the second is turned so that its beginning fits best."""
    turn = cast("complex", np.vdot(b[:first], a[:first]))
    return np.asarray(np.abs(a - b * (turn / abs(turn) if turn else 1.0)))


def _are_own(*positions: tuple[RegisteredSignal, RegisteredSignal]) -> bool:
    """Whether the names of all say that they are positions of the robot itself."""
    return all(
        any(not set(BRANCHES).isdisjoint(words_of(part)) for part in x.name.split("."))
        for x, _ in positions
    )


def _leaps_in(run: RunUnderCheck) -> list[Event]:
    return [each for each in run.events(JUMP.name) if each.name == "position"]


def _resets_in(run: RunUnderCheck) -> Array:
    """When a counter of episodes went on, or a flag said that one is done: it is put back then."""
    times: list[Array] = [np.zeros(0)]
    for name in run.search.known:
        if name in run.frame and not _EPISODES.isdisjoint(words_in(name)):
            changes = np.flatnonzero(np.diff(run.frame.coded(name).codes)) + 1
            times.append(run.frame.times[changes])
    return np.concatenate(times)


def stays_in_place(run: RunUnderCheck) -> Examined:
    """Warns where the position jumped: something put it elsewhere, or the estimate is wrong."""
    if run.motion.position is None:
        raise NotSearchableError("no position is recorded: publish gps or pose: [x, y], in metres")
    resets, all_leaps = _resets_in(run), _leaps_in(run)
    near_s = 2 * run.noise.interval_s * (1 + 1e-6)
    leaps = [e for e in all_leaps if np.abs(resets - e.start_s).min(initial=math.inf) > near_s]
    if not leaps:
        limit = f"limit {run.search.options.jump_m:g} m"
        names = [each.name for each in run.motion.position]
        but = f" but at {counted(len(all_leaps), 'reset')}" if all_leaps else ""
        return run.covered(f"its position never jumped{but}", signals=names, limit=limit)
    far_m = max(float(each.details.get("distance_m", 0.0)) for each in leaps)
    evidence = f"its position jumped {times(len(leaps))}, up to {far_m:.3g} m"
    return Fault("warn", evidence, leaps[0].start_s, len(leaps), run.more(JUMP.name))
