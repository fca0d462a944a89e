"""Reads the table of the promises, and what there is to show them."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from tests.faults.listed import is_test, located

CHECKOUT: Final = Path(__file__).parents[2]
TABLE: Final = Path(__file__).with_name("promises.toml")
_BENCHMARK: Final = "benchmark "


@dataclass(frozen=True)
class Promise:
    """A sentence of a page, or the part of one that promises something.

    Args:
        page: The page's path in the checkout.
        says: As it stands there, white space folded.
        shown_by: Ids of tests (`tests/...::test_name`), and `benchmark NAME`.
        why: What none of these shows, and why; empty where they show all of it.
    """

    page: str
    says: str
    shown_by: tuple[str, ...]
    why: str = ""

    @property
    def tests(self) -> list[str]:
        return [each for each in self.shown_by if not each.startswith(_BENCHMARK)]

    @property
    def benchmarks(self) -> list[str]:
        return [each.removeprefix(_BENCHMARK) for each in self.shown_by if each not in self.tests]

    def judge(self, outcomes: dict[str, str]) -> str:
        """One word about it, from how each of its tests ended (`passed`, `failed`, `skipped`)."""
        if not self.shown_by:
            return "unshown"
        if not self.tests:
            return "measured"
        found = {outcomes.get(each, "failed") for each in self.tests}
        if "failed" in found:
            return "broken"
        if "passed" not in found:
            return "skipped"
        return "partly" if self.why or "skipped" in found else "kept"


def read_promises(table: Path = TABLE) -> list[Promise]:
    """All promises, page by page, in the order of the table."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    pages: dict[str, list[dict[str, Any]]] = toml.loads(table.read_text("utf-8"))
    return [
        Promise(page, each.pop("says"), tuple(map(located, each.pop("shown_by"))), **each)
        for page, promises in pages.items()
        for each in promises
    ]


def stands_in_its_page(promise: Promise) -> bool:
    return promise.says in _folded(promise.page)


def is_there(shown_by: str) -> bool:
    """Whether there is such a test or benchmark; only files are read, nothing is imported."""
    if shown_by.startswith(_BENCHMARK):
        return shown_by.removeprefix(_BENCHMARK) in _benchmarks()
    return is_test(shown_by)


@cache
def _folded(page: str) -> str:
    return " ".join((CHECKOUT / page).read_text("utf-8").split())


@cache
def _benchmarks() -> set[str]:
    modules = (CHECKOUT / "tests" / "benchmarks").glob("*.py")
    declared = r'(?m)^@benchmark\(\s*"(\w+)"'
    return {name for file in modules for name in re.findall(declared, file.read_text("utf-8"))}
