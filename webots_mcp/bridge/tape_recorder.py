"""Records the calls that a controller makes of Webots' Python package, from inside its process.

The methods and properties of the package's classes are replaced by ones that also append to a list.
At the end of each step the list becomes a line of the tape. What the bridge asks is not recorded,
except for the values of sensors: a replay answers with them what the old code did not ask.

It must begin before `Robot()` is made, or it misses what was asked and enabled before. Importing
`webots_mcp` begins it where `WEBOTS_MCP_TAPE=1` is set, or where the project's `webots-mcp.toml`
says `tape = true`. Until a bridge opens the file, lines wait in memory.
"""

from __future__ import annotations

import atexit
import functools
import inspect
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from threading import get_ident
from types import FrameType, ModuleType
from typing import Any, Final, cast

from webots_mcp.bridge.error_report import describe
from webots_mcp.contract import PARAMETERS_VARIABLE, VERSION
from webots_mcp.database.tapes import tape_notes
from webots_mcp.database.tapes.package_surface import (
    PACKAGES,
    STEPS,
    caller_frame,
    classes_of,
    describe_package,
    kind_of_member,
)
from webots_mcp.database.tapes.source_files import (
    files_imported,
    files_near,
    read_sources,
    relative_source,
    root_of,
)
from webots_mcp.database.tapes.tape import MAX_TAPE_BYTES, NOTES, RUN, TapeWriter, tape_file
from webots_mcp.database.tapes.tape_values import encode_value
from webots_mcp.errors import warn

MAX_WAITING_LINES: Final = 20_000  # in memory, until a bridge opens the file
_OWN: Final = frozenset({"webots_mcp", *PACKAGES})  # packages whose calls are not the user's
_PATH: Final = "_webots_mcp_path"  # of an object of Webots' package
_SENSED: Final = frozenset({"getValue", "getValues", "getRollPitchYaw"})  # that the bridge asks too
_MOST_CALLS: Final = 20_000  # different ones; a call beyond them is not recorded
# What follows from the commands, and what only the bridge asks; both are asked many times a step.
_NOT_RECORDED: Final = ("SamplingPeriod", "sampling_period", "simulationGetMode")
_READS_DEVICES: Final = "webots_mcp.bridge.devices"
_VARIABLE_ARGUMENTS: Final = inspect.CO_VARARGS | inspect.CO_VARKEYWORDS
_NUMBERS: Final = frozenset({type(None), bool, int, float})
_PLAIN: Final = _NUMBERS | {str}
_FACTS: Final = {  # what a device is, asked once: new code may ask it although the old one did not
    "Robot": ("getName", "getModel", "getBasicTimeStep", "getProjectPath", "getWorldPath",
              "getNumberOfDevices", "getCustomData", "getMode", "getSynchronization",
              "getSupervisor"),
    "Camera": ("getWidth", "getHeight", "getFov", "hasRecognition"),
    "DistanceSensor": ("getType", "getMinValue", "getMaxValue", "getAperture"),
    "GPS": ("getCoordinateSystem",),
    "Lidar": ("getHorizontalResolution", "getNumberOfLayers", "getFov", "getMinRange",
              "getMaxRange"),
    "Motor": ("getType", "getMinPosition", "getMaxPosition", "getMaxVelocity", "getMultiplier"),
    "PositionSensor": ("getType",),
    "RangeFinder": ("getWidth", "getHeight", "getFov", "getMinRange", "getMaxRange"),
    "TouchSensor": ("getType",),
}  # fmt: skip


def _key(kind: str, name: str) -> str:
    """Return the name under which an object holds the number of a call without arguments."""
    return f"_webots_mcp_{kind}_{name}"


