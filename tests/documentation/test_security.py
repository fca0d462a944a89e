"""SECURITY.md names the tests of each of its sentences, and these tests are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
PROMISES, _, LIST = (CHECKOUT / "SECURITY.md").read_text("utf-8").partition("\n## Tests\n")
# What a sentence is about that promises nothing, or that another sentence already promises.
NO_PROMISE = (
    "**An assistant.**", "See [permissions]", "**Texts of a recording**",
    "A model may still be fooled", "**A recording from somebody else.**",
    "**Other users of the computer.**", "**Web sites and other computers.**", "What a controller",
    "What an assistant does",
)  # fmt: skip
_QUOTED = re.compile(r'^- "(.+)"$', re.MULTILINE)
_NAMED = re.compile(r"^  - `(tests/\S+\.py)::(test_\w+)`$", re.MULTILINE)


def folded(text: str) -> str:
    return " ".join(text.split())


def sentences() -> list[str]:
    """The sentences about what is not trusted, each with its heading where it is the first."""
    text = folded(PROMISES.partition("## What is not\n")[2])
    parts = re.split(r"(?<=[.:]) (?=[A-Z-])|(?<=\*\*) (?=[A-Z])", text)
    return [part.removeprefix("- ") for part in parts]


@pytest.mark.parametrize("quoted", _QUOTED.findall(LIST))
def test_a_sentence_that_has_tests_stands_in_the_page(quoted: str) -> None:
    assert quoted in folded(PROMISES)


@pytest.mark.parametrize(("file", "name"), _NAMED.findall(LIST))
def test_a_test_that_the_page_names_is_there(file: str, name: str) -> None:
    source = (CHECKOUT / file).read_text("utf-8")
    assert re.search(rf"^(async )?def {name}\(", source, re.MULTILINE), f"{file} has no {name}"


def test_every_line_of_the_list_is_a_sentence_or_a_test_and_each_sentence_has_one() -> None:
    entries = re.split(r'^(?=- ")', LIST, flags=re.MULTILINE)[1:]
    assert entries
    assert [each for each in entries if not _NAMED.search(each)] == []
    lines = [line for line in LIST.splitlines() if line.startswith(("- ", "  - "))]
    assert [line for line in lines if not (_QUOTED.match(line) or _NAMED.match(line))] == []


def test_every_sentence_that_promises_something_is_in_the_list() -> None:
    quoted = _QUOTED.findall(LIST)
    without = [
        sentence
        for sentence in sentences()
        if not sentence.startswith(NO_PROMISE)
        and not any(each in sentence or sentence in each for each in quoted)
    ]
    assert without == []
