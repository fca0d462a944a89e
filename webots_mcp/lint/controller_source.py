"""What the source of a controller says of devices, time steps and learning."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple, cast

from webots_mcp.simulator.project import ProjectController

_FILE_BYTES: Final = 2_000_000
_FILES: Final = 200
_MOST_VALUES: Final = 256
_OF_DEVICES: Final = (
    "Device", "Accelerometer", "Altimeter", "Brake", "Camera", "Compass", "Connector", "Display",
    "DistanceSensor", "Emitter", "GPS", "Gyro", "InertialUnit", "LED", "Led", "Lidar",
    "LightSensor", "Motor", "Pen", "PositionSensor", "Radar", "RangeFinder", "Receiver", "Speaker",
    "TouchSensor", "VacuumGripper",
)  # fmt: skip
_GETTERS: Final = frozenset(f"get{name}" for name in _OF_DEVICES)
_HARMLESS: Final = frozenset(
    {"controller", "numpy", "scipy", "cv2", "matplotlib", "pandas", "PIL", "yaml", "shapely"}
)
"""Imported packages that take no devices of a robot."""
_ENVIRONMENTS: Final = frozenset(
    {"gym", "gymnasium", "stable_baselines3", "sb3_contrib", "deepbots", "tianshou", "rllib"}
)
_NETWORKS: Final = frozenset({"torch", "tensorflow", "keras", "jax", "ray"})
_LEARNS: Final = frozenset({"backward", "learn", "fit", "train_on_batch"})
_COMMENT: Final = re.compile(r'//[^\n]*|/\*.*?\*/|("(?:[^"\\\n]|\\.)*")', re.DOTALL)
_C_DEVICE: Final = re.compile(
    r"(?:wb_robot_get_device|(?:->|\.)get(?:" + "|".join(_OF_DEVICES) + r"))\s*\(\s*([^;]*?)\)"
)
_C_TEXT: Final = re.compile(r"""["']((?:[^"'\\]|\\.)*)["']\s*\Z""")
_C_STEP: Final = re.compile(r"(?:wb_robot_step|robot(?:->|\.)step)\s*\(\s*(\w+)\s*\)")
_C_ENABLE: Final = re.compile(r"(?:wb_\w+_enable\s*\(\s*[\w\[\]]+\s*,|->enable\s*\()\s*(\w+)\s*\)")
_C_CONSTANT: Final = re.compile(
    r"#\s*define\s+(\w+)\s+\(?(\d+)\)?\s*$|(?:const|constexpr|final)\s+(?:static\s+)?"
    r"(?:int|double|float|unsigned)\s+(\w+)\s*=\s*(\d+)(?:\.0*)?\s*;",
    re.MULTILINE,
)


class NamedUse(NamedTuple):
    """A device that the source asks for by name.

    Attributes:
        name: The name.
        file: The file.
        line: The line.
        is_guarded: Whether it is asked for only under a condition.
    """

    name: str
    file: Path
    line: int
    is_guarded: bool


class PeriodUse(NamedTuple):
    """A period in milliseconds that the source gives to `step` or `enable`."""

    call: str
    period_ms: float
    file: Path
    line: int


@dataclass
class ControllerSource:
    """What was read of a controller.

    Attributes:
        devices: The devices that it asks for.
        periods: The periods that it gives to `step` and `enable`.
        learns_with: The package it learns with; empty if it shows no learning.
        unread: Why not all of it is known, so that it may use other devices; empty if all is.
        unread_period: Where it gives a period that is not known here.
    """

    devices: list[NamedUse] = field(default_factory=list[NamedUse])
    periods: list[PeriodUse] = field(default_factory=list[PeriodUse])
    learns_with: str = ""
    unread: str = ""
    unread_period: str = ""


def read_source(controller: ProjectController) -> ControllerSource:
    """Read the source of a controller."""
    found = ControllerSource()
    if controller.is_python:
        _PythonReader(controller.file, found).read()
    elif controller.language in ("C", "C++", "Java", "MATLAB"):
        _read_c(controller, found)
    else:
        found.unread = f"{controller.file.name} is {controller.language}"
    return found


def _text_of(file: Path, found: ControllerSource) -> str | None:
    try:
        if file.stat().st_size > _FILE_BYTES:
            raise OSError(f"more than {_FILE_BYTES:,} bytes")
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        found.unread = f"{file.name} cannot be read: {error}"
        return None


# -- Python --

BASIC_STEP: Final = object()
"""The value of `getBasicTimeStep`, or a whole multiple of it."""
_Values = Sequence[object]
"""What an expression can be; a loop over a list has several values."""


class _PythonReader:
    """Reads a Python controller and the modules of its folder that it imports."""

    def __init__(self, file: Path, found: ControllerSource) -> None:
        self._main = file
        self._found = found

    def read(self) -> None:
        """Read the file and what it imports."""
        done: set[Path] = set()
        waiting = [self._main]
        while waiting:
            file = waiting.pop()
            if file in done:
                continue
            done.add(file)
            if len(done) > _FILES:
                self._found.unread = f"it imports more than {_FILES} files"
                return
            text = _text_of(file, self._found)
            if text is None:
                continue
            try:
                tree = ast.parse(text)
                waiting += self._imports(tree)
                _PythonFile(file, tree, self._found).visit_all()
            except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
                self._found.unread = f"{file.name} cannot be parsed: {type(error).__name__}"
                self._found.unread_period = self._found.unread

    def _imports(self, tree: ast.Module) -> Iterator[Path]:
        """Yield the files of the project that a module imports, and note other packages."""
        calls = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        for name in _imported(tree):
            top = name.split(".")[0]
            local = [*self._files_of(name)]
            yield from local
            if top in _ENVIRONMENTS or (top in _NETWORKS and calls & _LEARNS):
                self._found.learns_with = self._found.learns_with or top
            if not local and top not in _HARMLESS and top not in sys.stdlib_module_names:
                self._found.unread = f"it imports {top}, which may take devices"

    def _files_of(self, name: str) -> Iterator[Path]:
        path = self._main.parent.joinpath(*name.split("."))
        for file in (path.with_suffix(".py"), path / "__init__.py", path.parent / "__init__.py"):
            if file.is_file() and file.parent.is_relative_to(self._main.parent):
                yield file


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            if module:
                yield module
            if not module or node.level:
                yield from (f"{module}.{each.name}".strip(".") for each in node.names)


class _PythonFile(ast.NodeVisitor):
    """Collects the calls of one file."""

    def __init__(self, file: Path, tree: ast.Module, found: ControllerSource) -> None:
        self._file = file
        self._tree = tree
        self._found = found
        self._names: dict[str, _Values | None] = {}
        self._robots = {"robot", "supervisor"}
        self._guards = 0

    def visit_all(self) -> None:
        """Visit the file; constants of it are known before its calls are read."""
        for node in ast.walk(self._tree):
            if isinstance(node, ast.Assign):
                for target in node.targets:
                    self._assign(target, node.value)
            elif isinstance(node, ast.AnnAssign) and node.value is not None:
                self._assign(node.target, node.value)
            elif isinstance(node, ast.AugAssign):
                self._names[ast.unparse(node.target)] = None
            elif isinstance(node, ast.arg):
                self._names[node.arg] = None
        for node in ast.walk(self._tree):
            if isinstance(node, (ast.For, ast.comprehension)):
                self._loop(node)
        self.visit(self._tree)

    def _assign(self, target: ast.expr, value: ast.expr) -> None:
        if not isinstance(target, (ast.Name, ast.Attribute)):
            for inner in ast.walk(target):
                if isinstance(inner, ast.Name):
                    self._names[inner.id] = None
            return
        name = ast.unparse(target)
        self._names[name] = None if name in self._names else self._values(value)
        if isinstance(value, ast.Call) and _last_name(value.func) in ("Robot", "Supervisor"):
            self._robots.add(name)

    def _loop(self, node: ast.For | ast.comprehension) -> None:
        if isinstance(node.target, ast.Name):
            values = self._values(node.iter)
            lists = [cast("Sequence[object]", each) for each in values or () if _is_list(each)]
            is_known = values is not None and len(lists) == len(values)
            flat = [item for each in lists for item in each[:_MOST_VALUES]]
            known = self._names.get(node.target.id, ()) if node.target.id in self._names else ()
            self._names[node.target.id] = (
                [*known, *flat] if is_known and known is not None else None
            )
        else:
            for inner in ast.walk(node.target):
                if isinstance(inner, ast.Name):
                    self._names[inner.id] = None

    def _values(self, node: ast.expr) -> _Values | None:
        """Return what an expression can be; None if that is not known."""
        if isinstance(node, ast.Constant):
            return [node.value]
        if isinstance(node, (ast.Name, ast.Attribute)):
            return self._names.get(ast.unparse(node))
        if isinstance(node, (ast.List, ast.Tuple)):
            items = [self._values(each) for each in node.elts]
            flat = [item for each in items for item in each or ()]
            return [tuple(flat)] if all(each is not None for each in items) else None
        if isinstance(node, ast.JoinedStr):
            return self._joined(node)
        if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Mult, ast.Mod)):
            return self._operation(node)
        if isinstance(node, ast.Call) and _last_name(node.func) == "getBasicTimeStep":
            return [BASIC_STEP]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            return self._call(node.func.id, node.args)
        return None

    def _joined(self, node: ast.JoinedStr) -> _Values | None:
        parts: list[_Values] = []
        for each in node.values:
            inner = each.value if isinstance(each, ast.FormattedValue) else each
            if isinstance(each, ast.FormattedValue) and each.format_spec is not None:
                return None
            values = self._values(inner)
            if values is None:
                return None
            parts.append(values)
        return self._combined(parts, lambda *items: "".join(map(str, items)))

    def _operation(self, node: ast.BinOp) -> _Values | None:
        left, right = self._values(node.left), self._values(node.right)
        if left is None or right is None:
            return None
        if isinstance(node.op, ast.Add):
            return self._combined([left, right], _added)
        if isinstance(node.op, ast.Mult):
            return self._combined([left, right], _multiplied)
        return self._combined([left, right], _formatted)

    def _call(self, name: str, arguments: Sequence[ast.expr]) -> _Values | None:
        given = [self._values(each) for each in arguments]
        known = [each for each in given if each is not None]
        if len(known) != len(given) or name not in ("str", "int", "range"):
            return None
        if name == "str" and len(known) == 1:
            return [str(each) for each in known[0]]
        if name == "int" and len(known) == 1:
            if known[0] == [BASIC_STEP]:
                return known[0]
            numbers = [each for each in known[0] if isinstance(each, (int, float))]
            return [int(each) for each in numbers] if len(numbers) == len(known[0]) else None
        bounds = [each[0] for each in known if len(each) == 1 and isinstance(each[0], int)]
        if name == "range" and 0 < len(bounds) == len(known) <= 3 and 0 not in bounds[2:]:
            return [range(*bounds)]
        return None

    def _combined(self, parts: Sequence[_Values], join: Callable[..., object]) -> _Values | None:
        total = 1
        for each in parts:
            total *= len(each)
        if total > _MOST_VALUES:
            return None
        found = [join(*items) for items in product(*parts)]
        return None if None in found else found

    # -- visiting --

    def visit_If(self, node: ast.If) -> None:
        """Visit what is done under a condition; `if __name__ == "__main__"` is none."""
        is_main = "__name__" in ast.unparse(node.test)
        self._guards += not is_main
        self.generic_visit(node)
        self._guards -= not is_main

    def visit_Try(self, node: ast.Try) -> None:
        """Visit what may fail."""
        self._guards += 1
        self.generic_visit(node)
        self._guards -= 1

    def visit_Call(self, node: ast.Call) -> None:
        """Note a call of the robot's API."""
        name = _last_name(node.func)
        if isinstance(node.func, ast.Attribute):
            if name in _GETTERS and len(node.args) == 1:
                self._device(node.args[0], node.lineno)
            elif name == "getDeviceByIndex" or name in ("attach", "auto_publish", "devices"):
                self._found.unread = f"it uses {name}, which takes any device"
            elif name in ("step", "enable") and len(node.args) == 1:
                self._period(name, node)
        self.generic_visit(node)

    def _device(self, argument: ast.expr, line: int) -> None:
        values = self._values(argument)
        if values is None or not all(isinstance(each, str) for each in values):
            self._found.unread = f"line {line} of {self._file.name} computes the name of a device"
            return
        uses = (NamedUse(str(each), self._file, line, self._guards > 0) for each in values)
        self._found.devices += uses

    def _period(self, name: str, node: ast.Call) -> None:
        assert isinstance(node.func, ast.Attribute)
        owner = ast.unparse(node.func.value)
        is_robot = owner in self._robots or owner in ("self.robot", "self.supervisor")
        if name == "step" and not is_robot:
            return
        values = self._values(node.args[0])
        value = values[0] if values and len(values) == 1 else None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            if value > 0:
                self._found.periods.append(PeriodUse(name, value, self._file, node.lineno))
        elif value is not BASIC_STEP and not (name == "enable" and isinstance(value, bool)):
            self._found.unread_period = f"line {node.lineno} of {self._file.name} computes a period"