class TapeRecorder:
    """Collects the calls of a process and writes them, a line for each step.

    Args:
        images: Whether to record the answers of cameras and lidars too.

    Attributes:
        began_late: Whether the robot was already there when the recording began.
        events: Of the round that is under way; always the same list.
        own_modules: Modules of Webots' package and of this one that have called.
        file: The tape; None until a bridge has opened it.
        why_not: Why nothing is recorded any more; None while it is.
        is_stepping: Whether a step is under way.
    """

    def __init__(self, *, images: bool) -> None:
        self.images = images
        self.began_late = False
        self.file: Path | None = None
        self.why_not: str | None = None
        self.events: list[Any] = []
        self.own_modules: set[str] = set()
        self.is_stepping = False
        self._definitions: list[list[Any]] = []
        self._waiting: list[list[Any]] = []
        self._writer: TapeWriter | None = None
        self._robot: Any = None
        self._get_time: Callable[[Any], float] | None = None
        self._rounds = 0
        self._runs = 0  # in which time has gone back, before this one
        self._time_s = 0.0
        self._run_uuid: Callable[[], str] | None = None
        self._noted_run = ""
        self._calls: dict[tuple[str, str, str], int] = {}
        self._places: dict[tuple[str, int], int] = {}
        self._unnamed: dict[str, int] = {}
        self._user_modules: set[str] = set()
        self._thread = get_ident()
        self._has_threads = False
        main = _main_file()
        self._root = root_of(main) if main else Path.cwd()
        self._known_sources: set[str] = set()
        self._modules: set[str] = set()  # that were loaded when the sources were read
        self._module_count = 0
        self._near: list[dict[str, str]] = []  # texts that a thread has read

    # -- in each call ----------------------------------------------------------------------------

    def is_own(self, frame: FrameType) -> bool:
        """Return whether a call comes from Webots' package or from this one, not from the user."""
        module = frame.f_globals.get("__name__", "")
        if module in self._user_modules:
            return False
        if module in self.own_modules:
            return True
        is_own = isinstance(module, str) and module.partition(".")[0] in _OWN
        (self.own_modules if is_own else self._user_modules).add(module)
        return is_own

    def answered(
        self, source: Any, name: str, arguments: Sequence[Any], answer: Any, kind: str = "question"
    ) -> None:
        """Append the answer to a question."""
        if self.why_not is not None:
            return
        try:
            if arguments:
                number = self._number(source, name, arguments, kind)
            else:
                number = self.number_without_arguments(source, _key(kind, name), name, kind)
            if type(answer) not in _NUMBERS:
                if type(answer) is _Raised:
                    answer = {"$raised": type(answer.error).__name__, "text": str(answer.error)}
                else:
                    path = functools.partial(self._name_answer, source, name, arguments)
                    answer = self._encode(answer, name, path)
            self.events.extend((number, answer))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._stop(f"{type(error).__name__}: {error}")

    def commanded(
        self, source: Any, name: str, arguments: Sequence[Any], frame: FrameType
    ) -> list[Any] | None:
        """Append a command; returns its event, to which an answer may be added."""
        if self.why_not is not None:
            return None
        try:
            number = self.number_without_arguments(source, _key("command", name), name, "command")
            coded = [
                each if type(each) in _PLAIN else self._encode(each, name, _known_name)
                for each in arguments
            ]
            where = (frame.f_code.co_filename, frame.f_lineno)
            place = self._places.get(where)
            if place is None:
                place = self._enter_place(where)
            event = [coded, place]
            self.events.extend((number, event))
            if get_ident() != self._thread:
                self._note_thread()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._stop(f"{type(error).__name__}: {error}")
            return None
        return event

    def stepped(self, robot: Any, name: str, arguments: Sequence[Any], answer: Any) -> None:
        """Write the round that this step ended."""
        if self.why_not is not None:
            return
        try:
            self._write_round(robot, name, arguments, answer)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._stop(f"{type(error).__name__}: {error}")

    def note(self, kind: str, content: Any) -> None:
        """Append what the bridge did at this moment: a command that it served, a value it set."""
        if self.why_not is None:
            self.events.extend((NOTES, [kind, content]))

    def _write_round(self, robot: Any, name: str, arguments: Sequence[Any], answer: Any) -> None:
        if self._get_time is None:
            self._get_time = _unwrapped(robot, "getTime")
            self._robot = robot
        if self._run_uuid is not None and self._run_uuid() != self._noted_run:
            self._noted_run = self._run_uuid()
            self.note(RUN, [self._noted_run, self._runs])
        events = self.events[:]
        del self.events[: len(events)]
        time_s = self._get_time(robot)
        self._runs += time_s < self._time_s - 1e-9
        self._time_s = time_s
        end = ["round", self._rounds, time_s, name, list(arguments), answer, events]
        self._rounds += 1
        definitions, self._definitions = self._definitions, []
        lines = [*definitions, end]
        if self._writer is None:
            self._waiting += lines
            if len(self._waiting) > MAX_WAITING_LINES:
                self._stop("no bridge was made, so there is no recording that it belongs to")
            return
        if len(sys.modules) != self._module_count or self._near:
            lines = [*self._new_sources(), *lines]
        self._writer.write(lines)
        if not self._writer.is_open:
            self._stop(f"it has reached {MAX_TAPE_BYTES:,} bytes")

    def _new_sources(self) -> list[list[Any]]:
        """Return lines with the modules that were imported since, and with what a thread has read.

        The folder of the controller may be large: it is not searched in the control loop.
        """
        self._module_count = len(sys.modules)
        loaded = set(sys.modules)
        new, self._modules = loaded - self._modules, loaded
        texts = read_sources(files_imported(sorted(new)), self._root, self._known_sources)
        while self._near:
            for name, text in self._near.pop().items():
                if name not in self._known_sources:
                    self._known_sources.add(name)
                    texts[name] = text
        return [["source", *each] for each in texts.items()]

    def _read_near(self, controller: Path) -> None:
        """Read the files next to the controller, in a thread of its own."""
        try:
            near = files_near(controller, self._root)
            self._near.append(read_sources(near, self._root, set()))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            warn(f"not on the tape: the files next to the controller, {describe(error)}")

    def _note_thread(self) -> None:
        if not self._has_threads:
            self._has_threads = True
            self.note("thread", threading.current_thread().name)

    # -- names -----------------------------------------------------------------------------------

    def _encode(self, value: Any, name: str, name_of: Callable[[Any], str | None]) -> Any:
        return encode_value(value, name, name_of, images=self.images)

    def number_without_arguments(self, source: Any, key: str, name: str, kind: str) -> int:
        """Return the number of a call of an object, which is stored there under a key."""
        own: dict[str, Any] = source.__dict__
        number: int | None = own.get(key)
        if number is None:
            number = own[key] = self._number(source, name, (), kind)
        return number

    def _number(self, source: Any, name: str, arguments: Sequence[Any], kind: str) -> int:
        """Return the number of a call, and describe it on the tape when it is new."""
        path = self._path_of(source)
        coded = [self._encode(each, name, self._known_path) for each in arguments]
        key = (path, f"{kind} {name}", repr(coded) if coded else "")
        number = self._calls.get(key)
        if number is None:
            number = len(self._calls) + 1
            if number > _MOST_CALLS:
                self._stop(f"there were more than {_MOST_CALLS:,} different calls")
            self._calls[key] = number
            owner = type(source).__name__ if path != "robot" else "Robot"
            self._definitions.append(["call", number, path, owner, name, coded, kind])
        return number

    def _path_of(self, source: Any) -> str:
        own: dict[str, Any] = source.__dict__
        path: str | None = own.get(_PATH)
        if path is None:
            path = own[_PATH] = self._new_path(source)
        return path

    def _new_path(self, source: Any) -> str:
        classes = classes_of("controller")
        if isinstance(source, classes["Robot"]):
            return "robot"
        if "Device" in classes and isinstance(source, classes["Device"]):
            return f"device:{_unwrapped(source, 'getName')(source)}"
        kind = type(source).__name__
        self._unnamed[kind] = self._unnamed.get(kind, 0) + 1
        return f"{kind}#{self._unnamed[kind]}"

    def _known_path(self, value: Any) -> str | None:
        return self._path_of(value) if _is_of_package(value) else None

    def _name_answer(
        self, source: Any, name: str, arguments: Sequence[Any], value: Any
    ) -> str | None:
        """Return the path of an object that was an answer: how it was asked for."""
        if not _is_of_package(value):
            return None
        own: dict[str, Any] = value.__dict__
        path: str | None = own.get(_PATH)
        if path is None:
            device = classes_of("controller").get("Device", ())
            asked = f"{self._path_of(source)}.{name}({', '.join(map(repr, arguments))})"
            path = own[_PATH] = self._new_path(value) if isinstance(value, device) else asked
        return path

    def _enter_place(self, where: tuple[str, int]) -> int:
        number = self._places[where] = len(self._places) + 1
        file = relative_source(where[0], self._root) or Path(where[0]).name
        self._definitions.append(["place", number, file, where[1]])
        return number

    # -- the file --------------------------------------------------------------------------------

    def open(
        self, data_dir: Path, session_uuid: str, robot: Any, run_uuid: Callable[[], str]
    ) -> None:
        """Write the head and all that waits to the tape of a session, and go on there."""
        if self.why_not is not None or self._writer is not None:
            return
        controller = _main_file()
        self._get_time = _unwrapped(robot, "getTime")
        self._robot = robot
        file = tape_file(data_dir, session_uuid)
        try:
            head = self._head(robot, session_uuid, controller)
            waiting, self._waiting = self._waiting, []
            self._writer = TapeWriter(file)
            self._writer.write([["head", head]])
            own = read_sources([controller] if controller else [], self._root, self._known_sources)
            sources = [["source", *each] for each in own.items()] + self._new_sources()
            for each in (*sources, *waiting):
                self._writer.write([each])
            if controller is not None:
                read = threading.Thread(target=self._read_near, args=(controller,), daemon=True)
                read.start()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._stop(f"{type(error).__name__}: {error}")
            return
        self.file = file
        self._run_uuid = run_uuid
        tape_notes.note = self.note
        atexit.register(self.close, "finished")

    def _head(self, robot: Any, session_uuid: str, controller: Path | None) -> dict[str, Any]:
        named = relative_source(controller, self._root) if controller else None
        return {
            "version": VERSION,
            "session_uuid": session_uuid,
            "began_wall_time_s": time.time(),
            "began_late": self.began_late,
            "images": self.images,
            "controller": named,
            "project": str(self._root),
            "arguments": sys.argv[1:],
            "folder": str(Path.cwd()),
            "python": sys.version.split()[0],
            "executable": sys.executable,
            "hash_seed": os.environ.get("PYTHONHASHSEED"),
            "parameters": os.environ.get(PARAMETERS_VARIABLE),
            "packages": {name: describe_package(name) for name in PACKAGES if name in sys.modules},
            "devices": {str(n): type(each).__name__ for n, each in _devices_of(robot).items()},
            "facts": _facts_of(robot),
        }

    def close(self, reason: str) -> None:
        """End the tape, with what was asked and commanded after the last step."""
        if self._writer is not None and self._writer.is_open:
            try:
                self._writer.write(self._new_sources())
                if self.why_not is None and self.events:
                    last = ["round", self._rounds, None, "", [], None, self.events]
                    self._writer.write([*self._definitions, last])
                self._writer.close(reason)
            except (OSError, TypeError, ValueError) as error:
                warn(f"the end of the tape {self.file} could not be written: {error}")
        self.why_not = self.why_not or reason
        self.events.clear()
        self._waiting, self._definitions = [], []

    def abandon(self) -> None:
        """Leave the tape to the parent of a forked child."""
        if self._writer is not None:
            self._writer.abandon()
        self.why_not = "the process is a forked child"

    def _stop(self, why: str) -> None:
        is_first = self.why_not is None
        self.why_not = why
        self.close("full" if "bytes" in why else why)
        if is_first:
            warn(f"the tape of this controller ends: {why}. The recording goes on without it")


