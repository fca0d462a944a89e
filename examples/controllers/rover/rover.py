"""A rover that wanders about the arena, records what it does and takes commands.

The bridge is in seven places: it is made, parameters are declared, commands are registered, and
the loop asks whether the world was reset, publishes, asks for commands and now and then saves a
picture. All else is an ordinary Webots controller.
"""

from math import hypot, inf, pi
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

WHEEL_RADIUS_M = 0.04
MAX_SPEED_RADPS = 10.0
FREE_M = 0.6
PICTURE_EVERY_S = 5.0


class Rover:
    """Senses, decides between a few modes, and turns the wheels."""

    def __init__(self, robot: Supervisor, bridge: MCPBridge) -> None:
        self.robot = robot
        self.speed = bridge.parameter(
            "speed", 5.0, low=0.0, high=MAX_SPEED_RADPS, unit="rad/s", doc="cruising speed"
        )
        self.near = bridge.parameter(
            "near", 0.35, low=0.2, high=FREE_M, unit="m", doc="how near it gets before it turns"
        )
        self.time_step = int(robot.getBasicTimeStep())
        self.motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
        self.encoders = [robot.getDevice(f"{side} wheel sensor") for side in ("left", "right")]
        self.eyes = [robot.getDevice(name) for name in ("ds_left", "ds_right")]
        self.gps = robot.getDevice("gps")
        self.imu = robot.getDevice("inertial unit")
        self.lidar = robot.getDevice("lidar")
        self.camera = robot.getDevice("camera")
        for sensor in (*self.encoders, *self.eyes, self.gps, self.imu):
            sensor.enable(self.time_step)
        for sensor in (self.lidar, self.camera):
            sensor.enable(4 * self.time_step)
        self.start()

    def start(self) -> None:
        """Begins anew: at the start, and when the simulation was reset under our feet."""
        self.time_s = 0.0
        self.mode, self.mode_since_s = "cruise", 0.0
        self.turn_sign = 1.0
        self.heading_rad: float | None = None
        self.stuck_since_s: float | None = None
        self.wheels_rad: list[float] | None = None
        for motor in self.motors:
            motor.setPosition(inf)

    def sense(self) -> dict[str, Any]:
        """Reads the sensors; the result is what gets published."""
        seconds = self.time_step / 1000.0
        x, y, _ = self.gps.getValues()
        self.yaw_rad = self.imu.getRollPitchYaw()[2]
        self.distances_m = [eye.getValue() for eye in self.eyes]
        wheels = [encoder.getValue() for encoder in self.encoders]
        before = self.wheels_rad or wheels
        speeds = [(wheels[i] - before[i]) / seconds for i in (0, 1)]
        self.wheels_rad, self.time_s = wheels, self.robot.getTime()
        self.stuck = self.is_stuck(WHEEL_RADIUS_M * sum(speeds) / 2.0, self.gps.getSpeedVector())
        return {
            "pose": {"x": x, "y": y, "yaw": self.yaw_rad},
            "mode": self.mode,
            "wheel_radps": {"left": speeds[0], "right": speeds[1]},
            "distance_m": {"left": self.distances_m[0], "right": self.distances_m[1]},
            "lidar": self.scan(),
            "stuck": self.stuck,
        }

    def scan(self) -> dict[str, float] | None:
        """The nearest thing that the lidar sees; None before its first scan."""
        if not self.lidar.range_image or self.time_s < 0.1:
            return None
        ranges = self.lidar.getRangeImage()
        nearest = min(range(len(ranges)), key=lambda i: ranges[i])
        bearing = self.lidar.getFov() * (0.5 - nearest / (len(ranges) - 1))
        return {"nearest_m": ranges[nearest], "bearing_rad": bearing}

    def is_stuck(self, rolled_mps: float, velocity_mps: list[float]) -> bool:
        """Whether the wheels have turned for half a second without getting anywhere."""
        spinning = abs(rolled_mps) > 0.05 and hypot(*velocity_mps[:2]) < 0.3 * abs(rolled_mps)
        if not spinning:
            self.stuck_since_s = None
        elif self.stuck_since_s is None:
            self.stuck_since_s = self.time_s
        return self.stuck_since_s is not None and self.time_s - self.stuck_since_s > 0.5

    def decide(self) -> None:
        """Chooses the next mode."""
        left, right = self.distances_m
        since_s = self.time_s - self.mode_since_s
        if self.mode == "cruise" and self.stuck:
            self.enter("back_up")
        elif self.mode == "cruise" and min(left, right) < self.near.value:
            self.turn_sign = 1.0 if left > right else -1.0
            self.enter("turn")
        elif self.mode == "back_up" and since_s > 0.8:
            self.enter("turn")
        elif self.mode == "turn":
            if since_s > 0.4 and min(left, right) > FREE_M:
                self.enter("cruise")
        elif self.mode == "turn_to" and abs(self.heading_error()) < 0.03:
            self.enter("cruise")

    def enter(self, mode: str) -> None:
        self.mode, self.mode_since_s = mode, self.time_s

    def heading_error(self) -> float:
        """How far to turn to the left for the heading that was asked for, from -pi to pi."""
        return (((self.heading_rad or 0.0) - self.yaw_rad) + pi) % (2.0 * pi) - pi

    def act(self) -> None:
        """Sets the wheels' speeds for the mode."""
        speed = self.speed.value
        turn_to = max(-3.0, min(3.0, 6.0 * self.heading_error()))
        left, right = {
            "cruise": (speed, speed),
            "back_up": (-speed, -speed),
            "turn": (-3.0 * self.turn_sign, 3.0 * self.turn_sign),
            "turn_to": (-turn_to, turn_to),
        }[self.mode]
        self.motors[0].setVelocity(left)
        self.motors[1].setVelocity(right)

    # Commands: what they return is the answer -----------------------------------------------------

    def set_speed(self, command: dict[str, Any]) -> dict[str, float]:
        """Set the cruising speed: `speed` in rad/s of the wheels, 0 to 10."""
        self.speed.set(max(0.0, min(MAX_SPEED_RADPS, float(command["speed"]))))
        return {"speed_radps": self.speed.value}

    def turn_to(self, command: dict[str, Any]) -> dict[str, float]:
        """Turn on the spot to `heading` in radians (0 is east, pi/2 north), then cruise on."""
        self.heading_rad = float(command["heading"])
        self.enter("turn_to")
        return {"heading_rad": self.heading_rad, "to_turn_rad": self.heading_error()}


def main() -> None:
    robot = Supervisor()
    bridge = MCPBridge(robot)
    rover = Rover(robot, bridge)
    bridge.register_command("set_speed", rover.set_speed)
    bridge.register_command("turn_to", rover.turn_to)
    bridge.on_reload(lambda: bridge.log("the world was reset or reloaded"))
    bridge.keep_camera(rover.camera)  # a breakpoint that keeps has pictures of what led there
    next_picture_s, mode = 1.0, rover.mode

    while robot.step(rover.time_step) != -1:
        if bridge.detect_reload():  # a reset: the motors hold until told again
            rover.start()
            next_picture_s = 1.0
        state = rover.sense()
        rover.decide()
        rover.act()
        bridge.publish(state, force=rover.mode != mode)
        bridge.get_command()
        if rover.mode != mode:
            bridge.log(f"{mode} -> {rover.mode}", level="warning" if rover.stuck else "info")
            mode = rover.mode
        if rover.time_s > next_picture_s:
            bridge.save_camera_frame(rover.camera)
            next_picture_s = rover.time_s + PICTURE_EVERY_S


if __name__ == "__main__":
    main()
