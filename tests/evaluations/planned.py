"""A client of the command line without a model: `planned CONFIG QUESTION` prints the answers.

It makes the calls of the scenario with that question, by the server that the file names.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import anyio
from mcp import Client, StdioServerParameters

from tests.evaluations.asking import data_of
from tests.evaluations.scenario import read_scenarios


async def main(config: str, question: str) -> None:
    (scenario,) = [each for each in read_scenarios() if each.question == question]
    server = json.loads(Path(config).read_text("utf-8"))["mcpServers"]["webots"]
    server["env"] = {**os.environ, **server["env"]}
    async with Client(StdioServerParameters(**server)) as client:
        for tool, arguments in scenario.plan:
            print(json.dumps(data_of(await client.call_tool(tool, arguments))))


if __name__ == "__main__":
    anyio.run(main, sys.argv[1], sys.argv[2])
