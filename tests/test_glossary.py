"""The glossaries, and words that are in no name, comment or docstring."""

from __future__ import annotations

import ast
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

_ROOT = Path(__file__).parents[1]
_CONTRIBUTING = (_ROOT / "CONTRIBUTING.md").read_text("utf-8")
_GLOSSARY = _CONTRIBUTING.partition("## Glossary")[2].partition("\n## ")[0]
_TERMS_OF_USERS = (_ROOT / "docs" / "glossary.md").read_text("utf-8")
_BRIDGE = _ROOT / "webots_mcp" / "bridge"
_RETIRED = {"hold", "heart", "pulse", "drops", "trouble", "complain", "say", "turn", "told", "tell",
            "untold", "companion", "standing"}  # fmt: skip
_PLAIN = ("bridge", "steering", "signals/conditions", "setup", "simulator")
_WITHOUT_MEANING = re.compile(
    r"\b(told|tells|beside|nobody|somebody|whoever|heard|hears)\b", re.IGNORECASE
)
# Private words for what engineers call otherwise, in folders that do without them.
_PRIVATE = re.compile(
    r"\b(so many|so long|told|tells|swings?|swung|stretch(es)?|creeps?|(is|are) gone|mends?|"
    r"twitch|alike|whoever)\b"
)
_REWRITTEN = (
    "answers", "bridge", "cli", "database", "plotting", "plugins/cluster", "plugins/pool",
    "questions", "server", "setup", "signals", "simulator", "standin", "steering", "store",
)  # fmt: skip


def test_each_term_of_the_glossary_has_one_meaning() -> None:
    terms = re.findall(r"^\| ([^|]+) \|", _GLOSSARY, re.MULTILINE)[1:]
    terms += re.findall(r"^- ([^:]+):", _TERMS_OF_USERS, re.MULTILINE)
    assert len(terms) > 10
    assert len(terms) == len(set(terms))


def test_a_newcomer_reads_the_guide_from_start_to_end() -> None:
    assert len(_CONTRIBUTING.split()) <= 1200


def test_retired_names_are_in_no_module_of_the_bridge() -> None:
    for module in _BRIDGE.glob("*.py"):
        assert not _RETIRED & _names(module), module.name


def test_words_without_a_technical_meaning_are_in_no_plain_package() -> None:
    assert _WITHOUT_MEANING.search("The journal is told.")
    for package in _PLAIN:
        modules = list((_ROOT / "webots_mcp" / package).rglob("*.py"))
        assert modules, package
        for module in modules:
            assert not _WITHOUT_MEANING.findall(module.read_text("utf-8")), module


@pytest.mark.slow
def test_private_words_are_in_no_comment_or_docstring() -> None:
    assert _PRIVATE.search("# the least of so many rows")
    for folder in _REWRITTEN:
        modules = list((_ROOT / "webots_mcp" / folder).rglob("*.py"))
        assert modules, folder
        for module in modules:
            for text in _texts(module):
                assert not _PRIVATE.search(text), f"{module}: {text}"


def _texts(file: Path) -> Iterator[str]:
    """The comments and the texts that stand alone, such as docstrings."""
    with file.open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type == tokenize.COMMENT:
                yield token.string
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            yield str(node.value.value)


def _names(file: Path) -> set[str]:
    """The words that names in the code are made of."""
    with file.open("rb") as source:
        names = [t.string for t in tokenize.tokenize(source.readline) if t.type == tokenize.NAME]
    return {word.lower() for name in names for word in re.findall("[A-Z]?[a-z]+", name)}
