"""What the bodies of a world are called in the names of signals: each a word, and each its own."""

from __future__ import annotations

import keyword
import re
import unicodedata
from collections.abc import Collection
from typing import Final

_ODD: Final = re.compile(r"\W")
_LONGEST_WORD: Final = 60  # characters


def word_of(name: str, taken: Collection[str]) -> str:
    """The name as a word that is not taken yet: `2nd robot` becomes `_2nd_robot`.

    Conditions and positions can name it without quotes. A number is appended to one that is taken.
    """
    word = _ODD.sub("_", unicodedata.normalize("NFKC", name))[:_LONGEST_WORD] or "robot"
    if word[0].isdigit() or keyword.iskeyword(word):
        word = f"_{word}"
    number, free = 2, word
    while free in taken:
        number, free = number + 1, f"{word}_{number}"
    return free
