"""Answers a controller from a tape, round by round, and compares what it commands with the old run.

Nothing is simulated. What happens after the first difference is unknown, so the replay ends there.
"""

from __future__ import annotations

import builtins
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn, cast

from webots_mcp.database.tapes.source_files import relative_source
from webots_mcp.database.tapes.tape import NOTES, Tape, TapedCall, TapedPlace, TapedRound
from webots_mcp.database.tapes.tape_values import UnrecordedValueError, decode_value, encode_value
from webots_mcp.rerun.difference import (
    HELD,
    CommandDifference,
    Commanded,
    GivenCommand,
    HeldByRows,
    differences,
)

Key = tuple[str, str, str]
Stated = tuple[Key, int]
"""A question, and the number of packets that were passed over before it in the round."""

_CALLS_AFTER_END: Final = 1000  # of `step`, by a loop that does not end when it returns -1
_CONSTANT: Final = (
    "getName", "getModel", "getNodeType", "getType", "getMin", "getMax", "getWidth", "getHeight",
    "getFov", "getNear", "getLookupTable", "getAperture", "getHorizontalResolution", "getNumberOf",
    "getBasicTimeStep", "getDevice", "getFromDef", "getFromDevice", "getSelf", "getRoot",
    "getField", "getProto", "getProjectPath", "getWorldPath", "getSupervisor",
    "getSynchronization", "getMode",
    "getCoordinateSystem", "getFrequency", "getMultiplier", "getPositionSensor", "getMotor",
    "getBrake", "getKeyboard", "getMouse", "getJoystick", "getDef", "getId", "getTypeName", "has",
    "getUrdf",
)  # fmt: skip
_NOT_CONSTANT: Final = ("getNumberOfContactPoints",)
_CONSUMES: Final = "nextPacket"  # after which a receiver answers about another packet
_TAKEN_ONCE: Final = ("getKey", "getKeyCode", "getPressedButton", "wwiReceiveText")  # from a queue
_NONE_LEFT: Final = (-1, None, "")  # what these answer when it is empty
_HELD: Final = {  # what Webots' library answers from the commands that it was given
    "getTargetPosition": "setPosition", ".target_position": "setPosition",
    "getVelocity": "setVelocity", ".target_velocity": "setVelocity",
    "getAcceleration": "setAcceleration", "getSamplingPeriod": "enable",
    ".sampling_period": "enable", "get": "set", ".value": "set",
}  # fmt: skip
_OF_DEVICES: Final = ("sensors", "motors", "actuators", "battery_j")  # keys of a row
_SENSED: Final = ("getValue", "getValues", "getRollPitchYaw")
_OF_BRIDGE: Final[Mapping[str, Any]] = {  # where nothing is known; a replay has no supervisor
    "getSupervisor": False, "getSynchronization": True, "getModel": "", "getCustomData": "",
    "getWorldPath": "", "getProjectPath": "", "getMode": 0, "simulationGetMode": 2, "getType": 0,
    "getMultiplier": 1.0, "getCoordinateSystem": 0, "getNumberOfDevices": 0,
}  # fmt: skip


class ReplayEndedError(BaseException):
    """The replay is over. No `except Exception` of a controller catches it."""


