"""Derives verdicts: whether an event was found, not found or not searched, and how a check ends.

A detector or check returns what it found and its coverage: what it could judge. Every verdict,
from "not searched" of a kind to "not judged" of a check, is derived from both in this module only.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from webots_mcp.signals.meaning import FIRM, Source
from webots_mcp.signals.naming import counted, listed
from webots_mcp.store.reading.unread import NOT_READ

Cause = Literal["absent", "undecided", "unread"]
Outcome = Literal["pass", "warn", "fail", "not applicable", "not looked at", "not judged"]
WORST_FIRST: Final[tuple[Outcome, ...]] = (
    "fail", "not looked at", "warn", "pass", "not judged", "not applicable",
)  # fmt: skip
AS_STUCK: Final = "reported as stuck"  # of standstills, where both kinds are asked for
_WITHOUT: Final[dict[Cause, Outcome]] = {
    "absent": "not applicable", "undecided": "not judged", "unread": "not looked at",
}  # fmt: skip
_MOST_NAMED: Final = 3
_NUMBER: Final = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class JudgedInterval(NamedTuple):
    """An interval of simulation time of one run that could be judged."""

    run_id: int
    start_s: float
    end_s: float


class Missing(NamedTuple):
    """Something that could not be judged.

    Attributes:
        reason: Why, for a person.
        cause: `absent` where the run lacks what is needed, `undecided` where nothing recorded
            decides, `unread` where it was not read.
    """

    reason: str
    cause: Cause


@dataclass
class Coverage:
    """Which signals and intervals a detector or a check could judge, and what was missing.

    Attributes:
        signals: Names of those that were judged, in order.
        intervals: What of the runs was judged; empty if nothing was.
        missing: What was not judged.
        nearest: What came nearest to an event: its share of one, and in words.
        says: Of a check, what held in all that was judged.
        judged: Of a check, what was judged; else the number of signals.
        limit: Of a check, what would have been a fault.
        subject: Of a check about several things, which one this is.
        often: How many things were not judged.
        more: The call that has them judged.
    """

    signals: dict[str, None] = field(default_factory=dict[str, None])
    intervals: list[JudgedInterval] = field(default_factory=list[JudgedInterval])
    missing: dict[Missing, None] = field(default_factory=dict[Missing, None])
    nearest: tuple[float, str] = (0.0, "")
    says: str = ""
    judged: str = ""
    limit: str = ""
    subject: str = ""
    often: int | None = None
    more: str = ""

    @classmethod
    def lacking(cls, reason: str, cause: Cause | None = None, subject: str = "") -> Coverage:
        """Return one in which nothing was judged.

        Args:
            reason: Why.
            cause: None where the reason tells it.
            subject: Of what.
        """
        missing = dict.fromkeys([Missing(reason, cause or cause_of(reason))])
        return cls(missing=missing, subject=subject)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was judged."""
        return not self.intervals

    @property
    def lasts_s(self) -> float:
        """How much simulation time was judged."""
        return sum(each.end_s - each.start_s for each in self.intervals)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why something was not judged; what many runs share is said once."""
        return tuple(reasons_of_runs([each.reason for each in self.missing]))

    def reasons_for(self, cause: Cause) -> list[str]:
        """Return the reasons of what was not judged for one cause."""
        return reasons_of_runs([each.reason for each in self.missing if each.cause == cause])

    def note_missing(self, reason: str, cause: Cause | None = None) -> None:
        """Note what was not judged; a cause of None is told by the reason."""
        self.missing[Missing(reason, cause or cause_of(reason))] = None

    def note_nearest(self, share: float, what: str) -> None:
        """Note what came near to an event; the nearest counts."""
        self.nearest = max(self.nearest, (share, what))

    def add(self, other: Coverage) -> None:
        """Take in what another one covers."""
        self.signals |= other.signals
        self.intervals += [each for each in other.intervals if each not in self.intervals]
        self.missing |= other.missing
        self.nearest = max(self.nearest, other.nearest)

    @property
    def words(self) -> str:
        """What was judged and by which limit, such as `2 wheels for 57 s, slip limit 50 %`."""
        judged = self.judged or (counted(len(self.signals), "signal") if self.signals else "")
        if judged and self.lasts_s > 0:
            judged += f" for {self.lasts_s:.3g} s"
        return ", ".join(filter(None, (judged, self.limit)))


class Fault(NamedTuple):
    """Something wrong that a check found.

    Attributes:
        severity: How bad it is where what it rests on is known firmly.
        evidence: The numbers that it rests on.
        since_s: Simulation time at which it began first.
        often: How many times it was so.
        more: The call that shows it in full.
        subject: Of a check about several things, which one this is.
        signals: The signals that it rests on.
    """

    severity: Literal["warn", "fail"]
    evidence: str
    since_s: float | None = None
    often: int | None = None
    more: str = ""
    subject: str = ""
    signals: tuple[str, ...] = ()


def cause_of(reason: str) -> Cause:
    """Return the cause that a reason tells: there was no time to read, or something is absent."""
    return "unread" if reason.startswith(NOT_READ) or "time limit reached" in reason else "absent"


# -- checks ------------------------------------------------------------------------------------


def outcome_of(made: Fault | Coverage, sources: Mapping[str, Source]) -> tuple[Outcome, str]:
    """Return what a check comes to, and why.

    A fault is no firmer than what is known of the signals that it rests on: a failure needs ones
    that are declared, known from a device or by an unambiguous name, a warning at least ones whose
    values show what they are. If the meaning of one is unknown, the outcome is "not judged".

    Args:
        made: What the check found, or what it could judge without finding a fault.
        sources: Of each signal, where its meaning is known from.
    """
    if isinstance(made, Fault):
        unknown = [name for name in made.signals if sources.get(name, "unknown") == "unknown"]
        if unknown:
            names = listed(unknown, _MOST_NAMED)
            return "not judged", f"{made.evidence}; it is not known what {names} means"
        loose = [name for name in made.signals if sources[name] not in FIRM]
        if made.severity == "fail" and loose:
            names = listed(loose, _MOST_NAMED)
            return "warn", f"{made.evidence}; what {names} means is told by its values alone"
        return made.severity, made.evidence
    held = ": ".join(filter(None, (made.says, made.words)))
    for cause in ("unread", "undecided", "absent"):
        if (lacking := made.reasons_for(cause)) and (cause != "absent" or made.is_empty):
            more = [held] if cause == "unread" and held and not made.is_empty else []
            return _WITHOUT[cause], "; ".join([*lacking, *more])
    if made.is_empty:
        return "not applicable", held or "nothing was recorded of it"
    return "pass", held


# -- events ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdicts:
    """What the answer says of each kind that was asked for; none of them is passed over.

    Attributes:
        found: How many there are.
        not_found: Kinds that were looked for, be it in a part, and of which there is none, each
            with what came nearest, or with an empty text.
        reasons: Why kinds were not looked for, or not everywhere, and what to ask to have them
            looked for. A kind that is also above was looked for in a part only.
        coverage: Of each kind, what could be judged.

    Shown are the properties, which name each kind that was not found once.
    """

    found: dict[str, int] = field(default_factory=dict[str, int])
    not_found: dict[str, str] = field(default_factory=dict[str, str])
    reasons: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    coverage: dict[str, Coverage] = field(default_factory=dict[str, Coverage])

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
        """What was not searched: each reason once, with the kinds that share it as the key.

        That nothing was found in the rest is said with the reasons of a kind, not on its own.
        """
        sharing: dict[str, list[str]] = {}
        for kind, reasons in self.reasons.items():
            for reason in reasons:
                sharing.setdefault(reason, []).append(kind)
        named: dict[tuple[str, ...], list[str]] = {}
        for reason, kinds in sharing.items():
            named.setdefault(tuple(kinds), []).append(reason)
        left = {kind: self.not_found[kind] for kind in self.reasons if kind in self.not_found}
        found: dict[str, str] = {}
        for kinds, reasons in named.items():
            absent = {kind: left.pop(kind) for kind in kinds if kind in left}
            found[", ".join(kinds)] = "; ".join([*reasons, *_in_the_rest(absent, kinds)])
        return found

    @property
    def none_in_part(self) -> list[str]:
        """Kinds that were searched for in a part of the range, and not found there."""
        return [kind for kind in self.not_found if kind in self.reasons]

    @property
    def _nowhere(self) -> list[str]:
        return [kind for kind in self.not_found if kind not in self.reasons]

    def why_unsearched(self, kind: str) -> str | None:
        """Return why a kind was searched nowhere; None if it was searched, at least in a part."""
        is_searched = kind in self.found or kind in self.not_found
        return None if is_searched else self.not_searched.get(kind)

    def knows(self, kind: str) -> bool:
        """Whether a kind was searched, or is said not to have been."""
        return kind in self.found or kind in self.not_found or kind in self.reasons

    def unread(self, kind: str) -> list[str]:
        """What of the range could not be read for a kind: its count is that of the rest."""
        return [each for each in self.reasons.get(kind, ()) if each.startswith(NOT_READ)]


def _in_the_rest(absent: Mapping[str, str], kinds: Sequence[str]) -> list[str]:
    """Return that kinds were not found in what was searched, with what came nearest to each."""
    if not absent:
        return []
    named = "none" if len(absent) == len(kinds) else f"no {', '.join(absent)}"
    nearest = dict.fromkeys(near for near in absent.values() if near)
    near = f" ({'; '.join(nearest)})" if nearest else ""
    return [f"in the rest: {named}{near}"]


@dataclass
class SearchCoverage:
    """The coverage of each kind of event in all that was searched so far.

    Attributes:
        notes: Remarks that are about no kind.
        of_several_runs: What came near has to say in which run.
        rows: Number of rows of all runs that were searched and in which a condition never held.
    """

    notes: list[str] = field(default_factory=list[str])
    of_several_runs: bool = False
    rows: int = 0
    by_kind: dict[str, Coverage] = field(default_factory=dict[str, Coverage])
    _of_runs: dict[str, list[int]] = field(default_factory=dict[str, list[int]])

    def of(self, kind: str) -> Coverage:
        """Return the coverage of a kind."""
        if (found := self.by_kind.get(kind)) is None:
            found = self.by_kind[kind] = Coverage()
        return found

    def not_searched(self, kind: str, *reasons: str, cause: Cause | None = None) -> None:
        """Note why a kind was not searched, or where it was not."""
        for reason in reasons:
            self.of(kind).note_missing(reason, cause)

    def note_of_run(self, run_id: int, note: str) -> None:
        """Remark on a run; runs with the same remark are reported together."""
        self._of_runs.setdefault(note, []).append(run_id)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """The remarks, each once."""
        runs = {note: ", ".join(map(str, run_ids)) for note, run_ids in self._of_runs.items()}
        of_runs = (f"run {listed}: {note}" for note, listed in runs.items())
        return tuple(dict.fromkeys([*self.notes, *of_runs]))

    def note_nearest(self, kind: str, share: float, what: str) -> None:
        """Note what came near to an event, as a share of what would be one; the most counts."""
        self.of(kind).note_nearest(share, what)

    def verdicts(self, names: Sequence[str], counts: Mapping[str, int]) -> Verdicts:
        """Return what became of each kind of these names, in their order.

        Args:
            names: All kinds that were asked for.
            counts: How many events of each were found.
        """
        there = {name: self.by_kind[name] for name in names if name in self.by_kind}
        return Verdicts(
            {name: counts[name] for name in names if counts.get(name)},
            {
                name: each.nearest[1]
                for name, each in there.items()
                if not each.is_empty and not counts.get(name)
            },
            {name: each.reasons for name, each in there.items() if each.missing},
            there,
        )


# -- reasons that many runs share --------------------------------------------------------------


def reasons_of_runs(reasons: Iterable[str]) -> list[str]:
    """Return reasons with those as one that differ only in the run and its numbers.

    Of `run 2 lasted only 7.95 s` and `run 3 lasted only 11.9 s` that is `runs 2-3 lasted only 7.95
    to 11.9 s`.
    """
    groups: dict[str, list[str]] = {}
    for reason in dict.fromkeys(reasons):
        groups.setdefault(_NUMBER.sub("#", reason) if "run " in reason else reason, []).append(
            reason
        )
    found: list[str] = []
    for alike in groups.values():
        one = _as_one(alike) if len(alike) > 1 else None
        found += [one] if one else alike
    return found


def _as_one(alike: Sequence[str]) -> str | None:
    """Several texts that differ in numbers as one; None unless the runs tell them apart."""
    numbers = list(zip(*(_NUMBER.findall(each) for each in alike), strict=True))
    texts = _NUMBER.split(alike[0])
    said, has_runs = texts[0], False
    for values, text in zip(numbers, texts[1:], strict=True):
        if said.endswith("run ") and len(set(values)) == len(alike):
            said = said[: -len("run ")] + "runs " + run_ranges(map(int, values))
            text = re.sub(r"^ has\b", " have", text)
            has_runs = True
        elif len(set(values)) == 1:
            said += values[0]
        else:
            said += f"{min(values, key=float)} to {max(values, key=float)}"
        said += text
    return said if has_runs else None


def run_ranges(run_ids: Iterable[int]) -> str:
    """Return run numbers in rising order, those in a row as a range: `2-6, 9`."""
    spans: list[list[int]] = []
    for run_id in sorted(set(run_ids)):
        if spans and spans[-1][1] == run_id - 1:
            spans[-1][1] = run_id
        else:
            spans.append([run_id, run_id])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in spans)
