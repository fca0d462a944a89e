"""Scores of a client: totals, a file that keeps them, and the comparison of two such files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import comb
from pathlib import Path

from tests.evaluations.asking import Outcome


@dataclass(frozen=True)
class Score:
    """What is kept of one scenario, over all times that it was asked."""

    name: str
    asked: int
    right: int
    calls: int
    tokens: int
    wrong_turns: int

    @property
    def share(self) -> float:
        """Return the share of right answers."""
        return self.right / self.asked


def scores_of(outcomes: Sequence[Outcome]) -> list[Score]:
    """Sum up outcomes by scenario."""
    names = dict.fromkeys(outcome.scenario.name for outcome in outcomes)
    return [
        _score(name, [each for each in outcomes if each.scenario.name == name]) for name in names
    ]


def _score(name: str, outcomes: Sequence[Outcome]) -> Score:
    return Score(
        name,
        len(outcomes),
        sum(each.is_right for each in outcomes),
        sum(len(each.calls) for each in outcomes),
        sum(each.tokens for each in outcomes),
        sum(each.wrong_turns for each in outcomes),
    )


def summary(scores: Sequence[Score]) -> str:
    """Return the totals in one line."""
    asked, right = sum(each.asked for each in scores), sum(each.right for each in scores)
    if not asked:
        return "nothing was asked"
    return (
        f"{right} of {asked} right ({100 * right / asked:.0f} %), "
        f"{sum(each.calls for each in scores) / asked:.1f} calls and "
        f"{sum(each.tokens for each in scores) / asked:,.0f} tokens of answers per question, "
        f"{sum(each.wrong_turns for each in scores)} wrong turns"
    )


def save_scores(file: Path, scores: Sequence[Score]) -> None:
    """Write scores as JSON."""
    file.write_text(json.dumps([asdict(each) for each in scores], indent=1) + "\n", "utf-8")


def read_scores(file: Path) -> list[Score]:
    """Read scores that were saved.

    Raises:
        ValueError: The file holds something else.
    """
    try:
        return [Score(**each) for each in json.loads(file.read_text("utf-8"))]
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file} holds no saved scores; write them with --save: {error}") from None


def comparison(before: Sequence[Score], after: Sequence[Score]) -> str:
    """Return what differs between two lists of scores, for the scenarios that both have."""
    later = {each.name: each for each in after}
    pairs = [(each, later[each.name]) for each in before if each.name in later]
    lines = [
        f"before: {summary([a for a, _ in pairs])}",
        f"after:  {summary([b for _, b in pairs])}",
    ]
    gained = [(a, b) for a, b in pairs if b.share > a.share]
    lost = [(a, b) for a, b in pairs if b.share < a.share]
    for word, changed in (("gained", gained), ("lost", lost)):
        lines += [f"{word}: {a.name} ({_share(a)}, now {_share(b)})" for a, b in changed]
    for a, b in pairs:
        if (a.calls / a.asked, a.wrong_turns / a.asked) != (
            b.calls / b.asked,
            b.wrong_turns / b.asked,
        ):
            lines.append(f"steps: {a.name} ({_steps(a)}, now {_steps(b)})")
    chance = sign_test(len(gained), len(lost))
    if gained or lost:
        lines.append(
            f"{len(gained)} questions gained, {len(lost)} lost: two equal versions differ as much "
            f"in {100 * chance:.0f} of 100 comparisons"
        )
    else:
        lines.append("no question is answered rightly more or less often")
    alone = len(before) + len(after) - 2 * len(pairs)
    return "\n".join([*lines, f"left out: {alone} questions of only one file"] if alone else lines)


def sign_test(gained: int, lost: int) -> float:
    """Return the probability of a split as uneven as this one by chance (two-sided)."""
    count = gained + lost
    tail = sum(comb(count, k) for k in range(min(gained, lost) + 1)) / 2**count
    return min(1.0, 2 * tail)


def _share(score: Score) -> str:
    return f"{score.right} of {score.asked}"


def _steps(score: Score) -> str:
    turns = score.wrong_turns / score.asked
    return f"{score.calls / score.asked:.1f} calls, {turns:.1f} wrong turns"
