"""Answers whose worth is known get the figures that they deserve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.judging.detection.asking import Claim
from tests.judging.detection.goals import missed_goals
from tests.judging.detection.judging import Tally, judge
from tests.judging.detection.labelled import Incident

STOPS = (Incident("standstill", 10.0, 20.0), Incident("standstill", 40.0, 50.0))


def stand(start_s: float, end_s: float) -> Claim:
    return Claim("standstill", 1, start_s, end_s)


def tally(*verdicts: object, admitted: bool = False) -> Tally:
    found = Tally()
    for verdict in verdicts:
        found.add(verdict, 2.0, 0.1, admitted=admitted)  # pyright: ignore[reportArgumentType]
    return found


SHORT = (replace(STOPS[0], optional=True),)
# What happened, what is told of it, and how much of that is found, missed and false.
TOLD = [
    (STOPS, [(10, 20), (40.1, 49.8)], (2, 0, 0)),
    (STOPS, [(10, 20), (70, 80)], (1, 1, 1)),
    (STOPS[:1], [(10, 14), (14.2, 16), (16.2, 18), (18.2, 20)], (1, 0, 3)),
    (STOPS, [(0, 600)], (0, 2, 1)),
    *((SHORT, told, (0, 0, 0)) for told in ([], [(10, 20)], [(10, 13), (15, 20)])),
]


@pytest.mark.parametrize(("happened", "told", "counts"), TOLD)
def test_what_is_told_is_found_or_false_and_the_rest_is_missed(
    happened: Sequence[Incident], told: list[tuple[float, float]], counts: tuple[int, int, int]
) -> None:
    verdict = judge(happened, [stand(*each) for each in told], 0.1)
    found = tally(verdict)
    assert (found.found, found.incidents - found.found, verdict.false) == counts
    goals = ["recall"] * (counts[1] > 0) + ["precision"] * (counts[2] > 0)
    assert missed_goals(("drive", "standstill", ""), found) == goals


def test_ten_dropouts_told_as_one_count_as_the_ten_that_they_are() -> None:
    drops = [Incident("dropout", at, at, "ir") for at in range(10)]
    told = Claim("dropout", 1, 0.0, 9.0, "ir", count=10)
    assert len(judge(drops, [told], 0.1).found) == 10
    assert judge(drops, [replace(told, count=12)], 0.1).false == 2
    assert len(judge(drops, [replace(told, count=8)], 0.1).missed) == 2
    assert not judge(drops, [replace(told, name="front")], 0.1).found


def test_a_swing_that_a_gap_cuts_in_two_may_be_told_twice() -> None:
    swing = Incident("swing", 10, 40, "heading", 2.0, 0.2, split=True)
    claim = Claim("swing", 1, 10, 20, "heading", 2.1, 0.18)
    verdict = judge([swing], [claim, replace(claim, start_s=26, end_s=40)], 0.1)
    assert len(verdict.found) == 1 and verdict.false == 0
    found = tally(verdict)
    assert found.period_errors == pytest.approx([0.05])
    assert found.amplitude_errors == pytest.approx([0.1])
    assert judge([replace(swing, split=False)], [claim, replace(claim)], 0.1).false == 1


def test_a_begin_that_noise_hides_is_judged_by_what_can_be_known_of_it() -> None:
    late = [stand(10.5, 20), stand(40.5, 50)]
    hidden = [replace(each, begin_error_s=0.8) for each in STOPS]
    assert missed_goals(("drive", "standstill", ""), tally(judge(STOPS, late, 0.1))) == ["begin"]
    assert missed_goals(("drive", "standstill", ""), tally(judge(hidden, late, 0.1))) == []
