"""Changes to files of the user's: wholly or not at all, and JSON with its comments kept.

The text of such JSON is never written anew: a member is put in or replaced, and all else stays as
it was, comments and trailing commas too.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn, cast

from webots_mcp.errors import CommandRefusedError, InvalidInputError


class FileChange(NamedTuple):
    """What a file is to hold.

    Attributes:
        file: As it was named; a symbolic link is followed when it is written.
        before: What it holds; None where there is no such file.
        after: What it is to hold.
    """

    file: Path
    before: bytes | None
    after: bytes

    @property
    def is_needed(self) -> bool:
        """Whether the file differs from what it is to hold."""
        return self.before != self.after

    @property
    def diff(self) -> str:
        """The lines that change, whatever the file's encoding."""
        before, after = (
            (content or b"").decode("utf-8", "replace").splitlines()
            for content in (self.before, self.after)
        )
        names = str(self.file), f"{self.file} (new)"
        return "\n".join(difflib.unified_diff(before, after, *names, lineterm="", n=2))


def read(file: Path) -> bytes | None:
    """What the file holds; None where there is none.

    Raises:
        OSError: It cannot be read, or is no file.
    """
    try:
        return file.read_bytes()
    except FileNotFoundError:
        for each in (file, file.parent):
            if each.is_symlink() and not each.exists():
                raise OSError(f"{each} is a symbolic link to nothing: remove or mend it") from None
        return None


def apply(change: FileChange) -> None:
    """Write the file, by a new one that takes its place; its permissions stay.

    Raises:
        CommandRefusedError: It may not be written, or has changed since it was read.
        OSError: It cannot be written.
    """
    target = change.file.resolve()
    if change.before is not None and not os.access(target, os.W_OK):
        raise CommandRefusedError(f"{change.file} is read-only: make it writable first")
    if read(change.file) != change.before:
        raise CommandRefusedError(f"{change.file} has changed meanwhile: try again")
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f".{target.name}.{os.getpid()}.new")
    try:
        with aside.open("xb") as new:
            new.write(change.after)
            new.flush()
            os.fsync(new.fileno())
        if change.before is not None:
            aside.chmod(target.stat().st_mode & 0o7777)
        os.replace(aside, target)  # noqa: PTH105
    finally:
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()


_STRING: Final = r'"(?:\\.|[^"\\\n])*"'
_COMMENT: Final = re.compile(rf"{_STRING}|(//[^\n]*|/\*.*?\*/)", re.DOTALL)
_TRAILING_COMMA: Final = re.compile(rf"{_STRING}|(,)(?=\s*[}}\]])")
_BLANK: Final = re.compile(r"\s*")
_INDENT: Final = "  "


class _Member(NamedTuple):
    """A member of an object, by where its name begins and its value begins and ends."""

    name: str
    begin: int
    value: int
    end: int


