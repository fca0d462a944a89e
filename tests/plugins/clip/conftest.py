"""A robot that drives into a wall, as a bridge records it, with the frames of its cameras."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.recordings.rows import Recorded, RecordedRobot
from tests.server.conftest import connect as connect
from tests.server.conftest import file as file
from tests.server.conftest import recorded as recorded

HIT_S = 6.0
STEP_S = 0.1


class Crash:
    """Ten seconds: it cruises to the wall, hits it at 6 s, and backs up."""

    def __init__(self, recorded: Recorded, folder: Path, name: str = "rover") -> None:
        self.folder = folder
        self.robot: RecordedRobot = recorded.robot(name)
        (folder / "camera").mkdir(exist_ok=True)

    def drive(self, *, position: bool = True, end_s: float = 10.0) -> Crash:
        for step in range(round(end_s / STEP_S) + 1):
            time_s = round(step * STEP_S, 6)
            self.robot.state(time_s, self.state(time_s, position=position))
        return self

    def state(self, time_s: float, *, position: bool = True) -> dict[str, Any]:
        x = 0.5 * time_s if time_s < HIT_S else 3.0 - 0.2 * (time_s - HIT_S)
        state: dict[str, Any] = {
            "mode": "cruise" if time_s < HIT_S else "back_up",
            "front_m": round(abs(3.0 - x), 6),
            "speed_mps": 0.5 if time_s < HIT_S else -0.2,
            "t": time_s,
        }
        if position:
            state["pose"] = {"x": x, "y": 0.2 * math.sin(time_s), "yaw": 0.2 * math.cos(time_s)}
        return state

    def frame(
        self, time_s: float, camera: str = "eye", size: tuple[int, int] = (160, 120),
        data: bytes | None = None,
    ) -> Path:  # fmt: skip
        """Record a frame whose red grows with time; `data` is other content of its file."""
        path = f"camera/{camera}.{round(1000 * time_s):06d}.png"
        file = self.folder / path
        if data is None:
            content = io.BytesIO()
            Image.new("RGB", size, (round(25 * time_s), 80, 160)).save(content, "PNG")
            data = content.getvalue()
        file.write_bytes(data)
        self.robot.image(time_s, path, device=camera, width=size[0], height=size[1])
        return file

    def film(self, start_s: float, end_s: float, camera: str = "eye", every_s: float = 0.2) -> None:
        for number in range(round((end_s - start_s) / every_s) + 1):
            self.frame(round(start_s + number * every_s, 6), camera)

    def hit(self) -> int:
        """Record that a condition held at the hit; return the id of the event."""
        data = {"breakpoint_id": 1, "values": {"front_m": 0.0}}
        return self.robot.event(HIT_S, "breakpoint", "front_m < 0.1", data)


@pytest.fixture
def crash(recorded: Recorded, file: Path) -> Iterator[Crash]:
    yield Crash(recorded, file.parent)
