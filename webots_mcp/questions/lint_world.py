"""The question what is wrong with a world file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.answers.answer_models import LintAnswer
from webots_mcp.answers.budget import fitting, table
from webots_mcp.answers.shortening import cut_text, is_for_a_person, tokens_of
from webots_mcp.contract import WORLD_ENDING
from webots_mcp.errors import InvalidInputError
from webots_mcp.lint import lint_world
from webots_mcp.lint.world_faults import RULES, SEVERITIES, LintReport, Severity, WorldFault
from webots_mcp.questions.declaration import READS, question
from webots_mcp.store.recording import RecordingAccess

COLUMNS: Final = ("severity", "rule", "path", "place", "what", "fix")


@dataclass(frozen=True)
class LintAnswerSizes:
    """How much an answer shows.

    Attributes:
        faults_tokens: Budget of the table of faults.
        reasons_tokens: Budget of the reasons why something was not searched.
        text_characters: Characters of a path, and of one text.
        in_world_info_processor_s: Processor time in seconds within webots_get_world_info.
    """

    faults_tokens: int = 1_000
    reasons_tokens: int = 350
    text_characters: int = 330
    in_world_info_processor_s: float = 2.0


_SIZES: Final = LintAnswerSizes()


@question("Find faults of a world", READS, command="lint", positional=("world",), tier="all")
def webots_lint_world(
    recording: RecordingAccess,
    world: Annotated[
        str | None,
        Field(
            max_length=1000,
            description="World file (.wbt). Default: the world of the newest run.",
        ),
    ] = None,
    severity: Annotated[
        Severity, Field(description="Least severity to list: note, warning or error.")
    ] = "note",
) -> LintAnswer:
    """Find what makes a world shake, drift, explode or stand still, before or without running it.

    Reads the world file, its PROTO files and its controllers: masses, inertias, overlaps, joints,
    motors, time steps, devices, names. Each fault has its place and a fix. For the nodes of a
    running world use webots_get_scene.
    """
    file = _file_of(recording, world)
    return lint_answer(_linted(file), severity)


def lint_answer(report: LintReport, severity: Severity = "note") -> LintAnswer:
    """Return what a lint found, as much of it as fits."""
    listed = SEVERITIES[: SEVERITIES.index(severity) + 1]
    faults = [fault for fault in report.faults if fault.severity in listed]
    rows = [_row(fault, report.world) for fault in faults]
    shown = rows if is_for_a_person() else fitting(rows, _SIZES.faults_tokens)
    verdicts = report.verdicts()
    hint = (
        f"The first {len(shown)} of {len(rows)} faults are shown."
        if len(shown) < len(rows)
        else None
    )
    return LintAnswer(
        world=str(report.world),
        counts={f"{name}s": report.count(name) for name in SEVERITIES},
        faults=table(COLUMNS, shown),
        rules=_rules(faults[: len(shown)]) or None,
        not_found=", ".join(n for n, each in verdicts.items() if each == "not found") or None,
        not_searched=_reasons(report) or None,
        hint=hint,
    )


def lint_in_short(world: str | None) -> dict[str, Any] | None:
    """Return how many faults a world file has and the worst of them, in less than 150 tokens."""
    if world is None:
        return None
    file = Path(world)
    if not file.is_absolute() or not _is_file(file):
        return {"not_searched": "the world file is not on this machine"}
    report = _linted(file, _SIZES.in_world_info_processor_s)
    found: dict[str, Any] = {
        f"{name}s": report.count(name) for name in SEVERITIES if report.count(name)
    }
    if report.faults:
        worst = report.faults[0]
        found["worst"] = cut_text(f"{worst.severity}: {worst.what} (line {worst.line})", 200)
    open_rules = {each.rule for each in report.not_searched}
    if open_rules:
        found["not_searched"] = f"{len(open_rules)} of {len(RULES)} rules could not judge all"
    return found or {"errors": 0}


def _linted(file: Path, processor_s: float | None = None) -> LintReport:
    """Return the report of a world, again only if a file next to it has changed."""
    return lint_world(file) if processor_s is None else _lint_once(file, _stamp(file), processor_s)


@lru_cache(maxsize=8)
def _lint_once(file: Path, stamp: object, processor_s: float) -> LintReport:
    return lint_world(file, processor_s)


def _stamp(file: Path) -> tuple[float, ...]:
    """Return times of change: of the world, the folders of its project and their sources."""
    project = file.parent.parent
    near = [file, *project.glob("protos/*.proto"), *project.glob("controllers/*/*.*")]
    return tuple(each.stat().st_mtime for each in near[:500] if _is_file(each))


def _is_file(file: Path) -> bool:
    try:
        return file.is_file()
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return False


def _file_of(recording: RecordingAccess, world: str | None) -> Path:
    if world is None:
        with recording.view(None) as view:
            world = view.require_run().world
        if world is None:
            raise InvalidInputError(
                "The newest run does not name its world file. Give one, for example "
                "world='worlds/arena.wbt'."
            )
    elif not is_for_a_person():  # like a world to open, it has to be one of the project
        from webots_mcp.simulator.launch import require_world
        from webots_mcp.steering.launcher import project_of

        return require_world(world, project_of(recording))[0]
    file = Path(world)
    if file.suffix != WORLD_ENDING:
        raise InvalidInputError(
            f"{cut_text(world, 200)!r} is no world file. Its name has to end in {WORLD_ENDING}, "
            "for example world='worlds/arena.wbt'."
        )
    if not _is_file(file):
        raise InvalidInputError(
            f"There is no file {cut_text(world, 200)!r} on this machine. Give the path of a world "
            "file, for example world='worlds/arena.wbt'."
        )
    return file


def _row(fault: WorldFault, world: Path) -> list[Any]:
    return [
        fault.severity,
        fault.rule,
        cut_text(fault.path, _SIZES.text_characters),
        place_of(fault, world),
        cut_text(fault.what, _SIZES.text_characters),
        cut_text(fault.fix, _SIZES.text_characters),
    ]


def place_of(fault: WorldFault, world: Path) -> str:
    """Return the file and line of a fault; a file of the project relative to it."""
    project = world.parent.parent
    inside = fault.file.is_relative_to(project)
    name = fault.file.relative_to(project) if inside else fault.file
    return f"{name}:{fault.line}"


def _rules(faults: Sequence[WorldFault]) -> dict[str, str]:
    names = dict.fromkeys(fault.rule for fault in faults)
    return {name: f"{RULES[name].why} {RULES[name].page}" for name in names}


def _reasons(report: LintReport) -> dict[str, str]:
    """Return for each rule why it did not judge everything: the first reason, and how many more."""
    by_rule: dict[str, dict[str, None]] = {}
    for each in report.not_searched:
        by_rule.setdefault(each.rule, {})[each.reason] = None
    same: dict[str, list[str]] = {}
    for rule, reasons in by_rule.items():
        first = next(iter(reasons))
        more = f" (and {len(reasons) - 1} more reasons)" if len(reasons) > 1 else ""
        same.setdefault(cut_text(f"{first}{more}", _SIZES.text_characters), []).append(rule)
    found: dict[str, str] = {}
    left = _SIZES.reasons_tokens
    for reason, rules in same.items():
        left -= tokens_of([rules, reason])
        if left < 0 and not is_for_a_person() and found:
            found["..."] = "more reasons are left out"
            break
        found[", ".join(rules)] = reason
    return found
