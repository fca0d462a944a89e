"""Show pages of the documentation in the terminal: `webots-mcp help stuck`.

A topic is the name of a page, a heading, or words of one. The index of headings is read from the
pages themselves, which are in `docs/` of a checkout or inside the installed package.
"""

from __future__ import annotations

import difflib
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Final, NamedTuple

from webots_mcp.cli.options import Json, Parameter
from webots_mcp.cli.terminal import print_json
from webots_mcp.contract import bundled
from webots_mcp.errors import InvalidInputError

_INDEX: Final = "index"


@dataclass(frozen=True)
class HelpLayout:
    """The layout of help pages.

    Attributes:
        width: Maximum characters of a line.
        see_also: Related topics that are named.
    """

    width: int = 100
    see_also: int = 5


_LAYOUT: Final = HelpLayout()


class Section(NamedTuple):
    """A heading of a page with its text and that of its subheadings.

    Attributes:
        page: The name of the page.
        title: The heading.
        level: 1 for the title of the page.
        text: Markdown that begins with the heading.
    """

    page: str
    title: str
    level: int
    text: str

    @property
    def topic(self) -> str:
        """The topic for which `webots-mcp help` prints it."""
        return self.page if self.level == 1 else f"{self.page} {anchor_of(self.title)}"


def help_(
    *topic: Annotated[str, Parameter("TOPIC", help="Page, heading, or words of a heading.")],
    as_json: Json = False,
) -> None:
    """Print a page of the documentation, or the section about a topic.

        webots-mcp help stuck

    Without TOPIC it lists the pages. For the options of a command use 'webots-mcp COMMAND --help'.
    """
    if not topic:
        return print_json({"pages": titles()}) if as_json else print(_overview())
    found = sections_about(topic)
    if not found and len(topic) == 1 and topic[0] in _command_names():
        return _print_help_of(topic[0])
    if not found:
        raise InvalidInputError(_nothing_about(" ".join(topic)))
    best, others = found[0], [each.topic for each in found[1 : _LAYOUT.see_also + 1]]
    text = with_topics_for_links(best.text)
    if as_json:
        return print_json({"topic": best.topic, "text": text, "see_also": others})
    _print_markdown(text)
    if others:
        lines = "".join(f"\n  webots-mcp help {each}" for each in others)
        print(f"\nSee also:{lines}")
    if (name := topic[0]) in _command_names() and len(topic) == 1:
        print(f"\nFor the options of the command: webots-mcp {name} --help")


def sections_about(topic: Sequence[str]) -> list[Section]:
    """Return the sections about a topic, the best first.

    The page of that name comes first, then headings with exactly these words, headings with all of
    them, headings on a page whose title has the others, and finally sections whose text has all.

    Args:
        topic: Words, the first of which may be the name of a page.
    """
    name = re.sub(r"\.md(#.*)?$", "", topic[0].removeprefix("docs/").lower())
    if name in page_files():
        within = _sections(name)
        if len(topic) == 1:
            return [within[0]]
        if inside := _matching(_words(" ".join(topic[1:])), within[1:]):
            return inside[:1]
    return _matching(
        _words(" ".join(topic)), [each for page in _ranked() for each in _sections(page)]
    )


def _matching(wanted: frozenset[str], candidates: Sequence[Section]) -> list[Section]:
    """Return the matching sections, those with matching headings first."""
    if not wanted:
        return []
    ranked: list[tuple[int, int, Section]] = []
    for place, section in enumerate(candidates):
        heading = _words(section.title)
        title = _words(section.page) | _words(titles()[section.page])
        if wanted == heading:
            rank = 0
        elif wanted <= heading:
            rank = 1
        elif wanted <= heading | title and not wanted <= title:
            rank = 2
        elif section.level == 1 and wanted <= title:
            rank = 1
        elif section.level == 2 and wanted <= _words(section.text):
            rank = 3
        else:
            continue
        ranked.append((rank, place, section))
    ranked.sort(key=lambda each: each[:2])
    return [section for _, _, section in ranked]


def with_topics_for_links(text: str) -> str:
    """Return Markdown in which links to other pages name the topic that prints them."""
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"(picture: \1)", text)
    return re.sub(r"\[([^\]]+)\]\((?!https?:)([^)\s#]*)(?:#([\w-]+))?\)", _topic_for_link, text)


