"""All checks of a run: the list `CHECKS`, and `check_run`, which makes them."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from webots_mcp.errors import UnknownSignalError
from webots_mcp.judging.checks import motion_checks, sensor_checks
from webots_mcp.judging.checks.check import (
    Check,
    Examined,
    Finding,
    RunUnderCheck,
)
from webots_mcp.judging.checks.whole_run_checks import (
    ends_well,
    keeps_expectations,
    keeps_pace,
    logs_no_errors,
    loses_no_rows,
    misses_no_steps,
    reaches_goal,
    understands_signals,
)
from webots_mcp.judging.detection import (
    degradation,
    fall,
    jump,
    oscillation,
    pace,
    sensors,
    slip,
    targets,
)
from webots_mcp.judging.detection.condition import (
    expectations_of,
)
from webots_mcp.judging.detection.event import NotSearchableError
from webots_mcp.judging.detection.event_kinds import asked_kinds
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import Found, search_events
from webots_mcp.judging.detection.search import Search
from webots_mcp.judging.verdicts import WORST_FIRST, Coverage, Fault, Outcome, outcome_of
from webots_mcp.signals.conditions.expectation import Expectation
from webots_mcp.signals.meaning import Source
from webots_mcp.store.project_file import ALL, Expected
from webots_mcp.store.reading.catalogue import catalogue
from webots_mcp.store.reading.ranges import TimeRange, whole_run
from webots_mcp.store.reading.segment import Deadline, Segment, Subject, in_one_snapshot
from webots_mcp.store.run_rows import fetch_run
from webots_mcp.store.runs import run_info

CHECK_DEADLINE_S: Final = 8.0
_OF_EVENTS: Final = 0.7  # of the time
_MOVES: Final = "the position; a commanded speed, speeds of wheels, or a mode"
_AIMS: Final = "a target next to its measurement: `arm.target`, `arm.position`"
_TWO: Final = "two positions of the robot, such as gps and odometry"
UNDERSTOOD: Final = "signals understood"  # never changes what the run comes to
_JUMP: Final = (jump.JUMP.name,)
_FLAT: Final = (sensors.FLAT.name,)
_OFF: Final = (targets.OFF_TARGET.name,)
_FALL: Final = (fall.FALL.name,)
_SWINGS: Final = (oscillation.OSCILLATION.name,)
_SLIP: Final = (slip.SLIP.name,)
_SLOW: Final = (pace.SLOW_SIMULATION.name,)
_NOISE: Final = (degradation.DEGRADATION.name,)
# A new check is a function and a line here: question, command, report, page and docs read it.
CHECKS: Final[list[Check]] = [
    Check(
        "moves when commanded", motion_checks.moves_when_commanded, _MOVES, ("stuck", "standstill")
    ),
    Check("rests when commanded", motion_checks.rests_when_commanded, _MOVES, of_values=True),
    Check("follows its targets", motion_checks.follows_targets, _AIMS, _OFF),
    Check("stays stable", motion_checks.stays_stable, "numbers", _SWINGS),
    Check("wheels grip", motion_checks.wheels_grip, "a position; speeds of wheels", _SLIP),
    Check("estimates agree", motion_checks.estimates_agree, _TWO, of_values=True),
    Check("stays upright", motion_checks.stays_upright, "roll and pitch", _FALL),
    Check("stays in place", motion_checks.stays_in_place, "the position", _JUMP),
    Check("sensors speak", sensor_checks.sensors_speak, "numbers", ("missing",), of_values=True),
    Check("sensors live", sensor_checks.sensors_live, "numbers", _FLAT, of_values=True),
    Check("sensors within limits", sensor_checks.sensors_within_limits, "numbers", of_values=True),
    Check("sensors drop nothing", sensor_checks.sensors_drop_nothing, "numbers", _JUMP),
    Check("sensors keep their noise", sensor_checks.sensors_keep_noise, "numbers", _NOISE),
    Check("keeps pace", keeps_pace, "rows", _SLOW, of_values=True),
    Check("misses no steps", misses_no_steps, "rows", ("gap",), of_values=True),
    Check("logs no errors", logs_no_errors, "", ("log",)),
    Check("ends well", ends_well, ""),
    Check("loses no rows", loses_no_rows, "", ("bridge_event",)),
    Check("reaches its goal", reaches_goal, "a run command with a condition in `until`"),
    Check("keeps expectations", keeps_expectations, "expectations", of_values=True),
    Check(UNDERSTOOD, understands_signals, "numbers"),
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
        """The worst of all; a check that could not be made shows nothing.

        Whether signals are understood says what could be judged, not how the run went.
        """
        there = {each.outcome for each in self.findings if each.name != UNDERSTOOD}
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
        expect: Conditions, in addition to those of the run's controller and its project.
        project: What its project's file says; None for what of it was compiled last.
        found: All events of the whole run, each by itself, where they are known already.
        deadline_s: A check that was not made by then is reported as not judged.

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
    """Return what a check comes to, by what it found and what could be judged."""
    try:
        run.require(check)
        made = check.find(run)
        examined = [made] if isinstance(made, (Fault, Coverage)) else list(made)
        if unread := run.unread(check):
            for each in examined:
                if isinstance(each, Coverage):
                    each.note_missing(unread, "unread")
    except NotSearchableError as error:
        examined = [Coverage.lacking(str(error), error.cause)]
    sources: dict[str, Source] = {name: each.source for name, each in run.meanings.items()}
    return [_finding(check, each, sources) for each in examined]


def _finding(check: Check, made: Examined, sources: Mapping[str, Source]) -> Finding:
    outcome, evidence = outcome_of(made, sources)
    name = made.subject or check.name
    since_s = made.since_s if isinstance(made, Fault) else None
    return Finding(outcome, evidence, since_s, made.often, made.more, name, tuple(made.signals))
