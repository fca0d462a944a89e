"""What is a gap in the recording, and what only another rate."""

from __future__ import annotations

from webots_mcp.analysis.arrays import Gap, rhythm_of

FAST = [round(step * 0.032, 3) for step in range(1000)]
SLOW = [round(32 + step * 0.5, 3) for step in range(60)]


def test_rows_that_come_at_a_slower_rate_for_a_while_have_no_gaps() -> None:
    assert rhythm_of([*FAST, *SLOW]).gaps == ()


def test_a_gap_within_a_slower_rate_is_one() -> None:
    assert rhythm_of([*FAST, *SLOW, 70.0, 70.5]).gaps == (Gap(SLOW[-1], 70.0),)


def test_a_few_lost_rows_one_after_the_other_are_gaps() -> None:
    assert len(rhythm_of([*FAST[:500], 16.5, 17.0, 17.5, *FAST[560:]]).gaps) == 4
