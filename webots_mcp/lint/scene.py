"""The scene tree of a world as its file and the PROTO files that are here describe it.

A PROTO node is replaced by its base node where its source can be read. Where it cannot, the node
stays, with the reason, and nothing is assumed about what is in it.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.worlds.proto_files import ProtoFiles
from webots_mcp.worlds.vrml import FieldDefinition, Parser, Token, WorldNode, tokens_of
from webots_mcp.worlds.world_errors import WorldFileError

NODES_FILE: Final = Path(__file__).with_name("nodes.txt")
_RELEASE: Final = re.compile(r"#VRML_SIM (?:R(20\d\d)([ab])?|V(\d+))\S* utf8")
_TEMPLATE: Final = re.compile(r"%[<{]")
_LOOKS: Final = frozenset({"appearance", "material", "texture", "textureTransform"})
_LOOKS_ONLY: Final = re.compile(r"projects/(?:appearances|objects/backgrounds)/")
ENU_SINCE: Final = (2022, "a")
"""The release from which on cylinders, capsules and planes stand along z instead of y."""
EXTERNPROTO_SINCE: Final = (2022, "b")

_TYPES: Final = Parser(NODES_FILE.read_text(encoding="utf-8")).types()
_PLACED: Final = ("Solid", "Robot")
_DEVICES: Final = (
    "Accelerometer", "Altimeter", "Camera", "Compass", "Connector", "Display", "DistanceSensor",
    "Emitter", "GPS", "Gyro", "InertialUnit", "LED", "Lidar", "LightSensor", "Microphone", "Pen",
    "Radar", "Radio", "RangeFinder", "Receiver", "Speaker", "TouchSensor", "VacuumCup",
    "VacuumGripper", "Track",
)  # fmt: skip
SOLIDS: Final = frozenset({*_PLACED, *_DEVICES, "Charger", "Fluid", "DifferentialWheels"})
JOINTS: Final = frozenset(
    {"HingeJoint", "Hinge2Joint", "SliderJoint", "BallJoint", "TransmissionJoint"}
)
MOTORS: Final = frozenset({"RotationalMotor", "LinearMotor"})
DEVICES: Final = frozenset({*_DEVICES, *MOTORS, "Brake", "PositionSensor", "Skin"})
"""Types that a controller gets with `getDevice`."""
NODE_TYPES: Final[Mapping[str, Mapping[str, FieldDefinition]]] = {
    name: {**(_TYPES["Solid"] if name in SOLIDS else {}), **fields}
    for name, fields in _TYPES.items()
}


@dataclass(frozen=True)
class ReadingLimits:
    """How much of a world is read; beyond it the rest is not searched.

    Attributes:
        file_bytes: Size of a world or PROTO file.
        nodes: Nodes of the scene tree, with those of PROTO nodes.
        depth: Nodes and PROTO nodes within each other.
        processor_s: Processor time for reading and judging together, in seconds.
    """

    file_bytes: int = 16_000_000
    nodes: int = 60_000
    depth: int = 250
    processor_s: float = 20.0


LIMITS: Final = ReadingLimits()


class Release(NamedTuple):
    """A release of Webots, from the first line of a file."""

    year: int
    half: str

    def __str__(self) -> str:
        """Return its name."""
        return f"R{self.year}{self.half}" if self.year else "older than R2018"


def release_of(text: str) -> Release:
    """Return the release in the first line of a file.

    Raises:
        WorldFileError: The file is not one of Webots.
    """
    first_line = text.partition("\n")[0].strip()
    found = _RELEASE.match(first_line)
    if found is None:
        raise WorldFileError(
            f'the file has to begin with "#VRML_SIM R2023b utf8", not {first_line[:40]!r}', 1
        )
    return Release(int(found[1]), found[2] or "a") if found[1] else Release(0, "")


class OutOfTimeError(Exception):
    """The time for one world is over."""


@dataclass
class LintDeadline:
    """The end of the processor time for one world, which other programs do not shorten."""

    processor_s: float = LIMITS.processor_s
    _end_s: float = field(init=False)

    def __post_init__(self) -> None:
        self._end_s = time.thread_time() + self.processor_s

    def check(self) -> None:
        """Return if there is time left.

        Raises:
            OutOfTimeError: There is none.
        """
        if time.thread_time() > self._end_s:
            raise OutOfTimeError


class TimedParser(Parser):
    """A parser that ends when the time is over."""

    def __init__(
        self,
        text: str | Sequence[Token],
        deadline: LintDeadline,
        given: Mapping[str, Any] | None = None,
        file: Path | None = None,
    ) -> None:
        """Begin at the first word.

        Raises:
            OutOfTimeError: The time is over.
        """
        self._deadline = deadline
        words = [*self._words(text)] if isinstance(text, str) else text
        super().__init__(words, given, file=file)

    def _words(self, text: str) -> Iterator[Token]:
        for number, token in enumerate(tokens_of(text)):
            if number % 4096 == 0:
                self._deadline.check()
            yield token

    def _body(self, type_token: Token, def_name: str) -> WorldNode:
        self._deadline.check()
        return super()._body(type_token, def_name)

    def _numbers(self) -> list[float]:
        self._deadline.check()
        return super()._numbers()


class ProtoSource(NamedTuple):
    """The source of a PROTO node."""

    file: Path
    fields: Mapping[str, FieldDefinition]
    body: Sequence[Token]


class UnknownField(NamedTuple):
    """A field that a node sets, but its PROTO does not declare.

    Attributes:
        type_name: Name of the PROTO.
        source: Its source.
    """

    type_name: str
    source: ProtoSource


@dataclass(eq=False)
class TreeNode:
    """A node of the scene tree.

    Attributes:
        type_name: Type of the node; the name of its PROTO where the source cannot be read.
        written_type: Type as the file has it, which may be the name of a PROTO.
        def_name: Its DEF name.
        file: The file that has the fields.
        line: Line of the node in that file.
        release: Release of that file.
        parent: The node around it.
        field_name: The field of the parent that it is in.
        index: Its place in that field, if that is a list.
        unread: Why its PROTO cannot be read; empty for all other nodes.
        proto_files: Files of the PROTO nodes that it was built from, the outermost first.
        written_file: The file that names the node.
        written_line: The line that names it.
    """

    type_name: str
    written_type: str
    def_name: str
    file: Path
    line: int
    release: Release
    parent: TreeNode | None
    field_name: str
    index: int | None
    unread: str = ""
    proto_files: tuple[Path, ...] = ()
    written_file: Path | None = None
    written_line: int = 0
    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    field_lines: dict[str, int] = field(default_factory=dict[str, int])

    def line_of(self, name: str) -> int:
        """Return the line of a field, or of the node if the file leaves the field out."""
        return self.field_lines.get(name, self.line)

    def _raw(self, name: str) -> Any:
        if name in self.fields:
            return self.fields[name]
        definition = NODE_TYPES.get(self.type_name, {}).get(name)
        return None if definition is None else definition.default

    def numbers(self, name: str) -> list[float]:
        """Return the numbers of a field, or of its default; empty if it has none."""
        value = self._raw(name)
        return cast("list[float]", value) if _is_numbers(value) else []

    def vector(self, name: str, size: int) -> list[float]:
        """Return the numbers of a vector, or its default where the file has too few."""
        found = self.numbers(name)
        if len(found) == size:
            return found
        definition = NODE_TYPES.get(self.type_name, {}).get(name)
        default = definition.default if definition else None
        fitting = _is_numbers(default) and len(cast("list[float]", default)) == size
        return cast("list[float]", default) if fitting else [0.0] * size

    def number(self, name: str) -> float:
        """Return the number in a field, or its default."""
        return self.vector(name, 1)[0]

    def text(self, name: str) -> str:
        """Return the text in a field, or its default."""
        value = self._raw(name)
        return value if isinstance(value, str) else ""

    def is_true(self, name: str) -> bool:
        """Return a TRUE or FALSE, or its default."""
        return self._raw(name) is True

    def child(self, name: str) -> TreeNode | None:
        """Return the node in a field; the first of several."""
        return next(self.children(name), None)

    def children(self, *names: str) -> Iterator[TreeNode]:
        """Yield the nodes in these fields, or in all."""
        for name in names or tuple(self.fields):
            value = self.fields.get(name)
            if isinstance(value, TreeNode):
                yield value
            elif isinstance(value, list):
                yield from (each for each in cast("list[Any]", value) if isinstance(each, TreeNode))

    def around(self) -> Iterator[TreeNode]:
        """Yield the nodes around it, the nearest first."""
        node = self.parent
        while node is not None:
            yield node
            node = node.parent

    @property
    def label(self) -> str:
        """Return what a person calls the node: its DEF name, its name, or its type."""
        name = self.fields.get("name")
        if self.def_name:
            return self.def_name
        named = isinstance(name, str) and name
        return f'{self.written_type} "{name}"' if named else self.written_type

    @property
    def path(self) -> str:
        """Return the path from the nearest node with a DEF name, or from the top."""
        steps: list[str] = []
        node = self
        while node.parent is not None and not node.def_name:
            place = "" if node.index is None else f"[{node.index}]"
            steps.append(f".{node.field_name}{place}")
            node = node.parent
        return node.label + "".join(reversed(steps))


def _is_numbers(value: Any) -> bool:
    if not isinstance(value, list):
        return False
    return all(isinstance(each, float) for each in cast("list[Any]", value))


class Scene:
    """The scene tree of one world file."""

    def __init__(self, world: Path, deadline: LintDeadline) -> None:
        """Read the world.

        Raises:
            WorldFileError: It is missing, not text, too large, or has a fault of syntax; the text
                names the line.
            OutOfTimeError: There is no time left.
        """
        self.world = world
        self.project = world.parent.parent
        self.roots: list[TreeNode] = []
        self.nodes: list[TreeNode] = []
        self.releases: dict[Path, Release] = {}
        self.declared: dict[Path, dict[str, str]] = {}
        """URLs of EXTERNPROTO by the file that declares them."""
        self.cut = ""
        """Why a part of the scene was not read."""
        self.unknown_fields: dict[tuple[Path, int, str], UnknownField] = {}
        """Fields that a PROTO does not declare, by file, line and name."""
        self._deadline = deadline
        self._sources: dict[str, ProtoSource | str] = {}
        text = _text_of(world, "world")
        self.release = self.releases[world] = release_of(text)
        deadline.check()
        parser = TimedParser(text, deadline, file=world)
        top = parser.nodes()
        self.declared[world] = parser.urls
        self._files = ProtoFiles(world, parser.urls)
        try:
            for index, node in enumerate(top):
                self.roots.append(self._built(node, None, "", index, 0))
        except RecursionError:
            self.cut = "nodes are too deep within each other"

    @property
    def home(self) -> Path | None:
        """Return the folder of the installed Webots, if WEBOTS_HOME names one."""
        return self._files.home

    @cached_property
    def info(self) -> TreeNode:
        """Return the WorldInfo node, or one with defaults."""
        found = next((node for node in self.roots if node.type_name == "WorldInfo"), None)
        return found or TreeNode(
            "WorldInfo", "WorldInfo", "", self.world, 1, self.release, None, "", None
        )

    @property
    def step_s(self) -> float:
        """Return the basic time step in seconds."""
        return self.info.number("basicTimeStep") / 1000.0

    def of_type(self, *types: str) -> Iterator[TreeNode]:
        """Yield the nodes of these types."""
        return (node for node in self.nodes if node.type_name in types)

    @property
    def unread(self) -> list[TreeNode]:
        """Return the PROTO nodes whose source cannot be read."""
        return [node for node in self.nodes if node.unread]

    def may_hold_solids(self, node: TreeNode) -> bool:
        """Return whether a PROTO without source may hold solids: appearances and skies do not."""
        url = self._files.urls.get(node.written_type, "")
        return node.field_name not in _LOOKS and not _LOOKS_ONLY.search(url)

    def _built(
        self, written: WorldNode, parent: TreeNode | None, name: str, index: int | None, depth: int
    ) -> TreeNode:
        if len(self.nodes) % 256 == 0:
            self._deadline.check()
        base, unread, files = self._base_of(written)
        file = base.file or self.world
        node = TreeNode(
            base.type_name, written.type_name, written.def_name, file, base.line,
            self.releases.get(file, self.release), parent, name, index, unread, files,
            written.file or self.world, written.line,
        )  # fmt: skip
        self.nodes.append(node)
        node.field_lines = base.field_lines
        for key, value in base.fields.items():
            node.fields[key] = self._value(value, node, key, depth + 1)
        return node

    def _value(self, value: Any, node: TreeNode, name: str, depth: int) -> Any:
        if isinstance(value, WorldNode):
            return self._inner(value, node, name, None, depth)
        if not isinstance(value, list):
            return value
        items = cast("list[Any]", value)
        if not any(isinstance(each, WorldNode) for each in items):
            return items
        return [
            self._inner(each, node, name, index, depth) if isinstance(each, WorldNode) else each
            for index, each in enumerate(items)
        ]

    def _inner(
        self, value: WorldNode, node: TreeNode, name: str, index: int | None, depth: int
    ) -> TreeNode | None:
        if depth > LIMITS.depth or len(self.nodes) >= LIMITS.nodes:
            self.cut = self.cut or (
                f"nodes are more than {LIMITS.depth} deep, or PROTO nodes hold each other"
                if depth > LIMITS.depth
                else f"the scene has more than {LIMITS.nodes:,} nodes"
            )
            return None
        return self._built(value, node, name, index, depth)

    def _base_of(self, written: WorldNode) -> tuple[WorldNode, str, tuple[Path, ...]]:
        """Return the base node of a PROTO node, and why it has none."""
        node, files = written, tuple[Path, ...]()
        while node.type_name not in NODE_TYPES:
            source = self._source(node.type_name)
            if isinstance(source, str):
                return (node if node is written else written), source, files
            if source.file in files:
                return written, f"{source.file.name} is made of itself", files
            self._note_unknown(node, source)
            given = {key: deepcopy(each.default) for key, each in source.fields.items()}
            given |= {key: value for key, value in node.fields.items() if key in source.fields}
            try:
                (base,) = TimedParser(source.body, self._deadline, given, source.file).nodes()
            except (WorldFileError, ValueError) as error:
                return written, f"{source.file.name}: {error}", files
            files = (*files, source.file)
            node = base
        return node, "", files

    def _note_unknown(self, node: WorldNode, source: ProtoSource) -> None:
        """Note fields that the PROTO does not declare."""
        for name in (each for each in node.fields if each not in source.fields):
            file, line = node.file or self.world, node.field_lines.get(name, node.line)
            self.unknown_fields[file, line, name] = UnknownField(node.type_name, source)

    def _source(self, name: str) -> ProtoSource | str:
        if name not in self._sources:
            self._deadline.check()
            self._sources[name] = self._read(name)
        return self._sources[name]

    def _read(self, name: str) -> ProtoSource | str:
        file = self._files.file_of(name) or _cached(self._files.urls.get(name, ""), self.release)
        if file is None:
            url = self._files.urls.get(name)
            return "its source is not on this machine" if url else "no PROTO file of that name"
        try:
            file = file.resolve()
            text = _text_of(file, "PROTO file")
            release = release_of(text)
            if _TEMPLATE.search(text):
                return f"{file.name} is a template in a script language"
            parser = TimedParser(text, self._deadline, file=file)
            _, fields, body = parser.proto()
        except (WorldFileError, ValueError) as error:
            return f"{file.name}: {error}"
        except RecursionError:
            return f"{file.name} nests its values too deep"
        self.releases[file] = release
        self.declared[file] = parser.urls
        self._files.note(parser.urls, file.parent)
        return ProtoSource(file, fields, body)


def _text_of(file: Path, what: str) -> str:
    """Return the text of a file of Webots; other files are not opened."""
    ending = ".wbt" if what == "world" else ".proto"
    if file.suffix != ending and file.parent != _cache():
        raise WorldFileError(f"a {what} ends in {ending}")
    try:
        if not file.is_file():
            raise WorldFileError("there is no such file")
        if file.stat().st_size > LIMITS.file_bytes:
            raise WorldFileError(f"the file has more than {LIMITS.file_bytes // 1_000_000} MB")
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise WorldFileError("the file is not text in UTF-8") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise WorldFileError(f"the file cannot be read: {error}") from error


def _cache() -> Path:
    """Return the folder in which Webots keeps what it has downloaded."""
    home = Path.home()
    if sys.platform == "win32":
        local = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
        return local / "Cyberbotics" / "Webots" / "cache" / "assets"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "Cyberbotics" / "Webots" / "assets"
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return cache / "Cyberbotics" / "Webots" / "assets"


def _cached(url: str, release: Release) -> Path | None:
    """Return the copy of a PROTO that Webots has downloaded: its name is the SHA-1 of the URL."""
    if url.startswith("webots://"):
        tag = f"{release}" if release.year else "R2023b"
        url = url.replace(
            "webots://", f"https://raw.githubusercontent.com/cyberbotics/webots/{tag}/", 1
        )
    if not url.startswith("https://"):
        return None
    file = _cache() / hashlib.sha1(url.encode(), usedforsecurity=False).hexdigest()
    return file if file.is_file() else None
