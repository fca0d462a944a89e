"""Values made short enough to be read whole, by rules that are stated in the answer.

Lengths are counted in tokens of compact JSON, about as models read it.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple, cast

Client = Literal["mcp", "cli"]
reader: Final[ContextVar[Client]] = ContextVar("reader", default="mcp")
STATE_BUDGET_TOKENS: Final = 1_500


@dataclass(frozen=True)
class ShorteningLimits:
    """How much of one value is shown."""

    items: int
    text: int
    keys: int
    depth: int
    exact: bool = False

    def rule(self) -> str:
        """Return the rule in words."""
        return (
            f"arrays over {self.items} items are summarised; texts over {self.text} characters, "
            f"objects over {self.keys} keys and what is nested over {self.depth} deep are cut"
        )


# From generous to tight: the first under which a value fits its budget is taken. Names go last.
GLANCE: Final = (
    ShorteningLimits(items=16, text=200, keys=64, depth=8),
    ShorteningLimits(items=8, text=80, keys=32, depth=5),
    ShorteningLimits(items=4, text=40, keys=20, depth=3),
    ShorteningLimits(items=2, text=20, keys=10, depth=2),
    ShorteningLimits(items=2, text=12, keys=6, depth=1),
)
WHOLE: Final = tuple(
    replace(limits, exact=True)
    for limits in (
        ShorteningLimits(items=2000, text=4000, keys=1000, depth=20),
        ShorteningLimits(items=16, text=200, keys=1000, depth=20),
        *GLANCE,
    )
)


class Shortened(NamedTuple):
    """A value that fits its budget, and the rule by which something was left out (else None)."""

    value: Any
    rule: str | None


def is_for_a_person() -> bool:
    """Return whether a person reads the answer in a terminal, where nothing is cut."""
    return reader.get() == "cli"


def shorten(
    value: Any,
    budget_tokens: int = STATE_BUDGET_TOKENS,
    levels: Sequence[ShorteningLimits] = GLANCE,
) -> Shortened:
    """Make a JSON value fit `budget_tokens` of compact JSON, as `tokens_in` counts them.

    Long arrays of numbers become `{"count", "min", "max", "mean", "argmin"}`, the names that the
    same array's signals have. With the levels `GLANCE` numbers are rounded (see
    `round_number`), which is the stated default and not reported; with `WHOLE` they are exact.
    """
    for limits in levels:
        shortener = _Shortener(limits)
        short = shortener.shorten(value, 0)
        if _fits(short, budget_tokens):
            return Shortened(short, limits.rule() if shortener.cut else None)
    text, longest = compact_json(value), 4 * budget_tokens
    while longest and not _fits(_cut(text, longest), budget_tokens):
        longest //= 2
    return Shortened(_cut(text, longest), f"cut to {longest} characters")


def compact_json(value: Any) -> str:
    """JSON without blanks, as the model reads it; an infinity, which JSON has not, is null."""
    try:
        return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return compact_json(json.loads(json.dumps(value), parse_constant=lambda _: None))


def tokens_in(text: str) -> int:
    """About how many tokens a model reads: of JSON in words 4 characters each, in numbers 1.8."""
    # The tokenizers of models differ, so this is an estimate: a word of up to 12 letters, three
    # digits, or a few signs together are one token, and so is any other character.
    return len(re.findall(r" ?[A-Za-z]{1,12}|\d{1,3}| ?[!-/:-@\[-`{-~]{1,4}|\s{1,16}|.", text))


def tokens_of(value: Any) -> int:
    """Return how many tokens of compact JSON an answer has, or a part of it."""
    return tokens_in(compact_json(value))


def _fits(value: Any, budget_tokens: int) -> bool:
    """Return whether a value fits; its length usually decides it without a count."""
    text = compact_json(value)
    if len(text) <= budget_tokens or len(text) > budget_tokens * 16:  # of a token at most
        return len(text) <= budget_tokens
    return tokens_in(text) <= budget_tokens


def round_number(value: float) -> float:
    """Return a number with 4 significant digits, but never coarser than a thousandth.

    So a time of 1234.567 s and a position far from the origin keep what moves. What adding leaves
    of a sum, as 2.25e-16, is the 0 that it means.
    """
    if abs(value) < 1e-12:
        return 0.0
    return round(value, 3) if abs(value) >= 1 else float(f"{value:.4g}")


def cut_text(text: str, longest: int) -> str:
    """Return a text with its true length at the end where something was left out."""
    return text if len(text) <= longest else _cut(text, longest)


def _cut(text: str, longest: int) -> str:
    return f"{text[:longest]}… [{len(text)} characters]"


class _Shortener:
    def __init__(self, limits: ShorteningLimits) -> None:
        self._limits = limits
        self.cut = False

    def shorten(self, value: Any, depth: int) -> Any:
        if isinstance(value, float):
            return value if self._limits.exact else round_number(value)
        if isinstance(value, str):
            return self._text(value)
        if isinstance(value, dict):
            return self._object(cast("dict[str, Any]", value), depth)
        if isinstance(value, list):
            return self._array(cast("list[Any]", value), depth)
        return value

    def _text(self, text: str) -> str:
        self.cut |= len(text) > self._limits.text
        return cut_text(text, self._limits.text)

    def _object(self, members: dict[str, Any], depth: int) -> Any:
        if depth >= self._limits.depth and members:
            self.cut = True
            return f"{{{len(members)} keys}}"
        shown: dict[str, Any] = {}
        for key, item in list(members.items())[: self._limits.keys]:
            name = self._text(key)
            shown[key if name in shown else name] = self.shorten(item, depth + 1)
        if len(members) > len(shown):
            self.cut = True
            first, last = [*members][len(shown)], [*members][-1]
            more = f"{len(members) - len(shown)} more keys"
            shown["…"] = f"{more}: {self._text(first)} to {self._text(last)}"
        return shown

    def _array(self, items: list[Any], depth: int) -> Any:
        if len(items) > self._limits.items:
            self.cut = True
            return self._summary(items, depth)
        if depth >= self._limits.depth and any(isinstance(item, (dict, list)) for item in items):
            self.cut = True
            return f"[{len(items)} items]"
        return [self.shorten(item, depth + 1) for item in items]

    def _summary(self, items: list[Any], depth: int) -> dict[str, Any]:
        numbers = [item for item in items if _is_figure(item)]
        others = [item for item in items if not _is_figure(item)]
        if all(item is None or item in ("nan", "inf", "-inf") for item in others):
            return {**self._statistics(items, numbers), **_counts(others)}
        first = [self.shorten(item, depth + 1) for item in items[: min(3, self._limits.items)]]
        return {"count": len(items), "first": first}

    @staticmethod
    def _statistics(items: list[Any], numbers: list[float]) -> dict[str, Any]:
        if not numbers:
            return {"count": len(items)}
        low, high = min(numbers), max(numbers)
        mean = sum(number / len(numbers) for number in numbers)
        return {
            "count": len(items),
            "min": round_number(low),
            "max": round_number(high),
            "mean": round_number(mean),
            "argmin": items.index(low),
        }


def _is_figure(item: Any) -> bool:
    """Return whether it is a number that a float can hold, unlike an integer of 400 digits."""
    return type(item) in (int, float) and abs(item) <= sys.float_info.max


def _counts(others: list[Any]) -> dict[str, int]:
    """Return how many items are no numbers, by what they are."""
    names = ["null" if item is None else str(item) for item in others]
    return {name: names.count(name) for name in dict.fromkeys(names)}


def cut_for_a_model(text: str, longest: int) -> str:
    """Return a text that is cut where it would fill a model's context."""
    return text if is_for_a_person() else cut_text(text, longest)
