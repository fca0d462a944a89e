"""Which parameters did best is told with how sure that is."""

from __future__ import annotations

import random

import pytest

from webots_mcp.store.analysis.spread import Best, Outcome, rank


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


def test_a_set_that_is_exact_by_chance_does_not_beat_noisy_ones() -> None:
    source = random.Random(3)
    for repeats in ([1] * 4, [2] * 4, [3] * 4):
        told = 0
        for _ in range(600):
            noisy = {f"k{i}": [source.gauss(0, 1) for _ in range(n)] for i, n in enumerate(repeats)}
            exact = [source.gauss(0, 1)] * 2
            told += bool(rank(outcomes(k9=exact, **noisy)).better)  # pyright: ignore[reportArgumentType]
        assert told <= 6


def test_repeats_that_agree_to_the_last_digit_are_no_proof_before_there_are_enough() -> None:
    few = rank(outcomes(k1=[1.0] * 3, k2=[1.1] * 3))
    assert (few.better, few.verdict.partition(": ")[2]) == (None, "repeat each 4 times")
    assert rank(outcomes(k1=[1.0] * 4, k2=[1.1] * 4)).better


@pytest.mark.parametrize("often", [0.5, 0.9, 0.02])
def test_counts_that_agree_by_chance_are_called_better_at_most_once_in_a_hundred_sets(
    often: float,
) -> None:
    source = random.Random(5)
    for repeats in (2, 4, 6):
        told = 0
        for _ in range(1000):
            groups = {
                f"k{i}": [float(source.random() < often) for _ in range(repeats)] for i in range(2)
            }
            told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]
        assert told <= 15


@pytest.mark.parametrize("repeats", [2, 3, 4, 6])
def test_a_few_trials_that_happened_to_fall_over_do_not_make_the_others_better(
    repeats: int,
) -> None:
    """Of sets that fall over as often; of two trials each one in ten was called better."""
    source = random.Random(7)
    told = 0
    for _ in range(600):
        groups = {
            f"k{i}": [100.0 * (source.random() < 0.5) + source.gauss(0, 1) for _ in range(repeats)]
            for i in range(2)
        }
        told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]
    assert told <= 12


def test_a_clear_effect_is_found_in_half_of_all_rankings() -> None:
    """Three deviations, with four repeats."""
    source = random.Random(11)
    told = 0
    for _ in range(300):
        groups = {f"k{i}": [source.gauss(3 * (i == 0), 1) for _ in range(4)] for i in range(2)}
        told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]
    assert told >= 150


def test_scores_that_are_all_equal_are_told_so() -> None:
    ranking = rank(outcomes(k1=[0.0, 0.0], k2=[0.0], k3=[0.0, None]))
    assert ranking.better is None
    assert ranking.verdict == "all 4 scores are 0: no tried value changed the score"


def test_without_repeats_nobody_can_tell_whether_the_best_is_better() -> None:
    ranking = rank(outcomes(k1=[1.0], k2=[5.0]))

    assert (ranking.better, ranking.chance) == (None, None)
    assert "unknown" in ranking.verdict


def test_noise_alone_is_called_better_at_most_once_in_a_hundred_sets() -> None:
    source = random.Random(7)
    told = 0
    for _ in range(2000):
        groups = {f"k{i}": [source.gauss(0, 1) for _ in range(3)] for i in range(5)}
        told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]

    assert told <= 20


def test_nothing_that_gave_a_score_is_said_so() -> None:
    assert rank(outcomes(k1=[None])).verdict == "no trial has a score"
    assert rank([]).verdict == "no trial has a score"
