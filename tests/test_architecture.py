"""Which folder may import which, as CONTRIBUTING draws it, and what the public surface is."""

from __future__ import annotations

import ast
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import webots_mcp

PACKAGE = Path(webots_mcp.__file__).parent
CONTRIBUTING = (PACKAGE.parent / "CONTRIBUTING.md").read_text("utf-8")

# The floors of the package, the highest first. A folder or file may import those below its floor.
FLOORS = """
    plugins      __main__
    cli
    server
    questions
    steering
    answers      plotting     setup        testing      lint
    judging      simulator    rerun
    store        bridge
    database     standin
    signals      worlds
    analysis     contract     errors       extras
"""
LEVEL = {part: -number for number, floor in enumerate(FLOORS.split("\n")) for part in floor.split()}
IN_A_CONTROLLER = ("bridge", "rerun", "database", "signals", "contract", "errors")
OPTIONAL_THERE = {"orjson", "numpy", "controller"}  # where they are installed, or loaded already


@cache
def imports(file: Path) -> frozenset[str]:
    """The modules that a file imports, also in functions and for types only."""
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += (f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def part_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def known_parts(file: Path) -> set[str]:
    """The folders and files of the package's root that a file imports."""
    names = (name.split(".") for name in imports(file) if name.startswith("webots_mcp."))
    return {name[1] for name in names if name[1] in LEVEL} - {part_of(file)}


FILES = [
    file
    for file in sorted(PACKAGE.rglob("*.py"))
    if file != PACKAGE / "__init__.py"
    and not file.is_relative_to(PACKAGE / "plugins" / "prove" / "project")
]


def test_every_part_stands_on_a_floor_and_the_picture_in_contributing_is_this_one() -> None:
    assert {part_of(file) for file in FILES} == LEVEL.keys()
    picture = CONTRIBUTING.partition("```text\n")[2].partition("```")[0]
    drawn = [line.split("  #")[0].split() for line in picture.splitlines()]
    assert [floor for floor in drawn if floor] == [
        f.split() for f in FLOORS.split("\n") if f.split()
    ]


@pytest.mark.slow
def test_each_file_imports_only_parts_that_stand_below_its_own() -> None:
    upwards = {
        f"{file.relative_to(PACKAGE)} imports {part}"
        for file in FILES
        for part in known_parts(file)
        if LEVEL[part] >= LEVEL[part_of(file)]
    }
    assert not upwards


def test_what_runs_in_a_controller_needs_the_standard_library_only() -> None:
    allowed = {*sys.stdlib_module_names, *OPTIONAL_THERE, "webots_mcp", "__future__"}
    for file in FILES:
        if part_of(file) in IN_A_CONTROLLER:
            foreign = {name.split(".")[0] for name in imports(file)} - allowed
            assert not foreign, file
    for file in (PACKAGE / "extras").glob("*.py"):
        assert {name.split(".")[0] for name in imports(file)} <= allowed, file


def test_only_an_observer_and_the_public_names_import_the_bridge() -> None:
    known = {
        file.relative_to(PACKAGE).as_posix() for file in FILES if "bridge" in known_parts(file)
    }
    assert known <= {
        "simulator/observer.py",
        "simulator/observed_bodies.py",
        *(name for name in known if name[:8] == "plugins/"),
    }


def test_nothing_but_plugins_knows_a_plugin_by_its_name() -> None:
    for file in FILES:
        if part_of(file) != "plugins":
            assert "plugins" not in known_parts(file), file
            assert "webots_mcp.plugins." not in file.read_text("utf-8"), file


def test_only_tests_and_plugins_import_the_stand_in() -> None:
    known = {part_of(file) for file in FILES if "standin" in known_parts(file)}
    assert known == {"plugins", "testing"}


def test_no_two_folders_import_each_other() -> None:
    graph: dict[str, set[str]] = {}
    for file in FILES:
        graph.setdefault(part_of(file), set()).update(known_parts(file))
    assert list(TopologicalSorter(graph).static_order())  # a circle raises CycleError


@pytest.mark.parametrize("part", [part for part in LEVEL if (PACKAGE / part).is_dir()])
def test_each_folder_says_what_belongs_there(part: str) -> None:
    text = ast.get_docstring(ast.parse((PACKAGE / part / "__init__.py").read_text("utf-8")))
    assert text is not None


def test_the_public_surface_is_exactly_this() -> None:
    assert webots_mcp.__all__ == ["BridgeStats", "MCPBridge", "MemoryDatabase", "__version__"]
    assert all(hasattr(webots_mcp, name) for name in webots_mcp.__all__)
