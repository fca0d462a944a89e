"""What bodies are called in signals: words that are their own, whatever their names hold."""

from __future__ import annotations

import pytest

from webots_mcp.signals.conditions.compiler import parse_condition
from webots_mcp.simulator.observed_bodies import word_of


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("ROVER", "ROVER"),
        ("e-puck", "e_puck"),
        ("2nd.robot", "_2nd_robot"),
        ("robot(1)", "robot_1_"),
        ("and", "_and"),
        ("Wagen mit O\u0308l", "Wagen_mit_Öl"),
        ("机器人", "机器人"),
        ("", "robot"),
        ("\n[0].x", "__0__x"),
    ],
)
def test_a_name_becomes_a_word_that_conditions_read(name: str, word: str) -> None:
    assert word_of(name, ()) == word
    assert parse_condition(f"world.{word}.x_m > 1").signals == (f"world.{word}.x_m",)


def test_equal_names_are_told_apart() -> None:
    taken: list[str] = []
    for _ in range(3):
        taken.append(word_of("e-puck", taken))
    assert taken == ["e_puck", "e_puck_2", "e_puck_3"]
