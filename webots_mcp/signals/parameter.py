"""What a tunable parameter may be set to: bridge and server refuse the same values.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.naming import nearest_first

Value: TypeAlias = "float | int | bool | str"

MOST_PARAMETERS: Final = 500  # of one controller: each run records all of them
MOST_TEXT_CHARACTERS: Final = 1000
LARGEST_INT: Final = 2**53  # up to here JSON, SQLite and floats hold an integer exactly
_KINDS: Final[dict[type[Any], str]] = {bool: "bool", int: "int", float: "float", str: "str"}
_MEANT: Final = {
    "float": "a number",
    "int": "a whole number of at most 53 bits",
    "bool": "true or false",
    "str": f"a text of at most {MOST_TEXT_CHARACTERS} characters",
}


class DeclarationLimits(NamedTuple):
    """Limits of a declaration of a parameter.

    Attributes:
        name_characters: Maximum length of a name.
        unit_characters: Maximum length of a unit.
        choices: Maximum number of choices.
        near: Similar names or choices that an error offers.
        shown_characters: Length at which an error cuts a value.
    """

    name_characters: int = 100
    unit_characters: int = 40
    choices: int = 100
    near: int = 5
    shown_characters: int = 80


_LIMITS: Final = DeclarationLimits()


class Declaration(NamedTuple):
    """A parameter as a controller declares it; made by `declare`.

    Attributes:
        kind: `float`, `int`, `bool` or `str`.
        low: The minimum; None without a bound. Only numbers have bounds.
        high: The maximum; None without a bound.
        choices: All values that it may have; None where it may have others.
        doc: What it does.
        unit: Of a number.
    """

    name: str
    kind: str
    default: Value
    low: float | None = None
    high: float | None = None
    choices: tuple[Value, ...] | None = None
    doc: str = ""
    unit: str | None = None

    def as_row(self) -> dict[str, Any]:
        """Return what its row in the table `parameter` holds, where texts stand for JSON."""
        choices = None if self.choices is None else json.dumps(self.choices, ensure_ascii=False)
        default = json.dumps(self.default, ensure_ascii=False)
        return {**self._asdict(), "default": default, "choices": choices}

    @classmethod
    def of_row(cls, *row: Any) -> Declaration:
        """The declaration that a row holds, of which these are the values in the fields' order."""
        name, kind, default, low, high, choices, doc, unit = row
        listed = None if choices is None else tuple(json.loads(choices))
        return cls(name, kind, json.loads(default), low, high, listed, doc, unit)

    def checked(self, value: object) -> Value:
        """Return the value as the parameter holds it: a float parameter takes 3 as 3.0.

        Raises:
            InvalidInputError: It is of another type, out of bounds or none of the choices.
        """
        found = _as_kind(self.kind, as_plain(value))
        if found is None or not self._is_allowed(found):
            raise InvalidInputError(
                f"Parameter {self.name!r} must be {self.expected}, not {_shown(value)}"
            )
        return found

    @property
    def expected(self) -> str:
        """What it may be set to, in words."""
        if self.choices is not None:
            return f"one of {', '.join(map(repr, self.choices))}"
        low = "" if self.low is None else f" from {_bound_text(self.low)}"
        high = "" if self.high is None else f" up to {_bound_text(self.high)}"
        return f"{_MEANT[self.kind]}{low}{high}"

    def _is_allowed(self, value: Value) -> bool:
        if self.choices is not None:
            return value in self.choices
        if isinstance(value, str):
            return True
        return not (
            (self.low is not None and value < self.low)
            or (self.high is not None and value > self.high)
        )


def declare(
    name: object,
    default: object,
    *,
    low: object = None,
    high: object = None,
    choices: object = None,
    doc: object = "",
    unit: object = None,
) -> Declaration:
    """Return a declaration, checked as a whole.

    Raises:
        TypeError: The name, the default or another argument is of a type that it cannot have.
        ValueError: One is out of bounds, or they contradict each other.
    """
    _require_name(name)
    plain = as_plain(default)
    kind = _KINDS.get(type(plain))
    if kind is None:
        raise TypeError(
            f"parameter {name!r}: the default is a float, int, bool or str, not {_shown(default)}"
        )
    least, greatest = _bound(name, kind, low, -math.inf), _bound(name, kind, high, math.inf)
    if least is not None and greatest is not None and least > greatest:
        raise ValueError(f"parameter {name!r}: low={least:g} is greater than high={greatest:g}")
    bounded = Declaration(str(name), kind, False, least, greatest)
    try:
        listed = None if choices is None else _listed(bounded, choices)
        chosen = bounded._replace(choices=listed, doc=_doc(name, doc), unit=_unit(name, unit))
        return chosen._replace(default=chosen.checked(plain))
    except InvalidInputError as error:
        raise ValueError(f"{error}. Correct its declaration.") from None


