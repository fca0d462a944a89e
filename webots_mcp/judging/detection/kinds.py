"""What an event is, and what counts as one."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Final

from webots_mcp.analysis.swings import LEAST_HALF_SWINGS
from webots_mcp.contract import LOG_LEVELS
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.judging.verdicts import Cause
from webots_mcp.signals.naming import Value

LEVELS: Final = LOG_LEVELS
MOST_TIMES: Final = 3  # of a group that are named
_SAME_LENGTH: Final = 0.05  # of the longest: so near each other they last equally long
_NUMBER: Final = re.compile(r"\d+(\.\d+)?")


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        kind: The name of one of `events.KINDS`.
        end_s: Equal to the start for what has no duration; of a change when the value ended.
        ongoing: It lasts up to the newest row of a run that goes on; of a command, it is not
            finished.
        name: The signal, the action, the level or the device that it is about.
        details: What there is to say about it, by kind.
        around: Values of a few signals when it began.
        count: How many alike events it stands for; it begins with the first, ends with the last.
    """

    kind: str
    run_id: int
    start_s: float
    end_s: float
    wall_time_s: float
    name: str | None = None
    details: dict[str, Any] = field(default_factory=dict[str, Any])
    ongoing: bool = False
    around: dict[str, Value] = field(default_factory=dict[str, Value])
    count: int = 1

    @property
    def duration_s(self) -> float:
        """How long it lasted, in simulated seconds."""
        return self.end_s - self.start_s


def both_of(names: Sequence[str] | None) -> tuple[str, str] | None:
    """The signals of x and y that were named, if any.

    Raises:
        InvalidInputError: They are not two.
    """
    if names is None:
        return None
    if len(names) != 2:
        raise InvalidInputError(f"position={list(names)} must name two signals, of x and of y.")
    return names[0], names[1]


