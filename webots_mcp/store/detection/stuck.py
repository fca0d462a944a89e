"""Whether a robot that stood still should have moved: what shows it, and what speaks against it.

No verdict depends on the name of a mode. What was commanded, what its wheels did, and that it moves
in the same mode is evidence; a measured speed of 0 is none against it. The rows of all standstills
are judged at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Flags, Indexes, median, np
from webots_mcp.store.analysis.noise import noise_of
from webots_mcp.store.analysis.standstill import NEARLY
from webots_mcp.store.detection.event import EventOptions
from webots_mcp.store.detection.mode_use import ModeUse, ModeUses
from webots_mcp.store.detection.motion import Motion
from webots_mcp.store.signals.flatten import shown
from webots_mcp.store.signals.registry import Signal

if TYPE_CHECKING:
    from webots_mcp.store.reading.frame import Frame

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
_HEADING_ROWS: Final = 5  # at each end, whose median is its heading


class Judged(NamedTuple):
    """An event, before it is known of which run: `standstill` or `stuck`.

    Attributes:
        covered: The robot was stuck for all of this standstill, which is told as well.
    """

    kind: str
    start_s: float
    end_s: float
    details: dict[str, Any]
    covered: bool = False


class Place(NamedTuple):
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
        told: It was commanded to move; `drives`: or its wheels drove it.
        wheel_drives: 1 where these drive it ahead, -1 back.
        stops: It was commanded to stand.
        turns: It turned in place; `sways`: it went to and fro.
    """

    def __init__(
        self, frame: Frame, motion: Motion, options: EventOptions, places: Sequence[Place]
    ) -> None:
        self.motion = motion
        self.options = options
        self.places = places
        self._frame = frame
        self._rows = np.concatenate([place.rows for place in places])
        self.times = np.concatenate([place.times for place in places])
        lengths = [len(place.rows) for place in places]
        self.starts: Indexes = np.concatenate(([0], np.cumsum(lengths)))
        self.owner = np.repeat(np.arange(len(places)), lengths)
        nothing = np.zeros(len(self.times), np.bool_)
        speed = motion.commanded or motion.speed
        self.speeds = self.numbers(speed)
        self.speed_name = speed.name if speed else ""
        self.told: Flags = nothing
        self.stops: Flags = nothing
        self.resting: Flags = nothing
        self.spot: Flags = nothing
        self.wheel_drives: Array = np.zeros(len(self.times))
        if self.speeds is not None:
            self._add_command(self.speeds)
        self.fastest: Array | None = None
        wheels = motion.wheel_commands or motion.wheels
        self.wheels = [each for each in wheels if each.name in frame]
        if self.wheels:
            self._add_wheels(np.stack([frame.numbers(e.name)[self._rows] for e in self.wheels]))
        self.drives = self.told | (self.wheel_drives != 0)
        self.turns = self._in_cells(self._turning)
        if motion.heading is None:  # wheels that turn it on the spot move it nowhere
            self.turns |= self.spot
        self.sways = self._in_cells(self._swaying)
        self.modes, self.modes_held = self._coded(motion.mode)
        self.labels = [shown(label) for label in self.modes_held]

    def numbers(self, signal: Signal | None) -> Array | None:
        """The numbers of a signal in these rows; None where there is no such signal."""
        if signal is None or signal.name not in self._frame:
            return None
        return self._frame.numbers(signal.name)[self._rows]

    def _coded(self, signal: Signal | None) -> tuple[Indexes, list[Value]]:
        if signal is None:
            return np.zeros(len(self.times), np.intp), [None]
        codes, labels = self._frame.coded(signal.name)
        return codes[self._rows], labels

    def _add_command(self, speeds: Array) -> None:
        """A speed whose name leaves open whether it is commanded or measured may be a command
        where it is not 0: it stands.
        """
        least = max(self.options.min_commanded_m_s, COMMAND_NOISE * _noise(speeds))
        self.told = np.abs(speeds) >= least
        self.stops = (np.abs(speeds) < least) & (self.motion.commanded is not None)

    def _add_wheels(self, speeds: Array) -> None:
        speeds = np.nan_to_num(speeds)
        fastest: Array = np.abs(speeds).max(axis=0)
        mean: Array = speeds.mean(axis=0)
        noise = max(_noise(each) for each in speeds)
        turn: Flags = fastest >= max(WHEELS_TURN, COMMAND_NOISE * noise)
        ahead: Flags = turn & (np.abs(mean) >= ON_THE_SPOT * fastest)
        self.fastest, self.resting, self.spot = fastest, ~turn, turn & ~ahead
        # Where the heading is known, it shows whether wheels against each other turn it.
        seen = self.spot & (self.motion.heading is not None)
        self.wheel_drives = np.where(ahead, np.sign(mean), 1.0 * seen)

    @cached_property
    def _cells(self) -> Indexes:
        """Where parts of about two seconds of each standstill begin."""
        first_s = np.array([place.times[0] for place in self.places])
        lasts_s = np.array([place.lasts_s for place in self.places])
        counts = np.maximum(1, np.round(lasts_s / CELL_S)).astype(np.intp)
        of = np.repeat(np.arange(len(counts)), counts)
        at = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
        begins_s = first_s[of] + at * (lasts_s / counts)[of]
        return np.unique(np.append(np.searchsorted(self.times, begins_s), self.starts[:-1]))

    def _in_cells(self, flags_of: Callable[[Indexes, Indexes], Flags]) -> Flags:
        """Flags of cells, in each of their rows; single cells do not show it."""
        cells = self._cells
        return np.repeat(flags_of(cells, self.owner[cells]), np.diff(cells, append=len(self.times)))

    @cached_property
    def course(self) -> Array | None:
        """Where it looks, counted on over whole turns; NaN where a row does not tell."""
        heading = self.motion.heading
        if (angles := self.numbers(heading)) is None or heading is None:
            return None
        course = np.full(len(angles), np.nan)
        there = np.isfinite(angles)
        course[there] = np.unwrap(angles[there] * (math.tau / (heading.turn or math.tau)))
        return course

    def _turning(self, cells: Indexes, of: Indexes) -> Flags:
        """Whether it looks elsewhere in each cell than in those next to it.

        Means are compared: who wiggles about one heading does not turn; nor who is turned once.
        """
        if self.course is None:
            return np.zeros(len(cells), np.bool_)
        there = np.isfinite(self.course)
        rows = np.maximum(1, np.add.reduceat(there * 1.0, cells))
        means = np.add.reduceat(np.where(there, self.course, 0.0), cells) / rows
        limit = np.maximum(TURNED_RAD, HEADING_NOISE * _noise(self.course) / np.sqrt(rows))
        turned = np.abs(np.diff(means)) > limit[1:]
        other = np.diff(of) != 0
        turned |= other
        alone = np.append(True, other) & np.append(other, True)
        return np.append(True, turned) & np.append(turned, True) & ~alone

    def _swaying(self, cells: Indexes, of: Indexes) -> Flags:
        """Whether it goes about in each cell: within a place who does so moves, and is not stuck.

        What counts is how far its places are from their mean (root mean square): of many rows some
        few are always far away.
        """
        away_m2 = np.zeros(len(cells))
        rows = np.diff(cells, append=len(self.times))
        for values in self._smoothed:
            off = values - np.repeat(np.add.reduceat(values, cells) / rows, rows)
            away_m2 += np.add.reduceat(off**2, cells) / rows
        left_m = np.array([place.left_m for place in self.places])[of]
        moved = away_m2 > np.maximum(SWAY_M, SWAY_NOISE * left_m) ** 2
        same = (np.diff(of) == 0) & moved[1:] & moved[:-1]  # a single twitch is none
        return np.concatenate(([False], same)) | np.concatenate((same, [False]))

    @cached_property
    def _smoothed(self) -> list[Array]:
        return [np.concatenate([getattr(p, axis) for p in self.places]) for axis in ("x", "y")]

    def codes(self, rows: slice) -> list[int]:
        """The modes in some of the rows."""
        counts: Indexes = np.bincount(self.modes[rows])
        return np.flatnonzero(counts).tolist()

    def reach_m(self, at: int) -> float:
        """How far apart the places are to and fro between which it went."""
        return math.hypot(np.ptp(self.places[at].x), np.ptp(self.places[at].y))

    @cached_property
    def hindered(self) -> Flags:
        """It moved in its place for as long as the shortest standstill takes."""
        return self.held(self.turns | self.sways, 0.0, self.options.stuck_s)

    def held(self, flags: Flags, bridged_s: float, least_s: float) -> Flags:
        """The flags where they hold for so long in one standstill, but for moments."""
        found = np.zeros(len(flags), np.bool_)
        for start, stop in self.spans(flags, bridged_s, least_s):
            found[start:stop] = True
        return found

    def spans(self, flags: Flags, bridged_s: float, least_s: float) -> list[tuple[int, int]]:
        """Rows [start, stop) of one standstill in which flags hold for so long, but for moments."""
        new = np.diff(self.owner, prepend=-1) != 0
        before = np.concatenate(([False], flags[:-1]))
        starts = np.flatnonzero(flags & (~before | new))
        after, last = np.append(flags[1:], False), np.append(new[1:], True)
        stops = np.flatnonzero(flags & (~after | last)) + 1
        if not len(starts):
            return []
        apart_s = self.times[starts[1:]] - self.times[stops[:-1] - 1]
        one = (self.owner[starts[1:]] == self.owner[starts[:-1]]) & (apart_s <= bridged_s)
        starts, stops = starts[np.append(True, ~one)], stops[np.append(~one, True)]
        long = self.times[stops - 1] - self.times[starts] >= NEARLY * least_s
        return list(zip(starts[long].tolist(), stops[long].tolist(), strict=True))


