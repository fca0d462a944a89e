"""Word how long ago something was, and the time of day.

Sentences use this for wall time; the data of an answer have the seconds and the time of day.
"""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Final

LONG_AGO_S: Final = 3_600.0  # from this age on, an answer also has the time of day
_MINUTE_S: Final = 60.0
_UNITS: Final = (  # each is used from twice its length on: 90 minutes, not 2 hours
    (365.25 * 86_400.0, "years"),
    (30.44 * 86_400.0, "months"),
    (86_400.0, "days"),
    (3_600.0, "hours"),
    (_MINUTE_S, "minutes"),
)


def age_in_words(seconds: float) -> str:
    """Return an age in words: 0.4 s, 42 s, 5 minutes, 3 hours, 2 days, 5 months, 3 years.

    Args:
        seconds: The age; a negative one, from a clock that runs ahead, counts as 0.
    """
    age_s = max(seconds, 0.0)
    for unit_s, unit in _UNITS:
        if age_s >= 2 * unit_s:
            return f"{age_s / unit_s:.0f} {unit}"
    return f"{age_s:.{1 if age_s < 10 else 0}f} s"


def ago(seconds: float) -> str:
    """Return an age followed by `ago`."""
    return f"{age_in_words(seconds)} ago"


def utc(wall_time_s: float) -> str:
    """Return a moment of wall time to the second, in UTC, as `since` of the tools takes it."""
    try:
        moment = datetime.fromtimestamp(wall_time_s, timezone.utc)
    except (OverflowError, OSError, ValueError):  # no bridge writes such a time
        return f"{wall_time_s}"
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def wall_clock(wall_time_s: float) -> str:
    """Return a moment of wall time in this machine's zone, as ISO 8601 with that zone."""
    try:
        return datetime.fromtimestamp(wall_time_s).astimezone().isoformat("T", "milliseconds")
    except (OverflowError, OSError, ValueError):  # no bridge writes such a time
        return f"{wall_time_s}"
