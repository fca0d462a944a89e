"""Sines of least squares about courses, many pieces and many periods at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from webots_mcp.store.analysis.arrays import Array, np

SAME_TIME: Final = 1e-9  # of the length of a piece: what adding up intervals leaves
# Times the period that seems right.
TRIED_PERIODS: Final = (0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08)


@dataclass(frozen=True)
class Fit:
    """What is left of the squares of each piece.

    Attributes:
        of_course: By a course alone.
        of_sines: By a course and a sine: a row for each piece, a column for each period.
        amplitudes: Of these sines, alike.
    """

    of_course: Array
    of_sines: Array
    amplitudes: Array

    @property
    def explained(self) -> Array:
        """The share of all squares that sines of each period explain."""
        course = float(self.of_course.sum())
        left: Array = np.sum(self.of_sines, axis=0)
        return np.asarray(1 - left / course if course > 0 else 0 * left, np.float64)

    def of_period(self, place: int) -> Fit:
        """What one of the periods leaves."""
        column = slice(place, place + 1)
        return Fit(self.of_course, self.of_sines[:, column], self.amplitudes[:, column])


def fit_sines(times: Array, values: Array, periods: Array, basis: Array) -> Fit:
    """Sines are fitted to what a course leaves of the values and of the sines themselves.

    Args:
        times: One row per piece, or one for all.
        values: One row per piece.
        periods: That are tried.
        basis: What the course of each piece, or of all, is made of: rows of length 1 at right
            angles.
    """
    moments = times - times.mean(axis=1, keepdims=True)
    angles: Array = 2 * np.pi * moments[:, None, :] / periods[:, None]
    waves = _beside(np.concatenate((np.sin(angles), np.cos(angles)), axis=1), basis)
    sines, cosines = waves[:, : len(periods)], waves[:, len(periods) :]
    left = _beside(values[:, None, :], basis)
    ss, cc, sc = (_products(*pair) for pair in ((sines,) * 2, (cosines,) * 2, (sines, cosines)))
    sy, cy, of_course = (_products(each, left) for each in (sines, cosines, left))
    determinant: Array = np.maximum(ss * cc - sc * sc, 1e-12)
    of_sine, of_cosine = (sy * cc - cy * sc) / determinant, (cy * ss - sy * sc) / determinant
    amplitudes: Array = np.hypot(of_sine, of_cosine)
    return Fit(of_course, of_course - of_sine * sy - of_cosine * cy, amplitudes)


def parabolas(times: Array) -> Array:
    """Per piece three courses of length 1 at right angles: level, straight and bent."""
    straight = _of_length_one(times - times.mean(axis=1, keepdims=True))
    bent = straight**2
    bent -= bent.mean(axis=1, keepdims=True)
    bent -= np.einsum("ij,ij->i", bent, straight)[:, None] * straight
    level = np.full_like(straight, straight.shape[1] ** -0.5)
    return np.stack((level, straight, _of_length_one(bent)), axis=1)


def alike_rows(times: Array) -> Array:
    """One row for all pieces whose rows come after the same times; else those of each piece."""
    after = times - times[:, :1]
    alike = np.abs(after - after[0]).max() <= SAME_TIME * after[0, -1]
    return times[:1] if alike else times


def _beside(courses: Array, basis: Array) -> Array:
    """The residuals of courses after removing those of the basis."""
    return np.asarray(courses - (courses @ np.swapaxes(basis, 1, 2)) @ basis, np.float64)


def _of_length_one(courses: Array) -> Array:
    return courses / np.sqrt(np.einsum("ij,ij->i", courses, courses))[:, None]


def _products(one: Array, other: Array) -> Array:
    """Sums along the rows, of as many courses or of many and one; of each piece or of all."""
    if one.shape == other.shape:
        return np.einsum("ijk,ijk->ij", one, other)
    return np.asarray((one @ np.swapaxes(other, 1, 2))[:, :, 0], np.float64)
