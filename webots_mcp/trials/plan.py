"""What a plan file says: which parameters are tried, for how long, and how a run is scored."""

from __future__ import annotations

import itertools
import json
import math
import sys
from dataclasses import asdict, dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import Any, Final, cast, get_args

from webots_mcp.conditions import parse_condition
from webots_mcp.conditions.score import parse_score
from webots_mcp.errors import InvalidInputError
from webots_mcp.naming import nearest_first
from webots_mcp.store.analysis.ranking import Best

MOST_TRIALS: Final = 10_000
_GRID: Final = "grid"
_REQUIRED: Final = ("world", "score", "parameters")


@dataclass(frozen=True)
class Plan:
    """A plan.

    Attributes:
        world: The world file, with its full path.
        score: See docs/trials.md.
        parameters: The sets that are tried.
        best: Which scores are the best.
        for_s: A trial ends after so many simulated seconds ...
        until: ... or when this condition holds, whichever comes first.
        repeats: How often each set is tried. With 1, the first one is tried twice nevertheless:
            that tells by how much like trials differ.
        robot: Whose signals, events and parameters are meant, where a world has several.
        timeout_s: A trial that takes longer, in wall time, has failed.
    """

    world: str
    score: str
    parameters: list[dict[str, Any]]
    best: Best = "highest"
    for_s: float | None = None
    until: str | None = None
    repeats: int = 1
    robot: str | None = None
    timeout_s: float = 300.0

    def __post_init__(self) -> None:
        if not Path(self.world).is_file():
            raise InvalidInputError(f"world: there is no file {self.world}")
        parse_score(self.score)
        if self.until is not None:
            parse_condition(self.until)
        if self.for_s is None and self.until is None:
            raise InvalidInputError("give for_s, until or both: when does a trial end?")
        if self.best not in get_args(Best):
            raise InvalidInputError(
                f"best={self.best!r} must be one of {', '.join(get_args(Best))}"
            )
        for name in ("for_s", "timeout_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InvalidInputError(f"{name}={value} must be a number of seconds above 0")
        if not (self.parameters and 1 <= self.repeats * len(self.parameters) <= MOST_TRIALS):
            raise InvalidInputError(f"there must be 1 to {MOST_TRIALS} trials")

    @property
    def text(self) -> str:
        """All of it, always written alike: by it a set is found again."""
        return json.dumps(asdict(self), sort_keys=True, ensure_ascii=False)

    @property
    def trials(self) -> list[dict[str, Any]]:
        """The parameters of each trial; all sets come once before any is repeated."""
        once = self.parameters[:1] if self.repeats == 1 else []
        return [*(each for _ in range(self.repeats) for each in self.parameters), *once]


def read_plan(file: Path) -> Plan:
    """Read a plan.

    Raises:
        InvalidInputError: It is no TOML, or says something that is not possible; the text names it.
        OSError: It cannot be read.
    """
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        found = cast("dict[str, Any]", toml.loads(file.read_text("utf-8")))
    except ValueError as error:  # also what is not UTF-8
        raise InvalidInputError(f"{file} is no TOML: {error}") from error
    try:
        return _plan_of(found, file.resolve().parent)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file}: {error}") from error


def _plan_of(found: dict[str, Any], folder: Path) -> Plan:
    kinds = {each.name: _KINDS[each.name] for each in fields(Plan)} | {_GRID: dict}
    for name, value in found.items():
        if name not in kinds:
            raise InvalidInputError(f"unknown {name!r}; there is {', '.join(_near(name, kinds))}")
        if not isinstance(value, kinds[name]) or isinstance(value, bool):
            raise InvalidInputError(f"{name}={value!r} is a {type(value).__name__}")
    if _GRID in found and "parameters" in found:
        raise InvalidInputError("give [grid] or [[parameters]], not both")
    if _GRID in found:
        found = found | {"parameters": _combinations(found[_GRID])}
    found = {name: value for name, value in found.items() if name != _GRID}
    for name in _REQUIRED:
        if name not in found:
            raise InvalidInputError(f"{name} is missing" + _HINTS.get(name, ""))
    parameters = cast("list[Any]", found["parameters"])
    _require_tables(parameters)
    found["world"] = str((folder / found["world"]).resolve())
    return Plan(**found)


def _near(name: str, known: Any) -> list[str]:
    return nearest_first(name, list(known))[:3]


def _combinations(grid: dict[str, Any]) -> list[dict[str, Any]]:
    for name, values in grid.items():
        if not isinstance(values, list) or not values:
            raise InvalidInputError(f"[grid] {name} must be an array of values, such as [1.0, 2.0]")
    return [dict(zip(grid, each, strict=True)) for each in itertools.product(*grid.values())]


def _require_tables(parameters: list[Any]) -> None:
    for each in parameters:
        if not isinstance(each, dict):
            raise InvalidInputError(f"parameters: {each!r} must be a table, as in [[parameters]]")
        for name, value in cast("dict[str, Any]", each).items():
            if not isinstance(value, (int, float, str)) or value in (math.inf, -math.inf):
                raise InvalidInputError(f"{name}={value!r} must be a number, a flag or a text")
    if len({repr(each) for each in parameters}) < len(parameters):
        raise InvalidInputError("the same parameters are given twice: use repeats")


_KINDS: Final[dict[str, Any]] = {
    "world": str, "score": str, "parameters": list, "best": str, "for_s": (int, float),
    "until": str, "repeats": int, "robot": str, "timeout_s": (int, float),
}  # fmt: skip
_HINTS: Final = {"parameters": ": give a [grid], as in speed = [2.0, 4.0], or [[parameters]]"}
