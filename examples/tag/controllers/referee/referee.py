"""The referee of a game of tag: tells the players where the other is, counts, sets them apart."""

import json
from math import dist
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

CAUGHT_M = 0.35
CORNERS_M = ((1.4, 1.4), (1.4, -1.4), (-1.4, 1.4), (-1.4, -1.4))
PLAYERS = ("hunter", "runner")


class Referee:
    """Keeps count of the game."""

    def __init__(self, robot: Supervisor) -> None:
        self.robot = robot
        self.players = {name: self.find(name.upper()) for name in PLAYERS}
        self.told = {name: node.getField("customData") for name, node in self.players.items()}
        self.start()

    def find(self, name: str) -> Any:
        node = self.robot.getFromDef(name)
        if node is None:
            raise SystemExit(f"the world has no DEF {name}: open worlds/tag.wbt")
        return node

    def start(self) -> None:
        """Begins to count, at the start and after a reset."""
        self.catches, self.round_since_s, self.longest_round_s = 0, 0.0, 0.0

    def watch(self) -> dict[str, Any]:
        """Looks at the players and tells each where the other is; the result gets published."""
        self.places = {name: node.getPosition()[:2] for name, node in self.players.items()}
        self.distance_m = dist(*self.places.values())
        for name, other in zip(PLAYERS, reversed(PLAYERS), strict=True):
            place = [round(place_m, 3) for place_m in self.places[other]]
            self.told[name].setSFString(json.dumps(place))
        return {
            **{name: dict(zip("xy", place, strict=True)) for name, place in self.places.items()},
            "distance_m": self.distance_m,
            "catches": self.catches,
            "round_s": self.robot.getTime() - self.round_since_s,
        }

    def caught(self) -> float | None:
        """The seconds of the round that just ended; None while it goes on."""
        if not self.distance_m <= CAUGHT_M:  # also where Webots is ending and tells no place
            return None
        now_s = self.robot.getTime()
        round_s, self.round_since_s = now_s - self.round_since_s, now_s
        self.catches += 1
        self.longest_round_s = max(self.longest_round_s, round_s)
        self.set_apart()
        return round_s

    def set_apart(self) -> None:
        """Puts the runner into the corner that is farthest from the hunter."""
        x, y = max(CORNERS_M, key=lambda corner: dist(corner, self.places["hunter"]))
        runner = self.players["runner"]
        runner.getField("translation").setSFVec3f([x, y, 0.04])
        runner.resetPhysics()

    def score(self, command: dict[str, Any]) -> dict[str, float]:
        """Say how the game stands."""
        return {"catches": self.catches, "longest_round_s": self.longest_round_s}


def main() -> None:
    robot = Supervisor()
    bridge = MCPBridge(robot)
    referee = Referee(robot)
    bridge.register_command("score", referee.score)
    bridge.describe("catches", quantity="count")

    while robot.step(int(robot.getBasicTimeStep())) != -1:
        if bridge.detect_reload():
            referee.start()
        bridge.publish(referee.watch())
        bridge.get_command()
        if (round_s := referee.caught()) is not None:
            bridge.log(f"caught after {round_s:.1f} s")


if __name__ == "__main__":
    main()
