"""Who may import whom, and what the public surface is."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import webots_mcp

PACKAGE = Path(webots_mcp.__file__).parent

# Part of the package: the parts that it may import. Everything below the line of `connection` is
# standard library only, because it runs inside a robot's controller.
ALLOWED = {
    "contract": {"errors"},
    "errors": set[str](),
    "access_token": {"contract", "errors"},
    "http_server": {"access_token", "errors", "http_limits"},
    "http_limits": set[str](),
    "connection": {"contract", "errors"},
    "liveness": {"connection", "contract", "errors", "queue", "waiting_file"},
    "queue": {"connection", "contract", "errors"},
    "requirements": set[str](),
    "pauses": {"conditions", "connection", "contract", "errors"},
    "naming": set[str](),
    "signal_register": {"naming"},
    "conditions": {"conditions", "errors", "naming"},
    "parameter": {"errors", "naming"},
    "stacks": set[str](),
    "waiting_file": {"connection", "errors", "queue", "stacks"},
    "maintenance": {"connection", "contract", "errors", "liveness", "waiting_file"},
    "standin": {"standin", "contract"},
    "webots": {"connection", "contract", "errors", "liveness", "webots"},
}
ALLOWED["setup"] = {"contract", "errors", "requirements", "setup", "webots", "__version__"}
STDLIB = {
    "conditions",
    "connection",
    "contract",
    "errors",
    "liveness",
    "maintenance",
    "naming",
    "parameter",
    "pauses",
    "queue",
    "signal_register",
    "stacks",
    "waiting_file",
}
ALLOWED["bridge"] = STDLIB | {"bridge", "__version__"}
ALLOWED["observer"] = STDLIB | {"bridge", "observer"}
ALLOWED["store"] = STDLIB | {"plugins", "requirements", "store", "__version__"}
ALLOWED["diagnosis"] = STDLIB | {"requirements", "store", "diagnosis", "setup", "webots"}
ALLOWED["diagnosis"] |= {"__version__"}
ALLOWED["launch"] = STDLIB | {"console", "store", "setup", "webots"}
ALLOWED["plotting"] = STDLIB | {"store", "plotting"}
ALLOWED["console"] = STDLIB | {"console", "store", "webots"}
ALLOWED["server"] = STDLIB | {
    "console", "store", "plotting", "diagnosis", "server", "webots",
    "launch", "plugins", "questions", "__version__",
}  # fmt: skip
ALLOWED["server"] |= {"requirements", "steering"}
ALLOWED["questions"] = ALLOWED["steering"] = ALLOWED["server"] - {"server"}
ALLOWED["cli"] = ALLOWED["server"] | {"cli", "observer", "setup"} | {"access_token", "http_server"}
ON_ALL = ALLOWED["cli"]
ALLOWED["plugins"] = set[str]()
ALLOWED["plugins.cluster"] = ALLOWED["steering"] | {"plugins.cluster", "plugins.pool"}
ALLOWED["plugins.demo"] = ON_ALL | {"standin", "plugins.demo"}
ALLOWED["plugins.formats"] = ALLOWED["store"] | {"plugins.formats"}
ALLOWED["plugins.pool"] = ALLOWED["store"] | {"cli", "plugins.pool"}
ALLOWED["plugins.prove"] = ON_ALL | {"MCPBridge", "standin", "plugins.prove"}
ALLOWED["plugins.report"] = ON_ALL | {"standin", "plugins.report"}
ALLOWED["plugins.page"] = ALLOWED["plugins.report"] | {"plugins.page"}
ALLOWED["testing"] = STDLIB | {"store", "standin", "testing"}
ALLOWED["pytest_plugin"] = {
    "connection",
    "contract",
    "standin",
    "testing",
    "MCPBridge",
    "MemoryDatabase",
}


# The parts that stand in a folder of their own: each is a part, and so is the folder's `__init__`.
PLUGINS = PACKAGE / "plugins"


def imports(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module in (
            "webots_mcp",
            "webots_mcp.plugins",
        ):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def part_of(name: str) -> str:
    _, part, *rest = name.split(".")
    in_plugin = part == "plugins" and rest and (PLUGINS / rest[0]).is_dir()
    return f"plugins.{rest[0]}" if in_plugin else part


def files_of(part: str) -> list[Path]:
    place = PACKAGE.joinpath(*part.split("."))
    if place == PLUGINS:
        return [PLUGINS / "__init__.py"]
    return [place.with_suffix(".py")] if not place.is_dir() else [*place.rglob("*.py")]


@pytest.mark.parametrize("part", ALLOWED)
def test_each_part_imports_only_what_stands_below_it(part: str) -> None:
    for file in files_of(part):
        ours = {part_of(name) for name in imports(file) if name.startswith("webots_mcp.")}
        assert ours <= ALLOWED[part], f"{file.name} imports {ours - ALLOWED[part]}"


def test_nothing_but_plugins_knows_a_plugin_by_its_name() -> None:
    names = [each.name for each in PLUGINS.iterdir() if (each / "__init__.py").exists()]
    assert all(f"plugins.{name}" in ALLOWED for name in names)
    for file in PACKAGE.rglob("*.py"):
        if not file.is_relative_to(PLUGINS):
            known = {part_of(n) for n in imports(file) if n.startswith("webots_mcp.plugins")}
            assert known <= {"plugins"}, f"{file.relative_to(PACKAGE)} imports {known}"
            assert "webots_mcp.plugins." not in file.read_text("utf-8"), file


def test_only_what_needs_a_simulator_in_this_process_imports_the_stand_in() -> None:
    above = (PACKAGE / "standin", PACKAGE / "testing.py", PACKAGE / "pytest_plugin.py", PLUGINS)
    for file in PACKAGE.rglob("*.py"):
        if not any(file.is_relative_to(each) for each in above):
            assert "standin" not in {part_of(n) for n in imports(file) if "webots_mcp." in n}, file


def test_the_public_surface_is_exactly_this() -> None:
    assert webots_mcp.__all__ == ["BridgeStats", "MCPBridge", "MemoryDatabase", "__version__"]


@pytest.mark.parametrize(
    ("room", "above"),
    [
        ("analysis", ("signals", "reading", "detection", "questions")),
        ("signals", ("detection", "questions")),
        ("reading", ("detection", "questions")),
        ("detection", ("questions",)),
    ],
)
def test_a_room_of_the_store_knows_nothing_of_those_above_it(
    room: str, above: tuple[str, ...]
) -> None:
    for file in (PACKAGE / "store" / room).glob("*.py"):
        known = {name for name in imports(file) if name.startswith("webots_mcp.store.")}
        beside = [name for name in known if name.split(".")[2] in above]
        assert not beside, f"{file.name} imports {beside}"