def require_known(names: Sequence[str], known: Sequence[str]) -> None:
    """Refuse names that no declared parameter has.

    Raises:
        InvalidInputError: It names them, and the declared names most like the first of them.
    """
    unknown = [name for name in names if name not in known]
    if not unknown:
        return
    if not known:
        raise InvalidInputError(
            "This robot's controller declares no parameters, so none can be read or "
            "set. In it, write "
            'kp = bridge.parameter("kp", 2.0, low=0.0, high=10.0) and use kp.value in its loop'
        )
    near = nearest_first(unknown[0], known)[: _LIMITS.near]
    more = (
        f", nor {', '.join(repr(name[: _LIMITS.shown_characters]) for name in unknown[1:4])}"
        if unknown[1:]
        else ""
    )
    raise InvalidInputError(
        f"No parameter {unknown[0][: _LIMITS.shown_characters]!r}{more}. "
        f"The nearest of {len(known)} that the controller declares: {', '.join(near)}"
    )


def as_plain(value: Any) -> object:
    """A Python number, flag or text in place of numpy's, of an enumeration's, of a subclass's."""
    if getattr(value, "shape", None) == () and hasattr(value, "item"):
        value = value.item()
    if isinstance(value, (bool, type(None))):
        return value
    for kind in (int, float):
        if isinstance(value, kind):
            return kind(value)
    return str.__str__(value) if isinstance(value, str) else value


def _as_kind(kind: str, value: object) -> Value | None:
    """Return the value as one of that kind; None where it is none."""
    if kind == "bool" or isinstance(value, bool):
        return value if kind == "bool" and isinstance(value, bool) else None
    if kind == "str" or isinstance(value, str):
        return value if kind == "str" and isinstance(value, str) and _is_storable(value) else None
    if not isinstance(value, (int, float)) or not _is_finite(value):
        return None
    if kind == "float":
        return float(value)
    is_whole = value == int(value) and abs(value) <= LARGEST_INT
    return int(value) if is_whole else None


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def _is_storable(text: str) -> bool:
    """No encoding has surrogates, and SQLite's shell would end the text at a NUL."""
    has_surrogate = any("\ud800" <= character <= "\udfff" for character in text)
    return len(text) <= MOST_TEXT_CHARACTERS and "\0" not in text and not has_surrogate


def _require_name(name: object) -> None:
    if not isinstance(name, str):
        raise TypeError(f"the name of a parameter is a text, not {_shown(name)}")
    fits = 0 < len(name) <= _LIMITS.name_characters and name.isprintable()
    if not fits or " " in name or "=" in name:
        raise ValueError(
            f"parameter {name[: _LIMITS.name_characters]!r} needs another name: 1 to "
            f"{_LIMITS.name_characters} printable characters without a space or '='"
        )


def _bound(name: object, kind: str, bound: object, none: float) -> float | None:
    """Return a bound; None for none, as which infinity on its side counts."""
    plain = as_plain(bound)
    if plain is None:
        return None
    if kind not in ("float", "int"):
        raise TypeError(f"parameter {name!r}: a {kind} has no bounds; give choices, or neither")
    if isinstance(plain, bool) or not isinstance(plain, (int, float)):
        raise TypeError(f"parameter {name!r}: a bound is a number, not {_shown(bound)}")
    if plain == none:
        return None
    if not _is_finite(plain) or (kind == "int" and abs(plain) > LARGEST_INT):
        raise ValueError(f"parameter {name!r}: a bound is a finite number, not {_shown(bound)}")
    return float(plain)


def _listed(declaration: Declaration, choices: object) -> tuple[Value, ...]:
    if isinstance(choices, (str, bytes)) or not isinstance(choices, Sequence):
        raise TypeError(
            f"parameter {declaration.name!r}: choices is a list of values, not {_shown(choices)}"
        )
    values = cast("Sequence[object]", choices)
    if not 0 < len(values) <= _LIMITS.choices:
        raise ValueError(
            f"parameter {declaration.name!r}: give 1 to {_LIMITS.choices} choices, "
            f"not {len(values)}"
        )
    return tuple(dict.fromkeys(declaration.checked(value) for value in values))


def _bound_text(bound: float) -> str:
    return f"{int(bound)}" if bound.is_integer() and abs(bound) <= LARGEST_INT else f"{bound!r}"


def _doc(name: object, doc: object) -> str:
    if not isinstance(doc, str):
        raise TypeError(f"parameter {name!r}: doc is a text, not {_shown(doc)}")
    return doc[:MOST_TEXT_CHARACTERS].encode("utf-8", "replace").decode().replace("\0", "\\0")


def _unit(name: object, unit: object) -> str | None:
    if unit is None:
        return None
    if isinstance(unit, str) and unit.isprintable() and len(unit) <= _LIMITS.unit_characters:
        return unit
    raise TypeError(f"parameter {name!r}: the unit is a short text such as 'm/s', not {unit!r:.80}")


def _shown(value: object) -> str:
    """Return a value as an error names it; its own words may fail, or be long."""
    try:
        text = repr(value)[: _LIMITS.shown_characters]
    except Exception as error:  # noqa: BLE001  (an object of the user's, or an integer too long)
        text = f"(no text: its repr() raised {type(error).__name__})"
    return f"{text} ({type(value).__name__})"
