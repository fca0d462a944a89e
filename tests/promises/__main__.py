"""Runs the tests of the pages' promises, and says of each whether it is kept."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Sequence

import pytest

from tests.promises.table import CHECKOUT, Promise, read_promises

_SHOWN = 100  # characters of a sentence


class _Outcomes:
    """How each test ended, of all its parameters together, also where pytest-xdist runs them."""

    def __init__(self) -> None:
        self.of: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        test = report.nodeid.partition("[")[0]
        if report.failed:
            self.of[test] = "failed"
        elif report.passed and report.when == "call" and self.of.get(test) != "failed":
            self.of[test] = "passed"
        elif report.skipped:
            self.of.setdefault(test, "skipped")


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns 1 where a promise is broken, 2 for a page that promises nothing."""
    promises = read_promises()
    pages = list(dict.fromkeys(each.page for each in promises))
    parser = argparse.ArgumentParser(prog="python -m tests.promises", description=__doc__)
    parser.add_argument("page", nargs="*", help=f"only of these: {', '.join(pages)}")
    parser.add_argument("--list", action="store_true", help="run nothing, show what is unshown")
    options = parser.parse_args(arguments)
    if unknown := set(options.page) - set(pages):
        parser.error(f"{', '.join(unknown)}: there are {', '.join(pages)}")
    chosen = [each for each in promises if each.page in (options.page or pages)]
    tests = sorted({test for promise in chosen for test in promise.tests})
    outcomes = dict.fromkeys(tests, "passed") if options.list else _run(tests)
    words = Counter(_tell(promise, outcomes) for promise in chosen)
    print(f"{len(chosen)} promises: " + ", ".join(f"{n} {word}" for word, n in words.items()))
    return int(words["broken"] > 0)


def _run(tests: list[str]) -> dict[str, str]:
    outcomes, workers = _Outcomes(), str(min(4, os.cpu_count() or 1))
    os.chdir(CHECKOUT)
    pytest.main([*tests, "-n", workers, "--dist", "loadfile"], plugins=[outcomes])
    return outcomes.of


def _tell(promise: Promise, outcomes: dict[str, str]) -> str:
    word = promise.judge(outcomes)
    whole = word != "kept" or len(promise.says) <= _SHOWN
    print(f"{word:9}{promise.page}: {promise.says if whole else promise.says[:_SHOWN] + ' ...'}")
    for test in promise.tests if word in ("broken", "skipped", "partly") else []:
        if outcomes.get(test) != "passed":
            print(f"{'':9}{outcomes.get(test, 'did not run')}: {test}")
    if promise.why:
        print(f"{'':9}{promise.why}")
    if word == "measured":
        print(f"{'':9}./run benchmarks --only {' --only '.join(promise.benchmarks)}")
    return word


if __name__ == "__main__":
    sys.exit(main())
