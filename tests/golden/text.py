"""Answers as text that is the same on each machine, with each clock, and for each Python."""

from __future__ import annotations

import json
import re
from itertools import compress
from pathlib import Path
from typing import Any, Final, cast

from tests.golden.recordings import GoldenRecording
from tests.recordings.drawn import CHECKOUT
from webots_mcp import __version__

_WIDTH: Final = 160
_DIGITS: Final = 6
# What is told by the clock of whoever asks, or names this machine: in every recording.
_ASKED_NOW: Final = re.compile(
    r"(^|_)(file|python|sqlite|age|ago|waited|uuid|pid|process|host|path|versions|version|took|bytes|mb|sha256)(_|$)"
)
# What the clock of the machine that recorded tells: only where it was a real one.
_RECORDED_THEN: Final = re.compile(
    r"(^|_)(wall|utc|pace|factor|started|ended|created|claimed|finished|waiting|running|commit|polls)(_|$)"
    r"|^(since|until|when|clock|longest_step_s|rows_per_s|own_ms|step_wait_ms)$"
)
_UUID: Final = re.compile(r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b")
_AGO: Final = re.compile(r"\b[\d.,]+ (ms|s|minutes|hours|days|months|years)( old| ago)\b")
_MOMENT: Final = re.compile(r"\b20\d\d-\d\d-\d\d([ T]\d\d:\d\d(:\d\d(\.\d+)?)?)?( ?UTC|Z)?")
_COMMIT: Final = re.compile(r"\b[0-9a-f]{40}\b")
_VERSIONS: Final = re.compile(r"\b(python|sqlite) [\d.]+\d")
_TAKES: Final = re.compile(r"It takes [\d.]+ MB")  # most of it are scripts of a library
_MADE: Final = re.compile(r"Made on .*? UTC")
_UNIX: Final = re.compile(r"\b1[7-9]\d{8}(\.\d+)?\b")
_PACE: Final = re.compile(r", (at )?[\d.,]+ times real time")
_KEEPS_PACE: Final = "keeps pace"
_OTHER_ROUTES: Final = re.compile(r"websocket: .*", re.DOTALL)  # what else this machine offers
_CLOCK: Final = re.compile(r"\b\d\d:\d\d:\d\d(\.\d+)?\b")


class Portable:
    """Makes the answers of one recording portable: what a clock tells is left out."""

    def __init__(self, recording: GoldenRecording, folder: Path) -> None:
        self._untrue = recording.untrue
        self._real_clock = not recording.has_own_clock
        self._named_here = (
            (str(folder), "FOLDER"), (str(CHECKOUT), "CHECKOUT"), (__version__, "VERSION"),
        )  # fmt: skip

    def text(self, value: Any) -> str:
        """A value as lines, of which a change shows what changed."""
        return "\n".join(_lines(self._made(value), ""))

    def _made(self, value: Any) -> Any:
        if isinstance(value, dict):
            named = cast("dict[str, Any]", value)
            if isinstance(named.get("columns"), list) and isinstance(named.get("rows"), list):
                named = named | self._table(named["columns"], named["rows"])
            told = {key: self._made(each) for key, each in named.items() if self._told(key)}
            return {
                key: each
                for key, each in told.items()
                if each != {} and not (isinstance(each, str) and each in self._untrue)
            }
        if isinstance(value, list | tuple):
            items = list(cast("list[Any]", value))
            if self._real_clock:
                items = [each for each in items if _KEEPS_PACE not in (each, *_first_of(each))]
            return [self._made(each) for each in items]
        if isinstance(value, float):
            return float(f"{value:.{_DIGITS}g}")
        return self._words(value) if isinstance(value, str) else value

    def _table(self, columns: list[str], rows: list[list[Any]]) -> dict[str, Any]:
        """Columns and rows without those columns that a clock tells."""
        told = [self._told(name) for name in columns]
        return {
            "columns": list(compress(columns, told)),
            "rows": [list(compress(row, told)) for row in rows],
        }

    def _told(self, name: str) -> bool:
        if _ASKED_NOW.search(name):
            return False
        is_length = name.endswith("_m")  # such as that to a wall
        return is_length or not (self._real_clock and _RECORDED_THEN.search(name))

    def _words(self, text: str) -> Any:
        if text.startswith("{") and text.endswith("}"):  # JSON, such as a state in a view
            return self._made(json.loads(text))
        text = _OTHER_ROUTES.sub("other routes", text)
        for written, stands in self._named_here:
            text = text.replace(written, stands)
        text = _VERSIONS.sub(r"\1 VERSION", _COMMIT.sub("COMMIT", _UUID.sub("UUID", text)))
        text = _MADE.sub("Made on MOMENT", _TAKES.sub("It takes MB", text))
        text = _AGO.sub(r"… \1\2", text)
        if self._real_clock:
            text = _PACE.sub("", text)  # told of runs that took long enough
            for pattern in (_MOMENT, _CLOCK, _UNIX):
                text = pattern.sub("CLOCK", text)
        return text


def _first_of(value: Any) -> list[Any]:
    return cast("list[Any]", value)[:1] if isinstance(value, list) else []


def _lines(value: Any, indent: str) -> list[str]:
    """JSON that breaks only where a line would be too long."""
    flat = json.dumps(value, ensure_ascii=False, allow_nan=True)
    if len(indent) + len(flat) <= _WIDTH or not isinstance(value, dict | list) or not value:
        return [indent + flat]
    if isinstance(value, dict):
        lines: list[str] = []
        for key, each in cast("dict[str, Any]", value).items():
            first, *rest = _lines(each, indent + "  ")
            lines += (
                [f"{indent}{key}: {first.strip()}", *rest]
                if not rest
                else [f"{indent}{key}:", first, *rest]
            )
        return lines
    return [line for each in cast("list[Any]", value) for line in _item(each, indent)]


def _item(value: Any, indent: str) -> list[str]:
    first, *rest = _lines(value, indent + "  ")
    return [f"{indent}- {first.strip()}", *rest]
