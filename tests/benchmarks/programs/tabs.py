"""The live page of a recording, open in some tabs of a browser until standard input ends.

python -m tests.benchmarks.programs.tabs FOLDER BROWSER COUNT
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

from tests.benchmarks.processes import say

_PATIENCE_MS = 60_000


def main(folder: Path, browser: str, count: int) -> None:
    """Say "ready" when each tab shows figures."""
    with _page_of(folder) as url, sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        for _ in range(count):
            tab = running.new_page(viewport={"width": 1280, "height": 800})
            tab.goto(url)
            expect(tab.locator(".bk-Figure").first).to_be_visible(timeout=_PATIENCE_MS)
        say("ready")
        sys.stdin.read()
        running.close()


@contextmanager
def _page_of(folder: Path) -> Generator[str]:
    line = ["view", "--data-dir", str(folder), "--port", "0", "--no-browser"]
    command = [sys.executable, "-m", "webots_mcp", *line]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().split(" at ")[1].split()[0]
        server.terminate()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
