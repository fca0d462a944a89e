"""Summaries as arrays: what they come to is what merging them one by one comes to."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.naming import Value
from webots_mcp.store.analysis.summaries import Summaries
from webots_mcp.store.analysis.summary import Summary, merge, summarise

values = st.one_of(st.none(), st.sampled_from([0.0, 1.0, -2.5]), st.floats(-7.0, 7.0))
stretches = st.lists(st.lists(values, max_size=4), max_size=5)


def summaries_of(stretches: list[list[Value]], *, angle: bool) -> list[Summary]:
    parts: list[Summary] = []
    for place, stretch in enumerate(stretches):
        times = [4.0 * place + row for row in range(len(stretch))]
        parts.append(summarise(times, stretch, angle=angle))
    return parts


def older(part: Summary) -> Summary:
    """As a version before the largest step made it."""
    return part._replace(largest_step=None, first_until_sim_time_s=None, last_since_sim_time_s=None)


@given(stretches, st.booleans(), st.booleans())
def test_the_whole_is_that_of_merging(
    found: list[list[Value]], angle: bool, partly_older: bool
) -> None:
    parts = summaries_of(found, angle=angle)
    if partly_older:
        parts = [older(part) if place % 2 else part for place, part in enumerate(parts)]
    whole, merged = (
        [math.nan if field is None else field for field in each]
        for each in (Summaries.of(parts).whole(), merge(parts))
    )
    assert whole == pytest.approx(merged, rel=1e-12, abs=1e-12, nan_ok=True)
    assert Summaries.of(parts).as_list() == parts


@given(stretches, st.sampled_from([None, math.tau]))
def test_centres_and_variances_are_those_of_each(
    found: list[list[Value]], turn: float | None
) -> None:
    parts = [part for part in summaries_of(found, angle=turn is not None) if part.sum is not None]
    together = Summaries.of(parts)
    centres = [math.nan if (c := part.centre(turn)) is None else c for part in parts]
    assert together.centres(turn).tolist() == pytest.approx(centres, nan_ok=True, abs=1e-12)
    variances = [(part.deviation_in(turn) or 0.0) ** 2 for part in parts]
    assert together.variances(turn).tolist() == pytest.approx(variances, abs=1e-9)


@given(stretches.filter(len), st.data())
def test_groups_have_the_ends_and_the_extremes_of_all_in_them(
    found: list[list[Value]], data: st.DataObject
) -> None:
    parts = [part for part in summaries_of(found, angle=False) if part.sum is not None]
    borders = data.draw(st.sets(st.integers(1, max(1, len(parts) - 1)))) if len(parts) > 1 else ()
    starts = [0, *sorted(borders)] if parts else []
    groups = Summaries.of(parts).of_groups(np.array(starts, np.intp))
    for place, (start, end) in enumerate(pairwise([*starts, len(parts)])):
        one, whole = groups.one(place), merge(parts[start:end])
        assert (one.first_sim_time_s, one.first) == (whole.first_sim_time_s, whole.first)
        assert (one.last_sim_time_s, one.last) == (whole.last_sim_time_s, whole.last)
        assert (one.min, one.max) == (whole.min, whole.max)


@given(stretches)
def test_ends_and_extremes_are_told_once_and_in_order(found: list[list[Value]]) -> None:
    parts = summaries_of(found, angle=False)
    points = {
        (time_s, value)
        for part in parts
        for time_s, value in (
            (part.first_sim_time_s, part.first),
            (part.min_sim_time_s, part.min),
            (part.max_sim_time_s, part.max),
            (part.last_sim_time_s, part.last),
        )
        if time_s is not None and value is not None
    }
    known = np.transpose(np.stack(Summaries.of(parts).known_values())).tolist()
    assert [tuple(point) for point in known] == sorted(points)
