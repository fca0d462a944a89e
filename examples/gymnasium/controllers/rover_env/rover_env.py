"""A Gymnasium-style environment in which a rover learns to drive to a goal: an episode is a run.

`RoverEnv` has `reset` and `step` as Gymnasium and deepbots have them, and needs nothing of either;
to train with a library, add `gymnasium.Env` as its base. The bridge needs no word about episodes:
each `simulationReset` begins another run, and what `publish` says of a step is in that run.
"""

import random
from math import atan2, cos, dist, inf, pi, sin
from typing import Any

from controller import Supervisor

from webots_mcp import MCPBridge

STEPS_PER_ACTION = 4
ACTIONS_PER_EPISODE = 200
MAX_SPEED_RADPS = 10.0
GOAL_M = 0.2
EPISODES = 40
SEEN = ("goal_left", "goal_ahead", "near_left", "near_right")
"""What an observation has, and a weight for each of them."""

Info = dict[str, Any]


class RoverEnv:
    """Observes where the goal is and what is ahead; an action is how far to steer, -1 to 1."""

    def __init__(self) -> None:
        self.robot = robot = Supervisor()
        self.bridge = MCPBridge(robot, throttle_interval=1)
        self.bridge.describe("action.steer", quantity="turn rate", role="commanded")
        self.bridge.describe("reward", quantity="count")  # it belongs to no sensor
        self.time_step = int(robot.getBasicTimeStep())
        goal: Any = robot.getFromDef("GOAL")
        self.goal: list[float] = goal.getPosition()[:2]
        self.motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
        self.gps, self.imu = robot.getDevice("gps"), robot.getDevice("inertial unit")
        self.eyes = [robot.getDevice(name) for name in ("ds_left", "ds_right")]
        for sensor in (self.gps, self.imu, *self.eyes):
            sensor.enable(self.time_step)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[list[float], Info]:
        """Begins an episode: the world as it was, the motors without position, a first look."""
        self.robot.simulationReset()
        self.robot.step(self.time_step)
        for motor in self.motors:
            motor.setPosition(inf)
            motor.setVelocity(0.0)
        self.robot.step(self.time_step)
        self.actions, self.score, self.to_goal_m = 0, 0.0, self.distance_m()
        return self.observe(), {}

    def step(self, action: float) -> tuple[list[float], float, bool, bool, Info]:
        """Steers for four time steps; the reward is by how much the goal came nearer."""
        steer = max(-1.0, min(1.0, action))
        for motor, sign in zip(self.motors, (-1.0, 1.0), strict=True):
            motor.setVelocity(MAX_SPEED_RADPS * (1.0 - abs(steer) + sign * steer) / 2.0)
        if self.robot.step(STEPS_PER_ACTION * self.time_step) == -1:
            raise SystemExit
        before_m, self.to_goal_m = self.to_goal_m, self.distance_m()
        reward, self.actions = before_m - self.to_goal_m, self.actions + 1
        self.score += reward
        arrived, over = self.to_goal_m < GOAL_M, self.actions >= ACTIONS_PER_EPISODE
        self.record(steer, reward, arrived)
        return self.observe(), reward, arrived, over, {}

    def record(self, steer: float, reward: float, arrived: bool) -> None:
        """What the assistant shall be able to ask for."""
        x, y, _ = self.gps.getValues()
        self.bridge.publish(
            {
                "pose": {"x": x, "y": y},
                "action": {"steer": steer},
                "reward": reward,
                "score": self.score,
                "to_goal_m": self.to_goal_m,
                "arrived": arrived,
            }
        )
        self.bridge.get_command()

    def distance_m(self) -> float:
        return dist(self.gps.getValues()[:2], self.goal)

    def observe(self) -> list[float]:
        """The bearing of the goal as sine and cosine, and how near the eyes see something."""
        x, y, _ = self.gps.getValues()
        heading_rad = self.imu.getRollPitchYaw()[2]
        bearing_rad = (atan2(self.goal[1] - y, self.goal[0] - x) - heading_rad) % (2.0 * pi)
        return [sin(bearing_rad), cos(bearing_rad), *(1.0 - eye.getValue() for eye in self.eyes)]


def episode(env: RoverEnv, weights: list[float]) -> float:
    """Drives by a linear policy until it arrives or time is over; returns the score."""
    observation, _ = env.reset()
    while True:
        action = sum(w * seen for w, seen in zip(weights, observation, strict=True))
        observation, _, arrived, over, _ = env.step(action)
        if arrived or over:
            return env.score


def in_words(weights: list[float]) -> str:
    return ", ".join(f"{name} {weight:.2f}" for name, weight in zip(SEEN, weights, strict=True))


def main() -> None:
    """Learns by random search: a change of the weights stays where the score is no worse."""
    env, chance = RoverEnv(), random.Random(1)
    best, weights = -inf, [0.0, 0.0, 0.0, 0.0]
    for number in range(EPISODES):
        tried = [w + chance.gauss(0.0, 0.5) for w in weights] if number else weights
        score = episode(env, tried)
        if score >= best:
            best, weights = score, tried
        env.bridge.log(f"episode {number}: score {score:.2f} m with {in_words(tried)}")


if __name__ == "__main__":
    main()
