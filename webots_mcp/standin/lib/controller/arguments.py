"""What `ctypes` makes of arguments in the real package: the same types, the same refusals."""

from __future__ import annotations

import ctypes
from typing import Any


def integer(value: Any) -> int:
    """An `int` argument; everything else is refused, `32.0` too."""
    if not isinstance(value, int):
        raise ctypes.ArgumentError(
            f"argument 1: TypeError: an int is needed, not {type(value).__name__} {value!r}"
        )
    return value


def number(value: Any) -> float:
    """A `double` argument: any number, no text."""
    return ctypes.c_double(value).value


def text(value: Any) -> str:
    """A `char *` argument: `str` only, no path objects, no None."""
    if not isinstance(value, str):
        raise TypeError(f"a text has to be str, not {type(value).__name__}")
    return value
