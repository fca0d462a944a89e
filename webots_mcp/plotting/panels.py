"""Which curves share an axis: those of one unit whose shapes stay visible side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from webots_mcp.plotting.curves import Curve

MOST_CURVES: Final = 5  # more bands on top of each other are mud
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

    @property
    def is_full(self) -> bool:
        """Whether another curve would be one too many."""
        return len(self.curves) == MOST_CURVES

    def suits(self, curve: Curve) -> bool:
        """Whether it has the unit and the scale of the others."""
        if curve.unit != self.unit:
            return False
        together = [*self.curves, curve]
        height = max(each.high for each in together) - min(each.low for each in together)
        return all(_is_visible(each, height) for each in together)


def _is_visible(curve: Curve, height: float) -> bool:
    interval = curve.high - curve.low
    return interval == 0 or interval >= _LEAST_SHARE * height


def by_scale(curves: Iterable[Curve], most_panels: int) -> tuple[list[Panel], list[str]]:
    """The curves of one run in at most so many panels, and the names of those left out.

    A unit or a scale that has no panel yet comes before a second panel for one that has.
    """
    panels: list[Panel] = []
    left_out: list[Curve] = []
    for curve in curves:
        suitable = [panel for panel in panels if panel.suits(curve)]
        place = next((panel for panel in suitable if not panel.is_full), None)
        if place is not None:
            place.curves.append(curve)
        elif suitable or len(panels) == most_panels:
            left_out.append(curve)
        else:
            panels.append(Panel([curve]))
    for _ in range(len(panels), most_panels):
        if left_out:
            panels.append(Panel(left_out[:1]))
            del left_out[0]
            _fill(panels[-1], left_out)
    return panels, [curve.name for curve in left_out]


def _fill(panel: Panel, waiting: list[Curve]) -> None:
    """Take from those that wait what suits."""
    for curve in tuple(waiting):
        if not panel.is_full and panel.suits(curve):
            panel.curves.append(curve)
            waiting.remove(curve)


def by_signal(curves: Sequence[Curve], most_panels: int) -> tuple[list[Panel], list[str]]:
    """The curves of several runs, one panel per signal, and the names of those left out."""
    names = list(dict.fromkeys(curve.name for curve in curves))
    panels = [
        Panel([curve for curve in curves if curve.name == name]) for name in names[:most_panels]
    ]
    return panels, names[most_panels:]
