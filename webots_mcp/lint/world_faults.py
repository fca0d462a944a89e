"""What a lint of a world finds: the rules, the faults, and what could not be searched."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal, NamedTuple, Protocol, get_args

Severity = Literal["error", "warning", "note"]
"""An error keeps the world from working as written, a warning makes it likely to misbehave."""
SEVERITIES: Final = get_args(Severity)
Verdict = Literal["found", "not found", "not searched"]

_REFERENCE: Final = "https://cyberbotics.com/doc/reference/"
_GUIDE: Final = "https://cyberbotics.com/doc/guide/"
IN_THE_SCENE: Final = (
    "time step", "mass ratio", "bounding object", "physics", "inertia", "overlap", "wheel axis",
    "motor limits", "devices", "names", "rendering load", "lidar layers",
)  # fmt: skip
"""Rules about nodes, which nobody can search in a PROTO without its source."""
_EXPLODES: Final = (
    f"{_GUIDE}modeling#my-robot-simulation-explodes-or-behaves-weirdly-what-should-i-do"
)


class LintRule(NamedTuple):
    """One kind of fault: what it is called, why it matters, and who says so."""

    name: str
    why: str
    page: str


RULES: Final = {
    rule.name: rule
    for rule in (
        LintRule(
            "file",
            "Webots loads nothing, or only a part, of what it cannot parse or use.",
            f"{_REFERENCE}proto",
        ),
        LintRule(
            "undeclared PROTO",
            "From R2022b on, Webots uses only PROTO nodes that the file declares with EXTERNPROTO.",
            f"{_REFERENCE}proto-definition",
        ),
        LintRule(
            "time step",
            "A long step makes springs rigid, lets heavy bodies sink and lets motors oscillate.",
            f"{_REFERENCE}worldinfo",
        ),
        LintRule(
            "sampling period",
            "The step of a controller has to be a multiple of WorldInfo.basicTimeStep.",
            f"{_REFERENCE}robot#wb_robot_step",
        ),
        LintRule(
            "mass ratio",
            "The error of a constraint between a heavy and a light body stays large: it shakes.",
            _EXPLODES,
        ),
        LintRule(
            "bounding object",
            "A Solid with physics needs a boundingObject to collide and to have an inertia.",
            f"{_REFERENCE}solid",
        ),
        LintRule(
            "physics",
            "A Solid between others with physics needs physics too, and a base without is pinned.",
            f"{_REFERENCE}physics#in-robots",
        ),
        LintRule(
            "inertia",
            "No body has such an inertia; the equations of motion have no sensible solution.",
            f"{_REFERENCE}physics",
        ),
        LintRule(
            "overlap",
            "The physics engine pushes overlapping bounding objects apart in the first steps.",
            f"{_REFERENCE}worldinfo",
        ),
        LintRule(
            "wheel axis",
            "A wheel that does not turn about its own axis wobbles or lifts the robot.",
            f"{_REFERENCE}hingejoint",
        ),
        LintRule(
            "motor limits",
            "Targets beyond what a joint can do are not clipped, or hit a stop.",
            f"{_REFERENCE}motor#motor-limits",
        ),
        LintRule(
            "devices",
            "Webots has no device of that name for the controller, or runs one that nobody reads.",
            f"{_REFERENCE}robot#wb_robot_get_device",
        ),
        LintRule(
            "controller",
            "Webots starts no controller for the robot.",
            f"{_REFERENCE}robot#field-summary",
        ),
        LintRule(
            "names",
            "Names identify solids among their siblings, and devices within a robot.",
            f"{_REFERENCE}solid#unique-solid-name",
        ),
        LintRule(
            "rendering load",
            "Every image is rendered and copied from the graphics card, which takes wall time.",
            f"{_GUIDE}speed-performance",
        ),
        LintRule(
            "lidar layers",
            "Webots simulates a lidar only if numberOfLayers < "
            "verticalFieldOfView * horizontalResolution / fieldOfView.",
            f"{_REFERENCE}lidar#field-summary",
        ),
        LintRule(
            "synchronization",
            "Without synchronization the number of steps per action depends on the load.",
            f"{_REFERENCE}robot#synchronous-versus-asynchronous-controllers",
        ),
    )
}
"""All rules by name, in the order in which a report lists them."""


class WorldFault(NamedTuple):
    """One fault of a world.

    Attributes:
        rule: Name of the rule in `RULES`.
        severity: How bad it is.
        path: Path of the node or field in the scene tree.
        file: The file to edit.
        line: Line in that file.
        what: What is wrong, with the values.
        fix: What to set.
    """

    rule: str
    severity: Severity
    path: str
    file: Path
    line: int
    what: str
    fix: str

    @property
    def why(self) -> str:
        """Return why it matters."""
        return RULES[self.rule].why

    @property
    def page(self) -> str:
        """Return the address of the page of Webots' documentation."""
        return RULES[self.rule].page


class Located(Protocol):
    """A node with its path in the scene tree, and its place in a file."""

    @property
    def path(self) -> str:
        """Its path in the scene tree."""
        ...

    @property
    def file(self) -> Path:
        """The file that has its fields."""
        ...

    def line_of(self, field: str, /) -> int:
        """Return the line of a field, or of the node for ""."""
        ...


class NotSearched(NamedTuple):
    """A part of the world that a rule could not judge, and the reason."""

    rule: str
    subject: str
    reason: str


@dataclass
class LintReport:
    """What a lint of one world found."""

    world: Path
    faults: list[WorldFault] = field(default_factory=list[WorldFault])
    not_searched: list[NotSearched] = field(default_factory=list[NotSearched])
    searched: dict[str, int] = field(default_factory=dict[str, int])
    """Number of nodes, pairs or calls that each rule judged."""

    def judge(self, rule: str, count: int = 1) -> None:
        """Count what a rule judged, whether or not it found a fault."""
        self.searched[rule] = self.searched.get(rule, 0) + count

    def blame(
        self, rule: str, severity: Severity, node: Located, field: str, what: str, fix: str
    ) -> None:
        """Note a fault of a node, or of one of its fields ("" for none); see `WorldFault`."""
        path = f"{node.path}.{field}" if field else node.path
        self.faults.append(
            WorldFault(rule, severity, path, node.file, node.line_of(field), what, fix)
        )

    def leave_out(self, rules: Iterable[str], subject: str, reason: str) -> None:
        """Note what these rules could not judge."""
        self.not_searched += [NotSearched(rule, subject, reason) for rule in rules]

    def finish(self) -> LintReport:
        """Sort the faults, the worst first, and remove repetitions."""
        self.faults = sorted(
            dict.fromkeys(self.faults),
            key=lambda fault: (SEVERITIES.index(fault.severity), str(fault.file), fault.line),
        )
        self.not_searched = list(dict.fromkeys(self.not_searched))
        return self

    def count(self, severity: Severity) -> int:
        """Return the number of faults of a severity."""
        return sum(fault.severity == severity for fault in self.faults)

    def verdicts(self) -> dict[str, Verdict]:
        """Return for each rule whether it found something.

        "not found" means that nothing was left out.
        """
        found = {fault.rule for fault in self.faults}
        open_rules = {each.rule for each in self.not_searched}
        return {
            name: "found"
            if name in found
            else "not searched"
            if name in open_rules
            else "not found"
            for name in RULES
        }
