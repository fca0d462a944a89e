"""Runs the benchmarks and prints one table."""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import sqlite3
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.benchmarks import (
    answers,
    c_header,
    commands,
    history,
    in_loop,
    kills,
    many_runs,
    pool,
    starting,
)
from tests.benchmarks.core import Bench, Benchmark, Section, render

BENCHMARKS: Final[tuple[Benchmark, ...]] = (
    *in_loop.BENCHMARKS,
    *c_header.BENCHMARKS,
    *starting.BENCHMARKS,
    *commands.BENCHMARKS,
    *kills.BENCHMARKS,
    *history.BENCHMARKS,
    *many_runs.BENCHMARKS,
    *answers.BENCHMARKS,
    *pool.BENCHMARKS,
)
_QUICK: Final = 0.1


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 however fast or slow everything was; 2 for a name that does not exist."""
    options = _parser().parse_args(arguments)
    chosen = [each for each in BENCHMARKS if not options.only or each.name in options.only]
    started_s, load = time.monotonic(), _load()
    sections = [
        _run(each, options, f"{number}/{len(chosen)}") for number, each in enumerate(chosen, 1)
    ]
    _show("")
    lasted = f"{time.monotonic() - started_s:.0f} s" + (", --quick" if options.quick else "")
    try:
        print(f"{render(sections)}\n\n{_machine()}; load {load} before, {_load()} after\n{lasted}")
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of the pipe has seen enough: Python does not try again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _run(benchmark: Benchmark, options: argparse.Namespace, number: str) -> Section:
    def say(text: str) -> None:
        _show(f"[{number}] {benchmark.name}: {text}")

    say("...")
    with tempfile.TemporaryDirectory(prefix="webots-mcp-bench-") as folder:
        effort = _QUICK if options.quick else 1.0
        return benchmark.run(Bench(Path(folder), effort, say, options.rows, options.kills))


def _show(text: str) -> None:
    """Progress in one line of a terminal; nothing in a pipe."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _machine() -> str:
    orjson = "orjson installed" if importlib.util.find_spec("orjson") else "no orjson"
    python = f"{platform.python_implementation()} {platform.python_version()}"
    system = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return f"{python}, SQLite {sqlite3.sqlite_version}, {orjson}; {system}"


def _load() -> str:
    """How busy the machine was in the last minute, where the system tells."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _parser() -> argparse.ArgumentParser:
    names = [each.name for each in BENCHMARKS]
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller counts: under a minute")
    parser.add_argument("--rows", type=int, help="length of the long recording (1000000)")
    parser.add_argument("--kills", type=int, help="controllers killed with others around (60)")
    only = f"only this one, may be repeated: {', '.join(names)}"
    parser.add_argument("--only", action="append", choices=names, metavar="NAME", help=only)
    return parser


if __name__ == "__main__":
    sys.exit(main())