@dataclass(frozen=True)
class EventOptions:
    """What counts as an event.

    Attributes:
        kinds: Names of the kinds that are looked for; without any the usual ones, which pictures
            are not.
        signals: Names, with `*`, of the signals that are looked at.
        position: The two signals of the position in metres; None finds them by name (`pose.0`
            and `pose.1`, `position.x` and `position.y`, `gps.0` and so on).
        mode: The signal of the mode, a text or a number; None finds a text by name (`mode`,
            `state`, ...).
        moving_modes: Modes in which the robot should move; None for those in which it has been
            seen moving, in this run or an earlier one.
        commanded: The signal of the commanded speed; None finds it by name (`commanded`, `cmd`,
            `target_speed`). Of `speed` and `velocity` it is open whether they are commanded.
        min_commanded_m_s: A commanded speed of at least this should move the robot.
        stuck_m: Who stays within this distance (more where the noise of the position is more) is at
            a standstill, and stuck who should move besides, ...
        stuck_s: ... for so long.
        where: For the kind "condition"; see docs/conditions.md.
        missing_s: Without a value for so long, though it mostly has one.
        flat_s: Exactly the same number for so long, though it mostly changes; for a signal that
            is noisy otherwise 0.15 of that are enough.
        jump_min_score: How many times larger than the usual step (modified z-score) a jump is.
        jump_m: A position jumps by at least so much between two rows.
        min_half_periods: Half periods in a row; with a period of more than 5 s at least 12.
        oscillation_period_s: The longest period that counts; None for as long a one as fits in
            the stretch, and for 5 s where that is too long to be read row by row.
        log_level: Log lines of this level and above.
    """

    kinds: tuple[str, ...] = ()
    signals: tuple[str, ...] = ("*",)
    position: tuple[str, str] | None = None
    mode: str | None = None
    moving_modes: tuple[str, ...] | None = None
    commanded: str | None = None
    min_commanded_m_s: float = 0.01
    stuck_m: float = 0.05
    stuck_s: float = 3.0
    where: str | None = None
    missing_s: float = 1.0
    flat_s: float = 20.0
    jump_min_score: float = 12.0
    jump_m: float = 0.3
    min_half_periods: int = LEAST_HALF_SWINGS
    oscillation_period_s: float | None = None
    log_level: str = "warning"

    def __post_init__(self) -> None:
        if self.log_level not in LEVELS:
            raise InvalidInputError(
                f"Unknown log level {self.log_level!r}. Levels: {', '.join(LEVELS)}."
            )
        for name in ("stuck_m", "stuck_s", "missing_s", "flat_s", "jump_min_score", "jump_m"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InvalidInputError(f"{name}={value} must be a number above 0.")


# -- what a kind of event is: how it is found, reported, counted and drawn -------------------------


class NotSearchableError(NothingRecordedError):
    """Nothing was recorded in which a kind could be looked for; the text says what is missing.

    Attributes:
        cause: None where the text tells it.
    """

    def __init__(self, reason: str, cause: Cause | None = None) -> None:
        super().__init__(reason)
        self.cause: Cause | None = cause


class NotAskedError(Exception):
    """A kind that was not named has nothing to look for, and nothing is said of it."""


def but_for_numbers(text: object) -> str:
    """What texts that differ in their numbers only have in common."""
    return _NUMBER.sub("#", str(text))


@dataclass(frozen=True)
class Alike:
    """How similar events of a kind are reported as one.

    Attributes:
        says: What they are, in the plural, given them in order and the unit of their signal.
        sort: What they share besides the run and the signal.
        adds: More of their details than what all of them have in common.
        most_single: So many of a sort are reported one by one.
        of_arrays: What several items of one array did at once is one event.
    """

    says: Callable[[Sequence[Event], str], str]
    sort: Callable[[Event], Hashable] = lambda event: None
    adds: Callable[[Sequence[Event]], dict[str, Any]] = lambda events: {}
    most_single: int = 3
    of_arrays: bool = False

    def as_one(self, alike: Sequence[Event], unit: str = "") -> Event:
        """Several of one sort, in order; what they are, when, and what they have in common."""
        first, last = alike[0], max(alike, key=lambda event: event.end_s)
        times_s = [round(each.start_s, 3) for each in alike]
        span = f"the first at {times_s[0]:.6g} s, the last at {times_s[-1]:.6g} s"
        lasted = _lengths([each.duration_s for each in alike])
        says = f"{len(alike)} {self.says(alike, unit)}, {span}{lasted}"
        details = _in_common([event.details for event in alike]) | self.adds(alike)
        details |= {"says": says, "first_times_s": times_s[:MOST_TIMES]}
        ends = {"end_s": last.end_s, "ongoing": last.ongoing}
        return replace(first, **ends, details=details, count=len(alike))


def _lengths(lengths_s: Sequence[float]) -> str:
    """How long they lasted, where they did."""
    least_s, most_s, middle_s = min(lengths_s), max(lengths_s), median(lengths_s)
    if not most_s:
        return ""
    if most_s - least_s <= _SAME_LENGTH * most_s:
        return f", each {middle_s:.3g} s long"
    total = f"{sum(lengths_s):.4g} s in total"
    return f", {least_s:.3g} to {most_s:.3g} s long (median {middle_s:.3g} s), {total}"


def _in_common(all_details: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the details of all of them are, or lie between."""
    first, *others = all_details
    names = [name for name in first if all(name in other for other in others)]
    shared = {name: _shared([details[name] for details in all_details]) for name in names}
    return {name: value for name, value in shared.items() if value is not None}


def _shared(values: Sequence[Any]) -> Any:
    """The one value; of numbers the least and the greatest; of texts the clauses that all have."""
    if all(value == values[0] for value in values):
        return values[0]
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return f"{min(values):.4g} to {max(values):.4g}"
    if all(isinstance(value, dict) for value in values):
        return _in_common(values) or None
    if all(isinstance(value, str) for value in values):
        clauses: list[list[str]] = [value.split("; ") for value in values]
        return "; ".join(e for e in clauses[0] if all(e in each for each in clauses)) or None
    return None


def count_by_kind(events: Iterable[Event]) -> Counter[str]:
    """How many there are of each kind, where one may stand for many that are alike."""
    counts = Counter[str]()
    for event in events:
        counts[event.kind] += event.count
    return counts
