"""The command that checks a run, for a person and for continuous integration."""

from __future__ import annotations

import contextlib
import re
import shlex
import sqlite3
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Final

from webots_mcp.cli.options import HERE, Id, Json, Parameter, Robot, Where, make_chunks_first
from webots_mcp.contract import whole_file
from webots_mcp.errors import DatabaseError, InvalidInputError

EXIT_CODES: Final = {"fail": 1, "not looked at": 2}
_ELEMENTS: Final = {  # of JUnit, and by which attribute they are counted
    "fail": ("failure", "failures"),
    "not looked at": ("error", "errors"),
    "not applicable": ("skipped", "skipped"),
}


def check(
    run_id: Annotated[Id | None, Parameter("RUN", help="Else the newest run.")] = None,
    /,
    *,
    expect: Annotated[
        list[str] | None,
        Parameter(
            "--expect",
            metavar="CONDITION",
            help="What shall hold, as \"front_m > 0.1 during mode == 'drive'\"; may be repeated.",
        ),
    ] = None,
    junit: Annotated[
        Path | None,
        Parameter("--junit", metavar="FILE", help="Write the checks there as JUnit XML too."),
    ] = None,
    robot: Robot = None,
    as_json: Json = False,
    recorded: Where = HERE,
) -> int:
    """Is this run well? Motion against commands, sensors, pace, log, end, lost rows, goal.

        webots-mcp check 4 --junit check.xml

    Exit code 0: each check passed, warned or did not apply. 1: one failed. 2: it could not be
    asked, or not all of the run was looked at.
    """
    from webots_mcp.cli.asking import ask, show
    from webots_mcp.questions.check_run import webots_check_run

    _compile(recorded)
    make_chunks_first(recorded.recording())
    given = {"run_id": run_id, "robot": robot, "expect": expect}
    reply = ask(webots_check_run, given, recorded)
    data = reply.data or {}
    shown = reply if as_json else reply._replace(data=_as_typed(data))
    show(webots_check_run, shown, recorded, as_json=as_json)
    if junit is not None:
        _write(junit, data)
    return EXIT_CODES.get(data.get("outcome", ""), 0)


def _compile(recorded: Where) -> None:
    """Let controllers that start without a server read what their project expects now."""
    from webots_mcp.store.project_file import compile_project, file_of, read_project

    recording = recorded.recording(read_only=False)
    if (file := file_of(recording.data_dir)) is None:
        return
    expected = read_project(file)
    # Where nothing can be written it is asked all the same, of what is recorded.
    with contextlib.suppress(DatabaseError, sqlite3.Error), recording.writer() as connection:
        compile_project(connection, expected)


def _as_typed(answer: dict[str, Any]) -> dict[str, Any]:
    """The answer with commands in the place of calls, and what passed in one line."""
    from webots_mcp.cli.asking import OPTIONS
    from webots_mcp.cli.terminal import commands_by_tool

    def typed(cell: Any) -> Any:
        call = re.fullmatch(r"webots_(\w+)\((.*)\)", str(cell))
        if call is None:
            return cell
        words = ["webots-mcp", commands_by_tool().get(call[1], call[1])]
        for name, value in re.findall(r"(\w+)=(\[[^]]*\]|'[^']*'|\w+)", call[2]):
            for each in re.findall(r"'([^']*)'", value) or [value]:
                words += [OPTIONS.get(name, f"--{name}"), each]
        return shlex.join(words)

    passed, table = answer.get("passed"), answer.get("checks")
    changed = {"passed": f"{len(passed)}: {', '.join(passed)}"} if passed else {}
    if table:
        changed["checks"] = table | {"rows": [[*map(typed, row)] for row in table["rows"]]}
    return answer | changed


def _write(file: Path, answer: dict[str, Any]) -> None:
    """Write an answer as JUnit XML: a warning passes, and stands in `system-out`.

    Raises:
        InvalidInputError: The file cannot be written.
    """
    from xml.etree.ElementTree import Element, SubElement, tostring

    from webots_mcp.naming import spelled_out

    suite = Element("testsuite", name=f"run {answer.get('run_id')} of {answer.get('robot')}")
    counts = Counter[str](tests=0, failures=0, errors=0, skipped=0)
    for each in _checks_in(answer):
        name, says = spelled_out(each["check"]), spelled_out(each.get("evidence") or "")
        case = SubElement(suite, "testcase", classname="webots-mcp", name=name)
        says += f" (since {each['since_s']:g} s)" if each.get("since_s") is not None else ""
        element, counted = _ELEMENTS.get(each["outcome"], ("", ""))
        counts.update(filter(None, ("tests", counted)))
        if element:
            SubElement(case, element, message=says)
        elif each["outcome"] == "warn":
            SubElement(case, "system-out").text = f"warning: {says}"
    suite.attrib |= {name: str(count) for name, count in counts.items()}
    try:
        with whole_file(file) as aside:
            aside.write_bytes(tostring(suite, "utf-8", xml_declaration=True))
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error


def _checks_in(answer: dict[str, Any]) -> list[dict[str, Any]]:
    table: Any = answer.get("checks") or {"columns": [], "rows": []}
    found = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    return [*found, *({"check": name, "outcome": "pass"} for name in answer.get("passed") or ())]
