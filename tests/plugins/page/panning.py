"""Measures how fluid the page is while a person moves a figure.

`python -m tests.plugins.page.panning` records 1,000,000 rows, shows them in Chromium, drags the
signals to and fro, and prints the times between two frames as `requestAnimationFrame` reports them.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from statistics import median, quantiles
from typing import Any

from playwright.sync_api import Page, sync_playwright

from tests.recordings.long import build
from tests.recordings.rover import start_run
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.store.chunk_making import make_chunks

ROWS = 1_000_000
OTHER_ROBOTS = 9
SIGNALS = 200
DRAGGED_S = 5
FRAMES = """
ms => new Promise(done => {
  const svg = document.querySelector('#signal-figure > svg');
  const box = svg.getBoundingClientRect();
  const send = (type, x) => svg.dispatchEvent(new PointerEvent(type, {
    bubbles: true, pointerType: 'touch', clientX: box.left + x, clientY: box.top + 80 }));
  const times = [];
  const began = performance.now();
  send('pointerdown', box.width / 2);
  const step = now => {
    times.push(now);
    send('pointermove', box.width / 2 + 100 * Math.sin((now - began) / 300));
    if (now - began < ms) return requestAnimationFrame(step);
    send('pointerup', box.width / 2);
    done(times);
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


def measure(page: Page, url: str, robot: str) -> dict[str, Any]:
    """Return the frames per second, and the times between frames, while a figure is dragged."""
    page.goto("about:blank")
    page.goto(f"{url}#robot={robot}&window=")
    page.wait_for_function(
        "() => document.getElementById('signal-figure').figure && !document.getElementById('busy')"
        ".checkVisibility()",
        timeout=120_000,
    )
    page.wait_for_timeout(2000)
    times: list[float] = page.evaluate(FRAMES, DRAGGED_S * 1000)
    between = [later - earlier for earlier, later in pairwise(times)]
    return {
        "frames_per_s": round(1000 * len(between) / (times[-1] - times[0]), 1),
        "median_ms": round(median(between), 1),
        "p99_ms": round(quantiles(between, n=100)[98], 1),
        "signals": page.evaluate("names.length"),
    }


def main() -> int:
    """Record, measure and print."""
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else ROWS
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder), rows)
        line = [sys.executable, "-m", "webots_mcp", "view", "--port", "0", "--no-browser", "--json"]
        with (
            subprocess.Popen(
                [*line, "--data-dir", folder], stdout=subprocess.PIPE, text=True
            ) as server,
            sync_playwright() as driver,
        ):
            try:
                assert server.stdout is not None
                url = json.loads(server.stdout.readline())["url"]
                browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                for robot in ("rover", "arm_0"):
                    print(json.dumps({"robot": robot, "rows": rows} | measure(page, url, robot)))
                browser.close()
            finally:
                server.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
