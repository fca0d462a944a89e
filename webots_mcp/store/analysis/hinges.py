"""Courses of straight pieces: where they bend, found in the presence of a sine."""

from __future__ import annotations

from typing import Final

from webots_mcp.store.analysis.arrays import Array, Indexes, np

MOST_HINGES: Final = 6  # in two to three periods; with more, a sine and a zigzag look the same
CERTAIN_HINGE: Final = 4.0  # deviations of the noise
PARAMETERS: Final = 2  # of a hinge: where it is, and how far it bends
_TINY: Final = 1e-9


def hinged_courses(values: Array, period: float | None, noise: float) -> tuple[Array, Array]:
    """What straight pieces that explain the values are made of, and the squares that they leave.

    Hinges are taken one after the other, each where it explains most of what is left (S. Chen,
    S. A. Billings, W. Luo, Orthogonal least squares methods and their application to non-linear
    system identification, International Journal of Control 50, 1989), as long as it is worth its
    two parameters (G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6, 1978)
    and stands out of the noise.

    Args:
        values: One row per piece.
        period: In columns, of a sine of any height that is part of each piece; None for no sine.
        noise: Standard deviation.

    Returns:
        Per piece rows of length 1 at right angles: level, straight and one for each hinge, 0 where
        there are fewer; and what is left of the squares, as an array of pieces.
    """
    count = values.shape[1]
    places: Array = np.arange(count, dtype=np.float64) - (count - 1) / 2
    ramps: Array = np.maximum(places[:, None] - places[1:-1], 0.0)
    chosen, left = _chosen(values, _known(places, period), ramps, noise)
    level, straight = np.transpose(_known(places, None))
    basis: list[Array] = [np.broadcast_to(each, values.shape) for each in (level, straight)]
    for at in chosen:
        hinge = _beside(np.transpose(ramps[:, at]), basis)
        basis.append(_of_length_one(hinge) * (at >= 0)[:, None])
    return np.stack(basis, axis=1), left


def hinges_in(basis: Array) -> Array:
    """How many hinges there are in each piece."""
    return np.asarray(basis[:, 2:].any(axis=2).sum(axis=1), np.float64)


def _known(places: Array, period: float | None) -> Array:
    """Columns at right angles that span what is always part of a course."""
    courses = [np.ones_like(places), places]
    if period is not None:
        angles: Array = 2 * np.pi * places / period
        courses += [np.sin(angles), np.cos(angles)]
    return np.asarray(np.linalg.qr(np.stack(courses, axis=1))[0], np.float64)


def _chosen(values: Array, known: Array, ramps: Array, noise: float) -> tuple[list[Indexes], Array]:
    """Which ramp each piece takes at each step, -1 for none, and the squares that are left."""
    count = values.shape[1]
    ramps = np.asarray(ramps - known @ (np.transpose(known) @ ramps), np.float64)
    rest: Array = values - (values @ known) @ np.transpose(known)
    squares: Array = np.einsum("ij,ij->i", rest, rest)
    along: Array = rest @ ramps
    lengths: Array = np.tile(np.einsum("ij,ij->j", ramps, ramps), (len(values), 1))
    shortest = _TINY * lengths.max()
    steps: list[Indexes] = []
    taken: list[Array] = []
    each = np.arange(len(values))
    while len(steps) < MOST_HINGES:
        gains = np.where(lengths > shortest, along**2 / np.maximum(lengths, shortest), 0.0)
        at = gains.argmax(axis=1)
        gain = gains[each, at]
        left = np.maximum(squares - gain, _TINY * squares)
        worth = squares > left * count ** (PARAMETERS / count)
        worth &= gain > (CERTAIN_HINGE * noise) ** 2
        if not worth.any():
            break
        step = _of_length_one(_beside(np.transpose(ramps[:, at]), taken)) * worth[:, None]
        share: Array = step @ ramps
        along -= share * np.einsum("ij,ij->i", step, rest)[:, None]
        lengths -= share**2
        squares = np.where(worth, left, squares)
        taken.append(step)
        steps.append(np.where(worth, at, -1))
    return steps, squares


def _beside(courses: Array, others: list[Array]) -> Array:
    """What is left of the courses at right angles to others of length 1."""
    for other in others:
        courses = courses - np.einsum("ij,ij->i", courses, other)[:, None] * other
    return courses


def _of_length_one(courses: Array) -> Array:
    lengths: Array = np.sqrt(np.einsum("ij,ij->i", courses, courses))
    return courses / np.maximum(lengths, np.finfo(np.float64).tiny)[:, None]