def _known_name(value: Any) -> str | None:
    return value.__dict__.get(_PATH) if _is_of_package(value) else None


def _is_of_package(value: Any) -> bool:
    is_object = type(value).__module__.partition(".")[0] in PACKAGES
    return is_object and hasattr(value, "__dict__")


def _main_file() -> Path | None:
    main = getattr(sys.modules.get("__main__"), "__file__", None)
    path = Path(main).absolute() if main else None
    return path if path and path.is_file() else None


def _devices_of(robot: Any) -> dict[str, Any]:
    return getattr(robot, "devices", None) or {}


def _facts_of(robot: Any) -> dict[str, dict[str, Any]]:
    """Return what the robot and its devices are, by path and name of the getter."""
    sources: dict[str, tuple[object, str]] = {"robot": (robot, "Robot")}
    devices = _devices_of(robot).items()
    sources |= {f"device:{name}": (each, type(each).__name__) for name, each in devices}
    facts: dict[str, dict[str, Any]] = {}
    for path, (source, owner) in sources.items():
        for name in _FACTS.get(owner, ()):
            if not hasattr(type(source), name):  # in another version of Webots' library
                continue
            try:
                value = _unwrapped(source, name)(source)
            except Exception as error:  # noqa: BLE001  (the robot comes first)
                warn(f"not on the tape: {path}.{name}(), which raised {describe(error)}")
                continue
            if type(value) in _PLAIN:
                facts.setdefault(path, {})[name] = value
    return facts


