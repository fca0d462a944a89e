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

from tests.benchmarks.registry import Bench, Benchmark, all_benchmarks
from tests.benchmarks.table import Section, render

_QUICK = 0.1


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 0 however fast or slow everything was; 2 for a name that does not exist."""
    benchmarks = all_benchmarks()
    options = _parser([b.name for b in benchmarks]).parse_args(arguments)
    chosen = [b for b in benchmarks if not options.only or b.name in options.only]
    started_s, load = time.monotonic(), _load()
    sections = [
        _run(benchmark, options, f"{number}/{len(chosen)}")
        for number, benchmark in enumerate(chosen, 1)
    ]
    _show("")
    lasted = f"{time.monotonic() - started_s:.0f} s" + (", --quick" if options.quick else "")
    _print(f"{render(sections)}\n\n{_machine()}; load {load} before, {_load()} after\n{lasted}")
    return 0


def _run(benchmark: Benchmark, options: argparse.Namespace, number: str) -> Section:
    def say(text: str) -> None:
        _show(f"[{number}] {benchmark.name}: {text}")

    say("...")
    with tempfile.TemporaryDirectory(prefix="webots-mcp-bench-") as folder:
        effort = _QUICK if options.quick else 1.0
        return benchmark.run(Bench(Path(folder), effort, say, options.rows, options.kills))


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:  # the reader of the pipe has seen enough: Python does not try again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _show(text: str) -> None:
    """Progress in one line of a terminal; nothing in a pipe."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _machine() -> str:
    encoder = "orjson installed" if importlib.util.find_spec("orjson") else "no orjson"
    python = f"{platform.python_implementation()} {platform.python_version()}"
    system = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return f"{python}, SQLite {sqlite3.sqlite_version}, {encoder}; {system}"


def _load() -> str:
    """How busy the machine was in the last minute, where the system tells."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def _parser(names: list[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller counts: under a minute")
    parser.add_argument(
        "--rows", type=int, metavar="ROWS", help="length of the long recording (1000000)"
    )
    parser.add_argument(
        "--kills", type=int, metavar="KILLS", help="controllers killed beside others (60)"
    )
    parser.add_argument(
        "--only",
        action="append",
        choices=names,
        metavar="NAME",
        help=f"only this one, may be repeated: {', '.join(names)}",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
