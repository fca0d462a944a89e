"""What an event is, and what counts as one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from webots_mcp.contract import LOG_LEVELS
from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import Value
from webots_mcp.store.analysis.swings import LEAST_HALF_SWINGS

LEVELS: Final = LOG_LEVELS


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        kind: The name of one of `registry.KINDS`.
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


@dataclass(frozen=True)
class Threshold:
    """A signal above or below a value for at least `for_s` simulated seconds."""

    signal: str
    above: float | None = None
    below: float | None = None
    for_s: float = 0.0

    def __post_init__(self) -> None:
        if (self.above is None) == (self.below is None):
            raise InvalidInputError(f"threshold on {self.signal!r}: give either above or below")


def both_of(names: Sequence[str] | None) -> tuple[str, str] | None:
    """The signals of x and y that were named, if any.

    Raises:
        InvalidInputError: They are not two.
    """
    if names is None:
        return None
    if len(names) != 2:
        raise InvalidInputError(f"position={list(names)} must name two signals, of x and of y")
    return names[0], names[1]


@dataclass(frozen=True)
class EventOptions:
    """What counts as an event.

    Attributes:
        kinds: Names of the kinds that are looked for; without any the usual ones, which pictures
            and thresholds are not.
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
        thresholds: For the kind "threshold".
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
    thresholds: tuple[Threshold, ...] = ()
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
                f"unknown log level {self.log_level!r}; there is {', '.join(LEVELS)}"
            )
        for name in ("stuck_m", "stuck_s", "missing_s", "flat_s", "jump_min_score", "jump_m"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InvalidInputError(f"{name}={value} must be a number above 0")
