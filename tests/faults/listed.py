"""The list of the faults: one TOML file per subject."""

from __future__ import annotations

import sys
from dataclasses import dataclass
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
        file: In which file, from the checkout's root.
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

    def text_in(self, root: Path) -> str:
        """The file's text with the fault.

        Raises:
            NotApplicableError: The file is gone, or the old text is not there exactly once.
        """
        path = root / self.file
        if not path.exists():
            raise NotApplicableError(f"there is no {self.file}")
        text = path.read_text("utf-8")
        if (count := text.count(self.old)) != 1:
            raise NotApplicableError(f"its old text is found {count} times in {self.file}")
        return text.replace(self.old, self.new)


def listed_faults() -> list[Fault]:
    """All of them, subject by subject."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    found: list[Fault] = []
    for file in sorted(Path(__file__).parent.glob("*.toml")):
        faults: list[dict[str, Any]] = toml.loads(file.read_text("utf-8"))["fault"]
        found += [Fault(subject=file.stem, **fault) for fault in faults]
    return found
