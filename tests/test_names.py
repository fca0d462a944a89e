"""A class name means one thing in the whole package."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import webots_mcp

pytestmark = pytest.mark.slow

PACKAGE = Path(webots_mcp.__file__).parent
ONCE = ("Place", "Run", "Kind", "Progress", "Report", "Frame")


def test_no_class_name_is_defined_in_two_modules() -> None:
    found = defaultdict[str, set[str]](set)
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                found[node.name].add(path.relative_to(PACKAGE).as_posix())
    twice = {name: files for name, files in found.items() if len(files) > 1}
    assert twice == {}
    assert all(len(found[name]) <= 1 for name in ONCE)


def test_no_function_is_called_look() -> None:
    named = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and node.name.strip("_") in ("look", "told", "here", "each", "there")
    ]
    assert named == []
