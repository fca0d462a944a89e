"""Reads the VRML dialect of .wbt files into a tree of nodes; knows nothing of what nodes mean."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias, cast

# What can go wrong with the stand-in, as one small tree of exceptions.
#
# StandInError
# ├── WorldError            the world file cannot be used; names the line
# ├── WouldBlockError       the call would wait for ever: the simulation is paused
# └── ControllerEndedError  the API was used after `step` had returned -1


class StandInError(Exception):
    """Anything the stand-in refuses to do."""


class WorldError(StandInError):
    """A world file that the stand-in cannot use."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message if line is None else f"line {line}: {message}")
        self.line = line


class WouldBlockError(StandInError):
    """An in-process `step` that would never return, because the simulation is paused."""


class ControllerEndedError(StandInError):
    """The API was used after `step` had returned -1.

    A controller process would end here without a word (C `exit`); in process that would end the
    whole test run, hence an exception.
    """


Value: TypeAlias = "bool | str | Node | list[float] | list[Value] | None"
"""A field as written: numbers are always a list of floats, `[...]` is a list of anything."""

_TOKEN: Final = re.compile(r'[\s,]+|#[^\n]*|(?P<token>"(?:[^"\\]|\\.)*"|[\[\]{}]|[^\s\[\]{}",#]+)')
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\Z")
_NAME: Final = re.compile(r"[A-Za-z_][^\s\"'#,.\[\]\\{}]*\Z")
_WORDS: Final[dict[str, bool | None]] = {"TRUE": True, "FALSE": False, "NULL": None}


class Token(NamedTuple):
    """A word of the file and the line it stands on."""

    text: str
    line: int


@dataclass(eq=False)
class Node:
    """A node of the scene tree; the parser fills in the fields that the file names, as `Value`s."""

    type_name: str
    def_name: str
    line: int
    fields: dict[str, Any] = field(default_factory=lambda: {})
    proto_name: str = ""
    """Of a PROTO node that was built: its own name; its type is that of what it is made of."""


def children_of(node: Node) -> Iterator[Node]:
    """The nodes in the fields of a node, in the order of the file."""
    for value in node.fields.values():
        if isinstance(value, Node):
            yield value
        elif isinstance(value, list):
            items = cast("list[Any]", value)
            yield from (item for item in items if isinstance(item, Node))


def descendants_of(node: Node) -> Iterator[Node]:
    """Everything inside a node, from the top of the file to the bottom."""
    for child in children_of(node):
        yield child
        yield from descendants_of(child)


def tokens_of(text: str) -> Iterator[Token]:
    """Split a world into words; comments, commas and white space fall away."""
    line, position = 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise WorldError(f"unexpected character {text[position]!r}", line)
        if word := match["token"]:
            yield Token(word, line)
        line += match[0].count("\n")
        position = match.end()


class Parser:
    """Recursive descent over the words of one world."""

    def __init__(self, text: str) -> None:
        self._tokens = [*tokens_of(text)]
        self._next = 0
        self._defined: dict[str, Node] = {}
        self._last_line = self._tokens[-1].line if self._tokens else 1

    def nodes(self) -> list[Node]:
        """The nodes at the top of the file, in order."""
        nodes: list[Node] = []
        while self._next < len(self._tokens):
            if not self._takes_externproto():
                line = self._tokens[self._next].line
                try:
                    nodes.append(self._node())
                except RecursionError:
                    why = "this node holds more, one in the other, than the stand-in can read"
                    raise WorldError(why, line) from None
        return nodes

    def _takes_externproto(self) -> bool:
        """Read over `EXTERNPROTO "url"`: it only says where a PROTO comes from."""
        if self._peek().text == "IMPORTABLE":
            self._take()
        if self._peek().text != "EXTERNPROTO":
            return False
        token = self._take()
        if not self._peek().text.startswith('"'):
            raise WorldError("EXTERNPROTO has no URL", token.line)
        self._take()
        return True

    def _peek(self) -> Token:
        if self._next == len(self._tokens):
            raise WorldError("the file ends in the middle of a node", self._last_line)
        return self._tokens[self._next]

    def _take(self) -> Token:
        token = self._peek()
        self._next += 1
        return token

    def _name(self, what: str) -> Token:
        token = self._take()
        if not _NAME.match(token.text):
            raise WorldError(f"expected {what}, found {token.text!r}", token.line)
        return token

    def _node(self) -> Node:
        token = self._name("a node")
        if token.text == "USE":
            return self._used()
        if token.text == "PROTO":
            raise WorldError("a world holds no PROTO definitions, they have own files", token.line)
        if token.text != "DEF":
            return self._body(token, "")
        name = self._name("a DEF name").text
        return self._body(self._name("a node type"), name)

    def _used(self) -> Node:
        token = self._name("a DEF name")
        if token.text not in self._defined:
            raise WorldError(f"USE {token.text} comes before any DEF {token.text}", token.line)
        return self._defined[token.text]

    def _body(self, type_token: Token, def_name: str) -> Node:
        node = Node(type_token.text, def_name, type_token.line)
        brace = self._take()
        if brace.text != "{":
            raise WorldError(
                f"expected {{ after {node.type_name}, found {brace.text!r}", brace.line
            )
        while self._peek().text != "}":
            token = self._name("a field name or }")
            if token.text == "hidden":  # what Webots keeps of a saved simulation
                self._value(self._take())
            else:
                node.fields[token.text] = self._value(token)
        self._take()
        if def_name:
            self._defined[def_name] = node
        return node

    def _value(self, owner: Token) -> Value:
        token = self._peek()
        if token.text == "[":
            return self._list(owner)
        if _NUMBER.match(token.text):
            return self._numbers()
        if token.text in _WORDS or token.text.startswith('"'):
            return _word(self._take())
        if token.text in "]{}":
            raise WorldError(f"field {owner.text} has no value", token.line)
        return self._node()

    def _numbers(self) -> list[float]:
        numbers: list[float] = []
        while _NUMBER.match(self._peek().text):
            numbers.append(float(self._take().text))
        return numbers

    def _list(self, owner: Token) -> list[Value] | list[float]:
        self._take()
        if _NUMBER.match(self._peek().text):
            numbers = self._numbers()
            self._close(owner)
            return numbers
        values: list[Value] = []
        while self._peek().text != "]":
            values.append(self._value(owner))
        self._close(owner)
        return values

    def _close(self, owner: Token) -> None:
        token = self._take()
        if token.text != "]":
            raise WorldError(f"field {owner.text}: expected ], found {token.text!r}", token.line)


