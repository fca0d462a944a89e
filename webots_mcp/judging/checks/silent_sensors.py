"""Whether a sensor was without a value because of where the robot was, or what it did.

A program publishes null where there is nothing to measure: a satellite receiver below the surface,
an object that is out of sight. Then something else that is measured separates the rows without a
value from those with one, at each begin and end of the silence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import MOSTLY, Array, Flags, np
from webots_mcp.judging.checks.check import RunUnderCheck
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.sensors import rows_without_value
from webots_mcp.signals.meaning import INERT, understood_words, words_in
from webots_mcp.store.chunks import shown

_NOISE: Final = 4.0  # standard deviations: so near the limit a reading may be on either side
# Of a signal's range: a border that is wider says little. By chance a signal that comes and goes
# once passes one level twice within such a share: one silence in 50 has a false reason.
_WIDEST: Final = 0.02
_INERT_OR_FAR: Final = INERT | {"distance"}  # a depth is a distance from the surface
_MOST_MODES: Final = 20


_OWN_WORDS: Final = frozenset(
    word
    for said in understood_words().values()
    for unit_or_word in said
    for word in unit_or_word.split()
) | {
    "battery",
    "camera",
    "gnss",
    "gps",
    "imu",
    "odometry",
    "pose",
    "position",
    "radar",
    "robot",
    "rtk",
}


class Reason(NamedTuple):
    """What separates the rows without a value from the others.

    Attributes:
        signal: Its name.
        says: In words, such as `depth_m was above 0.3`.
    """

    signal: str
    says: str


def reason_of(run: RunUnderCheck, silent: Event) -> Reason | None:
    """Return what explains all silences of a signal; None where nothing recorded does.

    Only silences that begin and end within the run are explained: whatever only rises, as a clock
    does, separates the two halves of a run.
    """
    name, frame = silent.name or "", run.frame
    lacks = rows_without_value(frame, name)
    if lacks is None or lacks[0] or lacks.all():
        return None
    edges = np.flatnonzero(np.diff(lacks)) + 1
    if len(edges) < 2:
        return None
    reasons = _reasons(run, name, lacks)
    return next(reasons, None)


def _reasons(run: RunUnderCheck, name: str, lacks: Flags) -> Iterator[Reason]:
    frame, branches = run.frame, run.search.branches
    mode = run.motion.mode
    if mode is not None and mode.name in frame:
        codes, labels = frame.coded(mode.name)
        without: set[int] = set(codes[lacks].tolist())
        others: set[int] = set(codes[~lacks].tolist())
        if len(labels) <= _MOST_MODES and without.isdisjoint(others):
            modes = ", ".join(sorted(str(shown(labels[code])) for code in without))
            yield Reason(mode.name, f"{mode.name} was {modes}")
    for other, meaning in run.meanings.items():
        signal = run.search.known[other]
        if (
            meaning.quantity not in _INERT_OR_FAR
            or not meaning.is_sensed
            or not signal.is_number
            or signal.turn is not None
            or branches[other] == branches[name]
            or other not in frame
        ):
            continue
        values = frame.numbers(other)
        limit = _limit_between(values, lacks, run.noise.of(other))
        if limit is not None:
            above = float(np.nanmedian(values[lacks])) > limit
            yield Reason(other, f"{other} was {'above' if above else 'below'} {limit:.3g}")


def _limit_between(values: Array, lacks: Flags, noise: float) -> float | None:
    """The value that separates rows without a value from the others; None where none does."""
    known = np.isfinite(values)
    if np.count_nonzero(known) < len(values) * 0.99:
        return None
    inside, outside = values[known & lacks], values[known & ~lacks]
    if not len(inside) or not len(outside):
        return None
    border = _WIDEST * float(np.ptp(values[known]))
    if 2 * _NOISE * noise > border:
        return None
    for low, high in ((inside, outside), (outside, inside)):
        # The largest of some and the smallest of the others overlap by the width of the border.
        limit = float((low.max() + high.min()) / 2)
        overlap = float(low.max() - high.min())
        near = max(overlap, _NOISE * noise)
        if overlap <= border and _keeps_away(values, lacks, limit, near):
            return limit
    return None


def _keeps_away(values: Array, lacks: Flags, limit: float, near: float) -> bool:
    """Whether a signal mostly stays away from a limit, with and without a value of the other."""
    is_near = np.abs(values - limit) <= near
    return all(float(is_near[rows].mean()) <= MOSTLY for rows in (lacks, ~lacks))


def explained(run: RunUnderCheck, silent: Sequence[Event]) -> dict[str, str]:
    """Return for signals that were null why that is no fault, as far as it is known."""
    names = {each.name: each for each in silent if each.name and not each.details}
    found: dict[str, str] = {}
    for name, each in names.items():
        if _is_of_something_seen(run, name):
            found[name] = "which is none of the robot's own devices"
        elif reason := reason_of(run, each):
            found[name] = f"while {reason.says}"
    return found


def _is_of_something_seen(run: RunUnderCheck, name: str) -> bool:
    """Whether a signal belongs to a thing that a robot sees or does not: `ball.distance_m`.

    Then all that is known of the thing is null at once, and no word for it is one of a device, a
    joint or a quantity. A device that is there always gives a number, or NaN.
    """
    branch = name.rpartition(".")[0]
    words = {word for word in words_in(branch) if not word.isdigit()}
    if not words or words & _OWN_WORDS:
        return False
    others = [each for each in run.search.known if each.startswith(f"{branch}.")]
    lacks = rows_without_value(run.frame, name)
    return lacks is not None and all(
        (other := rows_without_value(run.frame, each)) is not None and np.array_equal(other, lacks)
        for each in others
    )
