from __future__ import annotations

from collections import Counter

import pytest

from tests.faults.listed import ROOT, is_test, listed_faults

FAULTS = listed_faults()


@pytest.mark.parametrize("subject", sorted({fault.subject for fault in FAULTS}))
def test_listed_faults_can_still_be_put_into_the_code(subject: str) -> None:
    for fault in FAULTS:
        if fault.subject == subject:
            sound, faulty = fault.place(ROOT).read_text("utf-8"), fault.text_in(ROOT)
            if fault.file.endswith(".py"):
                compile(faulty, fault.file, "exec")
            assert faulty != sound, fault.name


def test_the_tests_that_catch_listed_faults_are_there() -> None:
    assert [test for fault in FAULTS for test in fault.caught_by if not is_test(test)] == []


def test_no_two_listed_faults_have_the_same_name() -> None:
    assert [
        name for name, count in Counter(fault.name for fault in FAULTS).items() if count > 1
    ] == []
