"""How true an answer is: claims against what happened."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Final

import numpy as np

from tests.judging.detection.asking import Claim
from tests.judging.detection.labelled import Incident

LEAST_COMMON: Final = 0.3  # of the time that either lasts, claim and incident have in common
SLACK_ROWS: Final = 1.5  # by which what takes a row or two may be told too early or too late


@dataclass
class Tally:
    """What came of the judged answers about one kind of recording.

    Attributes:
        found: Incidents that were told; `false`: claims without an incident.
        said: Of the missed incidents those whose answer said that it may have missed some.
        clean: Runs without a false claim.
        begin_errors: How many rows the begin of each found incident is off, of a swing how many
            periods; and so for its end.
        least_begin_errors: What no unbiased estimate of these begins falls below, in rows.
        period_errors: As shares of the truth; `amplitude_errors` as well.
    """

    runs: int = 0
    clean: int = 0
    incidents: int = 0
    found: int = 0
    false: int = 0
    said: int = 0
    minutes: float = 0.0
    slowest_s: float = 0.0
    begin_errors: list[float] = field(default_factory=list[float])
    end_errors: list[float] = field(default_factory=list[float])
    least_begin_errors: list[float] = field(default_factory=list[float])
    period_errors: list[float] = field(default_factory=list[float])
    amplitude_errors: list[float] = field(default_factory=list[float])

    @property
    def recall(self) -> float | None:
        """The share of what happened that was told."""
        return self.found / self.incidents if self.incidents else None

    @property
    def precision(self) -> float | None:
        """The share of what was told that happened; of runs in which nothing did the clean ones."""
        if not self.incidents:
            return self.clean / self.runs if self.runs else None
        told = self.found + self.false
        return self.found / told if told else None

    @property
    def said_share(self) -> float | None:
        """Of what was missed, the share of which the answer said that it may have missed some."""
        missed = self.incidents - self.found
        return self.said / missed if missed else None

    def add(self, verdict: Verdict, minutes: float, took_s: float, *, admitted: bool) -> None:
        """Count what was found out about one run."""
        self.runs += 1
        self.clean += not verdict.false
        self.incidents += len(verdict.found) + len(verdict.missed)
        self.found += len(verdict.found)
        self.false += verdict.false
        self.said += len(verdict.missed) if admitted else 0
        self.minutes += minutes
        self.slowest_s = max(self.slowest_s, took_s)
        for incident, claim in verdict.found:
            self._add_errors(incident, claim, verdict.interval_s)

    def _add_errors(self, incident: Incident, claim: Claim, interval_s: float) -> None:
        if claim.count == 1 and not incident.split:
            unit_s = incident.period_s or interval_s
            self.begin_errors.append(abs(claim.start_s - incident.start_s) / unit_s)
            self.least_begin_errors.append(incident.begin_error_s / unit_s)
            self.end_errors.append(abs(claim.end_s - incident.end_s) / unit_s)
        if incident.period_s:
            told_s, told = claim.period_s or math.inf, claim.amplitude or math.inf
            self.period_errors.append(abs(told_s / incident.period_s - 1))
            self.amplitude_errors.append(abs(told / (incident.amplitude or 1) - 1))


@dataclass(frozen=True)
class Verdict:
    """What came of the claims about one run.

    Attributes:
        unfounded: Claims of what did not happen, or was told already.
        false: How many things they tell; a claim of ten dropouts where eight were tells two.
    """

    found: tuple[tuple[Incident, Claim], ...]
    missed: tuple[Incident, ...]
    unfounded: tuple[Claim, ...]
    false: int
    interval_s: float


def judge(incidents: Sequence[Incident], claims: Sequence[Claim], interval_s: float) -> Verdict:
    """Match each claim of one measure with what it tells, those that fit best first.

    One claim tells one incident, but for a claim that counts several, and one incident is told by
    one claim, but for one that a gap cuts in two. Whatever touches an optional incident is right.
    """
    slack_s = SLACK_ROWS * interval_s
    pairs = [(_common(i, c, slack_s), i, c) for i, c in product(incidents, claims)]
    fitting = sorted((each for each in pairs if each[0] >= LEAST_COMMON), key=lambda p: -p[0])
    told: dict[int, Claim] = {}
    left = {id(claim): claim.count for claim in claims}
    repeated: set[int] = set()
    for _, incident, claim in fitting:
        if left[id(claim)] and id(incident) not in told:
            told[id(incident)] = claim
            left[id(claim)] -= 1
        elif incident.split and left[id(claim)]:
            repeated.add(id(claim))
    right = repeated | _touching_optional(incidents, claims, slack_s)
    unfounded = tuple(each for each in claims if left[id(each)] and id(each) not in right)
    wanted = [each for each in incidents if not each.optional]
    return Verdict(
        tuple((each, told[id(each)]) for each in wanted if id(each) in told),
        tuple(each for each in wanted if id(each) not in told),
        unfounded,
        sum(left[id(each)] for each in unfounded),
        interval_s,
    )


def _common(incident: Incident, claim: Claim, slack_s: float) -> float:
    """The share of time that both have in common; 1 for what a claim of several reaches over.

    Of a swing that a gap cuts in two it is the share of the claim.
    """
    if incident.name != claim.name:
        return 0.0
    start_s = max(incident.start_s, claim.start_s)
    end_s = min(incident.end_s, claim.end_s)
    if claim.count > 1:
        return 1.0 if end_s - start_s >= -slack_s else 0.0
    shortest_s = claim.end_s - claim.start_s if incident.split else math.inf
    whole_s = max(incident.end_s, claim.end_s) - min(incident.start_s, claim.start_s)
    return (end_s - start_s + slack_s) / (min(whole_s, shortest_s) + slack_s)


def _touching_optional(
    incidents: Iterable[Incident], claims: Iterable[Claim], slack_s: float
) -> set[int]:
    optional = [each for each in incidents if each.optional]
    return {
        id(claim)
        for claim, each in product(claims, optional)
        if claim.name == each.name
        and claim.start_s <= each.end_s + slack_s
        and each.start_s <= claim.end_s + slack_s
    }


def median(values: Sequence[float]) -> float | None:
    """The middle one; None of none."""
    return float(np.median(values)) if values else None


def nine_in_ten(values: Sequence[float]) -> float | None:
    """What nine in ten do not exceed; None of none."""
    return float(np.quantile(values, 0.9)) if values else None