class CommentedJSON:
    """A text that holds one JSON object, perhaps with comments.

    Args:
        text: All of it.

    Raises:
        InvalidInputError: It is no such thing; the message names the line and the column.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._uncommented = _blanked(_COMMENT, text)
        self._plain = _blanked(_TRAILING_COMMA, self._uncommented)
        try:
            self.value: dict[str, Any] = json.loads(self._plain, object_pairs_hook=_unique)
        except json.JSONDecodeError as error:
            raise InvalidInputError(
                f"line {error.lineno}, column {error.colno}: {error.msg}"
            ) from error
        except RecursionError as error:
            raise InvalidInputError("its values lie too deep in each other") from error
        if not isinstance(self.value, dict):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise InvalidInputError("it holds no JSON object at its top, which begins with {")

    def with_member(self, path: tuple[str, ...], value: Any) -> str:
        """The text with a member put in or replaced; objects on the way are made.

        Raises:
            InvalidInputError: What lies on the way is no object.
        """
        begin, above = self._skip(0), self.value
        for depth, name in enumerate(path):
            here = list(self._members(begin))
            found = next((member for member in here if member.name == name), None)
            rest = path[depth + 1 :]
            if found is None:
                return self._inserted(begin, here, name, _nested(rest, value), depth + 1)
            if not rest:
                return self._replaced(found, value, depth + 1)
            above = above[name]
            if not isinstance(above, dict):
                raise InvalidInputError(f"{json.dumps(name)} holds no object there")
            above = cast("dict[str, Any]", above)
            begin = found.value
        return self.text

    def _members(self, begin: int) -> Iterator[_Member]:
        """Those of the object that begins there, with `{`."""
        decoder = json.JSONDecoder()
        place = self._skip(begin + 1)
        while self._plain[place] != "}":
            name, end = decoder.raw_decode(self._plain, place)
            value = self._skip(self._skip(end) + 1)
            _, end = decoder.raw_decode(self._plain, value)
            yield _Member(name, place, value, end)
            place = self._skip(end)
            if self._plain[place] == ",":
                place = self._skip(place + 1)

    def _skip(self, place: int) -> int:
        blank = _BLANK.match(self._plain, place)
        return blank.end() if blank else place

    def _inserted(
        self, begin: int, members: list[_Member], name: str, value: Any, depth: int
    ) -> str:
        indent = self._indent_of(members, depth)
        written = f"{indent}{json.dumps(name)}: {self._written(value, indent)}"
        if members:
            return self._appended(members[-1].end, written)
        end = self._skip(begin + 1)
        if self.text[begin + 1 : end].strip():  # a comment
            return f"{self.text[: begin + 1]}{self._eol}{written}{self.text[begin + 1 :]}"
        closing = self._eol + indent[: -len(_step_of(indent))]
        return f"{self.text[: begin + 1]}{self._eol}{written}{closing}{self.text[end:]}"

    def _appended(self, end: int, written: str) -> str:
        """Behind the last member, and behind the comment that follows it on its line."""
        trailing = re.compile(r"\s*,").match(self._uncommented, end)
        comma = trailing.end() if trailing else end
        rest = self._plain[comma:].partition("\n")[0]
        place = comma + len(rest.rstrip("\r")) if not rest.strip() else comma
        before, after = ("", ",") if trailing else (",", "")
        between = before + self.text[comma:place] + self._eol + written + after
        return self.text[:comma] + between + self.text[place:]

    def _replaced(self, member: _Member, value: Any, depth: int) -> str:
        written = self._written(value, self._indent_of([member], depth))
        return self.text[: member.value] + written + self.text[member.end :]

    def _indent_of(self, members: list[_Member], depth: int) -> str:
        """That of the members that are there, where each has a line of its own."""
        if members:
            before = self.text[: members[-1].begin].rpartition("\n")[2]
            if not before.strip():
                return before
        return _INDENT * depth

    def _written(self, value: Any, indent: str) -> str:
        lines = json.dumps(value, indent=_step_of(indent), ensure_ascii=False).split("\n")
        return (self._eol + indent).join(lines)

    @property
    def _eol(self) -> str:
        return "\r\n" if "\r\n" in self.text else "\n"


def _step_of(indent: str) -> str:
    return "\t" if indent.startswith("\t") else _INDENT


def _blanked(pattern: re.Pattern[str], text: str) -> str:
    """What the group matches becomes spaces, so that all else stays at its line and column."""

    def blank(found: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", found[0]) if found[1] else found[0]

    return pattern.sub(blank, text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        _refuse_twice([name for name, _ in pairs])
    return members


def _refuse_twice(names: list[str]) -> NoReturn:
    twice = next(name for name in names if names.count(name) > 1)
    raise InvalidInputError(f"the name {json.dumps(twice)} is there twice in one object")


def _nested(path: tuple[str, ...], value: Any) -> Any:
    for name in reversed(path):
        value = {name: value}
    return value
