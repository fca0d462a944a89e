"""What a shipper tells of its work."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Report:
    """What was shipped so far, and what was not.

    Attributes:
        rows: By table; a row that changed counts each time that it was sent.
        pictures: Files.
        lost: By table, rows that retention had deleted before they could be shipped.
        replaced: By column, values that the pool cannot hold, for which it has what comes nearest.
        lost_pictures: Files that were not there any more, or are no pictures of ours.
        foreign: By their UUIDs, runs that another recording had shipped before, with its UUID.
        notes: What else a person should know.
    """

    rows: Counter[str] = field(default_factory=Counter[str])
    pictures: int = 0
    lost: Counter[str] = field(default_factory=Counter[str])
    replaced: Counter[str] = field(default_factory=Counter[str])
    lost_pictures: int = 0
    foreign: dict[str, str] = field(default_factory=dict[str, str])
    notes: list[str] = field(default_factory=list[str])

    def note(self, text: str) -> None:
        """Remember it, once."""
        if text not in self.notes:
            self.notes.append(text)
