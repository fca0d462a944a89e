"""Each healthy robot passes without an alarm, and each problem is answered as an expert would."""

from __future__ import annotations

import pytest

from tests.cases import healthy_robots, problems
from tests.cases.situations import HEALTHY, PROBLEMS, Situation, failures

_MODULES = (healthy_robots, problems)  # which fill the registries


def _cases(registry: dict[str, Situation]) -> list[object]:
    return [
        pytest.param(
            each,
            id=each.name,
            marks=pytest.mark.xfail(reason=each.known_gap, strict=True) if each.known_gap else (),
        )
        for each in registry.values()
    ]


@pytest.mark.parametrize("each", _cases(HEALTHY))
def test_no_alarm_is_raised_where(each: Situation) -> None:
    assert failures(each) == []


@pytest.mark.parametrize("each", _cases(PROBLEMS))
def test_it_is_answered_that(each: Situation) -> None:
    assert failures(each) == []
