"""Adding the two lines of the bridge to a controller, and removing them again.

The syntax tree of a controller says where the lines belong; the bytes of the file stay as they are
everywhere else. What cannot be determined for certain is refused. Each result is checked before it
is returned: its tree is that of the original with the two statements added, so nothing else has
changed its meaning.
"""

from __future__ import annotations

import ast
import re
import tokenize
import warnings
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from webots_mcp.errors import InvalidInputError

IMPORT: Final = "from webots_mcp import MCPBridge"
_BRIDGE: Final = "MCPBridge"
# Classes of robots by the package that they are of; those of deepbots are Webots' Supervisor, too.
_ROBOTS: Final = {
    "controller": ("Robot", "Supervisor"),
    "vehicle": ("Driver", "Car"),
    "deepbots": (
        "DeepbotsSupervisorEnv", "RobotSupervisorEnv", "EmitterReceiverSupervisorEnv",
        "CSVSupervisorEnv", "EmitterReceiverRobot", "CSVRobot",
    ),
}  # fmt: skip
_MOST_MODULES: Final = 50
_ADDED: Final = re.compile(
    rb"\s*(?:from webots_mcp import MCPBridge|MCPBridge\.attach\([^()]+\))\s*"
)
_Function: TypeAlias = ast.FunctionDef | ast.AsyncFunctionDef


class AlreadyPatchedError(InvalidInputError):
    """The controller makes a bridge."""


class _NoRobotError(InvalidInputError):
    """The module makes no robot; one that it imports may."""


class AttachingPlace(NamedTuple):
    """Where the robot of a controller is attached.

    Attributes:
        file: The controller's own, or that of a module in its folder.
        line: After which the statement belongs.
        statement: What attaches it.
    """

    file: Path
    line: int
    statement: str


class _InsertionPoint(NamedTuple):
    """The statement after which the robot is attached, what attaches it, and the import's."""

    after: ast.stmt
    attach: str
    imported: ast.stmt


def attaching_place(controller: Path) -> AttachingPlace:
    """Return where a robot is attached: in the controller's file, or in a module that it imports.

    Modules are searched for in the controller's folder, as Python does first.

    Raises:
        AlreadyPatchedError: It, or another of the kind, is there.
        InvalidInputError: It cannot be determined for certain; the message says why.
        OSError: A file cannot be read.
    """
    why: InvalidInputError | None = None
    found = list[AttachingPlace]()
    files = [controller]
    for file in files:
        try:
            module = _parsed(file.read_bytes())
            files += [each for each in _imported(module, file, controller) if each not in files]
            del files[_MOST_MODULES:]
            place = _place(module)
        except _NoRobotError as error:
            why = why or error
        except InvalidInputError as error:
            if file == controller:
                raise
            raise type(error)(f"{file.name}, which it imports: {error}") from error
        else:
            line = place.after.end_lineno or place.after.lineno
            found.append(AttachingPlace(file, line, place.attach))
        if file == controller and found:
            return found[0]
    if len(found) == 1:
        return found[0]
    if found:
        places = ", ".join(f"{each.file.name} line {each.line}" for each in found)
        raise InvalidInputError(f"several of its modules make a robot: {places}")
    assert why is not None
    raise why


def is_plain_robot(controller: Path) -> bool:
    """Return whether a controller makes a Robot and no Supervisor, as far as it can be read."""
    made = set[str]()
    files = [controller]
    for file in files:
        try:
            module = _parsed(file.read_bytes())
        except (InvalidInputError, OSError):
            return False
        files += [each for each in _imported(module, file, controller) if each not in files]
        del files[_MOST_MODULES:]
        made |= _classes_used(list(ast.walk(module)))
    return made == {"Robot"}  # the class without a supervisor's calls


def _classes_used(nodes: list[ast.AST]) -> set[str]:
    """Webots' names of the classes that a module calls or derives its own from."""
    called = dict[str, str]()
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and not node.level:
            for robot in _robots_of(node.module or ""):
                names = [a.asname or a.name for a in node.names if a.name == robot]
                names += [robot for a in node.names if a.name == "*"]
                called.update(dict.fromkeys(names, robot))
        elif isinstance(node, ast.Import):
            for alias in node.names:
                for robot in _robots_of(alias.name):
                    called[f"{alias.asname or alias.name}.{robot}"] = robot
    used = [node.func for node in nodes if isinstance(node, ast.Call)]
    used += [base for node in nodes if isinstance(node, ast.ClassDef) for base in node.bases]
    return {called[name] for name in map(_dotted, used) if name in called}


