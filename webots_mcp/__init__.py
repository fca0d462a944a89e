"""Flight recorder and remote control for Webots simulations.

    from webots_mcp import MCPBridge
    bridge = MCPBridge(robot)

The names are imported when first asked for, and from the standard library only: this package runs
inside a robot's controller, and its pytest plugin is loaded by every pytest run.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from webots_mcp.bridge.mcp_bridge import BridgeStats, MCPBridge
    from webots_mcp.contract import VERSION as __version__  # noqa: N811
    from webots_mcp.database.location import MemoryDatabase

__all__ = ["BridgeStats", "MCPBridge", "MemoryDatabase", "__version__"]

_HOMES = {  # the module of each name, and its name there
    "BridgeStats": ("webots_mcp.bridge.mcp_bridge", "BridgeStats"),
    "MCPBridge": ("webots_mcp.bridge.mcp_bridge", "MCPBridge"),
    "MemoryDatabase": ("webots_mcp.database.location", "MemoryDatabase"),
    "__version__": ("webots_mcp.contract", "VERSION"),
}

# A tape has to begin before `Robot()` is made, which is before any name is asked for here.
if {"WEBOTS_MCP_TAPE", "WEBOTS_INSTANCE_PATH", "WEBOTS_CONTROLLER_URL"} & os.environ.keys():
    import_module("webots_mcp.bridge.tape_start").begin_if_wanted()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, its_name = _HOMES[name]
    globals()[name] = value = getattr(import_module(module), its_name)
    return value
