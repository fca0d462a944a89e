"""The list of the faults: one TOML file per subject, and where their texts and tests stand now."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class NotApplicableError(Exception):
    """The code has changed: the fault must be carried to where its subject is now."""


@dataclass(frozen=True)
class Fault:
    """One wrong place in the code.

    Attributes:
        name: What is wrong then, as a sentence.
        subject: The name of the list that it stands in.
        file: In which file, from the checkout's root; where it has moved, the only one that has it.
        old: What stands there, once.
        new: What stands there instead while the fault is in.
        caught_by: The tests that fail then, as pytest names them; none: a known hole.
    """

    name: str
    subject: str
    file: str
    old: str
    new: str
    caught_by: list[str]

    def place(self, root: Path) -> Path:
        """The file that has the old text.

        Raises:
            NotApplicableError: The text is nowhere, or not once.
        """
        named = root / self.file
        if named.exists() and self.old in named.read_text("utf-8"):
            return self._only([named])
        sources = sorted((root / "webots_mcp").rglob(f"*{named.suffix}"))
        return self._only([each for each in sources if self.old in each.read_text("utf-8")])

    def _only(self, files: list[Path]) -> Path:
        count = sum(each.read_text("utf-8").count(self.old) for each in files)
        if count != 1:
            raise NotApplicableError(f"its old text is found {count} times ({self.file})")
        return files[0]

    def text_in(self, root: Path) -> str:
        """The file's text with the fault.

        Raises:
            NotApplicableError: The old text is not there exactly once.
        """
        return self.place(root).read_text("utf-8").replace(self.old, self.new)


def listed_faults() -> list[Fault]:
    """All of them, subject by subject."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    found: list[Fault] = []
    for file in sorted(Path(__file__).parent.glob("*.toml")):
        faults: list[dict[str, Any]] = toml.loads(file.read_text("utf-8"))["fault"]
        for fault in faults:
            tests = [located(test) for test in fault.pop("caught_by")]
            found.append(Fault(subject=file.stem, caught_by=tests, **fault))
    return found


@cache
def located(test: str) -> str:
    """A test's id, also where it has moved to another file that alone has one of its name."""
    file, _, name = test.partition("::")
    homes = _tests().get(name.rpartition("::")[2], [file])
    return test if file in homes or len(homes) != 1 else f"{homes[0]}::{name}"


@cache
def _tests() -> dict[str, list[str]]:
    """The files that have a test of each name."""
    found: dict[str, list[str]] = {}
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        for name in re.findall(r"(?m)^ *(?:async )?def (test_\w+)\(", file.read_text("utf-8")):
            found.setdefault(name, []).append(file.relative_to(ROOT).as_posix())
    return found


def is_test(test: str) -> bool:
    """Whether there is a test of that id, or a file of tests; nothing is imported."""
    file, _, name = test.partition("::")
    if not name:
        return (ROOT / file).is_file()
    return file in _tests().get(name.rpartition("::")[2], [])
