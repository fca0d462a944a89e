"""What controllers ask is answered as Webots' own package answers it, or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from webots_mcp.standin import Simulation

HERE = Path(__file__).parent
LACKING = "EXC NotInStandInError: the stand-in has no "
PAGE = "; see 'webots-mcp help standin' for what it has"


class Asked(NamedTuple):
    """An expression and what the real package makes of it."""

    number: int
    expression: str
    answers: tuple[str, ...]
    """That of both releases, or those of R2023b and R2025a."""
    printed: str


def asked() -> Iterator[Asked]:
    lines = (HERE / "real_answers.tsv").read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, start=1):
        if line and not line.startswith(("# ", "== ")):
            expression, answer, *printed = line.split("\t")
            answers = tuple(part.partition(" ")[2] for part in answer.split(" | R"))
            answers = answers if answer.startswith("R20") else (answer,)
            yield Asked(number, expression, answers, "".join(printed))


def answers_of_the_stand_in(expressions: list[str], tmp_path: Path) -> list[tuple[str, str]]:
    questions, answers = tmp_path / "questions.txt", tmp_path / "answers.json"
    questions.write_text("\n".join(expressions), encoding="utf-8")
    world = tmp_path / "worlds" / "host.wbt"
    world.parent.mkdir()
    world.write_bytes((HERE / "asked_host.wbt").read_bytes())
    controllers = {"rover": HERE / "asking.py"}
    files = {"ASKED": str(questions), "ANSWERS": str(answers)}
    with Simulation(world, mode="fast", controllers=controllers, environment=files) as simulation:
        simulation.wait_for(answers.exists, timeout_s=60)
        simulation.wait_for(lambda: not simulation.controller("rover").is_running, timeout_s=60)
    return [(answer, printed) for answer, printed in json.loads(answers.read_text("utf-8"))]


@pytest.mark.skipif(os.name != "posix", reason="the table was made on Linux")
def test_each_expression_is_answered_as_in_webots_or_refused_with_the_page(
    tmp_path: Path,
) -> None:
    table = [*asked()]
    assert len(table) == 588
    found = answers_of_the_stand_in([entry.expression for entry in table], tmp_path)
    other: list[str] = []
    for entry, (answer, printed) in zip(table, found, strict=True):
        is_refused = answer.startswith(LACKING) and answer.endswith(PAGE)
        if is_refused:
            continue
        if answer not in entry.answers or printed != entry.printed:
            wanted = f"{' or '.join(entry.answers)} {entry.printed}"
            other.append(f"{entry.number}: {entry.expression}\n  {answer} {printed}\n  {wanted}")
    assert not other, "\n".join([f"{len(other)} of {len(table)} differ", *other])
