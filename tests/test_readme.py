"""The README starts with what there is."""

from __future__ import annotations

import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text("utf-8")


def test_it_installs_from_what_exists() -> None:
    lines = re.findall(r"(?:pip|uv tool) install ([^#`\n]*)|uvx --from (\S+)", README)
    sources = {(installed or run).split()[-1] for installed, run in lines}
    assert sources == {"."}
    published = re.findall(r"[^.]*\bpackage index\b[^.]*\.[^.]*\.", README)
    assert len(published) == 1
    assert "not on the package index yet" in published[0]
    assert "Once it is published" in published[0]


def test_it_is_short() -> None:
    assert len(README.encode()) <= 10_000
