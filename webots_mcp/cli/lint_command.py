"""The command `lint`: what is wrong with a world file."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Annotated, Final

from webots_mcp.cli.options import Json, Parameter
from webots_mcp.cli.terminal import print_json, printable, terminal_width
from webots_mcp.contract import WORLD_ENDING
from webots_mcp.errors import InvalidInputError
from webots_mcp.lint.world_faults import (
    RULES,
    SEVERITIES,
    LintReport,
    Severity,
    WorldFault,
)

_PLURALS: Final = {"error": "errors", "warning": "warnings", "note": "notes"}


def lint(
    world: Annotated[Path, Parameter("WORLD", help="World file (.wbt).")],
    /,
    *,
    severity: Annotated[
        Severity,
        Parameter(
            "--severity", help="Least severity to list: note, warning or error. Default: note."
        ),
    ] = "note",
    as_json: Json = False,
) -> int:
    """Find what makes a world shake, drift, explode or stand still, without running it.

        webots-mcp lint worlds/arena.wbt --severity warning

    Reads the world, its PROTO files and its controllers. Exit code 0: no error found. 1: an error
    was found. 2: the file could not be read.
    """
    from webots_mcp.lint import lint_world
    from webots_mcp.questions.lint_world import place_of

    if world.suffix != WORLD_ENDING:
        raise InvalidInputError(
            f"{str(world)!r} is no world file. Its name has to end in {WORLD_ENDING}, as in "
            "'webots-mcp lint worlds/arena.wbt'."
        )
    if not world.is_file():
        raise InvalidInputError(
            f"There is no file {str(world)!r}. Give the path of a world file, as in "
            "'webots-mcp lint worlds/arena.wbt'."
        )
    report = lint_world(world)
    listed = SEVERITIES[: SEVERITIES.index(severity) + 1]
    faults = [fault for fault in report.faults if fault.severity in listed]
    if as_json:
        print_json(_as_json(report, faults))
    else:
        _print(report, faults, place_of)
    if any(fault.rule == "file" for fault in report.faults):
        return 2
    return int(report.count("error") > 0)


def _as_json(report: LintReport, faults: list[WorldFault]) -> dict[str, object]:
    return {
        "world": str(report.world),
        "counts": {f"{name}s": report.count(name) for name in SEVERITIES},
        "faults": [
            {
                "severity": fault.severity,
                "rule": fault.rule,
                "path": fault.path,
                "file": str(fault.file),
                "line": fault.line,
                "what": fault.what,
                "why": fault.why,
                "fix": fault.fix,
                "page": fault.page,
            }
            for fault in faults
        ],
        "verdicts": report.verdicts(),
        "not_searched": [each._asdict() for each in report.not_searched],
    }


def _print(report: LintReport, faults: list[WorldFault], place_of: object) -> None:
    assert callable(place_of)
    counts = [
        f"{number} {name if number == 1 else _PLURALS[name]}"
        for name in SEVERITIES
        if (number := report.count(name))
    ]
    print(f"{report.world.name}: {', '.join(counts) or 'no fault found'}.")
    for fault in faults:
        print(f"\n{fault.severity:8} {printable(fault.rule)}  {place_of(fault, report.world)}")
        for head, text in (
            ("", fault.what),
            ("at    ", fault.path),
            ("why   ", f"{fault.why} {fault.page}"),
            ("fix   ", fault.fix),
        ):
            _print_folded(f"         {head}", text)
    _print_coverage(report)


def _print_coverage(report: LintReport) -> None:
    verdicts = report.verdicts()
    quiet = [name for name, verdict in verdicts.items() if verdict == "not found"]
    print()
    if quiet:
        _print_folded("not found     ", ", ".join(quiet))
    rules_by_reason: dict[str, dict[str, None]] = {}
    for each in report.not_searched:
        rules_by_reason.setdefault(each.reason, {})[each.rule] = None
    reasons_by_rules: dict[str, list[str]] = {}
    for reason, rules in rules_by_reason.items():
        names = "all rules" if len(rules) >= len(RULES) - 1 else ", ".join(rules)
        reasons_by_rules.setdefault(names, []).append(reason)
    for names, reasons in reasons_by_rules.items():
        _print_folded("not searched  ", f"{names}: {'; '.join(reasons)}")


def _print_folded(head: str, text: str) -> None:
    width = max(terminal_width(sys.stdout) - len(head), 30)
    lines = textwrap.wrap(
        printable(text), width, break_long_words=False, break_on_hyphens=False
    ) or [""]
    print(head + f"\n{'':{len(head)}}".join(lines))
