"""The README starts with what there is."""

from __future__ import annotations

import re
from pathlib import Path

README = (Path(__file__).parents[1] / "README.md").read_text("utf-8")


def test_it_installs_from_what_exists() -> None:
    lines = re.findall(r"(?:pip|uv tool) install ([^#`\n]*)|uvx --from (\S+)", README)
    sources = {(installed or run).split()[-1] for installed, run in lines}
    assert sources == {"."}
    assert "not on the package index yet" in README


def test_what_it_installs_by_default_has_the_page_and_reports() -> None:
    wanted = (Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8")
    default = wanted.partition("\ndependencies = [")[2].partition("\n]")[0]
    assert (
        "pip install .            # the bridge, the server, the command line, the live page"
        in README
    )
    assert {"resvg-py", "jinja2"} <= set(re.findall(r'"([\w-]+)', default))


def test_no_advice_names_a_package_index_on_which_anybody_may_register_the_name() -> None:
    """Neither docs nor messages: what is installed by a name is not ours until it is published."""
    root = Path(__file__).parents[1]
    by_name = re.compile(
        r"\bwebots-mcp\[|webots-mcp==|\buvx webots-mcp|"
        r"\b(pip|pipx|uv tool) install\b[^`#]*\bwebots-mcp\b"
    )
    files = [root / "README.md", *root.glob("docs/**/*.md"), *root.glob("examples/**/*.md")]
    files += root.glob("webots_mcp/**/*.py")
    found = [
        f"{file.relative_to(root)}: {line.strip()}"
        for file in files
        for line in file.read_text("utf-8").splitlines()
        if by_name.search(line)
    ]
    assert found == []


def test_it_is_short() -> None:
    assert len(README.encode()) <= 10_000
