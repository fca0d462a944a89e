from __future__ import annotations

from collections import Counter

import pytest

from tests.faults.listed import ROOT, Fault, listed_faults

FAULTS = listed_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_listed_fault_can_still_be_put_into_the_code(fault: Fault) -> None:
    sound = (ROOT / fault.file).read_text("utf-8") if (ROOT / fault.file).exists() else ""
    faulty = fault.text_in(ROOT)
    if fault.file.endswith(".py"):
        compile(faulty, fault.file, "exec")
    assert faulty != sound


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_tests_that_catch_a_listed_fault_are_there(fault: Fault) -> None:
    for test in fault.caught_by:
        file, *names = test.split("::")
        text = (ROOT / file).read_text("utf-8")
        assert all(f"def {name}(" in text or f"class {name}" in text for name in names)


def test_no_two_listed_faults_have_the_same_name() -> None:
    assert [
        name for name, count in Counter(fault.name for fault in FAULTS).items() if count > 1
    ] == []
