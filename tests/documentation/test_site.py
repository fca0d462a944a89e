"""The site of `./run docs`: it is made without a warning, and its search leads to help first."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.browsing import chromium

pytest.importorskip("sphinx", reason="Sphinx is not installed")
pytest.importorskip("furo", reason="the theme is not installed")
pytestmark = pytest.mark.slow
__all__ = ["chromium"]
CHECKOUT = Path(__file__).parents[2]
WIDTHS = (390, 1280)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_args: Any, **_named: Any) -> None:
        """Nothing of a request is printed."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    line = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-E", "-q", "-c", "docs", "-b",
            "html", "-d", str(folder / "trees"), ".", str(folder / "html")]  # fmt: skip
    made = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    handler = partial(Quiet, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_the_search_for_stuck_finds_what_to_do_first(chromium: Any, address: str) -> None:
    page = chromium.new_page()
    page.goto(f"{address}/search.html?q=stuck")
    first = page.locator("#search-results li a").first
    first.wait_for()
    target = first.get_attribute("href")
    page.close()
    assert target.split("#")[0].split("?")[0] in {
        "docs/my-robot.html", "docs/troubleshooting.html",
    }  # fmt: skip


def test_each_page_fits_a_telephone_and_a_desk(chromium: Any, site: Path, address: str) -> None:
    files = [*(CHECKOUT / "docs").glob("*.md"), *(CHECKOUT / "docs").glob("*/*.md")]
    names = [file.relative_to(CHECKOUT).with_suffix(".html").as_posix() for file in files]
    wide: list[tuple[str, int]] = []
    for width in WIDTHS:
        page = chromium.new_page(viewport={"width": width, "height": 900})
        for name in names:
            page.goto(f"{address}/{name}")
            if page.evaluate("document.documentElement.scrollWidth") > width:
                wide.append((name, width))
        page.close()
    assert wide == []
