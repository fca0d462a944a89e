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
    "transactions": set[str](),
    "schema": {"contract", "errors", "transactions"},
    "connection": {"contract", "errors", "schema", "transactions"},
    "liveness": {"contract", "queue", "waiting_file"},
    "queue": {"contract", "errors", "transactions"},
    "naming": set[str](),
    "conditions": {"conditions", "errors", "naming"},
    "parameter": {"errors", "naming"},
    "entries": {"queue"},
    "waiting_file": {"entries", "errors", "transactions"},
    "maintenance": {"connection", "errors", "schema", "transactions", "waiting_file"},
    "standin": {"standin", "contract"},
    "webots": {"connection", "contract", "errors", "liveness", "webots"},
}
ALLOWED["setup"] = {"contract", "errors", "setup", "webots", "__version__"}
ENTRIES = {
    "conditions",
    "maintenance",
    "naming",
    "parameter",
    "liveness",
    "queue",
}
STDLIB = {
    *ENTRIES,
    *ALLOWED["maintenance"],
    *ALLOWED["liveness"],
    *ALLOWED["waiting_file"],
}
ALLOWED["bridge"] = STDLIB | {"bridge", "__version__"}
ALLOWED["observer"] = STDLIB | {"bridge", "observer"}
ALLOWED["store"] = STDLIB | {"store"}
ALLOWED["pool"] = STDLIB | {"store", "pool"}
ALLOWED["trials"] = STDLIB | {"pool", "store", "trials", "webots", "__version__"}
ALLOWED["diagnosis"] = STDLIB | {"store", "diagnosis", "setup", "webots"}
ALLOWED["launch"] = STDLIB | {"console", "store", "setup", "webots"}
ALLOWED["plotting"] = STDLIB | {"store", "plotting"}
ALLOWED["charts"] = ALLOWED["plotting"] | {"charts", "plotting", "standin"}
ALLOWED["report"] = ALLOWED["charts"] | {"charts", "report", "__version__"}
ALLOWED["console"] = STDLIB | {"console", "store", "webots"}
ALLOWED["server"] = STDLIB | {
    "console", "store", "plotting", "diagnosis", "trials", "server", "webots",
    "launch", "questions", "report", "__version__",
}  # fmt: skip
ALLOWED["questions"] = ALLOWED["server"]
ALLOWED["page"] = ALLOWED["server"] | ALLOWED["charts"] | {"page"}
ALLOWED["testing"] = STDLIB | {"store", "standin", "testing"}
ALLOWED["pytest_plugin"] = {
    "connection",
    "contract",
    "standin",
    "testing",
    "MCPBridge",
    "MemoryDatabase",
}


def imports(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "webots_mcp":
            yield from (f"webots_mcp.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


@pytest.mark.parametrize("part", ALLOWED)
def test_each_part_imports_only_what_stands_below_it(part: str) -> None:
    files = [PACKAGE / f"{part}.py"] if (PACKAGE / f"{part}.py").exists() else []
    files += (PACKAGE / part).rglob("*.py")
    assert files
    for file in files:
        ours = {name.split(".")[1] for name in imports(file) if name.startswith("webots_mcp.")}
        assert ours <= ALLOWED[part], f"{file.name} imports {ours - ALLOWED[part]}"


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
