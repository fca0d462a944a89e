"""What became of each kind that was asked for: found, not found, or not looked for and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from webots_mcp.store.detection.event import Event
from webots_mcp.store.detection.kind import EventKind
from webots_mcp.store.reading.frame_source import NOT_READ


def count_by_kind(events: Iterable[Event]) -> Counter[str]:
    """How many there are of each kind, where one may stand for many that are alike."""
    counts = Counter[str]()
    for event in events:
        counts[event.kind] += event.count
    return counts


@dataclass(frozen=True)
class Verdicts:
    """What the answer says of each kind that was asked for; none of them is passed over.

    Attributes:
        found: How many there are.
        not_found: Kinds that were looked for, be it in a part, and of which there is none, each
            with what came nearest, or with an empty text.
        reasons: Why kinds were not looked for, or not everywhere, and what to ask to have them
            looked for. A kind that stands here and above is found, or not, in what was.

    Shown are the properties, which name each kind that was not found once.
    """

    found: dict[str, int] = field(default_factory=dict[str, int])
    not_found: dict[str, str] = field(default_factory=dict[str, str])
    reasons: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])

    @property
    def not_searched(self) -> dict[str, str]:
        """By kind, all reasons in one text."""
        return {kind: "; ".join(reasons) for kind, reasons in self.reasons.items()}

    @property
    def far(self) -> list[str]:
        """Kinds that were found nowhere, and to which nothing came near."""
        return [kind for kind in self._nowhere if not self.not_found[kind]]

    @property
    def nearest(self) -> dict[str, str]:
        """Kinds that were found nowhere, with what came nearest."""
        return {kind: self.not_found[kind] for kind in self._nowhere if self.not_found[kind]}

    @property
    def gaps(self) -> dict[str, str]:
        """What was not searched: each reason once, with the kinds that share it as the key."""
        sharing: dict[str, list[str]] = {}
        for kind, reasons in self.reasons.items():
            for reason in (*reasons, *self._in_what_was_searched(kind)):
                sharing.setdefault(reason, []).append(kind)
        named: dict[str, list[str]] = {}
        for reason, kinds in sharing.items():
            named.setdefault(", ".join(kinds), []).append(reason)
        return {kinds: "; ".join(reasons) for kinds, reasons in named.items()}

    @property
    def _nowhere(self) -> list[str]:
        return [kind for kind in self.not_found if kind not in self.reasons]

    def _in_what_was_searched(self, kind: str) -> list[str]:
        near = self.not_found.get(kind)
        return [] if near is None else [f"none in the searched part{near and f' ({near})'}"]

    def unlooked(self, kind: str) -> str | None:
        """Why a kind was not looked for anywhere; None if it was, at least in a part."""
        looked = kind in self.found or kind in self.not_found
        return None if looked else self.not_searched.get(kind)

    def unread(self, kind: str) -> list[str]:
        """What of the range could not be read for a kind: its count is that of the rest."""
        return [each for each in self.reasons.get(kind, ()) if each.startswith(NOT_READ)]


@dataclass
class Ledger:
    """What was noted of each kind while it was looked for.

    Attributes:
        searched: Kinds that were looked for at least in a part.
        notes: Remarks that are about no kind.
        of_several_runs: What came near has to say in which run.
        rows: Those in which a condition held nowhere, of all runs.
    """

    searched: set[str] = field(default_factory=set[str])
    notes: list[str] = field(default_factory=list[str])
    of_several_runs: bool = False
    rows: int = 0
    _of_runs: dict[str, list[int]] = field(default_factory=dict[str, list[int]])
    _reasons: dict[str, dict[str, None]] = field(default_factory=dict[str, dict[str, None]])
    _nearest: dict[str, tuple[float, str]] = field(default_factory=dict[str, tuple[float, str]])

    def not_searched(self, kind: str, *reasons: str) -> None:
        """Note why a kind was not looked for, or where it was not."""
        self._reasons.setdefault(kind, {}).update(dict.fromkeys(reasons))

    def note_of_run(self, run_id: int, note: str) -> None:
        """A remark on a run; runs with the same remark are reported together."""
        self._of_runs.setdefault(note, []).append(run_id)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """The remarks, each once."""
        runs = {note: ", ".join(map(str, run_ids)) for note, run_ids in self._of_runs.items()}
        of_runs = (f"run {listed}: {note}" for note, listed in runs.items())
        return tuple(dict.fromkeys([*self.notes, *of_runs]))

    def note_nearest(self, kind: str, share: float, what: str) -> None:
        """Note what came near to an event, as a share of what would be one; the most counts."""
        self._nearest[kind] = max(self._nearest.get(kind, (0.0, "")), (share, what))

    def verdicts(self, kinds: Sequence[EventKind], events: Iterable[Event]) -> Verdicts:
        """On each of the kinds, in their order, given all that was found."""
        counts, names = count_by_kind(events), [kind.name for kind in kinds]
        not_found = [name for name in names if name in self.searched and not counts[name]]
        return Verdicts(
            {name: counts[name] for name in names if counts[name]},
            {name: self._nearest.get(name, (0.0, ""))[1] for name in not_found},
            {name: tuple(self._reasons[name]) for name in names if self._reasons.get(name)},
        )
