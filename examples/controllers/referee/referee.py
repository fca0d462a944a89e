"""A referee that watches the rover from above, keeps count, and can put it elsewhere."""

from math import dist
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

HALF_ARENA_M = 2.0
ROVER_RADIUS_M = 0.13
OBSTACLES_M = {"OBSTACLE_BOX_1": 0.15, "OBSTACLE_BOX_2": 0.15, "OBSTACLE_PILLAR": 0.15}
"""DEF names of what stands in the arena, with half of its width."""
LOOSE = ("CRATE", "BALL")


class Referee:
    """Keeps count of what one robot does."""

    def __init__(self, robot: Supervisor) -> None:
        self.robot = robot
        self.rover = self.find("ROVER")
        self.loose = {name: self.find(name) for name in LOOSE}
        self.obstacles = {
            name: (self.find(name).getPosition(), half_m) for name, half_m in OBSTACLES_M.items()
        }
        self.start()

    def find(self, name: str) -> Any:
        node = self.robot.getFromDef(name)
        if node is None:
            raise SystemExit(f"the world has no DEF {name}: open worlds/arena_referee.wbt")
        return node

    def start(self) -> None:
        """Begins to count, at the start and after a reset."""
        self.time_s = 0.0
        self.distance_m, self.collisions = 0.0, 0
        self.touched: str | None = None
        self.last = self.rover.getPosition()
        self.first = {name: node.getPosition() for name, node in self.loose.items()}

    def watch(self) -> dict[str, Any]:
        """Looks at the world; the result is what gets published."""
        here = self.rover.getPosition()
        self.distance_m += dist(here, self.last)
        self.last, self.time_s = here, self.robot.getTime()
        touched = self.touching(here)
        self.collisions += touched is not None and touched != self.touched
        self.touched = touched
        return {
            "rover": {"x": here[0], "y": here[1], "region": region(here)},
            "distance_m": self.distance_m,
            "collisions": self.collisions,
            "touching": touched or "nothing",
            "moved_m": {
                name.lower(): dist(node.getPosition(), self.first[name])
                for name, node in self.loose.items()
            },
        }

    def touching(self, here: list[float]) -> str | None:
        """What the rover is so near to that it must touch it."""
        if max(abs(here[0]), abs(here[1])) > HALF_ARENA_M - ROVER_RADIUS_M:
            return "wall"
        for name, (there, half_m) in self.obstacles.items():
            if dist(here[:2], there[:2]) < half_m + ROVER_RADIUS_M:
                return name.lower()
        return None

    def place_rover(self, command: dict[str, Any]) -> dict[str, float]:
        """Put the rover at `x`, `y` (metres, -1.8 to 1.8), facing `heading` (radians)."""
        x, y = float(command["x"]), float(command["y"])
        heading = float(command.get("heading", 0.0))
        if max(abs(x), abs(y)) > 1.8:
            raise ValueError(f"({x}, {y}) is not inside the arena: use -1.8 to 1.8")
        self.rover.getField("translation").setSFVec3f([x, y, 0.04])
        self.rover.getField("rotation").setSFRotation([0.0, 0.0, 1.0, heading])
        self.rover.resetPhysics()
        self.last = [x, y, 0.04]  # being carried is not distance travelled
        return {"x": x, "y": y, "heading_rad": heading}


def region(position: list[float]) -> str:
    """The quarter of the arena: x is east, y is north."""
    return f"{'north' if position[1] >= 0 else 'south'}-{'east' if position[0] >= 0 else 'west'}"


def main() -> None:
    robot = Supervisor()
    time_step = 4 * int(robot.getBasicTimeStep())
    referee = Referee(robot)
    bridge = MCPBridge(robot, throttle_interval=1)
    bridge.register_command("place_rover", referee.place_rover)
    touched = None

    while robot.step(time_step) != -1:
        if bridge.detect_reload():
            referee.start()
        bridge.publish(referee.watch())
        bridge.get_command()
        if referee.touched and referee.touched != touched:
            bridge.log(f"the rover touches {referee.touched}", level="warning")
        touched = referee.touched


if __name__ == "__main__":
    main()