def _unwrapped(source: Any, name: str) -> Callable[[Any], Any]:
    """Return a method as Webots' package has it."""
    kind: Any = source.__class__
    method = getattr(kind, name)
    return getattr(method, "_webots_mcp_original", method)


# -- replacing the members of Webots' classes ------------------------------------------------------


_recorder: TapeRecorder | None = None


def recorder() -> TapeRecorder | None:
    """Return the recorder of this process; None where no tape is recorded."""
    return _recorder


def begin(*, images: bool = False) -> TapeRecorder:
    """Record the calls of this process from now on, or as soon as it imports Webots' package."""
    global _recorder
    if _recorder is not None:
        return _recorder
    _recorder = TapeRecorder(images=images)
    if "controller" in sys.modules:
        robot = getattr(sys.modules["controller"], "Robot", None)
        _recorder.began_late = bool(getattr(robot, "created", None))
    loaded = [name for name in PACKAGES if name in sys.modules]
    for name in loaded:
        _replace_members(_recorder, name)
    if len(loaded) < len(PACKAGES):
        sys.meta_path.insert(0, _PackageFinder(_recorder))
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_recorder.abandon)
    return _recorder


class _PackageFinder(MetaPathFinder):
    """Finds Webots' packages as usual, and replaces the members of their classes once loaded."""

    def __init__(self, tape: TapeRecorder) -> None:
        self._tape = tape
        self._is_finding = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in PACKAGES or self._is_finding:
            return None
        self._is_finding = True
        try:
            spec = find_spec(fullname)
        finally:
            self._is_finding = False
        if spec is not None and spec.loader is not None:
            _replace_after_loading(spec.loader, self._tape, fullname)
        return spec


