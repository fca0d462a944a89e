"""Makes the pictures of the pages, and the README's conversation, anew: `python -m docs.pictures`.

They show the world and the controller of `webots-mcp demo`, up to a breakpoint at a certain step.
`images/drawn.json` says what was drawn by what; a test does the same again and compares.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import closing, redirect_stdout, suppress
from io import BytesIO, StringIO
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import anyio
import resvg_py
from PIL import Image

from webots_mcp.cli import main as webots_mcp
from webots_mcp.contract import DATABASE_NAME, THROTTLE_VARIABLE
from webots_mcp.database.connection import connect
from webots_mcp.plugins.demo import demo_command as demo
from webots_mcp.testing import RecordedSimulation

CHECKOUT: Final = Path(__file__).parent.parent
README: Final = CHECKOUT / "README.md"
IMAGES: Final = Path(__file__).parent / "images"
DRAWN: Final = IMAGES / "drawn.json"
BREAKPOINT: Final = "pose.y < -1.6"  # held first after some 28 s
# What is drawn, as the options of `webots-mcp plot`.
PLOTS: Final = {
    "signals.png": "lidar.nearest_m distance_m.left distance_m.right wheel_radps.left --height 520",
    "way.png": "--trajectory --height 620",
}
# What a person would say, and the tool call that an assistant makes of it.
TURNS: Final[tuple[demo.Turn, ...]] = (
    (
        "When did it begin and end to turn in the first ten seconds, and was it ever stuck?",
        "webots_find_events",
        {"kinds": ["change", "stuck"], "signals": ["mode"], "end_s": 10},
    ),
)
CHROMIUM: Final = shutil.which("chromium") or shutil.which("chromium-browser")
FIGURES_ARE_THERE: Final = """() => document.querySelector(".figure > svg")
    && [...document.querySelectorAll(".figure > svg")].every(each => each.parentNode.figure)"""
CONVERSATION: Final = re.compile(r"(?<=<!-- conversation -->\n```text\n).*?(?=^```$)", re.M | re.S)


def recorded(folder: Path) -> RecordedSimulation:
    """The demo's robot in its world; not started yet."""
    return RecordedSimulation(data_dir=folder, environment={THROTTLE_VARIABLE: "5"})


def drive(simulation: RecordedSimulation, data_dir: Path) -> None:
    """Let it drive to the breakpoint, at which its bridge pauses it and goes on answering."""
    simulation.resume()
    simulation.wait_for(lambda: _has_states(data_dir / DATABASE_NAME), 60.0)
    _run("breakpoint", BREAKPOINT, "--data-dir", str(data_dir))
    simulation.run_for(120.0)


def _has_states(database: Path) -> bool:
    """Whether a controller has recorded there; a database without tables is being made."""
    if not database.exists():
        return False
    with closing(connect(database, "reader")) as connection, suppress(sqlite3.OperationalError):
        return connection.execute("SELECT 1 FROM state LIMIT 1").fetchone() is not None
    return False


def draw_plots(data_dir: Path, images: Path) -> None:
    """Draw what was recorded there."""
    images.mkdir(exist_ok=True)
    for name, options in PLOTS.items():
        where = ("--data-dir", str(data_dir), "-o", str(images / name))
        _run("plot", *options.split(), *where)


def photograph_report(browser: Any, data_dir: Path, images: Path) -> None:
    """The part of a report that says what happened, as a browser shows it."""
    file = data_dir / "run.html"
    _run("report", "1", "-o", str(file), "--data-dir", str(data_dir))
    page = browser.new_page(viewport={"width": 900, "height": 900})
    page.goto(f"{file.as_uri()}#happened-1")
    page.wait_for_function(FIGURES_ARE_THERE, timeout=120_000)
    _save(page, images / "report.png")


def photograph_page(browser: Any, data_dir: Path, images: Path) -> None:
    """The live page, as a browser shows it."""
    options = ["--port", "0", "--no-browser", "--data-dir", str(data_dir)]
    line = [sys.executable, "-m", "webots_mcp", "view", *options]
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        try:
            assert server.stdout is not None
            (address,) = re.findall(r"http://\S+", server.stdout.readline())
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(address)
            page.wait_for_function(FIGURES_ARE_THERE, timeout=120_000)
            _save(page, images / "page.png")
        finally:
            server.terminate()


def _run(*arguments: str) -> None:
    if webots_mcp(arguments):
        raise RuntimeError(f"webots-mcp {' '.join(arguments)} failed")


def _save(page: Any, file: Path) -> None:
    """What is seen of a page, in 256 colours, which make a small file."""
    page.wait_for_timeout(1000)  # figures are painted after they are there
    seen = Image.open(BytesIO(page.screenshot())).convert("RGB")
    seen.quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)


@contextlib.contextmanager
def started_browser() -> Generator[Any]:
    """A Chromium, driven by Playwright."""
    from playwright.sync_api import sync_playwright

    options = ["--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=options)
        yield browser
        browser.close()


def means(simulation: RecordedSimulation) -> dict[str, float]:
    """What was drawn, in a few numbers: the mean of each signal of numbers."""
    values = {each.name: each.values() for each in simulation.recording.signals()}
    numbers = {name: [v for v in each if isinstance(v, float)] for name, each in values.items()}
    return {name: round(fmean(each), 4) for name, each in numbers.items() if each}


def conversation(data_dir: Path) -> str:
    """What a person asks, what is called and what is answered, as the demo prints it."""
    with redirect_stdout(StringIO()) as out:
        anyio.run(demo.converse, data_dir, TURNS)
    return re.sub(r"(?m)^  \(.* s\)\n", "", out.getvalue()).lstrip()


def main() -> int:
    """Make all of it."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder)
        simulation = recorded(data_dir)
        with simulation:
            drive(simulation, data_dir)
            draw_plots(data_dir, IMAGES)
            with started_browser() as browser:
                photograph_report(browser, data_dir, IMAGES)
                photograph_page(browser, data_dir, IMAGES)
                by = {"resvg": resvg_py.__version__, "chromium": browser.version}
            drawn = {"by": by, "means": means(simulation)}
            DRAWN.write_text(json.dumps(drawn, indent=2) + "\n", "utf-8")
            said = conversation(data_dir)
    README.write_text(CONVERSATION.sub(lambda _: said, README.read_text("utf-8")), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
