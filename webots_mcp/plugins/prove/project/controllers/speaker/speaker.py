"""A robot of `webots-mcp prove` without a bridge: an observer records what it writes."""

import json
from typing import Any

from controller import Robot

robot: Any = Robot()
messages = 0
while robot.step(16) != -1:
    messages += 1
    robot.setCustomData(json.dumps({"seq": messages, "twice": 2 * messages}))
