"""Checks of each link between a controller and its client, and how they are run.

A check is one function of what is `Examined` that yields each `Diagnosis`, declared by
`@check(NAME)` in one of the modules of this package. What it finds is explained in
the page troubleshooting, under a heading of its name. A diagnosis changes nothing.
"""

from __future__ import annotations

import sqlite3
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from webots_mcp.contract import PROJECT_DATA_FOLDER
from webots_mcp.database.files import full_path
from webots_mcp.database.transactions import is_damage, text_of
from webots_mcp.errors import WebotsMCPError
from webots_mcp.store.recording import RecordingAccess, RobotView, view_of
from webots_mcp.store.robots import list_robots

if TYPE_CHECKING:
    from webots_mcp.simulator.instances import Instance

Verdict = Literal["ok", "warning", "wrong", "not checked"]
_WORST_FIRST: Final[tuple[Verdict, ...]] = ("wrong", "warning", "not checked", "ok")
PAGE: Final = "troubleshooting"  # of the documentation
# From the controller's machine to the client; within a module the order is that of its functions.
_IN_ORDER: Final = (
    "machine_checks", "recording_checks", "controller_checks", "simulation_check", "webots_checks",
)  # fmt: skip


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and how to fix it if something is wrong."""

    verdict: Verdict
    seen: str
    fix: str | None = None


def ok(seen: str) -> Diagnosis:
    """Nothing is to be fixed."""
    return Diagnosis("ok", seen)


def warning(seen: str, fix: str) -> Diagnosis:
    """It may be as it should be."""
    return Diagnosis("warning", seen, fix)


def wrong(seen: str, fix: str) -> Diagnosis:
    """It has to be fixed."""
    return Diagnosis("wrong", seen, fix)


def unclear(seen: str) -> Diagnosis:
    """It could not be checked, and why."""
    return Diagnosis("not checked", seen)


@dataclass(frozen=True)
class Examined:
    """What is checked.

    Attributes:
        recording: Read only: a diagnosis changes nothing.
        chosen_by: The rule that chose its folder.
        project: The folder that is searched for the files of clients.
        connection: To the recording; None where it cannot be read.
        unread: Why it cannot be read.
        server: The command that starts this package's own server.
        probes_python: A person asks: the Python of controllers may be started, which files of the
            project name.
    """

    recording: RecordingAccess
    chosen_by: str
    project: Path
    connection: sqlite3.Connection | None = None
    unread: WebotsMCPError | None = None
    server: Sequence[str] = (sys.executable, "-m", "webots_mcp", "serve", "--read-only")
    probes_python: bool = False
    now_s: float = field(default_factory=time.time)

    @property
    def file(self) -> Path | None:
        """The database's file; None for one in memory."""
        return self.recording.database if isinstance(self.recording.database, Path) else None

    @property
    def opened(self) -> sqlite3.Connection:
        """The connection, for a check that needs the recording."""
        assert self.connection is not None
        return self.connection

    @cached_property
    def views(self) -> list[RobotView]:
        """All robots that were ever seen."""
        robots = list_robots(self.opened, self.now_s)
        return [view_of(self.opened, robot, self.now_s) for robot in robots]

    @cached_property
    def live(self) -> list[RobotView]:
        """The robots whose controllers live."""
        return [view for view in self.views if view.robot.live]

    @cached_property
    def running_webots(self) -> list[Instance]:
        """The Webots that run on this machine."""
        from webots_mcp.simulator.instances import instances

        return instances()


@dataclass(frozen=True)
class DoctorCheck:
    """A link of the chain.

    Attributes:
        name: In one word or a few; the heading of its part of the page.
        run: Yields what it finds.
        well: What is seen where it finds nothing.
        needs_recording: Skip the check without a readable recording.
        starts_process: It takes seconds: a server does not ask it of itself.
    """

    name: str
    run: Callable[[Examined], Iterator[Diagnosis]]
    well: str = ""
    needs_recording: bool = False
    starts_process: bool = False

    @property
    def page(self) -> str:
        """The command that prints the section of the documentation about it."""
        return f"webots-mcp help {PAGE} {self.name.lower().replace(' ', '-')}"


class Checked(NamedTuple):
    """A check and what it found."""

    check: DoctorCheck
    finding: Diagnosis

    @property
    def is_well(self) -> bool:
        """Whether there is nothing to fix."""
        return self.finding.verdict == "ok"


def check(
    name: str, **options: Any
) -> Callable[[Callable[[Examined], Iterator[Diagnosis]]], DoctorCheck]:
    """Declare a function as a check; a `DoctorCheck` has the options."""
    return lambda run: DoctorCheck(name, run, **options)


def all_checks(*, with_server: bool = False) -> list[DoctorCheck]:
    """Return all that the modules declare, in the order of the chain.

    Args:
        with_server: Those as well that start a process of their own.
    """
    modules = [import_module(f"{__package__}.{name}") for name in _IN_ORDER]
    declared = [each for module in modules for each in vars(module).values()]
    checks = [each for each in declared if isinstance(each, DoctorCheck)]
    return [each for each in checks if with_server or not each.starts_process]


def worst(findings: Sequence[Diagnosis]) -> Diagnosis:
    """Several findings of one check as one; what is well is left out where something is not."""
    verdict = _WORST_FIRST[min(_WORST_FIRST.index(finding.verdict) for finding in findings)]
    shown = [finding for finding in findings if verdict == "ok" or finding.verdict != "ok"]
    fixes = list(dict.fromkeys(finding.fix for finding in shown if finding.fix))
    seen = "; ".join(dict.fromkeys(finding.seen for finding in shown))
    return Diagnosis(verdict, seen, "; ".join(fixes) or None)


def last_seen_s(view: RobotView) -> float:
    """Return when a robot last gave a sign of life, Unix time."""
    seen_s = view.robot.last_seen_wall_time_s
    return max(seen_s, view.session.last_seen_wall_time_s) if view.session else seen_s


def diagnose(subject: Examined, checks: Sequence[DoctorCheck] | None = None) -> list[Checked]:
    """Run the checks, all but those that start a process; what cannot be checked says why."""
    with ExitStack() as stack:
        try:
            connection = stack.enter_context(subject.recording.reader())
            subject = replace(subject, connection=connection)
        except WebotsMCPError as error:
            subject = replace(subject, unread=error)
        return [Checked(each, _run_check(each, subject)) for each in checks or all_checks()]


def _run_check(check: DoctorCheck, subject: Examined) -> Diagnosis:
    """Run one check; one that fails reports that, and the others still run."""
    if check.needs_recording and subject.connection is None:
        return unclear("there is no recording that can be read")
    try:
        return worst(list(check.run(subject)) or [ok(check.well)])
    except ModuleNotFoundError as error:
        return unclear(f"the Python package {error.name!r} is missing")
    except Exception as error:  # noqa: BLE001  (it is reported)
        if is_damage(error):
            fix = (
                "stop what records there, save rows with 'sqlite3 FILE .recover', and move the "
                "file away"
            )
            return wrong(f"the database is damaged: {text_of(error)}", fix)
        return unclear(f"{type(error).__name__}: {error}")


def subject_of(recording: RecordingAccess, chosen_by: str) -> Examined:
    """Return what is checked of a recording: also the folder that the asker is in."""
    return Examined(replace(recording, read_only=True), chosen_by, _project(recording))


def _project(recording: RecordingAccess) -> Path:
    """Return the folder above `mcp_data/`, else the current one."""
    folder = full_path(recording.data_dir)
    return folder.parent if folder.name == PROJECT_DATA_FOLDER else Path.cwd()
