"""Each kind of fault is noticed by its check, and nothing fails in healthy runs."""

from __future__ import annotations

import pytest

from tests.checks.judging import HEALTHY, checked, judge, render
from webots_mcp.store.checks import CHECKS

pytestmark = pytest.mark.slow


def test_each_fault_is_noticed_by_its_check_and_no_check_fails_in_50_healthy_runs() -> None:
    judged = judge(50, 3)
    table = render(judged)
    healthy = judged.pop(HEALTHY)
    assert healthy.wrong == [], table
    assert {kind: each.noticed for kind, each in judged.items()} == {
        kind: each.runs for kind, each in judged.items()
    }, table
    assert {each.checked_by for each in judged.values()} >= {
        check.name for check in CHECKS if check.name != "keeps expectations"
    }


def test_what_the_deadline_leaves_unread_is_not_looked_at_and_never_passes() -> None:
    found = checked("healthy", 0, deadline_s=0.0)
    assert not [each for each in found if each.outcome == "pass" and each.name in OF_VALUES]
    assert {each.outcome for each in found if each.name in OF_VALUES} == {"not looked at"}


OF_VALUES = {
    check.name for check in CHECKS
    if (check.of_values or "stuck" in check.kinds) and check.name != "keeps expectations"
}  # fmt: skip
