"""How much of a signal is noise, and the smoothing that it asks for."""

from __future__ import annotations

from typing import Final

from webots_mcp.store.analysis.arrays import Array, median, np

_ORDER: Final = 4
# The fourth difference of independent noise has sqrt(1 + 16 + 36 + 16 + 1) = sqrt(70) times its
# standard deviation, and a normal variable has a median magnitude of 0.6745 of it.
_GAIN: Final = 0.6745 * 70**0.5
LEAST_ROWS: Final = 3 * _ORDER
FEWEST_SMOOTHED: Final = 5  # rows: through fewer a parabola leaves the noise


def noise_of(values: Array) -> float:
    """Standard deviation of the independent noise in evenly recorded values.

    The median magnitude of the fourth differences: a course that a polynomial of third degree
    describes over five rows adds nothing to it, and single outliers hardly anything (T. Gasser,
    L. Sroka, C. Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression,
    Biometrika 73, 1986, of which this is the robust form with a higher order). 0 for fewer than
    12 values.
    """
    sizes = np.abs(np.diff(values, _ORDER))
    return median(sizes) / _GAIN if len(sizes) >= LEAST_ROWS - _ORDER else 0.0


def smooth(values: Array, rows: int) -> tuple[Array, float]:
    """Values without most of their noise, and the share of its standard deviation that is left.

    A parabola of least squares through an odd number of rows about each (A. Savitzky, M. Golay,
    Smoothing and differentiation of data by simplified least squares procedures, Analytical
    Chemistry 36, 1964): a bend that is long compared to the window is kept. At the ends the
    parabola through the first or last window is taken.
    """
    rows = min(rows, len(values) - 1 + len(values) % 2)
    if rows < FEWEST_SMOOTHED:
        return values, 1.0
    fit, half = _parabola(rows), rows // 2
    smoothed = np.asarray(np.convolve(values, fit[half, ::-1], "same"), np.float64)
    smoothed[:half] = (fit @ values[:rows])[:half]
    smoothed[-half:] = (fit @ values[-rows:])[-half:]
    return smoothed, float(np.sqrt(fit[half] @ fit[half]))


def variance_along(count: int, rows: int) -> Array:
    """Of the noise in each of so many smoothed values, as a ratio to that of those in the middle.

    The parabola is less certain at the ends: there it is up to four times as much.
    """
    variance, rows = np.ones(count), min(rows, count - 1 + count % 2)
    if rows >= FEWEST_SMOOTHED:
        fit, half = _parabola(rows), rows // 2
        ratios = np.einsum("ij,ij->i", fit, fit) / (fit[half] @ fit[half])
        variance[:half], variance[-half:] = ratios[:half], ratios[-half:]
    return variance


def kept_alike(rows: int) -> Array:
    """Correlation of the noise in two smoothed values that lie 0, 1, 2, ... rows apart.

    The last one, 0, holds for all that lie farther apart.
    """
    if rows < FEWEST_SMOOTHED:
        return np.array([1.0, 0.0])
    middle = _parabola(rows)[rows // 2]
    alike = np.correlate(middle, middle, "full")[rows - 1 :]
    return np.append(alike / alike[0], 0.0)


def _parabola(rows: int) -> Array:
    """The matrix that turns so many values into those of the parabola of least squares."""
    place = np.arange(rows, dtype=np.float64) - rows // 2
    basis: Array = np.stack((place**2, place, np.ones(rows)), axis=1)
    return np.asarray(basis @ np.linalg.pinv(basis), np.float64)
