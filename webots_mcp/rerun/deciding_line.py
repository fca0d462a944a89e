"""The line at which two versions of a controller decide differently, in the round that differs.

Both are traced in that round only. Their lines are paired by the text of the files; a line that
only one of them has is passed over. Where a pair is followed by different lines, the pair decides.
Otherwise the last line that was changed decides, else the first whose values differ, else the one
that gives the command.
"""

from __future__ import annotations

import linecache
import re
import sys
from collections.abc import Mapping, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from types import FrameType, MemberDescriptorType
from typing import Any, Final, NamedTuple, cast

from webots_mcp.database.tapes.package_surface import caller_frame
from webots_mcp.database.tapes.source_files import relative_source

MOST_LINES: Final = 20_000  # that are traced in the round
_MOST_VALUES: Final = 12  # of a line
_MOST_CHARACTERS: Final = 80  # of a value
_MOST_ITEMS: Final = 8
_PLAIN: Final = (int, float, bool, str, type(None))
_WORD: Final = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")


class TracedLine(NamedTuple):
    """A line that was executed, and the values of the names on it right before."""

    file: str
    line: int
    values: dict[str, str]


class DecidingLine(NamedTuple):
    """Where two versions decide differently.

    Attributes:
        place: The line in the new version, `controllers/rover/nav.py:123`.
        text: Its text there.
        old_place: The same line in the old version; None where that does not have it.
        old_text: Its text there.
        new_values: The values of the names on it, in the new version.
        old_values: The same in the old one.
        new_next: The line that the new version executed next; None if it is the command itself.
        old_next: The line that the old version executed next.
    """

    place: str
    text: str
    old_place: str | None
    old_text: str | None
    new_values: dict[str, str]
    old_values: dict[str, str]
    new_next: str | None
    old_next: str | None