def _imported(module: ast.Module, file: Path, controller: Path) -> list[Path]:
    """Return the files in the controller's folder that a module imports."""
    names = list[tuple[Path, str]]()
    for node in ast.walk(module):
        if isinstance(node, ast.Import):
            names += [(controller.parent, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            folder = file.parents[node.level - 1] if node.level else controller.parent
            modules = [f"{node.module or ''}.{alias.name}".strip(".") for alias in node.names]
            names += [(folder, name) for name in (node.module or "", *modules)]
    paths = [folder.joinpath(*n.split(".")) for folder, n in names if n and not _robots_of(n)]
    files = [each for path in paths for each in (path.with_suffix(".py"), path / "__init__.py")]
    return [each for each in dict.fromkeys(files) if each.is_file()]


def patch(source: bytes) -> bytes:
    """Return the controller with the bridge's lines.

    Raises:
        AlreadyPatchedError: They, or others of the kind, are there.
        InvalidInputError: It cannot be determined for certain where they belong.
    """
    module = _parsed(source)
    place = _place(module)
    lines = _split(source)
    first = (line.rstrip(b"\r\n") + b"\n" for line in lines)
    encoding = tokenize.detect_encoding(first.__next__)[0]
    try:
        attach = _indented(lines, place, encoding)
    except UnicodeError as error:
        raise InvalidInputError(f"it is not all {encoding}: {error}") from error
    added = [(place.after, attach), (place.imported, IMPORT.encode())]
    for statement, line in sorted(added, key=lambda each: each[0].lineno, reverse=True):
        _insert(lines, statement.end_lineno or statement.lineno, line)
    patched = b"".join(lines)
    if not _is_proven(module, patched, place.attach):
        raise InvalidInputError("the lines cannot be put in without changing others: write them")
    return patched


def unpatch(source: bytes) -> bytes:
    """Return the controller as it was before `patch`, to the byte; later changes elsewhere stay.

    Raises:
        InvalidInputError: The lines are not there, or not as `patch` writes them.
    """
    lines = _split(source)
    places = [number for number, line in enumerate(lines) if _ADDED.fullmatch(line)]
    for place in reversed(places):
        if not lines[place].endswith((b"\r", b"\n")):
            lines[place - 1] = lines[place - 1].rstrip(b"\r\n")
        del lines[place]
    before = b"".join(lines)
    try:
        is_undone = patch(before) == source
    except InvalidInputError:
        is_undone = False
    if not is_undone:
        raise InvalidInputError(
            "the lines of the bridge are not there as --patch writes them: take them out by hand"
        )
    return before


def _parsed(source: bytes) -> ast.Module:
    try:
        with warnings.catch_warnings():  # about the user's own strings, as "\\d"
            warnings.simplefilter("ignore")
            return ast.parse(source)
    except SyntaxError as error:
        place = f" (line {error.lineno})" if error.lineno else ""
        raise InvalidInputError(f"it is no Python that can be read: {error.msg}{place}") from error
    except (ValueError, RecursionError, MemoryError) as error:
        raise InvalidInputError(f"it is no Python that can be read: {error}") from error


def _place(module: ast.Module) -> _InsertionPoint:
    """Find where the robot is attached: after its constructor, or after an assignment."""
    nodes = list(ast.walk(module))
    _refuse_bridge(nodes)
    imports = [
        (statement, names)
        for statement in module.body
        if not isinstance(statement, (_Function, ast.ClassDef))
        for node in ast.walk(statement)
        if (names := _robots_imported(node))
    ]
    if not imports:
        raise _NoRobotError(
            "it does not import Robot or Supervisor of the module controller at its top: "
            "where another module makes the robot, write the lines there"
        )
    classes = set[str]().union(*(names for _, names in imports))  # names, also dotted
    own = _subclasses(nodes, classes)
    _refuse_rebound(nodes, classes, own)
    made = [
        node
        for node in nodes
        if isinstance(node, ast.Call) and _dotted(node.func) in classes | own.keys()
    ]
    if len(made) > 1:
        lines = ", ".join(str(node.lineno) for node in made)
        raise InvalidInputError(f"it makes a robot in several places (lines {lines})")
    if made:
        after, attach = _in_constructor(own, _dotted(made[0].func)) or _assigned(nodes, made[0])
    else:
        after, attach = _in_class(own)
    imported = imports[0][0]
    if imported.lineno <= after.lineno <= (imported.end_lineno or 0):
        raise InvalidInputError(
            f"the module controller is imported inside the block of line {imported.lineno}"
        )
    return _InsertionPoint(after, f"{_BRIDGE}.attach({attach})", imported)


def _refuse_bridge(nodes: list[ast.AST]) -> None:
    for node in nodes:
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if any(name.partition(".")[0] == "webots_mcp" for name in modules):
            raise AlreadyPatchedError(f"it has webots_mcp already, in line {_line_of(node)}")
        if _BRIDGE in _bound(node) or (isinstance(node, ast.Name) and node.id == _BRIDGE):
            raise InvalidInputError(
                f"it has another {_BRIDGE}, in line {_line_of(node)}: write the lines by hand"
            )


def _line_of(node: ast.AST) -> int:
    return getattr(node, "lineno", 1)


def _bound(node: ast.AST) -> list[str]:
    """Return the names that a node binds."""
    if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
        return [node.name]
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return [(alias.asname or alias.name).partition(".")[0] for alias in node.names]
    if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
        return [node.id]
    return [node.arg] if isinstance(node, ast.arg) else []


def _robots_imported(node: ast.AST) -> set[str]:
    """Return what a statement calls Webots' classes."""
    if isinstance(node, ast.ImportFrom) and not node.level:
        robots = _robots_of(node.module or "")
        return {
            name
            for alias in node.names
            for name in (robots if alias.name == "*" else (alias.asname or alias.name,))
            if alias.name in ("*", *robots)
        }
    if isinstance(node, ast.Import):
        modules = [(alias.asname or alias.name, alias.name) for alias in node.names]
        return {f"{name}.{robot}" for name, module in modules for robot in _robots_of(module)}
    return set()


def _robots_of(module: str) -> tuple[str, ...]:
    return _ROBOTS.get(module.partition(".")[0], ())


def _subclasses(nodes: list[ast.AST], classes: set[str]) -> dict[str, ast.ClassDef]:
    """Return the module's own classes of robots, by name."""
    own: dict[str, ast.ClassDef] = {}
    for node in nodes:
        if isinstance(node, ast.ClassDef) and any(
            _dotted(base) in classes | own.keys() for base in node.bases
        ):
            if node.name in own:
                raise InvalidInputError(f"there are two classes {node.name!r}")
            own[node.name] = node
    return own


def _refuse_rebound(nodes: list[ast.AST], classes: set[str], own: dict[str, ast.ClassDef]) -> None:
    names = {name.partition(".")[0] for name in classes} | own.keys()
    for node in nodes:
        if _robots_imported(node) or node in own.values():
            continue
        if again := names.intersection(_bound(node)):
            raise InvalidInputError(
                f"the name {again.pop()!r} means something else too (line {_line_of(node)})"
            )


def _in_class(own: dict[str, ast.ClassDef]) -> tuple[ast.stmt, str]:
    """Return the same of the only class of a robot, which another module makes."""
    bases = {_dotted(base) for cls in own.values() for base in cls.bases}
    last = [name for name in own if name not in bases]
    if not last:
        raise _NoRobotError("it makes no Robot() and no Supervisor()")
    if len(last) > 1:
        lines = ", ".join(str(own[name].lineno) for name in last)
        raise InvalidInputError(f"it has several classes of robots (lines {lines})")
    if (place := _in_constructor(own, last[0])) is None:
        raise InvalidInputError(
            f"the class {last[0]} in line {own[last[0]].lineno} has no constructor: attach the "
            "robot where it is made"
        )
    return place


def _in_constructor(own: dict[str, ast.ClassDef], name: str | None) -> tuple[ast.stmt, str] | None:
    """`super().__init__()` of the robot's own class, where it has a constructor, and its self."""
    name = name or ""
    while cls := own.get(name):
        bases = [_dotted(base) for base in cls.bases]
        for statement in cls.body:
            if isinstance(statement, _Function) and statement.name == "__init__":
                parameters = [*statement.args.posonlyargs, *statement.args.args]
                calls = [each for each in statement.body if _calls_super(each, bases)]
                if len(calls) != 1 or not parameters:
                    raise InvalidInputError(
                        f"the constructor in line {statement.lineno} does not call "
                        "super().__init__() as a statement of its own, once"
                    )
                return calls[0], parameters[0].arg
        name = next((base for base in bases if base in own), "") or ""
    return None


def _calls_super(statement: ast.stmt, bases: list[str | None]) -> bool:
    """`super().__init__(...)`, `super(C, self).__init__(...)` or `Robot.__init__(self, ...)`."""
    call = statement.value if isinstance(statement, ast.Expr) else None
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)):
        return False
    owner = call.func.value
    is_super = isinstance(owner, ast.Call) and _dotted(owner.func) == "super"
    return call.func.attr == "__init__" and (is_super or _dotted(owner) in bases)


