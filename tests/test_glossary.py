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


def _retired() -> set[str]:
    return set(re.findall(r"`(\w+)`", _GLOSSARY.partition("Names that the bridge")[2]))


def _names(file: Path) -> set[str]:
    """The words that names in the code are made of."""
    with file.open("rb") as source:
        names = [t.string for t in tokenize.tokenize(source.readline) if t.type == tokenize.NAME]
    return {word.lower() for name in names for word in re.findall("[A-Z]?[a-z]+", name)}
