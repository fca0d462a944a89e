"""Flight recorder and remote control for Webots simulations.

    from webots_mcp import MCPBridge
    bridge = MCPBridge(robot)

The names are imported when first asked for, and from the standard library only: this package runs
inside a robot's controller, and its pytest plugin is loaded by every pytest run.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from webots_mcp.bridge.mcp_bridge import MCPBridge
    from webots_mcp.bridge.stats import BridgeStats
    from webots_mcp.contract import MemoryDatabase

__version__ = "0.1.0"
__all__ = ["BridgeStats", "MCPBridge", "MemoryDatabase", "__version__"]


def __getattr__(name: str) -> Any:
    if name == "MCPBridge":
        from webots_mcp.bridge import mcp_bridge as home
    elif name == "BridgeStats":
        from webots_mcp.bridge import stats as home
    elif name == "MemoryDatabase":
        from webots_mcp import contract as home
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(home, name)
    return value
