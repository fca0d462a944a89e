"""Makes the pictures and conversations of the pages anew: `python -m docs.pictures`.

Most show the world and the controller of `webots-mcp demo`, up to a breakpoint at a certain step.
The first conversation, its animation and the tutorial's pictures show the robot of the tutorial.
`images/drawn.json` says what was drawn by what; a test does the same again and compares.
"""

from __future__ import annotations

import base64
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
from html import escape
from io import BytesIO, StringIO
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import anyio
import resvg_py
from PIL import Image

from docs import walkthrough
from webots_mcp.cli import main as webots_mcp
from webots_mcp.contract import DATABASE_NAME, THROTTLE_VARIABLE
from webots_mcp.database.connection import connect
from webots_mcp.database.tapes.tape_wanted import TAPE_VARIABLE
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
# Drawn by the steps of the tutorial, under these names in its folder.
TUTORIAL_PLOTS: Final = {"tutorial-stuck.png": "stuck.png", "tutorial-paths.png": "paths.png"}
ANIMATION: Final = "conversation.gif"
CLIP: Final = "clip.png"
# What a person asks of the tutorial's robot, and the calls that an assistant makes to find out.
QUESTION: Final = "Why did the explorer stop?"
TURNS: Final[tuple[demo.Turn, ...]] = (
    (QUESTION, "webots_check_run", {}),
    (QUESTION, "webots_get_trends", {"signals": ["proximity.*"]}),
)
DRIVEN_S: Final = 30.0
CHROMIUM: Final = shutil.which("chromium") or shutil.which("chromium-browser")
_WINDOW: Final = """<!doctype html><meta charset="utf-8"><style>
body {{ margin: 0; background: #1b1e24; color: #d7dae0; font: 15px/1.5 monospace; }}
header {{ background: #2a2e37; color: #8a909c; padding: 6px 14px; font-size: 13px; }}
pre {{ margin: 0; padding: 14px 18px; font: inherit; white-space: pre-wrap; }}
img {{ display: block; margin: 0 18px; width: 500px; border-radius: 4px; }}
</style><header>an assistant, connected to webots-mcp</header><pre>{text}</pre>{picture}"""
# What a person asks of the demo's robot, with the page that shows the answer; the README has both.
INSIDE: Final = "What were the variables when it turned?"
EDITED: Final = "Would my edit have braked earlier?"
PAGES_OF: Final = {INSIDE: "inspect.md", EDITED: "rerun.md"}
TURNED: Final = "changed(mode)"  # It begins to turn after some 5 s.
EDIT: Final = ('"near", 0.35', '"near", 0.5')
ROVER: Final = Path("controllers/rover/rover.py")
FIGURES_ARE_THERE: Final = """() => document.querySelector(".figure > .stage > svg")
    && [...document.querySelectorAll(".figure > .stage")].every(each => each.parentNode.figure)"""
CONVERSATION: Final = re.compile(r"(?<=<!-- conversation -->\n```text\n).*?(?=^```$)", re.M | re.S)


def shown_of(question: str) -> re.Pattern[str]:
    """The lines of a page that show the conversation about a question."""
    return re.compile(rf"(?ms)^> {re.escape(question)}\n.*?(?=^```$|^$)")


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


def draw_clip(data_dir: Path, images: Path) -> None:
    """Draw the contact sheet of the clip of the breakpoint."""
    sheet = data_dir / CLIP
    where = ("--data-dir", str(data_dir), "-o", str(data_dir / "clip.webp"))
    _run("clip", "--before", "4", "--after", "0", "--sheet", str(sheet), *where)
    drawn: Any = Image.open(sheet)
    images.mkdir(exist_ok=True)
    drawn.quantize(64, dither=Image.Dither.NONE).save(images / CLIP, optimize=True)


def photograph_report(browser: Any, data_dir: Path, images: Path) -> None:
    """The beginning of a report, which says what happened, as a browser shows it."""
    file = data_dir / "run.html"
    _run("report", "1", "-o", str(file), "--data-dir", str(data_dir))
    page = browser.new_page(viewport={"width": 900, "height": 900})
    page.goto(file.as_uri())
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


