"""No fault is denied, or told at another time, because of the rate of rows or the noise."""

from __future__ import annotations

from itertools import product

import pytest

from tests.cases.rates import FAULTS, INTERVALS_S, NOISES, NOT_SEARCHED, RIGHT, answer

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", FAULTS)
def test_it_is_found_at_every_rate_and_noise_or_said_not_to_be_searchable(name: str) -> None:
    answers = {each: answer(name, *each) for each in product(INTERVALS_S, NOISES)}
    wrong = {each: said for each, said in answers.items() if said not in (RIGHT, NOT_SEARCHED)}
    assert wrong == {}
    assert answers[INTERVALS_S[1], NOISES[1]] == RIGHT
