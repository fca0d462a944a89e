"""Asks the scenarios' questions, judges the answers, and prints what they cost.

    python -m tests.evaluations                          the calls of the plans, no model
    python -m tests.evaluations --client 'claude -p --mcp-config {config} --strict-mcp-config
        --allowedTools mcp__webots'                      any client of the command line
    python -m tests.evaluations --cheat 'a liar'         a client that does not earn its answers
    python -m tests.evaluations --compare A.json B.json  what differs between two saved scores

A client gets the question over stdin, or in place of {question}; {config} is a file that names the
server, {server} its command line, {schema} a file with the JSON schema of the answer. The last JSON
object that it prints is its answer. Exit code 1: an answer was wrong; 2: wrong usage.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

import anyio

from tests.evaluations.asking import Outcome, ask, ask_by_command
from tests.evaluations.cheats import CHEATS
from tests.evaluations.planned import answer_by_plan
from tests.evaluations.scenario import Scenario, read_scenarios
from tests.evaluations.scores import (
    comparison,
    read_scores,
    save_scores,
    scores_of,
    summary,
)
from tests.tool_list import counts_of
from webots_mcp.contract import TOOL_TIERS
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.server.mcp_server import create_server


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the arguments ask for; the result is the exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.compare:
        try:
            print(comparison(*(read_scores(file) for file in options.compare)))
        except (OSError, ValueError) as error:
            parser.error(str(error))
        return 0
    scenarios = [each for each in read_scenarios() if options.only in each.name]
    if not scenarios:
        parser.error(f"no scenario has {options.only!r} in its name")
    logging.getLogger("mcp").setLevel(logging.CRITICAL)
    logging.getLogger("client").setLevel(logging.CRITICAL)
    outcomes = list[Outcome]()
    for scenario in scenarios * options.repeat:
        outcomes.append(_ask(scenario, options))
        print(_line(outcomes[-1]), flush=True)
    scores = scores_of(outcomes)
    print(summary(scores))
    _print_tool_lists()
    if options.save:
        save_scores(options.save, scores)
    return 0 if all(each.is_right for each in outcomes) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.evaluations", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--client", metavar="COMMAND", help="command line of a client")
    who.add_argument("--cheat", choices=CHEATS, help="a client that does not earn its answers")
    who.add_argument(
        "--compare", nargs=2, type=Path, metavar="FILE", help="compare two files of --save"
    )
    parser.add_argument("--only", metavar="TEXT", default="", help="scenarios with this in a name")
    parser.add_argument(
        "--repeat", type=_count, default=1, metavar="N", help="ask each question N times (1)"
    )
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the scores to a JSON file")
    return parser


def _count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"{count} is less than 1")
    return count


def _ask(scenario: Scenario, options: argparse.Namespace) -> Outcome:
    if options.client:
        return ask_by_command(scenario, options.client)
    return ask(scenario, CHEATS[options.cheat] if options.cheat else answer_by_plan)


def _line(outcome: Outcome) -> str:
    turns = f", {outcome.wrong_turns} wrong turns" if outcome.wrong_turns else ""
    line = (
        f"{'right' if outcome.is_right else 'WRONG'}  {outcome.scenario.name:44}"
        f"{len(outcome.calls):>2} calls{outcome.tokens:>7,} tokens{outcome.wall_s:>7.1f} s{turns}"
    )
    if outcome.is_right:
        return line
    wrong = "".join(f"\n       {each}" for each in outcome.wrong)
    called = ", ".join(call.tool + " (failed)" * call.failed for call in outcome.calls)
    said = outcome.said.strip().replace("\n", "\n       | ")
    return f"{line}{wrong}\n       called {called or 'nothing'}\n       | {said}"


def _print_tool_lists() -> None:
    for tier in TOOL_TIERS:
        memory = MemoryDatabase()
        counts = counts_of(anyio.run(create_server(memory, memory.data_dir, tools=tier).list_tools))
        memory.close()
        print(f"the list of tools (--tools {tier}): {counts.tools}, about {counts.tokens:,} tokens")


if __name__ == "__main__":
    sys.exit(main())