def _noise(values: Array) -> float:
    return noise_of(values[np.isfinite(values)])


class Weighing:
    """Weighs, of all standstills, whether the robot should have moved."""

    def __init__(self, standings: Standings, uses: ModeUses) -> None:
        self._found = standings
        self._uses = uses
        self._motion = standings.motion
        self._options = standings.options
        self._by_mode = {
            code: self._moves_in(standings.labels[code]) for code in standings.codes(slice(None))
        }
        moves = np.zeros(len(standings.labels), np.bool_)
        for code in [code for code, (why, _) in self._by_mode.items() if why]:
            moves[code] = True
        self._in_moving_mode = moves[standings.modes]
        drives = standings.drives | self._in_moving_mode
        should_move = drives & ~standings.stops & ~standings.hindered
        self._spans = standings.spans(should_move, BRIDGED_S, self._options.stuck_s)

    def events(self) -> Iterator[Judged]:
        """Each standstill, and what of it the robot was stuck for."""
        found, least_s = self._found, self._options.stuck_s
        spans: dict[int, list[tuple[int, int]]] = {}
        for span in self._spans:
            spans.setdefault(int(found.owner[span[0]]), []).append(span)
        for at, place in enumerate(found.places):
            rows = slice(int(found.starts[at]), int(found.starts[at + 1]))
            start_s, end_s = float(place.times[0]), float(place.times[-1])
            against, stuck = self._against(at, rows), False
            covered = False
            for span in spans.get(at, []):
                inside = slice(*span)
                first_s, last_s = float(found.times[span[0]]), float(found.times[span[1] - 1])
                reasons, doubt = self._shown(inside)
                if doubt is not None:
                    against.append(doubt)
                    continue
                stuck = True
                covered |= first_s - start_s < least_s and end_s - last_s < least_s
                is_all = span[1] - span[0] >= NEARLY * (rows.stop - rows.start)
                ends = (start_s, end_s) if is_all else (first_s, last_s)
                details = self._facts(place, inside) | self._commanded(inside)
                details["evidence_for"] = "; ".join(reasons)
                if against:
                    details["evidence_against"] = "; ".join(against)
                yield Judged("stuck", *ends, details)
            details = self._facts(place, rows)
            if not stuck:
                modeless = "" if self._motion.mode else "; if one holds the mode, give mode=NAME"
                nothing = f"no published signal shows that it should have moved{modeless}"
                details["why_not_stuck"] = "; ".join(against) or nothing
            yield Judged("standstill", start_s, end_s, details, covered)

    def _moves_in(self, mode: str | None) -> tuple[str | None, str | None]:
        """Why a robot in that mode should move, and what speaks against it."""
        if mode is None:
            return None, None
        if (moving := self._options.moving_modes) is not None:
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
        found, said = self._found, list[str]()
        codes = found.codes(rows)
        said += [why for code in codes for why in self._by_mode[code][:1] if why]
        told, wheels = found.told[rows], found.wheel_drives[rows] != 0
        speeds: Array | None = None
        if found.speeds is not None and told.sum() > TOLD_SHARE * len(told):
            speeds = found.speeds[rows][told]
            said.append(f"{found.speed_name} {median(speeds):.3g}")
        if found.fastest is not None and wheels.any():
            is_rad_s = all(wheel.unit == "rad/s" for wheel in found.wheels)
            turning = (found.wheel_drives * found.fastest)[rows][wheels]
            said.append(f"wheels at {median(abs(turning)):.3g}{' rad/s' if is_rad_s else ''}")
            speeds = turning if wheels.sum() > told.sum() else speeds
        if self._in_moving_mode[rows].mean() >= MOSTLY or speeds is None:
            return said, None
        return said, self._doubt(speeds, codes, measured=bool(self._motion.commanded is None))

    def _doubt(self, speeds: Array, codes: Sequence[int], *, measured: bool) -> str | None:
        """Why speeds are no command: they are hardly beyond their noise, or to and fro."""
        middle = median(speeds)
        spread = median(np.abs(speeds - middle)) / 0.6745
        stands = any(self._use(code).usually_stands for code in codes)
        needed = USUALLY_STANDS if measured and stands else ONE_COURSE
        same = np.count_nonzero(np.sign(speeds) == np.sign(middle))
        if abs(middle) >= needed * spread and same >= ONE_SIGN * len(speeds):
            return None
        return f"commanded or measured speeds of {middle:.2g} are hardly beyond their noise"

    def _use(self, code: int) -> ModeUse:
        mode = self._found.labels[code]
        return ModeUse() if mode is None else self._uses.of(mode)

    def _against(self, at: int, rows: slice) -> list[str]:
        """What speaks against that it should have moved in a standstill."""
        found, motion, said = self._found, self._motion, list[str]()

        def mostly(flags: Flags) -> bool:
            return np.count_nonzero(flags[rows]) > MOSTLY * (rows.stop - rows.start)

        if motion.commanded and found.speeds is not None and mostly(found.stops):
            stopped = median(found.speeds[rows][found.stops[rows]])
            said.append(f"{motion.commanded.name} {stopped:.3g}")
        if mostly(found.resting):
            said.append("wheels at rest")
        codes = found.codes(rows)
        said += [why for code in codes for why in self._by_mode[code][1:] if why]
        if mostly(found.turns):
            said.append(
                "it turned in place"  # what only the wheels tell, a quadcopter's do as well
                if motion.heading is not None
                else "its wheels turned in opposite directions, as for a turn in place; no heading "
                "recorded"
            )
        if mostly(found.sways):
            said.append(f"it moved back and forth within {found.reach_m(at):.2g} m")
        return said

    def _facts(self, place: Place, rows: slice) -> dict[str, Any]:
        """What is told of a standstill, whether it was stuck or not."""
        found = self._found
        facts: dict[str, Any] = {"x_m": place.x_m, "y_m": place.y_m}
        if self._motion.mode is not None:
            facts["mode"] = found.modes_held[int(np.argmax(np.bincount(found.modes[rows])))]
        if found.course is not None:
            course = found.course[rows]
            course = course[~np.isnan(course)]
            few = max(1, min(_HEADING_ROWS, len(course) // 2))
            if len(course):
                facts["turned_rad"] = round(median(course[-few:]) - median(course[:few]), 3)
        return facts

    def _commanded(self, rows: slice) -> dict[str, Any]:
        if (speeds := self._found.speeds) is None:
            return {}
        here = speeds[rows]
        here = here[np.isfinite(here)]
        return {"commanded": round(median(here), 9)} if len(here) else {}
