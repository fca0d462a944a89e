"""Which curves share an axis: those of one unit whose shapes stay visible side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from webots_mcp.plotting.curves import Curve
from webots_mcp.plotting.palette import LINES

MOST_PANELS: Final = 3
MOST_CURVES: Final = len(LINES)
_LEAST_SHARE: Final = 0.07  # of the axis; a curve that moves less would look flat


@dataclass
class Panel:
    """Curves on one axis."""

    curves: list[Curve] = field(default_factory=list[Curve])

    @property
    def unit(self) -> str | None:
        """The unit of all of them."""
        return self.curves[0].unit

    @property
    def names(self) -> list[str]:
        """The signals, each once."""
        return list(dict.fromkeys(curve.name for curve in self.curves))

    def takes(self, curve: Curve) -> bool:
        """Whether it fits beside the others."""
        if len(self.curves) == MOST_CURVES or curve.unit != self.unit:
            return False
        together = [*self.curves, curve]
        height = max(each.high for each in together) - min(each.low for each in together)
        return all(_is_visible(each, height) for each in together)


def _is_visible(curve: Curve, height: float) -> bool:
    span = curve.high - curve.low
    return span == 0 or span >= _LEAST_SHARE * height


def by_scale(curves: Iterable[Curve]) -> tuple[list[Panel], list[str]]:
    """The curves of one run in at most three panels, and the names of those left out."""
    panels: list[Panel] = []
    left_out: list[str] = []
    for curve in curves:
        panel = next((panel for panel in panels if panel.takes(curve)), None)
        if panel is not None:
            panel.curves.append(curve)
        elif len(panels) < MOST_PANELS:
            panels.append(Panel([curve]))
        else:
            left_out.append(curve.name)
    return panels, left_out


def by_signal(curves: Sequence[Curve]) -> tuple[list[Panel], list[str]]:
    """The curves of several runs, one panel per signal, and the names of those left out."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    panels = [
        Panel([curve for curve in curves if curve.name == name]) for name in names[:MOST_PANELS]
    ]
    return panels, names[MOST_PANELS:]
