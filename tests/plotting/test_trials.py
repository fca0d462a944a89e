"""Pictures of trials: what they show, and what cannot be drawn."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from PIL import Image

from tests.memory import memory_connection
from tests.plotting.test_pictures import words
from webots_mcp.errors import InvalidInputError, NothingRecordedError
from webots_mcp.plotting import plot
from webots_mcp.plotting.canvas import Sheet
from webots_mcp.plotting.trials import compose_trials, plot_trials
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

SVG = Sheet(image_format="svg")
Tried = Callable[..., sqlite3.Connection]


@pytest.fixture
def tried() -> Iterator[Tried]:
    """A trial set with these parameters and scores; without a score it failed."""
    with memory_connection() as connection:

        def write(*trials: tuple[dict[str, Any], float | None]) -> sqlite3.Connection:
            values = [parameters for parameters, _ in trials]
            set_id = create_trial_set(connection, '{"score": "max(x)"}', values)
            for trial, (_, score) in zip(trials_of(connection, set_id), trials, strict=True):
                finish_trial(
                    connection, trial, TrialResult(None, score, None if score else "it fell")
                )
            return connection

        yield write


def test_over_one_parameter_each_score_its_mean_and_the_best_are_shown(tried: Tried) -> None:
    connection = tried(
        ({"kp": 1.0}, 4.0), ({"kp": 1.0}, 5.0), ({"kp": 2.0}, 9.0), ({"kp": 3.0}, None)
    )
    picture = plot(connection, trial_set=1)
    assert Image.open(io.BytesIO(picture.data)).size == (900, 500)
    assert picture.caption == "trial set 1, 4 trials: max(x) over kp"
    shown = words(plot_trials(connection, 1, sheet=SVG))
    assert shown >= {"kp", "score", "best", "one trial", "with failures"}
    assert "trial set 1, 4 trials: max(x)" in shown
    assert "mean, and least to greatest" in shown


def test_over_two_parameters_each_cell_has_its_mean_and_spread(tried: Tried) -> None:
    grid = [{"kp": kp, "gait": gait} for kp in (1.0, 2.0) for gait in ("trot", "walk")]
    scores = [4.0, 5.0, 9.0, None]
    connection = tried(*zip(grid, scores, strict=True), ({"kp": 1.0, "gait": "trot"}, 6.0))
    shown = " ".join(words(plot_trials(connection, 1, sheet=SVG)))
    for text in ("kp", "gait", "trot", "walk", "4 to 6", "9", "1 failed", "best"):
        assert text in shown, text


def test_values_that_are_no_numbers_stand_in_a_row(tried: Tried) -> None:
    connection = tried(({"gait": "trot"}, 4.0), ({"gait": "walk"}, 5.0), ({"gait": "hop"}, 6.0))
    assert words(plot_trials(connection, 1, sheet=SVG)) >= {"trot", "walk", "hop"}


def test_one_of_several_parameters_is_drawn_over_all_values_of_the_others(tried: Tried) -> None:
    grid = [{"kp": kp, "ki": ki, "kd": 1.0} for kp in (1.0, 2.0) for ki in (0.1, 0.2)]
    connection = tried(*((values, values["kp"] + values["ki"]) for values in grid))
    plot_of, notes = compose_trials(connection, 1, ["kp"])
    assert [(each.parameters, len(each.scores)) for each in plot_of.sets] == [
        ({"kp": 2.0}, 2),
        ({"kp": 1.0}, 2),
    ]
    assert notes == ("each over all values of ki",)
    assert compose_trials(connection, 1)[0].names == ["kp", "ki"]


def test_what_cannot_be_drawn_is_refused(tried: Tried) -> None:
    connection = tried(({"kp": 1.0, "ki": 1.0, "kd": 1.0}, 4.0))
    with pytest.raises(InvalidInputError, match=r"did not try 'kq'\. They tried kp"):
        plot_trials(connection, 1, ["kq"])
    with pytest.raises(InvalidInputError, match="3 parameters are named, but only one or two"):
        plot_trials(connection, 1, ["kp", "ki", "kd"])
    with pytest.raises(InvalidInputError, match=r"No trial set 7 is recorded\. The newest is 1"):
        plot_trials(connection, 7)
    tried(({"kp": 1.0}, None))
    with pytest.raises(NothingRecordedError, match="No trial of set 2 has a score"):
        plot_trials(connection, 2)