def _is_list(value: object) -> bool:
    return isinstance(value, (tuple, range))


def _last_name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def _added(a: object, b: object) -> object:
    if isinstance(a, str) and isinstance(b, str):
        return a + b
    if isinstance(a, tuple) and isinstance(b, tuple):
        return (*cast("tuple[object, ...]", a), *cast("tuple[object, ...]", b))
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return a + b
    return None


def _multiplied(a: object, b: object) -> object:
    if (a is BASIC_STEP and isinstance(b, int)) or (b is BASIC_STEP and isinstance(a, int)):
        return BASIC_STEP
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return a * b
    return None


def _formatted(text: object, value: object) -> object:
    try:
        return text % value if isinstance(text, str) else None
    except (TypeError, ValueError):
        return None


# -- C, C++, Java and MATLAB --


def _read_c(controller: ProjectController, found: ControllerSource) -> None:
    folder = controller.file.parent
    endings = (".c", ".cpp", ".cc", ".cxx", ".h", ".hpp", ".hh", ".java", ".m")
    files = [file for file in sorted(folder.rglob("*")) if file.suffix in endings]
    if not files:
        found.unread = f"{controller.file.name} is {controller.language} without source"
        return
    if len(files) > _FILES:
        found.unread = f"it has more than {_FILES} files"
    for file in files[:_FILES]:
        text = _text_of(file, found)
        if text is not None:
            _read_c_file(file, text, found, is_matlab=file.suffix == ".m")


