"""Ranges of parameters in a plan: what a search may try of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, cast

from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import nearest_first

_STEPS_TOLERANCE: Final = 1e-9


@dataclass(frozen=True)
class Range:
    """What may be tried of one parameter: the numbers of a range, or one of some choices.

    Attributes:
        low: The least number.
        high: The greatest number.
        step: Only so many more than `low` are tried; where both are whole, whole numbers.
        log: Numbers are spread evenly over orders of magnitude.
        choices: Instead of numbers.
    """

    low: float | None = None
    high: float | None = None
    step: float | None = None
    log: bool = False
    choices: list[Any] | None = None

    def __post_init__(self) -> None:
        if self.choices is not None:
            return self._require_choices()
        if self.low is None or self.high is None:
            raise InvalidInputError("it needs low and high, or choices")
        if not -math.inf < self.low < self.high < math.inf:
            raise InvalidInputError(f"low={self.low} must be less than high={self.high}")
        if self.log and self.low <= 0:
            raise InvalidInputError(f"low={self.low} must be above 0 with log = true")
        if self.step is not None:
            self._require_steps(self.low, self.high, self.step)

    @property
    def is_whole(self) -> bool:
        """Whether only whole numbers are tried."""
        return isinstance(self.low, int) and isinstance(self.step, int)

    def _require_choices(self) -> None:
        if (self.low, self.high, self.step, self.log) != (None, None, None, False):
            raise InvalidInputError("choices stand alone, without low, high, step and log")
        choices = self.choices
        if not choices or not all(isinstance(each, (int, float, str)) for each in choices):
            raise InvalidInputError("choices must be an array of numbers, flags or texts")
        if len({repr(each) for each in choices}) < len(choices):
            raise InvalidInputError("the same choice is given twice")

    def _require_steps(self, low: float, high: float, step: float) -> None:
        if not 0 < step < math.inf:
            raise InvalidInputError(f"step={step} must be a number above 0")
        if self.log and not (self.is_whole and step == 1):
            raise InvalidInputError("log and step go together only as whole numbers with step = 1")
        steps = round((high - low) / step)
        if steps < 1 or not math.isclose(low + steps * step, high, rel_tol=_STEPS_TOLERANCE):
            raise InvalidInputError(f"high={high} must be a number of steps={step} above low={low}")


def read_ranges(tables: dict[str, Any]) -> dict[str, Range]:
    """The ranges of `[ranges]` in a plan.

    Raises:
        InvalidInputError: One is none; the text names it.
    """
    if not tables:
        raise InvalidInputError("[ranges] names no parameter")
    return {name: _range_of(name, table) for name, table in tables.items()}


def _range_of(name: str, table: Any) -> Range:
    try:
        if not isinstance(table, dict):
            raise InvalidInputError("write { low = 0.5, high = 10.0 } or { choices = [...] }")
        found = cast("dict[str, Any]", table)
        require_kinds(found, _KINDS)
        return Range(**found)
    except InvalidInputError as error:
        raise InvalidInputError(f"[ranges] {name}: {error}") from error


def require_kinds(table: dict[str, Any], kinds: Mapping[str, Any]) -> None:
    """See that a table of a plan has only keys that are known, with values of their kinds.

    Raises:
        InvalidInputError: It has others.
    """
    for key, value in table.items():
        if key not in kinds:
            near = ", ".join(nearest_first(key, list(kinds))[:3])
            raise InvalidInputError(f"unknown {key!r}; there is {near}")
        if not isinstance(value, kinds[key]) or (
            isinstance(value, bool) and kinds[key] is not bool
        ):
            raise InvalidInputError(f"{key}={value!r} is a {type(value).__name__}")


def as_plain(ranges: dict[str, Range]) -> dict[str, Any]:
    """In JSON's terms, without what is not given."""
    return {
        name: {key: value for key, value in asdict(each).items() if value not in (None, False)}
        for name, each in ranges.items()
    }


_NUMBER: Final = (int, float)
_KINDS: Final[dict[str, Any]] = {
    "low": _NUMBER, "high": _NUMBER, "step": _NUMBER, "log": bool, "choices": list,
}  # fmt: skip
