"""Reports of the robot that the real bridge has recorded, and a browser that opens them."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.browsing import chromium
from webots_mcp.database.connection import connect
from webots_mcp.plugins.report.make_report import Report, make_report

__all__ = ["chromium"]

_VOID = {"meta", "img", "br", "link", "input"}


class Shown(HTMLParser):
    """What a page refers to, and the text that it shows outside its figures."""

    def __init__(self, html: bytes) -> None:
        super().__init__()
        self.attributes: list[tuple[str, str, str]] = []
        self.styles: list[str] = []
        self.words: list[str] = []
        self._inside: list[str] = []
        self.feed(html.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in _VOID:
            self._inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        while self._inside and self._inside.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if "style" in self._inside:
            self.styles.append(data)
        elif not {"script", "svg"} & set(self._inside):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="session")
def both(bridge_recording: Path) -> Report:
    """Of the two runs of `tests.recordings.bridge`."""
    with closing(connect(bridge_recording, "reader")) as connection:
        return make_report(connection, [1, 2], bridge_recording.parent)


@pytest.fixture(scope="session")
def page(both: Report) -> Shown:
    return Shown(both.html)


@pytest.fixture
def recording(bridge_recording: Path) -> Iterator[sqlite3.Connection]:
    with closing(connect(bridge_recording, "reader")) as connection:
        yield connection
