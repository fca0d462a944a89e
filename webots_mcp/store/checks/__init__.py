"""Checks of a run: is it well? What each looks at, what it found, and what it could not see."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from webots_mcp.conditions.expectation import Expectation
from webots_mcp.errors import UnknownSignalError
from webots_mcp.store.checks import of_motion, of_run, of_sensors
from webots_mcp.store.checks.finding import (
    WORST_FIRST,
    Check,
    Finding,
    Outcome,
    RunUnderCheck,
    outcome_of,
)
from webots_mcp.store.detection import jump, sensors
from webots_mcp.store.detection.events import Found, asked_kinds, search_events
from webots_mcp.store.detection.expectation import expectations_of
from webots_mcp.store.detection.kinds import EventOptions, NotSearchableError
from webots_mcp.store.detection.search import Search
from webots_mcp.store.project_file import ALL, Expected
from webots_mcp.store.questions.runs import run_info
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.ranges import TimeRange, whole_run
from webots_mcp.store.reading.segment import Deadline, Segment, Subject, in_one_snapshot
from webots_mcp.store.run_rows import fetch_run

CHECK_DEADLINE_S: Final = 8.0
_OF_EVENTS: Final = 0.7  # of the time

# A new check is a function and a line here: question, command, report, page and docs read it.
_MOVES: Final = "the position; a commanded speed, speeds of wheels, or a mode"
_AIMS: Final = "a target beside its measurement: `arm.target`, `arm.position`"
_TWO: Final = "two positions of the robot, such as gps and odometry"
_JUMP, _FLAT = (jump.JUMP.name,), (sensors.FLAT.name,)
CHECKS: Final[list[Check]] = [
    Check("moves when commanded", of_motion.moves_when_commanded, _MOVES, ("stuck", "standstill")),
    Check("follows its targets", of_motion.follows_targets, _AIMS, of_values=True),
    Check("wheels grip", of_motion.wheels_grip, "a position; speeds of wheels", of_values=True),
    Check("estimates agree", of_motion.estimates_agree, _TWO, of_values=True),
    Check("stays in place", of_motion.stays_in_place, "the position", _JUMP),
    Check("sensors speak", of_sensors.sensors_speak, "numbers", ("missing",), of_values=True),
    Check("sensors live", of_sensors.sensors_live, "numbers", _FLAT, of_values=True),
    Check("sensors within limits", of_sensors.sensors_within_limits, "numbers", of_values=True),
    Check("sensors drop nothing", of_sensors.sensors_drop_nothing, "numbers", _JUMP),
    Check("keeps pace", of_run.keeps_pace, "rows", of_values=True),
    Check("misses no steps", of_run.misses_no_steps, "rows", ("gap",), of_values=True),
    Check("logs no errors", of_run.logs_no_errors, "", ("log",)),
    Check("ends well", of_run.ends_well, ""),
    Check("loses no rows", of_run.loses_no_rows, "", ("bridge_event",)),
    Check("reaches its goal", of_run.reaches_goal, "a run command with a condition in `until`"),
    Check("keeps expectations", of_run.keeps_expectations, "expectations", of_values=True),
]


@dataclass(frozen=True)
class CheckedRun:
    """What became of each check of a run.

    Attributes:
        findings: With their names, in the order of `CHECKS`.
    """

    run_id: int
    robot: str
    findings: tuple[Finding, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of all; a check that could not be made shows nothing."""
        there = {each.outcome for each in self.findings}
        return next(each for each in WORST_FIRST if each in there)

    @property
    def worst_first(self) -> list[Finding]:
        """All of them."""
        return sorted(self.findings, key=lambda each: WORST_FIRST.index(each.outcome))

    def of(self, *outcomes: Outcome) -> list[Finding]:
        """Those that came out so."""
        return [each for each in self.findings if each.outcome in outcomes]


@in_one_snapshot
def check_run(
    connection: sqlite3.Connection,
    run_id: int,
    *,
    expect: Sequence[Expectation] = (),
    project: Sequence[Expected] | None = None,
    found: Found | None = None,
    deadline_s: float = CHECK_DEADLINE_S,
) -> CheckedRun:
    """Make all checks of a run.

    Args:
        connection: Any.
        run_id: The run.
        expect: What is expected besides what the run's controller and its project expect.
        project: What its project's file says; None for what of it was compiled last.
        found: All events of the whole run, each by itself, where they are known already.
        deadline_s: What was not looked at by then is said so, and does not pass.

    Raises:
        UnknownRunError, UnknownSignalError: As they say.
    """
    run = _under_check(connection, run_id, found, deadline_s)
    for each in expect:
        if not each.asks_missing and (unknown := each.violation.describe_unknown(run.search.known)):
            raise UnknownSignalError("; ".join(unknown))
    expected = expectations_of(connection, run_id, of_project=project is None)
    here = (ALL, run.info.robot)
    expected += [each.expectation for each in project or () if each.robot in here]
    expected += expect
    run.expected = list({each.asks: each for each in expected}.values())
    findings = [found for check in CHECKS for found in findings_of(check, run)]
    return CheckedRun(run_id, run.info.robot, tuple(findings))


def _under_check(
    connection: sqlite3.Connection, run_id: int, found: Found | None, deadline_s: float
) -> RunUnderCheck:
    import_module("numpy")  # once per process, before the time counts
    robot_id, info = fetch_run(connection, run_id).robot_id, run_info(connection, run_id)
    whole = Segment(run_id, -math.inf, math.inf, open_start=True, open_end=True)
    segment = whole_run(connection, run_id) or whole
    kinds = tuple(dict.fromkeys(kind for check in CHECKS for kind in check.kinds))
    wanted, deadline = EventOptions(kinds), Deadline(deadline_s)
    found = found or search_events(
        connection,
        TimeRange(robot_id, info.robot, (segment,), "simulation"),
        wanted,
        around=(),
        group=False,
        deadline_s=_OF_EVENTS * deadline_s,
    )
    known = catalogue(connection, Subject(robot_id, info.robot, run_id))
    search = Search(connection, segment, known, asked_kinds(wanted), wanted, deadline)
    return RunUnderCheck(info, robot_id, found, search)


def findings_of(check: Check, run: RunUnderCheck) -> list[Finding]:
    """What a check finds; it does not pass on what could not be looked at."""
    try:
        run.require(check)
        made = check.find(run)
        found = [made] if isinstance(made, Finding) else list(made)
        if unread := run.unread(check):
            for at, (outcome, evidence, *_) in enumerate(found):
                if outcome not in ("fail", "warn"):
                    said = unread + f"; {evidence}" * (outcome == "pass")
                    found[at] = found[at]._replace(outcome="not looked at", evidence=said)
    except NotSearchableError as error:
        found = [Finding(outcome_of(str(error)), str(error))]
    return [each if each.name else each._replace(name=check.name) for each in found]
