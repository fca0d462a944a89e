"""Compares what two versions of a controller command, round by round.

A setting of an actuator holds until it is set again. So a version that sets it only when it
changes commands the same as one that sets it in each round: what holds at the end of a round is
compared. Of other commands, such as a packet that is sent, each counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, cast

from webots_mcp.database.tapes.tape import TapedPlace

MOST_SHOWN: Final = 8
HELD: Final = "held"  # the note of what motors and LEDs were set to, on a tape made of rows
_HOLDING: Final = frozenset({"Motor", "LED", "Brake", "Pen", "VacuumGripper", "Connector", "Skin"})
_SENSORS_HOLD: Final = ("enable", "disable")
_OPPOSITES: Final = {
    "disable": ("enable", [0]), "turnOn": ("turnOn", [1]), "turnOff": ("turnOn", [0]),
    "lock": ("lock", [1]), "unlock": ("lock", [0]),
    ".sampling_period": ("enable", None), ".target_position": ("setPosition", None),
    ".target_velocity": ("setVelocity", None), ".available_force": ("setAvailableForce", None),
    ".available_torque": ("setAvailableTorque", None),
    ".target_acceleration": ("setAcceleration", None),
}  # fmt: skip
_CONTROL: Final = "control"  # by which of these a motor is driven: the last one that was set
_CONTROLS: Final = {"setPosition": "position", "setForce": "force", "setTorque": "torque"}


class GivenCommand(NamedTuple):
    """A command to a device, the robot or the scene, as a tape has it."""

    path: str
    owner: str
    name: str
    arguments: list[Any]
    place: TapedPlace | None


Commands = dict[tuple[str, str], GivenCommand]


class CommandDifference(NamedTuple):
    """What the new version commanded instead of the old one; None where it commanded nothing."""

    command: str
    old: list[Any] | None
    new: list[Any] | None
    old_place: TapedPlace | None
    new_place: TapedPlace | None

    def __str__(self) -> str:
        return f"{self.command} {_shown(self.new)} instead of {_shown(self.old)}"


def _shown(arguments: list[Any] | None) -> str:
    if arguments is None:
        return "nothing"
    return ", ".join(_short(each) for each in arguments) or "a call"


def _short(value: Any) -> str:
    if isinstance(value, dict):
        value = next(iter(cast("dict[str, Any]", value).values()))
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


@dataclass
class Commanded:
    """What a controller has commanded: settings that hold, and the other commands of this round."""

    holding: dict[tuple[str, str], GivenCommand] = field(
        default_factory=dict[tuple[str, str], GivenCommand]
    )
    once: dict[tuple[str, str], GivenCommand] = field(
        default_factory=dict[tuple[str, str], GivenCommand]
    )

    def begin_round(self) -> None:
        """Forget the commands that were given once."""
        self.once = {}

    def add(self, command: GivenCommand) -> None:
        """Add a command in its order."""
        name, arguments = command.name, command.arguments
        if name in _OPPOSITES:
            name, fixed = _OPPOSITES[name]
            arguments = arguments if fixed is None else fixed
        command = command._replace(name=name, arguments=arguments)
        key = (command.path, name)
        if command.owner in _HOLDING or name in _SENSORS_HOLD or name.endswith("Period"):
            self.holding[key] = command
            if command.owner == "Motor" and name in _CONTROLS:
                control = command._replace(name=_CONTROL, arguments=[_CONTROLS[name]])
                self.holding[command.path, _CONTROL] = control
            return
        same = (of for path, of in self.once if path == command.path)
        number = sum(1 for of in same if of.rpartition(" ")[0] == name)
        self.once[command.path, f"{name} {number}"] = command


def differences(old: Commanded, new: Commanded) -> list[CommandDifference]:
    """Return how the commands of a round differ; empty where they are equal."""
    found: list[CommandDifference] = []
    for before, after in ((old.holding, new.holding), (old.once, new.once)):
        for key in dict.fromkeys([*before, *after]):
            one, other = before.get(key), after.get(key)
            if one is not None and other is not None and _equal(one.arguments, other.arguments):
                continue
            known = one or other
            # A sensor that only one of them enables moves nothing.
            may_be_missing = key[1] == _CONTROL or key[1] in _SENSORS_HOLD
            is_implied = may_be_missing and (one is None or other is None)
            if known is None or is_implied or len(found) == MOST_SHOWN:
                continue
            place = (one.place if one else None, other.place if other else None)
            found.append(
                CommandDifference(
                    _name_of(known),
                    one.arguments if one else None,
                    other.arguments if other else None,
                    *place,
                )
            )
    return found or _differing_order(old, new)


def _differing_order(old: Commanded, new: Commanded) -> list[CommandDifference]:
    """Return the first object whose commands came in another order."""
    for path in dict.fromkeys(path for path, _ in old.once):
        before, after = (
            [each for (of, _), each in both.once.items() if of == path] for both in (old, new)
        )
        for one, other in zip(before, after, strict=True):
            if one.name != other.name:
                shown = f"{path.removeprefix('device:')} in this order:"
                old_names = [each.name for each in before[:MOST_SHOWN]]
                new_names = [each.name for each in after[:MOST_SHOWN]]
                return [CommandDifference(shown, old_names, new_names, one.place, other.place)]
    return []


def _name_of(command: GivenCommand) -> str:
    return f"{command.path.removeprefix('device:')}.{command.name.removeprefix('.')}"


def _equal(one: Any, other: Any) -> bool:
    """Return whether values are equal to the last digit; NaN equals NaN."""
    if isinstance(one, list) and isinstance(other, list):
        pair = cast("list[Any]", one), cast("list[Any]", other)
        return len(pair[0]) == len(pair[1]) and all(map(_equal, *pair))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return one == other


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


# -- a tape that was made of rows ------------------------------------------------------------------


class HeldByRows:
    """What motors and LEDs were set to when a row was recorded, against what the code sets.

    A row that the bridge recorded has what holds at the end of a round. One that the controller
    published in the middle of a round has any value of that round.
    """

    def __init__(self) -> None:
        self._expected: list[tuple[tuple[str, str], Any]] = []
        self._is_published = False
        self._at_first: dict[tuple[str, str], Any] = {}
        self._in_round: dict[tuple[str, str], list[GivenCommand]] = {}
        self._before: dict[tuple[str, str], list[GivenCommand]] = {}

    def expect(self, held: list[Any], is_published: bool) -> None:
        """Take what a row of this round has: path, setter and value of each."""
        self._expected = [((path, setter), value) for path, setter, value in held]
        self._is_published = is_published

    def commanded(self, command: GivenCommand) -> None:
        """Note a command of this round."""
        self._in_round.setdefault((command.path, command.name), []).append(command)

    def compare(self, new: Commanded) -> list[CommandDifference]:
        """Return how the row of this round differs from what the code has set."""
        found: list[CommandDifference] = []
        for key, value in self._expected:
            is_known = key in self._at_first
            at_first = self._at_first.setdefault(key, value)
            command = new.holding.get(key)
            if command is None:  # never set by the code: as the world's file says
                if is_known and not _equal(at_first, value):
                    named = f"{key[0].removeprefix('device:')}.{key[1]}"
                    found.append(CommandDifference(named, [value], None, None, None))
                continue
            if command.arguments and _is_nan(command.arguments[0]):
                continue  # Webots refuses it: what held before is not known here
            allowed = [command, *(self._in_round.get(key, ()) if self._is_published else ())]
            if self._is_published:
                allowed += self._before.get(key, ())
            if not any(_equal(each.arguments[:1], [value]) for each in allowed):
                given = (_name_of(command), [value], command.arguments, None, command.place)
                found.append(CommandDifference(*given))
        self._before = {key: [each] for key, each in new.holding.items()}
        self._expected, self._in_round = [], {}
        return found[:MOST_SHOWN]
