"""What `ctypes` makes of arguments in the real package: the same types, the same refusals."""

from __future__ import annotations

import ctypes
from typing import Any


def integer(value: Any, position: int = 1) -> int:
    """An `int` argument; everything else is refused, `32.0` too.

    Args:
        value: What was given.
        position: Which argument of the C function it is, for the message.
    """
    if not isinstance(value, int):
        raise ctypes.ArgumentError(
            f"argument {position}: TypeError: Don't know how to convert parameter {position}"
        )
    return value


def number(value: Any) -> float:
    """A `double` argument: any number, no text."""
    return ctypes.c_double(value).value


def numbers(values: Any, count: int) -> list[float]:
    """A `double` array argument: so many numbers at most, the rest are zeros."""
    return [*(ctypes.c_double * count)(*values)]


def text(value: Any) -> str:
    """A `char *` argument: `str` only, no path objects, no None."""
    str.encode(value)
    return value