def _word(token: Token) -> bool | str | None:
    if token.text in _WORDS:
        return _WORDS[token.text]
    return re.sub(r"\\(.)", r"\1", token.text[1:-1])


def parse(text: str) -> list[Node]:
    """Read the text of a .wbt file.

    Args:
        text: The whole file.

    Returns:
        The nodes at the top of the scene tree. A `USE` gives the very node that its `DEF` named.

    Raises:
        WorldError: The text is not a world; the message names the line.
    """
    first_line = text.partition("\n")[0]
    release = re.match(r"#VRML_SIM (R20\d\d)[ab]?\S* utf8", first_line)
    if release is None:
        raise WorldError(f'a world begins with "#VRML_SIM R2023b utf8", not {first_line[:40]!r}', 1)
    if release[1] < "R2022":
        raise WorldError(
            f"worlds of {release[1]} have other axes: open and save it with Webots R2022a or newer",
            1,
        )
    return Parser(text).nodes()


# The node types that the stand-in knows: their fields, types and default values.


_DEFINITIONS: Final = """
WorldInfo {
  MFString info []  SFString title ""  SFString window "<none>"
  SFFloat gravity 9.81  SFFloat basicTimeStep 32  SFFloat FPS 60
  SFInt32 optimalThreadCount 1  SFInt32 randomSeed 0
  SFString coordinateSystem "ENU"  SFString gpsCoordinateSystem "local"
  MFNode contactProperties []
}
ContactProperties {
  SFString material1 "default"  SFString material2 "default"
  MFFloat coulombFriction 1  SFFloat bounce 0.5
}
Viewpoint {
  SFRotation orientation 0 0 1 0  SFVec3f position -10 0 0  SFFloat fieldOfView 0.785398
}
Background { MFColor skyColor 0 0 0  SFFloat luminosity 1 }
DirectionalLight {
  SFFloat ambientIntensity 0  SFColor color 1 1 1  SFVec3f direction 0 0 -1  SFFloat intensity 1
  SFBool on TRUE
}
PointLight {
  SFFloat ambientIntensity 0  SFVec3f attenuation 1 0 0  SFColor color 1 1 1  SFFloat intensity 1
  SFVec3f location 0 0 0  SFBool on TRUE
}
SpotLight {
  SFFloat ambientIntensity 0  SFVec3f attenuation 1 0 0  SFColor color 1 1 1  SFFloat intensity 1
  SFVec3f location 0 0 10  SFVec3f direction 0 0 -1  SFFloat cutOffAngle 0.785398
  SFFloat beamWidth 1.570796  SFBool on TRUE
}
Group { MFNode children [] }
Pose { SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children [] }
Transform {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  SFVec3f scale 1 1 1  MFNode children []
}
Solid {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "solid"  SFString model ""  SFString description ""
  SFString contactMaterial "default"  SFNode boundingObject NULL  SFNode physics NULL
  SFBool locked FALSE
}
Robot {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "robot"  SFString model ""  SFString description ""
  SFString contactMaterial "default"  SFNode boundingObject NULL  SFNode physics NULL
  SFBool locked FALSE
  SFString controller "<generic>"  MFString controllerArgs []  SFString customData ""
  SFBool supervisor FALSE  SFBool synchronization TRUE  MFFloat battery []
  SFBool selfCollision FALSE  SFString window "<generic>"
}
Shape { SFNode appearance NULL  SFNode geometry NULL }
PBRAppearance {
  SFColor baseColor 1 1 1  SFFloat transparency 0  SFFloat roughness 0  SFFloat metalness 1
}
Appearance { SFNode material NULL }
Material { SFColor diffuseColor 0.8 0.8 0.8 }
Plane { SFVec2f size 1 1 }
Box { SFVec3f size 0.1 0.1 0.1 }
Cylinder { SFFloat height 0.2  SFFloat radius 0.1  SFInt32 subdivision 32 }
Capsule { SFFloat height 0.2  SFFloat radius 0.1  SFInt32 subdivision 24 }
Sphere { SFFloat radius 0.1  SFInt32 subdivision 1  SFBool ico TRUE }
Physics { SFFloat density 1000  SFFloat mass -1  MFVec3f centerOfMass [] }
HingeJoint { SFNode jointParameters NULL  MFNode device []  SFNode endPoint NULL }
HingeJointParameters { SFFloat position 0  SFVec3f axis 1 0 0  SFVec3f anchor 0 0 0 }
SliderJoint { SFNode jointParameters NULL  MFNode device []  SFNode endPoint NULL }
JointParameters { SFFloat position 0  SFVec3f axis 0 0 1 }
LinearMotor {
  SFString name "linear motor"  SFFloat acceleration -1  SFVec3f controlPID 10 0 0
  SFFloat minPosition 0  SFFloat maxPosition 0  SFFloat maxVelocity 10  SFFloat maxForce 10
  SFFloat multiplier 1
}
RotationalMotor {
  SFString name "rotational motor"  SFFloat acceleration -1  SFVec3f controlPID 10 0 0
  SFFloat minPosition 0  SFFloat maxPosition 0  SFFloat maxVelocity 10  SFFloat maxTorque 10
  SFFloat multiplier 1
}
PositionSensor { SFString name "position sensor"  SFFloat noise 0  SFFloat resolution -1 }
DistanceSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "distance sensor"  SFString model ""
  MFVec3f lookupTable [0 0 0 0.1 1000 0]
  SFString type "generic"  SFInt32 numberOfRays 1  SFFloat aperture 1.5708
}
Camera {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "camera"  SFString model ""
  SFFloat fieldOfView 0.7854  SFInt32 width 64  SFInt32 height 64  SFFloat near 0.01
  SFNode zoom NULL
}
Zoom { SFFloat maxFieldOfView 1.5  SFFloat minFieldOfView 0.5 }
Accelerometer {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "accelerometer"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
Compass {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "compass"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
Gyro {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "gyro"  SFString model ""  MFVec3f lookupTable []
  SFBool xAxis TRUE  SFBool yAxis TRUE  SFBool zAxis TRUE  SFFloat resolution -1
}
LED {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "led"  SFString model ""  MFColor color [1 0 0]  SFBool gradual FALSE
}
LightSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "light sensor"  SFString model ""  MFVec3f lookupTable [0 0 0 1 1000 0]
  SFColor colorFilter 1 1 1  SFBool occlusion FALSE  SFFloat resolution -1
}
TouchSensor {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "touch sensor"  SFString model ""  SFNode boundingObject NULL
  SFNode physics NULL  SFString type "bumper"  MFVec3f lookupTable [0 0 0 5000 50000 0]
  SFFloat resolution -1
}
GPS {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "gps"  SFString model ""  SFString type "satellite"  SFFloat accuracy 0
}
InertialUnit {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "inertial unit"  SFString model ""  SFFloat noise 0
}
Emitter {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "emitter"  SFString model ""  SFString type "radio"
  SFFloat range -1  SFFloat maxRange -1  SFFloat aperture -1  SFInt32 channel 0
  SFInt32 baudRate -1  SFInt32 byteSize 8  SFInt32 bufferSize -1
}
Receiver {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "receiver"  SFString model ""  SFString type "radio"
  SFFloat aperture -1  SFInt32 channel 0  SFInt32 baudRate -1  SFInt32 byteSize 8
  SFInt32 bufferSize -1  SFFloat signalStrengthNoise 0  SFFloat directionNoise 0
}
Lidar {
  SFVec3f translation 0 0 0  SFRotation rotation 0 0 1 0  MFNode children []
  SFString name "lidar"  SFString model ""
  SFInt32 horizontalResolution 512  SFFloat fieldOfView 1.5708  SFFloat verticalFieldOfView 0.2
  SFInt32 numberOfLayers 4  SFFloat near 0.01  SFFloat minRange 0.01  SFFloat maxRange 1
  SFString type "fixed"  SFFloat defaultFrequency 10
  SFFloat minFrequency 1  SFFloat maxFrequency 25
}
"""

