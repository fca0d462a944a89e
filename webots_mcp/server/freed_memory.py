"""Gives memory that a question has freed back to the operating system.

The C library keeps what was freed for the next question: after one about a million rows that are
hundreds of megabytes. Only glibc does so, and only glibc has a function that gives it back.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable


def give_back() -> None:
    """Give back what is free, in a few milliseconds, if a question can have taken much."""
    if "numpy" in sys.modules and (trim := _trim_of_glibc()) is not None:
        trim(0)


@functools.cache
def _trim_of_glibc() -> Callable[[int], int] | None:
    import ctypes

    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (OSError, TypeError, AttributeError):  # another C library
        return None
    return trim
