"""Flight recorder and remote control for Webots simulations.

    from webots_mcp import MCPBridge
    bridge = MCPBridge(robot)

Importing this package imports the standard library only: it runs inside a robot's controller.
"""

from webots_mcp.bridge.mcp_bridge import BridgeStats, MCPBridge
from webots_mcp.contract import MemoryDatabase

__version__ = "0.1.0"
__all__ = ["BridgeStats", "MCPBridge", "MemoryDatabase", "__version__"]