def _replace_after_loading(loader: Loader, tape: TapeRecorder, package: str) -> None:
    execute = loader.exec_module

    def load(module: ModuleType) -> None:
        execute(module)
        _replace_members(tape, package)

    cast("Any", loader).exec_module = load


def _replace_members(tape: TapeRecorder, package: str) -> None:
    for cls in classes_of(package).values():
        for name, member in tuple(vars(cls).items()):
            if hasattr(member, "_webots_mcp_original"):
                continue
            if name in STEPS and hasattr(cls, "getTime"):
                setattr(cls, name, _replaced_step(tape, name, member))
            elif name.startswith("_") or name.endswith(_NOT_RECORDED):
                continue
            elif inspect.isfunction(member):
                setattr(cls, name, _replaced_method(tape, name, member))
            elif isinstance(member, property):
                setattr(cls, name, _replaced_property(tape, name, member))


def _marked(replaced: Any, original: Any) -> Any:
    functools.update_wrapper(replaced, original)
    replaced._webots_mcp_original = original
    return replaced


def _replaced_step(tape: TapeRecorder, name: str, original: Any) -> Any:
    """Return a step that ends a round.

    The bridge's own exchanges with Webots do not, nor a step that is part of a `Driver`'s one.
    """

    def step(robot: Any, *args: Any, **kwargs: Any) -> Any:
        frame = caller_frame(1)
        is_part, tape.is_stepping = tape.is_stepping, True
        try:
            answer = original(robot, *args, **kwargs)
        finally:
            tape.is_stepping = is_part
        is_exchange = frame.f_code.co_name in ("exchange", "advance") and tape.is_own(frame)
        if not is_exchange and not is_part:
            tape.stepped(robot, name, (*args, *kwargs.values()), answer)
        return answer

    return _marked(step, original)