def _topic_for_link(link: re.Match[str]) -> str:
    words, page, anchor = link[1], Path(link[2]).stem, link[3]
    if page not in page_files() or _words(words) == _words(page):
        return words
    return f"{words} (help {page}{f' {anchor}' if anchor else ''})"


def anchor_of(heading: str) -> str:
    """Return the anchor of a heading, as code hosts create it."""
    return re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")


# -- the pages --


@cache
def page_files() -> dict[str, Path]:
    """Return the file of each page by its name, without the list of all pages."""
    files = sorted(bundled("docs").glob("*.md"))
    return {file.stem: file for file in files if file.stem != _INDEX}


@cache
def titles() -> dict[str, str]:
    """Return the title of each page by its name."""
    return {name: _sections(name)[0].title for name in page_files()}


@cache
def _sections(page: str) -> tuple[Section, ...]:
    """Return the title and the headings of a page, in order."""
    text = page_files()[page].read_text("utf-8")
    blank = re.sub(r"(?ms)^```.*?^```", lambda block: " " * len(block[0]), text)
    heads = list(re.finditer(r"(?m)^(#+) (.+)$", blank))
    sections: list[Section] = []
    for place, head in enumerate(heads):
        level = len(head[1])
        after = (later.start() for later in heads[place + 1 :] if len(later[1]) <= level)
        end = next(after, len(text))
        sections.append(Section(page, head[2], level, text[head.start() : end].strip()))
    return tuple(sections)


def _ranked() -> list[str]:
    """Return the names of the pages, those about symptoms first, then in the order of the index."""
    listed = [name for _, names in _groups() for name in names]
    # Someone who looks up a symptom wants to know what to do before what is recorded.
    first = [
        name for name in ("my-robot", "troubleshooting", "events", "check") if name in page_files()
    ]
    return list(dict.fromkeys([*first, *listed, *page_files()]))


def _groups() -> list[tuple[str, list[str]]]:
    """Return the captions of the index with the names of the pages below each."""
    index = (bundled("docs") / f"{_INDEX}.md").read_text("utf-8")
    parts = re.findall(r"(?ms)^## (.+?)\n(.*?)(?=^## |\Z)", index)
    groups = [
        (caption, re.findall(r"(?m)^- \[.+?\]\(([\w-]+)\.md\)", part)) for caption, part in parts
    ]
    return [(caption, names) for caption, names in groups if names]


def _words(text: str) -> frozenset[str]:
    """Return the words of a text in lower case and without the s of plurals."""
    words = re.findall(r"[^\W_]+(?:_[^\W_]+)*", text.lower())
    return frozenset(re.sub(r"(?<=[a-z]{3})(?<![su])s$", "", word) for word in words)


def _command_names() -> Sequence[str]:
    from webots_mcp.cli.commands import COMMANDS

    return [*COMMANDS]


# -- what is printed --


def _print_help_of(command: str) -> None:
    from webots_mcp.cli import app_for

    app_for([command])([command, "--help"], result_action="return_value")


def _overview() -> str:
    lines = ["webots-mcp help TOPIC prints a page, or the section about a topic such as stuck."]
    width = max(map(len, page_files()))
    for caption, names in _groups():
        lines += ["", caption, *(f"  {name:{width}}  {titles()[name]}" for name in names)]
    return "\n".join(lines)


def _nothing_about(topic: str) -> str:
    known = {
        word for page in page_files() for each in _sections(page) for word in _words(each.title)
    }
    near = difflib.get_close_matches(topic.lower(), sorted(known | page_files().keys()), n=3)
    offer = f" The nearest topics: {', '.join(near)}." if near else ""
    return f"no page is about {topic!r}.{offer} 'webots-mcp help' lists the pages."


def _print_markdown(text: str) -> None:
    """Print Markdown, rendered on a terminal and raw elsewhere."""
    if not sys.stdout.isatty():
        print(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    width = min(shutil.get_terminal_size().columns, _LAYOUT.width)
    Console(width=width).print(Markdown(text, hyperlinks=False))
