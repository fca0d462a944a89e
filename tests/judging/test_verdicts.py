"""What is said of a kind of event or of a check follows from what could be judged."""

from __future__ import annotations

import pytest

from webots_mcp.judging.verdicts import (
    Coverage,
    Fault,
    JudgedInterval,
    SearchCoverage,
    outcome_of,
    reasons_of_runs,
)
from webots_mcp.signals.meaning import Source

A_MINUTE = JudgedInterval(1, 0.0, 57.0)


def test_a_pass_names_what_was_judged_for_how_long_and_by_which_limit() -> None:
    covered = Coverage(intervals=[A_MINUTE], judged="2 wheels against gps", limit="slip limit 50 %")
    assert outcome_of(covered, {}) == ("pass", "2 wheels against gps for 57 s, slip limit 50 %")


def test_a_check_that_could_judge_nothing_does_not_pass() -> None:
    assert outcome_of(Coverage(says="all is well"), {})[0] == "not applicable"
    assert outcome_of(Coverage.lacking("no position"), {}) == ("not applicable", "no position")
    undecided = Coverage.lacking("nothing decides it", "undecided")
    assert outcome_of(undecided, {}) == ("not judged", "nothing decides it")
    unread = "not read from 1.000 to 2.000 s: the chunk is damaged"
    assert outcome_of(Coverage.lacking(unread), {}) == ("not looked at", unread)


def test_a_check_that_judged_a_part_passes_unless_the_rest_was_not_read_or_is_undecided() -> None:
    made = {}
    for cause in ("absent", "undecided", "unread"):
        covered = Coverage(intervals=[A_MINUTE])
        covered.note_missing("some reason", cause)
        made[cause] = outcome_of(covered, {})[0]
    assert made == {"absent": "pass", "undecided": "not judged", "unread": "not looked at"}


@pytest.mark.parametrize(
    ("source", "outcomes"),
    [
        ("declared", ("warn", "fail")),
        ("device", ("warn", "fail")),
        ("named", ("warn", "fail")),
        ("behaviour", ("warn", "warn")),
        ("unknown", ("not judged", "not judged")),
    ],
)
def test_a_fault_is_as_firm_as_what_is_known_of_its_signals(
    source: Source, outcomes: tuple[str, str]
) -> None:
    faults = [Fault(each, "it is off", signals=("u", "v")) for each in ("warn", "fail")]
    sources: dict[str, Source] = {"u": source, "v": "declared"}
    assert tuple(outcome_of(each, sources)[0] for each in faults) == outcomes


def test_only_a_kind_that_was_judged_somewhere_is_not_found() -> None:
    search = SearchCoverage()
    search.of("gap").intervals.append(A_MINUTE)
    search.not_searched("stuck", "no position is known")
    search.of("jump")
    told = search.verdicts(["gap", "stuck", "jump"], {})
    assert (told.far, told.not_searched) == (["gap"], {"stuck": "no position is known"})
    assert not told.knows("jump")


def test_what_many_runs_lack_is_said_once_with_the_runs_and_the_range_of_their_numbers() -> None:
    lasted = {2: "11.9", 3: "7.95", 4: "8", 5: "9", 6: "10", 9: "8.5"}
    reasons = [
        f"run {run} lasted only {time} s; this kind needs at least 20 s"
        for run, time in lasted.items()
    ]
    other = "no position is known"
    assert reasons_of_runs([reasons[0], other, *reasons[1:]]) == [
        "runs 2-6, 9 lasted only 7.95 to 11.9 s; this kind needs at least 20 s",
        other,
    ]
    assert reasons_of_runs(reasons[:1]) == reasons[:1]
    rows = [f"run {run} has no row in that range" for run in (1, 2)]
    assert reasons_of_runs(rows) == ["runs 1-2 have no row in that range"]


def test_parts_of_one_run_that_were_not_read_stay_apart() -> None:
    parts = [
        f"not read from {at}.000 to {at + 1}.000 s: the chunk of run 1 is damaged" for at in (1, 5)
    ]
    assert reasons_of_runs(parts) == parts
