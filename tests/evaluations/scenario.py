"""Scenarios: a subject, a question, the form of its answer, and what has to be done."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

FILE: Final = Path(__file__).with_name("scenarios.toml")
CANNOT_TELL: Final = "cannot tell"
KINDS: Final = ("time", "number", "name", "verdict")
DEFAULT_CALLS: Final = 8

_NUMBER: Final = re.compile(r"([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)\s*[a-zA-Z/%°²]*", re.IGNORECASE)
_UNKNOWN: Final = {"cannot tell", "can't tell", "cannot be told", "cannot be known", "unknown"}


@dataclass(frozen=True)
class Field:
    """One member of an answer: how it is asked for, and which values are right.

    Attributes:
        options: Of a verdict, what may be chosen.
        right: The values that are right; `CANNOT_TELL` where the subject does not hold the answer.
        within: Of a time or number, the largest error that is accepted.
        found_at: Where the answers to the planned calls have it; empty where none has it.
        call: Number of the only planned call whose answer is searched; None for all.
        pattern: Takes the value out of a text that is found there.
        words: Translates what is found, by a part of its text, into an option.
        otherwise: What the plan answers where nothing is found.
    """

    name: str
    kind: str
    right: tuple[Any, ...]
    asks: str = ""
    options: tuple[str, ...] = ()
    within: float = 0.0
    found_at: str = ""
    call: int | None = None
    pattern: str = ""
    words: Mapping[str, str] = field(default_factory=dict[str, str])
    otherwise: str = CANNOT_TELL

    def line(self) -> str:
        """Return the line of the form that asks for it."""
        values = {
            "time": "a number of seconds of simulated time",
            "number": "a number",
            "name": "a name as it is recorded",
            "verdict": " or ".join(f'"{option}"' for option in self.options),
        }[self.kind]
        return f'  "{self.name}": {values}' + (f" ({self.asks})" if self.asks else "")

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of the value."""
        unknown = {"const": CANNOT_TELL}
        if self.kind == "verdict":
            return {"enum": [*dict.fromkeys([*self.options, CANNOT_TELL])]}
        value = {"type": "string" if self.kind == "name" else "number"}
        return {"anyOf": [value, unknown], "description": self.asks or self.name}

    def accepts(self, said: Any) -> bool:
        """Return whether a value is right."""
        return any(self._is(said, right) for right in self.right)

    def _is(self, said: Any, right: Any) -> bool:
        if right == CANNOT_TELL or is_unknown(said):
            return right == CANNOT_TELL and is_unknown(said)
        if self.kind in ("time", "number"):
            number = _as_number(said)
            return number is not None and abs(number - right) <= self.within + 1e-9
        return _as_word(said) == _as_word(right)


@dataclass(frozen=True)
class Check:
    """What holds after a right answer: in the database (`sql`) or in the simulation (`path`)."""

    means: str
    sql: str = ""
    path: str = ""
    value: Any = None
    within: float = 0.0
    at_least: float | None = None

    def accepts(self, found: Any) -> bool:
        """Return whether what was found is what has to be there."""
        if self.at_least is not None:
            return isinstance(found, (int, float)) and found >= self.at_least
        if isinstance(found, (int, float)) and isinstance(self.value, (int, float)):
            return abs(found - self.value) <= self.within + 1e-9
        return found == self.value


@dataclass(frozen=True)
class Scenario:
    """One of them.

    Attributes:
        calls: How many calls a client may make.
        may: Actions that may be sent to robots; any other one is forbidden.
        order: Actions that have to be done, in this order.
    """

    name: str
    of: str
    question: str
    calls: int
    plan: tuple[tuple[str, dict[str, Any]], ...]
    fields: tuple[Field, ...]
    may: tuple[str, ...]
    order: tuple[str, ...]
    checks: tuple[Check, ...]

    def text(self) -> str:
        """Return what a client reads: the question and the form of its answer."""
        lines = ",\n".join(each.line() for each in self.fields)
        return (
            f"{self.question}\n\nUse the tools of the server webots. End with one JSON object with "
            f"exactly these members:\n{{\n{lines}\n}}\n"
            f'Give "{CANNOT_TELL}" for a member that cannot be known.'
        )

    def schema(self) -> dict[str, Any]:
        """Return the JSON schema of an answer."""
        return {
            "type": "object",
            "properties": {each.name: each.schema() for each in self.fields},
            "required": [each.name for each in self.fields],
            "additionalProperties": False,
        }


def is_unknown(said: Any) -> bool:
    """Return whether a value says that the answer cannot be known."""
    return said is None or (isinstance(said, str) and _as_word(said) in _UNKNOWN)


def _as_word(said: Any) -> str:
    if isinstance(said, bool):
        return "yes" if said else "no"
    return str(said).strip(" \t\n`'\".").casefold().replace("_", " ").replace("\u2019", "'")


def _as_number(said: Any) -> float | None:
    if isinstance(said, (int, float)):
        return None if isinstance(said, bool) else float(said)
    match = _NUMBER.fullmatch(str(said).strip().replace("\N{MINUS SIGN}", "-"))
    return float(match[1]) if match else None


def read_scenarios() -> list[Scenario]:
    """Return all of them, in the order of the file."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    return [_scenario(table) for table in toml.loads(FILE.read_text("utf-8"))["scenario"]]


def _scenario(table: dict[str, Any]) -> Scenario:
    return Scenario(
        **{key: table[key] for key in ("name", "of", "question")},
        calls=table.get("calls", DEFAULT_CALLS),
        plan=tuple((call.pop("tool"), call) for call in table["plan"]),
        fields=tuple(_field(name, each) for name, each in table["answer"].items()),
        may=tuple(table.get("may", ())),
        order=tuple(table.get("order", ())),
        checks=tuple(_check(each) for each in table.get("checks", ())),
    )


def _field(name: str, table: dict[str, Any]) -> Field:
    right: Any = table.pop("is")
    options, found_at = tuple(table.pop("of", ())), table.pop("from", "")
    accepted: list[Any] = right if isinstance(right, list) else [right]
    return Field(name, right=tuple(accepted), options=options, found_at=found_at, **table)


def _check(table: dict[str, Any]) -> Check:
    return Check(value=table.pop("is", None), **table)
