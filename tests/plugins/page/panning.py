"""Measures how fluid the page is while a person moves a figure.

`python -m tests.plugins.page.panning` records 1,000,000 rows, shows them in Chromium, drags the
signals to and fro, and prints two measurements. The times between two frames, as
`requestAnimationFrame` reports them, include the drawing of the browser, which is slow without a
graphics card. The processor times are those of the page's own thread, which other programs do not
lengthen.
`--keep FOLDER` keeps the recording, and uses it again.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from playwright.sync_api import CDPSession, Page, sync_playwright

from tests.recordings.long import build
from tests.recordings.rover import start_run
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.store.chunk_making import make_chunks

ROWS = 1_000_000
OTHER_ROBOTS = 9
SIGNALS = 200
DRAGGED_S = 5
CASES = (("rover", ()), ("arm_0", ()), ("arm_0", tuple(f"arm.joint_{n}" for n in range(SIGNALS))))
"""Robots, and the signals that are drawn; without any those that changed most."""
FRAMES = """
ms => new Promise(done => {
  const svg = document.querySelector('#signal-figure svg');
  const box = svg.getBoundingClientRect();
  const send = (type, x) => svg.dispatchEvent(new PointerEvent(type, {
    bubbles: true, pointerType: 'touch', clientX: box.left + x, clientY: box.top + 80 }));
  const times = [];
  const scripts = [];
  const began = performance.now();
  send('pointerdown', box.width / 2);
  const step = now => {
    times.push(now);
    const before = performance.now();
    send('pointermove', box.width / 2 + 100 * Math.sin((now - began) / 300));
    scripts.push(performance.now() - before);
    if (now - began < ms) return requestAnimationFrame(step);
    send('pointerup', box.width / 2);
    done([times, scripts]);
  };
  requestAnimationFrame(step);
})
"""


def record(data_dir: Path, rows: int) -> None:
    """Record one robot with many rows, and robots with many signals."""
    build(data_dir / DATABASE_NAME, rows)
    with closing(connect(data_dir / DATABASE_NAME, "writer")) as connection:
        for number in range(OTHER_ROBOTS):
            recorder = start_run(connection, f"arm_{number}")
            for step in range(100):
                joints = {f"joint_{joint}": step * joint / 10 for joint in range(SIGNALS)}
                recorder.publish(step / 10, {"arm": joints})
        make_chunks(connection, 1_000_000)


def measure(page: Page, url: str, robot: str, drawn: Sequence[str]) -> dict[str, Any]:
    """Return the frames per second, and the times of frames, while a figure is dragged."""
    page.goto("about:blank")
    chosen = f"&signals={json.dumps(drawn)}" if drawn else ""
    page.goto(f"{url}#robot={robot}&window={chosen}")
    page.wait_for_function(
        "() => document.getElementById('signal-figure').figure && !document.getElementById('busy')"
        ".checkVisibility()",
        timeout=120_000,
    )
    page.wait_for_timeout(2000)
    devtools = page.context.new_cdp_session(page)
    devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
    before = spent(devtools)
    times: list[float]
    scripts: list[float]
    times, scripts = page.evaluate(FRAMES, DRAGGED_S * 1000)
    after = spent(devtools)
    between = [later - earlier for earlier, later in pairwise(times)]
    return {
        "frames_per_s": round(1000 * len(between) / (times[-1] - times[0]), 1),
        "frame_median_ms": round(median(between), 1),
        "frame_p99_ms": round(quantiles(between, n=100)[98], 1),
        "script_median_ms": round(median(scripts), 2),
        "script_p99_ms": round(quantiles(scripts, n=100)[98], 2),
        "processor_ms_per_frame": {
            name: round(1000 * (after[name] - before[name]) / len(times), 2) for name in after
        },
        "signals": page.evaluate("names.length"),
        "curves": page.evaluate("figures.signals.figure.data.curves.length"),
    }


def spent(devtools: CDPSession) -> dict[str, float]:
    """Return the processor time of the page's main thread in seconds, in all and by kind."""
    metrics = devtools.send("Performance.getMetrics")["metrics"]
    values = {each["name"]: each["value"] for each in metrics}
    return {kind: values[f"{kind}Duration"] for kind in ("Script", "RecalcStyle", "Layout", "Task")}


def main() -> int:
    """Record, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", type=int, nargs="?", default=ROWS)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    rows: int = asked.rows
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = asked.keep or Path(temporary)
        if not (folder / DATABASE_NAME).exists():
            record(folder, rows)
        line = [sys.executable, "-m", "webots_mcp", "view", "--port", "0", "--no-browser", "--json"]
        with (
            subprocess.Popen(
                [*line, "--data-dir", str(folder)], stdout=subprocess.PIPE, text=True
            ) as server,
            sync_playwright() as driver,
        ):
            try:
                assert server.stdout is not None
                url = json.loads(server.stdout.readline())["url"]
                browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                for robot, drawn in CASES:
                    measured = measure(page, url, robot, drawn)
                    print(json.dumps({"robot": robot, "rows": rows} | measured), flush=True)
                browser.close()
            finally:
                server.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