class ReplayedTape:
    """A tape as the devices of a replay ask it.

    Args:
        tape: The tape.
        run: The run of its session that is replayed to its end, from 0.
        until_s: Simulation time in that run at which the replay ends.
        goes_on: Whether it goes on after the first difference, as for a debugger.

    Attributes:
        rounds: Those that were compared.
        time_s: Simulation time, as of the last step.
        run: The run that the replay has come to, from 0.
        first: The differences in the first round that has any.
        unrecorded: What was asked and is not on the tape; it ended the replay.
        why_ended: Why no step follows; None before the end.
        root: The folder of the project that is replayed.
        classes: Of the replayed packages, by name.
        named: Paths of the devices that were made by their names.
        unnamed: Number of objects without a name that were made, by class.
        threads: Names of other threads that called Webots' package in the old run.
        on_round: Called with the number of each round before it begins.
        given: Of each command of the replayed code: round, path, class, name, arguments and place.
            None where they are not needed.
    """

    def __init__(
        self,
        tape: Tape,
        *,
        run: int = 0,
        until_s: float | None = None,
        goes_on: bool = False,
        root: str = "",
    ) -> None:
        self.tape = tape
        self.root = Path(root)
        self._last_run = run
        self._until_s = until_s
        self._goes_on = goes_on
        self._coming: Iterator[TapedRound] = tape.rounds()
        self._round: TapedRound | None = None
        self._answers: dict[Stated, list[Any]] = {}
        self._used: dict[Stated, int] = {}
        self._passed_over: Counter[str] = Counter()  # packets, by path, by the replayed code
        self._seen: dict[Key, Any] = {}
        self._latest: dict[Key, Any] = {}
        self._replies: dict[tuple[str, str], list[Any]] = {}
        self._commands: list[tuple[str, dict[str, Any]]] = []
        self._parameters: dict[str, Any] = {}
        self._old, self._new = Commanded(), Commanded()
        self._objects: dict[str, Any] = {}
        self._calls_after_end = 0
        self.classes: dict[str, type[Any]] = {}
        self.unnamed: Counter[str] = Counter()
        self.named: set[str] = set()
        self.rounds = 0
        self.time_s = float(tape.head.get("began_s", 0.0))
        self.run = 0
        self.first: list[CommandDifference] = []
        self.unrecorded: str | None = None
        self.why_ended: str | None = None
        self.threads: list[str] = []
        self.on_round: Callable[[int], None] | None = None
        self.given: list[list[Any]] | None = None
        self._rows = HeldByRows() if tape.head.get("rests_on_rows") is True else None
        self._load()

    # -- rounds ----------------------------------------------------------------------------------

    def _load(self) -> None:
        """Read what was asked and commanded up to the next step."""
        self._answers, self._used, self._seen, self._replies = {}, {}, {}, {}
        self._passed_over.clear()
        passed_over: Counter[str] = Counter()
        self._old.begin_round()
        self._new.begin_round()
        self._round = next(self._coming, None)
        if self._round is None:
            return
        events = self._round.events
        for number, value in zip(events[::2], events[1::2], strict=False):
            if number == NOTES:
                self._take_note(*value)
            else:
                self._take(self.tape.calls[number], value, passed_over)

    def _take_note(self, kind: str, content: Any) -> None:
        if kind == "command":
            self._commands.append((content[0], content[1]))
        elif kind == "parameters":
            self._parameters |= content
        elif kind == "thread":
            self.threads.append(content)
        elif kind == HELD and self._rows is not None:
            self._rows.expect(*content)

    def _take(self, call: TapedCall, value: Any, passed_over: Counter[str]) -> None:
        if call.kind == "command":
            arguments, place, *reply = value
            known = self.tape.places.get(place)
            passed_over[call.path] += call.name == _CONSUMES
            self._old.add(GivenCommand(call.path, call.owner, call.name, arguments, known))
            if reply:
                self._replies.setdefault((call.path, call.name), []).append(reply[0])
            return
        key = (call.path, call.name, json.dumps(call.arguments) if call.arguments else "[]")
        self._latest[key] = value
        if call.kind == "seen":
            self._seen[key] = value
        else:
            self._answers.setdefault((key, passed_over[call.path]), []).append(value)

    def step(self, name: str, arguments: Sequence[Any]) -> Any:
        """Compare the round that ends here, and return what the step answered in the old run."""
        if self.why_ended is not None:
            return self._step_after_end()
        over = self._round
        given = self._step_arguments(arguments)
        if self._rows is not None:
            self._require_rows_of(name, given)
        if over is None or not over.step[0]:  # the old code had ended
            return self._end("the old code ended")
        held = self._step_arguments(over.step[1])
        if (over.step[0], held) != (name, given):
            before = held if over.step[0] == name else None
            self.first = [CommandDifference(f"robot.{name}", before, given, None, None)]
        self._compare()
        self.rounds += 1
        if over.end_s < self.time_s - 1e-9:
            self.run += 1
        self.time_s = over.end_s
        self._load()
        answer = over.step[2]
        if self.run > self._last_run:
            return self._end("the run ended")
        if answer == -1:
            return self._end("the old run ended")
        is_until = self._until_s is not None and self.run == self._last_run
        if is_until and self.time_s >= (self._until_s or 0.0) - 1e-9:
            return self._end("until")
        if self._round is None and self.tape.end != "finished":
            return self._end("the tape ended")
        if self.on_round is not None:
            self.on_round(self.rounds)
        return answer

    def _require_rows_of(self, name: str, given: list[Any]) -> None:
        """End the replay at a step of which the rows do not tell how it was called."""
        basic_ms = float(self._fact("robot", "getBasicTimeStep"))
        is_whole = name == "step" and len(given) == 1 and type(given[0]) in (int, float)
        if not is_whole or given[0] <= 0 or (basic_ms and given[0] % basic_ms):
            called = f"robot.{name}({', '.join(map(str, given))})"
            self.end_unrecorded(
                f"{called} is not in the recorded rows, which have whole steps of "
                f"{basic_ms:g} ms; a tape has it"
            )

    def _step_arguments(self, arguments: Sequence[Any]) -> list[Any]:
        """Return the arguments of a step, which is the basic one where none is given."""
        return list(arguments) or [int(self._fact("robot", "getBasicTimeStep"))]

    def step_never_comes(self) -> None:
        """Note that the controller has ended while the old run went on."""
        is_last = self._round is None or not self._round.step[0]
        self._end("the old run ended" if is_last else "ended early")

    def finish(self) -> None:
        """Compare what was commanded after the last step, when the controller has ended."""
        is_last = self._round is not None and not self._round.step[0]
        if is_last and self.why_ended == "the old run ended" and not self.first and not self._rows:
            self.first = differences(self._old, self._new)

    def _compare(self) -> None:
        if self.rounds == 0 and self.tape.head.get("began_late"):
            self._old.holding = self._new.holding | self._old.holding
            self._old.once = self._new.once
        if self._rows is not None:
            self.first = self.first or self._rows.compare(self._new)
        elif not self.first:
            self.first = differences(self._old, self._new)
        if self.first and not self._goes_on:
            self._end("difference")
            raise ReplayEndedError

    def _end(self, why: str) -> int:
        self.why_ended = why
        return -1

    def _step_after_end(self) -> int:
        self._calls_after_end += 1
        if self._calls_after_end > _CALLS_AFTER_END:
            raise ReplayEndedError
        return -1

    # -- notes for the bridge --------------------------------------------------------------------

    def command_due(self) -> tuple[str, dict[str, Any]] | None:
        """Return the next command that the old run got in this round."""
        return self._commands.pop(0) if self._commands else None

    def parameters_due(self) -> dict[str, Any]:
        """Return the parameters that were set in this round of the old run."""
        due, self._parameters = self._parameters, {}
        return due

    def bridge_begins(self) -> None:
        """End the replay where the recorded code has made steps before, of which no row tells."""
        if self._rows is not None and self.rounds:
            count = f"{self.rounds} step" + "s" * (self.rounds > 1)
            what = f"the code makes {count} before its MCPBridge"
            self.end_unrecorded(f"{what}, which no row has; a tape has it")

    def publishes(self, state: Mapping[Any, Any]) -> None:
        """End the replay where the recorded code names values of its own as the devices' are."""
        own = [each for each in _OF_DEVICES if each in state] if self._rows is not None else []
        if own:
            named = ", ".join(map(repr, own))
            self.end_unrecorded(
                f"the code itself publishes {named}, so the rows may have its values and not "
                "those of the devices; a tape has these"
            )

    # -- answers ---------------------------------------------------------------------------------

    def ask(
        self, path: str, owner: str, name: str, arguments: Sequence[Any], *, is_own: bool
    ) -> Any:
        """Return the answer of the old run in this round.

        Raises:
            ReplayEndedError: The old run did not ask this.
            LookupError: The bridge asked, and the tape does not know.
        """
        coded = [self._encode(each) for each in arguments]
        key = (path, name, json.dumps(coded) if coded else "[]")
        found = self._recorded(key, is_own=is_own)
        if not is_own and found is not None and self._is_not_enabled(path, name):
            device = path.removeprefix("device:")
            self._miss(f"{device} is not enabled any more, so the answer of {name}() is unknown")
            raise ReplayEndedError
        if found is None:
            found = self._derived(key, owner, name, arguments, is_own=is_own)
        if found is None and is_own:  # the bridge counts it as a failure and goes on
            raise LookupError(f"a replay does not know {path}.{name}()")
        if found is None:
            shown = f"{path.removeprefix('device:')}.{name}({', '.join(map(repr, arguments))})"
            why = "was not asked in this round of the old run"
            if self.tape.head.get("rests_on_rows"):
                why = "is not in the recorded rows; a tape has it"
            self._miss(f"{shown.replace('..', '.')} {why}")
            raise ReplayEndedError
        (value,) = found
        if isinstance(value, dict) and "$raised" in value:
            raised = cast("dict[str, str]", value)
            kind: Any = getattr(builtins, raised["$raised"], RuntimeError)
            raise kind(raised["text"])
        try:
            return decode_value(value, self.make)
        except UnrecordedValueError as error:
            self._miss(f"{path.removeprefix('device:')}.{name}(): {error}")
            raise ReplayEndedError from error

    def _is_not_enabled(self, path: str, name: str) -> bool:
        """Return whether the old code enabled a sensor, and neither the new one nor the bridge."""
        enable = (path, "enable")
        if enable not in self._old.holding or enable in self._new.holding:
            return False
        return path not in self.named and not name.startswith(_CONSTANT)

    def end_unrecorded(self, what: str) -> NoReturn:
        """End the replay, because the tape does not say what the code would have heard."""
        self._miss(what)
        raise ReplayEndedError

    def _miss(self, what: str) -> None:
        if self.unrecorded is None:
            self.unrecorded = what
        self._end("unrecorded")

    def _recorded(self, key: Key, *, is_own: bool) -> tuple[Any] | None:
        stated = (key, self._passed_over[key[0]])
        answers = self._answers.get(stated)
        if is_own and key in self._seen:
            return (self._seen[key],)
        if answers is not None:
            number = self._used.get(stated, 0)
            if not is_own:
                self._used[stated] = number + 1
            if number >= len(answers) and key[1] in _TAKEN_ONCE and answers[-1] not in _NONE_LEFT:
                return None
            return (answers[min(number, len(answers) - 1)],)
        return (self._seen[key],) if key in self._seen else None

    def _derived(
        self, key: Key, owner: str, name: str, arguments: Sequence[Any], *, is_own: bool
    ) -> tuple[Any] | None:
        """Return what follows from the head of the tape, from commands or from earlier answers."""
        path, head = key[0], self.tape.head
        if name == "getTime":
            return (self.time_s,)
        if name == "getDevice" and arguments:
            device: str | None = head["devices"].get(arguments[0])
            return (device and {"$object": f"device:{arguments[0]}", "class": device},)
        if name == "getDeviceByIndex" and arguments and isinstance(arguments[0], int):
            names = list(head["devices"])
            if arguments[0] < len(names):
                return self._derived(key, owner, "getDevice", [names[arguments[0]]], is_own=is_own)
        if name == "getName" and path.startswith("device:"):
            return (path.removeprefix("device:"),)
        if name == "getSupervisor" and is_own:
            return (False,)
        if name == "getName" and is_own and "recorded_as" in head:
            return (head["recorded_as"],)
        if name == ".value":
            for sensed in _SENSED:
                if (found := self._recorded((path, sensed, "[]"), is_own=True)) is not None:
                    return found
        held = self._held(path, name, is_own=is_own)
        if held is not None:
            return held
        fact = head["facts"].get(path, {})
        if name in fact:
            return (fact[name],)
        if key in self._latest and (is_own or _is_constant(name)):
            return (self._latest[key],)
        if is_own and name.endswith("SamplingPeriod"):
            return (0,)
        return (_OF_BRIDGE[name],) if is_own and name in _OF_BRIDGE else None

    def _held(self, path: str, name: str, *, is_own: bool) -> tuple[Any] | None:
        setter = _HELD.get(name)
        if setter is None:
            return None
        command = self._new.holding.get((path, setter))
        if command is not None and command.arguments:
            return (command.arguments[0],)
        if setter == "enable":
            is_sensed = any(key[0] == path for key in self._latest)
            is_enabled = path in self.named or (self.tape.head["began_late"] and is_sensed)
            return (int(self._fact("robot", "getBasicTimeStep")) if is_enabled else 0,)
        limit = self.tape.head["facts"].get(path, {}).get("getMaxVelocity", 0.0 if is_own else None)
        defaults = {} if limit is None else {"setVelocity": limit}
        if is_own:
            defaults["setPosition"] = 0.0  # the world's file may say otherwise
        return (defaults[setter],) if setter in defaults else None

    def _fact(self, path: str, name: str) -> Any:
        return self.tape.head["facts"].get(path, {}).get(name, 0.0)

    def command(
        self, path: str, owner: str, name: str, arguments: Sequence[Any], frame: FrameType
    ) -> Any:
        """Note a command, and return what it answered in the old run."""
        if self.why_ended == "unrecorded":
            raise ReplayEndedError
        file = frame.f_code.co_filename
        place = TapedPlace(relative_source(file, self.root) or file, frame.f_lineno)
        coded = [self._encode(each) for each in arguments]
        given = GivenCommand(path, owner, name, coded, place)
        self._new.add(given)
        if self._rows is not None:
            self._rows.commanded(given)
        if self.given is not None:
            self.given.append([self.rounds, *given[:4], list(place)])
        self._passed_over[path] += name == _CONSUMES
        replies = self._replies.get((path, name))
        reply = replies.pop(0) if replies else None
        return None if isinstance(reply, dict) else reply

    def _encode(self, value: Any) -> Any:
        return encode_value(value, "", path_of_object, images=True)

    def make(self, path: str, owner: str) -> Any:
        """Return the object of Webots' package at a path, always the same one."""
        found = self._objects.get(path)
        if found is None:
            made: Any = object.__new__(self.classes[owner])
            made.__dict__["_path"] = path
            found = self._objects[path] = made
        return found


def _is_constant(name: str) -> bool:
    return name.startswith(_CONSTANT) and name not in _NOT_CONSTANT


def path_of_object(value: Any) -> str | None:
    """Return the path of an object of the replayed package; None for any other object."""
    own: dict[str, Any] = getattr(value, "__dict__", {})
    kind: Any = value.__class__
    return own.get("_path") if hasattr(kind, "_webots_mcp_replayed") else None


_active: ReplayedTape | None = None


def activate(tape: ReplayedTape) -> None:
    """Let the replayed packages of this process answer from a tape."""
    global _active
    _active = tape


def active() -> ReplayedTape:
    """Return the tape that this process replays.

    Raises:
        ImportError: It replays none.
    """
    if _active is None:
        raise ImportError("this package answers from a tape, and only within 'webots-mcp rerun'")
    return _active