@contextlib.contextmanager
def stuck_explorer(folder: Path) -> Generator[Path]:
    """Let the tutorial's robot drive until it is stuck; yields the folder of its recording."""
    world, data_dir = walkthrough.write_project(folder), folder / "mcp_data"
    simulation = RecordedSimulation(world, data_dir=data_dir)
    with simulation:
        simulation.run_for(DRIVEN_S)
        yield data_dir


def conversation(data_dir: Path) -> list[str]:
    """Ask an MCP server about the tutorial's robot; return the lines that a client shows.

    The calls and answers are those of the server. The last line is written here, with figures of
    the answers.
    """
    with redirect_stdout(StringIO()):
        checked, trends = anyio.run(demo.converse, data_dir, TURNS)
    table = checked["answer"]["checks"]
    failed = dict(zip(table["columns"], table["rows"][0], strict=True))
    evidence, since = failed["evidence"].partition(";")[0], f"{failed['start_s']:.1f} s"
    (run,) = trends["answer"]["runs"]
    ((signal, course, *_),) = run["numbers"]["rows"]
    return [
        f"> {QUESTION}",
        f"● {_call(*TURNS[0])}",
        f"  └ {failed['check']}: {failed['outcome']}, {evidence}, since {since}",
        f"● {_call(*TURNS[1])}",
        f"  └ {signal} {course.partition(';')[0]}; constant: {run['constant']}",
        f"● At {since} it hit something that only its left eye saw. "
        "Your code asks only the right eye.",
    ]


def demo_conversations(folder: Path) -> dict[str, list[str]]:
    """Ask an MCP server about the demo's robot and an edit of its code; return the lines of each.

    The calls and answers are those of the server. The last lines are written here, with figures of
    the answers.
    """
    for part in ("worlds/arena.wbt", ROVER):
        (folder / part).parent.mkdir(parents=True)
        shutil.copyfile(CHECKOUT / "examples" / part, folder / part)
    data_dir = folder / "mcp_data"
    simulation = RecordedSimulation(
        folder / "worlds/arena.wbt", data_dir=data_dir, environment={TAPE_VARIABLE: "1"}
    )
    with simulation:
        simulation.resume()
        simulation.wait_for(lambda: _has_states(data_dir / DATABASE_NAME), 60.0)
        with redirect_stdout(StringIO()):
            _run("breakpoint", TURNED, "--action", "log", "--data-dir", str(data_dir))
        simulation.reset()
        simulation.run_for(7.0)
    code = (folder / ROVER).read_text("utf-8")
    (folder / ROVER).write_text(code.replace(*EDIT), "utf-8")
    with closing(connect(data_dir / DATABASE_NAME, "reader")) as connection:
        event_id, run_id = connection.execute(
            "SELECT max(id), max(run_id) FROM event WHERE kind = 'inspection' "
            "AND sim_time_s = (SELECT min(sim_time_s) FROM event WHERE kind = 'inspection')"
        ).fetchone()
    turns: tuple[demo.Turn, ...] = (
        (INSIDE, "webots_inspect_controller", {"event_id": event_id}),
        (EDITED, "webots_rerun_controller", {"run_id": run_id}),
    )
    with redirect_stdout(StringIO()):
        inspected, rerun = (each["answer"] for each in anyio.run(demo.converse, data_dir, turns))
    rover = inspected["frames"][0]["variables"]["rover"]
    seen_m, since_s = rover["distances_m"], rover["mode_since_s"]
    names = ("mode", "mode_since_s", "turn_sign", "distances_m")
    values = ", ".join(f"{name} {json.dumps(rover[name])}" for name in names)
    left, *_, decided = rerun["verdict"].split("; ")
    at_s, held = rerun["equal_until_s"], rerun["deciding_line"]["new_values"]
    right_m, limit_m = float(held["right"]), held["self.near.value"]
    return {
        INSIDE: [
            f"> {INSIDE}",
            f"● {_call(*turns[0])}",
            f"  └ {inspected['frames'][0]['at']}, main(): rover: {values}",
            f"● Its right eye saw something at {seen_m[1]:.2f} m, so it turned to the left.",
        ],
        EDITED: [
            f"> {EDITED}",
            f"● {_call(*turns[1])}",
            f"  └ {left}; then left wheel motor.setVelocity -3.0 instead of 5.0; … {decided}",
            f"● Yes, {since_s - at_s:.2f} s earlier: it saw something at {right_m:.3f} m, "
            f"below your new limit of {limit_m} m.",
        ],
    }


