"""What a check is, what it is given, and what it says."""

from __future__ import annotations

import sqlite3
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from webots_mcp.errors import WebotsMCPError
from webots_mcp.store.recording import Recording, View, view_of
from webots_mcp.store.robots import list_robots

if TYPE_CHECKING:
    from webots_mcp.webots.instances import Instance

Verdict = Literal["ok", "warning", "wrong", "not looked at"]

_WORST_FIRST: Final[tuple[Verdict, ...]] = ("wrong", "warning", "not looked at", "ok")
PAGE: Final = "docs/troubleshooting.md"


@dataclass(frozen=True)
class Finding:
    """What was seen, and what mends it where it is not as it should be."""

    verdict: Verdict
    seen: str
    fix: str | None = None


@dataclass(frozen=True)
class Subject:
    """What is looked at.

    Attributes:
        recording: Read only: a diagnosis changes nothing.
        chosen_by: The rule that chose its folder.
        project: The folder in which the files of clients are looked for.
        connection: To the recording; None where it cannot be read.
        unread: Why it cannot be read.
        server: The command that starts this package's own server.
    """

    recording: Recording
    chosen_by: str
    project: Path
    connection: sqlite3.Connection | None = None
    unread: WebotsMCPError | None = None
    server: Sequence[str] = (sys.executable, "-m", "webots_mcp", "serve", "--read-only")
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
    def views(self) -> list[View]:
        """All robots that were ever seen."""
        robots = list_robots(self.opened, self.now_s)
        return [view_of(self.opened, robot, self.now_s) for robot in robots]

    @cached_property
    def live(self) -> list[View]:
        """The robots whose controllers live."""
        return [view for view in self.views if view.robot.live]

    @cached_property
    def running_webots(self) -> list[Instance]:
        """The Webots that run on this machine."""
        from webots_mcp.webots.instances import instances

        return instances()


class Check(NamedTuple):
    """A link of the chain.

    Attributes:
        name: In one word or a few; the heading of its part of the page.
        look: Looks at it.
        needs_recording: It is not looked at where there is no recording that can be read.
    """

    name: str
    look: Callable[[Subject], Finding]
    needs_recording: bool = False

    @property
    def page(self) -> str:
        """Where more is said about it."""
        return f"{PAGE}#{self.name.lower().replace(' ', '-')}"


class Checked(NamedTuple):
    """A check and what it found."""

    check: Check
    finding: Finding

    @property
    def is_well(self) -> bool:
        """Whether there is nothing to mend."""
        return self.finding.verdict == "ok"


def worst(findings: Sequence[Finding]) -> Finding:
    """Several findings of one check as one; what is well is left out where something is not."""
    verdict = _WORST_FIRST[min(_WORST_FIRST.index(finding.verdict) for finding in findings)]
    told = [finding for finding in findings if verdict == "ok" or finding.verdict != "ok"]
    fixes = list(dict.fromkeys(finding.fix for finding in told if finding.fix))
    seen = "; ".join(dict.fromkeys(finding.seen for finding in told))
    return Finding(verdict, seen, "; ".join(fixes) or None)


def last_seen_s(view: View) -> float:
    """When a robot was heard of last, Unix time."""
    seen_s = view.robot.last_seen_wall_time_s
    return max(seen_s, view.session.last_seen_wall_time_s) if view.session else seen_s


def ago(seconds: float) -> str:
    """How long ago something was, in the unit in which a person thinks of it."""
    for size, unit in ((86_400, "days"), (3_600, "hours"), (120, "minutes")):
        if seconds >= 2 * size or (unit == "minutes" and seconds >= size):
            return f"{seconds / (60 if unit == 'minutes' else size):.0f} {unit} ago"
    return f"{max(seconds, 0.0):.1f} s ago"
