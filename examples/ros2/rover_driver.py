"""A plugin of `webots_ros2_driver` that records a robot and takes commands from an assistant.

The driver makes an object of this class, calls `init` once and `step` at each time step of the
simulation. What ROS 2 asks of the robot, here the velocities of `/cmd_vel`, is recorded beside what
its devices say, so that both can be asked for together.
"""

# pyright: basic, reportMissingImports=false

from typing import Any

import rclpy
from geometry_msgs.msg import Twist

from webots_mcp import MCPBridge


class RoverDriver:
    """Records what the devices say and what was asked of the robot."""

    def init(self, webots_node: Any, properties: dict[str, Any]) -> None:
        self.asked = {"ahead_mps": 0.0, "turn_radps": 0.0}
        self.bridge = MCPBridge(webots_node.robot)
        self.bridge.register_command("set_velocity", self.set_velocity)
        rclpy.init(args=None)
        self.node: Any = rclpy.create_node("webots_mcp")
        self.publisher: Any = self.node.create_publisher(Twist, "cmd_vel", 1)
        self.node.create_subscription(Twist, "cmd_vel", self.on_velocity, 1)

    def on_velocity(self, message: Any) -> None:
        self.asked = {"ahead_mps": message.linear.x, "turn_radps": message.angular.z}

    def set_velocity(self, command: dict[str, Any]) -> dict[str, float]:
        """Publish a velocity on /cmd_vel: `ahead` in m/s and `turn` in rad/s."""
        message: Any = Twist()
        message.linear.x = float(command["ahead"])
        message.angular.z = float(command.get("turn", 0.0))
        self.publisher.publish(message)
        return {"ahead_mps": message.linear.x, "turn_radps": message.angular.z}

    def step(self) -> None:
        rclpy.spin_once(self.node, timeout_sec=0)
        self.bridge.auto_publish({"asked": self.asked})
        self.bridge.get_command()
