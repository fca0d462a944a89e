"""Which parameters did best is told with how sure that is."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from webots_mcp.analysis.summary import Best, Outcome, rank


def outcomes(**scores: list[float | None]) -> list[Outcome]:
    return [
        Outcome({"kp": float(name[1:])}, score, None if score is not None else "crashed at 3 s")
        for name, group in scores.items()
        for score in group
    ]


@pytest.mark.parametrize(("best", "order"), [("highest", [2, 1, 3]), ("lowest", [3, 1, 2])])
def test_sets_are_ranked_by_their_mean(best: Best, order: list[float]) -> None:
    ranking = rank(outcomes(k1=[1.0, 1.1, 9.0], k2=[5.0, 5.1, 5.2], k3=[2.0, 2.1, 2.2]), best)

    assert [each.parameters["kp"] for each in ranking.sets] == order
    assert ranking.sets[order.index(1)].score == (pytest.approx(3.7), 1.0, 9.0)


def test_a_set_with_failures_comes_after_those_without_and_names_them() -> None:
    ranking = rank(outcomes(k1=[1.0, 1.1], k2=[9.0, None], k3=[None, None]))

    assert [each.parameters["kp"] for each in ranking.sets] == [1, 2, 3]
    assert ranking.sets[1].failures == ["crashed at 3 s"]
    assert ranking.sets[2].score is None
    assert (ranking.better, ranking.verdict) == (None, "every other parameter set had failures")


def test_a_set_is_better_only_where_the_repeats_of_both_show_it() -> None:
    near: list[float | None] = [1.0, 1.001, 0.999, 1.0]
    far: list[float | None] = [5.0, 5.001, 4.999, 5.0]
    ranking = rank(outcomes(k1=near, k2=far, k3=[2.0, 2.1]))

    assert ranking.noise == (pytest.approx(0.0267, abs=0.001), 7)
    assert ranking.better is None, "two trials do not tell how much they differ"
    assert rank(outcomes(k1=near, k2=far)).better
    once = rank(outcomes(k1=[1.0, 1.001, 0.999], k2=[5.0]))
    assert (once.better, once.chance) == (None, None)
    assert "not both repeated" in once.verdict


def test_repeats_that_agree_to_the_last_digit_are_no_proof_before_there_are_enough() -> None:
    few = rank(outcomes(k1=[1.0] * 3, k2=[1.1] * 3))
    assert (few.better, few.verdict.partition(": ")[2]) == (None, "repeat each 4 times")
    assert rank(outcomes(k1=[1.0] * 4, k2=[1.1] * 4)).better


def exact(dice: random.Random, at: int, repeats: int) -> list[float]:
    """The first of the sets has the same score twice."""
    return [dice.gauss(0, 1)] * 2 if at == 0 else [dice.gauss(0, 1) for _ in range(repeats)]


def falling_over(dice: random.Random, at: int, repeats: int) -> list[float]:
    return [100.0 * (dice.random() < 0.5) + dice.gauss(0, 1) for _ in range(repeats)]


def counted(dice: random.Random, at: int, repeats: int) -> list[float]:
    return [float(dice.random() < 0.9) for _ in range(repeats)]


def alike(dice: random.Random, at: int, repeats: int) -> list[float]:
    return [dice.gauss(0, 1) for _ in range(repeats)]


def effective(dice: random.Random, at: int, repeats: int) -> list[float]:
    """Three deviations."""
    return [dice.gauss(3 * (at == 0), 1) for _ in range(repeats)]


@pytest.mark.parametrize(
    ("draw", "sets", "repeats", "least", "most"),
    [
        *((exact, 5, repeats, 0, 6) for repeats in (1, 2, 3)),
        *((falling_over, 2, repeats, 0, 12) for repeats in (2, 3, 4, 6)),
        *((counted, 2, repeats, 0, 9) for repeats in (2, 4, 6)),
        (alike, 5, 3, 0, 6),
        (effective, 2, 4, 300, 600),
    ],
)
def test_of_six_hundred_rankings_chance_alone_makes_hardly_one_better_and_an_effect_half(
    draw: Callable[[random.Random, int, int], list[float]],
    sets: int, repeats: int, least: int, most: int,
) -> None:  # fmt: skip
    dice, told = random.Random(7), 0
    for _ in range(600):
        groups = {f"k{at}": draw(dice, at, repeats) for at in range(sets)}
        told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]
    assert least <= told <= most


def test_scores_that_are_all_equal_are_told_so() -> None:
    ranking = rank(outcomes(k1=[0.0, 0.0], k2=[0.0], k3=[0.0, None]))
    assert ranking.better is None
    assert ranking.verdict == "all 4 scores are 0: no tried value changed the score"


def test_without_repeats_nobody_can_tell_whether_the_best_is_better() -> None:
    ranking = rank(outcomes(k1=[1.0], k2=[5.0]))

    assert (ranking.better, ranking.chance) == (None, None)
    assert "unknown" in ranking.verdict


def test_nothing_that_gave_a_score_is_said_so() -> None:
    assert rank(outcomes(k1=[None])).verdict == "no trial has a score"
    assert rank([]).verdict == "no trial has a score"
