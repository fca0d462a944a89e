"""Medians and noise of many values equal those that sorting all of them gives."""

from __future__ import annotations

import numpy as np
import pytest

from webots_mcp.analysis.arrays import in_order, median, noise_of

_MANY = 60_001


def _drawn() -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    rows = np.arange(_MANY)
    return {
        "noise": random.normal(size=_MANY),
        "rounded": np.round(random.normal(size=_MANY), 1),
        "one value": np.zeros(_MANY),
        "two values": (rows % 2) * 1.0,
        "a ramp": rows * -0.5,
        "two levels": np.where(rows < _MANY // 2, 0.0, 1e6 + random.normal(size=_MANY)),
        "swings as long as the sample's steps": np.sin(rows * (2 * np.pi / (_MANY // 4096))),
    }


@pytest.mark.parametrize("name", _drawn())
@pytest.mark.parametrize("rows", [1, 2, 7, 1000, _MANY - 1, _MANY])
def test_a_median_is_the_middle_of_the_sorted_values(name: str, rows: int):
    values = _drawn()[name][:rows]
    ordered = np.sort(values)
    assert median(values) == (ordered[(rows - 1) // 2] + ordered[rows // 2]) / 2
    assert in_order(values, rows // 4) == ordered[rows // 4]


def test_noise_of_many_values_is_that_of_all_fourth_differences():
    values = np.cumsum(np.random.default_rng(2).normal(size=_MANY))
    sizes = np.sort(np.abs(np.diff(values, 4)))
    middle = (sizes[(len(sizes) - 1) // 2] + sizes[len(sizes) // 2]) / 2
    assert noise_of(values) == pytest.approx(middle / (0.6745 * 70**0.5), rel=1e-15)