def _call(_question: str, tool: str, arguments: dict[str, Any]) -> str:
    given = ", ".join(f"{name}={json.dumps(value)}" for name, value in arguments.items())
    return f"{tool}({given})"


def animate(browser: Any, lines: list[str], plot: Path, images: Path) -> None:
    """Show a conversation line by line, and the plot of it, as an animated picture."""
    asked, *said = lines
    encoded = base64.b64encode(plot.read_bytes()).decode()
    page = browser.new_page(viewport={"width": 860, "height": 560})
    shown: list[tuple[str, int]] = [("", 600)]
    shown += [(asked[:end], 90) for end in range(4, len(asked), 4)]
    shown += [("\n".join([asked, *said[:count]]), 1300) for count in range(len(said))]
    plotted = "\n".join([asked, *said[:-1], '● webots_plot(signals=["proximity.*", "pose.x_m"])'])
    # The last frame comes first: it is what a page shows that does not animate.
    frames = [("\n".join([plotted, said[-1]]), encoded, 6000)]
    frames += [(text, "", pause_ms) for text, pause_ms in shown]
    frames.append((plotted, encoded, 2600))
    pictures: list[Image.Image] = []
    for text, picture, _ in frames:
        page.set_content(_WINDOW.format(text=escape(text), picture=_picture(picture)))
        seen = Image.open(BytesIO(page.screenshot())).convert("RGB")
        pictures.append(seen.quantize(64, dither=Image.Dither.NONE))
    pictures[0].save(
        images / ANIMATION, save_all=True, append_images=pictures[1:], loop=0, optimize=True,
        duration=[pause_ms for *_, pause_ms in frames],
    )  # fmt: skip


def _picture(encoded: str) -> str:
    return f'<img src="data:image/png;base64,{encoded}">' if encoded else ""


def main() -> int:
    """Make all of it."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder)
        simulation = recorded(data_dir)
        with simulation:
            drive(simulation, data_dir)
            draw_plots(data_dir, IMAGES)
            draw_clip(data_dir, IMAGES)
            with started_browser() as browser:
                photograph_report(browser, data_dir, IMAGES)
                photograph_page(browser, data_dir, IMAGES)
                by = {"resvg": resvg_py.__version__, "chromium": browser.version}
            drawn = {"by": by, "means": means(simulation)}
            DRAWN.write_text(json.dumps(drawn, indent=2) + "\n", "utf-8")
    with tempfile.TemporaryDirectory() as folder:
        terminal = walkthrough.Terminal(Path(folder))
        for _ in walkthrough.follow(walkthrough.PAGE.read_text("utf-8"), terminal):
            pass
        for name, drawn_as in TUTORIAL_PLOTS.items():
            shutil.copyfile(terminal.folder / drawn_as, IMAGES / name)
    with tempfile.TemporaryDirectory() as folder, stuck_explorer(Path(folder)) as data_dir:
        lines = conversation(data_dir)
        plot = Path(folder) / "plot.png"
        _run("plot", "proximity.*", "pose.x_m", "-o", str(plot), "--data-dir", str(data_dir))
        with started_browser() as browser:
            animate(browser, lines, plot, IMAGES)
    said = "\n".join(lines) + "\n"
    README.write_text(CONVERSATION.sub(lambda _: said, README.read_text("utf-8")), "utf-8")
    with tempfile.TemporaryDirectory() as folder:
        for question, lines in demo_conversations(Path(folder)).items():
            said = "\n".join(lines) + "\n"
            for page in (README, CHECKOUT / "docs" / PAGES_OF[question]):
                text = shown_of(question).sub(lambda _, said=said: said, page.read_text("utf-8"))
                page.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
