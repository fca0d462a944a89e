"""docs/tutorial.md, done from its first step to its last: each block, and what it prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs import walkthrough

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
    for name in re.findall(r"-o (\w+\.png)", PAGE):
        assert (terminal.folder / name).read_bytes().startswith(b"\x89PNG")


def test_its_pictures_are_those_that_its_steps_draw() -> None:
    assert re.findall(r"images/tutorial-(\w+)\.png", PAGE) == re.findall(r"-o (\w+)\.png", PAGE)
