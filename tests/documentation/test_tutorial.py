"""docs/tutorial.md, done from its first step to its last: each block, and what it prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import resvg_py

from docs import pictures, walkthrough
from tests.documentation.test_pictures import ANEW, DRAWN, NEAR, difference

PAGE = walkthrough.PAGE.read_text("utf-8")


def form(text: str) -> str:
    """Without numbers and spaces: machines differ in pace, and columns in width."""
    return re.sub(r"\s+", " ", re.sub(r"\d+(\.\d+)?", "#", text)).strip()


@pytest.mark.slow
def test_each_step_prints_what_the_page_shows(tmp_path: Path) -> None:
    terminal, shown = walkthrough.Terminal(tmp_path), 0
    for step, printed in walkthrough.follow(PAGE, terminal):
        if step.language == "text" and step.file is None:
            for line in step.text.splitlines():
                assert form(line) in form(printed)
                shown += 1
    assert shown > 5
    for shown_as, drawn_as in pictures.TUTORIAL_PLOTS.items():
        drawn = terminal.folder / drawn_as
        assert drawn.read_bytes().startswith(b"\x89PNG")
        if resvg_py.__version__ == DRAWN["by"]["resvg"]:
            assert difference(drawn, pictures.IMAGES / shown_as) < NEAR, f"{shown_as} {ANEW}"


def test_its_pictures_are_those_that_its_steps_draw() -> None:
    assert re.findall(r"images/tutorial-(\w+)\.png", PAGE) == re.findall(r"-o (\w+)\.png", PAGE)
