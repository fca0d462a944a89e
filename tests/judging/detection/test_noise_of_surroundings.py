"""Noise that grew because a robot went elsewhere is not taken for a sensor that fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cases.columns import Array, Random, chosen, noise
from tests.cases.situations import Columns, Recording, Situation, recorded
from webots_mcp.analysis.arrays import Flags


def _moves(t: Array, random: Random, noisier: Flags) -> dict[str, Any]:
    scatter = np.where(noisier, 0.15, 0.02)
    return {
        "gps.x": 0.6 * t + random.normal(0, 1, len(t)) * scatter,
        "gps.y": random.normal(0, 1, len(t)) * scatter,
    }


def _dives(t: Array, random: Random) -> Columns:
    depth = np.interp(t, [0, 60, 90, 160], [0, 0, 8, 8])
    return {**_moves(t, random, depth > 0.3), "depth_m": depth + noise(random, t, 0.01)}


def _takes_off(t: Array, random: Random) -> Columns:
    return {**_moves(t, random, t > 70), "mode": chosen((t > 69, "fly"), otherwise="ground")}


def _fails_under_water(t: Array, random: Random) -> Columns:
    depth = np.interp(t, [0, 5, 15, 160], [0, 0, 8, 8])
    return {**_moves(t, random, t > 90), "depth_m": depth + noise(random, t, 0.01)}


def _fails_in_one_of_many_modes(t: Array, random: Random) -> Columns:
    mode = chosen((t % 40 < 20, "scan"), otherwise="go")
    return {**_moves(t, random, t > 90), "mode": mode}


def _ask(draw: Callable[[Array, Random], Columns]) -> Recording:
    with recorded(Situation("noise", draw, (), 160, 0.05)) as asked:
        asked.events("degradation")
        assert asked.checked
        return asked


@pytest.mark.parametrize("draw", [_dives, _takes_off])
def test_noise_that_grew_in_other_surroundings_is_undecided(
    draw: Callable[[Array, Random], Columns],
) -> None:
    asked = _ask(draw)
    assert asked.events("degradation").events == ()
    (check,) = (e for e in asked.checked.findings if e.name == "sensors keep their noise")
    assert check.outcome == "not judged"
    assert "gps.x" in check.evidence


@pytest.mark.parametrize("draw", [_fails_under_water, _fails_in_one_of_many_modes])
def test_noise_that_grew_while_nothing_else_changed_is_a_fault(
    draw: Callable[[Array, Random], Columns],
) -> None:
    asked = _ask(draw)
    assert {each.name for each in asked.events("degradation").events} == {"gps.x", "gps.y"}
    (check,) = (e for e in asked.checked.findings if e.name == "sensors keep their noise")
    assert check.outcome == "warn"