def _assigned(nodes: list[ast.AST], made: ast.Call) -> tuple[ast.stmt, str]:
    """Return the statement that assigns the robot to a name, and that name."""
    for node in nodes:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is made:
            break
    else:
        raise InvalidInputError(
            f"the robot made in line {made.lineno} is not assigned to a name by itself"
        )
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [name for name in map(_dotted, targets) if name]
    if not names:
        raise InvalidInputError(f"line {made.lineno} assigns the robot to no plain name")
    if any(isinstance(each, (ast.For, ast.While)) and node in ast.walk(each) for each in nodes):
        raise InvalidInputError(f"line {node.lineno} makes the robot within a loop")
    return node, names[0]


def _dotted(node: ast.AST) -> str | None:
    """`a.b.c` of a name or of attributes of one."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (above := _dotted(node.value)):
        return f"{above}.{node.attr}"
    return None


def _split(source: bytes) -> list[bytes]:
    """Lines as Python counts them, with their ends."""
    return [line for line in re.findall(rb"[^\r\n]*(?:\r\n|\r|\n|\Z)", source) if line]


def _insert(lines: list[bytes], after: int, line: bytes) -> None:
    """Put in a line that ends as the one before it."""
    before = lines[after - 1]
    ending = before[len(before.rstrip(b"\r\n")) :]
    if not ending:  # the file ends without one, and does so afterwards
        first = lines[0]
        lines[after - 1] = before + (first[len(first.rstrip(b"\r\n")) :] or b"\n")
    lines.insert(after, line + ending)


def _indented(lines: list[bytes], place: _InsertionPoint, encoding: str) -> bytes:
    """Return what attaches the robot, indented as the statement before it.

    Raises:
        InvalidInputError: That statement shares its lines with others.
        UnicodeError: The file is not in its encoding.
    """
    statement = place.after

    def utf_8(number: int) -> bytes:  # in which a syntax tree counts columns
        return lines[number - 1].decode(encoding).encode()

    last = utf_8(statement.end_lineno or statement.lineno)[statement.end_col_offset :].strip()
    indent = utf_8(statement.lineno)[: statement.col_offset]
    if indent.strip() or (last and not last.startswith(b"#")):
        raise InvalidInputError(
            f"line {statement.lineno} holds other statements too: give the robot one of its own"
        )
    return indent + place.attach.encode(encoding.removesuffix("-sig"))


def _is_proven(before: ast.Module, patched: bytes, attach: str) -> bool:
    """Return whether nothing but the two statements is new."""

    class Without(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> Any:
            is_ours = isinstance(node, ast.stmt) and ast.unparse(node) in (IMPORT, attach)
            return None if is_ours else self.generic_visit(node)

    try:
        return ast.dump(Without().visit(_parsed(patched))) == ast.dump(before)
    except (InvalidInputError, RecursionError):
        return False
