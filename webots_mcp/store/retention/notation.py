"""Limits as a person writes them: `500MB,30d`, `100000rows`, `all`."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.store.retention.policy import Limit

_PART: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z]+)", re.IGNORECASE)
_BYTES: Final = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_SECONDS: Final = {"s": 1, "min": 60, "h": 3600, "d": 86_400, "w": 604_800}
NO_LIMIT: Final = "all"  # is kept
_OPTIONS: Final = {"kept_state": "--keep-stretches", "unshipped": "--keep-until-shipped"}
_ROWS: Final = {"row": 1, "rows": 1}


def option_of(kind: str) -> str:
    """The option of the command line that limits a kind of row."""
    return _OPTIONS.get(kind, f"--keep-{kind}s")


def parse_limit(text: str, default: Limit) -> Limit:
    """A limit from its parts, separated by commas; what is not named has no limit.

    Args:
        text: Sizes (kB, MB, GB), ages (min, h, d, w) and rows; or `all`, without any limit.
        default: What a current run is spared comes from here.

    Raises:
        InvalidInputError: A part is none of these, or named twice.
    """
    limit: dict[str, Any] = {"size_bytes": None, "rows": None, "age_s": None}
    for part in [] if text.strip().lower() == NO_LIMIT else text.split(","):
        name, value = _parse_part(part.strip(), text)
        if limit[name] is not None:
            raise InvalidInputError(f"{text!r} limits the same thing twice")
        limit[name] = value
    return replace(default, **limit)


def _parse_part(part: str, text: str) -> tuple[str, float]:
    found = _PART.fullmatch(part)
    if found is not None:
        number, unit = float(found[1]), found[2].lower()
        if unit in _BYTES:
            return "size_bytes", round(number * _BYTES[unit])
        if unit in _SECONDS:
            return "age_s", number * _SECONDS[unit]
        if unit in _ROWS:
            return "rows", round(number)
    raise InvalidInputError(
        f"{part!r} in {text!r} is not a limit: write a size (500MB), an age (30d), a number of "
        f"rows (100000rows), several of them with commas between, or {NO_LIMIT} to keep everything"
    )


def limit_text(limit: Limit) -> str:
    """A limit as `parse_limit` reads it; a size is rounded."""
    parts = [size_text(limit.size_bytes)] if limit.size_bytes is not None else []
    parts += [f"{limit.age_s:g}s"] if limit.age_s is not None else []
    parts += [f"{limit.rows}rows"] if limit.rows is not None else []
    return ",".join(parts) or NO_LIMIT


def size_text(size_bytes: float) -> str:
    """A size as a person reads it, in the units that `parse_limit` takes."""
    for unit in ("B", "kB", "MB"):
        if size_bytes < 1000:
            return f"{size_bytes:.0f} {unit}" if unit == "B" else f"{size_bytes:.1f} {unit}"
        size_bytes /= 1000
    return f"{size_bytes:.2f} GB"