def _read_c_file(file: Path, text: str, found: ControllerSource, *, is_matlab: bool) -> None:
    if is_matlab:
        text = re.sub(r"%[^\n]*", "", text)
    else:
        text = _COMMENT.sub(lambda each: each[1] or "\n" * each[0].count("\n"), text)
    constants: Mapping[str, float] = {
        (each[1] or each[3]): float(each[2] or each[4]) for each in _C_CONSTANT.finditer(text)
    }
    is_guarded = re.search(r"#\s*if(?!ndef\s+\w+_H)", text) is not None
    for call in _C_DEVICE.finditer(text):
        line = text.count("\n", 0, call.start()) + 1
        literal = _C_TEXT.match(call[1])
        if literal:
            found.devices.append(NamedUse(literal[1], file, line, is_guarded))
        elif call[1] and not re.match(r"(?:const\s+)?(?:char|std::string|String)\b", call[1]):
            found.unread = f"line {line} of {file.name} computes the name of a device"
    if re.search(r"get_device_by_index|getDeviceByIndex", text):
        found.unread = f"{file.name} takes devices by index"
    for name, pattern in (("step", _C_STEP), ("enable", _C_ENABLE)):
        for call in pattern.finditer(text):
            value = constants.get(call[1])
            period = value if value is not None else float(call[1]) if call[1].isdigit() else None
            line = text.count("\n", 0, call.start()) + 1
            if period is None and not re.search(r"basic_time_step|getBasicTimeStep", text):
                found.unread_period = f"line {line} of {file.name} computes a period"
            if period:
                found.periods.append(PeriodUse(name, period, file, line))
