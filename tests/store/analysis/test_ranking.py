"""Which parameters did best is told with how sure that is."""

from __future__ import annotations

import random

import pytest

from webots_mcp.store.analysis.ranking import Best, Outcome, rank


def outcomes(**scores: list[float | None]) -> list[Outcome]:
    return [
        Outcome({"kp": float(name[1:])}, score, None if score is not None else "crashed at 3 s")
        for name, group in scores.items()
        for score in group
    ]


@pytest.mark.parametrize(("best", "order"), [("highest", [2, 3, 1]), ("lowest", [1, 3, 2])])
def test_sets_are_ranked_by_their_median(best: Best, order: list[float]) -> None:
    ranking = rank(outcomes(k1=[1.0, 1.1, 9.0], k2=[5.0, 5.1, 5.2], k3=[2.0, 2.1, 2.2]), best)

    assert [each.parameters["kp"] for each in ranking.sets] == order
    assert ranking.sets[order.index(1)].score == (1.1, 1.0, 9.0)


def test_a_set_with_failures_comes_after_those_without_and_names_them() -> None:
    ranking = rank(outcomes(k1=[1.0, 1.1], k2=[9.0, None], k3=[None, None]))

    assert [each.parameters["kp"] for each in ranking.sets] == [1, 2, 3]
    assert ranking.sets[1].failures == ["crashed at 3 s"]
    assert ranking.sets[2].score is None
    assert (ranking.better, ranking.verdict) == (None, "every other parameter set had failures")


def test_one_repeated_set_tells_the_noise_of_all() -> None:
    ranking = rank(outcomes(k1=[1.0, 1.001, 0.999], k2=[5.0], k3=[2.0]))

    assert ranking.noise == (pytest.approx(0.001), 2)
    assert ranking.better
    assert rank(outcomes(k1=[1.0, 4.0], k2=[5.0], k3=[2.0])).better is False


def test_repeats_that_agree_to_the_last_digit_leave_no_doubt() -> None:
    assert rank(outcomes(k1=[1.0, 1.0], k2=[1.1])).better
    assert rank(outcomes(k1=[1.0, 1.0], k2=[1.0])).better is False


def test_without_repeats_nobody_can_tell_whether_the_best_is_better() -> None:
    ranking = rank(outcomes(k1=[1.0], k2=[5.0]))

    assert (ranking.better, ranking.chance) == (None, None)
    assert "not known" in ranking.verdict


def test_noise_alone_is_called_better_at_most_once_in_a_hundred_sets() -> None:
    source = random.Random(7)
    told = 0
    for _ in range(2000):
        groups = {f"k{i}": [source.gauss(0, 1) for _ in range(3)] for i in range(5)}
        told += bool(rank(outcomes(**groups)).better)  # pyright: ignore[reportArgumentType]

    assert told <= 20


def test_nothing_that_gave_a_score_is_said_so() -> None:
    assert rank(outcomes(k1=[None])).verdict == "no trial gave a score"
    assert rank([]).verdict == "no trial gave a score"
