"""numpy, imported at its first use: neither a server's start nor a summary waits for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Indexes = NDArray[np.intp]
else:
    Array = Flags = Indexes = Any

    class _AtFirstUse:
        def __getattr__(self, name: str) -> Any:
            import numpy

            setattr(self, name, getattr(numpy, name))
            return getattr(numpy, name)

    np = _AtFirstUse()

__all__ = ["Array", "Flags", "Indexes", "inner", "median", "np", "sums_of"]


def inner(one: Array, other: Array) -> float:
    """The sum of products, without the threads of `@`, which wait for each other actively."""
    return float(np.einsum("i,i->", one, other))


def median(values: Array) -> float:
    """That of at least one finite value; for few of them in a fifth of the time of numpy's."""
    below, above = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (below, above))
    return float(ordered[below] + ordered[above]) / 2


def sums_of(values: Array, rows: int) -> Array:
    """Of so many values that follow each other; put together of sums of half as many."""
    if rows == 1:
        return values
    halves = sums_of(values, rows // 2)
    sums = halves[: len(halves) - rows // 2] + halves[rows // 2 :]
    return sums[:-1] + values[rows - 1 :] if rows % 2 else sums
