"""Asks the scenarios' questions and says which were answered rightly, and what the tools cost.

    python -m tests.evaluations                          the calls of the plans, no model
    python -m tests.evaluations --client 'claude -p --mcp-config {config} --strict-mcp-config
        --allowedTools mcp__webots'                      any client of the command line

A client gets the question over stdin, or in place of {question}. Facts are sought in its words: who
names them and denies them is taken to be right. Exit code 1: one was wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import anyio

from tests.evaluations.asking import Outcome, ask_by_command, ask_by_plan
from tests.evaluations.scenario import Scenario, read_scenarios
from tests.tool_list import counts_of
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.questions.declaring import TIERS
from webots_mcp.server.mcp_server import create_server


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.evaluations", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--client", metavar="COMMAND", help="a client of the command line")
    parser.add_argument("--only", metavar="TEXT", default="", help="scenarios with this in a name")
    options = parser.parse_args(arguments)
    wrong = 0
    scenarios = [each for each in read_scenarios() if options.only in each.name]
    for scenario in scenarios:
        outcome = _asked(scenario, options.client)
        wrong += not outcome.is_right
        print(_line(outcome), flush=True)
    print(f"{len(scenarios) - wrong} of {len(scenarios)} are right")
    for tier in TIERS:
        memory = MemoryDatabase()
        counts = counts_of(anyio.run(create_server(memory, memory.data_dir, tools=tier).list_tools))
        memory.close()
        print(f"the list of tools (--tools {tier}): {counts.tools}, about {counts.tokens:,} tokens")
    return 1 if wrong else 0


def _asked(scenario: Scenario, client: str | None) -> Outcome:
    return ask_by_plan(scenario) if client is None else ask_by_command(scenario, client)


def _line(outcome: Outcome) -> str:
    scenario = outcome.scenario
    read = f"{outcome.tokens:>6,} tokens" if outcome.tokens is not None else ""
    line = (
        f"{'right' if outcome.is_right else 'WRONG'}  {scenario.name:46}{len(outcome.called)} of "
        f"{scenario.calls} calls{read}{outcome.wall_s:>7.1f} s"
    )
    if outcome.is_right:
        return line
    lacking = [f"\n       lacks {fact.at} = {fact.value!r}" for fact in outcome.lacking]
    said = outcome.said.strip().replace("\n", "\n       | ")
    called = f"\n       called {', '.join(outcome.called) or 'nothing'}"
    return line + "".join(lacking) + called + (f"\n       | {said}" if said else "")


if __name__ == "__main__":
    sys.exit(main())
