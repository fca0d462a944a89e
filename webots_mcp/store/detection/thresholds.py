"""Thresholds as a person states them: on some signals, above or below, for how long."""

from __future__ import annotations

from collections.abc import Sequence

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.detection.event import Threshold


def thresholds_on(
    names: Sequence[str], above: float | None, below: float | None, for_s: float
) -> tuple[Threshold, ...]:
    """One threshold per signal and limit; none where neither limit is given.

    Args:
        names: Signals, with `*`.
        above: In the unit of the signals.
        below: In the unit of the signals.
        for_s: At least so many simulated seconds.

    Raises:
        InvalidInputError: A limit without a signal, or a duration without a limit.
    """
    if for_s and above is None and below is None:
        raise InvalidInputError(f"for_s={for_s:g} needs above or below: of what it is the duration")
    limits = [{"above": above}] * (above is not None) + [{"below": below}] * (below is not None)
    if limits and not names:
        raise InvalidInputError("above and below need signals: name those that are compared")
    return tuple(Threshold(name, for_s=for_s, **limit) for name in names for limit in limits)
