"""The pictures and conversations of the pages are such as come about today."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import resvg_py
from PIL import Image, ImageChops, ImageStat

from docs import pictures
from webots_mcp.testing import RecordedSimulation

pytestmark = pytest.mark.slow
DRAWN = json.loads(pictures.DRAWN.read_text("utf-8"))
MOST_BYTES = 150_000
MOST_ANIMATED_BYTES = 2_000_000
# Mean difference of the channels, of 255: 0 where the same is drawn, 1.9 and more where it is
# drawn of a recording that is a second shorter.
NEAR = 0.5
ANEW = "looks otherwise today: look at what `python -m docs.pictures` makes, and commit it"


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recorded")


@pytest.fixture(scope="module")
def simulation(data_dir: Path) -> Iterator[RecordedSimulation]:
    simulation = pictures.recorded(data_dir)
    with simulation:
        pictures.drive(simulation, data_dir)
        yield simulation


def test_what_was_drawn_is_what_the_demo_records(simulation: RecordedSimulation) -> None:
    assert pictures.means(simulation) == pytest.approx(DRAWN["means"], rel=0.02, abs=0.02)


@pytest.mark.usefixtures("simulation")
def test_the_plots_look_as_they_are_drawn_today(data_dir: Path, tmp_path: Path) -> None:
    if resvg_py.__version__ != DRAWN["by"]["resvg"]:
        pytest.skip("another version of resvg drew the pictures")
    pictures.draw_plots(data_dir, tmp_path)
    for name in pictures.PLOTS:
        assert difference(tmp_path / name, pictures.IMAGES / name) < NEAR, f"{name} {ANEW}"


@pytest.mark.usefixtures("simulation")
def test_the_clip_looks_as_it_is_made_today(data_dir: Path, tmp_path: Path) -> None:
    if resvg_py.__version__ != DRAWN["by"]["resvg"]:
        pytest.skip("another version of resvg drew the pictures")
    pictures.draw_clip(data_dir, tmp_path)
    assert difference(tmp_path / pictures.CLIP, pictures.IMAGES / pictures.CLIP) < NEAR, ANEW


@pytest.mark.usefixtures("simulation")
def test_the_pages_look_as_a_browser_shows_them_today(data_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("playwright", reason="Playwright is not installed")
    if pictures.CHROMIUM is None:
        pytest.skip("there is no Chromium")
    with pictures.started_browser() as browser:
        if browser.version != DRAWN["by"]["chromium"]:
            pytest.skip("another version of Chromium took the pictures")
        pictures.photograph_report(browser, data_dir, tmp_path)
        pictures.photograph_page(browser, data_dir, tmp_path)
    for name in ("report.png", "page.png"):
        assert difference(tmp_path / name, pictures.IMAGES / name) < NEAR, f"{name} {ANEW}"


def test_the_readme_has_the_conversation_of_today(tmp_path: Path) -> None:
    (shown,) = pictures.CONVERSATION.findall(pictures.README.read_text("utf-8"))
    with pictures.stuck_explorer(tmp_path) as data_dir:
        lines = pictures.conversation(data_dir)
    assert form("\n".join(lines) + "\n") == form(shown), f"the README's conversation {ANEW}"


def test_the_pages_and_the_readme_have_the_conversations_of_today(tmp_path: Path) -> None:
    readme = pictures.README.read_text("utf-8")
    for question, lines in pictures.demo_conversations(tmp_path).items():
        page = (pictures.CHECKOUT / "docs" / pictures.PAGES_OF[question]).read_text("utf-8")
        for text in (page, readme):
            (shown,) = pictures.shown_of(question).findall(text)
            assert form("\n".join(lines) + "\n") == form(shown), f"the conversation {ANEW}"


def test_pictures_are_small_and_each_is_shown() -> None:
    pages = [pictures.README, *pictures.CHECKOUT.glob("docs/*.md")]
    text = "".join(page.read_text("utf-8") for page in pages)
    shown = set(re.findall(r"!\[.+\]\(\S*?images/(\S+)\)", text))
    made = {file.name: file.stat().st_size for file in pictures.IMAGES.glob("*.[pg][ni][gf]")}
    assert made.keys() == shown
    assert made.pop(pictures.ANIMATION) < MOST_ANIMATED_BYTES
    assert max(made.values()) < MOST_BYTES


def form(text: str) -> str:
    """Without numbers: when a step is asked for depends on the machine."""
    return re.sub(r" +", " ", re.sub(r"-?\d+(\.\d+)?(e-\d+)?", "#", text))


def difference(one: Path, other: Path) -> float:
    """Of two pictures, looked at from so far away that single pixels do not count."""
    small = [Image.open(file).convert("RGB").resize((90, 54), Image.Resampling.BOX)
             for file in (one, other)]  # fmt: skip
    means = ImageStat.Stat(ImageChops.difference(*small)).mean
    return sum(means) / len(means)
