"""A youBot that collects cubes: it drives to each, picks it up and sets it down by its color.

It is a Supervisor, and carries a cube by moving it along: the arm and the fingers do their work,
but whether a grip holds by friction is not what this example is about. It drives ahead and turns,
as any robot with wheels at its sides; its Mecanum wheels could do more.
"""

from math import atan2, cos, dist, hypot, inf, sin
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

WHEEL_RADIUS_M, AHEAD_M, ASIDE_M = 0.05, 0.228, 0.158
REACH_M = 0.47
"""How far ahead of its middle the robot stands from what it picks up or sets down."""
ARM_RAD = {
    "travel": (0.0, 1.57, -2.635, 1.78, 0.0),
    "floor": (0.0, -0.97, -1.55, -0.61, 0.0),
    "plate": (0.0, 0.92, 0.42, 1.78, 0.0),
}
"""The angles of the five joints of the arm for each of its poses."""
FINGERS_M = {"open": 0.025, "closed": 0.0}
ARM_S = 2.5
"""How long the arm takes for the longest way, with something to spare."""
HALF_CUBE_M = 0.02


class Collector:
    """Drives from cube to field until all cubes lie where they belong."""

    def __init__(self, robot: Supervisor, bridge: MCPBridge) -> None:
        self.robot, self.bridge = robot, bridge
        self.speed = bridge.parameter("speed", 0.4, low=0.05, high=0.7, unit="m/s")
        time_step = int(robot.getBasicTimeStep())
        self.wheels = [robot.getDevice(f"wheel{number}") for number in range(1, 5)]
        self.arm = [robot.getDevice(f"arm{number}") for number in range(1, 6)]
        self.arm_sensors = [robot.getDevice(f"arm{number}sensor") for number in range(1, 6)]
        self.finger = robot.getDevice("finger::left")
        self.gps, self.imu = robot.getDevice("gps"), robot.getDevice("inertial unit")
        for sensor in (self.gps, self.imu, *self.arm_sensors):
            sensor.enable(time_step)
        for counter in ("left", "delivered.*"):
            bridge.describe(counter, quantity="count")
        self.cubes, self.fields = self.find("CUBE_"), self.find("FIELD_")
        self.start()

    def find(self, beginning: str) -> dict[str, Any]:
        """The nodes at the top of the scene whose DEF begins so, by the rest of their names."""
        children: Any = self.robot.getRoot().getField("children")
        nodes = [children.getMFNode(i) for i in range(children.getCount())]
        return {
            name.removeprefix(beginning).lower(): node
            for node in nodes
            if (name := node.getDef()).startswith(beginning)
        }

    def start(self) -> None:
        """Begins anew: at the start, and when the simulation was reset under our feet."""
        self.mode, self.since_s, self.time_s = "choose", 0.0, 0.0
        self.cube: str | None = None
        self.waiting = sorted(self.cubes)
        self.delivered = dict.fromkeys(self.fields, 0)
        for wheel in self.wheels:
            wheel.setPosition(inf)
        self.move_arm("travel")
        self.move_fingers("open")
        self.drive(0.0, 0.0)

    # What it sees ---------------------------------------------------------------------------------

    def sense(self) -> dict[str, Any]:
        """Reads the sensors; the result is what gets published."""
        self.time_s = self.robot.getTime()
        self.x_m, self.y_m, _ = self.gps.getValues()
        self.heading_rad = self.imu.getRollPitchYaw()[2]
        angles = [sensor.getValue() for sensor in self.arm_sensors]
        return {
            "pose": {"x": self.x_m, "y": self.y_m, "yaw": self.heading_rad},
            "mode": self.mode,
            "cube": self.cube,
            "delivered": self.delivered,
            "left": len(self.waiting),
            "gripper": self.fingers,
            "arm": {
                "state": self.arm_pose,
                **{f"arm{number}_rad": angle for number, angle in enumerate(angles, 1)},
            },
            "to_goal_m": hypot(*self.ahead_and_left()) if self.mode in ("fetch", "carry") else None,
        }

    def goal(self) -> list[float]:
        """Where the cube lies that it fetches, or the field that it carries it to."""
        assert self.cube is not None
        color = self.cube.partition("_")[0]
        node = self.cubes[self.cube] if self.mode == "fetch" else self.fields[color]
        return node.getPosition()

    def ahead_and_left(self) -> tuple[float, float]:
        """Where the goal is, seen from the robot."""
        goal = self.goal()
        x, y = goal[0] - self.x_m, goal[1] - self.y_m
        c, s = cos(self.heading_rad), sin(self.heading_rad)
        return c * x + s * y, c * y - s * x

    # What it does ---------------------------------------------------------------------------------

    def act(self) -> None:
        """Goes on with what it is at."""
        {
            "choose": self.choose,
            "fetch": self.approach,
            "grip": self.grip,
            "lift": self.lift,
            "carry": self.approach,
            "lower": self.lower,
            "release": self.release,
            "back_up": self.back_up,
            "done": lambda: None,
        }[self.mode]()
        if self.mode in ("carry", "lower"):
            self.take_along()

    def enter(self, mode: str) -> None:
        self.mode, self.since_s = mode, self.time_s
        self.drive(0.0, 0.0)

    def is_over(self, seconds: float) -> bool:
        return self.time_s - self.since_s > seconds

    def choose(self) -> None:
        """The nearest cube that is left."""
        if not self.waiting:
            self.enter("done")
            self.bridge.log("all cubes lie where they belong")
            return
        here = (self.x_m, self.y_m)
        self.cube = min(self.waiting, key=lambda name: dist(here, self.place_of(name)))
        self.enter("fetch")

    def place_of(self, cube: str) -> list[float]:
        return self.cubes[cube].getPosition()[:2]

    def approach(self) -> None:
        """Turns to the goal, drives to where the arm reaches it, and then stretches the arm."""
        ahead_m, left_m = self.ahead_and_left()
        bearing_rad, short_m = atan2(left_m, ahead_m), hypot(ahead_m, left_m) - REACH_M
        if short_m < 0.01 and abs(bearing_rad) < 0.05:
            self.move_arm("floor")
            self.enter("grip" if self.mode == "fetch" else "lower")
            return
        ahead = max(-1.0, min(1.0, 3.0 * short_m)) if abs(bearing_rad) < 0.3 else 0.0
        self.drive(self.speed.value * ahead, max(-1.0, min(1.0, 3.0 * bearing_rad)))

    def grip(self) -> None:
        """Closes the fingers once the arm is down."""
        if self.is_over(ARM_S) and self.fingers == "open":
            self.move_fingers("closed")
        elif self.is_over(ARM_S + 1.0):
            self.move_arm("travel")
            self.enter("lift")

    def lift(self) -> None:
        if self.is_over(ARM_S):
            self.waiting.remove(self.cube or "")
            self.enter("carry")

    def lower(self) -> None:
        """Opens the fingers once the arm is down, and the cube lies on the field."""
        if self.is_over(ARM_S):
            self.set_down()
            self.move_fingers("open")
            self.enter("release")

    def release(self) -> None:
        if self.is_over(1.0):
            color = (self.cube or "").partition("_")[0]
            self.delivered[color] += 1
            self.bridge.log(f"delivered {self.cube}")
            self.cube = None
            self.move_arm("travel")
            self.enter("back_up")

    def back_up(self) -> None:
        self.drive(-self.speed.value / 2.0, 0.0)
        if self.is_over(2.0):
            self.enter("choose")

    def take_along(self) -> None:
        """The cube is where the gripper is: above the plate, or on its way down to the floor."""
        part = min(1.0, (self.time_s - self.since_s) / ARM_S) if self.mode == "lower" else 0.0
        self.move_cube(REACH_M * part, 0.25 * (1.0 - part) + HALF_CUBE_M * part)

    def set_down(self) -> None:
        self.move_cube(REACH_M, HALF_CUBE_M)

    def move_cube(self, ahead_m: float, z_m: float) -> None:
        x = self.x_m + ahead_m * cos(self.heading_rad)
        y = self.y_m + ahead_m * sin(self.heading_rad)
        self.cubes[self.cube or ""].getField("translation").setSFVec3f([x, y, z_m])

    # Motors ---------------------------------------------------------------------------------------

    def drive(self, ahead_mps: float, turn_radps: float) -> None:
        """Sets the wheels: 1 and 3 are on the right, 2 and 4 on the left."""
        turn_mps = (AHEAD_M + ASIDE_M) * turn_radps
        for wheel, sign in zip(self.wheels, (1.0, -1.0, 1.0, -1.0), strict=True):
            wheel.setVelocity((ahead_mps + sign * turn_mps) / WHEEL_RADIUS_M)

    def move_arm(self, pose: str) -> None:
        self.arm_pose = pose
        for joint, angle_rad in zip(self.arm, ARM_RAD[pose], strict=True):
            joint.setPosition(angle_rad)

    def move_fingers(self, state: str) -> None:
        """The left finger's motor moves both."""
        self.fingers = state
        self.finger.setVelocity(0.03)
        self.finger.setPosition(FINGERS_M[state])


def main() -> None:
    robot = Supervisor()
    bridge = MCPBridge(robot)
    collector = Collector(robot, bridge)

    while robot.step(int(robot.getBasicTimeStep())) != -1:
        if bridge.detect_reload():
            collector.start()
        bridge.publish(collector.sense())
        bridge.get_command()
        collector.act()


if __name__ == "__main__":
    main()
