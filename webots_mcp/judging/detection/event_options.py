"""The options of a search for events, with their defaults: what counts as an event of each kind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from webots_mcp.analysis.oscillations import LEAST_HALF_SWINGS
from webots_mcp.contract import LOG_LEVELS
from webots_mcp.errors import InvalidInputError


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
        where: For the kind "condition"; see 'webots-mcp help conditions'.
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
        if self.log_level not in LOG_LEVELS:
            raise InvalidInputError(
                f"Unknown log level {self.log_level!r}. Levels: {', '.join(LOG_LEVELS)}."
            )
        for name in ("stuck_m", "stuck_s", "missing_s", "flat_s", "jump_min_score", "jump_m"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise InvalidInputError(f"{name}={value} must be a number above 0.")


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
