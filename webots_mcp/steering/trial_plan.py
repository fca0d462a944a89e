"""Reads a plan of trials: which parameters to try, for how long, and how to score a run."""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal, cast, get_args

from webots_mcp.analysis.summary import Best
from webots_mcp.contract import PARAMETERS_VARIABLE, RESTORED_VARIABLE
from webots_mcp.errors import InvalidInputError
from webots_mcp.signals.conditions import parse_condition
from webots_mcp.signals.conditions.scoring import parse_score
from webots_mcp.signals.naming import harmless_first

Search = Literal["tpe", "random"]
MOST_TRIALS: Final = 10_000
_GRID: Final = "grid"
_NUMBER: Final = (int, float)
_RANGE_KINDS: Final[dict[str, Any]] = {
    "low": _NUMBER, "high": _NUMBER, "step": _NUMBER, "log": bool, "choices": list,
}  # fmt: skip
_KINDS: Final[dict[str, Any]] = {
    "world": str, "score": str, "parameters": list, "best": str, "for_s": (int, float),
    "until": str, "repeats": int, "robot": str, "timeout_s": (int, float), "prune": str,
    "ranges": dict, "sets": int, "seed": int, _GRID: dict,
}  # fmt: skip
_WRITTEN: Final = {_GRID: "[grid]", "parameters": "[[parameters]]", "ranges": "[ranges]"}


