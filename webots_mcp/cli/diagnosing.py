"""The command that says why nothing works."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from typing import TYPE_CHECKING, Any

from webots_mcp.cli.command import DATA_DIR, DATABASE, JSON, argument, command
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.diagnosis.doctor import Checked, Examined

_WRONG = 1


@command(
    "doctor",
    DATA_DIR,
    DATABASE,
    JSON,
    argument("--no-server", action="store_true", help="start no server to talk to"),
)
def doctor(arguments: argparse.Namespace) -> int:
    """Look at each link of the chain from controller to client, and say what mends it.

    Nothing is changed. Exit code 0: nothing is wrong (there may be warnings). 1: something is
    wrong. 2: it could not look.
    """
    from webots_mcp.diagnosis.doctor import all_checks, diagnose

    checked = diagnose(_subject(arguments), all_checks(with_server=not arguments.no_server))
    if arguments.json:
        _print_json(checked)
    else:
        _print_lines(checked)
    return _WRONG if any(each.finding.verdict == "wrong" for each in checked) else 0


def _subject(arguments: argparse.Namespace) -> Examined:
    from webots_mcp.contract import choose_data_dir, resolve_database
    from webots_mcp.diagnosis.doctor import subject_of
    from webots_mcp.store.recording import Recording

    try:
        database, data_dir = resolve_database(arguments.database, arguments.data_dir)
        named = arguments.database is not None
        rule = "--database" if named else choose_data_dir(arguments.data_dir).chosen_by
    except OSError as error:
        raise InvalidInputError(str(error)) from error
    return subject_of(Recording(database, data_dir), rule)


def _print_json(checked: list[Checked]) -> None:
    print(json.dumps({"checks": [_facts(each) for each in checked]}, indent=2))


def _facts(checked: Checked) -> dict[str, Any]:
    check, finding = checked
    mend = {} if checked.is_well else {"fix": finding.fix, "page": check.page}
    return {"check": check.name, "verdict": finding.verdict, "seen": finding.seen, **mend}


def _print_lines(checked: list[Checked]) -> None:
    from webots_mcp.cli.tables import printable
    from webots_mcp.cli.wording import as_typed

    for check, finding in checked:
        print(f"{finding.verdict:13}  {check.name:15}  {printable(as_typed(finding.seen))}")
        if finding.fix:
            print(f"{'':30}  -> {printable(as_typed(finding.fix))} ({check.page})")
    counts = Counter(each.finding.verdict for each in checked)
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
