"""How Sphinx makes a site of the pages: `./run docs`.

The source folder is the checkout, so that links between the pages, the README and the examples are
the same here and on a code host. What the code knows better is added as the pages are read.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).parent.parent
sys.path.insert(0, str(CHECKOUT))

from docs import reference  # noqa: E402
from webots_mcp import __version__  # noqa: E402

project = "webots-mcp"
author = copyright = "The webots-mcp authors"  # noqa: A001
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/*.md",
    "docs/*/*.md",
    "examples/*/README.md",
    "tests/evaluations/README.md",
]
exclude_patterns = [".*", "build", "dist", "migrations", "webots_mcp"]
html_theme = "furo"
html_title = f"webots-mcp {__version__}"
html_extra_path = ["site"]  # its index.html leads to the first page
html_copy_source = False
smartquotes = False  # it would make one dash of the two of an option
# A symptom leads to what to do about it.
html_search_scorer = str(CHECKOUT / "docs" / "search_scorer.js")

myst_heading_anchors = 4
default_role = "code"  # docstrings write `names` as Markdown does
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_use_ivar = True  # attributes are listed once: in the docstring of their class


def setup(app: Any) -> None:
    """Let the code complete the pages and their docstrings."""
    app.connect("source-read", complete_page)
    app.connect("autodoc-process-docstring", mark_examples, priority=100)  # before napoleon


def complete_page(app: Any, page: str, source: list[str]) -> None:
    """Add to a page what is generated for it."""
    if page in reference.ADDED:
        source[0] += "\n" + reference.ADDED[page](source[0])


def mark_examples(
    app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]
) -> None:
    """Say by two colons, as reStructuredText does, that an indented block is code."""
    for at in range(len(lines) - 3, -1, -1):
        indent = lines[at][: len(lines[at]) - len(lines[at].lstrip())]
        deeper = lines[at + 2].startswith(f"{indent}    ")
        if lines[at].strip() and not lines[at + 1].strip() and deeper:
            lines[at + 1 : at + 1] = ["", f"{indent}::"]