@dataclass(frozen=True)
class ParameterRange:
    """The values that may be tried of one parameter: the numbers of a range, or some choices.

    Attributes:
        low: The minimum.
        high: The maximum.
        step: Distance between the numbers to try; if both `low` and `step` are whole, only whole
            numbers are tried.
        log: Whether numbers are spread evenly over orders of magnitude.
        choices: The values, in place of a range.
    """

    low: float | None = None
    high: float | None = None
    step: float | None = None
    log: bool = False
    choices: list[Any] | None = None

    def __post_init__(self) -> None:
        if self.choices is not None:
            return self._require_choices()
        if self.low is None or self.high is None:
            raise InvalidInputError("it needs low and high, or choices")
        if not -math.inf < self.low < self.high < math.inf:
            raise InvalidInputError(f"low={self.low} must be less than high={self.high}")
        if self.log and self.low <= 0:
            raise InvalidInputError(f"low={self.low} must be above 0 with log = true")
        if self.step is not None:
            self._require_steps(self.low, self.high, self.step)

    @property
    def is_whole(self) -> bool:
        """Whether only whole numbers are tried."""
        return isinstance(self.low, int) and isinstance(self.step, int)

    def _require_choices(self) -> None:
        if (self.low, self.high, self.step, self.log) != (None, None, None, False):
            raise InvalidInputError("choices stand alone, without low, high, step and log")
        choices = self.choices
        if not choices or not all(isinstance(each, (int, float, str)) for each in choices):
            raise InvalidInputError("choices must be an array of numbers, flags or texts")
        if len({repr(each) for each in choices}) < len(choices):
            raise InvalidInputError("the same choice is given twice: remove one")

    def _require_steps(self, low: float, high: float, step: float) -> None:
        if not 0 < step < math.inf:
            raise InvalidInputError(f"step={step} must be a number above 0")
        if self.log and not (self.is_whole and step == 1):
            raise InvalidInputError("log and step go together only as whole numbers with step = 1")
        steps = round((high - low) / step)
        if steps < 1 or not math.isclose(low + steps * step, high, rel_tol=1e-9):
            raise InvalidInputError(f"high={high} must be a number of steps={step} above low={low}")


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """A plan of trials, independent of where they run.

    Attributes:
        score: The expression that scores a run, see 'webots-mcp help trials'.
        parameters: The parameter sets to try; empty if they are searched for.
        best: Whether the highest or the lowest score is the best.
        for_s: Simulated seconds after which a trial ends.
        until: Condition at which a trial ends, if it holds before `for_s` is over.
        prune: Condition at which a trial ends early, without a score.
        repeats: How often to try each set.
        robot: The robot whose signals, events and parameters to use, if a world has several.
        timeout_s: Wall time after which a trial has failed, in seconds.
        ranges: The values to search, by parameter.
        search: The sampler of Optuna that proposes sets.
        sets: The number of sets to search for.
        seed: Seed of the sampler: with the same seed and trials it proposes the same set.
    """

    score: str
    parameters: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    best: Best = "highest"
    for_s: float | None = None
    until: str | None = None
    repeats: int = 1
    robot: str | None = None
    timeout_s: float = 300.0
    prune: str | None = None
    ranges: dict[str, ParameterRange] = field(default_factory=dict[str, ParameterRange])
    search: Search | None = None
    sets: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        parse_score(self.score)
        for condition in (self.until, self.prune):
            if condition is not None:
                parse_condition(condition)
        if self.for_s is None and self.until is None:
            raise InvalidInputError("It is not said when a trial ends. Give for_s, until or both.")
        if self.best not in get_args(Best):
            raise InvalidInputError(
                f"best={self.best!r} must be one of {', '.join(get_args(Best))}"
            )
        for name in ("for_s", "timeout_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise InvalidInputError(f"{name}={value} must be a number of seconds above 0")
        if self.search or self.ranges or self.sets or self.seed:
            self._require_searchable()
        _require_tables(self.parameters)
        if not 1 <= self.trial_count <= MOST_TRIALS:
            raise InvalidInputError(f"there must be 1 to {MOST_TRIALS} trials")

    def _require_searchable(self) -> None:
        if self.search not in get_args(Search):
            known = ", ".join(get_args(Search))
            raise InvalidInputError(
                f"[ranges], sets and seed are for a search: --search takes {known}"
            )
        if not self.ranges or self.parameters:
            raise InvalidInputError(
                "--search takes [ranges], as in speed = { low = 0.5, high = 10.0 }, and neither "
                "[grid] nor [[parameters]]"
            )
        if self.sets < 1:
            raise InvalidInputError(
                "sets is missing. Give the number of sets to try, such as sets = 40."
            )
        if not 0 <= self.seed < (2**63):
            raise InvalidInputError(f"seed={self.seed} must be 0 or more, and less than 2**63")

    @property
    def text(self) -> str:
        """The plan as JSON, always in the same form: it identifies a trial set."""
        plain = asdict(self) | {"ranges": _as_plain(self.ranges)}
        return json.dumps(plain, sort_keys=True, ensure_ascii=False)

    @property
    def trials(self) -> list[dict[str, Any]]:
        """The parameters of each trial that is known from the start.

        All sets come once before any is repeated.
        """
        return [each for _ in range(self.repeats) for each in self.parameters]

    @property
    def trial_count(self) -> int:
        """The total number of trials."""
        return (self.sets or len(self.parameters)) * self.repeats


@dataclass(frozen=True, kw_only=True)
class WorldPlan(TrialPlan):
    """A plan whose trials each run in a simulator of their own.

    Attributes:
        world: The world file, with its full path.
    """

    world: str

    def __post_init__(self) -> None:
        if not Path(self.world).is_file():
            raise InvalidInputError(f"world: no file {self.world}. Give the path of a .wbt file.")
        super().__post_init__()

    @property
    def own_world(self) -> str:
        """The world file of the project, about which its rules are."""
        return self.world

    def environment(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return the variables with which the controllers of a trial begin with these values."""
        given = {self.robot: values} if self.robot else values
        return {PARAMETERS_VARIABLE: json.dumps(given)}


@dataclass(frozen=True)
class BranchMoment:
    """The moment of a run at which branches begin.

    Attributes:
        run: UUID of the run.
        sim_time_s: Its simulation time.
        world: The world file of the run.
        parameters: The values of the parameters of each robot of the simulation.
    """

    run: str
    sim_time_s: float
    world: str
    parameters: dict[str, dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class BranchPlan(WorldPlan):
    """A plan whose trials continue from a moment of a run. The first changes no parameter.

    Attributes:
        moment: That moment.
        states: File with the states of the robots at that moment.
    """

    moment: BranchMoment
    states: str

    @property
    def own_world(self) -> str:
        """The world file of the run that is continued."""
        return self.moment.world

    def environment(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return the variables with which controllers continue, with some values changed."""
        given = dict(self.moment.parameters)
        if self.robot is not None:
            given[self.robot] = {**given.get(self.robot, {}), **values}
        return {PARAMETERS_VARIABLE: json.dumps(given), RESTORED_VARIABLE: self.states}


def read_plan(file: Path, search: Search | None = None) -> WorldPlan:
    """Read a plan, for a search or without one.

    Raises:
        InvalidInputError: If it cannot be read, is not TOML, or asks for something impossible; the
            text names it.
    """
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        found = cast("dict[str, Any]", toml.loads(file.read_text("utf-8")))
    except ValueError as error:  # also what is not UTF-8
        raise InvalidInputError(f"{file} is not valid TOML: {error}.") from error
    except OSError as error:
        raise InvalidInputError(f"the plan {file} cannot be read: {error.strerror}") from error
    try:
        return _plan_of(found, file.resolve().parent, search)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file}: {error}") from error


def stored_plan(text: str) -> TrialPlan:
    """Return what the text of a plan says whose trials run in a robot's simulation."""
    return TrialPlan(**json.loads(text))


def _plan_of(found: dict[str, Any], folder: Path, search: Search | None) -> WorldPlan:
    _require_kinds(found, _KINDS)
    if len(given := [_WRITTEN[name] for name in _WRITTEN if name in found]) != 1:
        raise InvalidInputError(
            "give a [grid], as in speed = [2.0, 4.0], [[parameters]], or [ranges] to search"
            + (f", not {' and '.join(given)}" if given else "")
        )
    if _GRID in found:
        found = found | {"parameters": combinations(found[_GRID], "[grid] ")}
    found = {name: value for name, value in found.items() if name != _GRID}
    for name in ("world", "score"):
        if name not in found:
            raise InvalidInputError(f"{name} is missing")
    if "ranges" in found:
        found["ranges"] = _read_ranges(found["ranges"])
    found["world"] = str((folder / found["world"]).resolve())
    return WorldPlan(**found, search=search)


def combinations(grid: dict[str, Any], where: str = "") -> list[dict[str, Any]]:
    """Return every combination of the values of a grid.

    Args:
        grid: Lists of values by parameter.
        where: The place of the grid, as an error names it.

    Raises:
        InvalidInputError: If a parameter has no list of values, or there are too many combinations.
    """
    for name, values in grid.items():
        if not isinstance(values, list) or not values:
            raise InvalidInputError(f"{where}{name} must be a list of values, such as [1.0, 2.0]")
    if math.prod(len(values) for values in grid.values()) > MOST_TRIALS:
        raise InvalidInputError(
            f"The grid has more than {MOST_TRIALS} combinations. Give fewer values."
        )
    return [dict(zip(grid, each, strict=True)) for each in itertools.product(*grid.values())]


def _require_tables(parameters: list[Any]) -> None:
    for each in parameters:
        if not isinstance(each, dict):
            raise InvalidInputError(f"parameters: {each!r} must be a table, as in [[parameters]]")
        for name, value in cast("dict[str, Any]", each).items():
            if not isinstance(value, (int, float, str)) or value in (math.inf, -math.inf):
                raise InvalidInputError(f"{name}={value!r} must be a number, a flag or a text")
    if len({repr(each) for each in parameters}) < len(parameters):
        raise InvalidInputError("The same parameters are given twice. To repeat them, use repeats.")


def _read_ranges(tables: dict[str, Any]) -> dict[str, ParameterRange]:
    """Return the ranges of `[ranges]` in a plan.

    Raises:
        InvalidInputError: One is none; the text names it.
    """
    if not tables:
        raise InvalidInputError("[ranges] names no parameter")
    return {name: _range_of(name, table) for name, table in tables.items()}


def _range_of(name: str, table: Any) -> ParameterRange:
    try:
        if not isinstance(table, dict):
            raise InvalidInputError("write { low = 0.5, high = 10.0 } or { choices = [...] }")
        found = cast("dict[str, Any]", table)
        _require_kinds(found, _RANGE_KINDS)
        return ParameterRange(**found)
    except InvalidInputError as error:
        raise InvalidInputError(f"[ranges] {name}: {error}") from error


def _require_kinds(table: dict[str, Any], kinds: Mapping[str, Any]) -> None:
    """Refuse a table of a plan with an unknown key, or with a value of the wrong type.

    Raises:
        InvalidInputError: If there is one.
    """
    for key, value in table.items():
        if key not in kinds:
            near = ", ".join(harmless_first(key, list(kinds))[:3])
            raise InvalidInputError(f"Unknown key {key!r}. Keys, the nearest first: {near}.")
        if not isinstance(value, kinds[key]) or (
            isinstance(value, bool) and kinds[key] is not bool
        ):
            raise InvalidInputError(f"{key}={value!r} is a {type(value).__name__}")


def _as_plain(ranges: dict[str, ParameterRange]) -> dict[str, Any]:
    """Return ranges as JSON values, without those that are not given."""
    return {
        name: {key: value for key, value in asdict(each).items() if value not in (None, False)}
        for name, each in ranges.items()
    }
