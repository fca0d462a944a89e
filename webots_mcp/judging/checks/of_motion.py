"""Checks of how a robot moved: as it was commanded, as its wheels turned, as others measured it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final, cast

from webots_mcp.analysis.arrays import Array, Indexes, median, np, runs_of
from webots_mcp.analysis.summary import unwrap
from webots_mcp.judging.checks.finding import Examined, RunUnderCheck, times, total_s
from webots_mcp.judging.coverage import Coverage, Fault
from webots_mcp.judging.detection.fall import FALL, FALLEN_RAD
from webots_mcp.judging.detection.jump import JUMP
from webots_mcp.judging.detection.kinds import Event, NotSearchableError
from webots_mcp.judging.detection.search import ROLLS_OUT_S, in_metres, places_in
from webots_mcp.judging.detection.standstill import COMMAND_NOISE, ON_THE_SPOT, TURNED_RAD
from webots_mcp.judging.detection.targets import OFF_S, OFF_SHARE, OFF_TARGET, pursuits_in
from webots_mcp.signals.meaning import words_in
from webots_mcp.signals.naming import BRANCHES, METRES, counted, listed, unit_in, words_of
from webots_mcp.signals.register import PLACES
from webots_mcp.store.reading.frame import Frame
from webots_mcp.store.reading.segment import just_after
from webots_mcp.store.signals import RegisteredSignal, stored_roles

_OFF_THE_FLOOR_M: Final = 0.3
APART_S: Final = 3.0  # command and measurement for so long
NO_COMMAND: Final = (
    "nothing says when it should move: publish commanded_m_s, the speeds of its wheels, or mode"
)
_OF_RANGE: Final = 0.1  # of a target's whole range: what is apart by more is not there
_NEARER: Final = 0.002  # of that range, within `APART_S`: what comes so much nearer is on its way
_NOISE: Final = 6.0  # standard deviations; for half as many it may come nearer by chance
_HOLDING: Final = frozenset(("gripper", "finger", "hand", "claw", "jaw"))  # they close on things
_ALIKE: Final = 0.05  # of the faster side: wheels that differ by less drive straight on
_TURNED_ALONE_RAD: Final = 0.3  # in 3 s, while both sides turn alike
_SLIPS: Final = 0.5  # of the usual way per turn of the wheels
_CELLS_S: Final = (0.25, 0.5, 1.0, 2.0)  # over which speeds are compared; the noise chooses
_NOISE_SHARE: Final = 0.1  # of the speed that it may take
_CREEPS: Final = 0.2  # of how fast its wheels turn at their best: at less little can be said
_TURNS_RAD: Final = 1.0  # within a cell: then the straight line is shorter than the way
_LEAST_CELLS: Final = 10
_SPREAD: Final = 0.3  # of the ratios of a robot that rolls: of more they say nothing
_BY_WHEELS: Final = ("odom", "odometry")
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
    "mag", "magnetometer", "odom", "odometry", "pose", "position", "true",
))  # fmt: skip
_HEADINGS: Final = frozenset(("attitude", "deg", "degree", "euler", "heading", "rad", "rpy", "yaw"))


def moves_when_commanded(run: RunUnderCheck) -> Examined:
    """Fails where it stood although a command, its wheels or its mode say that it should move.

    Warns where only a mode that is the same in the whole run says so, or motors that lift it.
    """
    stood = run.events("standstill")
    stuck = [each for each in run.events("stuck") if each.duration_s >= APART_S]
    if stuck:
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
        rested = "it rested whenever every command was 0"
        judged = counted(len(commands), "command")
        return run.covered(rested, judged=judged, limit=f"limit {TURNED_RAD:g} rad or 5 cm")
    names = listed([each.name for each in commands], 3)
    evidence = f"{moved[0][1]} although {names} {'was' if len(commands) == 1 else 'were'} 0"
    shown = run.shows(*(each.name for each in commands[:2]))
    return Fault("warn", evidence, moved[0][0], len(moved), shown)


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
    if _flies(run):
        said = [each for each in said if not each.startswith("wheels at ")]
    by_mode = [each for each in said if each.startswith(("in mode ", "mode "))]
    mode = run.motion.mode
    may_change = mode is not None and len(set(run.frame.coded(mode.name).labels)) > 2
    return len(said) > len(by_mode) or (bool(said) and may_change)


def _flies(run: RunUnderCheck) -> bool:
    """Whether its motors are those of propellers: none is called a wheel, and it is off the floor.

    The motors of what flies turn all the time.
    """
    motors, height = run.motion.wheels or run.motion.wheel_commands, run.motion.height
    if height is None or any("wheel" in each.name.lower() for each in motors):
        return False
    heights = in_metres(height, run.frame.usable(height.name)[1])
    return len(heights) > 0 and median(heights) > _OFF_THE_FLOOR_M


# -- command and measurement -----------------------------------------------------------------------


def follows_targets(run: RunUnderCheck) -> Examined:
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
        limit = f"limit {100 * OFF_SHARE:g} % off for {OFF_S:g} s"
        return run.covered(said, of=OFF_TARGET.name, limit=limit)
    names = listed(list(dict.fromkeys(each.name or "" for each in found)), 3)
    longest = max(found, key=lambda each: each.duration_s)
    details = longest.details
    evidence = (
        f"{names}: {details['off_percent']:g} % off {details['target']} for "
        f"{longest.duration_s:.3g} s without coming nearer"
    )
    return Fault("fail", evidence, found[0].start_s, len(found), run.more(OFF_TARGET.name))


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
    evidence = f"fell {times(len(falls))}: tilted by {first.details['tilt_deg']:.3g}° {after}"
    return Fault("fail", evidence, first.start_s, len(falls), run.more(FALL.name))


# -- wheels and motion -----------------------------------------------------------------------------


def wheels_grip(run: RunUnderCheck) -> Examined:
    """Fails where the wheels drove ahead for 3 s and it went less than half as far as usual."""
    motion, position = run.motion, run.motion.position
    wheels = [each for each in motion.wheels or motion.wheel_commands if each.name in run.frame]
    if position is None or not wheels:
        raise NotSearchableError("publish the position and the speeds of its wheels")
    if _flies(run):
        raise NotSearchableError("its motors lift it")
    if position[0].name.partition(".")[0] in _BY_WHEELS:
        raise NotSearchableError(f"{position[0].name} is counted by the wheels themselves")
    starts_s, lasts_s, ratios = _ratios(run, position, wheels)
    known = np.isfinite(ratios)
    if np.count_nonzero(known) < _LEAST_CELLS:
        raise NotSearchableError("its wheels drove it ahead too seldom")
    usual = median(ratios[ratios >= np.nanquantile(ratios, 0.5)])
    rolled = ratios[ratios >= _SLIPS * usual]
    usual = median(rolled)
    if usual <= 0 or median(np.abs(rolled - usual)) > _SPREAD * usual:
        raise NotSearchableError("its speed and that of its wheels have no fixed ratio")
    slips = runs_of(ratios < _SLIPS * usual, starts_s)
    found = list(slips.only(slips.durations_s + 2 * lasts_s >= APART_S).spans())
    if turned := _turns_though_straight(run, wheels):
        return turned
    unit = "" if unit_in(wheels[0].name) in METRES else " per unit of wheel speed"
    rolls = f"rolls {usual:.3g} m/s{unit}"
    if not found:
        against = position[0].name.partition(".")[0]
        return run.covered(
            rolls,
            judged=f"{counted(len(wheels), 'wheel')} against {against}",
            limit=f"slip limit {100 * _SLIPS:g} %",
            lasts_s=int(np.count_nonzero(known)) * lasts_s,
        )
    longest_s = max(each.duration_s for each in found) + 2 * lasts_s
    least = min(float(np.nanmin(ratios[each.start : each.stop])) for each in found)
    evidence = f"slipped {times(len(found))}, up to {longest_s:.3g} s; {rolls}, then {least:.3g}"
    return Fault("fail", evidence, found[0].start_s, len(found), run.shows(wheels[0].name))


def _turns_though_straight(run: RunUnderCheck, wheels: list[RegisteredSignal]) -> Fault | None:
    """A robot that turned for long while the wheels of both sides turned alike: one side slips.

    A robot that steers turns so by nature, and where none of its wheels has a side nothing is said.
    """
    heading = run.motion.heading
    sides = {
        side: [w for w in wheels if (run.meanings[w.name].side or "").endswith(side)]
        for side in ("left", "right")
    }
    steers = any("steering" in words_in(name) for name in run.search.known)
    if heading is None or steers or not all(sides.values()):
        return None
    frame, turn = run.frame, heading.turn or math.tau
    course = unwrap(frame.numbers(heading.name), turn) * math.tau / turn
    left, right = (
        np.mean([frame.numbers(each.name) for each in wheels], axis=0) for wheels in sides.values()
    )
    fastest = np.maximum(np.abs(left), np.abs(right))
    alike = (np.abs(left - right) <= _ALIKE * fastest) & (fastest > 0) & np.isfinite(course)
    noise = run.noise.of(heading.name) * math.tau / turn
    for rest in runs_of(alike, frame.times).spans():
        if rest.end_s - rest.start_s < APART_S:
            continue
        part = course[rest.start : rest.stop]
        clock = frame.times[rest.start : rest.stop]
        cells = np.searchsorted(clock, np.arange(clock[0], clock[-1], APART_S))
        turned = np.diff(part[cells])
        far = np.flatnonzero(np.abs(turned) > max(_TURNED_ALONE_RAD, _NOISE * noise))
        if not len(far):
            continue
        side = "left" if turned[far[0]] > 0 else "right"
        total = float(np.abs(turned[far]).sum())
        evidence = (
            f"the {side} side slipped: it turned by {total:.3g} rad while the wheels of both "
            "sides turned alike"
        )
        since_s = float(clock[cells[far[0]]])
        return Fault("fail", evidence, since_s, 1, run.shows(heading.name, wheels[0].name))
    return None


def _ratios(
    run: RunUnderCheck,
    position: tuple[RegisteredSignal, RegisteredSignal],
    wheels: list[RegisteredSignal],
) -> tuple[Array, float, Array]:
    """From cell to cell how far it went per turn of its wheels; NaN where these do not drive it.

    Returns:
        When each cell begins, how long cells are, and the ratios.

    Raises:
        NotSearchableError: The position is too noisy to tell how far it went.
    """
    rows, x, y = places_in(run.frame, position)
    clock = run.frame.times[rows]
    speeds = np.nan_to_num([run.frame.numbers(each.name)[rows] for each in wheels])
    mean, fastest = speeds.mean(axis=0), np.abs(speeds).max(axis=0)
    least = max(4 * run.noise.of(wheels[0].name), _CREEPS * float(np.quantile(fastest, 0.9)))
    ahead = (np.abs(mean) >= ON_THE_SPOT * fastest) & (fastest > least)
    course = np.zeros(len(rows))
    if (heading := run.motion.heading) is not None:
        turn = heading.turn or math.tau
        course = unwrap(run.frame.numbers(heading.name)[rows], turn) * math.tau / turn
    per_row_s = max(run.noise.interval_s, 1e-6)
    columns = (clock, x, y, mean, course, np.sign(mean) * ahead)
    for lasts_s in [each for each in _CELLS_S if each >= 3 * per_row_s] or _CELLS_S[-1:]:
        starts_s, ratios, went_m_s = _ratios_in(columns, lasts_s)
        noise_m_s = 1.5 * run.noise.position_m * (per_row_s / lasts_s) ** 0.5 / lasts_s
        if not len(went_m_s) or noise_m_s <= _NOISE_SHARE * median(went_m_s):
            return starts_s, lasts_s, ratios
    raise NotSearchableError(
        f"position noise of {run.noise.position_m:.2g} m at a row each {per_row_s:.3g} s hides how "
        "far it went"
    )


def _ratios_in(columns: Sequence[Array], lasts_s: float) -> tuple[Array, Array, Array]:
    """The same in cells of one length, and how fast it went in those that count.

    Args:
        columns: Times, x, y, the mean speed of the wheels, the course, and 1 or -1 where these
            drive it ahead or back; in rows with a position.
        lasts_s: How long cells are.
    """
    clock = columns[0]
    cells = (clock // lasts_s).astype(np.intp)
    starts = np.flatnonzero(np.diff(cells, prepend=-1))
    if len(starts) < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    counts = np.diff(starts, append=len(clock))
    t, x, y, turned, course, driven = (np.add.reduceat(each, starts) / counts for each in columns)
    whole = (np.abs(driven) == 1) & (counts >= 2)
    both = whole[1:] & whole[:-1] & (driven[1:] == driven[:-1]) & (np.diff(cells[starts]) == 1)
    both &= np.abs(np.diff(course)) <= _TURNS_RAD
    rates = np.abs(turned[1:] + turned[:-1]) / 2 * np.diff(t)
    went_m = np.hypot(np.diff(x), np.diff(y))
    ratios = np.full(len(both), math.nan)
    ratios[both] = went_m[both] / rates[both]
    return clock[starts[:-1]], ratios, went_m[both] / np.diff(t)[both]


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
    made = [_drift(run, positions[0], other) for other in positions[1:]]
    examined = [each for each in made if each is not None]
    headings = [name for name in known if name in run.frame and _is_own_heading(run, name)]
    examined += [_turned_apart(run, headings[0], other) for other in headings[1:]]
    if not examined:
        raise NotSearchableError(
            "no second heading, and no second position of the robot that goes along with the first"
            f" for {_LEAST_WAY_M:g} m: publish gps and odometry, say"
        )
    faults = [each for each in examined if isinstance(each, Fault)]
    return min(faults, key=lambda each: each.severity, default=examined[0])


def _drift(
    run: RunUnderCheck,
    one: tuple[RegisteredSignal, RegisteredSignal],
    other: tuple[RegisteredSignal, RegisteredSignal],
) -> Examined | None:
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
        limit = f"limit {100 * _WARNS[0]:g} % of the path"
        return run.covered(evidence, judged="2 positions", limit=limit)
    since_s = float(run.frame.times[there][int(np.argmax(off > warns_m))])
    severity = "fail" if worst_m > fails_m else "warn"
    return Fault(severity, evidence, since_s, 1, run.shows(one[0].name, other[0].name))


def _is_own_heading(run: RunUnderCheck, name: str) -> bool:
    """Whether a heading is measured, and its name says of nothing but by whom."""
    meaning, words = run.meanings[name], frozenset(words_in(name))
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
    off = min((_cells_apart(a - sense * b, cells) for sense in (1, -1)), key=lambda e: median(e))
    apart = runs_of(off > _HEADING_WARNS_RAD, clock[cells])
    long = apart.only(apart.durations_s + _HEADING_CELL_S >= APART_S)
    evidence = f"{one} and {other}: {off.max():.3g} rad apart at most"
    if not len(long):
        limit = f"limit {_HEADING_WARNS_RAD:g} rad for {APART_S:g} s"
        return run.covered(evidence, signals=[one, other], judged="2 headings", limit=limit)
    worst = max(float(np.median(off[each.start : each.stop])) for each in long.spans())
    evidence = f"{one} and {other}: {worst:.3g} rad apart, {times(len(long))} for 3 s or more"
    return Fault(
        "fail" if worst > _HEADING_FAILS_RAD else "warn",
        evidence,
        float(long.starts_s[0]),
        len(long),
        run.shows(one, other),
        signals=(one, other),
    )


def _cells_apart(difference: Array, cells: Indexes) -> Array:
    """The mean angle of a difference in each cell, from that of the first cell on."""
    turned = np.add.reduceat(np.exp(1j * difference), cells)
    return np.abs(np.angle(turned * np.conj(turned[0])))


def _laid_over(a: Any, b: Any, first: int) -> Array:
    """How far two paths are apart where the second is turned so that its beginning fits best."""
    turn = cast("complex", np.vdot(b[:first], a[:first]))
    return np.asarray(np.abs(a - b * (turn / abs(turn) if turn else 1.0)))


def _are_own(*positions: tuple[RegisteredSignal, RegisteredSignal]) -> bool:
    """Whether the names of all say that they are positions of the robot itself."""
    return all(
        not set(BRANCHES).isdisjoint(words_of(x.name.partition(".")[0])) for x, _ in positions
    )


def stays_in_place(run: RunUnderCheck) -> Examined:
    """Warns where the position jumped: something put it elsewhere, or the estimate is wrong."""
    if run.motion.position is None:
        raise NotSearchableError("no position is published")
    leaps = [each for each in run.events(JUMP.name) if each.name == "position"]
    if not leaps:
        limit = f"limit {run.search.options.jump_m:g} m"
        names = [each.name for each in run.motion.position]
        return run.covered("its position never jumped", signals=names, limit=limit)
    far_m = max(float(each.details.get("distance_m", 0.0)) for each in leaps)
    evidence = f"its position jumped {times(len(leaps))}, up to {far_m:.3g} m"
    return Fault("warn", evidence, leaps[0].start_s, len(leaps), run.more(JUMP.name))
