"""What webots_mcp.h costs a controller in C, and its readers."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from statistics import median

from tests.benchmarks.core import Bench, Line, NotMeasurableError, Target, benchmark, duration
from webots_mcp import MCPBridge
from webots_mcp.contract import C_HEADER
from webots_mcp.standin import InProcessRobot
from webots_mcp.store.recording import RecordingAccess

_PROGRAM = """
#include <math.h>
#include <time.h>
#include "webots_mcp.h"
int main(int count, char **arguments) {
  int rows = count > 1 ? atoi(arguments[1]) : 1;
  char names[40][16];
  for (int i = 0; i < 40; i++) snprintf(names[i], 16, "s%d.value", i);
  wmcp *w = wmcp_open(NULL, "rover", NULL, 32, 1);
  clock_t started = clock();
  for (int row = 1; row <= rows; row++) {
    wmcp_begin(w, row * 0.008);
    for (int i = 0; i < 40; i++) wmcp_number(w, names[i], sin(row + i * 0.37) * 3);
    wmcp_publish(w);
  }
  printf("%.9f", (double)(clock() - started) / CLOCKS_PER_SEC / rows);
  wmcp_close(w);
  return 0;
}
"""
_VALUES = 40


@benchmark("c", "webots_mcp.h: publish of 40 values with all digits (processor time)")
def measure_c(bench: Bench) -> Iterable[Line]:
    """Beside the bridge in Python, and what it takes to get the rows into the database."""
    if shutil.which("gcc") is None:
        raise NotMeasurableError("there is no gcc")
    source, program = bench.folder / "publish.c", bench.folder / "publish"
    source.write_text(_PROGRAM)
    command = ["gcc", "-O2", f"-I{C_HEADER.parent}", source, "-o", program, "-lm"]
    subprocess.run(command, check=True)
    rows, ours, theirs = bench.count(20_000, least=200), list[float](), list[float]()
    folder = bench.place("c")
    for block in range(5):
        ours.append(_in_c(program, folder, rows))
        theirs.append(_in_python(bench.place(f"python{block}"), rows // 5))
    c, python = median(ours), median(theirs)
    beside, target = f"publish() in Python {duration(python)}", Target(20.0)
    yield Line("publish, 40 values", duration(c), beside, c * 1e6, "us", target)
    started_s, recording = time.process_time(), RecordingAccess(folder / "webots.db", folder)
    with recording.reader() as connection:  # as many as a question takes in
        spent_s = time.process_time() - started_s
        intake_s = spent_s / connection.execute("SELECT count(*) FROM state").fetchone()[0]
    yield Line("taking a row in", duration(intake_s), "", intake_s * 1e6, "us")


def _in_c(program: Path, folder: Path, rows: int) -> float:
    environment = os.environ | {"WEBOTS_MCP_DATA_DIR": str(folder)}
    run = subprocess.run(
        [program, str(rows)], env=environment, capture_output=True, text=True, check=True
    )
    return float(run.stdout)


def _in_python(folder: Path, rows: int) -> float:
    bridge = MCPBridge(InProcessRobot(), data_dir=folder, throttle_interval=1)
    states = [
        {f"s{i}": {"value": math.sin(row + i * 0.37) * 3} for i in range(_VALUES)}
        for row in range(100)
    ]
    started_s = time.process_time()
    for row in range(rows):
        bridge.publish(states[row % 100])
    spent_s = time.process_time() - started_s
    bridge.close()
    return spent_s / rows


BENCHMARKS = (measure_c,)