NUMBERS_IN: Final = {"Vec2f": 2, "Vec3f": 3, "Color": 3, "Rotation": 4}
"""How many numbers make one value of a type; all other types take one."""


@dataclass(frozen=True)
class FieldDefinition:
    """What a node type says about one of its fields."""

    type_name: str
    """`SFVec3f`, `MFNode` and so on."""
    default: Value
    """As the parser would have read it from a file."""


def definitions_in(text: str) -> dict[str, dict[str, FieldDefinition]]:
    """Fields by node type, from a text as Webots writes its node files, without comments."""
    words = [token.text for token in tokens_of(text)]
    known: dict[str, dict[str, FieldDefinition]] = {}
    start = 0
    while start < len(words):
        end = words.index("}", start)
        known[words[start]] = dict(_fields(words[start + 2 : end]))
        start = end + 1
    return known


def _fields(words: list[str]) -> list[tuple[str, FieldDefinition]]:
    starts = [i for i, word in enumerate(words) if word[:2] in ("SF", "MF")]
    return [
        (words[start + 1], FieldDefinition(words[start], _default(words[start + 2 : end])))
        for start, end in zip(starts, [*starts[1:], len(words)], strict=True)
    ]


def _default(words: list[str]) -> Value:
    if words[0] in ("TRUE", "FALSE"):
        return words[0] == "TRUE"
    if words[0] == "NULL":
        return None
    if words[0].startswith('"'):
        return words[0][1:-1]
    return [float(word) for word in words if word not in "[]"]


