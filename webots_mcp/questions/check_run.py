"""Is a run well? One line for each check that did not pass, with what shows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.conditions.expectation import Expectation, read_expectation
from webots_mcp.questions.answers import CheckAnswer
from webots_mcp.questions.budget import (
    answer_about,
    cut_for_a_model,
    fitting,
    is_for_a_person,
    seconds,
    without_empty,
)
from webots_mcp.questions.declaring import READS, RobotName, RunId, question
from webots_mcp.store.checks.finding import Finding
from webots_mcp.store.checks.registry import CHECK_DEADLINE_S, CheckedRun, check_run
from webots_mcp.store.project_file import Expected, file_of, read_project
from webots_mcp.store.recording import Recording, View

CHECK_COLUMNS: Final = ("check", "outcome", "evidence", "since_s", "times", "more")
_FOR_A_PERSON_S: Final = 120.0
_LONGEST_EVIDENCE: Final = 250
_BUDGET_TOKENS: Final = 1_400


@question(
    "Check a run",
    READS,
    command="check",
    positional=("run_id",),
    options={"run_id": "RUN"},
    core=True,
    example="4 --junit check.xml",
)
def webots_check_run(
    recording: Recording,
    expect: Annotated[
        list[Annotated[str, Field(max_length=1100)]] | None,
        Field(max_length=20, description="What shall hold: front_m > 0.1 during mode == 'drive'."),
    ] = None,
    robot: RobotName = None,
    run_id: RunId = None,
) -> CheckAnswer:
    """Is this run well? Motion against commands, sensors, estimates, pace, log, end, rows, goal.

    Each check passes, warns, fails, is not applicable (what is missing) or was not looked at.
    """
    expected = [read_expectation(each) for each in expect or ()]
    file = file_of(recording.data_dir)
    project = None if file is None else read_project(file)
    with recording.view(robot, run_id) as view:
        return answer_about(view, CheckAnswer, lambda: _checked(view, expected, project))


def _checked(
    view: View, expected: Sequence[Expectation], project: Sequence[Expected] | None
) -> dict[str, Any]:
    deadline_s = _FOR_A_PERSON_S if is_for_a_person() else CHECK_DEADLINE_S
    run_id = view.require_run().id
    checked = check_run(
        view.connection, run_id, expect=expected, project=project, deadline_s=deadline_s
    )
    return told(checked)


def told(checked: CheckedRun) -> dict[str, Any]:
    """What became of the checks, the worst first; of those that passed the names."""
    others = [each for each in checked.worst_first if each.outcome != "pass"]
    rows = fitting([_row(each) for each in others], None if is_for_a_person() else _BUDGET_TOKENS)
    left = Counter(each.outcome for each in others[len(rows) :])
    counts = ", ".join(f"{count} {outcome}" for outcome, count in left.items())
    return {
        "outcome": checked.outcome,
        "checks": without_empty(CHECK_COLUMNS, rows),
        "passed": [each.name for each in checked.of("pass")] or None,
        "notes": [f"not shown: {counts}; webots-mcp check shows all"] if left else None,
    }


def _row(finding: Finding) -> list[Any]:
    return [
        finding.name,
        finding.outcome,
        cut_for_a_model(finding.evidence, _LONGEST_EVIDENCE),
        seconds(finding.since_s),
        finding.often,
        finding.more or None,
    ]
