"""The glossary in CONTRIBUTING: each word once, and no retired name in the code of the bridge."""

from __future__ import annotations

import re
import tokenize
from pathlib import Path

_ROOT = Path(__file__).parents[1]
_CONTRIBUTING = (_ROOT / "CONTRIBUTING.md").read_text("utf-8")
_GLOSSARY = _CONTRIBUTING.partition("## Glossary")[2].partition("\n## ")[0]
_BRIDGE = _ROOT / "webots_mcp" / "bridge"


def test_each_word_has_one_meaning() -> None:
    cells = re.findall(r"^\| ([^*|]+) \|", _GLOSSARY, re.MULTILINE)
    words = [word for cell in cells[2:] for word in cell.split(", ")]
    assert len(words) > 30
    assert len(words) == len(set(words))


def test_retired_names_are_in_no_module_of_the_bridge() -> None:
    retired = _retired()
    assert "heart" in retired
    for module in _BRIDGE.glob("*.py"):
        assert not retired & _names(module), module.name


def test_words_without_a_technical_meaning_are_in_no_plain_package() -> None:
    packages, _, words = _GLOSSARY.partition("Words that are in no name")[2].partition(":")
    any_word = "|".join(re.findall(r"`(\w+)`", words))
    retired = re.compile(rf"\b({any_word})\b", re.IGNORECASE)
    assert retired.search("The journal is told.")
    for package in re.findall(r"`([\w/]+)`", packages):
        modules = list((_ROOT / "webots_mcp" / package).rglob("*.py"))
        assert modules, package
        for module in modules:
            assert not retired.findall(module.read_text("utf-8")), module


def _retired() -> set[str]:
    names = _GLOSSARY.partition("Names that the bridge")[2].partition("\n\n")[0]
    return set(re.findall(r"`(\w+)`", names))


def _names(file: Path) -> set[str]:
    """The words that names in the code are made of."""
    with file.open("rb") as source:
        names = [t.string for t in tokenize.tokenize(source.readline) if t.type == tokenize.NAME]
    return {word.lower() for name in names for word in re.findall("[A-Z]?[a-z]+", name)}
