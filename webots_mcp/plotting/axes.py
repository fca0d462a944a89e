"""The axes of a picture: their range of values, and the ticks on them.

Values are mapped to pixels by `AxesBox`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final


@dataclass(frozen=True)
class AxisLimits:
    """When values are drawn as constant.

    Attributes:
        rounding_span: Span relative to the largest value: less is left by the rounding of a
            constant.
        margin: Share of a constant value that is shown above and below it.
    """

    rounding_span: float = 1e-11
    margin: float = 0.05


_LIMITS: Final = AxisLimits()


@dataclass(frozen=True)
class AxesBox:
    """Axes in pixels, and the range of values on each."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    @property
    def right(self) -> float:
        """In pixels."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """In pixels."""
        return self.top + self.height

    def px(self, x: Any) -> Any:
        """Return a value, or an array of values, of the horizontal axis in pixels."""
        low, high = self.x
        return self.left + self.width * ((x - low) / (high - low))

    def py(self, y: Any) -> Any:
        """Return the same of the vertical axis."""
        low, high = self.y
        return self.bottom - self.height * ((y - low) / (high - low))


def axis_range(low: float, high: float, margin: float = 0.08) -> tuple[float, float]:
    """Return the range of an axis; values that are constant but for rounding are a flat line."""
    largest = max(abs(low), abs(high))
    middle = low / 2 + high / 2
    if high - low <= _LIMITS.rounding_span * largest:
        half = _LIMITS.margin * largest or 1.0
        return middle - half, middle + half
    half = (0.5 + margin) * (high - low)
    return middle - half, middle + half


def ticks(low: float, high: float, most: float) -> list[tuple[float, str]]:
    """Round values between two others, at most that many, with their labels."""
    least = (high - low) / max(most, 1.0)
    unit = 10.0 ** math.floor(math.log10(least))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [step * count for count in range(first, last + 1)]
    return [(value, _label(value, step, max(abs(low), abs(high)))) for value in values]


def rounded_on(value: float, bounds: tuple[float, float]) -> str:
    """Return a value as text, as exactly as it can be read from an axis of that range."""
    low, high = bounds
    step = 10.0 ** math.floor(math.log10((high - low) / 100))
    return _label(value, step, max(abs(low), abs(high), abs(value)))


def _label(value: float, step: float, largest: float) -> str:
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if largest < 1e6 and decimals <= 5:
        return f"{value:.{decimals}f}" if value else "0"
    digits = max(1, math.ceil(math.log10(largest / step) + 1e-9) + 1)
    return f"{value:.{digits}g}" if value else "0"
