"""The resolution of simulation times in questions and answers: the millisecond."""

from __future__ import annotations

import math
from typing import Final

_DECIMALS: Final = 3


def shown_time(time_s: float) -> float:
    """A simulation time as answers show it: to the millisecond."""
    return round(time_s, _DECIMALS)


def moment_of(time_s: float) -> float:
    """The earliest time that is shown like this one: where a bound of a range really lies."""
    shown_s = shown_time(time_s)
    moment_s = shown_s - 0.5 / 10**_DECIMALS
    while shown_time(moment_s) < shown_s:
        moment_s = math.nextafter(moment_s, math.inf)
    while shown_time(before_s := math.nextafter(moment_s, -math.inf)) >= shown_s:
        moment_s = before_s
    return moment_s
