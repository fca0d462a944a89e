"""Puts each fault of the list into a copy of the checkout and runs the tests that must notice it.

    python -m tests.faults                       all of them
    python -m tests.faults bridge "claimed"      those of a list, and those of whose name it is part
    python -m tests.faults --jobs 2              two copies, side by side

The checkout itself is never touched. PYTHONPATH puts the copy before an editable install, for the
tests' own processes too; only one that a test starts without PYTHONPATH imports the checkout. At
first all these tests run without a fault: what fails then proves nothing.
"""

from __future__ import annotations

import argparse
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.faults.listed import ROOT, Fault, NotApplicableError, listed_faults

TIMEOUT_S = 300.0  # a fault that makes its test hang is noticed as well
ENDED_BAD, HUNG = 1, -signal.SIGKILL
LEFT_OUT = (".git", ".venv", ".hypothesis", ".pytest_cache", ".ruff_cache", "build", "mcp_data")


def run_tests(copy: Path, tests: list[str], *options: str) -> tuple[int, str]:
    """How pytest ended in that copy, and what it printed."""
    line = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options, *tests]
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    with subprocess.Popen(
        line, cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, errors="replace", start_new_session=True,
    ) as process:  # fmt: skip
        try:
            said, _ = process.communicate(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            said, _ = process.communicate()
    return process.returncode, said


def verdict_on(fault: Fault, copy: Path) -> str:
    """`caught`, `known hole`, or what is wrong with the fault or with its tests."""
    try:
        text = fault.text_in(copy)
    except NotApplicableError as error:
        return f"CANNOT BE APPLIED: {error}"
    if not fault.caught_by:
        return "known hole"
    file = fault.place(copy)
    sound = file.read_text("utf-8")
    file.write_text(text, "utf-8")
    try:
        code, said = run_tests(copy, fault.caught_by, "-x")
    finally:
        file.write_text(sound, "utf-8")
    if code in (ENDED_BAD, HUNG):
        return "caught"
    return "NOT CAUGHT" if code == 0 else f"CANNOT BE RUN (pytest ended with {code}):\n{said}"


def main() -> int:
    """Returns 0 where every fault that has tests is caught, 1 where one is not."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults")
    parser.add_argument("names", nargs="*", metavar="NAME", help="a list, or a part of a name")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="copies side by side (1)")
    arguments = parser.parse_args()
    names: list[str] = arguments.names or [""]
    faults = [
        each for each in listed_faults()
        if any(name == each.subject or name in each.name for name in names)
    ]  # fmt: skip
    if not faults:
        parser.error(f"no fault is named {', '.join(names)}")
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        copies: queue.Queue[Path] = queue.Queue()
        for number in range(arguments.jobs):
            copy = Path(folder, f"{number}")
            shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*LEFT_OUT))
            copies.put(copy)

        def look(fault: Fault) -> str:
            copy, started_s = copies.get(), time.monotonic()
            verdict = verdict_on(fault, copy)
            copies.put(copy)
            took_s = time.monotonic() - started_s
            print(f"{took_s:6.1f} s  {fault.subject}: {fault.name}: {verdict}", flush=True)
            return verdict

        tests = sorted({test for fault in faults for test in fault.caught_by})
        code, said = run_tests(Path(folder, "0"), tests) if tests else (0, "")
        if code:
            print(f"without any fault pytest ended with {code}:\n{said}")
            return 1
        with ThreadPoolExecutor(arguments.jobs) as workers:
            verdicts = list(workers.map(look, faults))
    caught, holes = verdicts.count("caught"), verdicts.count("known hole")
    others = len(faults) - caught - holes
    print(
        f"{len(faults)} faults: {caught} caught, {holes} known holes, {others} not as they should"
    )
    return 1 if others else 0


if __name__ == "__main__":
    sys.exit(main())