NODE_TYPES: Final = definitions_in(_DEFINITIONS)
"""Fields by node type."""

DEFAULT_NAME_OF: Final = {
    **{"Altimeter": "altimeter", "Brake": "brake", "Connector": "connector"},
    **{"Display": "display", "Pen": "pen"},
    **{"Radar": "radar", "RangeFinder": "range-finder", "Skin": "skin"},
    **{"Speaker": "speaker", "VacuumGripper": "vacuum gripper"},
}
"""What devices that the stand-in does not have are called, unless the world gives them a name."""


# From fields as they are written to values of the types that a node's type asks for.


def give_types(node: Node, definitions: Mapping[str, FieldDefinition]) -> None:
    """Give a node all fields that its type has, with values of their types.

    Raises:
        WorldError: A value is of another type; names the field and the line.
    """
    written = node.fields
    node.fields = {}
    for name, definition in definitions.items():
        value = written[name] if name in written else deepcopy(definition.default)
        node.fields[name] = _typed(value, name, definition, node)


def _typed(value: Value, name: str, definition: FieldDefinition, node: Node) -> Value:
    many, kind = definition.type_name[:2] == "MF", definition.type_name[2:]
    try:
        if not many:
            return _single(value, kind)
        if kind in ("String", "Node"):
            values: list[Any] = value if isinstance(value, list) else [value]
            return [_single(item, kind) for item in values]
        return _several_numbers(value, kind)
    except (TypeError, ValueError):
        raise WorldError(
            f"{node.type_name}.{name} has to be {definition.type_name}, not {_shown(value)}",
            node.line,
        ) from None


def _single(value: Value, kind: str) -> Any:
    if kind in ("Bool", "String", "Node"):
        expected = {"Bool": bool, "String": str, "Node": (Node, type(None))}[kind]
        if not isinstance(value, expected):
            raise TypeError(kind)
        return value
    numbers = _numbers(value)
    if len(numbers) != NUMBERS_IN.get(kind, 1):
        raise ValueError(kind)
    if kind in NUMBERS_IN:
        return numbers
    return int(numbers[0]) if kind == "Int32" else numbers[0]


def _several_numbers(value: Value, kind: str) -> Value:
    numbers = _numbers(value)
    size = NUMBERS_IN.get(kind, 1)
    if len(numbers) % size:
        raise ValueError(kind)
    if size == 1:
        return numbers
    return [numbers[i : i + size] for i in range(0, len(numbers), size)]


def _numbers(value: Value) -> list[float]:
    if not isinstance(value, list) or not all(isinstance(item, float) for item in value):
        raise TypeError("numbers")
    return [*cast("list[float]", value)]


def _shown(value: Value) -> str:
    return f"a {value.type_name} node" if isinstance(value, Node) else repr(value)