class RoundTracer:
    """Traces the lines of the user's code in one round.

    Args:
        root: The folder of the project.
        number: The round, from 0.
    """

    def __init__(self, root: Path, number: int) -> None:
        self._root = root
        self._number = number
        self._names: dict[str, str | None] = {}
        self.lines: list[TracedLine] = []

    def begin_round(self, number: int) -> None:
        """Begin or end the tracing, before a round begins."""
        if number == self._number:
            sys.settrace(self._enter)
            frame: FrameType | None = caller_frame(1)
            while frame is not None:
                if self._file_of(frame) is not None:
                    frame.f_trace = self._trace
                frame = frame.f_back
        elif number > self._number:
            sys.settrace(None)

    def _file_of(self, frame: FrameType) -> str | None:
        name = frame.f_code.co_filename
        if name not in self._names:
            self._names[name] = relative_source(name, self._root)
        return self._names[name]

    def _enter(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self._trace if self._file_of(frame) is not None else None

    def _trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line" and len(self.lines) < MOST_LINES:
            file = self._file_of(frame) or ""
            text = linecache.getline(frame.f_code.co_filename, frame.f_lineno)
            self.lines.append(TracedLine(file, frame.f_lineno, values_on_line(frame, text)))
        return self._trace


def values_on_line(frame: FrameType, text: str) -> dict[str, str]:
    """Return the values of the names on a line of code that are numbers, texts or lists of them."""
    values: dict[str, str] = {}
    for name in dict.fromkeys(_WORD.findall(text.partition("#")[0])):
        first, *attributes = name.split(".")
        known, value = _value_of(frame, first)
        for attribute in attributes:
            known, value = _attribute(value, attribute) if known else (False, None)
        shown = _shown(value) if known else None
        if shown is not None and len(values) < _MOST_VALUES:
            values[name] = shown
    return values


def _value_of(frame: FrameType, name: str) -> tuple[bool, Any]:
    for scope in (frame.f_locals, frame.f_globals):
        if name in scope:
            return True, scope[name]
    return False, None


def _attribute(value: Any, name: str) -> tuple[bool, Any]:
    """Read an attribute that an object itself holds; no code of the user runs."""
    try:
        own: Any = object.__getattribute__(value, "__dict__")
    except AttributeError:
        own = None
    if type(own) is dict and name in own:
        return True, cast("dict[str, Any]", own)[name]
    for cls in type.__dict__["__mro__"].__get__(type(value)):
        slot = type.__dict__["__dict__"].__get__(cls).get(name)
        if type(slot) is MemberDescriptorType:
            try:
                return True, slot.__get__(value, cls)
            except AttributeError:
                return False, None
    return False, None


def _shown(value: Any) -> str | None:
    """Return a value as text; None for what is neither plain nor a short list of that."""
    if type(value) in (list, tuple):
        items = cast("Sequence[Any]", value)
        if len(items) > _MOST_ITEMS or not all(type(each) in _PLAIN for each in items):
            return None
    elif type(value) not in _PLAIN:
        return None
    text = repr(value)
    return text if len(text) <= _MOST_CHARACTERS else f"{text[: _MOST_CHARACTERS - 3]}..."


# -- comparing -------------------------------------------------------------------------------------


def find_deciding_line(
    old: Sequence[TracedLine],
    new: Sequence[TracedLine],
    old_sources: Mapping[str, str],
    new_sources: Mapping[str, str],
    commanded: tuple[str | None, str | None],
    renamed: Mapping[str, str],
) -> DecidingLine | None:
    """Return the line at which two traces of a round part; None where neither has a line.

    Args:
        old: The lines that the old version executed in the round.
        new: Those of the new version.
        old_sources: The old files by path.
        new_sources: The new ones.
        commanded: The places, `file:line`, of the first command that differs: old and new.
        renamed: The old name of each new file that has another one.
    """
    texts = _PairedTexts(old_sources, new_sources, renamed)
    at_old, at_new = 0, 0
    changed: DecidingLine | None = None
    unequal: DecidingLine | None = None
    last_old: int | None = None
    last_new: int | None = None
    while at_old < len(old) and at_new < len(new):
        before, after = old[at_old], new[at_new]
        if texts.is_pair(before, after):
            last_old, last_new = at_old, at_new
            if unequal is None and before.values != after.values:
                unequal = texts.deciding(before, after, (None, None))
            if texts.text(before, is_new=False) != texts.text(after, is_new=True):
                changed = texts.deciding(before, after, (None, None))
            at_old, at_new = at_old + 1, at_new + 1
        elif not texts.has_partner(after, is_new=True):
            changed = texts.deciding(None, after, (None, None))
            at_new += 1
        elif not texts.has_partner(before, is_new=False):
            at_old += 1
        else:
            break
    if at_old < len(old) and at_new < len(new):
        return _parting(old, new, (at_old, at_new), (last_old, last_new), texts)
    return changed or unequal or _at_command(old, new, commanded, texts)


def _parting(
    old: Sequence[TracedLine],
    new: Sequence[TracedLine],
    following: tuple[int, int],
    last: tuple[int | None, int | None],
    texts: _PairedTexts,
) -> DecidingLine | None:
    at_old, at_new = following
    nexts = (texts.line(new[at_new], is_new=True), texts.line(old[at_old], is_new=False))
    if at_new > 0 and not texts.has_partner(new[at_new - 1], is_new=True):
        return texts.deciding(None, new[at_new - 1], nexts)  # a line that was added decides
    before = old[last[0]] if last[0] is not None else None
    after = new[last[1]] if last[1] is not None else None
    return texts.deciding(before, after, nexts) if after is not None else None


def _at_command(
    old: Sequence[TracedLine],
    new: Sequence[TracedLine],
    commanded: tuple[str | None, str | None],
    texts: _PairedTexts,
) -> DecidingLine | None:
    """Both went the same way with other values: the line of the command decides."""
    found = [
        next((each for each in reversed(lines) if f"{each.file}:{each.line}" == place), None)
        for lines, place in ((old, commanded[0]), (new, commanded[1]))
    ]
    if found[1] is None:
        found[1] = new[-1] if new and found[0] is None else None
    if found[1] is None and found[0] is not None:  # the old command is not given any more
        return texts.deciding(found[0], None, (None, None))
    return texts.deciding(found[0], found[1], (None, None)) if found[1] is not None else None


class _PairedTexts:
    """The files of both versions, and which lines of them are the same line."""

    def __init__(
        self, old: Mapping[str, str], new: Mapping[str, str], renamed: Mapping[str, str]
    ) -> None:
        self._renamed = renamed
        self._old = {name: text.splitlines() for name, text in old.items()}
        texts = sorted(new.items(), key=lambda each: each[0] in renamed)  # these come last, and win
        self._new = {renamed.get(name, name): text.splitlines() for name, text in texts}
        self._pairs: dict[str, dict[int, int]] = {}
        self._partners: dict[str, set[int]] = {}

    def _paired(self, file: str) -> dict[int, int]:
        """Return the line of the new file for each line of the old one that it still has."""
        found = self._pairs.get(file)
        if found is None:
            before, after = self._old.get(file, []), self._new.get(file, [])
            found = self._pairs[file] = {}
            for tag, b0, b1, a0, a1 in SequenceMatcher(None, before, after, False).get_opcodes():
                if tag == "equal" or (tag == "replace" and b1 - b0 == a1 - a0):
                    found |= {b0 + i + 1: a0 + i + 1 for i in range(b1 - b0)}
            self._partners[file] = set(found.values())
        return found

    def is_pair(self, before: TracedLine, after: TracedLine) -> bool:
        same = before.file == self._name(after)
        return same and self._paired(before.file).get(before.line) == after.line

    def has_partner(self, traced: TracedLine, *, is_new: bool) -> bool:
        name = self._name(traced) if is_new else traced.file
        paired = self._paired(name)
        return traced.line in (self._partners[name] if is_new else paired)

    def _name(self, traced: TracedLine) -> str:
        """Return the old name of the file of a line of the new version."""
        return self._renamed.get(traced.file, traced.file)

    def text(self, traced: TracedLine, *, is_new: bool) -> str:
        known = self._new.get(self._name(traced)) if is_new else self._old.get(traced.file)
        lines = known or []
        return lines[traced.line - 1].strip() if traced.line <= len(lines) else ""

    def line(self, traced: TracedLine, *, is_new: bool) -> str:
        return f"{traced.file}:{traced.line}: {self.text(traced, is_new=is_new)}"

    def deciding(
        self,
        before: TracedLine | None,
        after: TracedLine | None,
        nexts: tuple[str | None, str | None],
    ) -> DecidingLine | None:
        shown = after or before
        if shown is None:
            return None
        return DecidingLine(
            f"{shown.file}:{shown.line}",
            self.text(shown, is_new=after is not None),
            f"{before.file}:{before.line}" if before else None,
            self.text(before, is_new=False) if before else None,
            after.values if after else {},
            before.values if before else {},
            *nexts,
        )
