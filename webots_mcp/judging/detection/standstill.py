"""`standstill` and `stuck`: the robot stayed where it was, and should have moved besides."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple, cast

from webots_mcp.analysis.arrays import Array, Flags, Indexes, median, noise_of, np, runs_of
from webots_mcp.analysis.path_length import SmoothedTrack, track_of
from webots_mcp.analysis.standstills import (
    MOST_AROUND,
    NEARLY,
    find_standstills,
    shortest_seen_s,
)
from webots_mcp.judging.detection.event import Alike, Event, NotSearchableError
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.search import (
    LEAST_VISITS,
    NO_TIME,
    EventKind,
    ModeUse,
    ModeUses,
    Motion,
    RunNoise,
    Search,
    course_in,
    in_metres,
    is_counted_by_wheels,
    tracks_in,
)
from webots_mcp.judging.verdicts import AS_STUCK
from webots_mcp.signals.meaning import meaning_by_name
from webots_mcp.signals.naming import NAME_POSITION
from webots_mcp.store.chunks import shown
from webots_mcp.store.reading.frame import Frame

# -- whether it should have moved: what shows it, and what speaks against it -----------------------
#
# No verdict depends on the name of a mode. What was commanded, what its wheels did, and that it
# moves in the same mode is evidence; a measured speed of 0 is none against it. The rows of all
# standstills are judged at once.


# What one of a unit of speed is in m/s or rad/s.
SPEED_UNITS: Final = {
    "cm/s": 0.01, "mm/s": 0.001, "km/h": 1 / 3.6, "deg/s": math.pi / 180, "rpm": math.pi / 30,
}  # fmt: skip
_TURNS: Final = ("rad/s", "deg/s", "rpm")
WHEELS_TURN: Final = 0.1  # rad/s, or in whatever unit they are published
ON_THE_SPOT: Final = 0.2  # of the fastest wheel: where the mean of all is less, none drives ahead
COMMAND_NOISE: Final = 4.0  # deviations of a speed's own noise: what is less is no command
ONE_COURSE: Final = 3.0  # deviations that the median of a command is from 0 ...
ONE_SIGN: Final = 0.95  # ... with the same sign in such a share of its rows
USUALLY_STANDS: Final = 10.0  # deviations, in a mode in which it usually stands
CELL_S: Final = 2.0  # in which a robot turns or sways, or not
TURNED_RAD: Final = 0.1  # from the mean of one cell to that of the next
HEADING_NOISE: Final = 6.0  # standard deviations of such a mean
SWAY_M: Final = 0.0035  # of 1 cm to and fro; less is how a robot trembles at a wall
SWAY_NOISE: Final = 3.5  # deviations in each coordinate: noise alone comes to 1.4 of them
MOSTLY: Final = 0.5
TOLD_SHARE: Final = 0.1  # of the rows: what holds in fewer, at the ends, shows nothing
BRIDGED_S: Final = 0.5  # evidence that is missing for less goes on
JUDGED_AT_ONCE: Final = 500_000  # rows, between two looks at the deadline
BY_WHEELS: Final = (
    "{} may be counted by wheels that spin in place: publish the position of a GPS or a Supervisor"
)
_HEADING_ROWS: Final = 5  # at each end, whose median is its heading
NOISE_RANGE: Final = 6.0  # deviations of noise from the least of some hundred rows to the greatest
SHORTEST_SHARE: Final = 4.0  # of the shortest standstill: shorter ones came nowhere near
MARGIN_ROWS: Final = 50_000  # before and after a range; all where a standstill takes more


class Judged(NamedTuple):
    """An event, before it is known of which run.

    Attributes:
        kind: `standstill` for all of one, `stuck` for a part in which it should have moved, and
            `apart` for what such parts leave of the standstill.
    """

    kind: str
    start_s: float
    end_s: float
    details: dict[str, Any]


class StandstillRows(NamedTuple):
    """Where it stood, and the rows of the frame in which it did: those with a position.

    Attributes:
        left_m: What is left of the noise in each of x and y, which are smoothed.
    """

    rows: Indexes
    times: Array
    x: Array
    y: Array
    x_m: float
    y_m: float
    left_m: float

    @property
    def lasts_s(self) -> float:
        """From the first row to the last."""
        return float(self.times[-1] - self.times[0])


class Standings:
    """The rows of all standstills one after the other, and what each of them shows.

    Attributes:
        starts: Where each standstill begins among these rows, and the end of the last one.
        owner: Of each row, which standstill it is of.
        speeds: As commanded, or as named so that they may be.
        told: It was commanded to move; `stops`: to stand.
        wheel_drives: 1 where its wheels drive it ahead, -1 back; `resting`: none of them turns.
        turns: It turned in place; `sways`: it went to and fro.
        in_moving_mode: It was in a mode in which it moves.
    """

    def __init__(
        self,
        frame: Frame,
        motion: Motion,
        options: EventOptions,
        places: Sequence[StandstillRows],
        noise: RunNoise,
        uses: ModeUses,
    ) -> None:
        self.motion, self.options, self.places, self.noise = motion, options, places, noise
        self._uses = uses
        rows = np.concatenate([place.rows for place in places])
        self.times, self._x, self._y = (
            np.concatenate([getattr(place, name) for place in places])
            for name in ("times", "x", "y")
        )
        lengths = [len(place.rows) for place in places]
        self.starts: Indexes = np.concatenate(([0], np.cumsum(lengths)))
        self.owner = np.repeat(np.arange(len(places)), lengths)
        self.speed = motion.commanded or motion.speed
        self.speeds = np.full(len(rows), np.nan)
        least = 0.0
        if self.speed is not None and self.speed.name in frame:
            self.speeds = frame.bridged(self.speed.name)[rows]
            if motion.sideways is not None and motion.sideways.name in frame:
                aside = np.nan_to_num(frame.bridged(motion.sideways.name)[rows])
                self.speeds = np.where(aside == 0, self.speeds, np.hypot(self.speeds, aside))
            least_m_s = options.min_commanded_m_s / SPEED_UNITS.get(self.speed.unit or "m/s", 1.0)
            least = max(least_m_s, COMMAND_NOISE * noise.of(self.speed.name))
        self.told = np.abs(self.speeds) >= least
        self.turn_speeds = np.full(len(rows), np.nan)
        least_turn = 0.0
        if (turning := motion.turn_command) is not None and turning.name in frame:
            self.turn_speeds = frame.bridged(turning.name)[rows]
            slowest = TURNED_RAD / CELL_S / SPEED_UNITS.get(turning.unit or "rad/s", 1.0)
            least_turn = max(slowest, COMMAND_NOISE * noise.of(turning.name))
        self.told_to_turn: Flags = np.abs(self.turn_speeds) >= least_turn
        # A speed whose name leaves open whether it is commanded or measured says so where it is 0.
        self.stops = (np.abs(self.speeds) < least) & (motion.commanded is not None)
        self.stops &= ~self.told_to_turn
        # To turn in place is no answer to a command to drive ahead, and not to turn.
        self.only_ahead: Flags = self.told & (np.abs(self.turn_speeds) < least_turn)
        self.only_ahead &= motion.commanded is not None
        wheels = motion.wheel_commands or motion.wheels
        self.wheels = [each for each in wheels if each.name in frame]
        self.wheels_are_commands = bool(motion.wheel_commands) or all(
            _was_set(frame, each.name, noise) for each in self.wheels
        )
        factors = [SPEED_UNITS.get(each.unit or "", 1.0) for each in self.wheels]
        turned = np.nan_to_num(
            [
                frame.bridged(each.name)[rows] * factor
                for each, factor in zip(self.wheels, factors, strict=True)
            ]
        )
        turned = turned if self.wheels else np.zeros((1, len(rows)))
        self.fastest: Array = np.abs(turned).max(axis=0)
        mean = turned.mean(axis=0)
        noises = [
            noise.of(each.name) * factor for each, factor in zip(self.wheels, factors, strict=True)
        ]
        turn: Flags = self.fastest >= max([WHEELS_TURN, *(COMMAND_NOISE * each for each in noises)])
        ahead: Flags = turn & (np.abs(mean) >= ON_THE_SPOT * self.fastest)
        self.resting = ~turn & bool(self.wheels)
        # Where the heading is known, it shows whether wheels against each other turn it.
        self.wheel_drives = np.where(
            ahead, np.sign(mean), 1.0 * (turn & (motion.heading is not None))
        )
        self.course: Array | None = None
        if (heading := motion.heading) is not None and heading.name in frame:
            self.course = course_in(frame, heading)[rows]
        self.turns = self._turning()
        if heading is None:  # wheels that turn it on the spot move it nowhere
            self.turns |= turn & ~ahead
        self.sways = self._swaying()
        coded = None if motion.mode is None else frame.coded(motion.mode.name)
        self._frame_rows = rows
        self._all_modes = np.zeros(len(frame), np.intp) if coded is None else coded.codes
        self.modes = self._all_modes[rows]
        self.labels = [None] if coded is None else coded.labels
        self._by_mode = {code: self._moves_in(code) for code in self.codes(slice(None))}
        moves = [bool(self._by_mode.get(code, (None,))[0]) for code in range(len(self.labels))]
        self.in_moving_mode = np.array(moves)[self.modes]

    @cached_property
    def _cells(self) -> tuple[Indexes, Indexes, Flags]:
        """Where parts of about two seconds of each standstill begin, how many rows each has, and
        whether it is of the same standstill as the next one.

        The shortest has two: in a single one nothing can be seen to turn or to sway.
        """
        begins: list[Array] = [
            np.linspace(place.times[0], place.times[-1], parts, endpoint=False)
            for place in self.places
            for parts in [max(2, round(place.lasts_s / CELL_S))]
        ]
        found = np.searchsorted(self.times, np.concatenate(begins))
        cells: Indexes = np.unique(np.append(found, self.starts[:-1]))
        same: Flags = np.diff(self.owner[cells]) == 0
        return cells, np.diff(cells, append=len(self.times)), same

    def _turning(self) -> Flags:
        """Whether it looks elsewhere in each part than in those next to it.

        Means are compared: who wiggles about one heading does not turn; nor who is turned once.
        """
        if self.course is None or self.motion.heading is None:
            return np.zeros(len(self.times), np.bool_)
        cells, rows, same = self._cells
        heading = self.motion.heading
        noise = self.noise.of(heading.name) * math.tau / (heading.turn or math.tau)
        there = np.isfinite(self.course)
        known = np.maximum(1, np.add.reduceat(there * 1.0, cells))
        means = np.add.reduceat(np.where(there, self.course, 0.0), cells) / known
        limit = np.maximum(TURNED_RAD, HEADING_NOISE * noise / np.sqrt(known))
        turned = ~same | (np.abs(np.diff(means)) > limit[1:])
        alone = np.append(True, ~same) & np.append(~same, True)
        return np.repeat(np.append(True, turned) & np.append(turned, True) & ~alone, rows)

    def _swaying(self) -> Flags:
        """Whether it goes about in each part: within a place who does so moves, and is not stuck.

        What counts is how far its places are from their mean (root mean square): of many rows some
        few are always far away. A single twitch is none.
        """
        cells, rows, same = self._cells
        away_m2 = np.zeros(len(cells))
        for values in (self._x, self._y):
            off = values - np.repeat(np.add.reduceat(values, cells) / rows, rows)
            away_m2 += np.add.reduceat(off**2, cells) / rows
        left_m = np.array([place.left_m for place in self.places])[self.owner[cells]]
        moved = away_m2 > np.maximum(SWAY_M, SWAY_NOISE * left_m) ** 2
        both = same & moved[1:] & moved[:-1]
        return np.repeat(np.append(False, both) | np.append(both, False), rows)

    def spans(self, flags: Flags, bridged_s: float) -> list[tuple[int, int]]:
        """Rows [start, stop) of one standstill in which flags hold for the shortest time that
        counts, but for moments.
        """
        rows = np.flatnonzero(flags)
        apart = (np.diff(rows) > 1) & (np.diff(self.times[rows]) > bridged_s)
        edges = np.flatnonzero(apart | (np.diff(self.owner[rows]) != 0)) + 1
        firsts, ends = np.append(0, edges), np.append(edges, len(rows))
        if not len(rows):
            return []
        starts, stops = rows[firsts], rows[ends - 1] + 1
        long = self.times[stops - 1] - self.times[starts] >= NEARLY * self.options.stuck_s
        return list(zip(starts[long].tolist(), stops[long].tolist(), strict=True))

    def codes(self, rows: slice) -> list[int]:
        """The modes in some of the rows."""
        return np.flatnonzero(np.bincount(self.modes[rows])).tolist()

    def facts(self, place: StandstillRows, rows: slice) -> dict[str, Any]:
        """What is told of rows of a standstill, whether it was stuck or not."""
        facts: dict[str, Any] = {"x_m": place.x_m, "y_m": place.y_m}
        if self.motion.mode is not None:
            facts["mode"] = self.labels[int(np.argmax(np.bincount(self.modes[rows])))]
        if self.course is not None:
            course = self.course[rows]
            course = course[~np.isnan(course)]
            few = max(1, min(_HEADING_ROWS, len(course) // 2))
            if len(course):
                facts["turned_rad"] = round(median(course[-few:]) - median(course[:few]), 3)
        return facts

    def judged(self, undecided: list[float]) -> list[Judged]:
        """Each standstill, what of it the robot was stuck for, and what that leaves of it.

        Args:
            undecided: Takes the begins of standstills of which nothing recorded says whether the
                robot should have moved.
        """
        events = list[Judged]()
        hindered = np.zeros(len(self.times), np.bool_)  # it moved in its place for long enough
        for start, stop in self.spans((self.turns | self.sways) & ~self.only_ahead, 0.0):
            hindered[start:stop] = True
        drives = self.told | (self.wheel_drives != 0) | self.in_moving_mode
        if self.motion.heading is not None:  # else it is not known whether it turned
            drives |= self.told_to_turn
        spans: dict[int, list[tuple[int, int]]] = {}
        for span in self.spans(drives & ~self.stops & ~hindered, BRIDGED_S):
            spans.setdefault(int(self.owner[span[0]]), []).append(span)
        for at, place in enumerate(self.places):
            whole = slice(int(self.starts[at]), int(self.starts[at + 1]))
            against, stuck = self._against(at, whole), list[tuple[int, int]]()
            for start, stop in spans.get(at, []):
                if stop - start >= NEARLY * (whole.stop - whole.start):
                    start, stop = whole.start, whole.stop
                reasons, doubt = self._shown(slice(start, stop))
                if doubt is not None:
                    against.append(doubt)
                    continue
                stuck.append((start, stop))
                speeds = self.speeds[start:stop][np.isfinite(self.speeds[start:stop])]
                details = self.facts(place, slice(start, stop))
                details |= {"commanded": round(median(speeds), 9)} if len(speeds) else {}
                details["evidence_for"] = "; ".join(reasons)
                details |= {"evidence_against": "; ".join(against)} if against else {}
                events.append(self._event("stuck", start, stop, details))
            details = self.facts(place, whole)
            if not stuck:
                modeless = "" if self.motion.mode else "; if one holds the mode, give mode=NAME"
                nothing = f"no published signal shows that it should have moved{modeless}"
                details["why_not_stuck"] = "; ".join(against) or nothing
            if not stuck and not self._is_decided(whole):
                undecided.append(float(place.times[0]))
            events.append(self._event("standstill", whole.start, whole.stop, details))
            edges = [whole.start, *(edge for span in stuck for edge in span), whole.stop]
            for start, stop in zip(edges[::2], edges[1::2], strict=True):
                # It ends in the row in which it begins to be stuck, and begins in their last one.
                first, last = start - (start > whole.start), min(stop, whole.stop - 1)
                part = self._event("apart", first, last + 1, details)
                if part.end_s - part.start_s >= NEARLY * self.options.stuck_s or not stuck:
                    own = self.facts(place, slice(first, last + 1)) if stuck else details
                    events.append(part._replace(details=own))
        return events

    def _event(self, kind: str, start: int, stop: int, details: dict[str, Any]) -> Judged:
        return Judged(kind, float(self.times[start]), float(self.times[stop - 1]), details)

    def _moves_in(self, code: int) -> tuple[str | None, str | None]:
        """Why a robot in that mode should move, and what speaks against it."""
        mode = shown(self.labels[code])
        if mode is None:
            return None, None
        if (moving := self.options.moving_modes) is not None:
            return (f"mode {mode} is one of moving_modes" if mode in moving else None), None
        use = self._uses.of(mode)
        if use.moving and not use.usually_stands:
            where = "" if use.run_id == self._uses.run_id else f" in run {use.run_id}"
            return f"in mode {mode}, in which it moved at {use.speed_m_s:.2g} m/s{where}", None
        if use.moving:
            return None, f"it usually stands in mode {mode}"
        if self._uses.is_cut:
            return None, f"not checked whether it moves in mode {mode}: time limit reached"
        return None, f"not seen moving in mode {mode}"

    def _shown(self, rows: slice) -> tuple[list[str], str | None]:
        """What shows that it should have moved in these rows; or why that is in doubt."""
        codes = self.codes(rows)
        modes = np.bincount(self.modes[rows]) > MOSTLY * (rows.stop - rows.start)
        said = [why for code in codes if modes[code] for why in self._by_mode[code][:1] if why]
        if said and not self._moves_on(rows):
            said = []
        told, wheels = self.told[rows], self.wheel_drives[rows] != 0
        speeds, is_measured = np.zeros(0), self.motion.commanded is None
        was_told, turned = (int(np.count_nonzero(each)) for each in (told, wheels))
        if self.speed is not None and was_told > TOLD_SHARE * len(told):
            speeds = self.speeds[rows][told]
            said.append(f"{self.speed.name} {median(speeds):.3g}")
        if turned > TOLD_SHARE * len(wheels):
            unit = " rad/s" if all(wheel.unit in _TURNS for wheel in self.wheels) else ""
            turning = (self.wheel_drives[rows] * self.fastest[rows])[wheels]
            said.append(f"wheels at {median(abs(turning)):.3g}{unit}")
            if turned > was_told:
                speeds, is_measured = turning, not self.motion.wheel_commands
        turning = self.told_to_turn[rows]
        told_to_turn = int(np.count_nonzero(turning))
        if (command := self.motion.turn_command) and told_to_turn > TOLD_SHARE * len(turning):
            rates = self.turn_speeds[rows][turning]
            said.append(f"{command.name} {median(rates):.3g}")
            if told_to_turn > was_told:
                speeds, is_measured = rates, False
        if not said:
            return said, self._why_mode_is_not_enough(rows)
        if not len(speeds):
            return said, None
        if self.in_moving_mode[rows].mean() >= MOSTLY and said[0].startswith(("in mode", "mode ")):
            return said, None
        # Speeds that are hardly beyond their noise, or go to and fro, are no command.
        middle = median(speeds)
        spread = median(np.abs(speeds - middle)) / 0.6745
        same = np.count_nonzero(np.sign(speeds) == np.sign(middle))
        stands = is_measured and any(self._use(code).usually_stands for code in codes)
        needed = USUALLY_STANDS if stands else ONE_COURSE
        if abs(middle) >= needed * spread and same >= ONE_SIGN * len(speeds):
            return said, None
        return said, f"commanded or measured speeds of {middle:.2g} are hardly beyond their noise"

    def _moves_on(self, rows: slice) -> bool:
        """Whether the robot moved on in the same mode after these rows, or always does so.

        A robot that stands until a mode ends may have arrived: one such visit shows nothing.
        """
        if self.options.moving_modes is not None:
            return True
        code = int(np.argmax(np.bincount(self.modes[rows])))
        use = self._use(code)
        if use.moving >= LEAST_VISITS and use.standing <= 1:  # this visit is one of them
            return True
        last = int(self._frame_rows[rows.stop - 1])
        later = self._all_modes[last + 1 : last + 2]
        return len(later) > 0 and int(later[0]) == code

    def _why_mode_is_not_enough(self, rows: slice) -> str | None:
        mode = shown(self.labels[int(np.argmax(np.bincount(self.modes[rows])))])
        if mode is None:
            return None
        return f"it stood until mode {mode} ended, as a robot does that has arrived"

    def _use(self, code: int) -> ModeUse:
        mode = shown(self.labels[code])
        return ModeUse() if mode is None else self._uses.of(mode)

    def _is_decided(self, rows: slice) -> bool:
        """Whether something recorded shows that it was meant to stand, or that it did move."""

        def mostly(flags: Flags) -> bool:
            return np.count_nonzero(flags[rows]) > MOSTLY * (rows.stop - rows.start)

        if mostly(self.turns | self.sways) or mostly(self.stops):
            return True
        if mostly(self.resting) and self.wheels_are_commands:
            return True
        return any(self._use(code).usually_stands for code in self.codes(rows))

    def _against(self, at: int, rows: slice) -> list[str]:
        """What speaks against that it should have moved in a standstill."""
        said = list[str]()

        def mostly(flags: Flags) -> bool:
            return np.count_nonzero(flags[rows]) > MOSTLY * (rows.stop - rows.start)

        if self.motion.commanded and mostly(self.stops):
            stopped = median(self.speeds[rows][self.stops[rows]])
            said.append(f"{self.motion.commanded.name} {stopped:.3g}")
        if mostly(self.resting):
            said.append("wheels at rest")
        said += [why for code in self.codes(rows) for why in self._by_mode[code][1:] if why]
        if mostly(self.turns):
            opposite = "its wheels turned in opposite directions, as for a turn in place"
            # What only the wheels tell, a quadcopter's do as well.
            seen = self.motion.heading is not None
            said.append("it turned in place" if seen else f"{opposite}; no heading recorded")
        if mostly(self.sways):
            place = self.places[at]
            reach_m = math.hypot(np.ptp(place.x), np.ptp(place.y))
            said.append(f"it moved back and forth within {reach_m:.2g} m")
        return said


def _was_set(frame: Frame, name: str, noise: RunNoise) -> bool:
    """Whether a speed whose name leaves it open was set: what is measured never repeats exactly.

    A name that says that it is measured decides. A wheel that never turned shows nothing.
    """
    if "measured" in (meaning_by_name(name, "num").role or "") or noise.of(name):
        return False
    values = frame.numbers(name)
    turns = np.abs(values[1:]) > 0
    repeated = int(np.count_nonzero(np.diff(values)[turns] == 0))
    return repeated > 0 and repeated >= MOSTLY * int(np.count_nonzero(turns))


@dataclass(frozen=True)
class Findings:
    """What was found in the rows of a run.

    Attributes:
        nearest: What came nearest to a standstill where there is none: its share of the shortest,
            and in words.
        unseen: What could not be looked at.
        undecided: Why one of them may be `stuck` that is told as a standstill.
        covered_s: Begin and end of each segment with a position.
    """

    events: list[Judged] = field(default_factory=list[Judged])
    nearest: tuple[float, str] | None = None
    unseen: list[str] = field(default_factory=list[str])
    undecided: list[str] = field(default_factory=list[str])
    covered_s: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])


def standstills_in(search: Search) -> Findings:
    """Those that touch the segment of a search, from as many rows as bear on them; found once.

    Raises:
        NotSearchableError: No position is known, or there is none, or no time.
    """
    if Findings in search.shared:
        return cast("Findings", search.shared[Findings])
    if search.deadline.passed:
        raise NotSearchableError(NO_TIME)
    motion, run, asked = search.motion, search.frame, search.asked or search.segment
    if search.whole.cut_at_s is None and not asked.full_rate:
        run = search.whole
    noise = search.noise if run is search.whole else RunNoise(run, motion)
    uses = ModeUses(search.connection, run, motion, search.options, search.deadline, noise)
    first, stop = run.places([asked.start_s, asked.end_s]).tolist()
    found = Findings()
    for margin in (MARGIN_ROWS, len(run)):
        rows = run.rows(before := max(0, first - margin), stop + margin)
        asked_rows = first - before, stop - before
        found = judge_standstills(rows, search, uses, noise, asked_rows)
        if len(rows) == len(run) or search.deadline.passed or not _may_reach_out(found, rows, run):
            break
    search.shared[Findings] = found
    return found


def _may_reach_out(found: Findings, rows: Frame, run: Frame) -> bool:
    """Whether rows beyond bear on a standstill: a creep shows in so many times its length."""
    lasts_s = max((each.end_s - each.start_s for each in found.events), default=0.0)
    first_s = min((each.start_s for each in found.events), default=math.inf)
    last_s = max((each.end_s for each in found.events), default=-math.inf)
    reach_s, (begin_s, end_s) = MOST_AROUND * lasts_s, rows.bounds_s
    began_s, ended_s = run.bounds_s
    return (began_s < begin_s > first_s - reach_s) or (ended_s > end_s < last_s + reach_s)


def judge_standstills(
    frame: Frame, search: Search, uses: ModeUses, noise: RunNoise, asked: tuple[int, int]
) -> Findings:
    """Find where a robot stood still and where it was stuck.

    Args:
        frame: The rows.
        search: Which signals tell, what counts, and until when there is time.
        uses: In which modes it moves.
        noise: Of the run.
        asked: Rows that the standstills have to touch.

    Raises:
        NotSearchableError: No position is known, or the frame has none.
    """
    motion, options = search.motion, search.options
    if motion.position is None:
        raise NotSearchableError(NAME_POSITION)
    tracks, rows = tracks_in(frame, motion.position, noise)
    if not tracks:
        names = " and ".join(signal.name for signal in motion.position)
        raise NotSearchableError(f"{names} have no value in that range of run {frame.run_id}")
    covered_s = [(float(each.times[0]), float(each.times[-1])) for each in tracks]
    seen_s = shortest_seen_s(noise.position_m, noise.interval_s, options.stuck_m, options.stuck_s)
    unseen = [
        f"none under {seen_s:.2g} s: position noise of {noise.position_m:.2g} m hides slow motion"
    ] * (seen_s > options.stuck_s / NEARLY)
    blind: Flags = np.array(frame.was_read())
    blind[np.concatenate(rows)] = False
    blind[: asked[0]] = blind[asked[1] :] = False
    gone = runs_of(blind, frame.times)
    if len(gone := gone.only(gone.durations_s >= options.stuck_s)):
        total_s, since_s = gone.durations_s.sum(), gone.starts_s[0]
        unseen.append(f"the position had no value for {total_s:.3g} s, from {since_s:.6g} s on")
    found = (
        place
        for track, here in zip(tracks, rows, strict=True)
        for place in _places(track, here, frame, search)
    )
    places = [each for each in found if each.rows[0] < asked[1] and each.rows[-1] >= asked[0]]
    if search.deadline.passed:
        unseen.append(f"{NO_TIME}; it may have rested where it moved slowly")
    long = [place for place in places if place.lasts_s >= NEARLY * seen_s]
    if not long:
        parts = [np.searchsorted(here, asked).tolist() for here in rows]
        there = [track.part(*part) for track, part in zip(tracks, parts, strict=True)]
        nearest = None if places else _nearest(there, search)
        return Findings([], nearest, unseen, covered_s=covered_s)
    events, open_s = list[Judged](), list[float]()
    for batch in _batches(long):
        if search.deadline.passed:
            since_s = batch[0].times[0]
            unseen.append(f"{NO_TIME}; standstills from {since_s:.3f} s on were not judged")
            break
        events += Standings(frame, motion, options, batch, noise, uses).judged(open_s)
    cut = ["time limit reached before it was known in which modes it moves"] if uses.is_cut else []
    if open_s and not cut:
        stood = sum(each.kind == "standstill" for each in events)
        run = f" of run {frame.run_id}" if search.coverage.of_several_runs else ""
        cut = [_nothing_says(motion, open_s, stood, run)]
    return Findings(events, None, unseen, cut, covered_s)


def _nothing_says(motion: Motion, open_s: Sequence[float], count: int, run: str) -> str:
    """Why it is not known of some standstills whether the robot should have moved."""
    which = f"{len(open_s)} of {count} standstills" if count > 1 else "the standstill"
    lacking = "no commanded speed, wheel command or mode is known"
    if motion.commanded or motion.wheels or motion.wheel_commands or motion.mode:
        lacking = "nothing recorded says whether it should have moved then"
    elif motion.turn_command and motion.heading is None:
        lacking = "it was commanded to turn, but no heading is known"
    return f"{which} from {min(open_s):.3f} s on{run} cannot be judged: {lacking}"


def _batches(places: Sequence[StandstillRows]) -> Iterator[Sequence[StandstillRows]]:
    """The standstills in order, each time so many that they have about `JUDGED_AT_ONCE` rows."""
    start, rows = 0, 0
    for at, place in enumerate(places):
        rows += len(place.rows)
        if rows >= JUDGED_AT_ONCE or at == len(places) - 1:
            yield places[start : at + 1]
            start, rows = at + 1, 0


def _places(
    track: SmoothedTrack, rows: Indexes, frame: Frame, search: Search
) -> Iterator[StandstillRows]:
    """The standstills of a track, in parts where it climbs or sinks in between."""
    motion, options = search.motion, search.options
    limits = options.stuck_m, options.stuck_s
    for each in find_standstills(track, *limits, lambda: search.deadline.passed):
        ends = [(each.start, each.last + 1)]
        if motion.height is not None:
            high = frame.bridged(motion.height.name)[rows[slice(*ends[0])]]
            ends = list(_at_one_height(track, in_metres(motion.height, high), each.start, options))
        for start, stop in ends:
            part = slice(start, stop)
            course = track.times[part], track.x[part], track.y[part]
            yield StandstillRows(rows[part], *course, each.x_m, each.y_m, track.left_m)


def _at_one_height(
    track: SmoothedTrack, heights: Array, first: int, options: EventOptions
) -> Iterator[tuple[int, int]]:
    """The rows of a standstill, from `first` on, in which it neither climbs nor sinks.

    Noise does neither: with it, heights reach farther than the robot does.
    """
    there = np.flatnonzero(np.isfinite(heights))
    noise_m = noise_of(heights[there])
    if not noise_m and (not len(there) or float(np.ptp(heights[there])) <= options.stuck_m):
        yield first, first + len(heights)
        return
    up = track_of(track.times[first + there], heights[there], np.zeros(len(there)), noise_m)
    far_m = np.ptp(up.x) if len(there) > 1 else 0.0
    if far_m <= options.stuck_m + NOISE_RANGE * up.left_m:
        yield first, first + len(heights)
        return
    for each in find_standstills(up, options.stuck_m, options.stuck_s):
        yield first + int(there[each.start]), first + int(there[each.last]) + 1


def _nearest(tracks: Sequence[SmoothedTrack], search: Search) -> tuple[float, str] | None:
    """The longest time for which it stood, else its smallest movement in the shortest one."""
    least_s, deadline = search.options.stuck_s, search.deadline
    limits = search.options.stuck_m, least_s / SHORTEST_SHARE
    short = [
        (float(track.times[each.last] - track.times[each.start]), float(track.times[each.start]))
        for track in tracks
        for each in find_standstills(track, *limits, lambda: deadline.passed)
    ]
    if short:
        lasts_s, start_s = max(short)
        climbed = ", but its height changed" if lasts_s >= least_s else ""
        stood = (
            f"longest standstill was {lasts_s:.2g} s, from {start_s:.1f} s on{climbed}; "
            f"{least_s:g} s within {search.options.stuck_m:g} m count"
        )
        return lasts_s / least_s, stood
    ways: list[tuple[float, float]] = []
    for track in tracks:
        later = np.searchsorted(track.times, track.times + least_s)
        starts = np.flatnonzero(later < len(track.times))
        way_m = np.hypot(*(each[later[starts]] - each[starts] for each in (track.x, track.y)))
        ways += zip(way_m.tolist(), track.times[starts].tolist(), strict=True)
    if not ways:
        return None
    way_m, start_s = min(ways)
    return 0.0, (
        f"smallest movement in {least_s:g} s was {way_m:.2g} m, from {start_s:.1f} s on; "
        f"less than {search.options.stuck_m:g} m counts"
    )


def _standstills(search: Search) -> Iterator[Event]:
    """It stayed where it was; beside `stuck`, where that is asked for as well."""
    with_stuck = any(kind.name == "stuck" for kind in search.kinds)
    if with_stuck and any(each.kind == "stuck" for each in standstills_in(search).events):
        search.note_nearest("standstill", math.inf, AS_STUCK)
    return _events(search, "standstill", "apart" if with_stuck else "standstill")


def _stuck(search: Search) -> Iterator[Event]:
    """It should have moved and stayed where it was."""
    found = standstills_in(search)
    events = list(_events(search, "stuck", "stuck"))
    undecided = found.undecided
    if not events and not undecided and (odometry := _counted_by_wheels(search.motion)):
        undecided = [BY_WHEELS.format(odometry)]
    search.not_searched("stuck", *undecided, cause="undecided")
    if undecided and not events:
        raise NotSearchableError("; ".join(undecided), "undecided")
    return iter(events)


def _counted_by_wheels(motion: Motion) -> str | None:
    """The position's name where the wheels themselves count it, which may spin in place."""
    if motion.position is None:
        return None
    x, _ = motion.position
    return (x.name.rpartition(".")[0] or x.name) if is_counted_by_wheels(x) else None


def _events(search: Search, kind: str, judged_as: str) -> Iterator[Event]:
    found = standstills_in(search)
    search.judged(kind, search.motion.evidence, found.covered_s)
    search.not_searched(kind, *found.unseen)
    if found.nearest is not None:
        search.note_nearest(kind, *found.nearest)
    for each in found.events:
        if each.kind == judged_as:
            yield search.event(kind, each.start_s, each.end_s, None, **each.details)


STANDSTILL: Final = EventKind(
    "standstill",
    "stands still",
    _standstills,
    lasts=True,
    least_s=lambda options: options.stuck_s,
    drawn=8,
    alike=Alike(lambda events, unit: "standstills", sort=lambda event: event.details.get("mode")),
    severity=20,
)
STUCK: Final = EventKind(
    "stuck",
    "stands although it should move",
    _stuck,
    lasts=True,
    least_s=lambda options: options.stuck_s,
    drawn=0,
    alike=Alike(lambda events, unit: "times stuck", sort=lambda event: event.details.get("mode")),
    severity=70,
)
