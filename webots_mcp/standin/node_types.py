"""The node types that the stand-in knows."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from webots_mcp.worlds.vrml import Parser

DATA: Final = Path(__file__).with_name("data")
"""Folder of the node types and the built-in PROTO nodes."""
NODE_TYPES: Final = Parser((DATA / "nodes.txt").read_text(encoding="utf-8")).types()
"""Definitions of fields by node type."""