def _replaced_method(tape: TapeRecorder, name: str, original: Any) -> Any:
    if kind_of_member(name) == "command":
        return _marked(_command(tape, name, original), original)
    return _marked(_question(tape, name, original), original)


def _question(tape: TapeRecorder, name: str, original: Any) -> Any:
    code = original.__code__
    takes_none = code.co_argcount == 1 and not (code.co_flags & _VARIABLE_ARGUMENTS)
    if takes_none and not code.co_kwonlyargcount:
        return _plain_question(tape, name, original)

    def ask(source: Any, *args: Any, **kwargs: Any) -> Any:
        if tape.is_own(caller_frame(1)):
            return original(source, *args, **kwargs)
        try:
            answer = original(source, *args, **kwargs)
        except Exception as error:
            tape.answered(source, name, _flat(original, source, args, kwargs), _Raised(error))
            raise
        if kwargs:
            args = _flat(original, source, args, kwargs)
        tape.answered(source, name, args, answer)
        return answer

    return ask


def _plain_question(tape: TapeRecorder, name: str, original: Any) -> Any:
    """Return a question without arguments: most calls are one, in each step."""
    is_sensed = name in _SENSED
    own_modules, extend, key = tape.own_modules, tape.events.extend, _key("question", name)

    def ask(source: Any) -> Any:
        frame = caller_frame(1)
        module = frame.f_globals.get("__name__")
        if module in own_modules or tape.is_own(frame):
            answer = original(source)
            if is_sensed and module == _READS_DEVICES:
                tape.answered(source, name, (), answer, "seen")
            return answer
        try:
            answer = original(source)
        except Exception as error:
            tape.answered(source, name, (), _Raised(error))
            raise
        number = source.__dict__.get(key)
        if number is not None and tape.why_not is None and type(answer) in _NUMBERS:
            extend((number, answer))
        else:
            tape.answered(source, name, (), answer)
        return answer

    return ask


def _command(tape: TapeRecorder, name: str, original: Any) -> Any:
    def command(source: Any, *args: Any, **kwargs: Any) -> Any:
        frame = caller_frame(1)
        if tape.is_own(frame):
            return original(source, *args, **kwargs)
        given = _flat(original, source, args, kwargs) if kwargs else args
        event = tape.commanded(source, name, given, frame)
        answer = original(source, *args, **kwargs)
        if answer is not None and event is not None:
            event.append(answer if type(answer) in _PLAIN else {"$type": type(answer).__name__})
        return answer

    return command


def _replaced_property(tape: TapeRecorder, name: str, original: property) -> property:
    getter, setter = original.fget, original.fset

    def get(source: Any) -> Any:
        answer = getter(source) if getter is not None else None
        if not tape.is_own(caller_frame(1)):
            tape.answered(source, f".{name}", (), answer)
        return answer

    def set_(source: Any, value: Any) -> None:
        frame = caller_frame(1)
        if not tape.is_own(frame):
            tape.commanded(source, f".{name}", (value,), frame)
        if setter is not None:
            setter(source, value)

    made = property(_marked(get, getter or get), _marked(set_, setter) if setter else None)
    return _TapedProperty(made.fget, made.fset, original)


class _TapedProperty(property):
    """A property that is replaced already."""

    def __init__(self, getter: Any, setter: Any, original: property) -> None:
        super().__init__(getter, setter)
        self._webots_mcp_original = original


class _Raised:
    """An answer that was an exception."""

    def __init__(self, error: Exception) -> None:
        self.error = error


def _flat(
    original: Any, source: Any, args: Sequence[Any], kwargs: dict[str, Any]
) -> tuple[Any, ...]:
    """Return all arguments by position."""
    try:
        bound = inspect.signature(original).bind(source, *args, **kwargs)
    except TypeError:  # Webots' package will say so
        return (*args, *kwargs.values())
    return bound.args[1:] + tuple(bound.kwargs.values())
