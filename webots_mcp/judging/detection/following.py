"""How a measured signal follows a target that keeps moving, and where it stopped doing so.

A target that never settles has no distance to judge by. In windows of 3 s the measurement is fitted
to the target of a moment before: the slope is the gain, the share of the target's motion that it
makes. What it is in most windows is usual; where it is less than half of that, it does not follow.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, Flags, Indexes, inner, median, np, runs_of

WINDOW_S: Final = 3.0  # a follower may lag by as much
# Of the usual gain: in 40 recordings of healthy joints that follow with gains of 0.4 to 1 and lags
# up to a fifth of a period, none was taken to be lost.
LOST_SHARE: Final = 0.5
_STEP_S: Final = 1.0  # from one window to the next
_LEAST_ROWS: Final = 6  # of a window
_LEAST_FOLLOWED: Final = 6  # windows in which it followed: 8 s
_LEAST_LOST: Final = 3  # windows in a row
_EXPLAINED: Final = 0.5  # of its variance, by the target, in the median window that it followed
_SAMPLED: Final = 40  # windows by which the lag is found
_LIKE_BEFORE: Final = 1.1  # times as fast, or as small, as where it was seen to follow
_MEDIAN_TO_SD: Final = 1.4826  # of deviations from a median, for normal noise


class LostSpan(NamedTuple):
    """From when to when it did not follow, with its gain there and the usual one."""

    start_s: float
    end_s: float
    gain: float
    usual: float


class Following(NamedTuple):
    """What came of a comparison with a moving target.

    Attributes:
        lost: Where it did not follow.
        judged_s: In how much time that could be judged.
        why_not: Why nothing could be judged; empty otherwise.
    """

    lost: list[LostSpan]
    judged_s: float
    why_not: str = ""


class _Windows(NamedTuple):
    """Rows of overlapping windows, and what the target does in each of them."""

    starts_s: Array
    firsts: Indexes
    stops: Indexes
    moves: Flags


def following_of(
    times: Array, values: Array, aims: Array, least_moved: float, noise: float, errors: float
) -> Following:
    """Judge how a signal follows a moving target.

    Args:
        times: Of rows in which both are known.
        values: What was measured; angles without leaps.
        aims: The target, in the same unit.
        least_moved: A target whose range in a window is less does not move.
        noise: Standard deviation of the noise of both.
        errors: Standard errors that the gain has to be known to, and usual gains to scatter less.
    """
    windows = _windows_of(times, aims, least_moved)
    if np.count_nonzero(windows.moves) < _LEAST_FOLLOWED + _LEAST_LOST:
        return Following([], 0.0, "its target moved for too short a time")
    lag_s = _lag_of(times, values, aims, windows)
    fits = _fits(times, values, np.interp(times - lag_s, times, aims), windows)
    windows = windows._replace(moves=windows.moves & np.isfinite(fits.gains))
    gains = fits.gains[windows.moves]
    if len(gains) < _LEAST_FOLLOWED:
        return Following([], 0.0, "too few rows show how it follows")
    most = float(np.quantile(gains, 0.9))
    followed = windows.moves & (fits.gains >= LOST_SHARE * most)
    if most <= 0 or np.count_nonzero(followed) < _LEAST_FOLLOWED:
        return Following([], 0.0, "it never follows its target")
    usual = median(fits.gains[followed])
    scatter = _MEDIAN_TO_SD * median(np.abs(fits.gains[followed] - usual))
    if median(fits.explained[followed]) < _EXPLAINED:
        return Following([], 0.0, "its target explains less than half of how it moves")
    if errors * scatter > LOST_SHARE * usual:
        return Following([], 0.0, "it follows its target by a share that varies")
    known = errors * noise <= LOST_SHARE * usual * fits.deviations * np.sqrt(fits.rows)
    judged = windows.moves & known
    # It may follow slow and large motions only: nothing is known of faster and smaller ones.
    judged &= fits.speeds <= _LIKE_BEFORE * fits.speeds[followed].max()
    judged &= fits.deviations * _LIKE_BEFORE >= fits.deviations[followed].min()
    lost = judged & (fits.gains < LOST_SHARE * usual)
    return Following(_spans(times, windows, lost, fits.gains, usual), _covered_s(windows, judged))


def _windows_of(times: Array, aims: Array, least_moved: float) -> _Windows:
    """Windows in which the target moved, also in each second of them."""
    starts_s = np.arange(times[0], times[-1] - WINDOW_S + _STEP_S / 2, _STEP_S)
    firsts, stops, seconds = (
        np.searchsorted(times, starts_s + each) for each in (0.0, WINDOW_S, _STEP_S)
    )
    last = len(times) - 1
    edges = np.searchsorted(times, np.arange(times[0], times[-1] + 2 * _STEP_S, _STEP_S))
    edges = np.minimum(edges, last)
    low = np.minimum.reduceat(aims, edges)
    high = np.maximum.reduceat(aims, edges)
    steps = np.arange(len(starts_s))
    inside = np.minimum(steps[:, None] + np.arange(int(WINDOW_S / _STEP_S)), len(edges) - 1)
    ranges = high[inside].max(axis=1) - low[inside].min(axis=1)
    goes_on = (high[inside] > low[inside]).all(axis=1)
    enough = (stops - firsts >= _LEAST_ROWS) & (seconds > firsts)
    return _Windows(starts_s, firsts, stops, enough & goes_on & (ranges > least_moved))


class _Fits(NamedTuple):
    """The line through measurement and target in each window.

    Attributes:
        gains: Its slope; NaN where there are too few rows.
        explained: The share of the measurement's variance that it explains.
        deviations: The standard deviation of the target.
        speeds: How fast the target goes, root mean square.
    """

    gains: Array
    explained: Array
    deviations: Array
    speeds: Array
    rows: Array


def _fits(times: Array, values: Array, aims: Array, windows: _Windows) -> _Fits:
    x, y = aims - aims.mean(), values - values.mean()
    steps_s = np.maximum(np.diff(times, append=times[-1] + 1.0), 1e-9)
    speeds = (np.diff(x, append=x[-1:]) / steps_s) ** 2
    columns = (x, y, x * x, x * y, y * y, speeds)
    sums = [
        total[windows.stops] - total[windows.firsts]
        for total in (np.concatenate(([0.0], np.cumsum(each))) for each in columns)
    ]
    rows = np.maximum(windows.stops - windows.firsts, 1).astype(np.float64)
    sum_x, sum_y, xx, xy, yy, fast = sums
    xx, xy, yy = xx - sum_x**2 / rows, xy - sum_x * sum_y / rows, yy - sum_y**2 / rows
    is_known = windows.moves & (xx > 0) & (rows >= _LEAST_ROWS)
    safe = np.where(is_known, xx, 1.0)
    gains = np.where(is_known, xy / safe, np.nan)
    explained = np.where(yy > 0, xy**2 / (safe * np.where(yy > 0, yy, 1.0)), 0.0)
    deviations = np.sqrt(np.maximum(xx, 0.0) / rows)
    return _Fits(gains, explained, deviations, np.sqrt(fast / rows), rows)


def _lag_of(times: Array, values: Array, aims: Array, windows: _Windows) -> float:
    """The lag with which most of its motion is explained, in the windows that are explained best.

    Where it does not follow for half of the run, the other half tells its lag.
    """
    interval_s = max(median(np.diff(times)), 1e-6)
    most = max(1, int(WINDOW_S / interval_s))
    lags_s = interval_s * np.unique(np.geomspace(1, most + 1, 24).astype(np.intp) - 1)
    moving = np.flatnonzero(windows.moves)
    picked = moving[np.unique(np.linspace(0, len(moving) - 1, _SAMPLED).astype(np.intp))]
    best = -1.0, 0.0
    spans = list(zip(windows.firsts[picked].tolist(), windows.stops[picked].tolist(), strict=True))
    for lag_s in lags_s.tolist():
        shares = [_explained(times, values, aims, span, lag_s) for span in spans]
        best = max(best, (round(float(np.quantile(shares, 0.75)), 6), -lag_s))
    return -best[1]


def _explained(
    times: Array, values: Array, aims: Array, span: tuple[int, int], lag_s: float
) -> float:
    """The share of the variance in some rows that the target a moment before explains."""
    first, stop = span
    part = slice(first, stop)
    before = slice(max(0, int(np.searchsorted(times, float(times[first]) - lag_s)) - 1), stop)
    moments: Array = times[part] - lag_s
    x: Array = np.interp(moments, times[before], aims[before])
    y: Array = values[part]
    x, y = x - x.mean(), y - y.mean()
    both, product = inner(x, x) * inner(y, y), inner(x, y)
    return product * abs(product) / both if both > 0 else 0.0


def _spans(
    times: Array, windows: _Windows, lost: Flags, gains: Array, usual: float
) -> list[LostSpan]:
    """Where windows in a row are lost; the gain falls to half where the middle of one is."""
    found: list[LostSpan] = []
    middle_s = (WINDOW_S - _STEP_S) / 2  # of the first window that is lost, on average
    for run in runs_of(lost, windows.starts_s).spans():
        if run.stop - run.start < _LEAST_LOST:
            continue
        is_first, is_last = run.start == 0, run.stop == len(lost)
        start_s = float(times[0]) if is_first else run.start_s + middle_s
        end_s = float(times[-1]) if is_last else run.end_s + WINDOW_S - middle_s
        rows = np.searchsorted(times, (start_s, end_s)).tolist()
        first_s, last_s = (float(times[min(row, len(times) - 1)]) for row in rows)
        gain = float(np.median(gains[run.start : run.stop]))
        found.append(LostSpan(first_s, last_s, gain, usual))
    return found


def _covered_s(windows: _Windows, judged: Flags) -> float:
    """How many seconds lie in a window that was judged."""
    steps = int(WINDOW_S / _STEP_S)
    covered = np.convolve(judged.astype(np.float64), np.ones(steps)) > 0
    return _STEP_S * float(np.count_nonzero(covered))
