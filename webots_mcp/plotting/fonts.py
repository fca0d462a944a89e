"""Characters that matplotlib's own font lacks: another font of this computer draws them."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any, Final

_OWN_FAMILY: Final = "DejaVu Sans"  # comes with matplotlib, the same everywhere
_PLACEHOLDERS: Final = "Last Resort"  # a font of nothing but boxes, which matplotlib brings
_SHAPING_SINCE: Final = (3, 11)  # the first matplotlib that joins letters and writes leftwards
_SHAPED: Final = ("R", "AL", "NSM")  # Hebrew, Arabic, and marks that combine with their letter
_UNSEEN: Final = ("Cc", "Cf", "Zs", "Zl", "Zp", "Mn")  # spaces, controls, marks on letters
_SHOWN_TEXTS: Final = 3


def fit_fonts(figure: Any) -> tuple[str, ...]:
    """Give each text of a figure the fonts that it needs; notes about what none of them has."""
    import matplotlib
    from matplotlib.text import Text

    texts = [text for text in figure.findobj(Text) if not text.get_text().isascii()]
    lacking = frozenset(c for text in texts for c in text.get_text() if _is_drawn(c))
    lacking -= _characters_of(_own_font(), lacking)
    families, boxes = _families(lacking) if lacking else ((), frozenset[str]())
    for text in texts:
        text.set_fontfamily([_OWN_FAMILY, *families])
    words = [text.get_text() for text in texts]
    notes = _note(words, boxes, "no font of this computer has all characters of {}: boxes stand "
                  "for them (install a font that has them, or draw an .svg)")  # fmt: skip
    if matplotlib.__version_info__ < _SHAPING_SINCE:
        shaped = {c for word in words for c in word if unicodedata.bidirectional(c) in _SHAPED}
        notes += _note(words, shaped, "drawn letter by letter from the left, because this version "
                       "of matplotlib joins no letters: {}")  # fmt: skip
    return notes


def _is_drawn(character: str) -> bool:
    return unicodedata.category(character) not in _UNSEEN


def _note(words: Iterable[str], characters: Iterable[str], note: str) -> tuple[str, ...]:
    """The note with the first of the words that have such characters; none without any."""
    wanted = set(characters)
    named = [repr(word.strip()) for word in dict.fromkeys(words) if wanted & set(word)]
    more = [f"{len(named) - _SHOWN_TEXTS} more"] if len(named) > _SHOWN_TEXTS else []
    return (note.format(", ".join([*named[:_SHOWN_TEXTS], *more])),) if named else ()


def _characters_of(font: Any, wanted: Iterable[str]) -> frozenset[str]:
    return frozenset(c for c in wanted if font.get_char_index(ord(c)))


def _own_font() -> Any:
    from matplotlib import font_manager

    manager: Any = font_manager
    return manager.get_font(manager.findfont(_OWN_FAMILY))


@lru_cache(maxsize=64)
def _families(wanted: frozenset[str]) -> tuple[tuple[str, ...], frozenset[str]]:
    """Families of fonts that have the characters, and the characters that no font has."""
    families: list[str] = []
    for family, font in _installed_fonts():
        if found := _characters_of(font, wanted):
            families.append(family)
            wanted -= found
        if not wanted:
            break
    return tuple(families), wanted


def _installed_fonts() -> Iterator[tuple[str, Any]]:
    """Upright fonts of usual weight, those without serifs first; each is read when it is needed."""
    from matplotlib import font_manager
    from matplotlib.ft2font import FT2Font

    entries = [
        entry
        for entry in font_manager.fontManager.ttflist
        if entry.style == "normal" and entry.weight in (400, "normal", "regular")
    ]
    for entry in sorted(entries, key=lambda entry: ("sans" not in entry.name.lower(), entry.name)):
        if _PLACEHOLDERS in entry.name:
            continue
        try:
            font = FT2Font(entry.fname)
        except (OSError, RuntimeError):  # it was removed, or is damaged
            continue
        if font.scalable:  # pictures of emoji of one size cannot be drawn
            yield entry.name, font
