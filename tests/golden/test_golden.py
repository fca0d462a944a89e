"""What each question answers of nine recordings is what was accepted."""

from __future__ import annotations

import pytest

from tests.golden.drawing import KINDS
from tests.golden.stored import answers_of, difference


@pytest.mark.parametrize("name", KINDS)
def test_every_answer_is_the_accepted_one(name: str) -> None:
    found = difference(name, answers_of(name))
    assert not found, f"{found}\n(after a look at each: python -m tests.golden --accept {name})"
